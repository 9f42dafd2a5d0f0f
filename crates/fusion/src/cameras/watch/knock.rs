//! What the lines say of one camera, if somebody has turned it.

use crossfix_message::{CameraName, Timestamp};
use nalgebra::{Matrix3, Matrix6, SMatrix, SVector, Unit, Vector3};

use super::memory::ErrorEstimate;
use super::{CLOCK, ERRORS, LONGEST_DRAW_S, PoseFinding};
use crate::cameras::ScaleSample;

/// Standard deviations of the turn of a camera that is moved, rad per axis, each as likely: a mast
/// that settles, a gust, a hand, a fall. With the largest alone a turn of two milliradians would be
/// less likely by a hundred times.
const KNOCKS_RAD: [f64; 4] = [1e-3, 3e-3, 1e-2, 3e-2];
/// Least deviation of a pose's rotation, rad: 0.1 mrad is what a mast does in the sun. With half of
/// it the sun would move cameras whose pose is declared exact.
const LEAST_TURN_RAD: f64 = 1e-4;
/// A pose whose declared error shifts lines by less than this is exact, rad: the factor on its
/// covariance stays finite. With half of it a factor of 1e9 would be one of 4e9.
const EXACT_RAD: f64 = 1e-6;
/// Least deviation of its position, m. Where an exact pose is declared, nothing else would allow
/// for the errors that a lens leaves; with half of it those of targets near the camera may count as
/// a move.
const LEAST_SHIFT_M: f64 = 2e-3;
/// Least deviation of its clock, s: where an exact one is declared, nothing else would tell whether
/// it is off. With half of it the same.
const LEAST_CLOCK_S: f64 = 1e-4;

/// A camera whose errors are watched.
#[derive(Clone, Debug)]
pub(super) struct Watched {
    pub(super) name: CameraName,
    /// Covariance of the pose by its calibration, and a root of it.
    covariance: Matrix6<f64>,
    root: Matrix6<f64>,
    /// Mean square of the shift of its newest line by the declared error of its pose, rad^2 per
    /// tangent.
    declared_rad2: f64,
    /// Standard deviation of its clock at its newest line, s: the unit of the clock's error.
    pub(super) clock_sd_s: f64,
    /// The direction in which it looks.
    forward: Unit<Vector3<f64>>,
    pub(super) watched_s: f64,
    /// Whether part of its noise has ever been known to last.
    pub(super) noise_lasts: bool,
    /// When the camera was last seen beside others.
    drawn: Option<Timestamp>,
}

impl Watched {
    /// For a camera of a declared pose, which looks `forward`.
    pub(super) fn new(
        name: CameraName,
        declared: &Matrix6<f64>,
        forward: Unit<Vector3<f64>>,
    ) -> Self {
        let mut covariance = *declared;
        for axis in 0..3 {
            covariance[(axis, axis)] += LEAST_TURN_RAD.powi(2);
            covariance[(axis + 3, axis + 3)] += LEAST_SHIFT_M.powi(2);
        }
        let root = covariance.cholesky().map_or_else(Matrix6::identity, |factor| factor.l());
        Self {
            name,
            covariance,
            root,
            declared_rad2: 0.0,
            clock_sd_s: LEAST_CLOCK_S,
            forward,
            watched_s: 0.0,
            noise_lasts: false,
            drawn: None,
        }
    }

    /// Notes that the camera has been seen beside others.
    pub(super) fn draw(&mut self, now: Timestamp) {
        let last = self.drawn.replace(now);
        self.watched_s +=
            last.map_or(0.0, |last| now.seconds_since(last).clamp(0.0, LONGEST_DRAW_S));
    }

    /// Derivative of a line by the errors.
    pub(super) fn by_errors(&self, sample: &ScaleSample) -> SMatrix<f64, 2, ERRORS> {
        let mut by = SMatrix::<f64, 2, ERRORS>::zeros();
        // In units of the declared deviations: a pose error L s, with C = L L' and s of unit
        // variance.
        by.fixed_columns_mut::<6>(0).copy_from(&(sample.by_pose * self.root));
        by.set_column(CLOCK, &(sample.by_time * sample.clock_sd_s.max(LEAST_CLOCK_S)));
        by
    }

    /// Inverse covariance of its errors if it has been knocked by `knock_rad`, rad.
    fn knocked(&self, knock_rad: f64) -> Option<SMatrix<f64, ERRORS, ERRORS>> {
        let mut wide = self.covariance;
        // A knock turns the camera and leaves it in its place.
        (0..3).for_each(|axis| wide[(axis, axis)] += knock_rad.powi(2));
        let mut inverse = SMatrix::<f64, ERRORS, ERRORS>::identity();
        // In units of the declared deviations: L' C^-1 L.
        let own = self.root.transpose() * wide.cholesky()?.inverse() * self.root;
        inverse.fixed_view_mut::<6, 6>(0, 0).copy_from(&own);
        Some(inverse)
    }

    /// What the lines say of it, if it has been moved, from the estimates of all errors if nothing
    /// has been; its own errors begin at `first`.
    pub(super) fn knocks(&self, estimates: &[ErrorEstimate], first: usize) -> Option<Knocks> {
        let mut each = Vec::with_capacity(KNOCKS_RAD.len() * estimates.len());
        for ErrorEstimate { mean, covariance, .. } in estimates {
            let mean = mean.fixed_rows::<ERRORS>(first).into_owned();
            let own = covariance.fixed_view::<ERRORS, ERRORS>(first, first).into_owned();
            for knock_rad in KNOCKS_RAD {
                each.push(self.knocked_by(knock_rad, &mean, &own)?);
            }
        }
        let likeliest = *each.iter().max_by(|a, b| a.log_odds.total_cmp(&b.log_odds))?;
        // Mean of the likelihood ratios over all knocks and memories: each is as likely.
        let ratio = |one: &Knock| (one.log_odds - likeliest.log_odds).exp();
        let odds: f64 = each.iter().map(ratio).sum();
        let log_odds = likeliest.log_odds + (odds / each.len() as f64).ln();
        let squares: Matrix3<f64> =
            each.iter().map(|one| one.squares() * (ratio(one) / odds)).sum();
        // Turned about the direction in which it looks, it sees the same; about each of the two
        // axes across that, its lines are shifted along one tangent.
        let along = self.forward.dot(&(squares * self.forward.into_inner()));
        let moved_rad2 = (squares.trace() - along) / 2.0;
        // A pose that is declared exact stays so, whatever the factor.
        let factor = moved_rad2 / self.declared_rad2.max(EXACT_RAD.powi(2));
        Some(Knocks { likeliest, log_odds, factor })
    }

    /// Notes a line that is compared with others'.
    pub(super) fn see(&mut self, sample: &ScaleSample) {
        self.declared_rad2 = sample.pose.norm_squared() / 2.0;
        self.clock_sd_s = sample.clock_sd_s.max(LEAST_CLOCK_S);
    }

    /// The finding if it has been moved.
    pub(super) fn finding(&self, knocks: &Knocks) -> PoseFinding {
        let Knock { turn, spread, .. } = knocks.likeliest;
        PoseFinding {
            watched_s: self.watched_s,
            turn,
            turn_sd: spread.symmetric_eigenvalues().max().max(0.0).sqrt(),
            log_odds: knocks.log_odds,
            is_moved: false,
            or_else: Vec::new(),
        }
    }

    /// What the lines of one memory say, if the camera has been knocked by `knock_rad`, rad.
    fn knocked_by(
        &self,
        knock_rad: f64,
        mean: &SVector<f64, ERRORS>,
        covariance: &SMatrix<f64, ERRORS, ERRORS>,
    ) -> Option<Knock> {
        let prior = self.knocked(knock_rad)?;
        // C^-1 = I + information of the lines, the other cameras' errors marginalised.
        let known = covariance.cholesky()?.inverse();
        // The posterior with the wide prior in place of the narrow one, which has unit variance.
        let wide = (known - SMatrix::identity() + prior).cholesky()?;
        let moved = wide.solve(&(known * mean));
        // 2 ln odds = ln|P| - ln|C| - ln|A| + h' (x_wide - x), with the wide prior's precision P,
        // the narrow posterior's covariance C, the wide posterior's precision A, and the lines'
        // pull h on the errors.
        let log_odds = (log_determinant(&prior.cholesky()?.l())
            - log_determinant(&covariance.cholesky()?.l())
            - log_determinant(&wide.l())
            + (known * mean).dot(&(moved - mean)))
            / 2.0;
        // L is lower triangular: the rotation's rows have this block only.
        let turns = self.root.fixed_view::<3, 3>(0, 0);
        let spread: Matrix3<f64> =
            turns * wide.inverse().fixed_view::<3, 3>(0, 0) * turns.transpose();
        Some(Knock { turn: turns * moved.fixed_rows::<3>(0), spread, log_odds })
    }
}

/// What the lines say of a camera, if it has been knocked by a certain size.
#[derive(Clone, Copy, Debug)]
struct Knock {
    /// Its turn about the world's axes, rad, and the covariance of that.
    turn: Vector3<f64>,
    spread: Matrix3<f64>,
    /// Log-likelihood ratio of the lines, against that nothing has been moved.
    log_odds: f64,
}

impl Knock {
    /// Mean squares and products of the turn about the world's axes, rad^2.
    fn squares(&self) -> Matrix3<f64> {
        self.turn * self.turn.transpose() + self.spread
    }
}

/// The same over all sizes and memories.
#[derive(Clone, Copy, Debug)]
pub(super) struct Knocks {
    likeliest: Knock,
    pub(super) log_odds: f64,
    /// Factor on the covariance of its pose: how many times the declared one its lines are shifted,
    /// in the mean square.
    pub(super) factor: f64,
}

/// Logarithm of the determinant of L L', from L.
fn log_determinant(factor: &SMatrix<f64, ERRORS, ERRORS>) -> f64 {
    2.0 * factor.diagonal().iter().map(|root| root.ln()).sum::<f64>()
}
