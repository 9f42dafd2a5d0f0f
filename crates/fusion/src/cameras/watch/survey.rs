//! How well a site has been surveyed of whose poses nobody has declared a deviation.
//!
//! How well lines meet tells the size of the poses' errors, but by few numbers: two cameras that see
//! one target miss each other by one. Where the poses err by a milliradian that number is likely to
//! be small, and by it alone they would be taken for exact. So three explanations of all lines are
//! compared, with the errors themselves integrated out: the poses are as good as a careful survey's;
//! they are exact; they are exact but for one. A factor is not smaller than the mean over those that
//! are likely.

use nalgebra::{DMatrix, DVector};

use super::memory::ErrorEstimate;
use super::{CLOCK, ERRORS};
use crate::cameras::pose_scale::LEAST_SCALE;
use crate::evidence::ONE_IN_A_HUNDRED;

/// Probability that a site's poses are no better than a careful survey's, before any line: most of
/// which nobody declares a deviation are drawn, or calibrated to less than their noise. With half of
/// it two cameras are taken for exact a little sooner.
const CAREFUL: f64 = 0.1;
/// The same that one camera of a site whose poses are exact is off. With half of it the same: how
/// its lines miss those of two others tells.
const ONE_IS_OFF: f64 = 0.1;
/// Factors (variance) on a careful survey's pose covariance of a camera that is off, each as likely:
/// by 1, 3, 10 and 30 mrad. With the least alone a camera that is off by a degree spoils all.
const OFF_BY: [f64; 4] = [1.0, 10.0, 100.0, 1000.0];
/// Most cameras whose poses are judged together, as the cost grows with the fourth power; they are
/// those known best. Eight have dozens of errors in common. With half of it the same.
const MOST_CAMERAS: usize = 8;

/// One explanation of the lines.
struct Explanation {
    /// The factor on each camera's pose covariance.
    factors: Vec<f64>,
    /// Logarithm of its probability, up to a constant.
    weight: f64,
}

/// The errors of some cameras as the lines tell of them, those of all others integrated out.
struct Told {
    /// Posterior information with priors of unit variance, and its product with the estimate.
    known: DMatrix<f64>,
    pull: DVector<f64>,
}

/// The least factor on the pose covariance of each of these cameras, at most 1; each is given by its
/// first error among all. `None` if the numbers fail.
pub(super) fn least_factors(
    estimate: &ErrorEstimate,
    mut cameras: Vec<usize>,
) -> Option<Vec<(usize, f64)>> {
    // Of a camera of which the lines tell nothing the whole prior is left.
    let left = |first: usize| estimate.covariance.diagonal().rows(first, ERRORS).sum();
    cameras.sort_by(|one, other| left(*one).total_cmp(&left(*other)));
    let (judged, others) = cameras.split_at(cameras.len().min(MOST_CAMERAS));
    let told = Told::of(estimate, judged)?;
    let explanations: Vec<Explanation> = candidates(judged.len())
        .map(|(factors, prior)| {
            let weight = prior.ln() + told.log_likelihood(&factors)?;
            Some(Explanation { factors, weight })
        })
        .collect::<Option<_>>()?;
    let most = explanations.iter().map(|one| one.weight).fold(f64::NEG_INFINITY, f64::max);
    // What is less likely than one in a hundred counts as none.
    let all: f64 = explanations.iter().map(|one| (one.weight - most).exp()).sum();
    let likely: Vec<(&[f64], f64)> = explanations
        .iter()
        .map(|one| (one.factors.as_slice(), (one.weight - most).exp() / all))
        .filter(|(_, probability)| *probability > ONE_IN_A_HUNDRED.exp())
        .collect();
    let all: f64 = likely.iter().map(|(_, probability)| probability).sum();
    let mean = |of: &dyn Fn(&[f64]) -> f64| -> f64 {
        likely.iter().map(|(factors, probability)| of(factors) * probability / all).sum()
    };
    let own = judged.iter().enumerate();
    let own = own.map(|(place, first)| (*first, mean(&|factors| factors[place].min(1.0))));
    // The others are taken to be as good as the best of these.
    let best = mean(&|factors| factors.iter().copied().fold(1.0, f64::min));
    Some(own.chain(others.iter().map(|first| (*first, best))).collect())
}

/// The factors of this many cameras by each explanation, with its probability before any line.
fn candidates(cameras: usize) -> impl Iterator<Item = (Vec<f64>, f64)> {
    let exact = move || vec![LEAST_SCALE; cameras];
    let each = (1.0 - CAREFUL) * ONE_IS_OFF / (cameras * OFF_BY.len()) as f64;
    let but_one = (0..cameras).flat_map(move |off| {
        OFF_BY.into_iter().map(move |factor| {
            let mut factors = exact();
            factors[off] = factor;
            (factors, each)
        })
    });
    [(vec![1.0; cameras], CAREFUL), (exact(), (1.0 - CAREFUL) * (1.0 - ONE_IS_OFF))]
        .into_iter()
        .chain(but_one)
}

impl Told {
    /// For the cameras with these first errors.
    fn of(ErrorEstimate { mean, covariance }: &ErrorEstimate, cameras: &[usize]) -> Option<Self> {
        let rows: Vec<usize> = cameras.iter().flat_map(|first| *first..first + ERRORS).collect();
        let own = DMatrix::from_fn(rows.len(), rows.len(), |i, j| covariance[(rows[i], rows[j])]);
        let known = own.cholesky()?.inverse();
        let pull = &known * DVector::from_fn(rows.len(), |i, _| mean[rows[i]]);
        Some(Self { known, pull })
    }

    /// Log-likelihood of the lines if the cameras' pose errors have these factors (variance) on what
    /// a careful survey leaves, up to a constant: `(h' A^-1 h - ln|A| - ln|D|) / 2`, where D is the
    /// errors' covariance, A the information with D as prior, and h the pull.
    fn log_likelihood(&self, factors: &[f64]) -> Option<f64> {
        let mut with = self.known.clone();
        let mut log_prior = 0.0;
        for error in (0..self.pull.len()).filter(|error| error % ERRORS != CLOCK) {
            let factor = factors[error / ERRORS];
            // In place of the prior of unit variance.
            with[(error, error)] += factor.recip() - 1.0;
            log_prior += factor.ln();
        }
        let root = with.cholesky()?;
        let log_determinant = 2.0 * root.l().diagonal().map(f64::ln).sum();
        let squares = self.pull.dot(&root.solve(&self.pull));
        Some((squares - log_determinant - log_prior) / 2.0)
    }
}

#[cfg(test)]
mod tests {
    use super::super::memory::Memory;
    use super::*;

    /// The least factors of two cameras whose lines have given this information on each pose error,
    /// in units of a careful survey's deviations, and these errors.
    fn of_two(information: f64, found: f64) -> [f64; 2] {
        let mut memory = Memory::default();
        memory.widen(2 * ERRORS);
        for error in (0..2 * ERRORS).filter(|error| error % ERRORS != CLOCK) {
            memory.information[(error, error)] = information;
            memory.pull[error] = information * found;
        }
        let least = least_factors(&memory.estimate().unwrap(), vec![0, ERRORS]).unwrap();
        [least[0].1, least[1].1]
    }

    /// By hand: 0.1 for careful, and for exact but this one 0.9 x 0.1 / 2.
    #[test]
    fn without_a_line_the_explanations_are_as_likely_as_before() {
        let expected = CAREFUL + (1.0 - CAREFUL) * ONE_IS_OFF / 2.0;
        for least in of_two(0.0, 0.0) {
            assert!((least - expected).abs() < 1e-5, "{least} {expected}");
        }
    }

    #[test]
    fn errors_as_of_a_careful_survey_exclude_exact_poses_and_none_excludes_the_survey() {
        assert!(of_two(100.0, 1.0).iter().all(|least| *least > 0.99));
        assert!(of_two(100.0, 0.0).iter().all(|least| *least < 1e-5));
    }

    /// By hand: twelve errors of which the lines have a tenth of the prior's information are as
    /// likely found to be zero as without it of exact poses, and 1.1^-6 times that of careful ones; a
    /// camera that is off is then less likely than one in a hundred.
    #[test]
    fn a_little_information_tells_a_little() {
        let careful = CAREFUL * 1.1_f64.powi(-6);
        let expected = careful / (careful + (1.0 - CAREFUL) * (1.0 - ONE_IS_OFF));
        for least in of_two(0.1, 0.0) {
            assert!((least - expected).abs() < 1e-5, "{least} {expected}");
        }
    }
}
