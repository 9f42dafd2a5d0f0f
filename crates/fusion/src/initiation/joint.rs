//! A target as all cameras see it, with the errors that each camera's lines share.

#[cfg(test)]
mod tests;

use crossfix_filter::{KinematicState, process_noise};
use crossfix_geometry::BearingModel;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{
    DMatrix, DVector, Dyn, Matrix2, Matrix2x3, Matrix3, OMatrix, Point3, U2, Vector2, Vector3,
};

use crate::prediction::log_density;
use crate::track::{FusedTrack, TrackBearing};
use crate::uncertainty::{CameraUncertainty, LASTING};
use crate::update::{MAX_ROUNDS, SETTLED};

/// Most pairs of errors that are estimated with the target: poses and lasting errors of four
/// cameras, or poses alone of eight; further ones count as noise of each line. With half of it what
/// a third camera shows is taken for less than it is; with twice as much a hypothesis takes three
/// times the memory.
const MAX_PAIRS: usize = 8;
/// Position and velocity.
const STATE: usize = 6;
/// Errors in a pair: one along each tangent.
const PAIR: usize = 2;
/// Index of the first of a pair among the errors that a camera's lines share: of the pose, and of
/// those that last.
const PAIRS: [usize; 2] = [0, LASTING];

/// Kalman filter for position and velocity of a target and for the shared errors of its cameras.
///
/// A track only considers those errors, so what it expects of a line is less than its lines so far
/// tell: one wrong pose would count anew in every line. The clock's error counts as noise of each
/// line here, as its effect is not known before the velocity is.
#[derive(Clone, Debug)]
pub(super) struct JointFilter {
    time: Timestamp,
    /// The errors that follow position and velocity in `mean`, in units of their own deviations.
    pairs: Vec<ErrorPair>,
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
}

/// Two errors that lines of a camera share, one along each tangent.
#[derive(Clone, Debug)]
struct ErrorPair {
    camera: CameraName,
    /// Index of the first of them among the camera's errors.
    from: usize,
    /// Decay time of errors that last, s; a pose's do not decay.
    decay_s: f64,
}

/// A line's measurement equation, linearised at one place.
struct Linearised {
    /// Jacobian by the position.
    by: Matrix2x3<f64>,
    /// Jacobians by the camera's errors that are estimated, each with the index of the first.
    shifts: [Option<(usize, Matrix2<f64>)>; 2],
    noise: Matrix2<f64>,
    innovation: Vector2<f64>,
    /// Distance of the place from the camera, m.
    range: f64,
}

/// What a line corrects.
#[derive(Clone, Debug)]
struct Correction {
    /// Cov(x, z) = P G', ...
    across: OMatrix<f64, Dyn, U2>,
    /// ... S = G P G' + R, ...
    spread: Matrix2<f64>,
    /// ... and S^-1.
    inverse: Matrix2<f64>,
    innovation: Vector2<f64>,
    /// Standard deviation of the line's noise, rad.
    noise_rad: f64,
    /// Distance of the place from the camera, m.
    range: f64,
}

impl Correction {
    /// S^-1 z: the mean of x grows by Cov(x, z) S^-1 z.
    fn pull(&self) -> Vector2<f64> {
        self.inverse * self.innovation
    }
}

impl JointFilter {
    /// What a track knows: its state, and how that is correlated with the cameras' errors.
    pub(super) fn of_track(track: &FusedTrack) -> Self {
        let mut joint = Self::of_state(track.state(), track.updated_at);
        for (camera, tied, lasting_s) in track.shared_ties() {
            for from in PAIRS {
                let tied = tied.fixed_columns::<PAIR>(from);
                // What is tied to nothing is met as new.
                if tied.amax() == 0.0 {
                    continue;
                }
                let Some(first) = joint.find_or_add(camera, from, lasting_s) else { break };
                let covariance = &mut joint.covariance;
                covariance.fixed_view_mut::<STATE, PAIR>(0, first).copy_from(&tied);
                covariance.fixed_view_mut::<PAIR, STATE>(first, 0).copy_from(&tied.transpose());
            }
        }
        joint
    }

    /// A state that is correlated with no camera's errors.
    fn of_state(state: &KinematicState, time: Timestamp) -> Self {
        Self {
            time,
            pairs: Vec::new(),
            mean: DVector::from_column_slice(state.mean.as_slice()),
            covariance: DMatrix::from_column_slice(STATE, STATE, state.covariance.as_slice()),
        }
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
        let velocity = self.velocity();
        let across = self.covariance.fixed_columns::<3>(3).into_owned();
        let spread = across.fixed_rows::<3>(3) + Matrix3::identity() * noise;
        let factor = spread.cholesky()?;
        // K = cov(x, v) (P_v + R)^-1, x <- x - K v, P <- P - K cov(v, x).
        slowed.mean -= &across * factor.solve(&velocity);
        slowed.covariance -= &across * factor.inverse() * across.transpose();
        slowed.balance();
        // The ratio's mean over what is known of v:
        // (S^2 / (1 - s^2 / S^2))^(3/2) |P_v + R|^(-1/2) exp(-v' (P_v + R)^-1 v / 2).
        let log_root: f64 = factor.l().diagonal().map(f64::ln).sum();
        let squares = velocity.dot(&factor.solve(&velocity));
        Some((slowed, 1.5 * (speed.powi(2) / faster).ln() - log_root - squares / 2.0))
    }

    fn place(&self) -> Point3<f64> {
        self.mean.fixed_rows::<3>(0).into_owned().into()
    }

    fn velocity(&self) -> Vector3<f64> {
        self.mean.fixed_rows::<3>(3).into_owned()
    }

    /// Index of the first of a pair of a camera's errors, of which nothing is known but their
    /// deviations if they are new; `None` if they count as noise.
    fn find_or_add(&mut self, camera: &CameraName, from: usize, lasting_s: f64) -> Option<usize> {
        let decay_s = if from == LASTING { lasting_s } else { f64::INFINITY };
        let known = self.pairs.iter().position(|pair| pair.from == from && pair.camera == *camera);
        if let Some(place) = known {
            self.pairs[place].decay_s = decay_s;
            return Some(STATE + PAIR * place);
        }
        if self.pairs.len() == MAX_PAIRS {
            return None;
        }
        self.pairs.push(ErrorPair { camera: camera.clone(), from, decay_s });
        let first = self.mean.len();
        self.mean.resize_vertically_mut(first + PAIR, 0.0);
        self.covariance.resize_mut(first + PAIR, first + PAIR, 0.0);
        self.covariance.fixed_view_mut::<PAIR, PAIR>(first, first).fill_with_identity();
        Some(first)
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
        for (place, pair) in self.pairs.iter().enumerate().filter(|(_, p)| p.decay_s.is_finite()) {
            let kept = (-dt.abs() / pair.decay_s).exp();
            for error in (0..PAIR).map(|tangent| STATE + PAIR * place + tangent) {
                self.mean[error] *= kept;
                self.covariance.row_mut(error).scale_mut(kept);
                self.covariance.column_mut(error).scale_mut(kept);
                self.covariance[(error, error)] += 1.0 - kept.powi(2);
            }
        }
        let noise = process_noise(dt, density);
        for axis in 0..3 {
            self.covariance[(axis, axis)] += noise.m11;
            self.covariance[(axis, axis + 3)] += noise.m12;
            self.covariance[(axis + 3, axis)] += noise.m12;
            self.covariance[(axis + 3, axis + 3)] += noise.m22;
        }
    }

    /// Takes in a line of the same time, whose reported covariance counts at least `factor` times;
    /// returns the logarithm of its probability density, 1/sr. `None` if it points away from the
    /// target, or the numbers fail.
    ///
    /// Iterated, as a track's update is: a target whose speed is not known yet may be anywhere
    /// within the distance that it flies from one exposure to the next. Where the rounds do not
    /// approach a place, or not in time, the range is so vague that the first is as good as any
    /// other.
    pub(super) fn see(&mut self, bearing: &TrackBearing<'_>, factor: f64) -> Option<f64> {
        let TrackBearing { camera, uncertainty: CameraUncertainty { pose, lasting, .. }, .. } =
            *bearing;
        let has_error = pose.is_some_and(|pose| pose.covariance().amax() > 0.0);
        let is_there = [has_error, lasting.sd_rad > 0.0];
        let mut firsts = [None; 2];
        for (first, (from, is_there)) in firsts.iter_mut().zip(PAIRS.into_iter().zip(is_there)) {
            if is_there {
                *first = self.find_or_add(camera, from, lasting.time_s);
            }
        }
        let before = self.place();
        let at_first = self.correction(before, bearing, factor, firsts)?;
        let mut correction = at_first.clone();
        let (mut place, mut moved_before) = (before, f64::INFINITY);
        for _ in 0..MAX_ROUNDS {
            let next = before + correction.across.fixed_rows::<3>(0) * correction.pull();
            let moved = (next - place).norm() / correction.range;
            if moved.powi(2) < SETTLED * correction.noise_rad {
                return self.corrected(&correction);
            }
            let next_one = self.correction(next, bearing, factor, firsts);
            let Some(next_one) = next_one.filter(|_| moved < moved_before) else { break };
            (place, moved_before, correction) = (next, moved, next_one);
        }
        self.corrected(&at_first)
    }

    /// Applies a correction; returns the logarithm of the line's probability density. `None`, and
    /// nothing is applied, if the numbers fail.
    fn corrected(&mut self, correction: &Correction) -> Option<f64> {
        let Correction { across, inverse, spread, innovation, .. } = correction;
        let log_density = log_density(spread, *innovation)?;
        self.mean += across * correction.pull();
        self.covariance -= across * inverse * across.transpose();
        self.balance();
        Some(log_density)
    }

    /// What a line corrects, by its measurement equation at a place.
    fn correction(
        &self,
        place: Point3<f64>,
        bearing: &TrackBearing<'_>,
        factor: f64,
        firsts: [Option<usize>; 2],
    ) -> Option<Correction> {
        let seen = self.linearised(place, bearing, factor, firsts)?;
        let across = self.across(&seen);
        let spread = seen.times(&across) + seen.noise;
        Some(Correction {
            inverse: spread.try_inverse()?,
            across,
            spread,
            innovation: seen.innovation,
            noise_rad: (seen.noise.trace() / 2.0).sqrt(),
            range: seen.range,
        })
    }

    /// A line's measurement equation at a place; `firsts` are the indices of the camera's errors.
    fn linearised(
        &self,
        place: Point3<f64>,
        &TrackBearing { line, uncertainty, .. }: &TrackBearing<'_>,
        factor: f64,
        firsts: [Option<usize>; 2],
    ) -> Option<Linearised> {
        let model = BearingModel::new(line.origin, place)?;
        let own = model.covariance_of(line) * (factor / uncertainty.factor).max(1.0);
        let camera = CameraUncertainty { clock_is_noise: true, ..*uncertainty };
        let all = camera.shifts(&model, self.velocity());
        let mut noise = camera.noise(&model, self.velocity(), &own);
        let by = model.by_position();
        let mut innovation = model.residual(line)? + by * (place - self.place());
        let mut shifts = [None; 2];
        for (index, from) in PAIRS.into_iter().enumerate() {
            let shift: Matrix2<f64> = all.fixed_columns::<PAIR>(from).into_owned();
            if let Some(first) = firsts[index] {
                innovation -= shift * self.mean.fixed_rows::<PAIR>(first);
                shifts[index] = Some((first, shift));
            } else {
                noise += shift * shift.transpose();
            }
        }
        Some(Linearised { by, shifts, noise, innovation, range: model.range })
    }

    /// P G', with G the line's Jacobian by all that is estimated.
    fn across(&self, Linearised { by, shifts, .. }: &Linearised) -> OMatrix<f64, Dyn, U2> {
        let mut across = self.covariance.fixed_columns::<3>(0) * by.transpose();
        for (first, shift) in shifts.iter().flatten() {
            across += self.covariance.fixed_columns::<PAIR>(*first) * shift.transpose();
        }
        across
    }

    /// Makes the covariance symmetric again: rounding errors would grow.
    fn balance(&mut self) {
        for row in 1..self.covariance.nrows() {
            for column in 0..row {
                let mean = (self.covariance[(row, column)] + self.covariance[(column, row)]) / 2.0;
                self.covariance[(row, column)] = mean;
                self.covariance[(column, row)] = mean;
            }
        }
    }
}

impl Linearised {
    /// G times a matrix with a row for each of what is estimated.
    fn times(&self, across: &OMatrix<f64, Dyn, U2>) -> Matrix2<f64> {
        let mut product = self.by * across.fixed_rows::<3>(0);
        for (first, shift) in self.shifts.iter().flatten() {
            product += shift * across.fixed_rows::<PAIR>(*first);
        }
        product
    }
}
