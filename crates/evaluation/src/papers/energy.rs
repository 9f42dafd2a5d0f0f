//! Energies and signal-to-noise ratios of the silhouettes (Lytvynets 2020, tables 1 and 2).

use crossfix_simulation::Silhouette;

use super::ValidationOptions;
use super::table::{Limit, Table, TableRow};

/// Sides, energy, and output signal-to-noise ratio in dB at sigma_n 0.1 to 0.6, as printed.
const PRINTED: [([usize; 2], f64, [f64; 6]); 3] = [
    ([50, 30], 136.6247, [38.34, 32.32, 28.8, 26.3, 24.36, 22.78]),
    ([25, 15], 36.7910, [32.64, 26.62, 23.10, 20.60, 18.66, 17.08]),
    ([10, 6], 5.1953, [24.1, 18.1, 14.6, 12.1, 10.2, 8.6]),
];

/// Tables 1 and 2. The paper's "15.2" is 16.24 (errata), its 12.1 dB is right.
pub(super) fn tables(_: ValidationOptions) -> Vec<Table> {
    let (mut energies, mut ratios) = (Vec::new(), Vec::new());
    for (sides, printed, decibels) in PRINTED {
        let canvas = Silhouette::new(sides[0], sides[1]).canvas(0);
        let mean = canvas.iter().sum::<f32>() / canvas.len() as f32;
        let energy: f64 = canvas.iter().map(|b| f64::from(b - mean).powi(2)).sum();
        let name = format!("{}x{}", sides[0], sides[1]);
        let near = |value: f64, share: f64| Limit::Near { value, tolerance: share * value };
        energies.push(
            TableRow::new(&name, sides[0] as f64, (energy, 0.0))
                .paper(printed)
                .limit(near(printed, 0.01)),
        );
        for (i, paper) in decibels.into_iter().enumerate() {
            let sigma_n = 0.1 * (i + 1) as f64;
            // h^2 = E / (2 sigma_n^2), Lytvynets 2020, chapter 6, eq. 3.
            let ratio = 10.0 * (energy / (2.0 * sigma_n * sigma_n)).log10();
            ratios.push(
                TableRow::new(&name, sigma_n, (ratio, 0.0)).paper(paper).limit(near(paper, 0.02)),
            );
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
