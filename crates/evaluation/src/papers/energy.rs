//! Energies and signal-to-noise ratios of the silhouettes (Lytvynets 2020, tables 1 and 2).

use crossfix_simulation::Silhouette;

use super::ValidationOptions;
use super::table::{Limit, SampleStatistic, Table, TableRow};

/// What the tables print of a silhouette.
struct PrintedEnergy {
    sides: [usize; 2],
    energy: f64,
    /// Output signal-to-noise ratio at sigma_n 0.1 to 0.6, dB.
    decibels: [f64; 6],
}

/// The silhouettes of the tables: they are the paper's.
const PRINTED: [PrintedEnergy; 3] = [
    PrintedEnergy {
        sides: [50, 30],
        energy: 136.6247,
        decibels: [38.34, 32.32, 28.8, 26.3, 24.36, 22.78],
    },
    PrintedEnergy {
        sides: [25, 15],
        energy: 36.7910,
        decibels: [32.64, 26.62, 23.10, 20.60, 18.66, 17.08],
    },
    PrintedEnergy { sides: [10, 6], energy: 5.1953, decibels: [24.1, 18.1, 14.6, 12.1, 10.2, 8.6] },
];

/// Tables 1 and 2. The paper's "15.2" is 16.24 (errata), its 12.1 dB is right.
pub(super) fn tables(_: ValidationOptions) -> Vec<Table> {
    let (mut energies, mut ratios) = (Vec::new(), Vec::new());
    for PrintedEnergy { sides, energy: printed, decibels } in PRINTED {
        let canvas = Silhouette::new(sides[0], sides[1]).canvas(0);
        let mean = canvas.iter().sum::<f32>() / canvas.len() as f32;
        let energy: f64 = canvas.iter().map(|b| f64::from(b - mean).powi(2)).sum();
        let name = format!("{}x{}", sides[0], sides[1]);
        let near = |value: f64, share: f64| Limit::Near { value, tolerance: share * value };
        energies.push(
            TableRow::new(&name, sides[0] as f64, SampleStatistic::exact(energy))
                .paper(printed)
                .limit(near(printed, 0.01)),
        );
        for (i, paper) in decibels.into_iter().enumerate() {
            let sigma_n = 0.1 * (i + 1) as f64;
            // h^2 = E / (2 sigma_n^2), Lytvynets 2020, chapter 6, eq. 3.
            let ratio = 10.0 * (energy / (2.0 * sigma_n * sigma_n)).log10();
            let row = TableRow::new(&name, sigma_n, SampleStatistic::exact(ratio));
            ratios.push(row.paper(paper).limit(near(paper, 0.02)));
        }
    }
    let table = |name, title: &str, x, y, rows| Table { name, title: title.to_owned(), x, y, rows };
    vec![
        table(
            "energy",
            "Energy of the silhouettes (Lytvynets 2020, table 1)",
            "columns",
            "energy",
            energies,
        ),
        table(
            "ratio",
            "Output signal-to-noise ratio (Lytvynets 2020, table 2)",
            "sigma_n",
            "dB",
            ratios,
        ),
    ]
}
