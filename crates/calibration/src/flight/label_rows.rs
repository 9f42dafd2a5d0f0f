//! Rows of a camera's labels: where the trajectory is seen, with the error that successive labels
//! have in common taken out.

use nalgebra::Vector2;

use super::model::{CameraLabels, Label, LabelResidual, MOST_OWN};
use super::noise::{Tails, Whitening};
use super::normal::Derivative;
use super::rows::{ResidualRow, Sink, UNSEEN};
use super::spline::{KNOT_S, SPAN, Weights};
use super::state::{CameraPriors, FlightState};
use super::unknowns::Touched;

/// Labels farther apart in time than this are taken to have independent errors, s. At most the
/// spacing of the spline's knots: a row has room for five coefficients. With half of it labels of 5
/// to 10 per second count as independent, and what they determine is stated too well.
pub(super) const LONGEST_PAIR_S: f64 = KNOT_S;
/// Unknowns of the target's trajectory that two successive labels touch: five coefficients.
const OF_A_PAIR: usize = 3 * (SPAN + 1);

impl FlightState {
    pub(super) fn label_rows<S: Sink>(
        &self,
        index: usize,
        start: usize,
        camera: &CameraLabels,
        priors: &CameraPriors,
        sink: &mut S,
    ) {
        let mut before: Option<(f64, LabelTerms)> = None;
        for label in &camera.labels {
            let placed = self.placed(index, label);
            let Some(placed) = placed else {
                // Counted as far off as can be: otherwise moving the target out of sight would
                // lower the cost.
                sink.take(&[(Vec::new(), UNSEEN), (Vec::new(), UNSEEN)], Tails::Heavy);
                before = None;
                continue;
            };
            let earlier = before.filter(|(time_s, earlier)| {
                label.time_s - time_s < LONGEST_PAIR_S && placed.may_follow(earlier)
            });
            let whitening = priors
                .noise
                .after(earlier.map(|(time_s, _)| label.time_s - time_s), priors.frame_s);
            let earlier = earlier.as_ref().map(|(_, earlier)| earlier);
            let pair = LabelPair { now: &placed, before: earlier, whitening };
            let rows = if S::TAKES_TERMS {
                self.whitened(index, start, &pair)
            } else {
                pair.residual().map(|residual| (Vec::new(), residual))
            };
            sink.take(&rows, Tails::Heavy);
            before = Some((label.time_s, placed));
        }
    }

    /// Derivatives of both axes of a label, in pixels, by the unknowns; `None` where it is not
    /// seen.
    pub(super) fn derivatives(&self, index: usize, label: &Label) -> Option<[Vec<Derivative>; 2]> {
        let placed = self.placed(index, label)?;
        let whitening = Whitening { kept: 0.0, sd_px: 1.0 };
        let alone = LabelPair { now: &placed, before: None, whitening };
        let rows = self.whitened(index, self.starts()[index], &alone);
        Some(rows.map(|(terms, _)| terms))
    }

    fn placed(&self, index: usize, label: &Label) -> Option<LabelTerms> {
        let (Weights { first, place: weights, .. }, seen) = self.see(index, label)?;
        let clock = &self.cameras[index].clock;
        let wander = clock.wander.weights(clock.straight_s(label.time_s));
        let placed = LabelTerms { first, weights, seen, wander };
        placed.touched().fit().then_some(placed)
    }

    /// See [`LabelPair::residual`], with its derivatives by the unknowns.
    fn whitened(&self, index: usize, start: usize, pair: &LabelPair<'_>) -> [ResidualRow; 2] {
        let residuals = pair.residual();
        [0, 1].map(|axis| (self.derivatives_of(index, start, pair, axis), residuals[axis]))
    }

    /// Derivatives of one axis of a label's row by the unknowns.
    fn derivatives_of(
        &self,
        index: usize,
        start: usize,
        pair: &LabelPair<'_>,
        axis: usize,
    ) -> Vec<Derivative> {
        let LabelPair { now, before, whitening: Whitening { kept, sd_px } } = *pair;
        let (order, own) = (self.order(), self.cameras[index].own());
        let first = before.map_or(now.first, |before| before.first);
        let mut chain = [0.0; OF_A_PAIR];
        let mut terms: Vec<Derivative> = Vec::with_capacity(OF_A_PAIR + own + 4);
        let mut own_terms = [0.0; MOST_OWN];
        // Row = (this label - kept x the label before) / sd_px.
        let parts = [Some((now, 1.0)), before.map(|before| (before, -kept))];
        for (part, share) in parts.into_iter().flatten() {
            let share = share / sd_px;
            for (k, weight) in part.weights.iter().enumerate() {
                for dimension in 0..3 {
                    // d(pixel) / d(coefficient) = d(pixel) / d(place) x the spline's weight.
                    chain[3 * (part.first - first + k) + dimension] +=
                        part.seen.by_place[(axis, dimension)] * weight * share;
                }
            }
            for (term, by_own) in own_terms.iter_mut().zip(&part.seen.by_own) {
                *term += by_own[axis] * share;
            }
            // d(pixel) / d(knot) = d(pixel) / d(time) x the knot's weight.
            for (knot, weight) in part.wander {
                let by_knot = part.seen.by_time[axis] * weight * share;
                terms.push((order.wander(knot, index), by_knot));
            }
        }
        // Four coefficients, or five where the two labels lie in neighbouring intervals.
        let used = 3 * (now.first - first + SPAN);
        let of_way = chain[..used].iter().enumerate();
        terms.extend(of_way.map(|(k, value)| (order.way(first + k / 3, k % 3), *value)));
        terms.extend(own_terms[..own].iter().enumerate().map(|(k, value)| (start + k, *value)));
        terms
    }
}

/// A label's residual and the unknowns of the chain that it depends on.
#[derive(Clone, Copy, Debug)]
struct LabelTerms {
    first: usize,
    weights: [f64; SPAN],
    seen: LabelResidual,
    wander: [(usize, f64); 2],
}

/// A label and the one before it, if that counts.
struct LabelPair<'a> {
    now: &'a LabelTerms,
    before: Option<&'a LabelTerms>,
    whitening: Whitening,
}

impl LabelPair<'_> {
    /// The label's residual less the share `kept` of the residual before it, divided by the
    /// deviation of the remainder.
    fn residual(&self) -> [f64; 2] {
        let Whitening { kept, sd_px } = self.whitening;
        let carried = self.before.map_or(Vector2::zeros(), |before| before.seen.residual * kept);
        ((self.now.seen.residual - carried) / sd_px).into()
    }
}

impl LabelTerms {
    /// Whether one row can have the unknowns of this label and of an earlier one: the rolling
    /// shutter and a clock that wanders may have put the later label first.
    fn may_follow(&self, earlier: &Self) -> bool {
        let ahead = self.first.checked_sub(earlier.first);
        // Both labels' unknowns must lie within the band of the chain.
        ahead.is_some_and(|ahead| ahead <= 1) && self.touched().and(earlier.touched()).fit()
    }

    fn touched(&self) -> Touched {
        Touched::by(self.first, self.wander[0].0)
    }
}
