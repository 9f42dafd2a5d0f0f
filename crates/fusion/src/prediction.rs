//! A track's predicted bearing for one camera: computed once per exposure, and compared with every
//! bearing of the exposure.

use std::f64::consts::PI;

use crossfix_filter::{Gate, Imm, KinematicState, MAX_MODELS, ModelWeights, MotionModels};
use crossfix_geometry::{BearingModel, SightLine};
use nalgebra::{Matrix2, Point3, Vector2};

use crate::uncertainty::{CameraUncertainty, SharedErrors};

/// The predicted bearing of a target for one camera, with its covariance.
#[derive(Clone, Debug)]
pub(crate) struct BearingPrediction {
    model: BearingModel,
    /// Factor on the covariances that the camera reports.
    factor: f64,
    /// The spread given what is known of the camera's errors.
    known: Spread,
    /// The spread if the camera's lasting errors have been drawn again (a label or an image tracker
    /// has jumped), and the probability of that.
    renewed: Option<(Spread, f64)>,
    /// Variance that each model's process noise adds along both tangents, rad^2, and the models'
    /// probabilities.
    added: ModelWeights,
    weights: ModelWeights,
    /// The largest of these variances, rad^2: the gate's.
    widest: f64,
}

/// Mean and covariance of a bearing about the expected direction, along the tangents.
#[derive(Clone, Copy, Debug)]
struct Spread {
    /// Shift of the bearing by the estimated errors of the camera, rad.
    shifted: Vector2<f64>,
    /// Covariance of the direction, rad^2: of the state without this step's process noise, and of
    /// the camera's pose and clock; the bearing's own noise comes on top.
    steady: Matrix2<f64>,
}

/// How well a bearing fits a prediction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct BearingFit {
    /// Squared Mahalanobis distance with the process noise of the liveliest model: the gate's test.
    pub(crate) gate_distance: f64,
    /// Logarithm of the bearing's probability density over all models, 1/sr.
    pub(crate) log_density: f64,
}

impl BearingFit {
    /// Log-likelihood ratio of two explanations of the bearing: a target that is detected with
    /// probability `detection`, or clutter of density `clutter_per_sr` (1/sr).
    pub(crate) fn log_ratio(&self, detection: f64, clutter_per_sr: f64) -> f64 {
        detection.ln() + self.log_density - clutter_per_sr.ln()
    }

    /// The likelier of two explanations of a bearing: that the camera's errors are as known, or
    /// that the lasting ones have been drawn again, which has the given probability.
    pub(crate) fn likelier(
        known: Option<Self>,
        renewed: Option<Self>,
        probability: f64,
    ) -> Option<Self> {
        let known = known.map(|fit| fit.weighed(1.0 - probability));
        let renewed = renewed.map(|fit| fit.weighed(probability));
        let both = [known, renewed].into_iter().flatten();
        both.max_by(|a, b| a.log_density.total_cmp(&b.log_density))
    }

    fn weighed(self, probability: f64) -> Self {
        Self { log_density: self.log_density + probability.ln(), ..self }
    }
}

impl BearingPrediction {
    /// The prediction of `imm` over `interval` seconds for a camera at `origin`; `None` if the
    /// target would be at the camera itself.
    pub(crate) fn new(
        imm: &Imm,
        interval: f64,
        models: &MotionModels,
        origin: Point3<f64>,
        uncertainty: &CameraUncertainty,
        errors: &SharedErrors,
    ) -> Option<Self> {
        // Process noise is isotropic: along the tangents it adds a multiple of the identity, so
        // only the part of the state that all models share has to be projected.
        let state: KinematicState = imm.combined().predicted(interval, 0.0);
        let model = BearingModel::new(origin, state.position())?;
        let by = model.by_position();
        let shifts = uncertainty.shifts(&model, state.velocity());
        let clock = uncertainty.noise(&model, state.velocity(), &Matrix2::zeros());
        // H P H', with H = E' / r.
        let placed = by * state.position_covariance() * by.transpose();
        let spread = |errors: &SharedErrors| {
            // H X J', with X the track's covariance with the shared errors.
            let cross = by * errors.ties.fixed_rows::<3>(0) * shifts.transpose();
            let steady = placed + cross + cross.transpose() + errors.spread(&shifts) + clock;
            Spread { shifted: shifts * errors.mean, steady }
        };
        // White acceleration of density q moves a position by a variance of q t^3 / 3.
        let moved = interval.abs().powi(3) / 3.0 / model.range.powi(2);
        let mut added = [0.0; MAX_MODELS];
        for (variance, model) in added.iter_mut().zip(models.models()) {
            *variance = model.density * moved;
        }
        Some(Self {
            model,
            factor: uncertainty.factor,
            known: spread(errors),
            renewed: errors
                .renewed()
                .map(|(drawn_again, probability)| (spread(&drawn_again), probability)),
            added,
            weights: imm.predicted_probabilities(interval, models),
            widest: models.widest() * moved,
        })
    }

    /// The predicted bearing of a state, at the state's time, for a camera at `origin`; between
    /// that time and the exposure the target may have moved by `moved` (m, standard deviation per
    /// axis).
    pub(crate) fn of_state(
        state: &KinematicState,
        origin: Point3<f64>,
        moved: f64,
    ) -> Option<Self> {
        let model = BearingModel::new(origin, state.position())?;
        let by = model.by_position();
        let steady = by * state.position_covariance() * by.transpose()
            + Matrix2::identity() * (moved / model.range).powi(2);
        // One model without process noise: `moved` stands for the motion.
        let mut weights = [0.0; MAX_MODELS];
        weights[0] = 1.0;
        let known = Spread { shifted: Vector2::zeros(), steady };
        let added = [0.0; MAX_MODELS];
        Some(Self { model, factor: 1.0, known, renewed: None, added, weights, widest: 0.0 })
    }

    /// How well a bearing fits; `None` if it lies outside the gate. Of the two cases, that the
    /// camera's lasting errors went on or that they were drawn again, the likelier is used.
    pub(crate) fn fit(&self, line: &SightLine, gate: Gate) -> Option<BearingFit> {
        let residual = self.model.residual(line)?;
        let known = self.fit_by(&self.known, residual, line, gate);
        let Some((renewed, probability)) = &self.renewed else { return known };
        BearingFit::likelier(known, self.fit_by(renewed, residual, line, gate), *probability)
    }

    fn fit_by(
        &self,
        by: &Spread,
        residual: Vector2<f64>,
        line: &SightLine,
        gate: Gate,
    ) -> Option<BearingFit> {
        let innovation = residual - by.shifted;
        // A variance along any axis is at most the trace: this cheap test rejects most bearings.
        let longest = by.steady.trace() + 2.0 * self.widest + line.covariance.trace() * self.factor;
        if innovation.norm_squared() > gate.threshold() * longest {
            return None;
        }
        // S without the process noise, which each model adds in its turn.
        let spread = by.steady + self.model.covariance_of(line) * self.factor;
        let gate_distance = distance(&spread, self.widest, innovation)?.squared;
        if !gate.holds(gate_distance) {
            return None;
        }
        // Mixture over the models: sum of w_i N(z; 0, S + q_i I).
        let mut density = 0.0;
        for (&added, &weight) in self.added.iter().zip(&self.weights) {
            if weight > 0.0 {
                let MahalanobisDistance { squared, determinant } =
                    distance(&spread, added, innovation)?;
                density += weight * (-squared / 2.0).exp() / (2.0 * PI * determinant.sqrt());
            }
        }
        Some(BearingFit { gate_distance, log_density: density.ln() })
    }
}

/// Mahalanobis distance of a vector.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MahalanobisDistance {
    /// Its square.
    pub(crate) squared: f64,
    /// Determinant of the covariance.
    pub(crate) determinant: f64,
}

/// Logarithm of a two-dimensional normal density of mean 0.
pub(crate) fn log_density(covariance: &Matrix2<f64>, vector: Vector2<f64>) -> Option<f64> {
    let MahalanobisDistance { squared, determinant } = distance(covariance, 0.0, vector)?;
    Some(-squared / 2.0 - (2.0 * PI).ln() - determinant.ln() / 2.0)
}

/// Distance of a vector for `covariance + I added`.
fn distance(
    covariance: &Matrix2<f64>,
    added: f64,
    vector: Vector2<f64>,
) -> Option<MahalanobisDistance> {
    let [xx, xy, yy] = [covariance.m11 + added, covariance.m12, covariance.m22 + added];
    let determinant = xx * yy - xy * xy;
    let squared = (yy * vector.x * vector.x - 2.0 * xy * vector.x * vector.y
        + xx * vector.y * vector.y)
        / determinant;
    // A negative definite matrix has a positive determinant too, so the first element is tested as
    // well.
    let is_possible = determinant > 0.0 && xx > 0.0 && squared.is_finite();
    is_possible.then_some(MahalanobisDistance { squared, determinant })
}

#[cfg(test)]
mod tests {
    use crossfix_filter::{ModeRates, MotionModel};
    use nalgebra::{Matrix6, Vector6};

    use super::*;
    use crate::spatial::tests_support::line_at;

    #[test]
    fn a_true_bearing_fits_and_the_liveliest_model_opens_the_gate() {
        let model = |density, share| MotionModel { density, share, calm: density == 0.0 };
        let rates = ModeRates { switching_per_s: 0.1, calming_per_s: 0.1, prior_s: 20.0 };
        let models = MotionModels::new(&[model(0.0, 0.9), model(5.0, 0.1)], rates).unwrap();
        let state = KinematicState {
            mean: Vector6::new(0.0, 0.0, 50.0, 10.0, 0.0, 0.0),
            covariance: Matrix6::identity() * 0.01,
        };
        let imm = Imm::new(state, &models);
        let camera = Point3::new(5.0, -100.0, 0.0);
        let prediction = BearingPrediction::new(
            &imm,
            1.0,
            &models,
            camera,
            &CameraUncertainty::of_time(0.0),
            &SharedErrors::unknown(),
        )
        .unwrap();
        let gate = Gate::with_probability(0.9999);
        let fit =
            |x: f64| prediction.fit(&line_at(camera, Point3::new(x, 0.0, 50.0), 1.0).line, gate);
        let near = |x: f64| fit(x).unwrap();
        assert!(near(10.0).gate_distance < 1e-9);
        // Two metres aside: twelve sigma of the quiet model, 1.5 of the lively one.
        assert!((1.5..3.0).contains(&near(12.0).gate_distance), "{:?}", near(12.0));
        assert!(near(12.0).log_density < near(10.0).log_density - 3.0);
        assert!(fit(40.0).is_none());
        let behind = line_at(camera, Point3::new(0.0, -200.0, -50.0), 1.0);
        assert!(prediction.fit(&behind.line, gate).is_none());
    }
}
