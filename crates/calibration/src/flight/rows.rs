//! Residuals, each with what it hangs on and how its tails are, and who takes them in.

use super::noise::Tails;
pub(super) use super::normal::Row;

/// What a label counts, in deviations, that the way does not reach or that lies behind its camera.
pub(super) const UNSEEN: f64 = 1e3;

/// Takes rows in that have their tails in common.
pub(super) trait Sink {
    /// Whether it makes anything of what rows hang on.
    const TAKES_TERMS: bool = true;

    fn take(&mut self, rows: &[Row], tails: Tails);
}

/// What rows cost together, in units of log likelihood.
pub(super) struct Cost(pub(super) f64);

impl Sink for Cost {
    const TAKES_TERMS: bool = false;

    fn take(&mut self, rows: &[Row], tails: Tails) {
        self.0 +=
            tails.loss(rows.iter().map(|(_, residual)| residual * residual).sum(), rows.len());
    }
}
