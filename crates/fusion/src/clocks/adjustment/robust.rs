//! How hard a bearing pulls, by its distance.

/// Squared Mahalanobis distance (two degrees of freedom) beyond which a bearing pulls no harder, in
/// the first descent, when all may be far off. With half of it one in ten of the target's own pulls
/// too little.
const HUBER: f64 = 9.0;
/// Squared distance beyond which a bearing does not pull at all, in the later descents: it is
/// of another object (1 in 60 000 of the target's own lies beyond; with half of it 1 in
/// 245).
pub(super) const OUTLIER: f64 = 22.0;

/// Robust cost: how hard a bearing pulls.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum RobustCost {
    Huber,
    Trimmed,
}

impl RobustCost {
    /// Of a squared distance.
    pub(super) fn of(self, squared: f64) -> BearingCost {
        match self {
            Self::Huber if squared > HUBER => {
                // rho(q) = 2 sqrt(H q) - H, w = rho' = sqrt(H / q).
                let cost = 2.0 * (HUBER * squared).sqrt() - HUBER;
                BearingCost { cost, weight: (HUBER / squared).sqrt() }
            }
            Self::Trimmed if squared > OUTLIER => BearingCost { cost: OUTLIER, weight: 0.0 },
            _ => BearingCost { cost: squared, weight: 1.0 },
        }
    }
}

/// The cost of one bearing.
#[derive(Clone, Copy, Debug)]
pub(super) struct BearingCost {
    pub(super) cost: f64,
    /// Derivative of the cost by the squared distance.
    pub(super) weight: f64,
}
