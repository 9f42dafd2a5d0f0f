//! One target followed to the letter of Herasymenko 2021 and Lytvynets 2020: a gate of three sides
//! about the prediction, one peak of one similarity measure, two Kalman filters of fixed
//! measurement noise.

use crossfix_correlation::{Extent, Plane, Reference, Window};
use crossfix_filter::{AxisFilter, AxisMeasurement, Innovation};
use nalgebra::Matrix2;

use crate::crop::replace_invalid;
use crate::frame::{Measurement, TargetStep};
use crate::reference::Adaptation;
use crate::scratch::Scratch;
use crate::{ImagePoint, PixelBox, TrackerConfig};

/// A target under track.
#[derive(Clone, Debug)]
pub(crate) struct PaperTarget {
    pub(crate) size: [f64; 2],
    reference: Reference,
    adaptation: Adaptation,
    /// Absent until the second measurement (Herasymenko 2021, eqs. 13-14).
    axes: Option<[AxisFilter; 2]>,
    first: ImagePoint,
    /// Offset of the box's middle from the middle of the reference, which is cut at whole pixels.
    middle: [f64; 2],
}

impl PaperTarget {
    pub(crate) fn new(image: &Plane, place: PixelBox, config: &TrackerConfig) -> Self {
        let centre = place.centre();
        let times = if config.paper.whole_gate { 3.0 } else { 1.0 };
        let side = |length: f64| (times * length).round().max(1.0) as usize;
        let (width, height) = (side(place.width), side(place.height));
        let (first, start) = crop(image, centre, width, height);
        // The reference is cut at whole pixels; the box's middle lies off its middle by a part of
        // one.
        let middle = [
            centre.x - start[0] - (width as f64 - 1.0) / 2.0,
            centre.y - start[1] - (height as f64 - 1.0) / 2.0,
        ];
        let noise = (config.noise_floor * config.noise_floor) as f32;
        Self {
            size: [place.width, place.height],
            adaptation: Adaptation::new(config.reference, &first, noise, config.noise_floor as f32),
            reference: Reference::new(first, Window::uniform(width, height)),
            axes: None,
            first: centre,
            middle,
        }
    }

    pub(crate) fn position(&self) -> ImagePoint {
        self.axes
            .as_ref()
            .map_or(self.first, |[x, y]| ImagePoint { x: x.position(), y: y.position() })
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

    /// Takes a place from somebody who knows it; after the box alone this starts the filters from
    /// two measurements (Herasymenko 2021, eqs. 13-14).
    pub(crate) fn take_place(
        &mut self,
        image: &Plane,
        place: ImagePoint,
        interval: f64,
        config: &TrackerConfig,
    ) -> TargetStep {
        let at = |position| Self::at(position, config);
        if let Some(axes) = &mut self.axes {
            predict(axes, interval, image);
            axes[0].measurement_update(at(place.x));
            axes[1].measurement_update(at(place.y));
        } else {
            let start = |first, second| {
                AxisFilter::start(at(first), at(second), interval, config.acceleration_sd_px)
            };
            self.axes = Some([start(self.first.x, place.x), start(self.first.y, place.y)]);
        }
        self.answer(place, 1.0, None, config)
    }

    fn answer(
        &self,
        place: ImagePoint,
        score: f64,
        nis: Option<f64>,
        config: &TrackerConfig,
    ) -> TargetStep {
        let covariance = Matrix2::identity() * config.paper.measurement_sd_px.powi(2);
        TargetStep { measured: Some(Measurement { place, covariance }), score, certainty: 1.0, nis }
    }

    pub(crate) fn step(
        &mut self,
        image: &Plane,
        interval: f64,
        scratch: &mut Scratch,
        config: &TrackerConfig,
    ) -> TargetStep {
        if let Some(axes) = &mut self.axes {
            predict(axes, interval, image);
        }
        let predicted = self.position();
        let gate_middle = ImagePoint { x: predicted.x.round(), y: predicted.y.round() };
        let sides = self.size.map(|side| (3.0 * side).round().max(1.0) as usize);
        let (gate, start) = crop(image, gate_middle, sides[0], sides[1]);
        scratch.gate = gate;
        let extent = config.paper.extent;
        scratch.correlator.similarity(
            &scratch.gate,
            &self.reference,
            config.paper.similarity,
            extent,
            config.noise_floor as f32,
            &mut scratch.ratios,
        );
        let peak = scratch.ratios.peak();
        let refined =
            if config.paper.sub_pixel { peak.refined(&scratch.ratios) } else { peak.whole() };
        let reference = self.reference.image();
        let (width, height) = (reference.width(), reference.height());
        let (gate_width, gate_height) = (scratch.gate.width(), scratch.gate.height());
        let place = ImagePoint {
            x: start[0] + reference_middle(refined.x, width, gate_width, extent) + self.middle[0],
            y: start[1] + reference_middle(refined.y, height, gate_height, extent) + self.middle[1],
        };
        let nis = if let Some([x, y]) = &mut self.axes {
            let innovations = [
                x.measurement_update(Self::at(place.x, config)),
                y.measurement_update(Self::at(place.y, config)),
            ];
            Some(innovations.iter().map(Innovation::normalised_squared).sum())
        } else {
            // The second measurement starts the filters (Herasymenko 2021, eqs. 13-14).
            self.take_place(image, place, interval, config);
            None
        };
        let (seen, _) = crop(image, self.position(), width, height);
        let noise = scratch.meter.variance(&scratch.gate, config.noise_floor as f32);
        let adaptation = &mut self.adaptation;
        self.reference.update(|own| {
            adaptation.take_in(own, &seen, noise, 1.0, interval as f32);
        });
        self.answer(place, f64::from(peak.score), nis, config)
    }
}

/// Predicts both axes; a target that leaves the picture is kept at its border.
fn predict(axes: &mut [AxisFilter; 2], interval: f64, image: &Plane) {
    for (axis, side) in axes.iter_mut().zip([image.width(), image.height()]) {
        axis.time_update(interval);
        let edge = side as f64 - 1.0;
        if !(0.0..=edge).contains(&axis.position()) {
            axis.hold_at(axis.position().clamp(0.0, edge));
        }
    }
}

/// Where on an axis of the gate the middle of a reference is that is placed at `at`, px.
fn reference_middle(at: f64, reference: usize, gate: usize, extent: Extent) -> f64 {
    // Circular correlation: placed more than half a gate from the middle, the reference comes in on
    // the other side.
    let off = at - (gate as f64 - reference as f64) / 2.0;
    let wraps = extent == Extent::Circular && off > gate as f64 / 2.0;
    at + (reference as f64 - 1.0) / 2.0 - if wraps { gate as f64 } else { 0.0 }
}

/// The part of an image about a place, cut at whole pixels, and where its first pixel is.
fn crop(image: &Plane, middle: ImagePoint, width: usize, height: usize) -> (Plane, [f64; 2]) {
    let start = [(middle.x, width), (middle.y, height)]
        .map(|(at, side)| (at - (side as f64 - 1.0) / 2.0).round());
    let mut part = image.crop(start[0] as isize, start[1] as isize, width, height);
    replace_invalid(&mut part);
    (part, start)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_of_even_sides_that_stands_still_is_measured_where_it_is() {
        for (whole_gate, extent) in
            [(true, Extent::Circular), (false, Extent::Linear), (false, Extent::Circular)]
        {
            let mut config = TrackerConfig::paper();
            (config.paper.whole_gate, config.paper.extent) = (whole_gate, extent);
            let image = Plane::from_fn(120, 90, |x, y| {
                let (dx, dy) = (x as f32 - 60.0, y as f32 - 45.0);
                10.0 + 90.0 * (-(dx * dx + dy * dy) / 18.0).exp()
            });
            let place = PixelBox { x: 50.0, y: 38.0, width: 20.0, height: 14.0 };
            let mut target = PaperTarget::new(&image, place, &config);
            let mut scratch = Scratch::default();
            for _ in 0..20 {
                let step = target.step(&image, 1.0 / 30.0, &mut scratch, &config);
                let measured = step.measured.map(|m| m.place);
                assert_eq!(measured, Some(place.centre()), "{whole_gate} {extent:?}");
            }
        }
    }
}
