//! Whether lines of several cameras are one target's, or each camera sees another.

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{Matrix2, Unit, Vector3};

use crate::prediction::{BearingPrediction, log_density};
use crate::spatial::TYPICAL_SPEED;
use crate::watch::independent_share;

/// Logarithm of the probability that a camera is blind for a target that it should see.
const BLIND: f64 = -4.6;
/// A camera's bearings that are shifted by so many times their own variance agree with nothing.
const VAGUE: f64 = 10.0;

/// A line as one camera alone goes on with it: a direction that turns evenly.
#[derive(Clone, Debug)]
struct Sight {
    direction: Unit<Vector3<f64>>,
    /// How fast the direction turns, rad/s.
    rate: Vector3<f64>,
    /// Variances of the direction (rad^2) and its rate (rad^2/s^2) along each tangent, and their
    /// covariance.
    variance: f64,
    rate_variance: f64,
    tie: f64,
    time: Timestamp,
    /// What pose and clock shift all bearings of the camera by, as far as is known (rad, world), and
    /// its variance along each tangent once the first prediction has told it.
    shift: Vector3<f64>,
    shift_variance: Option<f64>,
}

impl Sight {
    /// A first line, of a target that may move across it at `rate_sd` (rad/s).
    fn first(line: &SightLine, time: Timestamp, rate_sd: f64) -> Self {
        Self {
            direction: line.direction,
            rate: Vector3::zeros(),
            variance: line.covariance.trace() / 2.0,
            rate_variance: rate_sd.powi(2),
            tie: 0.0,
            time,
            shift: Vector3::zeros(),
            shift_variance: None,
        }
    }

    /// Where the line is expected at a time; `density` is that of the white acceleration that drives
    /// it, rad^2/s^3.
    fn predict(&mut self, time: Timestamp, density: f64) {
        let dt = time.seconds_since(self.time);
        self.direction = Unit::new_normalize(self.direction.into_inner() + self.rate * dt);
        // A clock's correction may take it back in time: that makes it no surer.
        let noise = density * dt.abs();
        self.variance += dt * (2.0 * self.tie + dt * self.rate_variance) + noise * dt * dt / 3.0;
        self.tie += dt * self.rate_variance + noise * dt / 2.0;
        self.rate_variance += noise;
        self.time = time;
    }

    /// How much likelier (logarithm) a line is where the target of all cameras is predicted than where
    /// this camera alone expects it; learns the camera's shift.
    fn log_ratio(&mut self, line: &SightLine, prediction: &BearingPrediction) -> Option<f64> {
        let to_tangents = prediction.basis().transpose();
        let noise = prediction.noise_of(line);
        let seen = to_tangents * line.direction.into_inner();
        let own = noise + Matrix2::identity() * self.variance;
        let alone = log_density(&own, seen - to_tangents * self.direction.into_inner())?;
        let (spread, common) = prediction.spreads();
        let variance = *self.shift_variance.get_or_insert(common.trace() / 2.0);
        let spread = spread + noise + Matrix2::identity() * variance;
        let off = seen - to_tangents * self.shift;
        let together = log_density(&spread, off)?;
        let gain = variance / (spread.trace() / 2.0);
        self.shift += prediction.basis() * off * gain;
        self.shift_variance = Some(variance * (1.0 - gain));
        Some(together - alone)
    }

    fn update(&mut self, line: &SightLine) {
        let spread = self.variance + line.covariance.trace() / 2.0;
        let off = line.direction.into_inner() - self.direction.into_inner();
        let (gain, rate_gain) = (self.variance / spread, self.tie / spread);
        self.direction = Unit::new_normalize(self.direction.into_inner() + off * gain);
        self.rate += off * rate_gain;
        self.rate_variance -= rate_gain * self.tie;
        self.tie -= gain * self.tie;
        self.variance -= gain * self.variance;
    }
}

/// How much likelier it is that lines are one target's than that every camera sees a target of its
/// own, which no other camera sees.
///
/// Against clutter any line that goes on smoothly is a target's. But where there are many targets
/// that one camera each sees, their lines cross, and only how well these agree with one place and
/// velocity tells: one target has six numbers, two lines have four each.
#[derive(Clone, Debug)]
pub(super) struct Coincidence {
    sights: Vec<(CameraName, Sight)>,
    /// Cameras that should see the target and never have, with the logarithm of that probability.
    silent: Vec<(CameraName, f64)>,
    log_ratio: f64,
    /// Whether poses or clocks are so uncertain that it says nothing.
    vague: bool,
}

impl Coincidence {
    /// Of the lines of a beginning, with its log-likelihood ratio; the target may be as fast as
    /// `speed` (m/s, standard deviation) at a place.
    pub(super) fn begin<'a>(
        lines: impl Iterator<Item = (&'a CameraName, &'a SightLine, Timestamp)>,
        (place, speed): (nalgebra::Point3<f64>, f64),
        log_ratio: f64,
    ) -> Self {
        let sight = |(camera, line, time): (&CameraName, &SightLine, Timestamp)| {
            let range = (place - line.origin).norm();
            (camera.clone(), Sight::first(line, time, speed / range))
        };
        Self { sights: lines.map(sight).collect(), silent: Vec::new(), log_ratio, vague: false }
    }

    /// A line that goes on with the target as predicted. `first_ratio` is its log-likelihood ratio
    /// where it is its camera's first.
    pub(super) fn see(
        &mut self,
        camera: &CameraName,
        (line, time, time_sd_s): (&SightLine, Timestamp, f64),
        prediction: &BearingPrediction,
        (density, speed): (f64, f64),
        first_ratio: f64,
    ) {
        let range = prediction.range();
        let Some((_, sight)) = self.sights.iter_mut().find(|(name, _)| name == camera) else {
            self.log_ratio += first_ratio;
            self.sights.push((camera.clone(), Sight::first(line, time, speed / range)));
            return;
        };
        sight.predict(time, density / range.powi(2));
        self.log_ratio += sight.log_ratio(line, prediction).unwrap_or(0.0);
        // What an unsure clock shifts a bearing by is not known before the velocity is.
        let clock = (speed * TYPICAL_SPEED * time_sd_s / range).powi(2);
        let shift = sight.shift_variance.map_or(clock, |variance| variance.max(clock));
        self.vague |= shift > VAGUE * line.covariance.trace() / 2.0;
        sight.update(line);
    }

    /// A camera that should have seen the target has not, `interval_s` after its exposure before.
    pub(super) fn miss(&mut self, camera: &CameraName, log_miss: f64, interval_s: f64) {
        if self.sights.iter().any(|(name, _)| name == camera) {
            return;
        }
        let more = log_miss * independent_share(interval_s);
        match self.silent.iter_mut().find(|(name, _)| name == camera) {
            Some((_, log)) => *log = (*log + more).max(BLIND),
            None => self.silent.push((camera.clone(), more.max(BLIND))),
        }
    }

    /// The log-likelihood ratio; `None` if poses or clocks are too uncertain for it.
    pub(super) fn log_ratio(&self) -> Option<f64> {
        if self.vague {
            return None;
        }
        let never = |camera: &CameraName| self.sights.iter().all(|(name, _)| name != camera);
        let silent = self.silent.iter().filter(|(camera, _)| never(camera));
        Some(self.log_ratio + silent.map(|(_, log)| log).sum::<f64>())
    }
}
