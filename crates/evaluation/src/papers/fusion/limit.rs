//! Errors of the whole fusion and of the batch solution, relative to the Cramer-Rao bound of all
//! periods.

use crossfix_filter::KinematicState;
use crossfix_fusion::spatial::{TimedLine, map};
use crossfix_fusion::{Fusion, FusionConfig, Output};
use crossfix_geometry::{Bearing, Camera};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, CameraName, ClockSource, ImageTrackState,
    Payload, Timestamp, TrackFrame, TrackState,
};
use nalgebra::{Matrix6, Point3, Vector3, Vector6};

use crate::bound::{BearingInformation, FisherInformation, LineGeometry};

use super::super::ValidationOptions;
use super::super::runs::{self, Noise};
use super::super::table::{
    Limit, SampleStatistic, Table, TableRow, mean, root_mean_square, root_ratio, share,
};
use super::site::{
    BEARING_SD, LAYOUTS, PERIODS, PaperSite, StraightTarget, bearing, line, tangent_noise,
};

/// Mean NEES of position and velocity if the covariance is consistent; the tolerance is the scatter
/// of 4000 runs. With half of the tolerance the same for up to 19 000 runs, as three standard
/// errors are always allowed.
const HONEST: Limit = Limit::Near { value: 6.0, tolerance: 0.15 };
/// Standard deviation of the prior on the velocity, m/s, of the batch solution and of the fusion.
/// With half of it the fusion's gate would refuse many targets, whose velocities have 15.6 m/s, as
/// too fast.
const PRIOR_SD: f64 = 15.0;
/// An error has diverged if it is more than this many of its own standard deviations. With half of
/// it the same: an honest error on one axis exceeds five deviations once in 1.7 million runs.
const DIVERGED_SDS: f64 = 10.0;
/// An error has diverged if it is more than this, m: two thirds of the cameras' distance. With half
/// of it the same.
const DIVERGED_M: f64 = 100.0;

/// The Cramer-Rao bound at the truth: the least covariance of position and velocity at a time that
/// any unbiased estimator can have from bearings of a target. `None` if they do not determine all
/// six numbers.
fn bound(lines: &[TimedLine], target: &StraightTarget, at: Timestamp) -> Option<Matrix6<f64>> {
    let mut information = FisherInformation::default();
    let noise = BearingInformation::isotropic(BEARING_SD)?;
    for TimedLine { line, time, .. } in lines {
        let geometry = LineGeometry::between(line.origin, target.at(time.seconds()))?;
        information.add(&geometry, &noise, time.seconds_since(at));
    }
    information.covariance()
}

/// One bearing of one camera.
struct TimedBearing {
    camera: usize,
    period: usize,
    time_s: f64,
    bearing: Bearing,
}

/// A run's target and all bearings of it, in order of their times.
struct LimitRun {
    target: StraightTarget,
    seen: Vec<TimedBearing>,
    /// The same bearings without noise.
    exact: Vec<TimedLine>,
}

impl LimitRun {
    fn new(layout: &PaperSite, cameras: &[Camera], noise: &mut Noise) -> Option<Self> {
        let target = StraightTarget::random(noise);
        let (mut seen, mut exact) = (Vec::new(), Vec::new());
        for period in 0..PERIODS {
            for (index, (camera, delay)) in cameras.iter().zip(layout.delays).enumerate() {
                let time_s = period as f64 + delay;
                let place = target.at(time_s);
                let bearing = bearing(camera, place, tangent_noise(Some(noise)))?;
                seen.push(TimedBearing { camera: index, period, time_s, bearing });
                exact.push(line(camera, place, tangent_noise(None), time_s)?);
            }
        }
        seen.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
        Some(Self { target, seen, exact })
    }

    /// The time of the last bearing.
    fn end(&self) -> Timestamp {
        self.exact.iter().map(|line| line.time).max().unwrap_or(Timestamp::EPOCH)
    }
}

/// An estimate at the time of the last bearing, compared with the truth.
struct EstimateError {
    /// Errors of position, m, and velocity, m/s.
    errors: [f64; 2],
    nees: f64,
    diverged: bool,
    /// Variances of the bound, m^2 and m^2/s^2.
    bound: [f64; 2],
}

impl EstimateError {
    fn of(flight: &LimitRun, state: &KinematicState) -> Option<Self> {
        let time = flight.end();
        let limit = bound(&flight.exact, &flight.target, time)?;
        let truth = flight.target.at(time.seconds());
        let (position, velocity) =
            (state.position() - truth, state.velocity() - flight.target.velocity);
        let error = Vector6::from_iterator(position.iter().chain(velocity.iter()).copied());
        let own_sd = state.position_covariance().trace().sqrt();
        let trace = |block: usize| limit.fixed_view::<3, 3>(block, block).trace();
        Some(Self {
            errors: [position.norm(), velocity.norm()],
            nees: error.dot(&(state.covariance.try_inverse()? * error)),
            diverged: position.norm() > DIVERGED_M || position.norm() > DIVERGED_SDS * own_sd,
            bound: [trace(0), trace(3)],
        })
    }
}

/// Result of the whole fusion, with its default configuration, for the messages of a flight: the
/// confirmed track of the last track frame, the nearest to the truth if there are several.
fn fused(flight: &LimitRun, cameras: &[(CameraName, Camera)]) -> Option<KinematicState> {
    let mut config = FusionConfig::default();
    config.initiation.velocity_prior_sd_mps = PRIOR_SD;
    let mut fusion = Fusion::new(config).ok()?;
    for (name, camera) in cameras {
        let exact = CameraCalibration::new(name, camera, Timestamp::EPOCH).with_pose_sd(0.0, 0.0);
        fusion.calibrate(&exact).ok()?;
    }
    let mut outputs = Vec::new();
    for seen in &flight.seen {
        outputs.extend(fusion.ingest(&frame(seen, &cameras.get(seen.camera)?.0)));
    }
    outputs.extend(fusion.flush());
    let last = outputs.into_iter().rev().find_map(|output| match output {
        Output::Tracks(frame) => Some(frame),
        _ => None,
    })?;
    (last.time_ns == flight.end().nanos()).then_some(())?;
    let truth = flight.target.at(flight.end().seconds());
    let states = confirmed_states(&last);
    states
        .into_iter()
        .min_by(|a, b| (a.position() - truth).norm().total_cmp(&(b.position() - truth).norm()))
}

fn frame(seen: &TimedBearing, camera: &CameraName) -> BearingFrame {
    let covariance = seen.bearing.covariance();
    let track = BearingTrack {
        track_id: 1,
        bearing: Some(seen.bearing.direction().into_inner().into()),
        covariance_xx: covariance.m11,
        covariance_xy: covariance.m12,
        covariance_yy: covariance.m22,
        state: ImageTrackState::Tracking.into(),
        ..Default::default()
    };
    BearingFrame {
        camera: camera.to_string(),
        sequence: seen.period as u64,
        capture_time_ns: Timestamp::from_seconds(seen.time_s).nanos(),
        clock_source: ClockSource::Simulated.into(),
        tracks: vec![track],
        ..Default::default()
    }
    .stamped()
}

/// The states of a frame's confirmed tracks.
fn confirmed_states(frame: &TrackFrame) -> Vec<KinematicState> {
    let sure = frame
        .tracks
        .iter()
        .filter(|t| matches!(t.state(), TrackState::Confirmed | TrackState::Coasting));
    sure.filter_map(|track| {
        let position: Point3<f64> = track.position?.into();
        let velocity: Vector3<f64> = track.velocity?.into();
        let mean = Vector6::from_iterator(position.iter().chain(velocity.iter()).copied());
        let covariance: [f64; 36] = track.covariance.as_slice().try_into().ok()?;
        Some(KinematicState { mean, covariance: Matrix6::from_row_slice(&covariance) })
    })
    .collect()
}

/// The outcomes of all runs; `None` where the estimator had no answer.
fn outcomes(
    options: ValidationOptions,
    layout: &PaperSite,
    estimate: impl Fn(&LimitRun, &[(CameraName, Camera)]) -> Option<KinematicState> + Sync,
) -> Vec<Option<EstimateError>> {
    let cameras = layout.cameras().unwrap_or_default();
    let names = ["first", "second", "third"].into_iter().filter_map(|name| name.parse().ok());
    let named: Vec<(CameraName, Camera)> = names.zip(cameras.iter().cloned()).collect();
    runs::all(options.runs, |index| {
        let flight = LimitRun::new(layout, &cameras, &mut Noise::new(options.seed, index))?;
        EstimateError::of(&flight, &estimate(&flight, &named)?)
    })
}

/// Rows of the tables that both estimators have.
#[derive(Default)]
struct Rows {
    ratios: Vec<TableRow>,
    errors: Vec<TableRow>,
    consistency: Vec<TableRow>,
}

impl Rows {
    fn add(&mut self, layout: &PaperSite, at: f64, outcomes: &[Option<EstimateError>]) {
        let known: Vec<&EstimateError> = outcomes.iter().flatten().collect();
        for (index, quantity) in ["position", "velocity"].into_iter().enumerate() {
            let errors: Vec<f64> = known.iter().map(|o| o.errors[index]).collect();
            let bounds: Vec<f64> = known.iter().map(|o| o.bound[index]).collect();
            // The root of the bound's mean trace over the runs.
            let best = mean(&bounds).value.sqrt();
            let rms = root_mean_square(&errors);
            let series = format!("{}: {quantity}", layout.name);
            self.errors.push(TableRow::new(&series, at, rms));
            let exact = SampleStatistic::exact(best);
            self.errors.push(TableRow::new(format!("{series}, bound"), at, exact));
            let over_bound = SampleStatistic {
                value: rms.value / best,
                standard_error: rms.standard_error / best,
            };
            let ratio = TableRow::new(series, at, over_bound);
            self.ratios.push(ratio.limit(Limit::AtMost(1.1)));
        }
        let nees: Vec<f64> = known.iter().map(|o| o.nees).collect();
        self.consistency.push(TableRow::new(layout.name, at, mean(&nees)).limit(HONEST));
    }
}

fn table(name: &'static str, title: &str, y: &'static str, rows: Vec<TableRow>) -> Table {
    Table { name, title: title.to_owned(), x: "layout", y, rows }
}

/// The two layouts in which the paper's own system of equations is regular: those of [`LAYOUTS`]
/// with its two pairs of delays.
const REGULAR: [PaperSite; 2] = [
    PaperSite::orthogonal("orthogonal, 0.1/0.2", [0.0, 0.1, 0.2]),
    PaperSite::orthogonal("orthogonal, 0.3/0.4", [0.0, 0.3, 0.4]),
];

/// The whole fusion, from messages to the last track frame, with its default configuration.
pub(super) fn fusion_tables(options: ValidationOptions) -> Vec<Table> {
    let (mut rows, mut shares) = (Rows::default(), Vec::new());
    for (number, layout) in REGULAR.iter().enumerate() {
        let at = (number + 1) as f64;
        let outcomes = outcomes(options, layout, fused);
        rows.add(layout, at, &outcomes);
        shares.push(confirmed(layout, at, &outcomes));
    }
    let Rows { ratios, errors, consistency } = rows;
    vec![
        table(
            "fusion-bound",
            "Whole fusion: RMS error over the bound of all periods",
            "ratio",
            ratios,
        ),
        table("fusion-error", "Whole fusion: RMS error and the bound", "m, m/s", errors),
        table("fusion-nees", "Whole fusion: mean NEES, 6 is honest", "NEES", consistency),
        table("fusion-confirmed", "Whole fusion: runs with a confirmed track", "share", shares),
    ]
}

/// The batch solution: all bearings at once.
fn batch(flight: &LimitRun, cameras: &[(CameraName, Camera)]) -> Option<KinematicState> {
    let lines = flight.seen.iter().map(|seen| {
        let line = cameras.get(seen.camera)?.1.sight_line(&seen.bearing);
        Some(TimedLine::exact(line, Timestamp::from_seconds(seen.time_s)))
    });
    let lines: Vec<TimedLine> = lines.collect::<Option<_>>()?;
    Some(map(&lines, flight.end(), PRIOR_SD)?.state)
}

/// Number of runs of a layout that diverged: none may.
fn diverged(layout: &PaperSite, at: f64, outcomes: &[Option<EstimateError>]) -> TableRow {
    let count = outcomes.iter().flatten().filter(|outcome| outcome.diverged).count();
    TableRow::new(layout.name, at, SampleStatistic::exact(count as f64)).limit(Limit::AtMost(0.0))
}

/// Share of a layout's runs in which the estimator had an answer: a fusion centre that does not
/// know how fast targets are may refuse a few in a thousand as too fast.
fn confirmed(layout: &PaperSite, at: f64, outcomes: &[Option<EstimateError>]) -> TableRow {
    TableRow::new(layout.name, at, share(outcomes.iter().map(Option::is_some)))
        .limit(Limit::AtLeast(0.99))
}

/// The whole fusion where one period does not determine position and velocity, compared with the
/// batch solution of the same bearings.
pub(super) fn degenerate_tables(options: ValidationOptions) -> Vec<Table> {
    let [mut ratios, mut consistency, mut divergences, mut shares] =
        [vec![], vec![], vec![], vec![]];
    for (number, layout) in LAYOUTS.iter().enumerate().skip(1) {
        let at = (number + 1) as f64;
        let (ours, best) = (outcomes(options, layout, fused), outcomes(options, layout, batch));
        let both: Vec<(&EstimateError, &EstimateError)> = ours
            .iter()
            .zip(&best)
            .filter_map(|(ours, best)| ours.as_ref().zip(best.as_ref()))
            .collect();
        for (index, quantity) in ["position", "velocity"].into_iter().enumerate() {
            let ours: Vec<f64> = both.iter().map(|(ours, _)| ours.errors[index].powi(2)).collect();
            let best: Vec<f64> = both.iter().map(|(_, best)| best.errors[index].powi(2)).collect();
            let row =
                TableRow::new(format!("{}: {quantity}", layout.name), at, root_ratio(&ours, &best));
            ratios.push(row.limit(Limit::AtMost(1.1)));
        }
        let nees: Vec<f64> = both.iter().map(|(ours, _)| ours.nees).collect();
        consistency.push(TableRow::new(layout.name, at, mean(&nees)).limit(HONEST));
        divergences.push(diverged(layout, at, &ours));
        shares.push(confirmed(layout, at, &ours));
    }
    vec![
        table("fusion-degenerate", "Whole fusion: RMS error over the batch MAP's", "ratio", ratios),
        table(
            "fusion-degenerate-nees",
            "Whole fusion: mean NEES, 6 is honest",
            "NEES",
            consistency,
        ),
        table(
            "fusion-degenerate-diverged",
            "Whole fusion: runs that diverged",
            "runs",
            divergences,
        ),
        table(
            "fusion-degenerate-confirmed",
            "Whole fusion: runs with a confirmed track",
            "share",
            shares,
        ),
    ]
}

/// All bearings at once, [`map`] with a prior on the velocity, in every layout.
pub(super) fn batch_tables(options: ValidationOptions) -> Vec<Table> {
    let (mut rows, mut divergences) = (Rows::default(), Vec::new());
    for (number, layout) in LAYOUTS.iter().enumerate() {
        let at = (number + 1) as f64;
        let outcomes = outcomes(options, layout, batch);
        rows.add(layout, at, &outcomes);
        divergences.push(diverged(layout, at, &outcomes));
    }
    let Rows { ratios, errors, consistency } = rows;
    vec![
        table("batch-bound", "Batch MAP: RMS error over the bound of all periods", "ratio", ratios),
        table("batch-error", "Batch MAP: RMS error and the bound", "m, m/s", errors),
        table("batch-nees", "Batch MAP: mean NEES, 6 is honest", "NEES", consistency),
        table("batch-diverged", "Batch MAP: runs that diverged", "runs", divergences),
    ]
}
