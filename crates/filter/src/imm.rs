use nalgebra::{Matrix6, Vector6};

use crate::KinematicState;
use crate::models::{MAX_MODELS, ModelWeights, MotionModels, Restlessness};

/// Interacting multiple models (IMM): a bank of Kalman filters that differ in their process noise,
/// weighted by how well each predicts (Solonar 2023, eqs. 10-17, with the errata; there for the
/// brightness of a pixel, here for position and velocity).
///
/// The rate at which a target leaves calm flight is learnt for each: one that has flown straight
/// for minutes is expected to go on, and one that turns every few seconds is expected to turn again
/// before its bearings can show it.
///
/// All models share the constant-velocity transition matrix. So the moments of the prediction
/// follow from those of the combined state in closed form, and a gate needs no mixing: see
/// [`Self::predicted`].
///
/// ```
/// use crossfix_filter::{Imm, KinematicState, ModeRates, MotionModel, MotionModels};
/// use nalgebra::{Matrix3, Matrix6, Point3, Vector6};
/// let quiet = MotionModel { density: 0.001, share: 0.8, calm: true };
/// let lively = MotionModel { density: 10.0, share: 0.2, calm: false };
/// let rates = ModeRates { switching_per_s: 0.3, calming_per_s: 0.1, prior_s: 20.0 };
/// let models = MotionModels::new(&[quiet, lively], rates).ok_or("models")?;
/// let start = KinematicState { mean: Vector6::zeros(), covariance: Matrix6::identity() };
/// let mut imm = Imm::new(start, &models);
/// let noise = Matrix3::identity() * 0.01;
/// for k in 0..20 {
///     // At rest, then suddenly away.
///     let x = f64::from(k - 10).max(0.0) * 10.0;
///     imm.update(1.0, &models, |state| state.position_updated(Point3::new(x, 0.0, 0.0), &noise));
///     if k == 10 {
///         assert!(imm.probabilities()[1] < 0.2);
///     } else if k == 11 {
///         assert!(imm.probabilities()[1] > 0.9);
///     }
/// }
/// # Ok::<(), &str>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Imm {
    states: Vec<KinematicState>,
    probabilities: ModelWeights,
    combined: KinematicState,
    restlessness: Restlessness,
    /// Upper limit on the probability of calm flight while an axis of the motion is not observed:
    /// the probability before, carried on by the transitions since. Measurements of the other axes
    /// may make calm less probable than this, but not more. `None` while all axes are observed.
    calm_most: Option<f64>,
}

impl Imm {
    /// A filter with all models at the same state, and their shares as probabilities.
    pub fn new(state: KinematicState, models: &MotionModels) -> Self {
        let mut probabilities = [0.0; MAX_MODELS];
        for (probability, model) in probabilities.iter_mut().zip(models.models()) {
            *probability = model.share;
        }
        let states = vec![state.clone(); models.models().len()];
        Self {
            states,
            probabilities,
            combined: state,
            restlessness: Restlessness::UNKNOWN,
            calm_most: None,
        }
    }

    /// Mean and covariance over all models.
    pub fn combined(&self) -> &KinematicState {
        &self.combined
    }

    /// Each model's probability.
    pub fn probabilities(&self) -> &[f64] {
        &self.probabilities[..self.states.len()]
    }

    /// Each model's probability `interval` seconds on.
    pub fn predicted_probabilities(&self, interval: f64, models: &MotionModels) -> ModelWeights {
        self.probabilities_after(&models.transitions(interval, &self.restlessness))
    }

    fn probabilities_after(&self, transitions: &[ModelWeights; MAX_MODELS]) -> ModelWeights {
        let mut predicted = [0.0; MAX_MODELS];
        // c_j = sum_i p_ij mu_i.
        for (row, now) in transitions.iter().zip(self.probabilities()) {
            for (p, transition) in predicted.iter_mut().zip(row) {
                *p += transition * now;
            }
        }
        predicted
    }

    /// Mean and covariance of the prediction over `interval` seconds.
    ///
    /// Mixing leaves the moments of the whole mixture unchanged, and all models have the same
    /// transition matrix, so these are the moments that mixing, predicting and combining would
    /// give.
    pub fn predicted(&self, interval: f64, models: &MotionModels) -> KinematicState {
        let weights = self.predicted_probabilities(interval, models);
        // Process noise is linear in the density, so the mixture's is that of the mean density.
        let density =
            models.models().iter().zip(weights).map(|(model, weight)| model.density * weight).sum();
        self.combined.predicted(interval, density)
    }

    /// Mixes, predicts every model `interval` seconds on and updates each by `update`, which
    /// returns the updated state with the logarithm of the measurement's likelihood.
    ///
    /// Returns the logarithm of the likelihood over all models; `None`, with everything left as it
    /// was, if `update` has failed or has given numbers that are not finite for all of them.
    pub fn update(
        &mut self,
        interval: f64,
        models: &MotionModels,
        mut update: impl FnMut(&KinematicState) -> Option<(KinematicState, f64)>,
    ) -> Option<f64> {
        let transitions = models.transitions(interval, &self.restlessness);
        let weights = self.probabilities_after(&transitions);
        let calm_before =
            self.calm_most.unwrap_or_else(|| models.calm_probability(self.probabilities()));
        let mut states: [Option<KinematicState>; MAX_MODELS] = Default::default();
        let mut logarithms = [f64::NEG_INFINITY; MAX_MODELS];
        for (j, (next, model)) in states.iter_mut().zip(models.models()).enumerate() {
            let mut predicted = self.mixed(j, &transitions);
            predicted.time_update(interval, model.density);
            let updated =
                update(&predicted).filter(|(state, log)| log.is_finite() && state.is_finite());
            *next = Some(match updated {
                Some((state, logarithm)) => {
                    // ln(c_j L_j), the model's unnormalised posterior probability.
                    logarithms[j] = logarithm + weights[j].ln();
                    state
                }
                None => predicted,
            });
        }
        // Normalised relative to the largest, so that the exponentials do not all underflow.
        let largest = logarithms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if !largest.is_finite() {
            return None;
        }
        let sum: f64 = logarithms.iter().map(|l| (l - largest).exp()).sum();
        self.calm_most = models.is_partial.then(|| models.calm_after(calm_before, &transitions));
        let probabilities = logarithms.map(|l| (l - largest).exp() / sum);
        self.probabilities = models.no_calmer(self.calm_most.unwrap_or(1.0), probabilities);
        for (state, next) in self.states.iter_mut().zip(states.into_iter().flatten()) {
            *state = next;
        }
        self.combined = combined(&self.states, &self.probabilities);
        // While an axis is not observed, the measurements do not tell how often the target leaves
        // calm.
        if !models.is_partial {
            self.restlessness.see(models.calm_probability(self.probabilities()), interval);
        }
        Some(largest + sum.ln())
    }

    /// Widens every model's covariance to at least these standard deviations and drops the
    /// correlation of velocity with position: the covariance re-initialisation of Kalinov 2019
    /// (equation 8), per block.
    pub fn reinitialise(&mut self, position_sd: f64, velocity_sd: f64) {
        for state in &mut self.states {
            state.reinitialise(position_sd, velocity_sd);
        }
        self.combined = combined(&self.states, &self.probabilities);
    }

    /// Adds `change`, which may be negative, to every model's covariance: for what is learnt of
    /// errors that all models share. A model whose covariance would no longer be positive definite
    /// stays as it is.
    pub fn add_covariance(&mut self, change: &Matrix6<f64>) {
        for state in &mut self.states {
            let next = state.covariance + change;
            if next.cholesky().is_some() {
                state.covariance = next;
            }
        }
        self.combined = combined(&self.states, &self.probabilities);
    }

    /// Makes every model's covariance P at least `part` (P - part has no negative eigenvalue), a
    /// part that all models share: a covariance that falls short grows by the smallest multiple of
    /// `part` that is enough. The growth is continuous, so that rounding decides nothing.
    pub fn raise_to(&mut self, part: &Matrix6<f64>) {
        let mut grown = false;
        for state in &mut self.states {
            if (state.covariance - part).cholesky().is_some() {
                continue;
            }
            // With Q the part: P + a Q >= Q where (1 - a) m <= 1, m being the largest eigenvalue of
            // L^-1 Q L^-T with P = L L'. So a = 1 - 1/m.
            let largest = state.covariance.cholesky().and_then(|factor| {
                let half = factor.l().solve_lower_triangular(part)?;
                let whole = factor.l().solve_lower_triangular(&half.transpose())?;
                Some(whole.symmetric_eigenvalues().max())
            });
            state.covariance += part * largest.map_or(1.0, |m| (1.0 - m.recip()).clamp(0.0, 1.0));
            grown = true;
        }
        if grown {
            self.combined = combined(&self.states, &self.probabilities);
        }
    }

    /// Adds `change` to every model's mean: for what is learnt of an error that all models share.
    pub fn shift(&mut self, change: &Vector6<f64>) {
        for state in &mut self.states {
            state.mean += change;
        }
        self.combined = combined(&self.states, &self.probabilities);
    }

    /// The state from which model `j` starts its step (IMM mixing): all states, weighted by the
    /// probability of each model having been the mode, given that `j` is the mode now.
    fn mixed(&self, j: usize, transitions: &[ModelWeights; MAX_MODELS]) -> KinematicState {
        if self.states.len() == 1 {
            return self.states[0].clone();
        }
        let mut weights = [0.0; MAX_MODELS];
        let mut total = 0.0;
        for ((weight, row), probability) in
            weights.iter_mut().zip(transitions).zip(self.probabilities())
        {
            // mu_ij = p_ij mu_i / c_j, with c_j the total.
            *weight = row[j] * probability;
            total += *weight;
        }
        if total <= 0.0 {
            // The model has probability 0, and over an interval of 0 no other changes to it: its
            // state counts for nothing.
            return self.combined.clone();
        }
        combined(&self.states, &weights.map(|weight| weight / total))
    }
}

/// Mean and covariance of a mixture: `m = sum w_i m_i`, `P = sum w_i (P_i + (m_i - m) (m_i - m)')`.
fn combined(states: &[KinematicState], weights: &ModelWeights) -> KinematicState {
    if let [only] = states {
        return only.clone();
    }
    let mean: Vector6<f64> =
        states.iter().zip(weights).map(|(state, &weight)| state.mean * weight).sum();
    let mut covariance = Matrix6::zeros();
    for (state, &weight) in states.iter().zip(weights) {
        let difference = state.mean - mean;
        covariance += (state.covariance + difference * difference.transpose()) * weight;
    }
    KinematicState { mean, covariance }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Point3};

    use super::*;
    use crate::models::{ModeRates, MotionModel};

    fn models() -> MotionModels {
        let model = |density, share, calm| MotionModel { density, share, calm };
        let models = [model(0.0, 0.7, true), model(1.0, 0.2, false), model(20.0, 0.1, false)];
        let rates = ModeRates { switching_per_s: 0.2, calming_per_s: 0.05, prior_s: 20.0 };
        MotionModels::new(&models, rates).unwrap()
    }

    fn running() -> Imm {
        let start =
            KinematicState { mean: Vector6::repeat(1.0), covariance: Matrix6::identity() * 4.0 };
        let mut imm = Imm::new(start, &models());
        for k in 0..4 {
            let z = Point3::new(f64::from(k * k), 0.5, -1.0);
            imm.update(0.7, &models(), |s| s.position_updated(z, &Matrix3::identity())).unwrap();
        }
        imm
    }

    #[test]
    fn the_closed_form_of_the_prediction_is_what_mixing_and_predicting_give() {
        let (imm, models) = (running(), models());
        let dt = 1.3;
        let weights = imm.predicted_probabilities(dt, &models);
        let states: Vec<KinematicState> = models
            .models()
            .iter()
            .enumerate()
            .map(|(j, model)| {
                imm.mixed(j, &models.transitions(dt, &imm.restlessness))
                    .predicted(dt, model.density)
            })
            .collect();
        let (slow, fast) = (combined(&states, &weights), imm.predicted(dt, &models));
        assert!((slow.mean - fast.mean).norm() < 1e-9);
        assert!((slow.covariance - fast.covariance).norm() < 1e-9);
    }

    #[test]
    fn a_transition_is_the_same_however_its_interval_is_cut() {
        let (imm, models) = (running(), models());
        let whole = imm.predicted_probabilities(2.0, &models);
        let mut halves = imm.clone();
        halves.probabilities = imm.predicted_probabilities(1.0, &models);
        let halves = halves.predicted_probabilities(1.0, &models);
        for (a, b) in whole.iter().zip(halves) {
            assert!((a - b).abs() < 1e-12);
        }
    }

    #[test]
    fn a_measurement_that_cannot_be_leaves_everything() {
        let mut imm = running();
        let before = imm.clone();
        assert!(imm.update(1.0, &models(), |_| None).is_none());
        assert_eq!(imm, before);
        assert!(imm.update(1.0, &models(), |s| Some((s.clone(), f64::NAN))).is_none());
        assert_eq!(imm, before);
    }

    #[test]
    fn a_model_that_is_ruled_out_spoils_no_measurement_of_the_same_time() {
        let mut imm = running();
        let far = Point3::new(500.0, 0.0, 0.0);
        imm.update(0.7, &models(), |s| s.position_updated(far, &Matrix3::identity())).unwrap();
        assert_eq!(imm.probabilities()[0], 0.0, "so unlikely that it underflows");
        imm.update(0.0, &models(), |s| s.position_updated(far, &Matrix3::identity())).unwrap();
        assert!(imm.combined().is_finite(), "{:?}", imm.combined());
    }
}
