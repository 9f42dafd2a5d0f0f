//! A target as all cameras see it, with the errors that each camera's lines share.

use crossfix_filter::KinematicState;
use crossfix_geometry::BearingModel;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{DMatrix, DVector, Dyn, Matrix2, Matrix3, OMatrix, U2};

use crate::prediction::log_density;
use crate::track::{FusedTrack, TrackBearing};
use crate::uncertainty::{LASTING, SHARED};

/// Most cameras whose shared errors are estimated with the target; those of further cameras count
/// as noise of each line. With half of it what a third camera shows is taken for less than it is;
/// with twice as much a hypothesis takes three times the memory.
const MAX_CAMERAS: usize = 4;
/// Position and velocity.
const STATE: usize = 6;

/// Kalman filter for position and velocity of a target and for the shared errors of its cameras.
///
/// A track only considers those errors, so what it expects of a line is less than its lines so far
/// tell: one wrong pose would count anew in every line. The clock's error counts as noise of each
/// line here, too, as its effect is not known before the velocity is.
#[derive(Clone, Debug)]
pub(super) struct JointFilter {
    time: Timestamp,
    /// The cameras whose errors follow position and velocity in `mean`, in units of their own
    /// deviations, and the decay time of those that last, s.
    cameras: Vec<(CameraName, f64)>,
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
}

impl JointFilter {
    /// What a track knows: its state, and how that is correlated with the cameras' errors.
    pub(super) fn of_track(track: &FusedTrack) -> Self {
        let KinematicState { mean, covariance } = track.state();
        let mut joint = Self {
            time: track.updated_at,
            cameras: Vec::new(),
            mean: DVector::from_column_slice(mean.as_slice()),
            covariance: DMatrix::from_column_slice(STATE, STATE, covariance.as_slice()),
        };
        for (camera, tied, lasting_s) in track.shared_ties().into_iter().take(MAX_CAMERAS) {
            let first = joint.widen(camera, lasting_s);
            let covariance = &mut joint.covariance;
            covariance.fixed_view_mut::<STATE, SHARED>(0, first).copy_from(tied);
            covariance.fixed_view_mut::<SHARED, STATE>(first, 0).copy_from(&tied.transpose());
        }
        joint
    }

    /// The same if the target's speed had a standard deviation of only a `share` of the one that
    /// was assumed before any line, `speed` (m/s per axis), and the log-likelihood ratio of that:
    /// as far as what the track has known since came from its lines. `None` if the numbers fail.
    pub(super) fn slowed(&self, share: f64, speed: f64) -> Option<(Self, f64)> {
        // N(v; 0, s^2) / N(v; 0, S^2) has the form of a measurement of v = 0 with the variance
        // R = s^2 / (1 - s^2 / S^2).
        let faster = 1.0 - share.powi(2);
        let noise = (share * speed).powi(2) / faster;
        let mut slowed = self.clone();
        let velocity = self.mean.fixed_rows::<3>(3).into_owned();
        let across = self.covariance.fixed_columns::<3>(3).into_owned();
        let spread = across.fixed_rows::<3>(3) + Matrix3::identity() * noise;
        let factor = spread.cholesky()?;
        // K = cov(x, v) (P_v + R)^-1, x <- x - K v, P <- P - K cov(v, x).
        slowed.mean -= &across * factor.solve(&velocity);
        slowed.covariance -= &across * factor.solve(&across.transpose());
        slowed.balance();
        // The ratio's mean over what is known of v:
        // (S^2 / (1 - s^2 / S^2))^(3/2) |P_v + R|^(-1/2) exp(-v' (P_v + R)^-1 v / 2).
        let log_root: f64 = factor.l().diagonal().map(f64::ln).sum();
        let squares = velocity.dot(&factor.solve(&velocity));
        Some((slowed, 1.5 * (speed.powi(2) / faster).ln() - log_root - squares / 2.0))
    }

    /// Adds the errors of a camera, of which nothing is known but their deviations; returns the
    /// index of the first.
    fn widen(&mut self, camera: &CameraName, lasting_s: f64) -> usize {
        let first = self.mean.len();
        self.cameras.push((camera.clone(), lasting_s));
        self.mean.resize_vertically_mut(first + SHARED, 0.0);
        self.covariance.resize_mut(first + SHARED, first + SHARED, 0.0);
        self.covariance.fixed_view_mut::<SHARED, SHARED>(first, first).fill_with_identity();
        first
    }

    /// Index of the first of a camera's errors, which are added if they are new; `None` if they
    /// count as noise.
    fn find_or_add(&mut self, camera: &CameraName, lasting_s: f64) -> Option<usize> {
        let place = self.cameras.iter().position(|(name, _)| name == camera);
        if let Some(place) = place {
            self.cameras[place].1 = lasting_s;
            return Some(STATE + SHARED * place);
        }
        (self.cameras.len() < MAX_CAMERAS).then(|| self.widen(camera, lasting_s))
    }

    /// Predicts to a time: constant velocity driven by white acceleration of this density, m^2/s^3.
    pub(super) fn predict(&mut self, time: Timestamp, density: f64) {
        let dt = time.seconds_since(self.time);
        self.time = time;
        // x <- F x and P <- F P F', with F = [I, I dt; 0, I] on the first six, and k on errors that
        // last, of which a share k is left; (1 - k^2) I of new error comes to them.
        for axis in 0..3 {
            self.mean[axis] += self.mean[axis + 3] * dt;
            let speed = self.covariance.row(axis + 3) * dt;
            let mut place = self.covariance.row_mut(axis);
            place += speed;
        }
        for axis in 0..3 {
            let speed = self.covariance.column(axis + 3) * dt;
            let mut place = self.covariance.column_mut(axis);
            place += speed;
        }
        for (place, (_, lasting_s)) in self.cameras.iter().enumerate() {
            let kept = (-dt.abs() / lasting_s).exp();
            for error in (LASTING..SHARED).map(|error| STATE + SHARED * place + error) {
                self.mean[error] *= kept;
                self.covariance.row_mut(error).scale_mut(kept);
                self.covariance.column_mut(error).scale_mut(kept);
                self.covariance[(error, error)] += 1.0 - kept.powi(2);
            }
        }
        // Q = q [T^3/3 T^2/2; T^2/2 T] per axis; going back in time it grows as well.
        let noise = density * dt.abs();
        for axis in 0..3 {
            self.covariance[(axis, axis)] += noise * dt.powi(2) / 3.0;
            self.covariance[(axis, axis + 3)] += noise * dt / 2.0;
            self.covariance[(axis + 3, axis)] += noise * dt / 2.0;
            self.covariance[(axis + 3, axis + 3)] += noise;
        }
    }

    /// Takes in a line of the same time, whose reported covariance counts at least `factor` times;
    /// returns the logarithm of its probability density, 1/sr. `None` if it points away from the
    /// target, or the numbers fail.
    pub(super) fn see(&mut self, bearing: &TrackBearing<'_>, factor: f64) -> Option<f64> {
        let TrackBearing { camera, line, uncertainty, .. } = *bearing;
        let own_errors = self.find_or_add(camera, uncertainty.lasting.time_s);
        let place = self.mean.fixed_rows::<3>(0).into_owned();
        let velocity = self.mean.fixed_rows::<3>(3).into_owned();
        let model = BearingModel::new(line.origin, place.into())?;
        let shifts = uncertainty.shifts(&model, velocity);
        let own = model.covariance_of(line) * (factor / uncertainty.factor).max(1.0);
        let mut noise = uncertainty.noise(&model, velocity, &own);
        let mut innovation = model.residual(line)?;
        // G = [H 0 ... J ... 0], by position and the camera's own errors.
        let mut by = OMatrix::<f64, U2, Dyn>::zeros(self.mean.len());
        by.fixed_columns_mut::<3>(0).copy_from(&model.by_position());
        if let Some(first) = own_errors {
            by.fixed_columns_mut::<SHARED>(first).copy_from(&shifts);
            innovation -= shifts * self.mean.fixed_rows::<SHARED>(first);
        } else {
            noise += shifts * shifts.transpose();
        }
        // Cov(x, z) = P G', S = G P G' + R, K = Cov(x, z) S^-1.
        let across = &self.covariance * by.transpose();
        let spread: Matrix2<f64> = &by * &across + noise;
        let log_density = log_density(&spread, innovation)?;
        let gain: OMatrix<f64, Dyn, U2> = &across * spread.try_inverse()?;
        self.mean += &gain * innovation;
        self.covariance -= gain * across.transpose();
        self.balance();
        Some(log_density)
    }

    /// Makes the covariance symmetric again: rounding errors would grow.
    fn balance(&mut self) {
        let turned = self.covariance.transpose();
        self.covariance += turned;
        self.covariance *= 0.5;
    }
}
