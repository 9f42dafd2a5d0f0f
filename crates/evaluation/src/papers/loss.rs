//! Probability of losing the target, and number of frames for which it is kept (Herasymenko 2021,
//! Fig. 7 and 8; Lytvynets 2020, tables 3 and 4).

use crossfix_simulation::Silhouette;
use crossfix_vision::TrackerConfig;

use super::ValidationOptions;
use super::flight::{Canvas, FRAMES, PaperFollower, Stamp, texts_path};
use super::runs::{self, Noise};
use super::table::{Limit, SampleStatistic, Table, TableRow, mean, share};

/// Standard deviations of the noise, contrasts of the silhouette: the papers'.
const SIGMAS: [f64; 6] = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6];

/// A template of the papers: sides, the pedestal of the errata, and the figures of Lytvynets 2020,
/// tables 3 and 4.
struct Template {
    sides: [usize; 2],
    pedestal: f32,
    lost: [f64; 6],
    frames: [f64; 6],
}

/// The papers' templates, with the figures that they print for [`SIGMAS`].
const TEMPLATES: [Template; 3] = [
    Template {
        sides: [50, 30],
        pedestal: 0.20,
        lost: [0.0, 0.0, 0.0, 0.0, 0.0, 0.033],
        frames: [20.0, 20.0, 20.0, 20.0, 20.0, 19.45],
    },
    Template {
        sides: [25, 15],
        pedestal: 0.24,
        lost: [0.0, 0.0, 0.0, 0.0, 0.13, 0.8],
        frames: [20.0, 20.0, 20.0, 20.0, 17.03, 9.55],
    },
    Template {
        sides: [10, 6],
        pedestal: 0.28,
        lost: [0.0, 0.0, 0.1, 1.0, 1.0, 1.0],
        frames: [20.0, 20.0, 18.01, 8.15, 3.54, 3.4],
    },
];

/// Flights of one template in one noise, and the tracker that follows them.
struct LossCase<'a> {
    stamp: &'a Stamp,
    sides: [usize; 2],
    sigma_n: f64,
    config: &'a TrackerConfig,
}

impl LossCase<'_> {
    /// Number of frames for which the target was kept in each run.
    fn kept(&self, options: ValidationOptions) -> Vec<usize> {
        runs::all(options.runs, |run| self.kept_in(Noise::new(options.seed, run)))
    }

    /// The same of one run: the first frame whose prediction is off by more than the box on either
    /// axis ends it.
    fn kept_in(&self, mut noise: Noise) -> usize {
        let sides = self.sides;
        let path = texts_path(&mut noise, FRAMES, 1.0);
        let mut canvas = Canvas::new(sides);
        let Some(mut follower) = PaperFollower::new(self.config.clone(), sides) else { return 0 };
        for (frame, place) in path.iter().enumerate() {
            let image = canvas.paint(Some(self.stamp), *place, 1.0, 0.0, self.sigma_n, &mut noise);
            let off = follower
                .step(image, *place, [0.0; 2], &mut noise)
                .map_or([0.0; 2], |outcome| outcome.prediction);
            if off[0].abs() > sides[0] as f64 || off[1].abs() > sides[1] as f64 || off[0].is_nan() {
                return frame;
            }
        }
        FRAMES
    }
}

fn lost(kept: &[usize]) -> SampleStatistic {
    share(kept.iter().map(|frames| *frames < FRAMES))
}

fn frames(kept: &[usize]) -> SampleStatistic {
    mean(&kept.iter().map(|frames| *frames as f64).collect::<Vec<_>>())
}

/// Loss that an independent implementation of the papers' algorithm reaches (errata).
fn expected_lost(sides: [usize; 2], sigma_n: f64) -> Option<Limit> {
    let near = |value, tolerance| Some(Limit::Near { value, tolerance });
    match (sides[0], (sigma_n * 10.0).round() as u32) {
        (10, 3) => near(0.18, 0.055),
        (10, 4) => near(0.95, 0.03),
        (25, 5) => near(0.28, 0.06),
        (25, 6) => near(0.90, 0.04),
        _ => None,
    }
}

/// Tables 3 and 4 in paper mode.
pub(super) fn paper_tables(options: ValidationOptions) -> Vec<Table> {
    let (mut lost_rows, mut kept_rows) = (Vec::new(), Vec::new());
    for Template { sides, pedestal, lost: paper_lost, frames: paper_frames } in &TEMPLATES {
        let stamp = Stamp::pasted(&Silhouette::new(sides[0], sides[1]), *pedestal);
        let name = format!("{}x{}", sides[0], sides[1]);
        for (i, sigma_n) in SIGMAS.into_iter().enumerate() {
            let config = &TrackerConfig::paper();
            let runs = LossCase { stamp: &stamp, sides: *sides, sigma_n, config }.kept(options);
            let row = TableRow::new(&name, sigma_n, lost(&runs)).paper(paper_lost[i]);
            lost_rows.push(TableRow { limit: expected_lost(*sides, sigma_n), ..row });
            let row = TableRow::new(&name, sigma_n, frames(&runs)).paper(paper_frames[i]);
            let asked =
                (sides[0] == 10 && i == 3).then_some(Limit::Near { value: 7.4, tolerance: 0.7 });
            kept_rows.push(TableRow { limit: asked, ..row });
        }
    }
    let table =
        |name, title: &str, y, rows| Table { name, title: title.to_owned(), x: "sigma_n", y, rows };
    vec![
        table("loss-paper", "Loss probability, the papers' algorithm", "P", lost_rows),
        table(
            "frames-paper",
            "Mean frames tracked of 20, the papers' algorithm",
            "frames",
            kept_rows,
        ),
    ]
}

/// Requirement on the default tracker.
struct LossLimit {
    /// Columns of the template.
    columns: usize,
    /// Tenths of sigma_n.
    tenths: u32,
    /// Largest loss allowed.
    most: f64,
}

/// The requirements on the default tracker, which are the project's own.
const ASKED: [LossLimit; 6] = [
    LossLimit { columns: 10, tenths: 3, most: 0.01 },
    LossLimit { columns: 10, tenths: 4, most: 0.02 },
    LossLimit { columns: 10, tenths: 5, most: 0.05 },
    LossLimit { columns: 10, tenths: 6, most: 0.2 },
    LossLimit { columns: 25, tenths: 6, most: 0.01 },
    LossLimit { columns: 25, tenths: 8, most: 0.02 },
];

/// The same flights with the default tracker, and silhouettes drawn at subpixel places.
pub(super) fn default_tables(options: ValidationOptions) -> Vec<Table> {
    let mut rows = Vec::new();
    for Template { sides, lost: paper, .. } in &TEMPLATES {
        let stamp = Stamp::Drawn(Silhouette::new(sides[0], sides[1]));
        let name = format!("{}x{}", sides[0], sides[1]);
        let more = (sides[0] == 25).then_some(0.8);
        for (i, sigma_n) in SIGMAS.into_iter().chain(more).enumerate() {
            let config = &TrackerConfig::default();
            let runs = LossCase { stamp: &stamp, sides: *sides, sigma_n, config }.kept(options);
            let tenths = (sigma_n * 10.0).round() as u32;
            let asked = ASKED.iter().find(|a| a.columns == sides[0] && a.tenths == tenths);
            let row = TableRow::new(&name, sigma_n, lost(&runs));
            rows.push(TableRow {
                paper: paper.get(i).copied(),
                limit: asked.map(|asked| Limit::AtMost(asked.most)),
                ..row
            });
        }
    }
    let title = "Loss probability, default tracker".to_owned();
    vec![Table { name: "loss-default", title, x: "sigma_n", y: "P", rows }]
}
