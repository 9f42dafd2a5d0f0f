//! How well a site has been surveyed of whose poses nobody has declared a deviation.
//!
//! How well lines meet tells the size of the poses' errors, but by few numbers: two cameras that
//! see one target miss each other by one. Where the poses err by a milliradian that number is
//! likely to be small, and by it alone they would be taken for exact. So explanations of all lines
//! are compared, with the errors themselves integrated out: the poses are as good as a careful
//! survey's, or all worse by a factor; they are exact; they are exact but for one, or one clock is
//! off. A factor is not smaller than the mean over those that are likely, or than 1 if the mean is
//! larger: how far poses are off is learnt from their own lines, and the mean of what all are
//! worse by is the least that their typical factor can be ([`super::super::pose_scale`]).

use nalgebra::{DMatrix, DVector};

use super::memory::ErrorEstimate;
use super::{CLOCK, ERRORS, FREEDOM};
use crate::cameras::pose_scale::{LEAST_SCALE, Surveyed};
use crate::evidence::ONE_IN_A_HUNDRED;

/// Probability, before any line, that the poses of a site are as good as a careful survey's.
/// Sites that declare nothing are drawn ones more often than not, and the lines tell soon. Poses
/// that are all worse by a factor (variance) are less likely by that factor (before all are made to
/// sum to one). With half of it lines that are half as unlikely exclude it.
const CAREFUL_CHANCE: f64 = 0.1;
/// The same that one camera of a site whose poses are exact is off. With half of it lines must be
/// twice as likely by that.
const ONE_OFF_CHANCE: f64 = 0.1;
/// The same that the clock of one camera is off by far more than it says. Without it a clock that
/// is 20 ms off passes for poses that are all off, and tracks are three times as far off; with ten
/// times as much, tracks before exact poses and clocks never claim what these are good for.
const CLOCK_OFF_CHANCE: f64 = 0.01;
/// By how much a clock is off that is off, s, each as likely.
const CLOCK_OFF_BY_S: [f64; 3] = [0.01, 0.1, 1.0];
/// Factors (variance) on a careful survey's pose covariance of one camera that is off, each as
/// likely, or of all: 1, 3, 10 and 30 mrad. With the least alone a camera that is off by a degree
/// spoils all, and of four cameras whose places are off by a metre the three that happen to agree
/// best are taken for exact.
const OFF_BY: [f64; 4] = [1.0, 10.0, 100.0, 1000.0];
/// Most cameras whose poses are judged together, as the cost grows with the fourth power; they are
/// those known best; the errors of all others are a careful survey's. With half of it four cameras,
/// of whose errors lines can tell 17, decide for a site.
const MOST_CAMERAS: usize = 8;

/// One explanation of the lines, with the logarithm of its probability up to a constant.
#[derive(Clone, Copy)]
enum Explanation {
    /// All have this factor (variance) on a careful survey's covariance.
    Alike(f64),
    Exact,
    /// Exact but for the camera in this place, whose lines its pose or its clock shifts by this
    /// factor (variance) on what a careful survey leaves, as far as they do not tell more.
    ButOne(usize, f64),
}

/// A camera that is judged.
#[derive(Clone, Copy, Debug)]
pub(super) struct Judged {
    /// Index of its first error.
    pub(super) first: usize,
    /// Standard deviation of its clock, s: the unit of the clock's error.
    pub(super) clock_sd_s: f64,
}

/// Factors on the variances of one camera's errors.
#[derive(Clone, Copy, Debug)]
struct Factors {
    pose: f64,
    clock: f64,
}

impl Factors {
    /// Those of an exact pose and of a clock that is as good as it says.
    const EXACT: Self = Self { pose: LEAST_SCALE, clock: 1.0 };
}

/// The errors of some cameras as the lines tell of them, those of all others integrated out.
struct Told {
    /// Posterior information with priors of unit variance, and its product with the estimate.
    known: DMatrix<f64>,
    pull: DVector<f64>,
    /// Sum of the squared misses of the lines, in units of their noise, and the number of
    /// coordinates in it.
    squares: f64,
    coordinates: f64,
}

/// What all lines together say of the pose of each of these cameras; each is given by its first
/// error among all. `None` if the numbers fail.
pub(super) fn survey(
    estimate: &ErrorEstimate,
    mut cameras: Vec<Judged>,
) -> Option<Vec<(usize, Surveyed)>> {
    // Of a camera of which the lines tell nothing the whole prior is left.
    let left =
        |Judged { first, .. }: &Judged| estimate.covariance.diagonal().rows(*first, ERRORS).sum();
    cameras.sort_by(|one, other| left(one).total_cmp(&left(other)));
    let (judged, others) = cameras.split_at(cameras.len().min(MOST_CAMERAS));
    let told = Told::of(estimate, judged)?;
    let explanations = told.explanations(judged)?;
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
    let mean = |of: &dyn Fn(Explanation) -> f64| {
        likely().map(|(one, chance)| of(one) * chance).sum::<f64>() / all
    };
    let least = |place: Option<usize>| {
        let factor = |one| match one {
            Explanation::Alike(by) => by,
            Explanation::ButOne(off, by) if Some(off) == place => by,
            Explanation::Exact | Explanation::ButOne(..) => 0.0,
        };
        mean(&factor).clamp(LEAST_SCALE, 1.0)
    };
    let all_worse_by = mean(&|one| match one {
        Explanation::Alike(by) => by,
        Explanation::Exact | Explanation::ButOne(..) => 0.0,
    });
    let said = |Judged { first, .. }: &Judged, least| (*first, Surveyed { least, all_worse_by });
    let own = judged.iter().enumerate().map(|(place, own)| said(own, least(Some(place))));
    // Of any other camera as much is known as before of one of a site that is like these.
    let unknown = (1.0 - CAREFUL_CHANCE) * ONE_OFF_CHANCE / cameras.len() as f64;
    let other = least(None).max(unknown);
    Some(own.chain(others.iter().map(|one| said(one, other))).collect())
}

impl Told {
    /// For these cameras.
    fn of(estimate: &ErrorEstimate, cameras: &[Judged]) -> Option<Self> {
        let ErrorEstimate { mean, covariance, unexplained, coordinates } = estimate;
        let rows: Vec<usize> =
            cameras.iter().flat_map(|Judged { first, .. }| *first..first + ERRORS).collect();
        let own = DMatrix::from_fn(rows.len(), rows.len(), |i, j| covariance[(rows[i], rows[j])]);
        let own_mean = DVector::from_fn(rows.len(), |i, _| mean[rows[i]]);
        let known = own.cholesky()?.inverse();
        let pull = &known * &own_mean;
        // What errors of unit variance explain of the squares, s' A s = h' A^-1 h, counts as missed
        // again.
        let squares = unexplained + pull.dot(&own_mean);
        Some(Self { known, pull, squares, coordinates: *coordinates })
    }

    /// The explanations, each with the logarithm of its probability.
    fn explanations(&self, cameras: &[Judged]) -> Option<Vec<(Explanation, f64)>> {
        let exact = vec![Factors::EXACT; cameras.len()];
        let but_one = (1.0 - CAREFUL_CHANCE) / cameras.len() as f64;
        let all_exact = (1.0 - CAREFUL_CHANCE) * (1.0 - ONE_OFF_CHANCE - CLOCK_OFF_CHANCE);
        let mut explanations =
            vec![(Explanation::Exact, self.log_likelihood(&exact)? + all_exact.ln())];
        for pose in OFF_BY {
            let alike = vec![Factors { pose, clock: 1.0 }; cameras.len()];
            let chance = CAREFUL_CHANCE / pose;
            explanations
                .push((Explanation::Alike(pose), self.log_likelihood(&alike)? + chance.ln()));
        }
        for (off, camera) in cameras.iter().enumerate() {
            // How far a pose is off that is off alone is learnt from its own lines.
            let poses = OFF_BY.map(|pose| (Factors { pose, clock: 1.0 }, 1.0));
            let clocks = CLOCK_OFF_BY_S.map(|by_s| {
                let clock = (by_s / camera.clock_sd_s).powi(2).max(1.0);
                let shift = clock * self.clock_over_pose(off);
                (Factors { clock, ..Factors::EXACT }, shift.min(1.0))
            });
            let sizes: [(&[_], f64); 2] = [(&poses, ONE_OFF_CHANCE), (&clocks, CLOCK_OFF_CHANCE)];
            for (sizes, chance) in sizes {
                explanations.push(self.but_one(off, sizes, &exact, but_one * chance)?);
            }
        }
        Some(explanations)
    }

    /// That one camera is off and all others are exact, by the sum over the sizes of its errors,
    /// each as likely; with each the factor on its pose that this stands for.
    fn but_one(
        &self,
        off: usize,
        sizes: &[(Factors, f64)],
        exact: &[Factors],
        chance: f64,
    ) -> Option<(Explanation, f64)> {
        let logs = sizes.iter().map(|(own, _)| {
            let mut all = exact.to_vec();
            all[off] = *own;
            self.log_likelihood(&all)
        });
        // A size whose numbers fail has no weight.
        let logs: Vec<f64> = logs.map(|log| log.unwrap_or(f64::NEG_INFINITY)).collect();
        let most = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> = logs.iter().map(|log| (log - most).exp()).collect();
        let all: f64 = weights.iter().sum();
        let factor: f64 = weights.iter().zip(sizes).map(|(weight, (_, by))| weight * by).sum();
        let log = most + (all / sizes.len() as f64).ln() + chance.ln();
        Some((Explanation::ButOne(off, factor / all), log))
    }

    /// How much a deviation of a camera's clock shifts its lines, relative to what one of the six
    /// errors of its pose does (variance): by what the lines tell of them.
    fn clock_over_pose(&self, camera: usize) -> f64 {
        let told = |error: usize| {
            let error = ERRORS * camera + error;
            (self.known[(error, error)] - 1.0).max(0.0)
        };
        let pose = (0..CLOCK).map(told).sum::<f64>() / CLOCK as f64;
        if pose > 0.0 { told(CLOCK) / pose } else { 0.0 }
    }

    /// Log-likelihood of the lines if the cameras' errors have these factors (variance) on what a
    /// careful survey and the clocks leave, up to a constant, with A the information with the
    /// errors' covariance D as prior, h the pull, and z' z the squares of n coordinates:
    /// `-((nu + n) ln f + (nu + z' z - h' A^-1 h) / f + ln|A| + ln|D|) / 2`. The variance of the
    /// lines' noise is f times as reported, the likeliest factor, at least 1, with nu coordinates
    /// beforehand, and D is in units of it: lines of other targets, or of a clock that is seconds
    /// off, are noise and no evidence of large errors, and a single draw tells little. That D alone
    /// stays as it is was tried: lines that miss each other by much have little weight already
    /// (Student's t), and of four cameras that are all off by a metre three were exact again.
    fn log_likelihood(&self, factors: &[Factors]) -> Option<f64> {
        let mut with = self.known.clone();
        let mut log_prior = 0.0;
        for error in 0..self.pull.len() {
            let Factors { pose, clock } = factors[error / ERRORS];
            let factor = if error % ERRORS == CLOCK { clock } else { pose };
            // In place of the prior of unit variance.
            with[(error, error)] += factor.recip() - 1.0;
            log_prior += factor.ln();
        }
        let root = with.cholesky()?;
        let log_determinant = 2.0 * root.l().diagonal().map(f64::ln).sum();
        let missed = (self.squares - self.pull.dot(&root.solve(&self.pull))).max(0.0);
        let (squares, coordinates) = (FREEDOM + missed, FREEDOM + self.coordinates);
        let noise = (squares / coordinates).max(1.0);
        let fit = coordinates * noise.ln() + squares / noise;
        Some(-(fit + log_determinant + log_prior) / 2.0)
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
            let coordinates = if *information > 0.0 { 6.0 } else { 0.0 };
            memory.add_squares(6.0 * information * found.powi(2), coordinates);
        }
        let judged = (0..cameras.len())
            .map(|place| Judged { first: ERRORS * place, clock_sd_s: 1e-4 })
            .collect();
        let mut found = survey(&memory.estimate().unwrap(), judged).unwrap();
        found.sort_by_key(|(first, _)| *first);
        found.into_iter().map(|(_, found)| found.least).collect()
    }

    /// By hand: 0.1 for careful, and for exact but this one 0.9 x 0.1 / n; that all are worse, or a
    /// clock is off, is less likely than one in a hundred.
    #[test]
    fn without_a_line_the_explanations_are_as_likely_as_before() {
        for cameras in [2, 3, 8] {
            let one_off = (1.0 - CAREFUL_CHANCE) * ONE_OFF_CHANCE / f64::from(cameras);
            let all = 1.0 - (1.0 - CAREFUL_CHANCE) * CLOCK_OFF_CHANCE;
            for least in least(&vec![[0.0; 2]; cameras as usize]) {
                let expected = (CAREFUL_CHANCE + one_off) / all;
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
        let exact = (1.0 - CAREFUL_CHANCE) * (1.0 - ONE_OFF_CHANCE - CLOCK_OFF_CHANCE);
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

    /// What the lines of two cameras with these errors of their poses (in deviations of a careful
    /// survey) and their clocks (in units of 0.1 ms) say, with this many coordinates on each error,
    /// and with a factor on the variance of their noise.
    fn said(cameras: [[f64; 2]; 2], coordinates: f64, noise: f64) -> Vec<Surveyed> {
        let mut memory = Memory::default();
        memory.widen(2 * ERRORS);
        let all = coordinates * 2.0 * ERRORS as f64;
        let mut squares = noise * all;
        for (place, [pose, clock]) in cameras.into_iter().enumerate() {
            // A pose's deviation shifts a line by ten times its noise, 0.1 ms by a tenth of it.
            let mut told = SVector::<f64, ERRORS>::repeat(100.0 * coordinates);
            told[CLOCK] = 0.01 * coordinates;
            let mut found = SVector::<f64, ERRORS>::repeat(pose);
            found[CLOCK] = clock;
            memory.add_information([ERRORS * place; 2], SMatrix::from_diagonal(&told));
            memory.add_pull(ERRORS * place, told.component_mul(&found));
            squares += told.dot(&found.component_mul(&found));
        }
        memory.add_squares(squares, all);
        let judged = [0, ERRORS].map(|first| Judged { first, clock_sd_s: 1e-4 });
        let mut found = survey(&memory.estimate().unwrap(), judged.to_vec()).unwrap();
        found.sort_by_key(|(first, _)| *first);
        found.into_iter().map(|(_, found)| found).collect()
    }

    #[test]
    fn poses_that_are_all_off_are_no_exact_ones_but_one() {
        let found = said([[10.0, 0.0], [-10.0, 0.0]], 10.0, 1.0);
        assert!(found.iter().all(|of| of.least > 0.99), "{found:?}");
        // Ten deviations of a careful survey are a hundred of its variance.
        assert!(found.iter().all(|of| (30.0..300.0).contains(&of.all_worse_by)), "{found:?}");
        // Misses as large that come and go are noise.
        let found = said([[0.1, 0.0], [-0.1, 0.0]], 10.0, 10_000.0);
        assert!(found.iter().all(|of| of.least < 0.2), "{found:?}");
    }

    #[test]
    fn a_clock_that_is_off_leaves_the_other_camera_exact() {
        let found = said([[0.0, 300.0], [0.0, 0.0]], 10.0, 1.0);
        // 30 ms shift its lines by three deviations of a careful survey's pose.
        assert!(found[0].least > 0.99 && found[1].least < 1e-5, "{found:?}");
        assert!(found.iter().all(|of| of.all_worse_by < 1e-3), "{found:?}");
    }
}
