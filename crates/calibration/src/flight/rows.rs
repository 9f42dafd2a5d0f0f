//! Residuals, each with the unknowns that it depends on and its kind of tails, and what collects
//! them.

use super::noise::Tails;
pub(super) use super::normal::ResidualRow;

/// Residual, in standard deviations, of a label that the trajectory does not reach or whose target
/// lies behind the camera. With half of it the same: by heavy tails its two rows cost 70 in the
/// place of 79.
pub(super) const UNSEEN: f64 = 1e3;

/// Collects rows that share one kind of tails.
pub(super) trait Sink {
    /// Whether it uses the terms of rows, that is the derivatives.
    const TAKES_TERMS: bool = true;

    fn take(&mut self, rows: &[ResidualRow], tails: Tails);
}

/// The summed cost of rows: twice their negative log likelihood (see [`Tails::loss`]).
pub(super) struct CostSum(pub(super) f64);

impl Sink for CostSum {
    /// A sum of costs needs no derivatives.
    const TAKES_TERMS: bool = false;

    fn take(&mut self, rows: &[ResidualRow], tails: Tails) {
        self.0 +=
            tails.loss(rows.iter().map(|(_, residual)| residual * residual).sum(), rows.len());
    }
}
