//! Results of an adjusted flight, with their uncertainty.

use crossfix_geometry::{Camera, Intrinsics, Pose};
use crossfix_message::{CameraName, Datum};
use nalgebra::{DMatrix, Matrix6};

use super::adjustment::AdjustedFlight;
use super::clicked::LandmarkMisfit;
use super::datum::Followers;
use super::error::Refusal;
use super::fitted::{self, FittedLabel, FittedSample};
use super::gauge::Gauge;
use super::halves::HalvesRatios;
use super::model::{CLOCK, FlightLog, POSE_AND_CLOCK};
use super::moved::{self, MovedAt};
use super::state::{CameraPriors, Flight, FlightState, Priors, square};
use crate::calibrated_camera::{CalibratedCamera, ClockCorrection};
use crate::label_noise::LabelNoise;
use crate::lens::{self, LensUncertainty};
use crate::site_file::SiteCalibration;

/// Result of one camera.
#[derive(Clone, Debug)]
pub struct CameraResult {
    /// Whose it is.
    pub name: CameraName,
    /// Lens and pose.
    pub camera: Camera,
    /// Covariance of the pose with the lens fixed at its estimate: rotation about the camera's axes
    /// (rad), then position (m).
    pub pose_covariance: Matrix6<f64>,
    /// Remaining uncertainty of the lens.
    pub lens: LensUncertainty,
    /// Its clock.
    pub clock: ClockResult,
    /// Error of its labels.
    pub noise: LabelNoise,
    /// Time between its frames, s.
    pub frame_s: f64,
    /// Median range at which it saw the target, m.
    pub range_m: f64,
    /// Number of labels, including those of other things.
    pub labels: usize,
    /// Number of labels within four deviations.
    pub used: usize,
    /// Root mean square of the residuals of the labels within four deviations, pixels per axis.
    pub residual_px: f64,
    /// Distance between the results of the flight's two halves in the image, as a multiple of what
    /// both state: above one, the deviations of pose and lens here are enlarged by it. Both halves
    /// know the same lens file and survey, so what is wrong with those does not show. `None`: one
    /// half saw too little.
    pub halves_ratio: Option<f64>,
    /// The moment at which its mean residual changes most.
    pub moved: Option<MovedAt>,
    /// Its labels where the target's trajectory reaches them, in order of its own time.
    pub fitted: Vec<FittedLabel>,
    /// The focal length relative to the lens file's.
    pub focal_ratio: f64,
    /// Standard deviation of that.
    pub focal_ratio_sd: f64,
}

/// Result of a clock.
#[derive(Clone, Debug)]
pub struct ClockResult {
    /// Knots, evenly spread over the labels' times.
    pub knots: Vec<ClockKnot>,
    /// Rate error: how much more than a second passes in one of its own.
    pub rate: f64,
    /// Standard deviation of that.
    pub rate_sd: f64,
    /// Power of its random walk, s^2/s.
    pub wander: f64,
    /// Time between the first row's read-out and the last's, s.
    pub readout_s: f64,
    /// Standard deviation of that.
    pub readout_sd_s: f64,
}

/// Correction of a clock at one of its times.
#[derive(Clone, Copy, Debug)]
pub struct ClockKnot {
    /// Its own time, s.
    pub time_s: f64,
    /// The common time less its own, s.
    pub ahead_s: f64,
    /// Standard deviation of that.
    pub sd_s: f64,
}

/// Result of a flight.
#[derive(Clone, Debug)]
pub struct FlightResult {
    /// Each camera that could be calibrated, in the order that they were given in.
    pub cameras: Vec<CameraResult>,
    /// What the cameras may be off by together; their own covariances do not contain it. `None` for
    /// a single camera, whose covariance has everything.
    pub datum: Option<Datum>,
    /// The other cameras, and why they were refused.
    pub refused: Vec<(CameraName, Refusal)>,
    /// Power of the target's jerk, m^2/s^5.
    pub jerk: f64,
    /// How the log fits; `None` without one.
    pub log: Option<LogFit>,
    /// The log's samples at times of the trajectory; none without a log.
    pub samples: Vec<FittedSample>,
    /// How each landmark fits, in each camera's picture.
    pub landmarks: Vec<LandmarkMisfit>,
}

/// How a log fits the adjusted trajectory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LogFit {
    /// Number of its samples at times of the trajectory.
    pub samples: usize,
    /// Those of them so far from the trajectory that they count next to nothing.
    pub left_out: usize,
    /// Root mean square of the others' residuals per axis, m.
    pub residual_m: f64,
    /// Stated standard deviation of each sample, m per axis.
    pub stated_sd_m: f64,
}

pub(super) fn results(
    flight: &Flight<'_>,
    mut adjusted: AdjustedFlight,
    priors: &Priors,
) -> Option<FlightResult> {
    let ratios = HalvesRatios::of(flight, priors, &adjusted);
    let followers = Followers::of(&adjusted.state);
    let shown = followers.estimator(adjusted.covariance.information())?;
    // What no measurement said of the site as a whole: the linearised jerk, and without a log the
    // gauge.
    let mut prior_information = adjusted.state.of_linear_jerk(priors);
    if flight.log.is_none() {
        prior_information += Gauge::information();
    }
    let datum = followers.datum(&shown, &prior_information, flight.log.is_none());
    // A single camera has no datum: all that it is off by is its own.
    let datum = (flight.cameras.len() > 1).then_some(datum);
    if datum.is_some() {
        // P - H D H': what a camera is off by beside the site as a whole.
        adjusted.covariance.take_off(shown.of_cameras());
    }
    let state = &adjusted.state;
    let cameras = (0..state.cameras.len())
        .map(|index| camera_result(flight, &adjusted, &priors.cameras[index], &ratios, index))
        .collect::<Option<_>>()?;
    let samples = flight.log.map_or_else(Vec::new, |log| fitted::samples(log, state));
    Some(FlightResult {
        cameras,
        datum,
        refused: Vec::new(),
        jerk: priors.jerk,
        log: flight.log.map(|log| log_fit(log, &samples)),
        samples,
        landmarks: state.landmark_misfits(flight),
    })
}

/// `None` if what was found is no camera, or its covariance is none.
fn camera_result(
    flight: &Flight<'_>,
    adjusted: &AdjustedFlight,
    prior: &CameraPriors,
    ratios: &HalvesRatios,
    index: usize,
) -> Option<CameraResult> {
    let state = &adjusted.state;
    let camera = &state.cameras[index];
    let start = state.starts()[index] - state.order().chain();
    let at = CameraBlock { covariance: adjusted.covariance.others(), start };
    let fitted = fitted::labels(flight, state, index);
    let within = |label: &&FittedLabel| label.beside_px.norm() < 4.0 * prior.noise.sd_px();
    let used = fitted.iter().filter(within);
    let squares: Vec<f64> = used.map(|label| square(label.beside_px)).collect();
    let factor = ratios.variance_factor(index);
    let pose = Pose::new(*camera.rotation.matrix(), camera.centre).ok()?;
    Some(CameraResult {
        name: flight.cameras[index].name.clone(),
        camera: Camera::new(camera.intrinsics, pose).ok()?,
        pose_covariance: at.pose_given_lens(lens::numbers(&camera.intrinsics))? * factor,
        // A factor on both covariances: the regression of pose on lens stays.
        lens: at.lens(lens::numbers(&camera.intrinsics), factor)?,
        clock: clock_result(flight, adjusted, index, prior.wander),
        noise: prior.noise,
        frame_s: prior.frame_s,
        range_m: middle_range(flight, state, index),
        labels: flight.cameras[index].labels.len(),
        used: squares.len(),
        residual_px: (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt(),
        halves_ratio: ratios.of_cameras[index],
        moved: moved::likeliest(&fitted),
        fitted,
        focal_ratio: camera.intrinsics.fx / prior.lens.fx,
        // The first lens number is ln fx: its deviation is that of the ratio.
        focal_ratio_sd: at.covariance_of(POSE_AND_CLOCK, POSE_AND_CLOCK).sqrt(),
    })
}

/// The median range at which a camera saw the target, m.
fn middle_range(flight: &Flight<'_>, state: &FlightState, index: usize) -> f64 {
    let camera = &state.cameras[index];
    let labels = flight.cameras[index].labels.iter();
    let places = labels.filter_map(|label| state.way.place_at(camera.time_s(label)));
    let mut ranges: Vec<f64> = places.map(|place| (place - camera.centre).norm()).collect();
    ranges.sort_unstable_by(f64::total_cmp);
    ranges.get(ranges.len() / 2).copied().unwrap_or(1.0)
}

/// Samples farther from the trajectory than this many deviations are left out: of normal ones one
/// in 2000 is. With half of it one in five would be.
const LEFT_OUT: f64 = 4.2;

fn log_fit(log: &FlightLog, samples: &[FittedSample]) -> LogFit {
    let mut squares: Vec<f64> =
        samples.iter().map(|sample| sample.residual().norm_squared() / 3.0).collect();
    squares.sort_unstable_by(f64::total_cmp);
    // The median of the mean of three squares is 0.789 of their variance.
    let typical = squares.get(squares.len() / 2).copied().unwrap_or_default() / 0.789;
    let most = (LEFT_OUT.powi(2) / 3.0) * typical.max(log.errors.sd_m.powi(2));
    let used = squares.partition_point(|square| *square <= most);
    LogFit {
        samples: squares.len(),
        left_out: squares.len() - used,
        residual_m: (squares[..used].iter().sum::<f64>() / used.max(1) as f64).sqrt(),
        stated_sd_m: log.errors.sd_m,
    }
}

/// One camera's part of the covariance of all unknowns outside the chain.
struct CameraBlock<'a> {
    covariance: &'a DMatrix<f64>,
    start: usize,
}

impl CameraBlock<'_> {
    fn covariance_of(&self, a: usize, b: usize) -> f64 {
        self.covariance[(self.start + a, self.start + b)]
    }

    fn part(&self, rows: usize, n: usize, columns: usize, m: usize) -> DMatrix<f64> {
        DMatrix::from_fn(n, m, |i, j| self.covariance_of(rows + i, columns + j))
    }

    /// Covariance of the lens, and the pose's regression on it.
    fn lens(&self, lens: usize, ratio: f64) -> Option<LensUncertainty> {
        let tied = self.part(0, 6, POSE_AND_CLOCK, lens);
        let covariance = self.part(POSE_AND_CLOCK, lens, POSE_AND_CLOCK, lens);
        // pose_by_lens = C(pose, lens) C(lens)^-1
        let pose_by_lens = covariance.clone().cholesky()?.solve(&tied.transpose()).transpose();
        Some(LensUncertainty { covariance: covariance * ratio, pose_by_lens })
    }

    /// The pose's covariance with the lens fixed at its estimate: what pose and lens may both be
    /// off by without a difference in the image is no error of a bearing.
    fn pose_given_lens(&self, lens: usize) -> Option<Matrix6<f64>> {
        let pose = self.part(0, 6, 0, 6);
        let tied = self.part(0, 6, POSE_AND_CLOCK, lens);
        let of_lens = self.part(POSE_AND_CLOCK, lens, POSE_AND_CLOCK, lens);
        // C(pose) - C(pose, lens) C(lens)^-1 C(lens, pose)
        let given_lens = pose - &tied * of_lens.cholesky()?.solve(&tied.transpose());
        let given_lens = (&given_lens + given_lens.transpose()) * 0.5;
        Some(Matrix6::from_column_slice(given_lens.as_slice()))
    }
}

/// Spacing of the stated clock corrections, s: between them a clock that wanders by 5 ms in a
/// second is 5 ms off, which its stated wander covers. With twice as much it is 8 ms off.
const CLOCK_STEP_S: f64 = 5.0;

fn clock_result(
    flight: &Flight<'_>,
    adjusted: &AdjustedFlight,
    index: usize,
    wander: f64,
) -> ClockResult {
    let state = &adjusted.state;
    let start = state.starts()[index];
    let clock = &state.cameras[index].clock;
    let labels = &flight.cameras[index].labels;
    let times = labels.first().zip(labels.last());
    let (from, to) = times.map_or((0.0, 0.0), |(first, last)| (first.time_s, last.time_s));
    let steps = ((to - from) / CLOCK_STEP_S).ceil().max(1.0);
    let knot = |k: usize| clock_knot(adjusted, index, from + (to - from) * k as f64 / steps);
    let variance = |unknown: usize| adjusted.covariance.variance(&[(start + unknown, 1.0)]);
    // Rounding may leave a variance of next to nothing negative.
    let sd = |unknown: usize| variance(unknown).max(0.0).sqrt();
    ClockResult {
        knots: (0..=steps as usize).map(knot).collect(),
        rate: clock.rate,
        rate_sd: sd(CLOCK + 1),
        wander,
        readout_s: clock.readout_s,
        readout_sd_s: sd(CLOCK + 2),
    }
}

fn clock_knot(adjusted: &AdjustedFlight, index: usize, time_s: f64) -> ClockKnot {
    let state = &adjusted.state;
    let (order, start) = (state.order(), state.starts()[index]);
    let clock = &state.cameras[index].clock;
    // The common time depends on two knots of the wander, on the offset, and on the rate.
    let of_wander = clock.wander.weights(clock.straight_s(time_s));
    let [first, second] = of_wander.map(|(k, weight)| (order.wander(k, index), weight));
    let rate = (start + CLOCK + 1, time_s - clock.reference_s);
    let terms = [first, second, (start + CLOCK, 1.0), rate];
    let sd_s = adjusted.covariance.variance(&terms).max(0.0).sqrt();
    ClockKnot { time_s, ahead_s: clock.common_s(time_s) - time_s, sd_s }
}

impl CameraResult {
    /// The lens as estimated.
    pub fn intrinsics(&self) -> &Intrinsics {
        self.camera.model().intrinsics()
    }
}

impl From<&FlightResult> for SiteCalibration {
    fn from(result: &FlightResult) -> Self {
        let cameras = result.cameras.iter().map(CalibratedCamera::from).collect();
        Self::with_datum(cameras, result.datum.clone())
    }
}

impl From<&CameraResult> for CalibratedCamera {
    fn from(result: &CameraResult) -> Self {
        let clock = &result.clock;
        let knots_s =
            clock.knots.iter().map(|knot| [knot.time_s, knot.ahead_s, knot.sd_s]).collect();
        Self {
            name: result.name.clone(),
            camera: result.camera.clone(),
            pose_covariance: result.pose_covariance,
            lens: result.lens.clone(),
            range_m: result.range_m,
            clock: ClockCorrection {
                knots_s,
                rate: clock.rate,
                rate_sd: clock.rate_sd,
                wander_s: clock.wander.sqrt(),
                readout_s: clock.readout_s,
            },
            noise: result.noise,
            frame_s: result.frame_s,
        }
    }
}
