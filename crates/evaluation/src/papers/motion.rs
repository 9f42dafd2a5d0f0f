//! The Kalman filters: consistency of the covariance, and the curves of Herasymenko 2021, Fig. 6.

use crossfix_filter::{AxisFilter, AxisMeasurement};
use crossfix_simulation::Silhouette;
use crossfix_vision::TrackerConfig;
use nalgebra::Vector2;

use super::ValidationOptions;
use super::flight::{Canvas, FRAMES, PaperFollower, Stamp, TACT, TrackErrors, texts_path};
use super::runs::{self, Noise};
use super::table::{Limit, SampleStatistic, Table, TableRow, mean, root_mean_square};

/// Number of runs of the filter alone for each run of the tracker: they take next to no time. With
/// half of it standard errors are 1.4 times as large.
const CHEAP: usize = 20;

/// NEES of the filter on its own model; required within 0.1 of 2.
fn filter_nees(options: ValidationOptions, sigma_a: f64) -> SampleStatistic {
    let samples = runs::all(CHEAP * options.runs, |run| {
        nees_of_flight(Noise::new(options.seed, run), sigma_a)
    });
    mean(&samples)
}

/// NEES at the end of one flight with white acceleration.
fn nees_of_flight(mut noise: Noise, sigma_a: f64) -> f64 {
    let (mut position, mut velocity) = (0.0, 10.0);
    let measured: [AxisMeasurement; FRAMES] = std::array::from_fn(|_| {
        let acceleration = sigma_a * noise.normal();
        position += velocity + acceleration / 2.0;
        velocity += acceleration;
        AxisMeasurement { position: position + noise.normal(), variance: 1.0 }
    });
    let mut filter = AxisFilter::start(measured[0], measured[1], 1.0, sigma_a);
    for measured in &measured[2..] {
        filter.time_update(1.0);
        filter.measurement_update(*measured);
    }
    let error = Vector2::new(position - filter.position(), velocity - filter.velocity());
    let inverse = filter.covariance().try_inverse();
    inverse.map_or(f64::NAN, |inverse| (error.transpose() * inverse * error).x)
}

/// Motion of a target: white acceleration with an SD, px/tact^2, for a number of frames, the first
/// `skipped` outcomes of which do not count.
#[derive(Clone, Copy)]
struct MotionCase {
    name: &'static str,
    sigma_a: f64,
    frames: usize,
    skipped: usize,
}

/// The papers' flight.
const TEXTS: MotionCase = MotionCase { name: "texts", sigma_a: 1.0, frames: FRAMES, skipped: 0 };
/// A straight flight, counted from when a second has shown that it is straight. With half of the
/// skipped frames, images count in which the motion may still be any.
const STRAIGHT: MotionCase = MotionCase { name: "straight", sigma_a: 0.0, frames: 50, skipped: 30 };

/// Flights of one silhouette in one noise, and the tracker that follows them.
struct TrackedFlight<'a> {
    flight: MotionCase,
    stamp: Stamp,
    sides: [usize; 2],
    sigma_n: f64,
    config: &'a TrackerConfig,
}

impl<'a> TrackedFlight<'a> {
    fn new(flight: MotionCase, sides: [usize; 2], sigma_n: f64, config: &'a TrackerConfig) -> Self {
        let stamp = Stamp::Drawn(Silhouette::new(sides[0], sides[1]));
        Self { flight, stamp, sides, sigma_n, config }
    }

    /// The outcomes of every frame, of runs in which the tracker kept the target.
    fn outcomes(&self, options: ValidationOptions) -> Vec<Vec<TrackErrors>> {
        let runs = runs::all(options.runs, |run| self.outcomes_of(Noise::new(options.seed, run)));
        runs.into_iter().flatten().filter(|run| is_kept(run, self.sides)).collect()
    }

    /// The outcomes of every frame of one run that counts; `None` if the configuration is
    /// impossible.
    fn outcomes_of(&self, mut noise: Noise) -> Option<Vec<TrackErrors>> {
        let path = texts_path(&mut noise, self.flight.frames, self.flight.sigma_a);
        let mut canvas = Canvas::new(self.sides);
        let mut follower = PaperFollower::new(self.config.clone(), self.sides)?;
        let mut outcomes = Vec::new();
        for (frame, place) in path.iter().enumerate() {
            let image = canvas.paint(Some(&self.stamp), *place, 1.0, 0.0, self.sigma_n, &mut noise);
            // The velocity at the end of the tact: the difference of places is the mean over the
            // tact.
            let velocity = velocity_at(&path, frame);
            outcomes.extend(follower.step(image, *place, velocity, &mut noise));
        }
        outcomes.drain(..self.flight.skipped.min(outcomes.len()));
        Some(outcomes)
    }
}

/// Whether a run never predicted the target further off than its size.
fn is_kept(run: &[TrackErrors], sides: [usize; 2]) -> bool {
    run.iter().all(|o| {
        o.prediction[0].abs() <= sides[0] as f64 && o.prediction[1].abs() <= sides[1] as f64
    })
}

/// The velocity at a frame, px/s: with constant acceleration over each tact, v+ = 2 dx / T - v.
fn velocity_at(path: &[[f64; 2]], frame: usize) -> [f64; 2] {
    let mut velocity = [10.0; 2];
    for pair in path[..=frame].windows(2) {
        for axis in 0..2 {
            velocity[axis] = 2.0 * (pair[1][axis] - pair[0][axis]) - velocity[axis];
        }
    }
    velocity.map(|v| v / TACT)
}

/// The mean over all frames and runs, with its error from the runs' means: the runs are
/// independent, the frames of a run are not.
fn over_runs(
    runs: &[Vec<TrackErrors>],
    of: impl Fn(&TrackErrors) -> Option<f64>,
) -> SampleStatistic {
    let of_run = |run: &Vec<TrackErrors>| run.iter().filter_map(&of).collect::<Vec<_>>();
    let each: Vec<f64> = runs.iter().map(|run| mean(&of_run(run)).value).collect();
    mean(&each)
}

/// Fig. 6, and the consistency of filter and tracker.
pub(super) fn tables(options: ValidationOptions) -> Vec<Table> {
    let near_two = |tolerance| Limit::Near { value: 2.0, tolerance };
    let nees = [0.3, 1.0, 3.0].map(|sigma_a| {
        TableRow::new("filter alone", sigma_a, filter_nees(options, sigma_a)).limit(near_two(0.1))
    });
    let table = |name, title: &str, x, y, rows| Table { name, title: title.to_owned(), x, y, rows };
    vec![
        table("nees", "NEES of the Kalman filter", "sigma_a", "NEES", nees.to_vec()),
        honesty(options),
        figure_6(options),
    ]
}

/// Consistency of the default tracker: squared innovations (NIS) and errors (NEES) over their
/// variances, each cell with its own random numbers.
fn honesty(options: ValidationOptions) -> Table {
    let mut rows = Vec::new();
    for flight in [TEXTS, STRAIGHT] {
        for sides in [[50, 30], [25, 15], [18, 12], [10, 6]] {
            for sigma_n in [0.1, 0.2, 0.3, 0.4] {
                let seed = options.seed.wrapping_add(1000 * rows.len() as u64);
                let options = ValidationOptions { seed, ..options };
                let config = &TrackerConfig::default();
                let runs = TrackedFlight::new(flight, sides, sigma_n, config).outcomes(options);
                for (what, figure) in [
                    ("NIS", over_runs(&runs, |o| o.nis)),
                    ("NEES", over_runs(&runs, |o| Some(o.nees))),
                ] {
                    let name = format!("{what} {}x{}, {}", sides[0], sides[1], flight.name);
                    let limit = Limit::Near { value: 2.0, tolerance: 0.1 };
                    rows.push(TableRow::new(name, sigma_n, figure).limit(limit));
                }
            }
        }
    }
    let title = "Consistency of the default tracker".to_owned();
    Table { name: "honesty", title, x: "sigma_n", y: "NIS, NEES", rows }
}

/// A figure of each outcome.
fn each(outcomes: &[&TrackErrors], of: impl Fn(&TrackErrors) -> f64) -> Vec<f64> {
    outcomes.iter().map(|outcome| of(outcome)).collect()
}

/// Fig. 6: 10x6 at sigma_n 0.1 in paper mode, x axis.
fn figure_6(options: ValidationOptions) -> Table {
    let config = &TrackerConfig::paper();
    let runs = TrackedFlight::new(TEXTS, [10, 6], 0.1, config).outcomes(options);
    let mut rows = Vec::new();
    for frame in 0..FRAMES - 2 {
        let outcomes: Vec<&TrackErrors> = runs.iter().filter_map(|run| run.get(frame)).collect();
        let x = (frame + 2) as f64;
        let predicted = root_mean_square(&each(&outcomes, |o| o.prediction[0]));
        rows.push(TableRow::new("prediction, Monte Carlo", x, predicted));
        let filters = mean(&each(&outcomes, |o| o.prediction_variance[0].sqrt()));
        rows.push(TableRow::new("prediction, filter", x, filters));
        // "The actual SD does not exceed the theoretical SD": holds at sigma_n 0.1 (errata).
        let actual = root_mean_square(&each(&outcomes, |o| o.estimate[0]));
        let theoretical = mean(&each(&outcomes, |o| o.estimate_variance[0].sqrt()));
        rows.push(
            TableRow::new("estimate, Monte Carlo", x, actual)
                .limit(Limit::AtMost(theoretical.value)),
        );
        rows.push(TableRow::new("estimate, filter", x, theoretical));
    }
    let title =
        "Errors of prediction and estimate on x, 10x6, sigma_n 0.1 (Herasymenko 2021, Fig. 6)"
            .to_owned();
    Table { name: "figure-6", title, x: "tact", y: "SD, px", rows }
}
