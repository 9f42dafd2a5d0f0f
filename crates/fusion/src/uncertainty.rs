//! Uncertainty of a camera as a whole, beside the noise of each bearing.

use crossfix_geometry::{BearingModel, tangent_basis};
use crossfix_message::ClockSource;
use nalgebra::{Matrix2, Matrix6, Rotation3, SMatrix, SVector, Unit, Vector2, Vector3};

/// Variances whose relative difference is less than this are equal: what rotating them leaves is
/// far less. With half of it the same.
const ROUNDING: f64 = 1e-9;

/// Number of errors that bearings of a camera share: two of its pose, one of its clock, and two
/// that last from one bearing of a target to the next.
pub(crate) const SHARED: usize = 5;
/// How many of them are of its pose.
pub(crate) const OF_POSE: usize = 2;
/// Index of the clock's error among them.
pub(crate) const OF_CLOCK: usize = OF_POSE;
/// Index of the first of those that last.
pub(crate) const LASTING: usize = 3;
/// Number of the errors before these. One target's bearings tell nothing of them: they are
/// considered (Schmidt) and not estimated.
pub(crate) const CONSIDERED: usize = LASTING;

/// Shift of a bearing by one standard deviation of each shared error, rad.
pub(crate) type Shifts = SMatrix<f64, 2, SHARED>;

/// Covariance of position and velocity with the shared errors, each in units of its own deviation.
pub(crate) type SharedTies = SMatrix<f64, 6, SHARED>;

/// Covariance of shared errors, each in units of its own deviation.
pub(crate) type SharedCovariance = SMatrix<f64, SHARED, SHARED>;

/// What a track knows of the errors that all bearings of a camera share, each in units of its own
/// deviation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SharedErrors {
    /// Covariance of the state with the errors.
    pub(crate) ties: SharedTies,
    /// Mean of the errors: only of those that last it is not zero.
    pub(crate) mean: SVector<f64, SHARED>,
    /// Covariance of the errors themselves.
    pub(crate) covariance: SharedCovariance,
    /// Where something is known of the errors that last, the probability that they have been drawn
    /// again since the camera's last bearing. Somebody's hand or a tracker moves on from where it
    /// was at once as well as slowly.
    pub(crate) renewal: Option<f64>,
}

impl SharedErrors {
    /// The prior: nothing is known of the errors but their deviations.
    pub(crate) fn unknown() -> Self {
        Self {
            ties: SharedTies::zeros(),
            mean: SVector::zeros(),
            covariance: SharedCovariance::identity(),
            renewal: None,
        }
    }

    /// Covariance of the shift of a bearing by the errors, rad^2.
    pub(crate) fn spread(&self, shifts: &Shifts) -> Matrix2<f64> {
        // Usually each error has unit variance and is correlated with no other: J C J' = J J'.
        if self.renewal.is_some() {
            shifts * self.covariance * shifts.transpose()
        } else {
            shifts * shifts.transpose()
        }
    }

    /// The same where the errors that last have been drawn again, and the probability of that;
    /// `None` if nothing was known of them.
    pub(crate) fn renewed(&self) -> Option<(Self, f64)> {
        let probability = self.renewal?;
        let mut ties = self.ties;
        // A new draw is correlated with nothing, has mean 0 and unit variance.
        ties.fixed_columns_mut::<2>(LASTING).fill(0.0);
        Some((Self { ties, ..Self::unknown() }, probability))
    }
}

/// The part of a bearing's noise that the next bearing of the same target shares: a tracker that
/// sits beside the target's middle does so for a while.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CorrelatedNoise {
    /// Standard deviation per tangent, rad.
    pub(crate) sd_rad: f64,
    /// Correlation time, s: e^-1 of the noise is left after it.
    pub(crate) time_s: f64,
}

impl CorrelatedNoise {
    /// None: the errors of successive bearings are independent.
    pub(crate) const NONE: Self = Self { sd_rad: 0.0, time_s: 1.0 };

    /// Variance of white noise that averages out as slowly over bearings `interval_s` apart, rad^2.
    pub(crate) fn as_white(&self, interval_s: f64) -> f64 {
        // rho = exp(-t / T).
        let kept = (-interval_s.max(1e-3) / self.time_s).exp();
        // The sum of rho^|k| over all k is (1 + rho) / (1 - rho).
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
    /// Variances of rotation and position where all axes are alike and nothing is correlated, as
    /// most poses are declared: then all bearings are shifted alike, and no matrices need be
    /// multiplied.
    isotropic: Option<[f64; 2]>,
}

impl PoseUncertainty {
    pub(crate) fn new(covariance: Matrix6<f64>) -> Self {
        let [rotation, position] = [covariance.m11, covariance.m44];
        let isotropic = Self::diagonal(rotation, position);
        // A covariance that was rotated into the world's axes has rounding off its diagonal.
        let [turns, moves] = [(0, rotation), (3, position)].map(|(from, variance)| {
            let off = (covariance - isotropic).fixed_view::<3, 3>(from, from).amax();
            off <= ROUNDING * variance.abs()
        });
        let tied = covariance.fixed_view::<3, 3>(0, 3).amax() > 0.0;
        let is_isotropic = turns && moves && !tied && rotation >= 0.0 && position >= 0.0;
        Self { covariance, isotropic: is_isotropic.then_some([rotation, position]) }
    }

    fn diagonal(rotation: f64, position: f64) -> Matrix6<f64> {
        Matrix6::from_diagonal(&[rotation, rotation, rotation, position, position, position].into())
    }

    pub(crate) fn covariance(&self) -> &Matrix6<f64> {
        &self.covariance
    }
}

/// Covariance of a pose whose uncertainty nobody has stated, rotation (rad) before position (m):
/// what a careful survey reaches.
pub fn pose_covariance_of_careful_survey() -> Matrix6<f64> {
    /// Standard deviation of the rotation, rad per axis. With half of it a camera would be believed
    /// before the others are.
    const ROTATION_SD_RAD: f64 = 1e-3;
    /// The same of the position, m per axis.
    const POSITION_SD_M: f64 = 0.05;
    PoseUncertainty::diagonal(ROTATION_SD_RAD.powi(2), POSITION_SD_M.powi(2))
}

/// What all bearings of an exposure have in common: the uncertainty of its time and of the camera's
/// pose, and how much worse than reported the camera has been found to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CameraUncertainty {
    /// Standard deviation of the capture time, s.
    pub(crate) time_sd_s: f64,
    /// Factor on the reported covariances.
    pub(crate) factor: f64,
    /// Uncertainty of the pose as declared.
    pub(crate) pose: Option<PoseUncertainty>,
    /// Factor on its covariance, as learnt from the camera's lines.
    pub(crate) pose_scale: f64,
    /// Whether the clock's error counts as noise of each bearing: where the velocity is not known
    /// yet, the shift by that error is not either.
    pub(crate) clock_is_noise: bool,
    /// Time source of the clock that stamps the exposure.
    pub(crate) clock_source: ClockSource,
    /// Random walk of the clock beside its offset and its drift, s^2/s.
    pub(crate) clock_walk: f64,
    /// The part of its bearings' noise that lasts, as declared or, where nobody has declared it, as
    /// learnt.
    pub(crate) lasting: CorrelatedNoise,
    /// The same as declared, by the calibration or by what the mount's angles are good for.
    pub(crate) declared_lasting: CorrelatedNoise,
    /// Rotation from camera to world axes: the shared errors keep to the camera's axes.
    pub(crate) axes: Rotation3<f64>,
}

impl CameraUncertainty {
    /// A camera of exact pose, with this standard deviation of its time, s.
    pub(crate) fn of_time(time_sd_s: f64) -> Self {
        Self {
            time_sd_s,
            factor: 1.0,
            pose: None,
            pose_scale: 1.0,
            clock_is_noise: false,
            clock_source: ClockSource::Unspecified,
            clock_walk: 0.0,
            lasting: CorrelatedNoise::NONE,
            declared_lasting: CorrelatedNoise::NONE,
            axes: Rotation3::identity(),
        }
    }

    /// Shifts of a bearing by the camera's shared errors, rad per standard deviation of each.
    /// Errors of pose and clock shift every bearing of the camera alike, those that last all
    /// bearings of a while, and more bearings do not average them away.
    pub(crate) fn shifts(&self, model: &BearingModel, velocity: Vector3<f64>) -> Shifts {
        let mut shifts = Shifts::zeros();
        // A factor on the variance is its root on the shift.
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

    /// Covariance of a bearing's noise, rad^2; `own` is the covariance that it reports.
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
        // f R + c c', c the shift by one deviation of the clock.
        own * self.factor + clock * clock.transpose()
    }

    /// Shift of a bearing by the pose's error as declared: a root of its covariance, rad.
    pub(crate) fn declared_pose(&self, model: &BearingModel) -> Matrix2<f64> {
        match self.pose {
            None => Matrix2::zeros(),
            Some(PoseUncertainty { isotropic: Some([rotation, position]), .. }) => {
                // All axes alike: the variance is that of the rotation plus that of the position
                // over r^2.
                let shift = (rotation + position / model.range.powi(2)).sqrt();
                self.turn(model) * shift
            }
            Some(PoseUncertainty { covariance, isotropic: None }) => {
                let by = model.by_pose();
                let turn = self.turn(model);
                // A root of J P J', taken in tangents of the camera's own axes.
                turn * root(&(turn.transpose() * (by * covariance * by.transpose()) * turn))
            }
        }
    }

    /// Rotation from tangents in the camera's own axes to those of the model: the columns of a root
    /// taken in the former keep to the camera's axes as the direction changes.
    fn turn(&self, model: &BearingModel) -> Matrix2<f64> {
        let direction = Unit::new_unchecked(self.axes.inverse() * model.direction.into_inner());
        model.basis.transpose() * (self.axes.matrix() * tangent_basis(&direction))
    }

    /// Covariance of the shift of a bearing by the shared errors, rad^2.
    pub(crate) fn shared(&self, model: &BearingModel, velocity: Vector3<f64>) -> Matrix2<f64> {
        let shifts = self.shifts(model, velocity);
        shifts * shifts.transpose()
    }
}

/// The lower triangular root of a covariance; of a singular one, the part that exists.
fn root(covariance: &Matrix2<f64>) -> Matrix2<f64> {
    let first = covariance.m11.max(0.0).sqrt();
    // Cholesky by hand: L = [a, 0; b, c], a = sqrt(m11), b = m12 / a, c = sqrt(m22 - b^2).
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
            lasting: CorrelatedNoise::NONE,
            declared_lasting: CorrelatedNoise::NONE,
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

    /// A calibration from landmarks correlates rotation with position: a camera thought to stand
    /// too far left is turned too far right. Bearings drawn from such a covariance scatter as
    /// `shared` says.
    #[test]
    fn a_correlated_pose_shifts_bearings_as_a_thousand_drawn_poses_do() {
        const RUNS: usize = 4000;
        let (origin, place) = (Point3::new(5.0, 0.0, 2.0), Point3::new(10.0, 60.0, 12.0));
        let model = BearingModel::new(origin, place).unwrap();
        // Landmarks 40 m away: a rotation about the vertical compensates for a position error c.
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
