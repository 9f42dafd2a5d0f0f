//! How much evidence is enough, as logarithms of likelihood ratios.

/// One explanation is taken for the truth if it is likelier than every other by this: 3000 times.
/// With half of it (50 times) ghosts are confirmed, targets are found again in clutter, and a host
/// that slept passes for clocks that have stepped.
pub(crate) const BEYOND_DOUBT: f64 = 8.0;
/// An explanation that is a hundred times less likely than its opposite is given up; nothing that
/// goes without saying, as that a camera detects what it should see, is surer than this. With half
/// of it (ten times) young targets that are missed a few times have to be found again, and a single
/// miss counts as a loss.
pub(crate) const ONE_IN_A_HUNDRED: f64 = -4.6;
