//! The reference fitted between the pixels, where the target is believed to be: the measurement.

use crossfix_correlation::{Fit, FitOptions, Freedom};
use crossfix_filter::{AxisFilter, AxisMeasurement};
use nalgebra::Matrix2;

use crate::appearance::Drift;
use crate::target::{LEAST_MEASUREMENT_SD, Target, Workbench};
use crate::{ImagePoint, TrackerConfig};

/// How much of what the reference does not explain counts as noise: it is not white.
const UNEXPLAINED_WEIGHT: f64 = 10.0;
/// A fit's variance over the bound, and what is added to it for each time that the noise's energy holds
/// the target's. Measured: `validate tracker` shows the consistency that follows.
const FIT_LOSS: f64 = 1.1;
const FIT_LOSS_IN_NOISE: f64 = 0.035;

/// A reference fitted to the image at the best placement.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Look {
    pub(crate) place: ImagePoint,
    pub(crate) covariance: Matrix2<f64>,
    /// Contrast over the reference's.
    pub(crate) contrast: f64,
    /// Log scale and turn, with their variances.
    pub(crate) shape: Option<[(f64, f64); 2]>,
    /// Correlation with the noise taken out.
    pub(crate) score: f64,
}

impl Look {
    /// The filter of an axis that begins here, of a target that moves as one does that was lost.
    pub(crate) fn start(&self, axis: usize, config: &TrackerConfig) -> AxisFilter {
        let position = [self.place.x, self.place.y][axis];
        let first = AxisMeasurement { position, variance: self.covariance[(axis, axis)] };
        AxisFilter::start_at_rest(first, config.search_velocity_sd_px, config.acceleration_sd_px)
    }
}

impl Target {
    /// Fits the reference at a placement of the gate.
    pub(crate) fn look(
        &mut self,
        column: usize,
        row: usize,
        origin: [f64; 2],
        bench: &mut Workbench,
        config: &TrackerConfig,
    ) -> Look {
        let working = &self.appearance.working;
        let freedom = if config.follow_shape { Freedom::ShiftScaleTurn } else { Freedom::Shift };
        let options = FitOptions { steps: 2, freedom, ..FitOptions::default() };
        let fit = bench.workshop.fitter.fit(&bench.gate, working, column as f64, row as f64, options);
        let (pixels, image_noise) = (fit.pixels as f64, f64::from(self.noise));
        let least_contrast = 0.1 * self.contrast * f64::from(self.appearance.clear_share());
        let contrast = fit.gain.max(least_contrast);
        let (reference_noise, slope_noise) = self.appearance.noise();
        let explained = image_noise * (1.0 + 2.0 * (2.0 / pixels).sqrt());
        let unexplained =
            (fit.residual_variance - explained - f64::from(reference_noise) * contrast * contrast).max(0.0);
        let noise = image_noise + UNEXPLAINED_WEIGHT * unexplained;
        let energy = contrast.powi(2) * f64::from(self.appearance.energy()).max(1e-12);
        let inverse_ratio = f64::from(self.appearance.pixels()) * image_noise / energy;
        let loss = FIT_LOSS + FIT_LOSS_IN_NOISE * inverse_ratio.min(10.0);
        let covariance = self.covariance(&fit, loss * noise, f64::from(slope_noise) * pixels, contrast);
        let drift = self.appearance.in_image(self.appearance.drift);
        let place = ImagePoint { x: origin[0] + fit.x + drift[0], y: origin[1] + fit.y + drift[1] };
        let scaled = noise * (fit.gain / contrast).powi(2);
        let Drift { log_scale, turn_rad, .. } = self.appearance.drift;
        let shape = fit
            .shape_variances(scaled)
            .map(|[scale, turn]| [(fit.log_scale + log_scale, scale), (fit.turn_rad + turn_rad, turn)]);
        let energy = fit.gain.max(0.0).powi(2) * f64::from(self.appearance.energy());
        let rest = (pixels * (fit.residual_variance - image_noise)).max(0.0);
        let score = (energy / (energy + rest + 1e-12)).sqrt();
        Look { place, covariance, contrast, shape, score }
    }

    /// The covariance of a fit: the bound in the image's noise, and what of the reference's gradient
    /// is itself noise.
    fn covariance(&self, fit: &Fit, noise: f64, slope_noise: f64, contrast: f64) -> Matrix2<f64> {
        let Some(bound) = fit.covariance(noise * (fit.gain / contrast).powi(2)) else {
            return Matrix2::identity();
        };
        let clear =
            fit.gradient_energy.map(|energy| (1.0 - slope_noise / energy.max(1e-12)).clamp(0.15, 1.0));
        let floor = LEAST_MEASUREMENT_SD.powi(2);
        Matrix2::from_fn(|i, j| {
            bound[(i, j)] / (clear[i] * clear[j]).sqrt() + if i == j { floor } else { 0.0 }
        })
    }
}
