//! Fisher information of bearings about a target's position and velocity.

use std::ops::AddAssign;

use crossfix_geometry::{SightLine, tangent_basis};
use nalgebra::{
    Matrix2, Matrix2x3, Matrix2x6, Matrix3x2, Matrix6, Point3, Rotation3, Unit, Vector3, Vector6,
};

/// Least eigenvalue of scaled information (its diagonal is one, so that they have the mean one):
/// below it the information is singular but for rounding. Rounding errs by some 1e-15, so half of
/// it gives the same.
const SINGULAR: f64 = 1e-12;

/// Geometry of a sight line to a target: its direction, the tangents across it, its length. World,
/// metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LineGeometry {
    direction: Unit<Vector3<f64>>,
    tangents: Matrix3x2<f64>,
    range_m: f64,
}

impl LineGeometry {
    /// The line from a camera's centre to a target, with the world's tangents ([`tangent_basis`]).
    ///
    /// `None` if they are in one place, or a coordinate is not finite.
    pub fn between(camera: Point3<f64>, target: Point3<f64>) -> Option<Self> {
        let (direction, range_m) = Unit::try_new_and_get(target - camera, 1e-9)?;
        let tangents = tangent_basis(&direction);
        range_m.is_finite().then_some(Self { direction, tangents, range_m })
    }

    /// The line of a measured bearing, with the tangents that its covariance refers to, to a target
    /// at a range in metres.
    ///
    /// `None` if the range is not a positive number.
    pub fn of(line: &SightLine, range_m: f64) -> Option<Self> {
        let possible = range_m > 1e-9 && range_m.is_finite();
        possible.then_some(Self { direction: line.direction, tangents: line.basis, range_m })
    }

    /// Metres from camera to target.
    pub fn range_m(&self) -> f64 {
        self.range_m
    }

    /// Derivative of the bearing by a displacement of the target, `E' / r`, rad/m.
    fn by_displacement(&self) -> Matrix2x3<f64> {
        self.tangents.transpose() / self.range_m
    }

    /// Derivative of the bearing by the camera's pose, as that of `geometry`'s bearing model: a
    /// turn (rad), `E' [u]x` with u the direction, and a displacement (m), `-E' / r`.
    fn by_errors(&self) -> Matrix2x6<f64> {
        let turn = self.tangents.transpose() * self.direction.cross_matrix();
        let displacement = self.by_displacement();
        Matrix2x6::from_fn(|row, column| match column {
            0..3 => turn[(row, column)],
            _ => -displacement[(row, column - 3)],
        })
    }
}

/// Noise of one bearing, independent between bearings: the inverse of its covariance, 1/rad^2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BearingInformation(Matrix2<f64>);

impl BearingInformation {
    /// Noise with a covariance, rad^2, in the tangents of its line.
    ///
    /// `None` if it is not positive definite.
    pub fn new(covariance: &Matrix2<f64>) -> Option<Self> {
        let good = covariance.m11 > 0.0 && covariance.determinant() > 0.0;
        let inverse = good.then(|| covariance.try_inverse()).flatten()?;
        inverse.iter().all(|v| v.is_finite()).then_some(Self(inverse))
    }

    /// Noise with one standard deviation, rad, on both tangents.
    ///
    /// `None` if it is not a positive number.
    pub fn isotropic(sd_rad: f64) -> Option<Self> {
        Self::new(&(Matrix2::identity() * sd_rad.powi(2)))
    }
}

/// Times of the bearings along one line, in seconds from the reference epoch (negative before it):
/// their number, sum and sum of squares.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TimeOffsets {
    count: f64,
    sum_s: f64,
    squares_s2: f64,
}

impl FromIterator<f64> for TimeOffsets {
    fn from_iter<T: IntoIterator<Item = f64>>(offsets_s: T) -> Self {
        offsets_s.into_iter().fold(Self::default(), |all, dt| Self {
            count: all.count + 1.0,
            sum_s: all.sum_s + dt,
            squares_s2: all.squares_s2 + dt * dt,
        })
    }
}

/// Fisher information on a target's position and velocity at a reference epoch.
///
/// A bearing at time `dt` from the reference epoch, along a line with tangents E and range r, with
/// noise R, adds `H' R^-1 H`, `H = [E'/r, E' dt/r]`. The inverse of the sum is the Cramer-Rao
/// bound: no unbiased estimator of `[p, v]` has a smaller covariance.
///
/// ```
/// use crossfix_evaluation::bound::{BearingInformation, FisherInformation, LineGeometry};
/// use nalgebra::Point3;
///
/// let target = Point3::new(0.0, 0.0, 50.0);
/// let noise = BearingInformation::isotropic(1e-3).ok_or("noise")?;
/// let mut information = FisherInformation::default();
/// for (camera, phase) in [(Point3::new(100.0, 0.0, 0.0), 0.0), (Point3::new(0.0, 100.0, 0.0), 0.1)] {
///     for period in 0..5 {
///         // Of a target that moves, the place at that time.
///         let line = LineGeometry::between(camera, target).ok_or("at the camera")?;
///         information.add(&line, &noise, f64::from(period) + phase - 4.1);
///     }
/// }
/// let covariance = information.covariance().ok_or("not observable")?;
/// assert!(covariance[(2, 2)].sqrt() < 0.1);
/// # Ok::<(), &str>(())
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FisherInformation(Matrix6<f64>);

impl FisherInformation {
    /// Information of a prior on the velocity alone: its standard deviation, m/s per axis.
    pub fn velocity_prior(sd_mps: f64) -> Self {
        let known = sd_mps.powi(-2);
        Self(Matrix6::from_diagonal(&Vector6::new(0.0, 0.0, 0.0, known, known, known)))
    }

    /// Adds a bearing at `dt_s` from the reference epoch.
    pub fn add(&mut self, line: &LineGeometry, noise: &BearingInformation, dt_s: f64) {
        self.add_all(line, noise, &[dt_s].into_iter().collect());
    }

    /// Adds bearings that differ only in their times.
    pub fn add_all(
        &mut self,
        line: &LineGeometry,
        noise: &BearingInformation,
        times: &TimeOffsets,
    ) {
        let across = line.by_displacement();
        // Sum over dt of [E'/r, E' dt/r]' R^-1 [E'/r, E' dt/r].
        let position = across.transpose() * noise.0 * across;
        for (row, column, weight) in [
            (0, 0, times.count),
            (0, 3, times.sum_s),
            (3, 0, times.sum_s),
            (3, 3, times.squares_s2),
        ] {
            let mut block = self.0.fixed_view_mut::<3, 3>(row, column);
            block += position * weight;
        }
    }

    /// The information matrix of `[p, v]`, 1/m^2, s/m^2 and s^2/m^2.
    pub fn matrix(&self) -> &Matrix6<f64> {
        &self.0
    }

    /// The Cramer-Rao bound: the covariance of `[p, v]`, m and m/s; `None` if some direction is not
    /// determined at all.
    pub fn covariance(&self) -> Option<Matrix6<f64>> {
        // Positions and velocities have different units: scaling to a unit diagonal makes them
        // comparable.
        let scale = self.0.diagonal().map(|v| v.sqrt().recip());
        if !scale.iter().all(|v| v.is_finite()) {
            return None;
        }
        let scaled =
            Matrix6::from_fn(|row, column| self.0[(row, column)] * scale[row] * scale[column]);
        let eigen = scaled.symmetric_eigen();
        if eigen.eigenvalues.min() < SINGULAR {
            return None;
        }
        let weights = Matrix6::from_diagonal(&eigen.eigenvalues.map(f64::recip));
        let inverse = eigen.eigenvectors * weights * eigen.eigenvectors.transpose();
        Some(Matrix6::from_fn(|row, column| inverse[(row, column)] * scale[row] * scale[column]))
    }
}

impl AddAssign<&FisherInformation> for FisherInformation {
    fn add_assign(&mut self, other: &FisherInformation) {
        self.0 += other.0;
    }
}

/// Errors that all bearings of one camera share for as long as the target is observed: more
/// bearings do not average them out.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CommonErrors {
    /// A root D of the covariance D D' of the camera's turn about the world's axes (rad) and its
    /// displacement relative to the target (m).
    root: Matrix6<f64>,
}

impl CommonErrors {
    /// Errors of a pose with this covariance: rotation about the camera's axes (rad) before
    /// position (m).
    pub fn of_pose(world_from_camera: &Rotation3<f64>, covariance: &Matrix6<f64>) -> Self {
        let mut turned = Matrix6::identity();
        turned.fixed_view_mut::<3, 3>(0, 0).copy_from(world_from_camera.matrix());
        Self { root: turned * root(covariance) }
    }

    /// Errors with one deviation about each axis (rad), and one along each (m).
    pub fn isotropic(rotation_sd_rad: f64, displacement_sd_m: f64) -> Self {
        let sd = |k| if k < 3 { rotation_sd_rad } else { displacement_sd_m };
        Self { root: Matrix6::from_diagonal(&Vector6::from_fn(|k, _| sd(k))) }
    }

    /// These errors and others that are independent of them.
    pub fn and(&self, other: &Self) -> Self {
        let sum = |errors: &Self| errors.root * errors.root.transpose();
        Self { root: root(&(sum(self) + sum(other))) }
    }

    /// Errors due to a wrong clock (s): it shows a target of `speed_mps` where it was or will be;
    /// as the direction of flight is not known beforehand, a displacement of
    /// `speed * clock / root 3` on each axis.
    pub fn of_clock(clock_sd_s: f64, speed_mps: f64) -> Self {
        Self::isotropic(0.0, speed_mps * clock_sd_s / 3.0_f64.sqrt())
    }
}

/// The symmetric root of a covariance, which may be singular.
fn root(covariance: &Matrix6<f64>) -> Matrix6<f64> {
    let eigen = covariance.symmetric_eigen();
    let roots = eigen.eigenvalues.map(|variance| variance.max(0.0).sqrt());
    eigen.eigenvectors * Matrix6::from_diagonal(&roots) * eigen.eigenvectors.transpose()
}

/// Information of one camera's bearings on a target *and* on the camera's own errors.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraInformation {
    target: FisherInformation,
    /// Block of `[p, v]` (rows) and the errors (columns: rotation, displacement).
    cross: Matrix6<f64>,
    errors: Matrix6<f64>,
}

impl CameraInformation {
    /// Adds a bearing at `dt_s` from the reference epoch.
    pub fn add(&mut self, line: &LineGeometry, noise: &BearingInformation, dt_s: f64) {
        self.add_all(line, noise, &[dt_s].into_iter().collect());
    }

    /// Adds bearings that differ only in their times.
    pub fn add_all(
        &mut self,
        line: &LineGeometry,
        noise: &BearingInformation,
        times: &TimeOffsets,
    ) {
        self.target.add_all(line, noise, times);
        let by_errors = line.by_errors();
        let weighted = noise.0 * by_errors;
        let position = line.by_displacement().transpose() * weighted;
        for (row, weight) in [(0, times.count), (3, times.sum_s)] {
            let mut block = self.cross.fixed_view_mut::<3, 6>(row, 0);
            block += position * weight;
        }
        self.errors += by_errors.transpose() * weighted * times.count;
    }

    /// Information on the target with the camera's errors marginalised out, given their priors.
    ///
    /// The Schur complement `A - B (C + P^-1)^-1 B'`, written with a root D of `P = D D'` as
    /// `A - B D (I + D' C D)^-1 D' B'`, so that errors of zero are allowed.
    pub fn marginal(&self, errors: &CommonErrors) -> FisherInformation {
        let root = &errors.root;
        let unexplained = Matrix6::identity() + root.transpose() * self.errors * root;
        // It is at least the identity, so it has an inverse unless a number is not finite.
        let Some(factor) = unexplained.cholesky() else {
            return FisherInformation::default();
        };
        let lost = self.cross * root;
        FisherInformation(self.target.0 - lost * factor.solve(&lost.transpose()))
    }
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::BearingModel;
    use nalgebra::Matrix3;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};

    use super::*;

    fn position(covariance: &Matrix6<f64>) -> Matrix3<f64> {
        covariance.fixed_view::<3, 3>(0, 0).into_owned()
    }

    /// Standard deviation of the range along the first of two cameras at 100 m from the target,
    /// whose lines cross at an angle.
    fn range_sd(angle: f64, first_sd: f64, second_sd: f64) -> f64 {
        let towards = [Vector3::x(), Vector3::new(angle.cos(), angle.sin(), 0.0)];
        let mut information = FisherInformation::velocity_prior(1.0);
        for (u, sd) in towards.into_iter().zip([first_sd, second_sd]) {
            let line = LineGeometry::between(Point3::from(u * -100.0), Point3::origin()).unwrap();
            information.add(&line, &BearingInformation::isotropic(sd / 100.0).unwrap(), 0.0);
        }
        let covariance = position(&information.covariance().unwrap());
        covariance.m11.sqrt()
    }

    #[test]
    fn the_range_along_a_known_line_is_one_over_the_sine() {
        // Klochko 2020, eq. 12: sigma_r = sigma_e / |sin alpha|, where the first line is exact.
        for angle in [0.1, 0.5, 1.0, std::f64::consts::FRAC_PI_2, 2.5] {
            let expected = 0.1 / angle.sin();
            let sd = range_sd(angle, 1e-5, 0.1);
            assert!((sd / expected - 1.0).abs() < 1e-4, "{angle}: {sd} against {expected}");
            // With noise on both lines the second line's place across itself is uncertain as well.
            let both = range_sd(angle, 0.1, 0.1);
            assert!((both / (expected * (1.0 + angle.cos().powi(2)).sqrt()) - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn one_line_and_two_alike_fix_nothing() {
        let line = LineGeometry::between(Point3::new(0.0, -50.0, 0.0), Point3::origin()).unwrap();
        let behind = LineGeometry::between(Point3::new(0.0, -90.0, 0.0), Point3::origin()).unwrap();
        let noise = BearingInformation::isotropic(1e-3).unwrap();
        let mut information = FisherInformation::velocity_prior(15.0);
        for line in [line, behind] {
            for dt in [-0.2, -0.1, 0.0] {
                information.add(&line, &noise, dt);
            }
            assert_eq!(information.covariance(), None);
        }
    }

    /// Mean bound of five periods at camera 1's last time, in the orthogonal geometry of the fusion
    /// notes.
    fn orthogonal_bound(delays: [f64; 3]) -> (f64, f64) {
        const RUNS: usize = 2000;
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let velocity = Normal::new(0.0, 15.6).unwrap();
        let noise = BearingInformation::isotropic(0.1 / 150.0).unwrap();
        let elevation = 35.264_389_68_f64.to_radians();
        let (mut position_trace, mut velocity_trace) = (0.0, 0.0);
        for _ in 0..RUNS {
            let middle = loop {
                let place = Vector3::from_fn(|_, _| rng.random_range(-10.0..10.0));
                if place.norm() < 10.0 {
                    break place;
                }
            };
            let speed = Vector3::from_fn(|_, _| velocity.sample(&mut rng));
            let mut information = FisherInformation::default();
            for (azimuth, delay) in
                [0.0_f64, 120.0, 240.0].map(f64::to_radians).into_iter().zip(delays)
            {
                let (sin, cos) = azimuth.sin_cos();
                let u = Vector3::new(elevation.cos() * cos, elevation.cos() * sin, elevation.sin());
                for period in 0..5 {
                    let time = f64::from(period) + delay;
                    let place = Point3::from(middle + speed * (time - 2.0));
                    let line = LineGeometry::between(Point3::from(u * -150.0), place).unwrap();
                    information.add(&line, &noise, time - 4.0);
                }
            }
            let covariance = information.covariance().unwrap();
            position_trace += position(&covariance).trace();
            velocity_trace += covariance.fixed_view::<3, 3>(3, 3).trace();
        }
        ((position_trace / RUNS as f64).sqrt(), (velocity_trace / RUNS as f64).sqrt())
    }

    #[test]
    fn the_limit_of_five_periods_is_the_reference_implementations() {
        for (delays, expected) in
            [([0.0, 0.1, 0.2], (0.093, 0.040)), ([0.0, 0.3, 0.4], (0.090, 0.040))]
        {
            let (position, velocity) = orthogonal_bound(delays);
            assert!((position / expected.0 - 1.0).abs() < 0.03, "{delays:?}: {position} m");
            assert!((velocity / expected.1 - 1.0).abs() < 0.03, "{delays:?}: {velocity} m/s");
        }
    }

    /// Position deviation by three orthogonal cameras at 100 m, each with `count` bearings of
    /// 1 mrad and with common errors.
    fn position_sd(count: usize, errors: &CommonErrors) -> f64 {
        let mut information = FisherInformation::velocity_prior(15.0);
        for axis in [Vector3::x(), Vector3::y(), Vector3::z()] {
            let line = LineGeometry::between(Point3::from(axis * 100.0), Point3::origin()).unwrap();
            let times: TimeOffsets = (0..count).map(|n| -(n as f64) / count as f64).collect();
            let mut camera = CameraInformation::default();
            camera.add_all(&line, &BearingInformation::isotropic(1e-3).unwrap(), &times);
            information += &camera.marginal(errors);
        }
        position(&information.covariance().unwrap()).trace().sqrt()
    }

    #[test]
    fn more_bearings_do_not_average_a_pose_error_away() {
        let none = CommonErrors::default();
        assert!((position_sd(400, &none) / position_sd(40_000, &none) - 10.0).abs() < 0.1);
        // Each axis is seen by two cameras: the limit is root(3/2) of one camera's error at 100 m.
        for errors in [CommonErrors::isotropic(5e-4, 0.0), CommonErrors::isotropic(0.0, 0.05)] {
            let sd = position_sd(1_000_000, &errors);
            assert!((sd / (0.05 * 1.5_f64.sqrt()) - 1.0).abs() < 0.01, "{sd}");
        }
        // A clock of 10 ms at 15 m/s: 0.15 m, shared among three axes.
        let sd = position_sd(1_000_000, &CommonErrors::of_clock(0.01, 15.0));
        assert!((sd / (0.15 / 2.0_f64.sqrt()) - 1.0).abs() < 0.01, "{sd}");
    }

    proptest! {
        /// A camera that is turned and moved so that the target seems to stay errs by nothing, and
        /// not twice.
        #[test]
        fn errors_of_a_pose_are_those_of_the_bearing_model(x in -80.0..80.0, y in 20.0..150.0, z in -40.0..40.0) {
            let target = Point3::new(x, y, z);
            let ours = LineGeometry::between(Point3::origin(), target).unwrap().by_errors();
            let model = BearingModel::new(Point3::origin(), target).unwrap().by_pose();
            // Whatever tangents each has.
            let difference = ours.transpose() * ours - model.transpose() * model;
            prop_assert!(difference.norm() < 1e-12);
        }

        #[test]
        fn the_marginal_is_the_block_of_the_whole_inverse(
            x in -80.0..80.0, y in 20.0..150.0, z in -40.0..40.0, rotation in 1e-5..1e-2, shift in 0.01..1.0,
            about in proptest::array::uniform3(-2.0..2.0), tied in -0.9..0.9,
        ) {
            let line = LineGeometry::between(Point3::origin(), Point3::new(x, y, z)).unwrap();
            let noise = BearingInformation::new(&Matrix2::new(4e-6, 1e-6, 1e-6, 2e-6)).unwrap();
            let mut camera = CameraInformation::default();
            for dt in [-0.9, -0.4, 0.0] {
                camera.add(&line, &noise, dt);
            }
            // A prior on the target, as the whole would have no inverse without it.
            let known = Matrix6::from_diagonal(&Vector6::new(0.1, 0.1, 0.1, 0.01, 0.01, 0.01));
            let mut whole = nalgebra::SMatrix::<f64, 12, 12>::zeros();
            // A pose's own errors: turns about its axes and displacements, two of them correlated.
            let pose: Rotation3<f64> = Rotation3::new(about.into());
            let sd: Vector6<f64> = [rotation, 2.0 * rotation, rotation, shift, shift, 3.0 * shift].into();
            let mut covariance = Matrix6::from_diagonal(&sd.component_mul(&sd));
            covariance[(0, 4)] = tied * rotation * shift;
            covariance[(4, 0)] = covariance[(0, 4)];
            let mut turned = Matrix6::identity();
            turned.fixed_view_mut::<3, 3>(0, 0).copy_from(pose.matrix());
            let of_world: Matrix6<f64> = turned * covariance * turned.transpose();
            whole.fixed_view_mut::<6, 6>(0, 0).copy_from(&(camera.target.0 + known));
            whole.fixed_view_mut::<6, 6>(0, 6).copy_from(&camera.cross);
            whole.fixed_view_mut::<6, 6>(6, 0).copy_from(&camera.cross.transpose());
            let errors = camera.errors + of_world.try_inverse().unwrap();
            whole.fixed_view_mut::<6, 6>(6, 6).copy_from(&errors);
            let expected = whole.try_inverse().unwrap().fixed_view::<6, 6>(0, 0).into_owned();
            let mut marginal = camera.marginal(&CommonErrors::of_pose(&pose, &covariance));
            marginal += &FisherInformation(known);
            let ours = marginal.covariance().unwrap();
            prop_assert!((ours - expected).norm() < 1e-6 * expected.norm());
        }
    }
}
