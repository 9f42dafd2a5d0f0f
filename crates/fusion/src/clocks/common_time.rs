//! What all clocks of a site say together, of which some are worse than is said of them.

/// The share of clocks that are not as good as is said of them: a source of time lost, a latency unknown. With half
/// of it one of three that is off by four of its deviations moves the common time by a third less.
const LIARS: f64 = 0.01;
/// How far off those are, s.
const LIARS_SD_S: f64 = 1.0;
/// Steps to the common time: the shares settle in three or four.
const STEPS: usize = 10;

/// Where a clock stands against any one of them, s, and the variance reported of it, s^2.
#[derive(Clone, Copy, Debug)]
pub(super) struct Standing {
    pub(super) offset: f64,
    pub(super) variance: f64,
}

impl Standing {
    /// The variance that is believed of a clock that is off by this from what all say, s^2: it is as good as it
    /// says, or one of the others.
    pub(super) fn believed(self) -> f64 {
        if self.variance <= 0.0 {
            return 0.0;
        }
        let liars = LIARS_SD_S.powi(2).max(self.variance);
        let odds = LIARS / (1.0 - LIARS) * (self.variance / liars).sqrt();
        let honest = (1.0 + odds * (self.offset.powi(2) / self.variance / 2.0).exp()).recip();
        (honest / self.variance + (1.0 - honest) / liars).recip()
    }
}

/// How much each clock says of true time: its share, and the variance that is believed of it, s^2 (expectation and
/// maximisation, from the clocks' median on). Clocks that are right by definition say all.
pub(super) fn common_time(clocks: &[Standing]) -> Vec<(f64, f64)> {
    if clocks.is_empty() {
        return Vec::new();
    }
    let right = clocks.iter().filter(|clock| clock.variance <= 0.0).count();
    if right > 0 {
        let share = |clock: &Standing| if clock.variance <= 0.0 { 1.0 / right as f64 } else { 0.0 };
        return clocks.iter().map(|clock| (share(clock), clock.variance)).collect();
    }
    // Summed by where they stand and not by the cameras' names: rounding decides nothing.
    let mut order: Vec<usize> = (0..clocks.len()).collect();
    order.sort_by(|&i, &k| clocks[i].offset.total_cmp(&clocks[k].offset));
    let mut common =
        (clocks[order[order.len() / 2]].offset + clocks[order[(order.len() - 1) / 2]].offset) / 2.0;
    let mut weights = Vec::new();
    for _ in 0..STEPS {
        let believed = |clock: &Standing| Standing { offset: clock.offset - common, ..*clock }.believed();
        weights = clocks.iter().map(|clock| (believed(clock).recip(), believed(clock))).collect();
        let total: f64 = order.iter().map(|&i| weights[i].0).sum();
        weights.iter_mut().for_each(|(share, _)| *share /= total);
        common = order.iter().map(|&i| weights[i].0 * clocks[i].offset).sum();
    }
    weights
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What clocks of so many deviations say together that stand so, and its standard deviation, s.
    fn common(clocks: &[(f64, f64)]) -> (f64, f64) {
        let clocks: Vec<Standing> =
            clocks.iter().map(|(offset, sd)| Standing { offset: *offset, variance: sd.powi(2) }).collect();
        let weights = common_time(&clocks);
        let offset = weights.iter().zip(&clocks).map(|((share, _), clock)| share * clock.offset).sum();
        let variance: f64 = weights.iter().map(|(share, variance)| share.powi(2) * variance).sum();
        (offset, variance.sqrt())
    }

    #[test]
    fn clocks_that_are_as_good_as_they_say_count_by_their_variances() {
        let (offset, sd) = common(&[(1e-3, 1e-3), (-2e-3, 2e-3), (0.0, 1e-3)]);
        let information = 1e6 + 0.25e6 + 1e6;
        assert!((offset - (1e3 - 500.0) / information).abs() < 1e-6, "{offset}");
        assert!((sd - 1.0 / f64::sqrt(information)).abs() < 1e-6, "{sd}");
        assert_eq!(common(&[(0.4, 0.0), (0.0, 1e-3)]), (0.4, 0.0), "right by definition");
    }

    #[test]
    fn one_liar_of_three_does_not_move_the_common_time() {
        for off in [0.02, 0.05, 1.0, -30.0] {
            let (offset, sd) = common(&[(off, 2e-3), (0.0, 2e-3), (0.3e-3, 2e-3)]);
            assert!((offset - 0.15e-3).abs() < 0.1e-3, "{off}: {offset}");
            assert!((sd - 2e-3 / f64::sqrt(2.0)).abs() < 0.1e-3, "{off}: {sd}");
        }
    }

    #[test]
    fn of_two_that_disagree_neither_is_believed() {
        let (offset, sd) = common(&[(0.0, 2e-3), (0.05, 2e-3)]);
        assert!((offset - 0.025).abs() < 1e-9, "{offset}");
        assert!(sd > 0.025, "the truth may be at either: {sd}");
    }
}
