//! How fast what is followed may be when it is first seen: it stands still, is slow, or as fast as
//! anything.

/// A case: how fast what is followed may be.
#[derive(Clone, Copy, Debug)]
pub(super) struct SpeedCase {
    /// Standard deviation of the speed, as a share of that of the fastest targets.
    pub(super) share: f64,
    /// Logarithm of its probability, up to a constant.
    pub(super) log_prior: f64,
}

/// The cases, the fastest last. Most of what a camera alone sees stands still: if all of it were
/// taken to be fast, that two things are not would pass for the agreement of two cameras on a
/// speed. Slow flight is one case in eight: if it were as likely as the others, lines of targets
/// that fly at 3 m/s would be taken for those of two objects for ten seconds (real flight 3, two
/// cameras); without it, where one camera of three is turned, the two others find a target of 4
/// m/s half a second later.
pub(super) const SPEEDS: [SpeedCase; 3] = [
    SpeedCase { share: 0.0, log_prior: 0.0 },
    SpeedCase { share: 0.1, log_prior: -1.2 },
    SpeedCase { share: 1.0, log_prior: 0.0 },
];

impl SpeedCase {
    /// Logarithm of the sum of the cases' probabilities.
    pub(super) fn log_all() -> f64 {
        SPEEDS.iter().map(|case| case.log_prior.exp()).sum::<f64>().ln()
    }
}

/// A filter for each case, with the logarithm of its probability (up to a constant).
#[derive(Clone, Debug)]
pub(super) struct BySpeed<F> {
    /// The fastest last.
    cases: Vec<(F, f64)>,
}

impl<F> BySpeed<F> {
    /// These cases, each with the logarithm of its probability; the fastest last.
    pub(super) fn new(cases: impl IntoIterator<Item = (F, f64)>) -> Self {
        Self { cases: cases.into_iter().collect() }
    }

    /// Logarithm of the sum of the cases' probabilities; `None` if there are none.
    pub(super) fn log_total(&self) -> Option<f64> {
        log_sum(self.cases.iter().map(|(_, log)| *log))
    }

    /// The filter of what moves as fast as anything.
    pub(super) fn fastest(&self) -> Option<&F> {
        self.cases.last().map(|(filter, _)| filter)
    }

    /// Logarithm of the probability density of something, over all cases, of which each says its
    /// own; `None` if it fails in all.
    pub(super) fn log_density(&self, density: impl Fn(&F) -> Option<f64>) -> Option<f64> {
        let weighted = self.cases.iter().filter_map(|(filter, log)| Some(log + density(filter)?));
        let weighted: Vec<f64> = weighted.collect();
        Some(log_sum(weighted.iter().copied())? - self.log_total()?)
    }

    /// The filter of each case.
    pub(super) fn filters(&self) -> impl Iterator<Item = &F> {
        self.cases.iter().map(|(filter, _)| filter)
    }

    /// Changes the filter of each case.
    pub(super) fn each(&mut self, mut change: impl FnMut(&mut F)) {
        self.cases.iter_mut().for_each(|(filter, _)| change(filter));
    }

    /// Logarithm of the probability density of something seen, over all cases, of which each says
    /// its own; `None` if it fails in all.
    pub(super) fn see(&mut self, mut density: impl FnMut(&mut F) -> Option<f64>) -> Option<f64> {
        let before = log_sum(self.cases.iter().map(|(_, log)| *log))?;
        let densities: Vec<Option<f64>> =
            self.cases.iter_mut().map(|(filter, _)| density(filter)).collect();
        let weighted = |((_, log), density): (&(F, f64), &Option<f64>)| Some(log + (*density)?);
        // p = sum P_i p_i.
        let after = log_sum(self.cases.iter().zip(&densities).filter_map(weighted))?;
        for ((_, log), density) in self.cases.iter_mut().zip(densities) {
            *log = density.map_or(f64::NEG_INFINITY, |density| *log + density - after);
        }
        Some(after - before)
    }
}

/// Logarithm of the sum of the exponentials; `None` if there are none.
fn log_sum(logs: impl Iterator<Item = f64> + Clone) -> Option<f64> {
    // Relative to the largest, so that the exponentials do not all underflow.
    let most = logs.clone().fold(f64::NEG_INFINITY, f64::max);
    most.is_finite().then(|| most + logs.map(|log| (log - most).exp()).sum::<f64>().ln())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_density_is_the_mean_over_the_cases_and_each_gains_by_its_own() {
        // One case is three times as likely as the other beforehand, and half as likely as that to
        // give what is seen.
        let mut speeds = BySpeed::new([(0.2_f64, 3.0_f64.ln()), (0.4, 0.0)]);
        let density = speeds.see(|density| Some(density.ln())).unwrap();
        assert!((density - (0.75 * 0.2 + 0.25 * 0.4_f64).ln()).abs() < 1e-12);
        // Now they are as 0.15 to 0.10.
        let density = speeds.see(|density| Some(density.ln())).unwrap();
        assert!((density - (0.6 * 0.2 + 0.4 * 0.4_f64).ln()).abs() < 1e-12);
    }

    #[test]
    fn a_case_that_fails_is_out_and_what_fails_in_all_says_nothing() {
        let mut speeds = BySpeed::new([(0.2_f64, 0.0), (0.4, 0.0)]);
        let density = speeds.see(|density| (*density > 0.3).then(|| density.ln())).unwrap();
        assert!((density - 0.2_f64.ln()).abs() < 1e-12);
        let density = speeds.see(|density| Some(density.ln())).unwrap();
        assert!((density - 0.4_f64.ln()).abs() < 1e-12);
        assert_eq!(speeds.see(|_| None), None);
        assert!((speeds.see(|density| Some(density.ln())).unwrap() - 0.4_f64.ln()).abs() < 1e-12);
    }

    /// However unlikely what has been seen is in all cases, they are still told apart.
    #[test]
    fn densities_that_underflow_are_compared() {
        let mut speeds = BySpeed::new([(-2000.0, 0.0), (-2010.0, 0.0)]);
        let density = speeds.see(|log| Some(*log)).unwrap();
        assert!((density - (-2000.0 + 0.5_f64.ln())).abs() < 1e-3, "{density}");
    }
}
