//! A target's trajectory over a window of time, as a cubic spline.

use nalgebra::{DMatrix, DVector, Vector3};

/// Length of a piece, s: a weave of 1 rad/s and 10 m is followed to 2 mm, its beginning and its end
/// (steps of the acceleration) to a few centimetres. With half of it an adjustment has twice as
/// many unknowns; with twice as much the weave is followed to 3 cm: a cubic's error grows with the
/// fourth power.
const PIECE_S: f64 = 0.5;
/// Third finite difference of neighbouring coefficients, of which a piece's third derivative is
/// made.
const THIRD: [f64; 4] = [-1.0, 3.0, -3.0, 1.0];
/// Second finite difference of neighbouring coefficients, for the acceleration.
const SECOND: [f64; 3] = [1.0, -2.0, 1.0];
/// First finite difference of neighbouring coefficients, for the velocity.
const FIRST: [f64; 2] = [-1.0, 1.0];
/// Nothing accelerates beyond this, m/s^2: it constrains what no bearing determines. With half of
/// it the same: over the whole curve it counts as a single measurement.
const VAGUE_ACCELERATION: f64 = 50.0;
/// Nothing flies faster than this, m/s. With half of it the same, for the same reason.
const VAGUE_SPEED: f64 = 300.0;
/// Standard deviation of a coefficient about the origin, m: it constrains what nothing else does.
/// With half of it the same: it only sets where a descent begins.
const VAGUE_PLACE_SD_M: f64 = 1e4;

/// A uniform cubic B-spline over an interval of time, continued beyond it by its first and last
/// pieces. Its coefficients are points in space, one after the other in a vector.
#[derive(Clone, Copy, Debug)]
pub(super) struct Curve {
    start_s: f64,
    pieces: usize,
}

/// Weights of four successive coefficients in the place (1) and in the velocity (1/s) at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Basis {
    /// The first of the four coefficients.
    pub(super) first: usize,
    pub(super) place: [f64; 4],
    pub(super) velocity: [f64; 4],
}

/// Where something was at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct TimedPlace {
    pub(super) time_s: f64,
    pub(super) place: Vector3<f64>,
}

impl Curve {
    /// A curve from one time to another, s.
    pub(super) fn over(start_s: f64, end_s: f64) -> Self {
        Self { start_s, pieces: ((end_s - start_s) / PIECE_S).ceil().max(1.0) as usize }
    }

    /// Number of its coefficients, each a point.
    pub(super) fn points(&self) -> usize {
        self.pieces + 3
    }

    pub(super) fn basis(&self, time_s: f64) -> Basis {
        let along = (time_s - self.start_s) / PIECE_S;
        let first = (along.max(0.0) as usize).min(self.pieces - 1);
        let u = along - first as f64;
        // Within the piece u goes from 0 to 1, and v = 1 - u; the velocity weights are the
        // derivatives.
        let (v, u2) = (1.0 - u, u * u);
        let u3 = u2 * u;
        let place =
            [v * v * v, 3.0 * u3 - 6.0 * u2 + 4.0, 3.0 * (u + u2 - u3) + 1.0, u3].map(|b| b / 6.0);
        let velocity =
            [-v * v, 3.0 * u2 - 4.0 * u, 1.0 + 2.0 * u - 3.0 * u2, u2].map(|b| b / (2.0 * PIECE_S));
        Basis { first, place, velocity }
    }

    /// Adds the prior of the coefficients to an information matrix: a white jerk of this power
    /// spectral density (m^2/s^5), and that nothing flies beyond all bounds.
    pub(super) fn add_prior(&self, information: &mut DMatrix<f64>, jerk_density: f64) {
        // The third difference of the coefficients is the jerk times the cube of a piece's length,
        // and white jerk of density q has the variance q / length over a piece: together q
        // length^5.
        let share = (self.points() as f64).recip();
        add_differences(
            information,
            self.points(),
            &THIRD,
            (jerk_density * PIECE_S.powi(5)).recip(),
        );
        // The vague bounds count once for the whole curve: each difference has its share.
        let bend = share / (VAGUE_ACCELERATION * PIECE_S * PIECE_S).powi(2);
        add_differences(information, self.points(), &SECOND, bend);
        add_differences(
            information,
            self.points(),
            &FIRST,
            share / (VAGUE_SPEED * PIECE_S).powi(2),
        );
    }

    /// The jerk density's part of the evidence: minus twice the log density of the prior, up to
    /// what is the same for all.
    pub(super) fn log_width(&self, jerk_density: f64) -> f64 {
        // Each third difference has three axes of variance q h^5: ln det of them all, less what q
        // does not change.
        3.0 * (self.points() - THIRD.len() + 1) as f64 * jerk_density.ln()
    }

    /// Least-squares coefficients for places, all with this standard deviation, m.
    pub(super) fn fit(
        &self,
        places: impl Iterator<Item = TimedPlace>,
        sd_m: f64,
    ) -> Option<DVector<f64>> {
        let n = 3 * self.points();
        let mut information = DMatrix::zeros(n, n);
        let mut pull = DVector::zeros(n);
        // The normal equations A'A c = A'p of p(t) = sum of w_i(t) c_i, weighted by 1 / sd^2.
        for TimedPlace { time_s, place } in places {
            let Basis { first, place: weights, .. } = self.basis(time_s);
            for i in 0..4 {
                for axis in 0..3 {
                    pull[3 * (first + i) + axis] += weights[i] * place[axis] / sd_m.powi(2);
                    for k in 0..4 {
                        information[(3 * (first + i) + axis, 3 * (first + k) + axis)] +=
                            weights[i] * weights[k] / sd_m.powi(2);
                    }
                }
            }
        }
        self.add_prior(&mut information, 1.0);
        for i in 0..n {
            information[(i, i)] += VAGUE_PLACE_SD_M.powi(-2);
        }
        Some(information.cholesky()?.solve(&pull))
    }
}

/// Adds the information `weight` that these differences of neighbouring coefficients are zero.
fn add_differences(information: &mut DMatrix<f64>, points: usize, difference: &[f64], weight: f64) {
    for start in 0..(points + 1).saturating_sub(difference.len()) {
        for (i, a) in difference.iter().enumerate() {
            for (k, b) in difference.iter().enumerate() {
                for axis in 0..3 {
                    information[(3 * (start + i) + axis, 3 * (start + k) + axis)] += weight * a * b;
                }
            }
        }
    }
}

/// The target at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct CurvePoint {
    /// m.
    pub(super) place: Vector3<f64>,
    /// m/s.
    pub(super) velocity: Vector3<f64>,
}

impl Basis {
    /// Place and velocity for the coefficients at the beginning of a vector.
    pub(super) fn at(&self, coefficients: &DVector<f64>) -> CurvePoint {
        let (mut place, mut velocity) = (Vector3::zeros(), Vector3::zeros());
        for i in 0..4 {
            let point = coefficients.fixed_rows::<3>(3 * (self.first + i));
            place += point * self.place[i];
            velocity += point * self.velocity[i];
        }
        CurvePoint { place, velocity }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parabola_is_followed_exactly_inside_and_beyond() {
        let curve = Curve::over(-1.0, 3.0);
        let at = |t: f64| Vector3::new(1.0 + 10.0 * t, -t * t, 40.0);
        let times = (0..40).map(|k| -1.0 + 0.1 * f64::from(k));
        let places = times.map(|time_s| TimedPlace { time_s, place: at(time_s) });
        let coefficients = curve.fit(places, 1e-3).unwrap();
        for t in [-1.2, -0.3, 0.77, 3.1] {
            let CurvePoint { place, velocity } = curve.basis(t).at(&coefficients);
            assert!((place - at(t)).norm() < 1e-2, "{t}: {place}");
            assert!(
                (velocity - Vector3::new(10.0, -2.0 * t, 0.0)).norm() < 1e-2,
                "{t}: {velocity}"
            );
        }
    }
}
