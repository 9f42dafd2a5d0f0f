//! Motion models of targets, and the rates of change between them. "Calm" models are those in which
//! targets fly for long; each time a target leaves them is an "upset".

/// Greatest number of models: more say nothing that fewer do not. With half of it there is no model
/// between calm flight and the hardest manoeuvre.
pub const MAX_MODELS: usize = 4;

/// A target counts as having left calm flight when the probability of calm is below this: when it
/// is more likely not calm. At half of this value only hard manoeuvres would count, ...
const UPSET: f64 = 0.5;
/// ... and it counts as calm again when the probability of calm is above this. Well above the
/// other, so that one manoeuvre during which the probability goes up and down counts once; at half
/// of it, below the other, each crossing would count.
const CALM: f64 = 0.9;

/// Number of upsets added to those seen, where an axis of the target's motion is not observed:
/// Jeffreys' prior of a rate. The mean rate over all targets is right only on average, and where an
/// axis is not observed nothing shows in time that it was wrong for this target. With half of it a
/// target that has never been upset is expected to be upset half as often.
const UNSEEN_UPSETS: f64 = 0.5;

/// A motion model: constant velocity driven by white acceleration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionModel {
    /// Power spectral density of the white acceleration, m^2/s^3.
    pub density: f64,
    /// Share of the time that targets fly by this model: the prior for a target of which nothing is
    /// known.
    pub share: f64,
    /// Whether targets fly by this model for long: each target leaves its calm models at a rate of
    /// its own.
    pub calm: bool,
}

/// Rates at which targets change from one motion model to another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ModeRates {
    /// Rate of change between models of the same kind, calm or not, 1/s: the model is drawn again
    /// by their shares.
    pub switching_per_s: f64,
    /// Rate at which a target that is not calm becomes calm, 1/s. With the shares it determines the
    /// mean rate, over all targets, of leaving calm.
    pub calming_per_s: f64,
    /// Weight of the prior rate of leaving calm of one target, as seconds of calm flight.
    pub prior_s: f64,
}

/// Motion models with the rates of change between them.
///
/// Whether a target is calm is a Markov chain of two states in continuous time, and so is its model
/// while it stays in one of them. So the transition over an interval is the same into however many
/// pieces it is cut. The rate of leaving calm is the target's own and is learnt: see
/// [`crate::Imm`].
#[derive(Clone, Debug, PartialEq)]
pub struct MotionModels {
    models: Vec<MotionModel>,
    rates: ModeRates,
    /// Share of the time that targets are calm.
    calm_share: f64,
    /// Whether an axis of the motion is not observed.
    pub(crate) is_partial: bool,
}

/// Weights of the models, in their order; entries beyond the last model are 0.
pub type ModelWeights = [f64; MAX_MODELS];

impl MotionModels {
    /// One to [`MAX_MODELS`] models. The shares are scaled to a sum of 1.
    ///
    /// `None` if a density is negative, a share or a rate is not positive (a lone model needs no
    /// rate), or a number is not finite.
    pub fn new(models: &[MotionModel], rates: ModeRates) -> Option<Self> {
        let total: f64 = models.iter().map(|m| m.share).sum();
        let possible = |m: &MotionModel| m.density >= 0.0 && m.density.is_finite() && m.share > 0.0;
        let is_rate = |rate: f64| rate.is_finite() && (rate > 0.0 || models.len() == 1);
        let good = (1..=MAX_MODELS).contains(&models.len()) && models.iter().all(possible);
        let ModeRates { switching_per_s, calming_per_s, prior_s } = rates;
        if !(good
            && [switching_per_s, calming_per_s, prior_s].into_iter().all(is_rate)
            && total.is_finite())
        {
            return None;
        }
        let scaled = |m: &MotionModel| MotionModel { share: m.share / total, ..*m };
        let models: Vec<MotionModel> = models.iter().map(scaled).collect();
        let calm_share = models.iter().filter(|model| model.calm).map(|model| model.share).sum();
        Some(Self { models, rates, calm_share, is_partial: false })
    }

    /// A single model: a plain Kalman filter.
    pub fn single(density: f64) -> Option<Self> {
        let rates = ModeRates { switching_per_s: 0.0, calming_per_s: 0.0, prior_s: 0.0 };
        Self::new(&[MotionModel { density, share: 1.0, calm: true }], rates)
    }

    /// The models.
    pub fn models(&self) -> &[MotionModel] {
        &self.models
    }

    /// The same models where an axis of the motion is not observed: along it every model that is
    /// not calm may be as lively as the liveliest, and even flight across it is no evidence of
    /// calm.
    #[must_use]
    pub fn partial(&self) -> Self {
        let widest = self.widest();
        let density = |m: &MotionModel| if m.calm { m.density } else { widest };
        let models =
            self.models.iter().map(|m| MotionModel { density: density(m), ..*m }).collect();
        Self { models, is_partial: true, ..*self }
    }

    /// The probability of calm after an interval with these `transitions`, from the probability
    /// `calm` before it.
    pub(crate) fn calm_after(&self, calm: f64, transitions: &[ModelWeights; MAX_MODELS]) -> f64 {
        let mut after = 0.0;
        for (is_calm, probability) in [(true, calm), (false, 1.0 - calm)] {
            // All models of a kind have the same probability of being calm afterwards: one row
            // does.
            let rows = transitions.iter().zip(&self.models);
            let row = rows.filter(|(_, model)| model.calm == is_calm).map(|(row, _)| row).next();
            after += row.map_or(0.0, |row| self.calm_probability(row)) * probability;
        }
        after
    }

    /// Rescales weights so that those of the calm models sum to at most `most`.
    pub(crate) fn no_calmer(&self, most: f64, weights: ModelWeights) -> ModelWeights {
        let calm = self.calm_probability(&weights);
        if calm <= most || calm >= 1.0 {
            return weights;
        }
        // What the calm models lose the others gain, in proportion: the sum stays 1.
        let (fewer, more) = (most / calm, (1.0 - most) / (1.0 - calm));
        let mut less = weights;
        for (weight, model) in less.iter_mut().zip(&self.models) {
            *weight *= if model.calm { fewer } else { more };
        }
        less
    }

    /// The largest density of acceleration among the models, m^2/s^3.
    pub fn widest(&self) -> f64 {
        self.models.iter().map(|m| m.density).fold(0.0, f64::max)
    }

    /// Transition matrix: probability of each model (columns) `interval` seconds after each (rows),
    /// for a target of this restlessness.
    pub(crate) fn transitions(
        &self,
        interval: f64,
        restlessness: &Restlessness,
    ) -> [ModelWeights; MAX_MODELS] {
        let interval = interval.abs();
        let (calm, lively) = (self.calm_share, 1.0 - self.calm_share);
        let of_two = calm > 0.0 && lively > 0.0;
        let calming = if of_two { self.rates.calming_per_s } else { 0.0 };
        // Stationary shares balance: calm * usual = lively * calming.
        let usual = if of_two { calming * lively / calm } else { 0.0 };
        let unseen = if self.is_partial { UNSEEN_UPSETS } else { 0.0 };
        let leaving =
            if of_two { restlessness.rate(usual, self.rates.prior_s, unseen) } else { 0.0 };
        // Two-state chain: a deviation from the stationary probabilities decays by this over the
        // interval.
        let kept = (-(leaving + calming) * interval).exp();
        let unswitched = (-self.rates.switching_per_s * interval).exp();
        // Probability that the target has neither changed its kind (calm, lively) nor drawn its
        // model again.
        let never =
            [(-leaving * interval).exp(), (-calming * interval).exp()].map(|out| out * unswitched);
        let mut transitions = [[0.0; MAX_MODELS]; MAX_MODELS];
        for (i, (row, from)) in transitions.iter_mut().zip(&self.models).enumerate() {
            let (out, back, share) =
                if from.calm { (leaving, calming, calm) } else { (calming, leaving, lively) };
            let total = out + back;
            // P(same kind after T) = (back + out exp(-(out + back) T)) / (out + back).
            let stays = if total > 0.0 { (back + out * kept) / total } else { 1.0 };
            let untouched = never[usize::from(!from.calm)];
            for (j, (probability, to)) in row.iter_mut().zip(&self.models).enumerate() {
                // Same kind: the model has stayed, or has been drawn again by the kind's shares.
                // Other kind: drawn by the shares of that one.
                *probability = if to.calm == from.calm {
                    let same = if i == j { untouched } else { 0.0 };
                    same + (stays - untouched) * to.share / share
                } else {
                    (1.0 - stays) * to.share / (1.0 - share)
                };
            }
        }
        transitions
    }

    /// The probability of calm: the sum over the calm models.
    pub(crate) fn calm_probability(&self, probabilities: &[f64]) -> f64 {
        self.models.iter().zip(probabilities).filter(|(model, _)| model.calm).map(|(_, p)| p).sum()
    }
}

/// Rate at which one target leaves calm, 1/s: the mean of a gamma distribution, which each upset
/// and each second of calm sharpens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Restlessness {
    is_calm: bool,
    /// How often the target has been seen to leave calm, ...
    upsets: f64,
    /// ... and how long it has been calm, s.
    calm_s: f64,
}

impl Restlessness {
    /// Of a target that nothing is known of: calm, with no upset and no time seen yet.
    pub(crate) const UNKNOWN: Self = Self { is_calm: true, upsets: 0.0, calm_s: 0.0 };

    /// The rate, 1/s, with `more` upsets than have been seen; `usual` is the mean rate over all
    /// targets, which counts as much as `prior_s` seconds of this one.
    fn rate(&self, usual: f64, prior_s: f64, more: f64) -> f64 {
        (usual * prior_s + self.upsets + more) / (prior_s + self.calm_s)
    }

    /// Notes that the target was calm with probability `calm` for `interval` seconds.
    pub(crate) fn see(&mut self, calm: f64, interval: f64) {
        self.calm_s += calm * interval.abs();
        if self.is_calm && calm < UPSET {
            self.upsets += 1.0;
            self.is_calm = false;
        }
        self.is_calm |= calm > CALM;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_that_cannot_be_are_refused() {
        let model = |density, share| MotionModel { density, share, calm: false };
        let rates = ModeRates { switching_per_s: 1.0, calming_per_s: 1.0, prior_s: 1.0 };
        assert!(MotionModels::new(&[], rates).is_none());
        assert!(MotionModels::new(&[model(-1.0, 1.0)], rates).is_none());
        let still = ModeRates { switching_per_s: 0.0, ..rates };
        assert!(MotionModels::new(&[model(1.0, 1.0); 2], still).is_none());
        let never = ModeRates { calming_per_s: 0.0, ..rates };
        assert!(MotionModels::new(&[model(1.0, 1.0); 2], never).is_none());
        assert!(MotionModels::new(&[model(1.0, f64::NAN)], rates).is_none());
        assert!(MotionModels::new(&[model(1.0, 1.0); 5], rates).is_none());
        assert!(MotionModels::single(1.0).is_some());
    }

    #[test]
    fn a_transition_is_a_probability_and_the_same_however_its_interval_is_cut() {
        let model = |share, calm| MotionModel { density: share, share, calm };
        let models = [model(0.5, true), model(0.2, true), model(0.2, false), model(0.1, false)];
        let rates = ModeRates { switching_per_s: 0.3, calming_per_s: 0.1, prior_s: 20.0 };
        let models = MotionModels::new(&models, rates).unwrap();
        let restless = Restlessness { is_calm: true, upsets: 3.0, calm_s: 40.0 };
        let at = |seconds| {
            nalgebra::Matrix4::from_fn(|i, j| models.transitions(seconds, &restless)[i][j])
        };
        assert!((at(0.7) * at(1.8) - at(2.5)).amax() < 1e-12);
        assert!(
            (at(2.5) * nalgebra::Vector4::repeat(1.0)).iter().all(|sum| (sum - 1.0).abs() < 1e-12)
        );
        assert!((at(0.0) - nalgebra::Matrix4::identity()).amax() < 1e-12);
    }

    #[test]
    fn where_an_axis_is_not_seen_no_target_becomes_calm_and_each_may_have_left_its_calm() {
        let model = |density, share, calm| MotionModel { density, share, calm };
        let models = [model(0.01, 0.8, true), model(1.0, 0.1, false), model(20.0, 0.1, false)];
        let rates = ModeRates { switching_per_s: 0.3, calming_per_s: 0.1, prior_s: 20.0 };
        let models = MotionModels::new(&models, rates).unwrap();
        let partial = models.partial();
        assert_eq!(
            partial.models().iter().map(|m| m.density).collect::<Vec<_>>(),
            [0.01, 20.0, 20.0]
        );
        let weights = [0.9, 0.05, 0.05, 0.0];
        for (weight, expected) in partial.no_calmer(0.5, weights).iter().zip([0.5, 0.25, 0.25, 0.0])
        {
            assert!((weight - expected).abs() < 1e-12);
        }
        assert_eq!(partial.no_calmer(0.95, weights), weights, "less calm it may be found to be");
        let transitions = partial.transitions(2.0, &Restlessness::UNKNOWN);
        let all_calm = transitions[0][0];
        assert!((partial.calm_after(1.0, &transitions) - all_calm).abs() < 1e-12);
        assert!(partial.calm_after(0.0, &transitions) < all_calm);
        let stays = |models: &MotionModels| models.transitions(1.0, &Restlessness::UNKNOWN)[0][0];
        assert!(stays(&partial) < stays(&models));
    }

    #[test]
    fn a_target_that_turns_often_is_expected_to_turn_again_and_one_that_never_does_is_not() {
        let mut restless = Restlessness::UNKNOWN;
        // Six seconds of calm and two of turning, ten times; and a minute of calm.
        for _ in 0..10 {
            restless.see(1.0, 6.0);
            restless.see(0.0, 2.0);
        }
        let mut calm = Restlessness::UNKNOWN;
        calm.see(1.0, 60.0);
        let usual = 1e-3;
        // Ten upsets in a minute, beside the prior's twenty seconds.
        assert!((restless.rate(usual, 20.0, 0.0) - 10.02 / 80.0).abs() < 1e-12);
        assert!((calm.rate(usual, 20.0, 0.0) - 0.02 / 80.0).abs() < 1e-12);
    }
}
