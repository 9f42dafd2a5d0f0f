//! One target: its reference, its two filters, and one step with one image.

use crossfix_correlation::{Correlator, Plane, Reference, Window};
use crossfix_filter::{AxisFilter, AxisMeasurement, Gate};

use crate::{ImagePoint, PixelBox, TrackerConfig};

/// A measurement of less quality than this is none.
const LEAST_QUALITY: f64 = 0.05;
/// The frame interval to which the coasting velocity's share refers, s.
const COASTING_INTERVAL: f64 = 1.0 / 30.0;

/// Where a reference was found, and how well it fits there.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Match {
    place: ImagePoint,
    score: f64,
}

/// What one step of one target gave.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Step {
    /// The measured place with its variance (px^2, either axis), if there is one.
    pub(crate) measured: Option<(ImagePoint, f64)>,
    /// The correlation at the best place.
    pub(crate) score: f64,
}

/// The filters of both axes; absent until the second measurement.
#[derive(Clone, Debug)]
enum Motion {
    /// One measurement, that of the box: nothing is known of the velocity.
    Still(ImagePoint),
    /// 000: the fourth-order filter splits into two of the second order.
    Moving { x: AxisFilter, y: AxisFilter },
}

/// A target under track.
#[derive(Clone, Debug)]
pub(crate) struct Target {
    /// Sides of the box, px.
    pub(crate) width: f64,
    pub(crate) height: f64,
    reference: Reference,
    anchor: Reference,
    motion: Motion,
    /// Frames in a row without a measurement.
    missed: u32,
    /// Time since the search began, s.
    searching_s: f64,
}

/// 0 below the first value, 1 above the second, linear between.
fn ramp(value: f64, [low, high]: [f64; 2]) -> f64 {
    ((value - low) / (high - low)).clamp(0.0, 1.0)
}

impl Target {
    /// Takes a target up: the box and a margin become the reference (001, object model).
    pub(crate) fn new(image: &Plane, place: PixelBox, config: &TrackerConfig) -> Self {
        let side = |length: f64| (length + 2.0 * config.margin_px).round().max(3.0) as usize;
        let (width, height) = (side(place.width), side(place.height));
        let centre = place.centre();
        let window = Window::gaussian(width, height, config.window_share);
        let crop = image.crop_centred(centre.x, centre.y, width, height);
        let reference = Reference::new(crop, &window);
        Self {
            width: place.width,
            height: place.height,
            anchor: reference.clone(),
            reference,
            motion: Motion::Still(centre),
            missed: 0,
            searching_s: 0.0,
        }
    }

    /// Where the target is believed to be.
    pub(crate) fn position(&self) -> ImagePoint {
        match &self.motion {
            Motion::Still(place) => *place,
            Motion::Moving { x, y } => ImagePoint { x: x.position(), y: y.position() },
        }
    }

    /// Whether it has been missed so often that it is searched for.
    pub(crate) fn is_searching(&self, config: &TrackerConfig) -> bool {
        self.missed >= config.search_after_frames
    }

    /// How fast it is believed to move, px/s.
    pub(crate) fn velocity(&self) -> ImagePoint {
        match &self.motion {
            Motion::Still(_) => ImagePoint { x: 0.0, y: 0.0 },
            Motion::Moving { x, y } => ImagePoint { x: x.velocity(), y: y.velocity() },
        }
    }

    /// Follows the target into the next image, `interval` seconds later.
    pub(crate) fn step(
        &mut self,
        image: &Plane,
        interval: f64,
        correlator: &mut Correlator,
        config: &TrackerConfig,
    ) -> Step {
        match self.motion.clone() {
            Motion::Still(first) => self.second_measurement(first, image, interval, correlator, config),
            Motion::Moving { x, y } => {
                self.motion = Motion::Moving {
                    x: self.predicted(x, interval, image.width(), config),
                    y: self.predicted(y, interval, image.height(), config),
                };
                if self.is_searching(config) {
                    self.searching_s += interval;
                    self.search(image, correlator, config)
                } else {
                    self.follow(image, correlator, config)
                }
            }
        }
    }

    fn predicted(
        &self,
        mut axis: AxisFilter,
        interval: f64,
        side: usize,
        config: &TrackerConfig,
    ) -> AxisFilter {
        axis.time_update(interval);
        if self.missed > 0 {
            axis.damp_velocity(config.coasting_velocity.powf(interval / COASTING_INTERVAL));
        }
        let edge = side as f64 - 1.0;
        if !(0.0..=edge).contains(&axis.position()) {
            // Out of the picture: it is waited for at the border.
            axis.hold_at(axis.position().clamp(0.0, edge));
        }
        axis
    }

    /// The start from two measurements (000, equations 13-14): the box, and the peak after it.
    fn second_measurement(
        &mut self,
        first: ImagePoint,
        image: &Plane,
        interval: f64,
        correlator: &mut Correlator,
        config: &TrackerConfig,
    ) -> Step {
        let found = self.best_match(image, first, [0.0; 2], None, correlator, config);
        let variance = config.measurement_sd_px.powi(2);
        let start = |first: f64, second: f64| {
            let at = |position| AxisMeasurement { position, variance };
            AxisFilter::start(at(first), at(second), interval, config.acceleration_sd_px)
        };
        self.motion = Motion::Moving { x: start(first.x, found.place.x), y: start(first.y, found.place.y) };
        self.adapt(image, found, config);
        Step { measured: Some((found.place, variance)), score: found.score }
    }

    fn follow(&mut self, image: &Plane, correlator: &mut Correlator, config: &TrackerConfig) -> Step {
        let Motion::Moving { x, y } = &self.motion else {
            return Step { measured: None, score: 0.0 };
        };
        let variance = config.measurement_sd_px.powi(2);
        let predicted = self.position();
        let spread = [x.position_variance() + variance, y.position_variance() + variance];
        let found = self.best_match(image, predicted, spread, Some(spread), correlator, config);
        let at = |position| AxisMeasurement { position, variance };
        // The ellipsoidal gate of both axes (001, equation 4.8).
        let nis = x.innovation(at(found.place.x)).normalised_squared()
            + y.innovation(at(found.place.y)).normalised_squared();
        let inside = Gate::with_threshold(config.gate_threshold).holds(nis);
        let quality = if inside { ramp(found.score, config.quality_scores) } else { 0.0 };
        if quality <= LEAST_QUALITY {
            self.missed += 1;
            return Step { measured: None, score: found.score };
        }
        let variance = variance / quality;
        let at = |position| AxisMeasurement { position, variance };
        if let Motion::Moving { x, y } = &mut self.motion {
            x.measurement_update(at(found.place.x));
            y.measurement_update(at(found.place.y));
        }
        self.missed = 0;
        self.adapt(image, found, config);
        Step { measured: Some((found.place, variance)), score: found.score }
    }

    /// Looks for a lost target in a gate that grows.
    fn search(&mut self, image: &Plane, correlator: &mut Correlator, config: &TrackerConfig) -> Step {
        let Motion::Moving { x, y } = &self.motion else {
            return Step { measured: None, score: 0.0 };
        };
        let spread = [x.position_variance(), y.position_variance()];
        let found = self.best_match(image, self.position(), spread, None, correlator, config);
        let quality = ramp(found.score, config.quality_scores);
        if found.score < config.search_score || quality <= LEAST_QUALITY {
            self.missed += 1;
            return Step { measured: None, score: found.score };
        }
        let variance = config.measurement_sd_px.powi(2);
        let start = |position| {
            let first = AxisMeasurement { position, variance };
            AxisFilter::start_at_rest(first, config.search_velocity_sd_px, config.acceleration_sd_px)
        };
        self.motion = Motion::Moving { x: start(found.place.x), y: start(found.place.y) };
        self.missed = 0;
        self.searching_s = 0.0;
        Step { measured: Some((found.place, variance / quality)), score: found.score }
    }

    /// The best place in the gate about `centre`: the peak of the correlation, or with a `prior`
    /// variance an axis, of the correlation and the prediction's log density together.
    fn best_match(
        &self,
        image: &Plane,
        centre: ImagePoint,
        spread: [f64; 2],
        prior: Option<[f64; 2]>,
        correlator: &mut Correlator,
        config: &TrackerConfig,
    ) -> Match {
        let (width, height) = (self.reference.image().width(), self.reference.image().height());
        let grown = config.search_growth_px * self.searching_s;
        let half = |side: usize, variance: f64, limit: usize| {
            let sigmas = (config.gate_sigmas * variance.sqrt()).ceil();
            (side as f64 + grown).max(sigmas).min(limit as f64) as isize
        };
        let half_x = half(width, spread[0], image.width());
        let half_y = half(height, spread[1], image.height());
        // A reference of even sides has its middle between two pixels.
        let offset = |side: usize| if side.is_multiple_of(2) { 0.5 } else { 0.0 };
        let left = centre.x.round() as isize - half_x;
        let top = centre.y.round() as isize - half_y;
        let gate = image.crop(
            left - (width as isize - 1) / 2,
            top - (height as isize - 1) / 2,
            2 * half_x as usize + width,
            2 * half_y as usize + height,
        );
        let anchor = config.anchor_share as f32;
        let references = [(&self.reference, 1.0 - anchor), (&self.anchor, anchor)];
        let scores = correlator.mixed_scores(&gate, &references, config.noise_floor as f32);

        let x_of = |column: f64| left as f64 + column + offset(width);
        let y_of = |row: f64| top as f64 + row + offset(height);
        let (edge_x, edge_y) = (image.width() as f64 - 1.0, image.height() as f64 - 1.0);
        let weight = config.score_weight as f32;
        let penalty = |distance: f64, variance: f64| {
            (0.5 * distance.powi(2) / (variance + config.prediction_floor_px.powi(2))) as f32
        };
        let posterior = Plane::from_fn(scores.width(), scores.height(), |column, row| {
            let (x, y) = (x_of(column as f64), y_of(row as f64));
            if !(0.0..=edge_x).contains(&x) || !(0.0..=edge_y).contains(&y) {
                return f32::NEG_INFINITY;
            }
            let from_prediction =
                prior.map_or(0.0, |[vx, vy]| penalty(x - centre.x, vx) + penalty(y - centre.y, vy));
            weight * scores.row(row)[column] - from_prediction
        });
        let best = posterior.peak();
        let score = scores.row(best.row)[best.column];
        let peak = crossfix_correlation::Peak { score, ..best }.refined(&scores);
        Match { place: ImagePoint { x: x_of(peak.x), y: y_of(peak.y) }, score: f64::from(score) }
    }

    /// Exponential adaptation of the reference, the more the better it fits (003).
    fn adapt(&mut self, image: &Plane, found: Match, config: &TrackerConfig) {
        let share = (1.0 - config.reference_memory) * ramp(found.score, config.adaptation_scores);
        if share > 0.0 {
            let (width, height) = (self.reference.image().width(), self.reference.image().height());
            let crop = image.crop_centred(found.place.x, found.place.y, width, height);
            self.reference = self.reference.adapted(&crop, (1.0 - share) as f32);
        }
    }
}
