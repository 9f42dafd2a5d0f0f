//! One target followed by the posterior over its placements: the likelihood of every placement in
//! the gate and the filters' prediction give where it is, how well that is known, and whether it
//! can be seen at all.
//!
//! A step goes through the stages of `state.rs`: the gate, the posterior, the fit, how sure
//! that is (`identity.rs`, and where there are several places `doubtful.rs`), the filters' update,
//! and learning. A target that is lost is searched for (`lost.rs`).

mod doubtful;
mod lost;

pub(crate) use doubtful::LEAST_MOVE_PX;

use crossfix_correlation::Plane;
use crossfix_filter::{AxisMeasurement, Gate};
use nalgebra::Matrix2;

use crate::config::GateRule;
use crate::fit::TargetFit;
use crate::frame::{FrameInput, Measurement, TargetStep};
use crate::gate::Region;
use crate::hypotheses::PlaceHypotheses;
use crate::identity::TargetIdentity;
use crate::motion::PlaceEvidence;
use crate::posterior::Posterior;
use crate::scratch::Scratch;
use crate::search_memory::SearchMemory;
use crate::state::{SEEN, TargetBelief};
use crate::tracker_part::TrackerPart;
use crate::{ImagePoint, PixelBox, TrackerConfig};

/// Variance below which a fit is narrower than the map's pixels, px^2. With half of it fits of 0.5
/// to 0.7 px are left to the peak's moments, to which the pixels add a twelfth.
const NARROW: f64 = 0.5;
/// Least gain of a measurement that is taken out of a peak of the map: with less, chance would be
/// taken for a measurement far off the prediction. With half of it such a measurement is up to
/// twice as far off.
const LEAST_GAIN: f64 = 0.1;
/// Largest product of the half sides of a gate in which a target in doubt is looked for, px^2: a
/// gate of 280 by 280 px takes 10 ms. With no limit it grows to the whole image, and takes 60. With
/// half of it a drawn target in noise is lost in 20 % of its frames instead of 2, and something
/// else taken for it for four seconds.
const MOST_IN_DOUBT: usize = 20_000;

/// A target under track.
#[derive(Clone, Debug)]
pub(crate) struct ImageTarget {
    pub(crate) state: TargetBelief,
    pub(crate) identity: TargetIdentity,
    pub(crate) hypotheses: PlaceHypotheses,
    pub(crate) search_memory: SearchMemory,
}

/// The measurement that leads from the prior to the posterior: the difference of the inverse
/// variances.
fn without_prior(posterior: AxisMeasurement, prior: AxisMeasurement) -> AxisMeasurement {
    // Each placement stands for a whole pixel, of variance 1/12, which the map's prior does not
    // have.
    let known = (posterior.variance - 1.0 / 12.0).max(1e-3 * prior.variance);
    // Gain K = 1 - P+ / P, hence z = x + (x+ - x) / K and R = P (1 / K - 1).
    let share = (1.0 - known / prior.variance).max(LEAST_GAIN);
    let off = (posterior.position - prior.position) / share;
    AxisMeasurement {
        position: prior.position + off,
        variance: prior.variance * (1.0 / share - 1.0) + 1.0 / 12.0,
    }
}

/// Half sides of a gate, made smaller in its shape where their product is above [`MOST_IN_DOUBT`];
/// neither becomes zero.
fn narrowed(half: [usize; 2]) -> [usize; 2] {
    let share = MOST_IN_DOUBT as f64 / (half[0] * half[1]).max(1) as f64;
    half.map(|side| if share < 1.0 { ((side as f64 * share.sqrt()) as usize).max(1) } else { side })
}

impl ImageTarget {
    /// Takes a target up.
    ///
    /// The velocity is unknown but for its prior: with the next measurement the state becomes that
    /// of Herasymenko 2021, eqs. 13-14, shrunk towards rest by the share of the measurement's
    /// variance in the prior's.
    pub(crate) fn new(
        image: &Plane,
        place: PixelBox,
        scratch: &mut Scratch,
        config: &TrackerConfig,
    ) -> Self {
        Self {
            state: TargetBelief::new(image, place, scratch, config),
            identity: TargetIdentity::new(),
            hypotheses: PlaceHypotheses::default(),
            search_memory: SearchMemory::default(),
        }
    }

    /// Covariance of position and velocity on either axis, with the spread of the other places
    /// where the target may be.
    pub(crate) fn covariances(&self) -> [Matrix2<f64>; 2] {
        let spread = self.hypotheses.spread(self.state.position());
        let covariances = self.state.motion.covariances();
        [0, 1].map(|i| {
            let mut covariance = covariances[i];
            // Mixture of places: P11 of the likeliest, plus the mean squared distance of all from
            // it.
            covariance.m11 += spread[i];
            covariance
        })
    }

    /// Whether it is searched for, or has not been sure in any place for long.
    pub(crate) fn is_lost(&self) -> bool {
        self.state.is_searching() || self.hypotheses.are_lost()
    }

    /// Follows the target into the next image.
    pub(crate) fn step(&mut self, frame: FrameInput<'_>, scratch: &mut Scratch) -> TargetStep {
        self.may_move_with_scene(frame);
        self.identity.note_last_place(&self.state, frame);
        self.state.predict(frame);
        self.hypotheses.predict(frame);
        if self.state.is_searching() {
            self.search(frame, scratch)
        } else if self.identity.is_on_probation() {
            self.follow_on_probation(frame, scratch)
        } else {
            self.follow(frame, scratch)
        }
    }

    /// Takes a place in the next image from somebody who knows it, instead of measuring it: with
    /// the box it starts the motion from two measurements (Herasymenko 2021, eqs. 13-14).
    pub(crate) fn take_place(
        &mut self,
        frame: FrameInput<'_>,
        place: ImagePoint,
        scratch: &mut Scratch,
    ) -> TargetStep {
        let FrameInput { image, interval, config, .. } = frame;
        let variance = config.given_sd_px.powi(2);
        let searching = self.state.is_searching();
        let given = [place.x, place.y].map(|position| AxisMeasurement { position, variance });
        if self.state.is_new {
            self.state.motion.start(given, interval);
        } else if searching {
            self.state.motion.restart_at(given, config.search_velocity_sd_px);
        } else {
            self.state.motion.predict(interval, frame.sides());
            self.state.motion.take_place(given);
        }
        self.identity.set_given();
        self.state.surroundings = None;
        let share = self.state.appearance.learn(
            image,
            place,
            self.state.noise,
            1.0,
            interval,
            &mut scratch.buffers,
        );
        self.state.motion.learn(place, f64::from(share), None);
        self.seen(place);
        self.hypotheses.clear();
        let covariance = Matrix2::identity() * variance;
        let measured = Measurement { place, covariance };
        TargetStep { measured: Some(measured), score: 1.0, certainty: 1.0, nis: None }
    }

    /// Whether it was not seen for sure in the last image, or has been found again just now.
    fn is_in_doubt(&self) -> bool {
        self.state.missed > 0 || !self.hypotheses.is_empty() || self.identity.is_on_probation()
    }

    fn follow(&mut self, frame: FrameInput<'_>, scratch: &mut Scratch) -> TargetStep {
        let FrameInput { image, config, .. } = frame;
        // The gate holds every hypothesis, but is widened to three times its size at most, and
        // not beyond what may be looked at.
        let reach = self.hypotheses.reach(self.state.position());
        let half = self.state.half_gate(image, config);
        let image_sides = [image.width(), image.height()];
        let half = [0, 1]
            .map(|i| (half[i] + (reach[i].ceil() as usize).min(2 * half[i])).min(image_sides[i]));
        let is_own_rule = matches!(config.gate, GateRule::Innovation { .. });
        let half = if is_own_rule && self.is_in_doubt() { narrowed(half) } else { half };
        let whole = Region::about(&self.state, half);
        let noise = scratch.meter.variance_within(
            image,
            whole.corner,
            whole.sides,
            config.noise_floor as f32,
        );
        self.state.note_noise(noise, frame.interval);

        // The whole gate is looked at only if the middle of it leaves the place unsure.
        let middle = if self.hypotheses.is_empty() {
            self.state.middle_of_gate(whole.half, config)
        } else {
            None
        };
        let middle = middle.map(|half| Region::about(&self.state, half));
        let sure = middle.map(|middle| (self.state.posterior(frame, middle, scratch), middle));
        let (posterior, region) = match sure.filter(|(posterior, _)| posterior.is_sure()) {
            Some(sure) => sure,
            None => (self.state.posterior_of_gate(frame, whole, scratch), whole),
        };
        if self.has_several_places(&posterior, config) {
            return self.follow_hypotheses(frame, region, scratch);
        }
        let [column, row] = posterior.peak;
        let fit = self.state.fit_at(column, row, region.origin, scratch, config);
        self.update(frame, &posterior, fit, region.origin, scratch)
    }

    /// Takes the posterior into the filters and the target's image into the reference.
    fn update(
        &mut self,
        frame: FrameInput<'_>,
        posterior: &Posterior,
        fit: TargetFit,
        origin: [f64; 2],
        scratch: &mut Scratch,
    ) -> TargetStep {
        let is_there = self.identity.measurement_update(&self.state, frame, fit, scratch);
        let discounted = posterior.discounted(is_there);
        let certainty = discounted.near.mass;
        let found = fit.found();
        if certainty > SEEN {
            self.state.motion.add_noise_of_learned(found.map(|at| at.variance));
        }
        let distance = self.state.motion.nis(found);
        let step =
            |measured| TargetStep { measured, score: fit.score, certainty, nis: Some(distance) };
        let measured = self.state.measurement(&fit);
        if let GateRule::Ellipsoid { probability } = frame.config.gate
            && !Gate::with_probability(probability).holds(distance)
        {
            self.state.missed += 1;
            return step(None);
        }
        // Whether what is followed is the target is said by the certainty; the covariance is that
        // of its place if it is.
        let posterior = if certainty > SEEN { posterior } else { &discounted };
        self.state.motion.update(&self.evidence(posterior, found, origin, frame.config));
        let (estimate, hidden) = (self.state.position(), posterior.unseen);
        if certainty > SEEN {
            self.state.take_features(fit.contrast, estimate, frame);
            self.seen(estimate);
            if frame.config.has(TrackerPart::MatchedNoise) {
                self.state.motion.match_noise(distance);
            }
        } else {
            self.state.missed += 1;
        }
        self.state.hidden = hidden;
        self.learn(frame, estimate, fit, certainty, scratch);
        step((certainty > SEEN).then_some(measured))
    }

    /// The measurement that a posterior over the placements gives of where the reference is found.
    /// If the fit is narrower than the map's pixels, it gives the place within the peak; else the
    /// peak's own moments do, with the prediction's part taken out.
    fn evidence(
        &self,
        posterior: &Posterior,
        fitted: [AxisMeasurement; 2],
        origin: [f64; 2],
        config: &TrackerConfig,
    ) -> PlaceEvidence {
        let narrow = fitted.iter().all(|at| at.variance < NARROW);
        // The posterior was made with this floor in its prior, so it is taken out with it.
        let floor = config.prediction_floor_px.powi(2);
        let expected = self
            .state
            .motion
            .found()
            .map(|at| AxisMeasurement { variance: at.variance + floor, ..at });
        let (near_at, elsewhere_at) =
            (posterior.near.in_image(origin), posterior.elsewhere.in_image(origin));
        let at =
            if narrow { fitted } else { [0, 1].map(|i| without_prior(near_at[i], expected[i])) };
        PlaceEvidence {
            near: posterior.near.mass,
            at,
            elsewhere: posterior.elsewhere.mass,
            elsewhere_at,
        }
    }

    /// Notes that the target was seen at a place.
    pub(crate) fn seen(&mut self, place: ImagePoint) {
        self.state.seen(place);
        self.search_memory.seen();
        if !self.identity.is_on_probation() {
            self.search_memory.forget_other();
        }
    }

    /// Learns contrast, size, direction and appearance, the more the surer the target was seen.
    /// From one on probation nothing is learnt.
    fn learn(
        &mut self,
        frame: FrameInput<'_>,
        place: ImagePoint,
        fit: TargetFit,
        certainty: f64,
        scratch: &mut Scratch,
    ) {
        if self.identity.is_on_probation() {
            return;
        }
        let learnt = self.state.learn(frame, place, fit, certainty, scratch);
        // Several places are those of one reference: while there are, it stays as it is.
        let may_centre = learnt > 0.0 && self.hypotheses.is_empty();
        if may_centre && self.state.centre(frame, place, learnt, scratch) {
            self.search_memory.forget_other();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gate_is_made_smaller_in_its_shape_and_only_where_it_is_too_large() {
        assert_eq!(narrowed([60, 90]), [60, 90]);
        assert_eq!(narrowed([400, 200]), [200, 100]);
        assert_eq!(narrowed([100_000, 1])[1], 1);
        assert_eq!(narrowed([0, 5]), [0, 5]);
    }
}
