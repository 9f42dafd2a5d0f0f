//! How far a place may lie from where the shift, roll and zoom of the whole scene put it: for the
//! comparison of what is followed with what was there before (`identity.rs`), and for what the
//! scene looks like to a search (`empty_scene.rs`).

/// Share of a camera's turn by which a place may have moved more or less than the turn that was
/// found: one shift describes a turn, but it moves the edges of a picture of 60 degrees by a third
/// more than its middle, `1 + tan^2 30`, and the shift is a mean of both. Of eight drawn targets
/// before a pan identity followed 74 % of the images with it, with twice of it the same and with
/// half of it 73; with none of it 54, and a mast was shown for the target for up to six seconds.
const UNEVEN_TURN: f64 = 0.2;
/// Farthest that a place is looked for from where it should be, px: that of a turn by 80 px. With
/// twice as much a comparison costs four times as much; half of it is too little for a turn of more
/// than 40 px.
const MOST_UNEVEN_PX: f64 = 16.0;

/// How far from where a turn puts it a place is looked for, px along each axis. After a turn by
/// more than 80 px it may be farther.
pub(crate) fn reach_px(turn: [f64; 2]) -> f64 {
    (UNEVEN_TURN * turn[0].hypot(turn[1])).min(MOST_UNEVEN_PX)
}
