//! A target as all cameras see it, with the errors that each camera's lines share.

#[cfg(test)]
mod tests;

use crossfix_filter::{KinematicState, process_noise};
use crossfix_geometry::{BearingModel, SightLine};
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{
    DMatrix, DVector, Dyn, Matrix2, Matrix2x3, Matrix3, Matrix6, OMatrix, Point3, U2, Vector2,
    Vector3, Vector6,
};

use crate::prediction::log_density;
use crate::track::{FusedTrack, TrackBearing};
use crate::uncertainty::{CameraUncertainty, LASTING, OF_CLOCK, SHARED};
use crate::update::{MAX_ROUNDS, SETTLED};

/// Most errors that are estimated with the target: all of four cameras, or poses and clocks of six;
/// further ones count as noise of each line. With half of it what a third camera shows is taken for
/// less than it is; with twice as much a hypothesis takes three times the memory.
const MAX_ERRORS: usize = 4 * SHARED;
/// Position and velocity.
const STATE: usize = 6;
/// A clock whose standard deviation has changed by a larger factor (logarithm) is known anew. With
/// half of it one that has only walked for a minute is forgotten; with twice as much what is known
/// of it is off by a fifth.
const ANOTHER: f64 = 0.1;

/// Kalman filter for position and velocity of a target and for the shared errors of its cameras.
///
/// A track only considers those errors, so what it expects of a line is less than its lines so far
/// tell: one wrong pose would count anew in every line. What a clock's error does to a line is not
/// known before the velocity is: until then that counts as noise.
#[derive(Clone, Debug)]
pub(super) struct JointFilter {
    time: Timestamp,
    /// The cameras whose errors follow position and velocity in `mean`, in units of their own
    /// deviations.
    cameras: Vec<CameraErrors>,
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    /// The velocity by which clocks shift lines, where it is known from later lines.
    flown: Option<Flown>,
}

/// How fast a target flies, m/s.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flown {
    velocity: Vector3<f64>,
    covariance: Matrix3<f64>,
}

impl Flown {
    /// Mean variance per axis, m^2/s^2.
    pub(super) fn variance(&self) -> f64 {
        self.covariance.trace() / 3.0
    }
}

/// The errors that all lines of a camera share.
#[derive(Clone, Debug)]
struct CameraErrors {
    camera: CameraName,
    /// The place of each of them in the filter's state, as far as it is estimated.
    places: [Option<usize>; SHARED],
    /// Decay time of errors that last, s; the others do not decay.
    decay_s: f64,
    /// Standard deviation of its clock, s: the unit of that error.
    time_sd_s: Option<f64>,
}

/// A line's measurement equation, linearised at one place.
struct Linearised {
    /// Jacobian by the position.
    by: Matrix2x3<f64>,
    /// Jacobian by each of the camera's errors that is estimated, with its place in the state.
    shifts: [Option<(usize, Vector2<f64>)>; SHARED],
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
            // What is tied to nothing is met as new.
            let is_there = std::array::from_fn(|error| tied.column(error).amax() > 0.0);
            let places = joint.find_or_add(camera, is_there, lasting_s);
            for (tied, place) in tied.column_iter().zip(places) {
                let Some(place) = place else { continue };
                let covariance = &mut joint.covariance;
                covariance.fixed_view_mut::<STATE, 1>(0, place).copy_from(&tied);
                covariance.fixed_view_mut::<1, STATE>(place, 0).copy_from(&tied.transpose());
            }
        }
        joint
    }

    /// A target at about this place (standard deviation in m per axis), that may be this fast (m/s).
    pub(super) fn at(place: Point3<f64>, place_sd: f64, speed: f64, time: Timestamp) -> Self {
        let mut state = KinematicState { mean: Vector6::zeros(), covariance: Matrix6::zeros() };
        state.mean.fixed_rows_mut::<3>(0).copy_from(&place.coords);
        for axis in 0..3 {
            state.covariance[(axis, axis)] = place_sd.powi(2);
            state.covariance[(axis + 3, axis + 3)] = speed.powi(2);
        }
        Self::of_state(&state, time)
    }

    /// A state that is correlated with no camera's errors.
    fn of_state(state: &KinematicState, time: Timestamp) -> Self {
        Self {
            time,
            cameras: Vec::new(),
            mean: DVector::from_column_slice(state.mean.as_slice()),
            covariance: DMatrix::from_column_slice(STATE, STATE, state.covariance.as_slice()),
            flown: None,
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

    /// How fast the target flies, as far as its lines have told.
    pub(super) fn flown(&self) -> Flown {
        let covariance = self.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        Flown { velocity: self.velocity(), covariance }
    }

    /// Takes it to be known, or no longer, how fast the target flies, for what clocks do to lines.
    pub(super) fn assume_flown(&mut self, flown: Option<Flown>) {
        self.flown = flown;
    }

    /// Whether it is known how far an uncertain clock of this deviation (s) shifts a line, to
    /// better than the line's own noise.
    pub(super) fn knows_shift(&self, line: &SightLine, time_sd_s: f64) -> bool {
        let Some(model) = BearingModel::new(line.origin, self.place()) else { return false };
        // E' P_v E sd(t)^2 / r^2.
        let by = model.by_position();
        let unsure = by * self.flown().covariance * by.transpose() * time_sd_s.powi(2);
        unsure.trace() < line.covariance.trace()
    }

    fn velocity(&self) -> Vector3<f64> {
        self.mean.fixed_rows::<3>(3).into_owned()
    }

    /// The place of each of a camera's errors that is there; of one that is new nothing is known
    /// but its deviation. `None` for those that count as noise.
    fn find_or_add(
        &mut self,
        camera: &CameraName,
        is_there: [bool; SHARED],
        decay_s: f64,
    ) -> [Option<usize>; SHARED] {
        if is_there == [false; SHARED] {
            return [None; SHARED];
        }
        let known = self.cameras.iter().position(|errors| errors.camera == *camera);
        let index = known.unwrap_or_else(|| {
            let (camera, places) = (camera.clone(), [None; SHARED]);
            self.cameras.push(CameraErrors { camera, places, decay_s, time_sd_s: None });
            self.cameras.len() - 1
        });
        let errors = &mut self.cameras[index];
        errors.decay_s = decay_s;
        let size = self.mean.len();
        let mut added = 0;
        for (place, is_there) in errors.places.iter_mut().zip(is_there) {
            if is_there && place.is_none() && size + added < STATE + MAX_ERRORS {
                *place = Some(size + added);
                added += 1;
            }
        }
        let places = errors.places;
        if added > 0 {
            self.mean.resize_vertically_mut(size + added, 0.0);
            self.covariance.resize_mut(size + added, size + added, 0.0);
            self.covariance.view_mut((size, size), (added, added)).fill_with_identity();
        }
        std::array::from_fn(|error| places[error].filter(|_| is_there[error]))
    }

    /// Forgets the error of a camera's clock if that has become another, as by what another target
    /// has told of it: its times are corrected anew then, and its deviation is another unit.
    fn note_clock(&mut self, camera: &CameraName, time_sd_s: f64) {
        let Some(errors) = self.cameras.iter_mut().find(|errors| errors.camera == *camera) else {
            return;
        };
        let before = errors.time_sd_s.replace(time_sd_s);
        let is_another = before.is_some_and(|before| (time_sd_s / before).ln().abs() > ANOTHER);
        if let Some(clock) = errors.places[OF_CLOCK].filter(|_| is_another) {
            self.mean[clock] = 0.0;
            self.covariance.row_mut(clock).fill(0.0);
            self.covariance.column_mut(clock).fill(0.0);
            self.covariance[(clock, clock)] = 1.0;
        }
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
        for CameraErrors { places, decay_s, .. } in &self.cameras {
            let kept = (-dt.abs() / decay_s).exp();
            for error in places[LASTING..].iter().copied().flatten() {
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
        let TrackBearing { camera, uncertainty, .. } = *bearing;
        let has_error = uncertainty.pose.is_some_and(|pose| pose.covariance().amax() > 0.0);
        let lasts = uncertainty.lasting.sd_rad > 0.0;
        let is_there = [has_error, has_error, uncertainty.time_sd_s > 0.0, lasts, lasts];
        let places = self.find_or_add(camera, is_there, uncertainty.lasting.time_s);
        self.note_clock(camera, uncertainty.time_sd_s);
        let before = self.place();
        let at_first = self.correction(before, bearing, factor, places)?;
        let mut correction = at_first.clone();
        let (mut place, mut moved_before) = (before, f64::INFINITY);
        for _ in 0..MAX_ROUNDS {
            let next = before + correction.across.fixed_rows::<3>(0) * correction.pull();
            let moved = (next - place).norm() / correction.range;
            if moved.powi(2) < SETTLED * correction.noise_rad {
                return self.corrected(&correction);
            }
            let next_one = self.correction(next, bearing, factor, places);
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
        places: [Option<usize>; SHARED],
    ) -> Option<Correction> {
        let seen = self.linearised(place, bearing, factor, places)?;
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

    /// A line's measurement equation at a place of the target; `places` are those of the camera's
    /// errors.
    fn linearised(
        &self,
        place: Point3<f64>,
        &TrackBearing { line, uncertainty, .. }: &TrackBearing<'_>,
        factor: f64,
        places: [Option<usize>; SHARED],
    ) -> Option<Linearised> {
        let model = BearingModel::new(line.origin, place)?;
        let camera = CameraUncertainty { clock_is_noise: false, ..*uncertainty };
        let Flown { velocity, covariance: unsure } = self.flown.unwrap_or_else(|| self.flown());
        let all = camera.shifts(&model, velocity);
        let by = model.by_position();
        let mut noise = model.covariance_of(line) * factor.max(uncertainty.factor);
        let mut innovation = model.residual(line)? + by * (place - self.place());
        let mut shifts = [None; SHARED];
        for ((shift, own), place) in shifts.iter_mut().zip(all.column_iter()).zip(places) {
            let own: Vector2<f64> = own.into_owned();
            if let Some(place) = place {
                innovation -= own * self.mean[place];
                *shift = Some((place, own));
            } else {
                noise += own * own.transpose();
            }
        }
        // What the clock's error t does by the velocity's error: its mean square is
        // (E' P_v E) (mean^2 + variance of t) / r^2.
        let square = places[OF_CLOCK].map_or(1.0, |clock| {
            self.mean[clock].powi(2) + self.covariance[(clock, clock)].max(0.0)
        });
        noise += by * unsure * by.transpose() * (square * uncertainty.time_sd_s.powi(2));
        Some(Linearised { by, shifts, noise, innovation, range: model.range })
    }

    /// P G', with G the line's Jacobian by all that is estimated.
    fn across(&self, Linearised { by, shifts, .. }: &Linearised) -> OMatrix<f64, Dyn, U2> {
        let mut across = self.covariance.fixed_columns::<3>(0) * by.transpose();
        for (error, shift) in shifts.iter().flatten() {
            for (tangent, by) in shift.iter().enumerate() {
                across.column_mut(tangent).axpy(*by, &self.covariance.column(*error), 1.0);
            }
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
        for (error, shift) in self.shifts.iter().flatten() {
            product += shift * across.row(*error);
        }
        product
    }
}
