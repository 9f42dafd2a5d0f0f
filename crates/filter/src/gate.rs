/// An ellipsoidal gate: the region in which a measurement falls with a given probability
/// (Lytvynets 2020, eqs. 4.8-4.11: `r' D^-1 r <= l^2`).
///
/// ```
/// use crossfix_filter::Gate;
/// let gate = Gate::with_probability(0.99);
/// assert!(gate.holds(9.2));
/// assert!(!gate.holds(9.3));
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gate {
    threshold: f64,
}

impl Gate {
    /// The gate in two dimensions that contains a true measurement with probability `p`:
    /// `l^2 = -2 ln(1 - p)`. `p` is clamped to [0, 1 - 1e-12].
    pub fn with_probability(p: f64) -> Self {
        Self { threshold: -2.0 * (1.0 - p.clamp(0.0, 1.0 - 1e-12)).ln() }
    }

    /// The threshold `l^2`.
    pub fn threshold(&self) -> f64 {
        self.threshold
    }

    /// The probability with which the gate contains a true measurement of two dimensions.
    pub fn probability(&self) -> f64 {
        1.0 - (-self.threshold / 2.0).exp()
    }

    /// Whether a squared Mahalanobis distance lies inside the gate; a NaN does not.
    pub fn holds(&self, normalised_squared: f64) -> bool {
        normalised_squared <= self.threshold
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probability_and_threshold_agree() {
        assert!((Gate::with_probability(0.95).threshold() - 5.991_464_547).abs() < 1e-8);
        assert!((Gate::with_probability(0.99).threshold() - 9.210_340_372).abs() < 1e-8);
        assert!((Gate::with_probability(0.99).probability() - 0.99).abs() < 1e-12);
        assert!(!Gate::with_probability(1.0).holds(f64::NAN));
    }
}
