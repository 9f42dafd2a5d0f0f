//! What is uncertain of a camera as a whole, beside the noise of each bearing.

use crossfix_geometry::{BearingModel, tangent_basis};
use crossfix_message::ClockSource;
use nalgebra::{Matrix2, Matrix6, Rotation3, SMatrix, SVector, Unit, Vector2, Vector3};

/// Variances that differ by less than this share of them are one: what turning them leaves is far
/// less.
const ROUNDING: f64 = 1e-9;

/// Errors that bearings of a camera share: two of its pose, one of its clock, and two that last from
/// one bearing of a target to the next.
pub(crate) const SHARED: usize = 5;
/// How many are of its pose.
pub(crate) const OF_POSE: usize = 2;
/// Where the clock's is among them.
pub(crate) const OF_CLOCK: usize = OF_POSE;
/// Where those are that last, ...
pub(crate) const LASTING: usize = 3;
/// ... after so many that one target's bearings tell nothing of: they are considered.
pub(crate) const CONSIDERED: usize = LASTING;

/// What a deviation of each shared error does to a bearing, rad.
pub(crate) type Shifts = SMatrix<f64, 2, SHARED>;

/// Covariance of position and velocity with the shared errors, each in its own deviations.
pub(crate) type SharedTies = SMatrix<f64, 6, SHARED>;

/// Covariance of shared errors, each in its own deviations.
pub(crate) type SharedCovariance = SMatrix<f64, SHARED, SHARED>;

/// What a track knows of the errors that all bearings of a camera share, each in its own deviations.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SharedErrors {
    /// Covariance of the state with them.
    pub(crate) ties: SharedTies,
    /// What they are thought to be: not zero for those that last alone.
    pub(crate) mean: SVector<f64, SHARED>,
    /// Their own covariance.
    pub(crate) covariance: SharedCovariance,
    /// Where something is known of those that last, the probability that they have been drawn anew
    /// since the camera's last bearing. Somebody's hand or a tracker moves on from where it was at
    /// once as well as slowly.
    pub(crate) renewal: Option<f64>,
}

impl SharedErrors {
    /// Nothing but their deviations.
    pub(crate) fn unknown() -> Self {
        Self {
            ties: SharedTies::zeros(),
            mean: SVector::zeros(),
            covariance: SharedCovariance::identity(),
            renewal: None,
        }
    }

    /// Covariance of what they shift a bearing by, rad^2.
    pub(crate) fn spread(&self, shifts: &Shifts) -> Matrix2<f64> {
        // Most often each is as wide as it says and goes with no other.
        if self.renewal.is_some() {
            shifts * self.covariance * shifts.transpose()
        } else {
            shifts * shifts.transpose()
        }
    }

    /// The same where those that last have been drawn anew, and the probability of that; `None` if
    /// nothing was known of them.
    pub(crate) fn renewed(&self) -> Option<(Self, f64)> {
        let probability = self.renewal?;
        let mut ties = self.ties;
        ties.fixed_columns_mut::<2>(LASTING).fill(0.0);
        Some((Self { ties, ..Self::unknown() }, probability))
    }
}

/// The part of a bearing's noise that the next bearing of the same target has, too: a tracker that
/// sits beside the target's middle does so for a while.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LastingNoise {
    /// Standard deviation per tangent, rad.
    pub(crate) sd_rad: f64,
    /// Time after which e^-1 of it is left, s.
    pub(crate) time_s: f64,
}

impl LastingNoise {
    /// None: each bearing errs anew.
    pub(crate) const NONE: Self = Self { sd_rad: 0.0, time_s: 1.0 };

    /// The variance of white noise of bearings `interval_s` apart that averages out as slowly, rad^2.
    pub(crate) fn as_white(&self, interval_s: f64) -> f64 {
        let kept = (-interval_s.max(1e-3) / self.time_s).exp();
        self.variance() * (1.0 + kept) / (1.0 - kept)
    }

    /// Its variance, rad^2.
    pub(crate) fn variance(&self) -> f64 {
        self.sd_rad.powi(2)
    }
}

/// Covariance of a camera's pose in the world's axes as declared: rotation (rad), then position
/// (m).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PoseUncertainty {
    covariance: Matrix6<f64>,
    /// The variances of rotation and position where all axes are alike and nothing is tied, as most
    /// poses are declared: then all bearings are shifted alike, and no matrices need be multiplied.
    alike: Option<[f64; 2]>,
}

impl PoseUncertainty {
    pub(crate) fn new(covariance: Matrix6<f64>) -> Self {
        let [rotation, position] = [covariance.m11, covariance.m44];
        let alike = Self::diagonal(rotation, position);
        // A covariance that was turned into the world's axes has rounding beside its diagonal.
        let [turns, moves] = [(0, rotation), (3, position)].map(|(from, variance)| {
            let off = (covariance - alike).fixed_view::<3, 3>(from, from).amax();
            off <= ROUNDING * variance.abs()
        });
        let tied = covariance.fixed_view::<3, 3>(0, 3).amax() > 0.0;
        let is_alike = turns && moves && !tied && rotation >= 0.0 && position >= 0.0;
        Self { covariance, alike: is_alike.then_some([rotation, position]) }
    }

    fn diagonal(rotation: f64, position: f64) -> Matrix6<f64> {
        Matrix6::from_diagonal(&[rotation, rotation, rotation, position, position, position].into())
    }

    pub(crate) fn covariance(&self) -> &Matrix6<f64> {
        &self.covariance
    }
}

/// Covariance of a pose of which nobody has said how sure it is, rotation (rad) before position (m):
/// what a careful survey reaches, 1 mrad and 5 cm an axis. A camera of which half as much were assumed
/// would be believed before the others are.
pub fn pose_covariance_of_careful_survey() -> Matrix6<f64> {
    const ROTATION_SD_RAD: f64 = 1e-3;
    const POSITION_SD_M: f64 = 0.05;
    PoseUncertainty::diagonal(ROTATION_SD_RAD.powi(2), POSITION_SD_M.powi(2))
}

/// What all bearings of an exposure have in common: the uncertainty of its time and of the
/// camera's pose, and how much worse than it says the camera has been found to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CameraUncertainty {
    /// Standard deviation of the capture time, s.
    pub(crate) time_sd_s: f64,
    /// The reported covariances count this many times.
    pub(crate) factor: f64,
    /// What is uncertain of the pose as declared, ...
    pub(crate) pose: Option<PoseUncertainty>,
    /// ... and how many times that is what the camera's lines have shown.
    pub(crate) pose_scale: f64,
    /// Whether the clock's error is taken for noise of each bearing: where the velocity is not
    /// known yet, what it shifts the bearings by is not either.
    pub(crate) clock_is_noise: bool,
    /// What sets the clock that the capture time is by.
    pub(crate) clock_source: ClockSource,
    /// What the clock wanders by beside its offset and its drift, s^2/s.
    pub(crate) clock_walk: f64,
    /// The part of its bearings' noise that lasts.
    pub(crate) lasting: LastingNoise,
    /// World from camera: the shared errors keep to the camera's axes.
    pub(crate) axes: Rotation3<f64>,
}

impl CameraUncertainty {
    /// A camera of exact pose and clock, with the time's standard deviation.
    pub(crate) fn of_time(time_sd_s: f64) -> Self {
        Self {
            time_sd_s,
            factor: 1.0,
            pose: None,
            pose_scale: 1.0,
            clock_is_noise: false,
            clock_source: ClockSource::Unspecified,
            clock_walk: 0.0,
            lasting: LastingNoise::NONE,
            axes: Rotation3::identity(),
        }
    }

    /// How the camera's shared errors shift a bearing, rad, each in units of its own deviation: what
    /// pose and clock are off by hits every bearing of the camera alike, what lasts those of a
    /// while, and more bearings do not average it away.
    pub(crate) fn shifts(&self, model: &BearingModel, velocity: Vector3<f64>) -> Shifts {
        let mut shifts = Shifts::zeros();
        let pose = self.declared_pose(model) * self.pose_scale.sqrt();
        shifts.fixed_view_mut::<2, 2>(0, 0).copy_from(&pose);
        if self.time_sd_s > 0.0 && !self.clock_is_noise {
            shifts.set_column(OF_CLOCK, &(model.by_time(velocity) * self.time_sd_s));
        }
        if self.lasting.sd_rad > 0.0 {
            let lasting = self.turn(model) * self.lasting.sd_rad;
            shifts.fixed_view_mut::<2, 2>(0, LASTING).copy_from(&lasting);
        }
        shifts
    }

    /// Covariance of what in a bearing is noise, rad^2; `own` is the covariance that it reports.
    pub(crate) fn noise(
        &self,
        model: &BearingModel,
        velocity: Vector3<f64>,
        own: &Matrix2<f64>,
    ) -> Matrix2<f64> {
        let clock = if self.clock_is_noise {
            model.by_time(velocity) * self.time_sd_s
        } else {
            Vector2::zeros()
        };
        own * self.factor + clock * clock.transpose()
    }

    /// What the pose shifts a bearing by as declared: the root of its covariance, rad.
    pub(crate) fn declared_pose(&self, model: &BearingModel) -> Matrix2<f64> {
        match self.pose {
            None => Matrix2::zeros(),
            Some(PoseUncertainty { alike: Some([rotation, position]), .. }) => {
                let shift = (rotation + position / model.range.powi(2)).sqrt();
                self.turn(model) * shift
            }
            Some(PoseUncertainty { covariance, alike: None }) => {
                let by = model.by_pose();
                let turn = self.turn(model);
                turn * root(&(turn.transpose() * (by * covariance * by.transpose()) * turn))
            }
        }
    }

    /// From tangents in the camera's own axes to the model's: the columns of a root in the former
    /// keep to the camera's axes as the direction changes.
    fn turn(&self, model: &BearingModel) -> Matrix2<f64> {
        let direction = Unit::new_unchecked(self.axes.inverse() * model.direction.into_inner());
        model.basis.transpose() * (self.axes.matrix() * tangent_basis(&direction))
    }

    /// Covariance of what the shared errors shift a bearing by, rad^2.
    pub(crate) fn shared(&self, model: &BearingModel, velocity: Vector3<f64>) -> Matrix2<f64> {
        let shifts = self.shifts(model, velocity);
        shifts * shifts.transpose()
    }
}

/// The lower triangular root of a covariance; of one that is singular, what there is of it.
fn root(covariance: &Matrix2<f64>) -> Matrix2<f64> {
    let first = covariance.m11.max(0.0).sqrt();
    let across = if first > 0.0 { covariance.m12 / first } else { 0.0 };
    Matrix2::new(first, 0.0, across, (covariance.m22 - across * across).max(0.0).sqrt())
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector6};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    #[test]
    fn rotation_position_and_clock_add_what_they_shift() {
        let direction = Vector3::new(0.3, 0.8, 0.2).normalize();
        let model = BearingModel::new(Point3::origin(), Point3::from(direction * 50.0)).unwrap();
        let mut pose = Matrix6::zeros();
        for axis in 0..3 {
            pose[(axis, axis)] = 1e-6;
            pose[(axis + 3, axis + 3)] = 0.01;
        }
        let camera = CameraUncertainty {
            time_sd_s: 0.01,
            factor: 4.0,
            pose: Some(PoseUncertainty::new(pose)),
            clock_is_noise: false,
            pose_scale: 1.0,
            clock_source: ClockSource::Ntp,
            clock_walk: 0.0,
            lasting: LastingNoise::NONE,
            axes: Rotation3::identity(),
        };
        // 10 m/s along the first tangent: 0.2 rad/s.
        let velocity = model.basis.column(0) * 10.0;
        let shared = camera.shared(&model, velocity);
        // 1e-6 of the rotation, (0.1 m / 50 m)^2, and (0.2 rad/s x 0.01 s)^2 on the first tangent.
        assert!((shared.m22 - (1e-6 + 4e-6)).abs() < 1e-12);
        assert!((shared.m11 - shared.m22 - 4e-6).abs() < 1e-12);
        assert!(shared.m12.abs() < 1e-12);
    }

    /// A calibration from landmarks ties rotation to position: a camera thought to stand too far
    /// left is turned too far right. Drawn from such a covariance, bearings scatter as `shared`
    /// says.
    #[test]
    fn a_correlated_pose_shifts_bearings_as_a_thousand_drawn_poses_do() {
        const RUNS: usize = 4000;
        let (origin, place) = (Point3::new(5.0, 0.0, 2.0), Point3::new(10.0, 60.0, 12.0));
        let model = BearingModel::new(origin, place).unwrap();
        // Landmarks 40 m away: a position error c is made up for by a rotation about the vertical.
        let mut factor = Matrix6::<f64>::identity() * 2e-4;
        factor[(3, 3)] = 0.2;
        factor[(2, 3)] = 0.2 / 40.0;
        let pose = factor * factor.transpose();
        let camera = CameraUncertainty {
            pose: Some(PoseUncertainty::new(pose)),
            ..CameraUncertainty::of_time(0.0)
        };
        let expected = camera.shared(&model, Vector3::zeros());
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let mut sum = Matrix2::zeros();
        for _ in 0..RUNS {
            let drawn = Vector6::from_fn(|_, _| StandardNormal.sample(&mut random));
            let error = factor * drawn;
            let turned = Rotation3::new(error.fixed_rows::<3>(0).into_owned());
            let seen = turned.inverse() * (place - origin - error.fixed_rows::<3>(3)).normalize();
            let offset = model.basis.transpose() * seen;
            sum += offset * offset.transpose();
        }
        let found = sum / RUNS as f64;
        // A variance of n draws is known to sqrt(2 / n) of itself.
        let tolerance = 4.0 * (2.0 / RUNS as f64).sqrt() * expected.trace();
        assert!((found - expected).norm() < tolerance, "{found} {expected}");
        // With the wrong sign of the position it would be several times as large.
        assert!(expected.trace().sqrt() < 0.6 * (0.2 / 40.0), "{}", expected.trace().sqrt());
    }
}
