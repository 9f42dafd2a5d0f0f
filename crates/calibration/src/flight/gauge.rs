//! What no label tells of a site: where it is as a whole, which way round, how large, and when.
//!
//! Without a log the equations leave that open, or as good as. Here the site as a whole is held to
//! where the adjustment began, loosely: enough for the equations to be solved, and taken off again
//! from what is said of the datum.

use crossfix_message::Datum;
use nalgebra::{DMatrix, DVector};

use super::datum::Followers;
use super::model::{CLOCK, step_between};
use super::noise::Tails;
use super::rows::{Row, Sink};
use super::state::State;

/// The site as a whole is held by these: shift (m), turn (rad), growth, lateness (s). Rounding is at
/// ten digits below them, far under what cameras are known by beside the datum. The clocks' common
/// rate has a prior of its own.
const HELD: [f64; Datum::WAYS - 1] = [10.0, 10.0, 10.0, 0.1, 0.1, 0.1, 0.1, 1.0];

/// The hold.
#[derive(Clone, Debug)]
pub(super) struct Gauge {
    from: State,
    /// The datum's ways (rows) from the cameras' own unknowns (columns).
    gain: DMatrix<f64>,
}

impl Gauge {
    /// To a state.
    pub(super) fn of(from: &State) -> Option<Self> {
        // A turn counts by what it moves some way off.
        const RANGE_M: f64 = 30.0;
        let followers = Followers::of(from);
        let starts = from.starts();
        let first = from.order().chain();
        let mut weight = DMatrix::zeros(followers.unknowns(), followers.unknowns());
        for start in &starts[..from.cameras.len()] {
            let own = start - first;
            (0..3).for_each(|k| weight[(own + k, own + k)] = RANGE_M * RANGE_M);
            (3..CLOCK + 2).for_each(|k| weight[(own + k, own + k)] = 1.0);
        }
        Some(Self { from: from.clone(), gain: followers.shown(&weight)?.into_gain() })
    }

    pub(super) fn rows(&self, state: &State, sink: &mut impl Sink) {
        let first = state.order().chain();
        let pairs = self.from.cameras.iter().zip(&state.cameras);
        let moved = DVector::from_vec(pairs.flat_map(|(a, b)| step_between(a, b)).collect());
        let as_a_whole = &self.gain * moved;
        for (way, sd) in HELD.iter().enumerate() {
            let gain = self.gain.row(way);
            let terms = gain.iter().enumerate().filter(|(_, by)| **by != 0.0);
            let row: Row =
                (terms.map(|(k, by)| (first + k, by / sd)).collect(), as_a_whole[way] / sd);
            sink.take(&[row], Tails::Normal);
        }
    }

    /// The information on the datum that is the hold's.
    pub(super) fn information() -> DMatrix<f64> {
        let held = |way: usize| HELD.get(way).map_or(0.0, |sd| 1.0 / (sd * sd));
        DMatrix::from_diagonal(&DVector::from_fn(Datum::WAYS, |way, _| held(way)))
    }
}
