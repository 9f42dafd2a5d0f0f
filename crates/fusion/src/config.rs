//! The configuration of the fusion centre: what a site may set, with its defaults. The ranges are
//! in `ranges.rs`.

use crossfix_message::CameraName;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// How the fusion centre works. Every field has a default; the file's keys are the fields' names.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FusionConfig {
    /// Putting frames into the order of their capture times.
    pub event_time: EventTime,
    /// What a bearing's reported covariance is worth.
    pub bearings: Bearings,
    /// How new tracks are found.
    pub initiation: Initiation,
    /// How tracks are kept up.
    pub tracking: Tracking,
    /// How the cameras' clocks are estimated.
    pub clocks: Clocks,
}

impl FusionConfig {
    /// The configuration with this [`Tracking::smoothing_s`], if one is given.
    #[must_use]
    pub fn smoothed(mut self, smoothing_s: Option<f64>) -> Self {
        self.tracking.smoothing_s = smoothing_s.unwrap_or(self.tracking.smoothing_s);
        self
    }
}

/// How the cameras' clocks are estimated from the tracks. The initial standard deviation of a
/// clock's offset is that which its frames report of their capture time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Clocks {
    /// Whether they are estimated. Default true.
    pub estimate: bool,
    /// Cameras whose clock is right by definition. Default none.
    pub trusted: Vec<CameraName>,
    /// Clocks reported to be better than this are used as reported, s. 1e-9 to 10. Default
    /// 0.001.
    pub least_sd_s: f64,
    /// Standard deviation of a clock's drift, s/s. 1e-12 to 0.1. Default 0.00003: quartzes are
    /// within 50 ppm.
    pub drift_sd: f64,
}

impl Default for Clocks {
    fn default() -> Self {
        Self { estimate: true, trusted: Vec::new(), least_sd_s: 1e-3, drift_sd: 3e-5 }
    }
}

/// Putting frames into the order of their capture times.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EventTime {
    /// How long to wait for a camera that is behind the others, s of capture time; and for a frame
    /// that a newer one of its camera has overtaken, where that has happened within the last 20
    /// times this. 0.001 to 60. Default 0.5: longer than any network hiccup that a track would not
    /// survive anyway.
    pub lateness_s: f64,
    /// A frame this far ahead of the cameras' common time (the second newest, and what half of them
    /// have reached) is from the future and refused, s. 0.001 to 3600. Default 10.
    pub max_ahead_s: f64,
}

impl Default for EventTime {
    fn default() -> Self {
        Self { lateness_s: 0.5, max_ahead_s: 10.0 }
    }
}

/// Which covariance a bearing is weighted by.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Weighting {
    /// Each bearing's own covariance.
    #[default]
    Reported,
    /// The same standard deviation for every bearing, as in the papers.
    Equal,
}

/// What a bearing's reported covariance is worth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Bearings {
    /// `reported` (default) or `equal`.
    pub weighting: Weighting,
    /// The standard deviation with `equal`, rad per axis. 1e-9 to 0.1. Default 0.001, a pixel of a
    /// 1000-pixel lens.
    pub equal_sd_rad: f64,
    /// What pose and lens leave unmodelled: added in square to each reported standard deviation,
    /// rad per axis. 0 to 0.1. Default 0: calibrations are used as reported.
    pub systematic_sd_rad: f64,
}

impl Default for Bearings {
    fn default() -> Self {
        Self { weighting: Weighting::default(), equal_sd_rad: 1e-3, systematic_sd_rad: 0.0 }
    }
}

/// What turns the bearings of one period into fixes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SpatialSolver {
    /// Two receivers, ranges only (Klochko 2020, the alternative algorithm).
    Pair,
    /// Three receivers, ranges and velocity (Klochko 2020, the proposed algorithm).
    Triple,
    /// n receivers, ranges and velocity by unweighted least squares.
    Stacked,
    /// n receivers, weighted, with a prior on the velocity.
    #[default]
    Map,
}

/// How the bearings of several periods become a track.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InitiationMethod {
    /// Every way in which bearings may belong together is followed as a hypothesis over several
    /// periods, by likelihood; the best set of hypotheses without common bearings is confirmed.
    #[default]
    Hypotheses,
    /// Each period is solved for fixes, and fixes are grouped by their residuals (Klochko 2020).
    Grouping,
}

/// How new tracks are found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Initiation {
    /// `hypotheses` (default) or `grouping`.
    pub method: InitiationMethod,
    /// New targets that a period is expected to bring, 1/m^3, for `hypotheses`. 1e-30 to 1. Default
    /// 1e-9: one in a cubic kilometre.
    pub birth_density_per_m3: f64,
    /// `map` (default), `stacked`, `triple` or `pair`, for `grouping`.
    pub solver: SpatialSolver,
    /// The shortest observation period, s; a period lasts until every camera that is heard has
    /// given an exposure, and these lie closest together. 0.0001 to 60. Default 0.05.
    pub period_s: f64,
    /// How many periods a group of fixes may span. 2 to 20, default 4; the papers have 5.
    pub periods: usize,
    /// Fixes that a group needs to start a track. 1 to `periods`, default 2.
    pub fixes: usize,
    /// How long the bearings of two cameras must agree to start a track that no third camera sees,
    /// s, for `hypotheses`; looks of a camera that misses a young target within it count as one.
    /// 0.001 to 3600. Default 0.3.
    pub pair_s: f64,
    /// Standard deviation of the velocity's prior, m/s per axis. 0.001 to 10000. Default 50.
    pub velocity_prior_sd_mps: f64,
    /// Fixes farther than this from a camera are ghosts, m. 0.01 to 1000000. Default 20000.
    pub max_range_m: f64,
    /// Probability with which a true combination passes the gates of `hypotheses` and of `map`.
    /// Default 0.999.
    pub spatial_gate_probability: f64,
    /// The spatial gate of `pair`, `J <= beta`, m^2 (Klochko 2020, below equation 9). 1e-9 to 1e9.
    /// Default 16.
    pub pair_gate_m2: f64,
    /// The temporal gate of the papers, m. 1e-6 to 1000000. Absent (default): the gate follows from
    /// the covariances.
    pub temporal_gate_m: Option<f64>,
    /// How many sight lines two groups may share and both start a track. 0 to 64. Default 0.
    pub shared_lines: usize,
}

impl Default for Initiation {
    fn default() -> Self {
        Self {
            method: InitiationMethod::default(),
            birth_density_per_m3: 1e-9,
            solver: SpatialSolver::default(),
            period_s: 0.05,
            periods: 4,
            fixes: 2,
            pair_s: 0.3,
            velocity_prior_sd_mps: 50.0,
            max_range_m: 20_000.0,
            spatial_gate_probability: 0.999,
            pair_gate_m2: 16.0,
            temporal_gate_m: None,
            shared_lines: 0,
        }
    }
}

/// How a track stays with a target that turns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Manoeuvres {
    /// Interacting multiple models, `models`.
    #[default]
    Models,
    /// One model, `acceleration_density`, re-initialised when the smoothed residual is too large
    /// (Kalinov 2019).
    SmoothedResidual,
    /// The same when the normalised innovation squared is too large.
    Innovation,
    /// One model, `acceleration_density`.
    None,
}

/// One motion model: a way of flying.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlightModel {
    /// Power spectral density of the white acceleration, m^2/s^3: its root is the change of
    /// velocity in a second, m/s. 0 to 1000000.
    pub acceleration_density: f64,
    /// Share of the time for which targets fly like this.
    pub share: f64,
    /// Whether targets fly like this for long. The rate at which a target leaves its calm is learnt
    /// for each target. Default false.
    #[serde(default)]
    pub calm: bool,
}

/// How tracks are kept up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Tracking {
    /// `models` (default), `smoothed-residual`, `innovation` or `none`.
    pub manoeuvres: Manoeuvres,
    /// The ways of flying of `models`, one to four. Default: straight (1e-6, calm, 0.98 of the
    /// time), drifting (0.3, 0.012), manoeuvring (5, 0.007) and hard turns (60, 0.001).
    pub models: Vec<FlightModel>,
    /// How often a target that is not calm changes its way of flying, 1/s. 1e-9 to 100. Default
    /// 0.3.
    pub switching_rate_per_s: f64,
    /// How often a target that is not calm comes to its calm, 1/s. 1e-9 to 100. Default 0.02; with
    /// the default shares targets leave it every forty minutes in the mean.
    pub calming_rate_per_s: f64,
    /// Weight of the prior rate at which a target leaves its calm, in seconds of the target's own
    /// flight. 0.001 to 1000000. Default 20: a target that has turned once is expected to turn
    /// again within so many seconds. With half of it the track of a target that flies straight
    /// after one turn is noisier than it need be.
    pub restlessness_prior_s: f64,
    /// Power spectral density of the white acceleration where there is one model, m^2/s^3. 1e-12 to
    /// 1000000. Default 3, for UAVs that turn and stop (1.7 m/s of change in a second); 0.02 for
    /// what flies straight.
    pub acceleration_density: f64,
    /// Number of residuals that `smoothed-residual` averages. 1 to 1000. Default 8.
    pub residual_window: usize,
    /// Its threshold in standard deviations of a bearing. 0.001 to 1000. Default 0.81, as in
    /// Kalinov 2019.
    pub residual_scale: f64,
    /// Number of innovations that `innovation` sums. 1 to 1000. Default 2.
    pub innovation_window: usize,
    /// Probability of its false alarm. Default 0.0001.
    pub innovation_false_alarm: f64,
    /// Probability with which a true bearing passes a track's gate. Default 0.999999: a target that
    /// begins to turn must still be inside the gate when the likelihoods have noticed.
    pub gate_probability: f64,
    /// Probability that a camera reports a target in its field of view. Default 0.9.
    pub detection_probability: f64,
    /// Density of false bearings, 1/sr. 1e-9 to 1000000. Default 5.
    pub clutter_per_sr: f64,
    /// Log-likelihood ratio (target against clutter) that confirms a track. 0.001 to 40: no score
    /// is larger. Default 25.
    pub confirm_score: f64,
    /// A confirmed track not updated for this long is coasting, and a camera that has not seen a
    /// target for this long no longer counts as holding (supporting) its track, s. 0.001 to 3600.
    /// Default 1.5.
    pub coasting_after_s: f64,
    /// A track not updated for this long is lost, s. 0.001 to 3600. Default 4.
    pub lost_after_s: f64,
    /// A track whose position has a larger standard deviation than this along any axis is lost, m.
    /// 0.001 to 100000. Default 20.
    pub max_position_sd_m: f64,
    /// How long a track's state waits to be smoothed by later bearings, s: it goes out at once, and
    /// again when these are in (`replay --fuse` writes only the smoothed ones). 0 to 2. Default 0:
    /// no smoothing. Half a second halves the error of the velocity, more tells little more; the
    /// cost of each bearing grows with it.
    pub smoothing_s: f64,
}

impl Default for Tracking {
    fn default() -> Self {
        let model =
            |acceleration_density, share, calm| FlightModel { acceleration_density, share, calm };
        Self {
            manoeuvres: Manoeuvres::default(),
            models: vec![
                model(1e-6, 0.98, true),
                model(0.3, 0.012, false),
                model(5.0, 0.007, false),
                model(60.0, 0.001, false),
            ],
            switching_rate_per_s: 0.3,
            calming_rate_per_s: 0.02,
            restlessness_prior_s: 20.0,
            acceleration_density: 3.0,
            residual_window: 8,
            residual_scale: 0.81,
            innovation_window: 2,
            innovation_false_alarm: 1e-4,
            gate_probability: 0.999_999,
            detection_probability: 0.9,
            clutter_per_sr: 5.0,
            confirm_score: 25.0,
            coasting_after_s: 1.5,
            lost_after_s: 4.0,
            max_position_sd_m: 20.0,
            smoothing_s: 0.0,
        }
    }
}

/// A number of the configuration that makes no sense.
#[derive(Clone, Debug, PartialEq, Error)]
#[error("`{key}` is {}: it must be {must}", crate::ranges::plain(*value))]
pub struct FusionConfigError {
    /// The key, with its section.
    pub key: &'static str,
    /// What it is.
    pub value: f64,
    /// What it must be.
    pub must: String,
}
