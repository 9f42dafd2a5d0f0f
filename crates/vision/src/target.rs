//! One target followed by the posterior over its placements: the likelihood of every placement in
//! the gate and the filters' prediction give where it is, how well that is known, and whether it can
//! be seen at all.

use crossfix_correlation::{Correlator, Plane, Statistics};
use crossfix_filter::{AxisFilter, AxisMeasurement, Gate};
use nalgebra::Matrix2;

use crate::appearance::{Appearance, Workshop};
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
/// Squared Mahalanobis distance beyond which a certain match is a manoeuvre.
const MANOEUVRE: f64 = 25.0;
/// Certainty above which the rest of the gate is not looked at: what is there could take no more from it than this leaves.
const SURE: f64 = 0.99;
/// Certainty above which a target counts as seen.
pub(crate) const SEEN: f64 = 0.5;
/// Over how long the usual contrast is a mean, s: longer than a cloud takes it.
const USUAL_S: f64 = 3.0;
/// Time constant with which a lost target's contrast is taken for what it usually is again, s: about a cloud's edge.
const FADES_S: f64 = 0.5;
/// Floor of a measurement's standard deviation, px.
pub(crate) const LEAST_MEASUREMENT_SD: f64 = 0.015;
/// Share of a measurement's variance that is the image's own noise, new in every frame. The rest is
/// where the noise of the first image has put the reference: it is common to all measurements of a
/// track, and no filter can take it out. About half, since image and first image are alike.
const OWN_SHARE: f64 = 0.62;
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
pub(crate) struct Workbench {
    pub(crate) workshop: Workshop,
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
    pub(crate) axes: [AxisFilter; 2],
    /// Variance of the image's noise.
    pub(crate) noise: f32,
    pub(crate) contrast: f64,
    pub(crate) contrast_variance: f64,
    /// What the contrast is over seconds, as long as the target is seen.
    pub(crate) usual_contrast: f64,
    shape_variances: [f64; 2],
    /// Variance of the reference's own place, x and y, px^2.
    common: [f64; 2],
    /// Variance of the box's centre about the target's own, px^2.
    centre_variance: f64,
    pub(crate) missed: u32,
    /// How often it has been searched for since.
    pub(crate) searches: u32,
    is_new: bool,
    /// Time since it was last seen, s.
    pub(crate) unseen_s: f64,
    pub(crate) last_seen: ImagePoint,
    /// Where it was in the tracker's keepsake picture.
    pub(crate) in_keepsake: Option<ImagePoint>,
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

/// Moves both axes on; a target that leaves the picture is waited for at its border.
pub(crate) fn predict(axes: &mut [AxisFilter; 2], interval: f64, image: &Plane) {
    for (axis, side) in axes.iter_mut().zip([image.width(), image.height()]) {
        axis.time_update(interval);
        let edge = side as f64 - 1.0;
        if !(0.0..=edge).contains(&axis.position()) {
            axis.hold_at(axis.position().clamp(0.0, edge));
        }
    }
}

impl Target {
    /// Takes a target up: the box and a margin become the reference (001, object model).
    ///
    /// The velocity is unknown but for its prior: with the next measurement the state becomes that of
    /// 000 (13)-(14), shrunk towards rest by the share of the measurement's variance in the prior's.
    pub(crate) fn new(image: &Plane, place: PixelBox, bench: &mut Workbench, config: &TrackerConfig) -> Self {
        let centre = place.centre();
        let around = [place.width, place.height].map(|side| (3.0 * side).ceil().max(9.0) as usize);
        let corner = [centre.x - around[0] as f64 / 2.0, centre.y - around[1] as f64 / 2.0];
        crop(image, corner.map(|at| at as isize), around, &mut bench.gate);
        let noise = bench.meter.variance(&bench.gate, config.noise_floor as f32);
        let start = |position| {
            let first = AxisMeasurement { position, variance: config.given_sd_px.powi(2) };
            AxisFilter::start_at_rest(first, config.start_velocity_sd_px, config.acceleration_sd_px)
        };
        Self {
            appearance: Appearance::new(image, place, noise, config, &mut bench.workshop),
            axes: [start(centre.x), start(centre.y)],
            noise,
            contrast: 1.0,
            contrast_variance: 0.0,
            usual_contrast: 1.0,
            shape_variances: [1e-6; 2],
            common: [0.0; 2],
            centre_variance: config.centre_sd_px.powi(2),
            missed: 0,
            searches: 0,
            is_new: true,
            unseen_s: 0.0,
            last_seen: centre,
            in_keepsake: None,
            background: None,
            other_look: None,
            identity: Identity::new(),
            hypotheses: Hypotheses::default(),
        }
    }

    /// Where the target is believed to be.
    pub(crate) fn position(&self) -> ImagePoint {
        ImagePoint { x: self.axes[0].position(), y: self.axes[1].position() }
    }

    /// How fast it is believed to move, px/s.
    pub(crate) fn velocity(&self) -> ImagePoint {
        ImagePoint { x: self.axes[0].velocity(), y: self.axes[1].velocity() }
    }

    pub(crate) fn axes(&self) -> &[AxisFilter; 2] {
        &self.axes
    }

    /// Covariance of position and velocity on either axis, the reference's own place and the other places where the target
    /// may be included.
    pub(crate) fn covariances(&self) -> [Matrix2<f64>; 2] {
        let spread = self.hypotheses.spread(self.position());
        [0, 1].map(|i| {
            let mut covariance = self.axes[i].covariance();
            covariance.m11 += self.common[i] + self.centre_variance + spread[i];
            covariance
        })
    }

    /// What a look measured, with all that its covariance must hold.
    pub(crate) fn measurement(&self, look: &Look) -> Measurement {
        let covariance = look.covariance + Matrix2::identity() * self.centre_variance;
        Measurement { place: look.place, covariance }
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
    pub(crate) fn step(&mut self, frame: Frame<'_>, bench: &mut Workbench) -> Step {
        let Frame { image, interval, .. } = frame;
        self.may_move_with_scene(frame);
        predict(&mut self.axes, interval, image);
        self.hypotheses.predict(frame);
        self.unseen_s += interval;
        let frames = interval / FRAME_INTERVAL;
        let [scale, turn] = &mut self.shape_variances;
        *scale = (*scale + SCALE_WALK.powi(2) * frames).min(0.09);
        *turn = (*turn + TURN_WALK.powi(2) * frames).min(0.25);
        if self.is_searching() {
            self.search(frame, bench)
        } else if self.identity.is_on_probation() {
            self.follow_on_probation(frame, bench)
        } else {
            self.follow(frame, bench)
        }
    }

    /// Takes a place in the next image from somebody who knows it, instead of measuring it: with the
    /// box it is the start from two measurements (000 (13)-(14)).
    pub(crate) fn take_place(&mut self, frame: Frame<'_>, place: ImagePoint, bench: &mut Workbench) -> Step {
        let Frame { image, interval, config, .. } = frame;
        let variance = config.given_sd_px.powi(2);
        let searching = self.is_searching();
        let at = |position| AxisMeasurement { position, variance };
        if !self.is_new {
            predict(&mut self.axes, interval, image);
        }
        for (axis, position) in self.axes.iter_mut().zip([place.x, place.y]) {
            if self.is_new {
                *axis =
                    AxisFilter::start(at(axis.position()), at(position), interval, config.acceleration_sd_px);
            } else if searching {
                *axis = AxisFilter::start_at_rest(
                    at(position),
                    config.search_velocity_sd_px,
                    config.acceleration_sd_px,
                );
            } else {
                axis.measurement_update(at(position));
            }
        }
        self.identity.is_given();
        self.appearance.learn(image, place, self.noise, 1.0, interval, &mut bench.workshop);
        self.seen(place);
        self.hypotheses.clear();
        let covariance = Matrix2::identity() * (variance + self.centre_variance);
        let measured = Measurement { place, covariance };
        Step { measured: Some(measured), score: 1.0, certainty: 1.0, nis: None }
    }

    pub(crate) fn follow(&mut self, frame: Frame<'_>, bench: &mut Workbench) -> Step {
        let Frame { image, config, .. } = frame;
        let reach = self.hypotheses.reach(self.position());
        let half = self.half_gate(image, config);
        let image_sides = [image.width(), image.height()];
        let half =
            [0, 1].map(|i| (half[i] + (reach[i].ceil() as usize).min(2 * half[i])).min(image_sides[i]));
        let whole = Region::about(self, half);
        let noise = bench.meter.variance_within(image, whole.corner, whole.sides, config.noise_floor as f32);
        self.noise = if self.is_new { noise } else { self.noise + NOISE_SHARE * (noise - self.noise) };

        // The whole gate is looked at only where the middle of it leaves a doubt.
        let middle = self.middle_of_gate(whole.half, config).map(|half| Region::about(self, half));
        let sure = middle.map(|middle| (self.posterior(frame, middle, bench), middle));
        let (posterior, region) = match sure.filter(|(posterior, _)| posterior.near.mass > SURE) {
            Some(sure) => sure,
            None => (self.posterior(frame, whole, bench), whole),
        };
        if self.must_doubt(&posterior, config) {
            return self.follow_hypotheses(frame, region, bench);
        }
        let [column, row] = posterior.peak;
        let look = self.look(column, row, region.origin, bench, config);
        self.update(frame, &posterior, look, region.origin, bench)
    }

    /// Takes the posterior into the filters and the target's image into the reference.
    pub(crate) fn update(
        &mut self,
        frame: Frame<'_>,
        posterior: &Posterior,
        look: Look,
        origin: [f64; 2],
        bench: &mut Workbench,
    ) -> Step {
        let is_there = self.doubt(frame, look, bench);
        let posterior = &posterior.doubted(is_there);
        let certainty = posterior.near.mass;
        let at = [look.place.x, look.place.y];
        let variances = [look.covariance.m11, look.covariance.m22].map(|v| OWN_SHARE * v);
        self.common = variances.map(|own| own * (1.0 - OWN_SHARE) / OWN_SHARE);
        let distance: f64 = (0..2)
            .map(|i| {
                let measurement = AxisMeasurement { position: at[i], variance: variances[i] };
                self.axes[i].innovation(measurement).normalised_squared()
            })
            .sum();
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
            for i in 0..2 {
                self.axes[i].inflate(distance / MANOEUVRE);
                self.axes[i].measurement_update(AxisMeasurement { position: at[i], variance: variances[i] });
            }
            self.seen(look.place);
            self.learn(frame, look.place, look, certainty, bench);
            return step(Some(measured));
        }
        self.condition(posterior, at, variances, origin);
        let estimate = self.position();
        if certainty > SEEN {
            self.seen(estimate);
        } else {
            self.missed += 1;
        }
        self.learn(frame, estimate, look, certainty, bench);
        step((certainty > SEEN).then_some(measured))
    }

    /// The mixture of near, elsewhere and not seen, an axis, by its mean and variance.
    fn condition(&mut self, posterior: &Posterior, at: [f64; 2], variances: [f64; 2], origin: [f64; 2]) {
        let narrow = variances.iter().all(|v| *v < NARROW);
        for i in 0..2 {
            let (prior_mean, prior) = (self.axes[i].position(), self.axes[i].position_variance());
            let (near_mean, near_variance) = if narrow {
                let gain = prior / (prior + variances[i]);
                (prior_mean + gain * (at[i] - prior_mean), (1.0 - gain) * prior)
            } else {
                (origin[i] + posterior.near.mean[i], posterior.near.variance[i])
            };
            let Part { mass, mean, variance } = posterior.elsewhere;
            let parts = [
                (posterior.near.mass, near_mean, near_variance),
                (mass, origin[i] + mean[i], variance[i]),
                (posterior.unseen, prior_mean, prior),
            ];
            let mean: f64 = parts.iter().map(|(mass, mean, _)| mass * mean).sum();
            let spread: f64 =
                parts.iter().map(|(mass, at, variance)| mass * (variance + (at - mean).powi(2))).sum();
            self.axes[i].condition(AxisMeasurement { position: mean, variance: spread.min(4.0 * prior) });
        }
    }

    pub(crate) fn seen(&mut self, place: ImagePoint) {
        (self.missed, self.searches) = (0, 0);
        self.unseen_s = 0.0;
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
        bench: &mut Workbench,
    ) {
        let Frame { image, interval, .. } = frame;
        if certainty < 0.05 {
            return;
        }
        let seen = certainty > SEEN;
        if seen && !self.identity.is_on_probation() {
            let clear = f64::from(self.appearance.clear_share());
            let measured = look.contrast / clear;
            let variance = f64::from(self.noise / self.appearance.energy().max(1e-12)) / clear.powi(2)
                + CONTRAST_FLOOR.powi(2);
            self.contrast_variance += (CONTRAST_WALK * self.contrast).powi(2) * interval / FRAME_INTERVAL;
            let gain = certainty * self.contrast_variance / (self.contrast_variance + variance);
            self.contrast = (self.contrast + gain * (measured - self.contrast)).clamp(0.2, 5.0);
            self.contrast_variance *= 1.0 - gain;
            let share = (certainty * interval / USUAL_S).min(1.0);
            self.usual_contrast += share * (self.contrast - self.usual_contrast);
        }
        let certainty = certainty * ramp(look.score, LEARNING_SCORES);
        if certainty >= 0.02 && !self.identity.is_on_probation() {
            // Size and direction take effect with the learning; without it they would run away.
            if seen {
                self.follow_shape(look);
            }
            self.appearance.learn(image, place, self.noise, certainty as f32, interval, &mut bench.workshop);
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

    fn search(&mut self, frame: Frame<'_>, bench: &mut Workbench) -> Step {
        // Nothing is known of its contrast any more but what it usually is.
        let share = (frame.interval / FADES_S).min(1.0);
        self.contrast += share * (self.usual_contrast - self.contrast);
        self.contrast_variance += share * ((0.5 * self.usual_contrast).powi(2) - self.contrast_variance);
        if !frame.may_search {
            self.missed += 1;
            return Step { measured: None, score: 0.0, certainty: 0.0, nis: None };
        }
        self.find_again(frame, bench).unwrap_or_else(|score| {
            self.missed += 1;
            Step { measured: None, score, certainty: 0.0, nis: None }
        })
    }

    /// Takes what a search finds, if it is believed; else its score.
    fn find_again(&mut self, frame: Frame<'_>, bench: &mut Workbench) -> Result<Step, f64> {
        let found = crate::search::find(self, frame, bench);
        let Some(look) = found.look.filter(|_| found.accepted) else {
            return Err(found.look.map_or(0.0, |look| look.score));
        };
        self.begin_probation(frame.scene);
        for (i, position) in [look.place.x, look.place.y].into_iter().enumerate() {
            let axis = &mut self.axes[i];
            let near = (position - axis.position()).powi(2) < MANOEUVRE * axis.position_variance();
            if self.missed < 20 && near {
                let variance = look.covariance[(i, i)].min(axis.position_variance());
                axis.condition(AxisMeasurement { position, variance });
            } else {
                *axis = look.start(i, frame.config);
            }
        }
        self.seen(look.place);
        self.hypotheses.clear();
        let measured = self.measurement(&look);
        Ok(Step { measured: Some(measured), score: look.score, certainty: 1.0, nis: None })
    }
}
