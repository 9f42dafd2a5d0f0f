//! How hard a bearing pulls, by its distance.

/// Squared Mahalanobis distance (two degrees of freedom) beyond which a bearing pulls no harder, in
/// the first descent, when all may be far off. With half of it one in ten of the target's own pulls
/// too little.
const HUBER: f64 = 9.0;
/// Squared distance beyond which a bearing does not pull at all, in the later descents: it is
/// of another object (1 in 60 000 of the target's own lies beyond; with half of it 1 in
/// 245).
pub(super) const OUTLIER: f64 = 22.0;

/// Robust loss: how hard a bearing pulls.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Loss {
    Huber,
    Trimmed,
}

impl Loss {
    /// Of a squared distance.
    pub(super) fn of(self, squared: f64) -> BearingLoss {
        match self {
            Self::Huber if squared > HUBER => {
                // rho(q) = 2 sqrt(H q) - H, w = rho' = sqrt(H / q).
                let cost = 2.0 * (HUBER * squared).sqrt() - HUBER;
                BearingLoss { cost, weight: (HUBER / squared).sqrt() }
            }
            Self::Trimmed if squared > OUTLIER => BearingLoss { cost: OUTLIER, weight: 0.0 },
            _ => BearingLoss { cost: squared, weight: 1.0 },
        }
    }
}

/// The loss of one bearing.
#[derive(Clone, Copy, Debug)]
pub(super) struct BearingLoss {
    pub(super) cost: f64,
    /// Derivative of the cost by the squared distance.
    pub(super) weight: f64,
}
