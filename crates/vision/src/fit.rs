//! Fit of the reference between the pixels, where the target is believed to be: the measurement.

use crossfix_correlation::{Fit, FitOptions, Freedom};
use crossfix_filter::AxisMeasurement;
use nalgebra::Matrix2;

use crate::appearance::Drift;
use crate::frame::Measurement;
use crate::scratch::Scratch;
use crate::state::TargetBelief;
use crate::{ImagePoint, TrackerConfig};

/// Floor of a measurement's standard deviation, px: the bias of the fit over the phases of a pixel,
/// which does not show in the residuals. With half of it a bright target without noise promises a
/// quarter of the variance that this bias has.
const LEAST_MEASUREMENT_SD: f64 = 0.005;
/// Residuals beyond those of the noise and of the reference come from something else in front of
/// the target. They change together over connected parts of this many pixels, and so displace the
/// fit like noise of this many times their variance. With half of it a target behind branches
/// promises 0.7 of the standard deviation that it should.
const PIXELS_PER_PART: f64 = 10.0;

/// Largest standard deviation of a measurement, px: a place measured no better is unknown, and gets
/// this one. With half of it the same: 500 px say nothing either.
const MOST_MEASUREMENT_SD: f64 = 1e3;

/// A reference fitted to the image at the best placement.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TargetFit {
    pub(crate) place: ImagePoint,
    pub(crate) covariance: Matrix2<f64>,
    /// The target's contrast, as a multiple of the reference's.
    pub(crate) contrast: f64,
    /// Change of log scale, and of turn (rad).
    pub(crate) shape: Option<[ShapeChange; 2]>,
    /// Correlation coefficient, with the noise taken out.
    pub(crate) score: f64,
}

/// A measured change of a target's size or direction.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ShapeChange {
    pub(crate) change: f64,
    pub(crate) variance: f64,
}

impl TargetFit {
    /// Where the reference is found, as a measurement per axis.
    pub(crate) fn found(&self) -> [AxisMeasurement; 2] {
        let Self { place, covariance, .. } = self;
        [(place.x, covariance.m11), (place.y, covariance.m22)]
            .map(|(position, variance)| AxisMeasurement { position, variance })
    }
}

impl TargetBelief {
    /// Fits the reference at a placement of the gate, given by column and row.
    pub(crate) fn fit_at(
        &mut self,
        column: usize,
        row: usize,
        origin: [f64; 2],
        scratch: &mut Scratch,
        config: &TrackerConfig,
    ) -> TargetFit {
        let working = &self.appearance.working;
        let freedom = if config.follow_shape { Freedom::ShiftScaleTurn } else { Freedom::Shift };
        let options = FitOptions { steps: 2, freedom, ..FitOptions::default() };
        let fit =
            scratch.buffers.fitter.fit(&scratch.gate, working, column as f64, row as f64, options);
        // The image's noise, to two standard deviations of its estimate, and the reference's own
        // noise explain part of the residuals; the rest is of another kind, and lies in connected
        // parts.
        let (pixels, image_noise) = (fit.pixels as f64, f64::from(self.noise));
        let least_contrast = 0.1 * self.contrast * f64::from(self.appearance.clear_share());
        let contrast = fit.gain.max(least_contrast);
        let expected = f64::from(self.appearance.noise() + self.appearance.filtered_out())
            * contrast
            * contrast;
        let explained = image_noise * (1.0 + 2.0 * (2.0 / pixels).sqrt());
        let unexplained = (fit.residual_variance - explained - expected).max(0.0);
        let noise = image_noise + PIXELS_PER_PART * unexplained;
        let covariance = self.covariance(&fit, self.motion.noise_factor() * noise, contrast);
        // The reference may have drifted off its anchor meanwhile.
        let drift = self.appearance.in_image(self.appearance.drift);
        let place = ImagePoint { x: origin[0] + fit.x + drift[0], y: origin[1] + fit.y + drift[1] };
        // The fit's variances are proportional to noise / gain^2; this makes them those at
        // `contrast`.
        let scaled = noise * (fit.gain / contrast).powi(2);
        let Drift { log_scale, turn_rad, .. } = self.appearance.drift;
        let shape = fit.shape_variances(scaled).map(|[scale, turn]| {
            [
                ShapeChange { change: fit.log_scale + log_scale, variance: scale },
                ShapeChange { change: fit.turn_rad + turn_rad, variance: turn },
            ]
        });
        // Correlation coefficient sqrt(signal / (signal + rest)), the rest being neither signal nor
        // noise.
        let energy = fit.gain.max(0.0).powi(2) * f64::from(self.appearance.energy());
        let rest = (pixels * (fit.residual_variance - image_noise)).max(0.0);
        let score = (energy / (energy + rest + 1e-12)).sqrt();
        TargetFit { place, covariance, contrast, shape, score }
    }

    /// Measurement of the target's place by a fit: the reference's offset is taken out, and the
    /// offset's variance added to the fit's covariance.
    pub(crate) fn measurement(&self, fit: &TargetFit) -> Measurement {
        let [x, y] = self.motion.offset();
        let place = ImagePoint { x: fit.place.x - x.position, y: fit.place.y - y.position };
        Measurement {
            place,
            covariance: fit.covariance + Matrix2::new(x.variance, 0.0, 0.0, y.variance),
        }
    }

    /// Covariance of a fit by a reference that differs from the target itself: see
    /// [`crate::appearance`]'s `steepness`.
    fn covariance(&self, fit: &Fit, noise: f64, contrast: f64) -> Matrix2<f64> {
        // The Cramer-Rao bound at `contrast`, which is the fitted gain unless that is too small.
        let Some(bound) = fit.covariance(noise * (fit.gain / contrast).powi(2)) else {
            return Matrix2::identity();
        };
        let steepness = self.appearance.steepness();
        let floor = LEAST_MEASUREMENT_SD.powi(2);
        let covariance = Matrix2::from_fn(|i, j| {
            bound[(i, j)] / (steepness[i] * steepness[j]) + if i == j { floor } else { 0.0 }
        });
        let is_known = covariance.m11.max(covariance.m22) <= MOST_MEASUREMENT_SD.powi(2);
        if is_known { covariance } else { Matrix2::identity() * MOST_MEASUREMENT_SD.powi(2) }
    }
}
