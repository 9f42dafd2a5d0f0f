//! How well a site has been surveyed of whose poses nobody has declared a deviation.
//!
//! How well lines meet tells the size of the poses' errors, but by few numbers: two cameras that
//! see one target miss each other by one. Where the poses err by a milliradian that number is
//! likely to be small, and by it alone they would be taken for exact. So three explanations of all
//! lines are compared, with the errors themselves integrated out: the poses are as good as a
//! careful survey's; they are exact; they are exact but for one. A factor is not smaller than the
//! mean over those that are likely.

use nalgebra::{DMatrix, DVector};

use super::memory::ErrorEstimate;
use super::{CLOCK, ERRORS};
use crate::cameras::pose_scale::LEAST_SCALE;
use crate::evidence::ONE_IN_A_HUNDRED;

/// Probability, before any line, that the poses of a site are no better than a careful survey's.
/// Sites that declare nothing are drawn ones more often than not, and the lines tell soon. With
/// half of it lines that are half as unlikely exclude it.
const CAREFUL_CHANCE: f64 = 0.1;
/// The same that one camera of a site whose poses are exact is off. With half of it lines must be
/// twice as likely by that.
const ONE_OFF_CHANCE: f64 = 0.1;
/// Factors (variance) on a careful survey's pose covariance of a camera that is off, each as
/// likely: by 1, 3, 10 and 30 mrad. With the least alone a camera that is off by a degree spoils
/// all.
const OFF_BY: [f64; 4] = [1.0, 10.0, 100.0, 1000.0];
/// Most cameras whose poses are judged together, as the cost grows with the fourth power; they are
/// those known best. With half of it four cameras, of whose errors lines can tell 17, decide for a
/// site.
const MOST_CAMERAS: usize = 8;

/// One explanation of the lines, with the logarithm of its probability up to a constant.
#[derive(Clone, Copy)]
enum Explanation {
    Careful,
    Exact,
    /// Exact but for the camera in this place.
    ButOne(usize),
}

/// The errors of some cameras as the lines tell of them, those of all others integrated out.
struct Told {
    /// Posterior information with priors of unit variance, and its product with the estimate.
    known: DMatrix<f64>,
    pull: DVector<f64>,
}

/// The least factor on the pose covariance of each of these cameras, at most 1; each is given by
/// its first error among all. `None` if the numbers fail.
pub(super) fn least_factors(
    estimate: &ErrorEstimate,
    mut cameras: Vec<usize>,
) -> Option<Vec<(usize, f64)>> {
    // Of a camera of which the lines tell nothing the whole prior is left.
    let left = |first: usize| estimate.covariance.diagonal().rows(first, ERRORS).sum();
    cameras.sort_by(|one, other| left(*one).total_cmp(&left(*other)));
    let (judged, others) = cameras.split_at(cameras.len().min(MOST_CAMERAS));
    let told = Told::of(estimate, judged)?;
    let explanations = told.explanations(judged.len())?;
    let most = explanations.iter().map(|(_, log)| *log).fold(f64::NEG_INFINITY, f64::max);
    let all: f64 = explanations.iter().map(|(_, log)| (log - most).exp()).sum();
    if !all.is_finite() {
        return None;
    }
    // What is less likely than one in a hundred counts as none.
    let likely = || {
        let chances = explanations.iter().map(|(one, log)| (*one, (log - most).exp() / all));
        chances.filter(|(_, chance)| *chance > ONE_IN_A_HUNDRED.exp())
    };
    let all: f64 = likely().map(|(_, chance)| chance).sum();
    let factor = |chance: f64| LEAST_SCALE.max(chance / all);
    let of = |place: Option<usize>| {
        let is_off = |one| match one {
            Explanation::Careful => true,
            Explanation::Exact => false,
            Explanation::ButOne(off) => Some(off) == place,
        };
        likely().filter(|(one, _)| is_off(*one)).map(|(_, chance)| chance).sum::<f64>()
    };
    let own = judged.iter().enumerate().map(|(place, first)| (*first, factor(of(Some(place)))));
    // Of any other camera as much is known as before of one of a site that is like these.
    let unknown = (1.0 - CAREFUL_CHANCE) * ONE_OFF_CHANCE / cameras.len() as f64;
    let other = factor(of(None)).max(unknown);
    Some(own.chain(others.iter().map(|first| (*first, other))).collect())
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

    /// The explanations, each with the logarithm of its probability.
    fn explanations(&self, cameras: usize) -> Option<Vec<(Explanation, f64)>> {
        let exact = vec![LEAST_SCALE; cameras];
        let careful = self.log_likelihood(&vec![1.0; cameras])? + CAREFUL_CHANCE.ln();
        let all_exact = (1.0 - CAREFUL_CHANCE) * (1.0 - ONE_OFF_CHANCE);
        let all_exact = self.log_likelihood(&exact)? + all_exact.ln();
        let each = (1.0 - CAREFUL_CHANCE) * ONE_OFF_CHANCE / (cameras * OFF_BY.len()) as f64;
        let mut explanations =
            vec![(Explanation::Careful, careful), (Explanation::Exact, all_exact)];
        for off in 0..cameras {
            let logs = OFF_BY.map(|by| {
                let mut factors = exact.clone();
                factors[off] = by;
                self.log_likelihood(&factors)
            });
            let most = logs.into_iter().flatten().fold(f64::NEG_INFINITY, f64::max);
            let sizes: f64 = logs.into_iter().flatten().map(|log| (log - most).exp()).sum();
            explanations.push((Explanation::ButOne(off), most + sizes.ln() + each.ln()));
        }
        Some(explanations)
    }

    /// Log-likelihood of the lines if the cameras' pose errors have these factors (variance) on
    /// what a careful survey leaves, up to a constant: `(h' A^-1 h - ln|A| - ln|D|) / 2`, where D
    /// is the errors' covariance, A the information with D as prior, and h the pull.
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
    use nalgebra::{SMatrix, SVector};

    use super::super::memory::Memory;
    use super::*;

    /// The least factors of cameras whose lines have given this information on each error of their
    /// poses, in units of a careful survey's deviations, and these errors.
    fn least(cameras: &[[f64; 2]]) -> Vec<f64> {
        let mut memory = Memory::default();
        memory.widen(cameras.len() * ERRORS);
        for (place, [information, found]) in cameras.iter().enumerate() {
            let mut of_pose = SVector::<f64, ERRORS>::repeat(*information);
            of_pose[CLOCK] = 0.0;
            memory.add_information([ERRORS * place; 2], SMatrix::from_diagonal(&of_pose));
            memory.add_pull(ERRORS * place, of_pose * *found);
        }
        let firsts = (0..cameras.len()).map(|place| ERRORS * place).collect();
        let mut least = least_factors(&memory.estimate().unwrap(), firsts).unwrap();
        least.sort_by_key(|(first, _)| *first);
        least.into_iter().map(|(_, least)| least).collect()
    }

    /// By hand: 0.1 for careful, and for exact but this one 0.9 x 0.1 / n.
    #[test]
    fn without_a_line_the_explanations_are_as_likely_as_before() {
        for cameras in [2, 3, 8] {
            let one_off = (1.0 - CAREFUL_CHANCE) * ONE_OFF_CHANCE / f64::from(cameras);
            for least in least(&vec![[0.0; 2]; cameras as usize]) {
                let expected = CAREFUL_CHANCE + one_off;
                assert!((least - expected).abs() < 1e-5, "{cameras}: {least} {expected}");
            }
        }
    }

    #[test]
    fn errors_as_of_a_careful_survey_exclude_exact_poses_and_none_excludes_the_survey() {
        assert!(least(&[[100.0, 1.0]; 2]).iter().all(|least| *least > 0.99));
        assert!(least(&[[100.0, 0.0]; 3]).iter().all(|least| *least < 1e-5));
    }

    /// By hand: twelve errors of which the lines have a tenth of the prior's information, and which
    /// are found to be zero: of careful poses that is 1.1^-6 times as likely as of exact ones, and
    /// with one camera off (1 + 0.1 f)^-3 times, in the mean over f.
    #[test]
    fn a_little_information_tells_a_little() {
        let careful = CAREFUL_CHANCE * 1.1_f64.powi(-6);
        let exact = (1.0 - CAREFUL_CHANCE) * (1.0 - ONE_OFF_CHANCE);
        let off: f64 = OFF_BY.iter().map(|by| (1.0 + 0.1 * by).powi(-3)).sum::<f64>() / 4.0;
        let one_off = (1.0 - CAREFUL_CHANCE) * ONE_OFF_CHANCE / 2.0 * off;
        let expected = (careful + one_off) / (careful + exact + 2.0 * one_off);
        for least in least(&[[0.1, 0.0]; 2]) {
            assert!((least - expected).abs() < 1e-5, "{least} {expected}");
        }
    }

    #[test]
    fn a_camera_that_is_off_leaves_the_others_exact_and_one_without_lines_is_not_taken_for_exact() {
        let found = least(&[[100.0, 0.0], [100.0, 10.0], [100.0, 0.0], [0.0, 0.0]]);
        assert!(found[0] < 1e-5 && found[1] > 0.99 && found[2] < 1e-5, "{found:?}");
        let found = least(&[[100.0, 0.0], [100.0, 0.0], [0.0, 0.0]]);
        assert!(found[0] < 1e-5 && found[1] < 1e-5 && found[2] > 0.03, "{found:?}");
        // Eight are judged; the ninth has no line.
        let mut nine = vec![[100.0, 0.0]; 9];
        nine[0] = [0.0, 0.0];
        let found = least(&nine);
        assert!(found[0] > 0.005 && found[1..].iter().all(|least| *least < 1e-5), "{found:?}");
    }
}
