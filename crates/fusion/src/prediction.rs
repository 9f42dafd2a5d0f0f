//! A track's prediction as one camera sees it: computed once an exposure, compared with every
//! bearing of it.

use std::f64::consts::PI;

use crossfix_filter::{Gate, Imm, KinematicState, MAX_MODELS, ModelWeights, MotionModels};
use crossfix_geometry::{BearingModel, SightLine};
use nalgebra::{Matrix2, Matrix3x2, Point3, Vector2};

use crate::uncertainty::{CameraUncertainty, SharedErrors};

/// Where a camera should see a target, and how surely.
#[derive(Clone, Debug)]
pub(crate) struct BearingPrediction {
    model: BearingModel,
    factor: f64,
    /// By what is known of the camera's errors.
    known: Spread,
    /// The same where those that last have been drawn anew, and the probability of that.
    renewed: Option<(Spread, f64)>,
    /// What each model's process noise adds along both tangents, rad^2, and its probability.
    added: ModelWeights,
    weights: ModelWeights,
    widest: f64,
}

/// How far a bearing may lie from the direction that is expected, along the tangents.
#[derive(Clone, Copy, Debug)]
struct Spread {
    /// What the camera's errors are thought to shift the bearing by, rad.
    shifted: Vector2<f64>,
    /// Covariance of the direction without the process noise of this step, with what pose and clock
    /// of the camera add, rad^2.
    steady: Matrix2<f64>,
    /// What poses and clocks of the camera shift all its bearings by, rad^2, and how that goes with
    /// the track's error.
    shift: Matrix2<f64>,
    cross: Matrix2<f64>,
}

/// A line of which a track has been made, along the tangents.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Beginning {
    /// What of it the track leaves, rad.
    pub(crate) left: Vector2<f64>,
    /// Covariances of the camera's shift, of the line's noise, and of the track's place as seen
    /// from there, rad^2.
    pub(crate) shift: Matrix2<f64>,
    pub(crate) noise: Matrix2<f64>,
    pub(crate) placed: Matrix2<f64>,
}

/// A bearing against a prediction, with what its camera shifts all of its bearings by apart, along
/// the tangents.
#[derive(Clone, Copy, Debug)]
pub(crate) struct GivenShift {
    /// Covariance of the shift, rad^2.
    pub(crate) shift: Matrix2<f64>,
    /// What of a shift the bearing is off by: the track has taken the rest of it in.
    pub(crate) left: Matrix2<f64>,
    /// Covariance of the rest, rad^2.
    pub(crate) spread: Matrix2<f64>,
}

/// How a bearing fits a prediction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Fit {
    /// Squared Mahalanobis distance under the liveliest of the models: what the gate looks at.
    pub(crate) gate_distance: f64,
    /// Logarithm of the bearing's density over all models, 1/sr.
    pub(crate) log_density: f64,
}

impl Fit {
    /// Log-likelihood ratio of the bearing being a target's that is seen with a probability against being
    /// one of so many false ones, 1/sr.
    pub(crate) fn log_ratio(&self, detection: f64, clutter_per_sr: f64) -> f64 {
        detection.ln() + self.log_density - clutter_per_sr.ln()
    }

    /// The likelier of two readings of a bearing, by what was known of its camera's errors or as
    /// those that last have been drawn anew, which is of a probability.
    pub(crate) fn likelier(
        known: Option<Self>,
        renewed: Option<Self>,
        probability: f64,
    ) -> Option<Self> {
        let weighed = |fit: Option<Self>, probability: f64| {
            fit.map(|fit| Self { log_density: fit.log_density + probability.ln(), ..fit })
        };
        [weighed(known, 1.0 - probability), weighed(renewed, probability)]
            .into_iter()
            .flatten()
            .max_by(|a, b| a.log_density.total_cmp(&b.log_density))
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
        // Process noise is the same along all axes: what it adds to a direction is a multiple of
        // the identity, and only what the models share has to be projected.
        let state: KinematicState = imm.combined().predicted(interval, 0.0);
        let model = BearingModel::new(origin, state.position())?;
        let by = model.by_position();
        let shifts = uncertainty.shifts(&model, state.velocity());
        let noise = uncertainty.noise(&model, state.velocity(), &Matrix2::zeros());
        let placed = by * state.position_covariance() * by.transpose();
        let spread = |errors: &SharedErrors| {
            let shift = errors.spread(&shifts);
            let cross = by * errors.ties.fixed_rows::<3>(0) * shifts.transpose();
            let steady = placed + cross + cross.transpose() + shift + noise;
            Spread { shifted: shifts * errors.mean, steady, shift, cross }
        };
        let moved = interval.abs().powi(3) / 3.0 / model.range.powi(2);
        let mut added = [0.0; MAX_MODELS];
        for (variance, model) in added.iter_mut().zip(models.models()) {
            *variance = model.density * moved;
        }
        Some(Self {
            model,
            factor: uncertainty.factor,
            known: spread(errors),
            renewed: errors.renewed().map(|(anew, probability)| (spread(&anew), probability)),
            added,
            weights: imm.predicted_probabilities(interval, models),
            widest: models.widest() * moved,
        })
    }

    /// Where a camera at `origin` should see a target of a state, as of the state's time; the
    /// target may have moved by `moved` (m, standard deviation per axis) between that time and the
    /// exposure.
    pub(crate) fn of_state(
        state: &KinematicState,
        origin: Point3<f64>,
        moved: f64,
    ) -> Option<Self> {
        let model = BearingModel::new(origin, state.position())?;
        let by = model.by_position();
        let steady = by * state.position_covariance() * by.transpose()
            + Matrix2::identity() * (moved / model.range).powi(2);
        let mut weights = [0.0; MAX_MODELS];
        weights[0] = 1.0;
        let none = Matrix2::zeros();
        let known = Spread { shifted: Vector2::zeros(), steady, shift: none, cross: none };
        let added = [0.0; MAX_MODELS];
        Some(Self { model, factor: 1.0, known, renewed: None, added, weights, widest: 0.0 })
    }

    /// Range of the target, m.
    pub(crate) fn range(&self) -> f64 {
        self.model.range
    }

    /// The tangents at the predicted direction, in which its covariances are expressed, world.
    pub(crate) fn basis(&self) -> &Matrix3x2<f64> {
        &self.model.basis
    }

    /// What a bearing is expected to be off by, where what the camera shifts all of its own by is
    /// known.
    pub(crate) fn given_shift(&self, line: &SightLine, least_factor: f64) -> GivenShift {
        let added: f64 =
            self.added.iter().zip(&self.weights).map(|(added, weight)| added * weight).sum();
        let noise = self.model.covariance_of(line) * self.factor.max(least_factor);
        // Of the shift s the track has taken C V^-1 s in, with C the covariance of the two and V
        // the shift's.
        let Spread { steady, shift, cross, .. } = self.known;
        let taken = shift.try_inverse().map_or_else(Matrix2::zeros, |inverse| cross * inverse);
        let left = Matrix2::identity() + taken;
        let spread = steady - left * shift * left.transpose();
        GivenShift { shift, left, spread: spread + noise + Matrix2::identity() * added }
    }

    /// What is left of a line of which the track has been made.
    pub(crate) fn beginning(&self, line: &SightLine) -> Option<Beginning> {
        let noise = self.model.covariance_of(line) * self.factor;
        let Spread { steady, shift, cross, .. } = self.known;
        let placed = steady - cross - cross.transpose() - shift;
        Some(Beginning { left: self.model.offset(line)?, shift, noise, placed })
    }

    /// How a bearing fits; `None` if it lies outside the gate. What is likelier of the camera's
    /// errors that last, that they went on or were drawn anew, is taken for true.
    pub(crate) fn fit(&self, line: &SightLine, gate: Gate) -> Option<Fit> {
        let offset = self.model.offset(line)?;
        let known = self.fit_by(&self.known, offset, line, gate);
        let Some((renewed, probability)) = &self.renewed else { return known };
        Fit::likelier(known, self.fit_by(renewed, offset, line, gate), *probability)
    }

    fn fit_by(
        &self,
        by: &Spread,
        offset: Vector2<f64>,
        line: &SightLine,
        gate: Gate,
    ) -> Option<Fit> {
        let innovation = offset - by.shifted;
        // No axis of the covariance is longer than its trace: most bearings need no more than this.
        let longest = by.steady.trace() + 2.0 * self.widest + line.covariance.trace() * self.factor;
        if innovation.norm_squared() > gate.threshold() * longest {
            return None;
        }
        let spread = by.steady + self.model.covariance_of(line) * self.factor;
        let gate_distance = distance(&spread, self.widest, innovation)?.0;
        if !gate.holds(gate_distance) {
            return None;
        }
        let mut density = 0.0;
        for (&added, &weight) in self.added.iter().zip(&self.weights) {
            if weight > 0.0 {
                let (squared, determinant) = distance(&spread, added, innovation)?;
                density += weight * (-squared / 2.0).exp() / (2.0 * PI * determinant.sqrt());
            }
        }
        Some(Fit { gate_distance, log_density: density.ln() })
    }
}

/// Logarithm of a normal density of mean 0.
pub(crate) fn log_density(covariance: &Matrix2<f64>, vector: Vector2<f64>) -> Option<f64> {
    let (squared, determinant) = distance(covariance, 0.0, vector)?;
    Some(-squared / 2.0 - (2.0 * PI).ln() - determinant.ln() / 2.0)
}

/// Squared Mahalanobis distance of a vector, and the determinant, for `covariance + I added`.
fn distance(covariance: &Matrix2<f64>, added: f64, vector: Vector2<f64>) -> Option<(f64, f64)> {
    let [xx, xy, yy] = [covariance.m11 + added, covariance.m12, covariance.m22 + added];
    let determinant = xx * yy - xy * xy;
    let squared = (yy * vector.x * vector.x - 2.0 * xy * vector.x * vector.y
        + xx * vector.y * vector.y)
        / determinant;
    // Of a matrix that is less than nothing the determinant is positive too.
    (determinant > 0.0 && xx > 0.0 && squared.is_finite()).then_some((squared, determinant))
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
