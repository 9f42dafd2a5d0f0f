//! The papers' tables and figures computed again, each figure beside the paper's: the image tracker
//! of Herasymenko 2021 and Lytvynets 2020, the adaptive reference of Solonar 2023, the fusion of
//! Klochko 2020 and the manoeuvres of Kalinov 2019.

mod brightness;
mod energy;
mod flight;
mod fusion;
mod looped;
mod loss;
mod motion;
mod positioning;
mod runs;
mod table;

pub(crate) use runs::{Noise, all as all_runs};
pub(crate) use table::mean;
pub use table::{Limit, SampleStatistic, Table, TableRow, Verdict};

/// Extent of the simulation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ValidationOptions {
    /// Number of Monte Carlo runs per experiment; the papers have 1000.
    pub runs: usize,
    /// Seed of all runs.
    pub seed: u64,
}

impl Default for ValidationOptions {
    fn default() -> Self {
        Self { runs: 200, seed: 1 }
    }
}

/// One experiment: its name, and the function that computes its tables.
struct Experiment {
    name: &'static str,
    make: fn(ValidationOptions) -> Vec<Table>,
}

/// The image tracker's experiments, in the order of their tables.
const TRACKER: [Experiment; 7] = [
    Experiment {
        name: "energies and signal-to-noise ratios (Lytvynets 2020, tables 1 and 2)",
        make: energy::tables,
    },
    Experiment {
        name: "positioning (Herasymenko 2021, Fig. 5) against the Cramer-Rao bound",
        make: positioning::tables,
    },
    Experiment {
        name: "Kalman filter and prediction (Herasymenko 2021, Fig. 6)",
        make: motion::tables,
    },
    Experiment {
        name: "loss of track (Herasymenko 2021, Fig. 7 and 8; Lytvynets 2020, tables 3 and 4), \
               paper mode",
        make: loss::paper_tables,
    },
    Experiment { name: "loss of track, default", make: loss::default_tables },
    Experiment {
        name: "brightness of a pixel (Solonar 2023, Fig. 4 to 6)",
        make: brightness::tables,
    },
    Experiment { name: "reference strategies in the loop", make: looped::tables },
];

/// Computes the image tracker's tables, of the experiments whose name contains `only`. `progress`
/// is given the number of experiments done, the number of all, and the name of the next.
pub fn validate_tracker(
    options: ValidationOptions,
    only: &str,
    progress: impl FnMut(usize, usize, &str),
) -> Vec<Table> {
    make(&TRACKER, options, only, progress)
}

/// Computes the fusion's tables, of the experiments whose name contains `only`; `progress` as in
/// [`validate_tracker`].
pub fn validate_fusion(
    options: ValidationOptions,
    only: &str,
    progress: impl FnMut(usize, usize, &str),
) -> Vec<Table> {
    make(&fusion::EXPERIMENTS, options, only, progress)
}

fn make(
    experiments: &[Experiment],
    options: ValidationOptions,
    only: &str,
    mut progress: impl FnMut(usize, usize, &str),
) -> Vec<Table> {
    let wanted: Vec<&Experiment> = experiments.iter().filter(|e| e.name.contains(only)).collect();
    let mut tables = Vec::new();
    for (done, experiment) in wanted.iter().enumerate() {
        progress(done, wanted.len(), experiment.name);
        tables.extend((experiment.make)(options));
    }
    progress(wanted.len(), wanted.len(), "");
    tables
}
