//! Detectors of manoeuvres: they tell when a constant-velocity filter is left behind by its target.

use std::collections::VecDeque;

use nalgebra::Vector3;
use statrs::distribution::{ChiSquared, ContinuousCDF};

/// Kalinov's detector, corrected: compares the running mean of the residuals with a multiple of the
/// measurement's standard deviation, axis by axis (equations 6-7, with the absolute value that the
/// paper's text has and its equation lacks).
///
/// ```
/// use crossfix_filter::SmoothedResidual;
/// use nalgebra::Vector3;
/// let mut detector = SmoothedResidual::new(3, 0.81);
/// assert!(!detector.see(Vector3::new(1.0, -1.0, 0.5)));
/// assert!(!detector.see(Vector3::new(-0.8, 0.9, -0.2)));
/// // The mean of 1.0, -0.8 and -4.0 is beyond 0.81 standard deviations.
/// assert!(detector.see(Vector3::new(-4.0, 0.0, 0.0)));
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct SmoothedResidual {
    window: usize,
    scale: f64,
    residuals: VecDeque<Vector3<f64>>,
}

impl SmoothedResidual {
    /// A detector over a window of this many residuals (at least 1), with the threshold `scale` in
    /// standard deviations of one measurement. Kalinov 2019 uses 0.81, which keeps false alarms few
    /// for windows of 8 and more.
    pub fn new(window: usize, scale: f64) -> Self {
        Self { window: window.max(1), scale, residuals: VecDeque::new() }
    }

    /// Takes a residual, each axis in standard deviations of the measurement, and returns whether
    /// the target manoeuvres. After an alarm the window starts empty again.
    pub fn see(&mut self, residual: Vector3<f64>) -> bool {
        self.residuals.push_back(residual);
        if self.residuals.len() > self.window {
            self.residuals.pop_front();
        }
        // White residuals have a mean of deviation 1 / sqrt(n): 0.81 is 2.3 of these for n = 8.
        let mean = self.residuals.iter().sum::<Vector3<f64>>() / self.residuals.len() as f64;
        let alarm = self.residuals.len() == self.window && mean.amax() > self.scale;
        if alarm {
            self.residuals.clear();
        }
        alarm
    }
}

/// A chi-square test on the sum of the newest squared normalised innovations (NIS).
///
/// ```
/// use crossfix_filter::NormalisedInnovation;
/// let mut detector = NormalisedInnovation::new(2, 1e-4);
/// assert!(!detector.see(2.0, 2));
/// assert!(!detector.see(3.0, 2));
/// // 3 + 40 is far beyond what four degrees of freedom reach once in 10 000.
/// assert!(detector.see(40.0, 2));
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct NormalisedInnovation {
    window: usize,
    false_alarm: f64,
    innovations: VecDeque<(f64, usize)>,
}

impl NormalisedInnovation {
    /// A detector over a window of this many innovations (at least 1), with this probability of a
    /// false alarm.
    pub fn new(window: usize, false_alarm: f64) -> Self {
        Self { window: window.max(1), false_alarm, innovations: VecDeque::new() }
    }

    /// Takes the NIS of a measurement of `dimensions` and returns whether the target manoeuvres.
    /// After an alarm the window starts empty again.
    pub fn see(&mut self, nis: f64, dimensions: usize) -> bool {
        self.innovations.push_back((nis, dimensions));
        if self.innovations.len() > self.window {
            self.innovations.pop_front();
        }
        let sum: f64 = self.innovations.iter().map(|(nis, _)| nis).sum();
        let freedom: usize = self.innovations.iter().map(|(_, dimensions)| dimensions).sum();
        // The sum of independent chi-square variables is chi-square with the sum of their degrees
        // of freedom.
        let threshold = ChiSquared::new(freedom.max(1) as f64)
            .map_or(f64::INFINITY, |distribution| distribution.inverse_cdf(1.0 - self.false_alarm));
        let alarm = self.innovations.len() == self.window && sum > threshold;
        if alarm {
            self.innovations.clear();
        }
        alarm
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    #[test]
    fn an_honest_filter_is_left_alone_as_often_as_promised() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut normal = move || -> f64 { StandardNormal.sample(&mut rng) };
        let mut detector = NormalisedInnovation::new(2, 0.01);
        let runs = 20_000;
        let alarms =
            (0..runs).filter(|_| detector.see(normal().powi(2) + normal().powi(2), 2)).count();
        // Sums over a window of two overlap, and the window starts empty after an alarm: slightly
        // under 1 %.
        let share = alarms as f64 / f64::from(runs);
        assert!((0.006..0.012).contains(&share), "{share}");
    }

    #[test]
    fn a_bias_on_one_axis_is_seen_within_the_window() {
        let mut detector = SmoothedResidual::new(5, 0.81);
        assert!((0..4).all(|_| !detector.see(Vector3::new(0.0, 2.0, 0.0))));
        assert!(detector.see(Vector3::new(0.0, 2.0, 0.0)));
        assert!(!detector.see(Vector3::new(0.0, 2.0, 0.0)), "the window starts anew");
    }
}
