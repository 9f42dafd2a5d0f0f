//! The fusion of Klochko 2020 and the manoeuvres of Kalinov 2019.

mod degenerate;
mod detection;
mod limit;
mod manoeuvre;
mod site;

use super::Experiment;

/// Standard deviation of each component of the targets' velocities, m/s: the independent
/// implementation's. With half of it true pairs miss each other by half as much.
const VELOCITY_SD: f64 = 15.6;
/// Number of runs of the independent implementation behind each of its figures. With half of it the
/// tolerances of the comparison would be wider.
const INDEPENDENT_RUNS: usize = 300;

/// The fusion's experiments, in the order of their tables.
pub(super) const EXPERIMENTS: [Experiment; 6] = [
    Experiment { name: "detection (Klochko 2020, tables 1 and 2)", make: detection::tables },
    Experiment { name: "degenerate geometries, one period", make: degenerate::tables },
    Experiment { name: "bound of all periods, whole fusion", make: limit::fusion_tables },
    Experiment { name: "degenerate geometries, whole fusion", make: limit::degenerate_tables },
    Experiment { name: "bound of all periods, batch", make: limit::batch_tables },
    Experiment { name: "manoeuvres (Kalinov 2019, Fig. 11)", make: manoeuvre::tables },
];

/// Tolerance on the difference to an independent figure: three standard errors of the difference,
/// with the independent implementation's runs scattered as ours are over `samples` samples, and
/// half of the independent implementation's last digit.
fn independent_tolerance(
    standard_error: f64,
    samples: usize,
    independent_samples: usize,
    digit: f64,
) -> f64 {
    3.0 * standard_error * (1.0 + samples as f64 / independent_samples as f64).sqrt() + digit / 2.0
}
