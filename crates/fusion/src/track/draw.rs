//! Draws: where the cameras see a target, compared with one another a few times a second.
//!
//! From these comparisons the errors of the poses are learnt (`cameras/pose_scale.rs`,
//! `cameras/watch.rs`). Two cameras of which each moves the track, or which see a target at
//! different times, differ by more than their poses do. So all of them are compared with a course
//! that no bearing moves, at one time.

use crossfix_filter::KinematicState;
use crossfix_geometry::BearingModel;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{Matrix2, Matrix2x3, Matrix2x6, Point3, Vector2, Vector3};

use super::TrackBearing;
use crate::cameras::ScaleSample;
use crate::uncertainty::CorrelatedNoise;

/// A draw lasts this long, s: long enough for some bearings of each camera, short enough to see a
/// mast sway. With half of it cameras of 5 Hz have one bearing per draw, or none.
pub(super) const DRAW_S: f64 = 0.3;

/// A course that began longer ago than this is no longer where the target may be, s: a track that
/// waits to be confirmed, or that one camera alone has seen, is not drawn. With half of it cameras
/// of half a hertz are not compared; with twice as much a turn of that time shows in the residuals.
pub(super) const LONGEST_COURSE_S: f64 = 2.5;

/// What the cameras have seen of a target.
#[derive(Clone, Debug, Default)]
pub(crate) struct Draw {
    /// The age of the track, s.
    pub(crate) age_s: f64,
    /// The residuals of the cameras that see the target.
    pub(crate) samples: Vec<ScaleSample>,
    /// Those of the cameras that for long have had something beside it in the same place: that may
    /// be the target.
    pub(crate) beside: Vec<ScaleSample>,
}

/// Where the target would be since the last draw if it flew straight on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Course {
    pub(super) since: Timestamp,
    position: Point3<f64>,
    velocity: Vector3<f64>,
    /// Standard deviation of the velocity when it began, m/s.
    pub(super) speed_sd: f64,
}

impl Course {
    /// From this state on.
    pub(super) fn of(state: &KinematicState, since: Timestamp) -> Self {
        let (position, velocity) = (state.position(), state.velocity());
        Self { since, position, velocity, speed_sd: speed_sd(state) }
    }

    /// By how much a bearing passes beside it.
    pub(super) fn residual(
        &self,
        TrackBearing { time, line, .. }: &TrackBearing<'_>,
    ) -> Option<Residual> {
        let after_s = time.seconds_since(self.since);
        let model = BearingModel::new(line.origin, self.position + self.velocity * after_s)?;
        Some(Residual { after_s, angles: model.residual(line)?, model })
    }
}

/// Standard deviation of the velocity, m/s: that of all axes together, more than along any one. How
/// a target turns while the track lags behind is in it.
pub(super) fn speed_sd(state: &KinematicState) -> f64 {
    state.covariance.diagonal().fixed_rows::<3>(3).sum().max(0.0).sqrt()
}

/// By how much a bearing passes beside a course.
pub(super) struct Residual {
    /// How long after the course began, s.
    after_s: f64,
    /// rad.
    angles: Vector2<f64>,
    model: BearingModel,
}

/// One camera's bearings since the last draw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Drawn {
    residuals: ResidualSums,
    by_position: Matrix2x3<f64>,
    /// Covariance of one bearing's noise, rad^2.
    noise: Matrix2<f64>,
    /// The part of the noise that lasts, and so is not averaged away.
    lasting: CorrelatedNoise,
    pose: Matrix2<f64>,
    by_pose: Matrix2x6<f64>,
    by_time: Vector2<f64>,
    /// Standard deviation of the clock, s.
    time_sd_s: f64,
}

impl Drawn {
    /// With one bearing more, of a target that flies at this velocity (m/s).
    pub(super) fn with(
        before: Option<Self>,
        residual @ Residual { model, .. }: &Residual,
        velocity: Vector3<f64>,
        TrackBearing { line, uncertainty, .. }: &TrackBearing<'_>,
    ) -> Self {
        let sums = before.map_or_else(ResidualSums::default, |drawn| drawn.residuals);
        Self {
            residuals: sums.with(residual.angles, residual.after_s),
            by_position: model.by_position(),
            noise: model.covariance_of(line) * uncertainty.factor,
            lasting: uncertainty.lasting,
            pose: uncertainty.declared_pose(model),
            by_pose: model.by_pose(),
            by_time: model.by_time(velocity),
            time_sd_s: uncertainty.time_sd_s,
        }
    }

    /// Mean residual of the bearings, each at its own time, rad.
    pub(super) fn mean(&self) -> Vector2<f64> {
        self.residuals.of_angles / self.residuals.count
    }

    /// The residual at a time since the course began (s), for a target whose velocity has a
    /// standard deviation of `speed`, m/s.
    pub(super) fn sample(self, camera: &CameraName, speed: f64, at_s: f64) -> ScaleSample {
        // Residuals drift by A v where the velocity differs by v.
        let drift = self.by_position * self.by_position.transpose() * speed.powi(2);
        let (residual, count) = self.residuals.at(at_s, drift.trace() / self.noise.trace());
        let white = self.noise / count;
        // The clock's effect is computed with the estimated velocity, and is as uncertain as that.
        let by_clock = drift * self.time_sd_s.powi(2);
        let lasting = Matrix2::identity() * self.lasting.as_white(DRAW_S);
        ScaleSample {
            camera: camera.clone(),
            residual,
            by_position: self.by_position,
            // The lasting part does not average out within a draw; for the watch, over many draws,
            // it does as slowly as white noise of `as_white`.
            noise: white + Matrix2::identity() * self.lasting.variance(),
            pose: self.pose,
            by_pose: self.by_pose,
            by_time: self.by_time,
            clock_sd_s: self.time_sd_s,
            slow_noise: white + lasting + by_clock,
            noise_lasts: self.lasting.sd_rad > 0.0,
        }
    }
}

/// Sums over residuals r (rad) and their times t (s).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct ResidualSums {
    count: f64,
    /// Of r, t, t^2 and r t.
    of_angles: Vector2<f64>,
    of_times: f64,
    of_squares: f64,
    of_products: Vector2<f64>,
}

impl ResidualSums {
    fn with(self, angles: Vector2<f64>, after_s: f64) -> Self {
        Self {
            count: self.count + 1.0,
            of_angles: self.of_angles + angles,
            of_times: self.of_times + after_s,
            of_squares: self.of_squares + after_s.powi(2),
            of_products: self.of_products + angles * after_s,
        }
    }

    /// The residual at a time T, if residuals drift at a rate of which nothing is known but its
    /// variance, `drift` times that of one residual's noise (1/s^2); and how many residuals of that
    /// very time would tell as much.
    fn at(&self, time_s: f64, drift: f64) -> (Vector2<f64>, f64) {
        // r(T) = 1'V^-1 r / 1'V^-1 1 with V = I + q u u' and u = t - T, so that
        // (1 + q u'u) V^-1 = (1 + q u'u) I - q u u'.
        let offsets = self.of_times - self.count * time_s;
        let squares = (self.of_squares - time_s * (self.of_times + offsets)).max(0.0);
        let products = self.of_products - self.of_angles * time_s;
        let whole = 1.0 + drift * squares;
        // 1'1 u'u - (1'u)^2 is not negative.
        let spread = (self.count * squares - offsets.powi(2)).max(0.0);
        let count = self.count + drift * spread;
        let residual = (self.of_angles * whole - products * (drift * offsets)) / count;
        (residual, count / whole)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sums(residuals: &[(f64, f64)]) -> ResidualSums {
        residuals.iter().fold(ResidualSums::default(), |sums, (time, angle)| {
            sums.with(Vector2::new(*angle, 0.0), *time)
        })
    }

    /// A residual of 2 + 10 t at the times 0.1 to 0.3, looked at at 0.1.
    #[test]
    fn a_drift_that_nobody_knows_is_taken_out_and_one_that_is_known_is_not() {
        let drifting = sums(&[(0.1, 3.0), (0.2, 4.0), (0.3, 5.0)]);
        let (mean, count) = drifting.at(0.1, 0.0);
        assert!((mean.x - 4.0).abs() < 1e-12 && (count - 3.0).abs() < 1e-12, "{mean} {count}");
        // The value of a straight line through three points at the first one has 5/6 of the
        // variance of one point.
        let (there, count) = drifting.at(0.1, 1e9);
        assert!((there.x - 3.0).abs() < 1e-5 && (count - 1.2).abs() < 1e-5, "{there} {count}");
    }

    /// By hand: a variance of s^2 + q s^2 u^2, which is five times s^2.
    #[test]
    fn one_residual_of_another_time_tells_less() {
        let (residual, count) = sums(&[(0.3, 7.0)]).at(0.1, 100.0);
        assert!((residual.x - 7.0).abs() < 1e-12 && (count - 0.2).abs() < 1e-12, "{count}");
    }
}
