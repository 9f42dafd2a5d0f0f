//! The gauge: what no label tells of a site, that is where it is as a whole, its orientation, its
//! size and its time.
//!
//! Without a log the equations leave these open, or nearly so. Here the site as a whole is loosely
//! constrained to where the adjustment began: enough for the equations to be solved; this
//! information is subtracted again from what is stated of the datum.

use crossfix_message::Datum;
use nalgebra::{DMatrix, DVector};

use super::datum::Followers;
use super::model::{CLOCK, step_between};
use super::noise::Tails;
use super::rows::{ResidualRow, Sink};
use super::state::FlightState;

/// Deviations of the constraint on the site as a whole: shift (m), turn (rad), growth, lateness
/// (s). Rounding errors are ten digits below them, far under the accuracy of the cameras beside the
/// datum. The clocks' common rate has a prior of its own. With half of them the rough start pulls
/// four times as hard against what a survey says.
const LOOSE_SD: [f64; Datum::WAYS - 1] = [10.0, 10.0, 10.0, 0.1, 0.1, 0.1, 0.1, 1.0];

/// The constraint.
#[derive(Clone, Debug)]
pub(super) struct Gauge {
    from: FlightState,
    /// The datum's components (rows) from the cameras' own unknowns (columns).
    gain: DMatrix<f64>,
}

impl Gauge {
    /// Constraint to a state.
    pub(super) fn of(from: &FlightState) -> Option<Self> {
        /// A turn is weighted by how far it moves a point at this range, m. With half of it the
        /// same: it only decides how much of a difference counts as a turn.
        const RANGE_M: f64 = 30.0;
        let followers = Followers::of(from);
        let starts = from.starts();
        let first = from.order().chain();
        let mut weight = DMatrix::zeros(followers.unknowns(), followers.unknowns());
        for start in &starts[..from.cameras.len()] {
            let own = start - first;
            // rad^2 to m^2, so that turns and shifts are weighed alike.
            (0..3).for_each(|k| weight[(own + k, own + k)] = RANGE_M * RANGE_M);
            (3..CLOCK + 2).for_each(|k| weight[(own + k, own + k)] = 1.0);
        }
        Some(Self { from: from.clone(), gain: followers.estimator(&weight)?.into_gain() })
    }

    pub(super) fn rows(&self, state: &FlightState, sink: &mut impl Sink) {
        let first = state.order().chain();
        let pairs = self.from.cameras.iter().zip(&state.cameras);
        let moved = DVector::from_vec(pairs.flat_map(|(a, b)| step_between(a, b)).collect());
        // The site's part of the cameras' movements, which alone is constrained.
        let as_a_whole = &self.gain * moved;
        for (way, sd) in LOOSE_SD.iter().enumerate() {
            let gain = self.gain.row(way);
            let terms = gain.iter().enumerate().filter(|(_, by)| **by != 0.0);
            let row: ResidualRow =
                (terms.map(|(k, by)| (first + k, by / sd)).collect(), as_a_whole[way] / sd);
            sink.take(&[row], Tails::Normal);
        }
    }

    /// Information on the datum that comes from the constraint.
    pub(super) fn information() -> DMatrix<f64> {
        let weight = |way: usize| LOOSE_SD.get(way).map_or(0.0, |sd| 1.0 / (sd * sd));
        DMatrix::from_diagonal(&DVector::from_fn(Datum::WAYS, |way, _| weight(way)))
    }
}
