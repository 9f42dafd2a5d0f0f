use nalgebra::{Matrix6, Vector6};

use crate::KinematicState;

/// More models than this say nothing that fewer do not.
pub const MAX_MODELS: usize = 4;

/// What is believed of a target's restlessness before it has been seen is worth so much calm flight, s: the rates
/// at which targets leave their calm differ from one to the next by orders of magnitude, so a first manoeuvre
/// says much. With half of it a target that has turned once is taken to turn again within ten seconds.
const RESTLESSNESS_PRIOR_S: f64 = 20.0;
/// A target has left its calm when calm is less likely than this, ...
const UPSET: f64 = 0.5;
/// ... and has come to it again when it is likelier than this.
const CALM: f64 = 0.9;

/// One way of flying: constant velocity driven by white acceleration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionModel {
    /// Power spectral density of the white acceleration, m^2/s^3.
    pub density: f64,
    /// Share of the time that targets fly like this, before anything is known of one.
    pub share: f64,
    /// The habit that it belongs to, by number: a target changes between the models of its habit often, and
    /// its habit seldom.
    pub habit: u8,
}

/// The ways in which targets fly, and how often they change from one to another.
///
/// The mode is a Markov process in continuous time: at `switching_rate` it is drawn anew from the shares of
/// the models of its habit, and at `habit_rate` from those of all models. So the transition over an interval
/// is the same however it is cut. The rate at which a target leaves the calmest habit is its own and is learnt
/// (see [`Imm`]).
#[derive(Clone, Debug, PartialEq)]
pub struct MotionModels {
    models: Vec<MotionModel>,
    switching_rate: f64,
    habit_rate: f64,
    /// The habit of the quietest model.
    calm: u8,
}

/// Weights of the models, in their order; what lies beyond the last model is 0.
pub type ModelWeights = [f64; MAX_MODELS];

impl MotionModels {
    /// One to [`MAX_MODELS`] models, with the rates of switching within a habit and of changing it in 1/s. The
    /// shares are scaled to a sum of 1.
    ///
    /// `None` if a density is negative, a share or a rate is not positive (a lone model needs no
    /// rate), or a number is not finite.
    pub fn new(models: &[MotionModel], switching_rate: f64, habit_rate: f64) -> Option<Self> {
        let total: f64 = models.iter().map(|m| m.share).sum();
        let possible = |m: &MotionModel| m.density >= 0.0 && m.density.is_finite() && m.share > 0.0;
        let is_rate = |rate: f64| rate.is_finite() && (rate > 0.0 || models.len() == 1);
        let good = (1..=MAX_MODELS).contains(&models.len()) && models.iter().all(possible);
        if !(good && is_rate(switching_rate) && is_rate(habit_rate) && total.is_finite()) {
            return None;
        }
        let scaled = |m: &MotionModel| MotionModel { share: m.share / total, ..*m };
        let calm = models.iter().min_by(|a, b| a.density.total_cmp(&b.density))?.habit;
        Some(Self { models: models.iter().map(scaled).collect(), switching_rate, habit_rate, calm })
    }

    /// A single model: a plain Kalman filter.
    pub fn single(density: f64) -> Option<Self> {
        Self::new(&[MotionModel { density, share: 1.0, habit: 0 }], 0.0, 0.0)
    }

    /// The models.
    pub fn models(&self) -> &[MotionModel] {
        &self.models
    }

    /// The same with every model as lively as the liveliest.
    #[must_use]
    pub fn widened(&self) -> Self {
        let widest = self.widest();
        let models = self.models.iter().map(|m| MotionModel { density: widest, ..*m }).collect();
        Self { models, ..*self }
    }

    /// The largest density of acceleration among the models, m^2/s^3.
    pub fn widest(&self) -> f64 {
        self.models.iter().map(|m| m.density).fold(0.0, f64::max)
    }

    /// Probability of each model (columns) an interval of seconds after each (rows), for a target of some
    /// restlessness.
    fn transitions(&self, interval: f64, restlessness: &Restlessness) -> [ModelWeights; MAX_MODELS] {
        let lively = 1.0 - self.calm_share();
        let leaving = restlessness.rate(self.habit_rate * lively);
        let leaving_calm = if lively > 0.0 { leaving / lively } else { 0.0 };
        let same_mode = (-self.switching_rate * interval.abs()).exp();
        let mut transitions = [[0.0; MAX_MODELS]; MAX_MODELS];
        for (i, (row, from)) in transitions.iter_mut().zip(&self.models).enumerate() {
            let rate = if from.habit == self.calm { leaving_calm } else { self.habit_rate };
            let same_habit = (-rate * interval.abs()).exp();
            let alike = self.models.iter().filter(|model| model.habit == from.habit);
            let habit_share: f64 = alike.map(|model| model.share).sum();
            for (j, (probability, to)) in row.iter_mut().zip(&self.models).enumerate() {
                *probability = (1.0 - same_habit) * to.share;
                if from.habit == to.habit {
                    let kept = if i == j { same_mode } else { 0.0 };
                    *probability += same_habit * (kept + (1.0 - same_mode) * to.share / habit_share);
                }
            }
        }
        transitions
    }

    /// Share of the time that targets are calm.
    fn calm_share(&self) -> f64 {
        self.calm_probability(&self.models.iter().map(|model| model.share).collect::<Vec<_>>())
    }

    fn calm_probability(&self, probabilities: &[f64]) -> f64 {
        let calm = self.models.iter().zip(probabilities).filter(|(model, _)| model.habit == self.calm);
        calm.map(|(_, probability)| probability).sum()
    }
}

/// How often a target leaves its calm: the mean of a gamma distribution of the rate, which each time it does and
/// each second that it does not sharpen.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Restlessness {
    is_calm: bool,
    /// How often it has been seen to leave its calm, ...
    upsets: f64,
    /// ... and for how long it has been calm, s.
    calm_s: f64,
}

impl Restlessness {
    const UNKNOWN: Self = Self { is_calm: true, upsets: 0.0, calm_s: 0.0 };

    /// The rate, 1/s; `usual` is that of all targets.
    fn rate(&self, usual: f64) -> f64 {
        (usual * RESTLESSNESS_PRIOR_S + self.upsets) / (RESTLESSNESS_PRIOR_S + self.calm_s)
    }

    /// The target has been calm with this probability for an interval of seconds.
    fn see(&mut self, calm: f64, interval: f64) {
        self.calm_s += calm * interval.abs();
        if self.is_calm && calm < UPSET {
            self.upsets += 1.0;
            self.is_calm = false;
        }
        self.is_calm |= calm > CALM;
    }
}

/// Interacting multiple models (IMM): a bank of Kalman filters that differ in their process noise,
/// weighted by how well each predicts (003, equations 10-17, with the errata; there for the
/// brightness of a pixel, here for position and velocity).
///
/// How often a target leaves its calm is learnt of each: one that has flown straight for minutes is expected to go
/// on, and one that turns every few seconds to turn again before its bearings can show it.
///
/// All models share the transition of constant velocity. So the moments of the prediction follow
/// from those of the combined state in closed form, and a gate needs no mixing: see
/// [`Self::predicted`].
///
/// ```
/// use crossfix_filter::{Imm, KinematicState, MotionModel, MotionModels};
/// use nalgebra::{Matrix3, Matrix6, Point3, Vector6};
/// let quiet = MotionModel { density: 0.001, share: 0.8, habit: 0 };
/// let lively = MotionModel { density: 10.0, share: 0.2, habit: 0 };
/// let models = MotionModels::new(&[quiet, lively], 0.1, 0.1).ok_or("models")?;
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
}

impl Imm {
    /// All models at one state, with the shares as probabilities.
    pub fn new(state: KinematicState, models: &MotionModels) -> Self {
        let mut probabilities = [0.0; MAX_MODELS];
        for (probability, model) in probabilities.iter_mut().zip(models.models()) {
            *probability = model.share;
        }
        let states = vec![state.clone(); models.models().len()];
        Self { states, probabilities, combined: state, restlessness: Restlessness::UNKNOWN }
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
        for (row, now) in transitions.iter().zip(self.probabilities()) {
            for (p, transition) in predicted.iter_mut().zip(row) {
                *p += transition * now;
            }
        }
        predicted
    }

    /// Mean and covariance of the prediction over `interval` seconds.
    ///
    /// Mixing leaves the moments of the whole as they are, and the models' transition is the same:
    /// so these are the moments that mixing, predicting and combining would give.
    pub fn predicted(&self, interval: f64, models: &MotionModels) -> KinematicState {
        let weights = self.predicted_probabilities(interval, models);
        let density = models.models().iter().zip(weights).map(|(model, weight)| model.density * weight).sum();
        self.combined.predicted(interval, density)
    }

    /// Mixes, predicts every model `interval` seconds on and updates each by `update`, which
    /// returns the updated state with the logarithm of the measurement's likelihood.
    ///
    /// Returns the logarithm of the likelihood over all models; `None`, with everything left as it
    /// was, if `update` has failed for all of them or the numbers have.
    pub fn update(
        &mut self,
        interval: f64,
        models: &MotionModels,
        mut update: impl FnMut(&KinematicState) -> Option<(KinematicState, f64)>,
    ) -> Option<f64> {
        let transitions = models.transitions(interval, &self.restlessness);
        let weights = self.probabilities_after(&transitions);
        let mut states: [Option<KinematicState>; MAX_MODELS] = Default::default();
        let mut logarithms = [f64::NEG_INFINITY; MAX_MODELS];
        for (j, (next, model)) in states.iter_mut().zip(models.models()).enumerate() {
            let mut predicted = self.mixed(j, &transitions);
            predicted.time_update(interval, model.density);
            let updated = update(&predicted).filter(|(state, log)| log.is_finite() && state.is_finite());
            *next = Some(match updated {
                Some((state, logarithm)) => {
                    logarithms[j] = logarithm + weights[j].ln();
                    state
                }
                None => predicted,
            });
        }
        let largest = logarithms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if !largest.is_finite() {
            return None;
        }
        let sum: f64 = logarithms.iter().map(|l| (l - largest).exp()).sum();
        self.probabilities = logarithms.map(|l| (l - largest).exp() / sum);
        for (state, next) in self.states.iter_mut().zip(states.into_iter().flatten()) {
            *state = next;
        }
        self.combined = combined(&self.states, &self.probabilities);
        self.restlessness.see(models.calm_probability(self.probabilities()), interval);
        Some(largest + sum.ln())
    }

    /// Widens every model's knowledge to at least these standard deviations and forgets what ties
    /// velocity to position: the covariance re-initialisation of 004 (equation 8), per block.
    pub fn reinitialise(&mut self, position_sd: f64, velocity_sd: f64) {
        for state in &mut self.states {
            state.reinitialise(position_sd, velocity_sd);
        }
        self.combined = combined(&self.states, &self.probabilities);
    }

    /// Adds to every model's covariance, or takes from it, for what is learnt of errors that all models
    /// share. What would leave a model less than nothing is not taken from it.
    pub fn add_covariance(&mut self, change: &Matrix6<f64>) {
        for state in &mut self.states {
            let next = state.covariance + change;
            if next.cholesky().is_some() {
                state.covariance = next;
            }
        }
        self.combined = combined(&self.states, &self.probabilities);
    }

    /// Makes no model's covariance less than a part of it that all share: what is short of it grows by the
    /// smallest share of the part that does. The growth is continuous, so that rounding decides nothing.
    pub fn exceed(&mut self, part: &Matrix6<f64>) {
        let mut grown = false;
        for state in &mut self.states {
            if (state.covariance - part).cholesky().is_some() {
                continue;
            }
            // P + a Q >= Q where (1 - a) m <= 1, m being the largest eigenvalue of L^-1 Q L^-T with P = L L'.
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

    /// Moves every model's mean: for what is learnt of an error that all models share.
    pub fn shift(&mut self, change: &Vector6<f64>) {
        for state in &mut self.states {
            state.mean += change;
        }
        self.combined = combined(&self.states, &self.probabilities);
    }

    /// What model `j` starts its step from: the states weighted by the probability of each having
    /// been the mode, given that `j` is the mode now.
    fn mixed(&self, j: usize, transitions: &[ModelWeights; MAX_MODELS]) -> KinematicState {
        if self.states.len() == 1 {
            return self.states[0].clone();
        }
        let mut weights = [0.0; MAX_MODELS];
        let mut total = 0.0;
        for ((weight, row), probability) in weights.iter_mut().zip(transitions).zip(self.probabilities()) {
            *weight = row[j] * probability;
            total += *weight;
        }
        if total <= 0.0 {
            // Ruled out, and no time in which it could have come up again: its state counts for nothing.
            return self.combined.clone();
        }
        combined(&self.states, &weights.map(|weight| weight / total))
    }
}

/// Mean and covariance of a mixture.
fn combined(states: &[KinematicState], weights: &ModelWeights) -> KinematicState {
    if let [only] = states {
        return only.clone();
    }
    let mean: Vector6<f64> = states.iter().zip(weights).map(|(state, &weight)| state.mean * weight).sum();
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

    fn models() -> MotionModels {
        let model = |density, share, habit| MotionModel { density, share, habit };
        MotionModels::new(&[model(0.0, 0.7, 0), model(1.0, 0.2, 1), model(20.0, 0.1, 1)], 0.2, 0.05).unwrap()
    }

    fn running() -> Imm {
        let start = KinematicState { mean: Vector6::repeat(1.0), covariance: Matrix6::identity() * 4.0 };
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
            .map(|(j, model)| imm.mixed(j, &models.transitions(dt, &imm.restlessness)).predicted(dt, model.density))
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

    #[test]
    fn models_that_cannot_be_are_refused() {
        let model = |density, share| MotionModel { density, share, habit: 0 };
        assert!(MotionModels::new(&[], 1.0, 1.0).is_none());
        assert!(MotionModels::new(&[model(-1.0, 1.0)], 1.0, 1.0).is_none());
        assert!(MotionModels::new(&[model(1.0, 1.0); 2], 0.0, 1.0).is_none());
        assert!(MotionModels::new(&[model(1.0, 1.0); 2], 1.0, 0.0).is_none());
        assert!(MotionModels::new(&[model(1.0, f64::NAN)], 1.0, 1.0).is_none());
        assert!(MotionModels::new(&[model(1.0, 1.0); 5], 1.0, 1.0).is_none());
        assert!(MotionModels::single(1.0).is_some());
    }
}
