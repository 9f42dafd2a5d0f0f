//! One target followed by the posterior over its placements: the likelihood of every placement in
//! the gate and the filters' prediction give where it is, how well that is known, and whether it
//! can be seen at all.

use crossfix_correlation::{Correlator, Plane, Statistics};
use crossfix_filter::{AxisMeasurement, Gate};
use nalgebra::Matrix2;

use crate::appearance::{Appearance, AppearanceScratch};
use crate::arrival::Comparison;
use crate::config::GateRule;
use crate::crop::crop;
use crate::frame::{FRAME_INTERVAL, Frame, Measurement, Step};
use crate::gate::Region;
use crate::hypotheses::Hypotheses;
use crate::identity::Identity;
use crate::likelihood::Expectation;
use crate::look::Look;
use crate::looks::OtherLook;
use crate::motion::{Evidence, Motion};
use crate::noise::NoiseMeter;
use crate::posterior::{Part, Posterior, PosteriorMap};
use crate::search::{Background, Search};
use crate::{ImagePoint, PixelBox, TrackerConfig};

/// Frames without the target after which it is searched for.
pub(crate) const SEARCH_AFTER_FRAMES: u32 = 3;
/// Share of a frame's noise in the running estimate.
const NOISE_SHARE: f32 = 0.3;
/// Variance below which a fit is narrower than the pixels of the map, px^2.
const NARROW: f64 = 0.5;
/// What a map tells of a place is at least this share of what is known then: with less, chance
/// would be taken for a measurement from afar.
const LEAST_TOLD: f64 = 0.1;
/// Squared Mahalanobis distance beyond which a certain match is a manoeuvre.
const MANOEUVRE: f64 = 25.0;
/// A manoeuvre makes the filters' variances at most so many times larger: from a tenth of a pixel
/// to ten.
const MOST_INFLATED: f64 = 1e4;
/// Certainty above which the rest of the gate is not looked at: what is there could take no more
/// from it than this leaves.
const SURE: f64 = 0.99;
/// Certainty above which a target counts as seen.
pub(crate) const SEEN: f64 = 0.5;
/// Over how long the usual contrast is a mean, s: longer than a cloud takes it.
const USUAL_S: f64 = 3.0;
/// Time constant with which a lost target's contrast is taken for what it usually is again, s:
/// about a cloud's edge.
const FADES_S: f64 = 0.5;
/// Floor of a measurement's standard deviation, px: the fit's bias over the phases of a pixel,
/// which no noise shows.
pub(crate) const LEAST_MEASUREMENT_SD: f64 = 0.005;
/// Correlations at which an image is not learned at all, and fully.
const LEARNING_SCORES: [f64; 2] = [0.35, 0.70];
/// How fast the contrast, the log scale and the turn wander, a frame; and the floors of their
/// measurements' standard deviations.
const CONTRAST_WALK: f64 = 0.14;
const SCALE_WALK: f64 = 0.006;
const TURN_WALK: f64 = 0.02;
const CONTRAST_FLOOR: f64 = 0.1;
const SHAPE_FLOOR: f64 = 0.05;

/// Memory that all targets of a tracker share.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    pub(crate) buffers: AppearanceScratch,
    pub(crate) correlator: Correlator,
    pub(crate) meter: NoiseMeter,
    pub(crate) gate: Plane,
    pub(crate) statistics: Statistics,
    pub(crate) ratios: Plane,
    pub(crate) search: Search,
    pub(crate) map: PosteriorMap,
    pub(crate) comparison: Comparison,
}

/// A target under track.
#[derive(Clone, Debug)]
pub(crate) struct Target {
    pub(crate) appearance: Appearance,
    pub(crate) motion: Motion,
    /// How likely it could not be seen in the last image.
    pub(crate) hidden: f64,
    /// Variance of the image's noise.
    pub(crate) noise: f32,
    pub(crate) contrast: f64,
    pub(crate) contrast_variance: f64,
    /// What the contrast is over seconds, as long as the target is seen.
    pub(crate) usual_contrast: f64,
    shape_variances: [f64; 2],
    pub(crate) missed: u32,
    /// How often it has been searched for since.
    pub(crate) searches: u32,
    is_new: bool,
    /// Time since it was last seen, s.
    pub(crate) unseen_s: f64,
    pub(crate) last_seen: ImagePoint,
    /// Where it was in the tracker's snapshot picture.
    pub(crate) in_snapshot: Option<ImagePoint>,
    pub(crate) background: Option<Background>,
    /// What else it is searched for as, while it is lost.
    pub(crate) other_look: Option<Box<OtherLook>>,
    pub(crate) identity: Identity,
    pub(crate) hypotheses: Hypotheses,
}

/// 0 below the first value, 1 above the second, linear between.
fn ramp(value: f64, [low, high]: [f64; 2]) -> f64 {
    ((value - low) / (high - low)).clamp(0.0, 1.0)
}

/// The measurement that makes a posterior of a prior: the inverse variances' difference.
fn without_prior(posterior: AxisMeasurement, prior: AxisMeasurement) -> AxisMeasurement {
    // A placement stands for a whole pixel, of which the map's prior knows nothing.
    let known = (posterior.variance - 1.0 / 12.0).max(1e-3 * prior.variance);
    let share = (1.0 - known / prior.variance).max(LEAST_TOLD);
    let off = (posterior.position - prior.position) / share;
    AxisMeasurement {
        position: prior.position + off,
        variance: prior.variance * (1.0 / share - 1.0) + 1.0 / 12.0,
    }
}

impl Target {
    /// Takes a target up: the box and a margin become the reference (Lytvynets 2020, object model).
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
        let centre = place.centre();
        let around = [place.width, place.height].map(|side| (3.0 * side).ceil().max(9.0) as usize);
        let corner = [centre.x - around[0] as f64 / 2.0, centre.y - around[1] as f64 / 2.0];
        crop(image, corner.map(|at| at as isize), around, &mut scratch.gate);
        let noise = scratch.meter.variance(&scratch.gate, config.noise_floor as f32);
        let variance = config.given_sd_px.powi(2) + config.centre_sd_px.powi(2);
        let given = [centre.x, centre.y].map(|position| AxisMeasurement { position, variance });
        Self {
            appearance: Appearance::new(image, place, noise, config, &mut scratch.buffers),
            motion: Motion::at_rest(given, config.start_velocity_sd_px, config.acceleration_sd_px),
            hidden: 0.0,
            noise,
            contrast: 1.0,
            contrast_variance: 0.0,
            usual_contrast: 1.0,
            shape_variances: [1e-6; 2],
            missed: 0,
            searches: 0,
            is_new: true,
            unseen_s: 0.0,
            last_seen: centre,
            in_snapshot: None,
            background: None,
            other_look: None,
            identity: Identity::new(),
            hypotheses: Hypotheses::default(),
        }
    }

    /// Where the target is believed to be.
    pub(crate) fn position(&self) -> ImagePoint {
        self.motion.position()
    }

    /// How fast it is believed to move, px/s.
    pub(crate) fn velocity(&self) -> ImagePoint {
        self.motion.velocity()
    }

    /// Covariance of position and velocity on either axis, the other places where the target may be
    /// included.
    pub(crate) fn covariances(&self) -> [Matrix2<f64>; 2] {
        let spread = self.hypotheses.spread(self.position());
        let covariances = self.motion.covariances();
        [0, 1].map(|i| {
            let mut covariance = covariances[i];
            covariance.m11 += spread[i];
            covariance
        })
    }

    /// What a look measured, the reference's offset taken out, with all that its covariance must
    /// hold.
    pub(crate) fn measurement(&self, look: &Look) -> Measurement {
        let [x, y] = self.motion.offset();
        let place = ImagePoint { x: look.place.x - x.position, y: look.place.y - y.position };
        Measurement {
            place,
            covariance: look.covariance + Matrix2::new(x.variance, 0.0, 0.0, y.variance),
        }
    }

    /// Whether it is searched for, or for long has not been sure in any place.
    pub(crate) fn is_lost(&self) -> bool {
        self.is_searching() || self.hypotheses.are_doubted()
    }

    pub(crate) fn is_searching(&self) -> bool {
        self.missed >= SEARCH_AFTER_FRAMES
    }

    /// What is expected of the target in the image.
    pub(crate) fn expectation(
        &self,
        noise: f32,
        energy: f32,
        pixels: f32,
        config: &TrackerConfig,
    ) -> Expectation {
        let contrast = self.contrast * f64::from(self.appearance.clear_share());
        let variance = (config.contrast_sd * contrast).powi(2) + self.contrast_variance;
        Expectation {
            // A reference of nothing is found nowhere.
            energy: energy.max(1e-3 * pixels * noise),
            pixels,
            noise: noise.max(f32::MIN_POSITIVE),
            contrast: contrast as f32,
            contrast_variance: variance as f32,
            mismatch: config.mismatch as f32,
        }
    }

    /// Follows the target into the next image.
    pub(crate) fn step(&mut self, frame: Frame<'_>, scratch: &mut Scratch) -> Step {
        let interval = frame.interval;
        self.may_move_with_scene(frame);
        self.note_last_place(frame);
        self.motion.predict(interval, frame.sides());
        self.hypotheses.predict(frame);
        self.unseen_s += interval;
        let frames = interval / FRAME_INTERVAL;
        let [scale, turn] = &mut self.shape_variances;
        *scale = (*scale + SCALE_WALK.powi(2) * frames).min(0.09);
        *turn = (*turn + TURN_WALK.powi(2) * frames).min(0.25);
        if self.is_searching() {
            self.search(frame, scratch)
        } else if self.identity.is_on_probation() {
            self.follow_on_probation(frame, scratch)
        } else {
            self.follow(frame, scratch)
        }
    }

    /// Takes a place in the next image from somebody who knows it, instead of measuring it: with
    /// the box it is the start from two measurements (Herasymenko 2021, eqs. 13-14).
    pub(crate) fn take_place(
        &mut self,
        frame: Frame<'_>,
        place: ImagePoint,
        scratch: &mut Scratch,
    ) -> Step {
        let Frame { image, interval, config, .. } = frame;
        let variance = config.given_sd_px.powi(2);
        let searching = self.is_searching();
        let given = [place.x, place.y].map(|position| AxisMeasurement { position, variance });
        if self.is_new {
            self.motion.start(given, interval);
        } else if searching {
            self.motion.restart_at(given, config.search_velocity_sd_px);
        } else {
            self.motion.predict(interval, frame.sides());
            self.motion.take_place(given);
        }
        self.identity.is_given();
        let share =
            self.appearance.learn(image, place, self.noise, 1.0, interval, &mut scratch.buffers);
        self.motion.learn(place, f64::from(share), None);
        self.seen(place);
        self.hypotheses.clear();
        let covariance = Matrix2::identity() * variance;
        let measured = Measurement { place, covariance };
        Step { measured: Some(measured), score: 1.0, certainty: 1.0, nis: None }
    }

    pub(crate) fn follow(&mut self, frame: Frame<'_>, scratch: &mut Scratch) -> Step {
        let Frame { image, config, .. } = frame;
        let reach = self.hypotheses.reach(self.position());
        let half = self.half_gate(image, config);
        let image_sides = [image.width(), image.height()];
        let half = [0, 1]
            .map(|i| (half[i] + (reach[i].ceil() as usize).min(2 * half[i])).min(image_sides[i]));
        let whole = Region::about(self, half);
        let noise = scratch.meter.variance_within(
            image,
            whole.corner,
            whole.sides,
            config.noise_floor as f32,
        );
        self.noise =
            if self.is_new { noise } else { self.noise + NOISE_SHARE * (noise - self.noise) };

        // The whole gate is looked at only where the middle of it leaves a doubt.
        let middle = self.middle_of_gate(whole.half, config).map(|half| Region::about(self, half));
        let sure = middle.map(|middle| (self.posterior(frame, middle, scratch), middle));
        let (posterior, region) = match sure.filter(|(posterior, _)| posterior.near.mass > SURE) {
            Some(sure) => sure,
            None => (self.posterior(frame, whole, scratch), whole),
        };
        if self.must_doubt(&posterior, config) {
            return self.follow_hypotheses(frame, region, scratch);
        }
        let [column, row] = posterior.peak;
        let look = self.look(column, row, region.origin, scratch, config);
        self.update(frame, &posterior, look, region.origin, scratch)
    }

    /// Takes the posterior into the filters and the target's image into the reference.
    pub(crate) fn update(
        &mut self,
        frame: Frame<'_>,
        posterior: &Posterior,
        look: Look,
        origin: [f64; 2],
        scratch: &mut Scratch,
    ) -> Step {
        let is_there = self.doubt(frame, look, scratch);
        let doubted = posterior.doubted(is_there);
        let certainty = doubted.near.mass;
        let found = look.found();
        if certainty > SEEN {
            self.motion.tell_noise(found.map(|at| at.variance));
        }
        let expected = self.motion.found();
        let distance = self.motion.surprise(found);
        let step = |measured| Step { measured, score: look.score, certainty, nis: Some(distance) };
        let measured = self.measurement(&look);
        if let GateRule::Ellipsoid { probability } = frame.config.gate
            && !Gate::with_probability(probability).holds(distance)
        {
            self.missed += 1;
            return step(None);
        }
        if certainty > SEEN && distance > MANOEUVRE {
            // Certain, and not where it was expected: the filters are too sure of themselves.
            let off = |i: usize| {
                (found[i].position - expected[i].position).powi(2) / expected[i].variance
            };
            self.motion.inflate((off(0).max(off(1)) / MANOEUVRE).clamp(1.0, MOST_INFLATED));
            self.motion.update(&Evidence::of(found));
            self.seen(look.place);
            self.learn(frame, look.place, look, certainty, scratch);
            return step(Some(measured));
        }
        // Whether it is the target that is followed is said by the certainty, and the covariance is
        // that of where it is then.
        let posterior = if certainty > SEEN { posterior } else { &doubted };
        self.motion.update(&self.evidence(posterior, found, origin, frame.config));
        let (estimate, hidden) = (self.position(), posterior.unseen);
        if certainty > SEEN {
            self.seen(estimate);
            self.motion.match_noise(distance);
        } else {
            self.missed += 1;
        }
        self.hidden = hidden;
        self.learn(frame, estimate, look, certainty, scratch);
        step((certainty > SEEN).then_some(measured))
    }

    /// What a posterior over the placements says of where the reference is found. Where the fit is
    /// narrower than the pixels of the map, it says where in the peak; elsewhere the peak's own
    /// moments do, the prediction's part taken out.
    fn evidence(
        &self,
        posterior: &Posterior,
        fitted: [AxisMeasurement; 2],
        origin: [f64; 2],
        config: &TrackerConfig,
    ) -> Evidence {
        let narrow = fitted.iter().all(|at| at.variance < NARROW);
        let floor = config.prediction_floor_px.powi(2);
        let expected =
            self.motion.found().map(|at| AxisMeasurement { variance: at.variance + floor, ..at });
        let in_image = |part: &Part, i: usize| AxisMeasurement {
            position: origin[i] + part.mean[i],
            variance: part.variance[i],
        };
        let at = if narrow {
            fitted
        } else {
            [0, 1].map(|i| without_prior(in_image(&posterior.near, i), expected[i]))
        };
        Evidence {
            near: posterior.near.mass,
            at,
            elsewhere: posterior.elsewhere.mass,
            elsewhere_at: [0, 1].map(|i| in_image(&posterior.elsewhere, i)),
        }
    }

    pub(crate) fn seen(&mut self, place: ImagePoint) {
        (self.missed, self.searches) = (0, 0);
        (self.unseen_s, self.hidden) = (0.0, 0.0);
        self.is_new = false;
        self.last_seen = place;
        self.background = None;
        if !self.identity.is_on_probation() {
            self.other_look = None;
        }
    }

    /// Follows contrast, size, direction and appearance, the more the surer the target was seen.
    pub(crate) fn learn(
        &mut self,
        frame: Frame<'_>,
        place: ImagePoint,
        look: Look,
        certainty: f64,
        scratch: &mut Scratch,
    ) {
        let Frame { image, interval, .. } = frame;
        if certainty < 0.05 {
            return;
        }
        let seen = certainty > SEEN;
        if seen && !self.identity.is_on_probation() {
            let clear = f64::from(self.appearance.clear_share());
            let measured = look.contrast / clear;
            let variance = f64::from(self.noise / self.appearance.energy().max(1e-12))
                / clear.powi(2)
                + CONTRAST_FLOOR.powi(2);
            self.contrast_variance +=
                (CONTRAST_WALK * self.contrast).powi(2) * interval / FRAME_INTERVAL;
            let gain = certainty * self.contrast_variance / (self.contrast_variance + variance);
            self.contrast = (self.contrast + gain * (measured - self.contrast)).clamp(0.2, 5.0);
            self.contrast_variance *= 1.0 - gain;
            let share = (certainty * interval / USUAL_S).min(1.0);
            self.usual_contrast += share * (self.contrast - self.usual_contrast);
        }
        let certainty = certainty * ramp(look.score, LEARNING_SCORES);
        if certainty >= 0.02 && !self.identity.is_on_probation() {
            // Size and direction take effect with the learning; without it they would run away.
            if seen && self.appearance.is_in_shape() {
                self.follow_shape(look);
            }
            let (certainty, buffers) = (certainty as f32, &mut scratch.buffers);
            let share =
                self.appearance.learn(image, place, self.noise, certainty, interval, buffers);
            let variances = [look.covariance.m11, look.covariance.m22];
            self.motion.learn(place, f64::from(share), Some(variances));
        }
    }

    fn follow_shape(&mut self, look: Look) {
        let Some(shape) = look.shape else { return };
        let limits = [0.2, 0.5];
        let mut steps = [0.0; 2];
        for i in 0..2 {
            let (change, variance) = shape[i];
            if variance < 0.1 && change.abs() < limits[i] {
                let known = &mut self.shape_variances[i];
                let gain = *known / (*known + variance + SHAPE_FLOOR.powi(2));
                steps[i] = gain * change;
                *known *= 1.0 - gain;
            }
        }
        self.appearance.reshape(steps[0], steps[1]);
    }

    fn search(&mut self, frame: Frame<'_>, scratch: &mut Scratch) -> Step {
        // Nothing is known of its contrast any more but what it usually is.
        let share = (frame.interval / FADES_S).min(1.0);
        self.contrast += share * (self.usual_contrast - self.contrast);
        self.contrast_variance +=
            share * ((0.5 * self.usual_contrast).powi(2) - self.contrast_variance);
        if !frame.may_search {
            self.missed += 1;
            return Step { measured: None, score: 0.0, certainty: 0.0, nis: None };
        }
        self.find_again(frame, scratch).unwrap_or_else(|score| {
            self.missed += 1;
            Step { measured: None, score, certainty: 0.0, nis: None }
        })
    }

    /// Takes what a search finds, if it is believed; else its score.
    fn find_again(&mut self, frame: Frame<'_>, scratch: &mut Scratch) -> Result<Step, f64> {
        let found = crate::search::find(self, frame, scratch);
        let Some(look) = found.look.filter(|_| found.accepted) else {
            return Err(found.look.map_or(0.0, |look| look.score));
        };
        self.begin_probation(frame.scene);
        let (found, expected) = (look.found(), self.motion.found());
        let is_near = |i: usize| {
            (found[i].position - expected[i].position).powi(2) < MANOEUVRE * expected[i].variance
        };
        if self.missed < 20 && is_near(0) && is_near(1) {
            self.motion.condition([0, 1].map(|i| AxisMeasurement {
                variance: found[i].variance.min(expected[i].variance),
                ..found[i]
            }));
        } else {
            self.motion.restart(found, frame.config.search_velocity_sd_px);
        }
        self.seen(look.place);
        self.hypotheses.clear();
        let measured = self.measurement(&look);
        Ok(Step { measured: Some(measured), score: look.score, certainty: 1.0, nis: None })
    }
}
