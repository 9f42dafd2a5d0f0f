//! Estimation of the noise, the clocks' wander and the target's jerk beside the unknowns, round by
//! round.

use nalgebra::Vector2;

use super::adjustment::{self, AdjustedFlight, NEARLY_SETTLED, SETTLED};
use super::normal::Derivative;
use super::spline::{KNOT_S, THIRD_DIFFERENCE};
use super::state::{CameraPriors, Flight, FlightState, Priors};
use crate::label_noise::LabelNoise;

/// Rounds in which deviations and powers are estimated beside the unknowns. With half of it a
/// steady clock's wander may not have come down from the large value that it begins with.
const ROUNDS: usize = 6;
/// Usual value of a clock's wander, s^2/s: 0.03 ms after a second. With half of it clocks of which
/// labels say little are taken to be 1.4 times steadier.
const USUAL_WANDER: f64 = 1e-9;
/// The usual value counts as this many steps that were observed. With half as many chance decides
/// where labels show few.
const USUAL_STEPS: f64 = 2.0;
/// Least wander, s^2/s: a good crystal's. With half of it the same.
const LEAST_WANDER: f64 = 1e-12;
/// Extrapolation of the wander from round to round: the value found is multiplied again by the
/// factor by which it changed, but by this at most. With half of it the rounds end before a value
/// that is far off is reached; with twice as much they may overshoot.
const MOST_AHEAD: f64 = 3.0;

/// Adjusts, finds the noise in what is left, and adjusts again.
pub(super) fn settle(
    flight: &Flight<'_>,
    mut priors: Priors,
    mut state: FlightState,
) -> Option<(AdjustedFlight, Priors)> {
    let mut adjusted = None;
    for round in 0..ROUNDS {
        let is_last = round + 1 == ROUNDS;
        let settled = if is_last { SETTLED } else { NEARLY_SETTLED };
        let next = adjustment::adjust(flight, &priors, state, settled)?;
        state = next.state.clone();
        if !is_last {
            // After the last round nothing is learnt: state and covariance belong to the priors
            // that are returned.
            priors = learnt(flight, &next, &priors);
            tracing::debug!(
                "round {round}: cost {:.1}, jerk {:.2} m^2/s^5",
                next.cost,
                priors.jerk
            );
        }
        adjusted = Some(next);
    }
    Some((adjusted?, priors))
}

/// Priors with the noise, wander and jerk that an adjustment shows.
fn learnt(flight: &Flight<'_>, adjusted: &AdjustedFlight, priors: &Priors) -> Priors {
    let state = &adjusted.state;
    let mut cameras = Vec::new();
    for (index, camera) in state.cameras.iter().enumerate() {
        let residuals = residuals(flight, state, index);
        let frame_s = priors.cameras[index].frame_s;
        let caution = priors.cameras[index].noise.caution(frame_s);
        let explained = explained(flight, adjusted, index, caution);
        let noise = LabelNoise::of(&residuals, explained, frame_s);
        // Where the trajectory is free, one camera's noise may be found to be next to nothing.
        let before = flight.survey.known(&flight.cameras[index].name).map(|known| known.noise);
        let noise = before.filter(|before| before.sd_px() > noise.sd_px()).unwrap_or(noise);
        let wander = wander(adjusted, index, priors.cameras[index].wander);
        tracing::debug!(
            "camera `{}`: noise {:.3} px and {:.3} px lasting {:.2} s ({:.3} px explained), \
             wander {:.3} ms/sqrt(s), rate {:.2e}, read-out {:.1} ms, focal ratio {:.4}, centre \
             {:.2}",
            flight.cameras[index].name,
            noise.white_px,
            noise.lasting_px,
            noise.lasting_s,
            explained.sqrt(),
            wander.sqrt() * 1e3,
            camera.clock.rate,
            camera.clock.readout_s * 1e3,
            camera.intrinsics.fx / priors.cameras[index].lens.fx,
            camera.centre
        );
        cameras.push(CameraPriors { noise, wander, ..priors.cameras[index].clone() });
    }
    Priors { jerk: jerk(adjusted), rate_sd: priors.rate_sd, cameras }
}

/// A camera's residuals with the times of its own clock.
pub(super) fn residuals(
    flight: &Flight<'_>,
    state: &FlightState,
    index: usize,
) -> Vec<(f64, Vector2<f64>)> {
    let labels = flight.cameras[index].labels.iter();
    labels.filter_map(|label| Some((label.time_s, state.see(index, label)?.1.residual))).collect()
}

/// Mean part of a label's variance that the adjustment has absorbed, pixels^2 per axis.
///
/// What trajectory and clock follow from moment to moment was absorbed from labels whose variance
/// had been enlarged ([`LabelNoise::caution`]), so it is less by that factor. What the cameras
/// absorbed comes from the mean of many labels, which is as well known as stated.
fn explained(flight: &Flight<'_>, adjusted: &AdjustedFlight, index: usize, caution: f64) -> f64 {
    /// One label in this many is looked at: neighbours tell the same. With half of it the same, in
    /// twice the time.
    const STRIDE: usize = 20;
    let (mut sum, mut count) = (0.0, 0);
    for label in flight.cameras[index].labels.iter().step_by(STRIDE) {
        for terms in adjusted.state.derivatives(index, label).into_iter().flatten() {
            let chain = adjusted.state.order().chain();
            let of_chain: Vec<Derivative> =
                terms.iter().copied().filter(|(unknown, _)| *unknown < chain).collect();
            let with_others_fixed = adjusted.covariance.variance_with_others_fixed(&of_chain);
            // Total variance = chain with the others fixed + part by the others; only the first is
            // divided.
            sum += with_others_fixed / caution + adjusted.covariance.variance(&terms)
                - with_others_fixed;
            count += 1;
        }
    }
    if count == 0 { 0.0 } else { sum / f64::from(count) }
}

/// Power of a clock's random walk, s^2/s: from the squares of its steps and the number of steps
/// that the labels determine (MacKay's fixed point), and from what clocks are usually like.
fn wander(adjusted: &AdjustedFlight, camera: usize, before: f64) -> f64 {
    let order = adjusted.state.order();
    let knots = &adjusted.state.cameras[camera].clock.wander;
    let (mut squares, mut told) = (0.0, 0.0);
    for (k, pair) in knots.values.windows(2).enumerate() {
        let step = [(order.wander(k, camera), -1.0), (order.wander(k + 1, camera), 1.0)];
        let spread = adjusted.covariance.variance(&step);
        squares += (pair[1] - pair[0]).powi(2) / knots.step_s;
        // Effective number of observed steps: 1 - posterior variance / prior variance, per step.
        told += (1.0 - spread / (before * knots.step_s)).clamp(0.0, 1.0);
    }
    let found = (squares + USUAL_STEPS * USUAL_WANDER) / (told + USUAL_STEPS);
    // The fixed point alone takes a dozen rounds and more, as half of the distance remains after
    // each.
    let ahead = (found / before).clamp(MOST_AHEAD.recip(), MOST_AHEAD);
    (found * ahead).max(LEAST_WANDER)
}

/// Power of the jerk that a trajectory shows: its third differences, and their variance
/// (expectation maximisation).
pub(super) fn jerk(adjusted: &AdjustedFlight) -> f64 {
    let (way, order) = (&adjusted.state.way, adjusted.state.order());
    let mut sum = 0.0;
    for first in 0..way.intervals() {
        sum += way.third_difference(first).norm_squared();
        for axis in 0..3 {
            let terms = [0, 1, 2, 3].map(|k| (order.way(first + k, axis), THIRD_DIFFERENCE[k]));
            // E[d^2] = d_hat^2 + Var(d): without the variance the smoothed trajectory would show
            // too little jerk.
            sum += adjusted.covariance.variance_with_others_fixed(&terms);
        }
    }
    // The third difference has the variance power x interval^5.
    (sum / (3.0 * way.intervals() as f64) / KNOT_S.powi(5)).max(1e-6)
}
