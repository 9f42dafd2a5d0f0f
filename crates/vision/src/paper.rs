//! One target followed to the letter of 000 and 001: a gate of three sides about the prediction, one
//! peak of one similarity measure, two Kalman filters of fixed measurement noise.

use crossfix_correlation::{Extent, Plane, Reference, Window};
use crossfix_filter::{AxisFilter, AxisMeasurement, Innovation};
use nalgebra::Matrix2;

use crate::mend::mend;
use crate::reference::Adaptation;
use crate::target::{Step, Workbench, predict};
use crate::tracker::Measurement;
use crate::{ImagePoint, PixelBox, TrackerConfig};

/// A target under track.
#[derive(Clone, Debug)]
pub(crate) struct PaperTarget {
    pub(crate) size: [f64; 2],
    reference: Reference,
    adaptation: Adaptation,
    /// Absent until the second measurement (000 (13)-(14)).
    axes: Option<[AxisFilter; 2]>,
    first: ImagePoint,
}

impl PaperTarget {
    pub(crate) fn new(image: &Plane, place: PixelBox, config: &TrackerConfig) -> Self {
        let centre = place.centre();
        let times = if config.paper.whole_gate { 3.0 } else { 1.0 };
        let side = |length: f64| (times * length).round().max(1.0) as usize;
        let (width, height) = (side(place.width), side(place.height));
        let first = crop(image, centre, width, height);
        let noise = (config.noise_floor * config.noise_floor) as f32;
        Self {
            size: [place.width, place.height],
            adaptation: Adaptation::new(config.reference, &first, noise, config.noise_floor as f32),
            reference: Reference::new(first, Window::uniform(width, height)),
            axes: None,
            first: centre,
        }
    }

    pub(crate) fn position(&self) -> ImagePoint {
        self.axes.as_ref().map_or(self.first, |[x, y]| ImagePoint { x: x.position(), y: y.position() })
    }

    pub(crate) fn velocity(&self) -> ImagePoint {
        let still = ImagePoint { x: 0.0, y: 0.0 };
        self.axes.as_ref().map_or(still, |[x, y]| ImagePoint { x: x.velocity(), y: y.velocity() })
    }

    pub(crate) fn axes(&self) -> Option<&[AxisFilter; 2]> {
        self.axes.as_ref()
    }

    fn at(position: f64, config: &TrackerConfig) -> AxisMeasurement {
        AxisMeasurement { position, variance: config.paper.measurement_sd_px.powi(2) }
    }

    /// The start from two measurements (000 (13)-(14)).
    pub(crate) fn take_place(&mut self, place: ImagePoint, interval: f64, config: &TrackerConfig) -> Step {
        let at = |position| Self::at(position, config);
        let start =
            |first, second| AxisFilter::start(at(first), at(second), interval, config.acceleration_sd_px);
        self.axes = Some([start(self.first.x, place.x), start(self.first.y, place.y)]);
        self.answer(place, 1.0, None, config)
    }

    fn answer(&self, place: ImagePoint, score: f64, nis: Option<f64>, config: &TrackerConfig) -> Step {
        let covariance = Matrix2::identity() * config.paper.measurement_sd_px.powi(2);
        Step { measured: Some(Measurement { place, covariance }), score, certainty: 1.0, nis }
    }

    pub(crate) fn step(
        &mut self,
        image: &Plane,
        interval: f64,
        bench: &mut Workbench,
        config: &TrackerConfig,
    ) -> Step {
        if let Some(axes) = &mut self.axes {
            predict(axes, interval, image);
        }
        let predicted = self.position();
        let gate_middle = ImagePoint { x: predicted.x.round(), y: predicted.y.round() };
        let sides = self.size.map(|side| (3.0 * side).round().max(1.0) as usize);
        bench.gate = crop(image, gate_middle, sides[0], sides[1]);
        let extent = config.paper.extent;
        bench.correlator.similarity(
            &bench.gate,
            &self.reference,
            config.paper.similarity,
            extent,
            config.noise_floor as f32,
            &mut bench.ratios,
        );
        let peak = bench.ratios.peak();
        let refined = if config.paper.sub_pixel { peak.refined(&bench.ratios) } else { peak.whole() };
        let reference = self.reference.image();
        let (width, height) = (reference.width(), reference.height());
        let offset = |at: f64, gate: usize, reference: usize| {
            // Where the reference lies against the middle of the gate; wrapped round, it lies before it.
            let offset = at - (gate as f64 - reference as f64) / 2.0;
            let wraps = extent == Extent::Circular && offset > gate as f64 / 2.0;
            if wraps { offset - gate as f64 } else { offset }
        };
        let place = ImagePoint {
            x: gate_middle.x + offset(refined.x, bench.gate.width(), width),
            y: gate_middle.y + offset(refined.y, bench.gate.height(), height),
        };
        let nis = if let Some([x, y]) = &mut self.axes {
            let innovations = [
                x.measurement_update(Self::at(place.x, config)),
                y.measurement_update(Self::at(place.y, config)),
            ];
            Some(innovations.iter().map(Innovation::normalised_squared).sum())
        } else {
            self.take_place(place, interval, config);
            None
        };
        let seen = crop(image, self.position(), width, height);
        let noise = bench.meter.variance(&bench.gate, config.noise_floor as f32);
        let adaptation = &mut self.adaptation;
        self.reference.update(|own| adaptation.take_in(own, &seen, noise, 1.0, interval as f32));
        self.answer(place, f64::from(peak.score), nis, config)
    }
}

/// The part of an image about a place rounded to whole pixels; one of even sides has its middle half
/// a pixel further.
fn crop(image: &Plane, middle: ImagePoint, width: usize, height: usize) -> Plane {
    let start = |at: f64, side: usize| (at - (side as f64 - 1.0) / 2.0).round() as isize;
    let mut part = image.crop(start(middle.x, width), start(middle.y, height), width, height);
    mend(&mut part);
    part
}
