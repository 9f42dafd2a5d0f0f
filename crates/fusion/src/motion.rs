//! How targets move between bearings, and what is done when one turns.

use crossfix_filter::{
    ModeRates, MotionModel, MotionModels, NormalisedInnovation, SmoothedResidual,
};

use crate::{FlightModel, FusionConfigError, Manoeuvres, Tracking};

/// Standard deviation of a track's velocity after a manoeuvre that a detector saw, m/s per axis.
/// With half of it a target of 15 m/s that turns back is four deviations off; with twice as much
/// the track forgets its course at a false alarm.
pub(crate) const REINITIALISED_VELOCITY_SD: f64 = 15.0;
/// Standard deviation of its position by then, m per axis. With half of it a track that has been
/// led astray comes back later.
pub(crate) const REINITIALISED_POSITION_SD: f64 = 1.0;

/// The motion models of all tracks, and the detector that a new track gets.
#[derive(Clone, Debug)]
pub(crate) struct MotionSetup {
    /// For tracks that several cameras see.
    models: MotionModels,
    /// For tracks that one camera alone sees: the motion along its sight line cannot be observed,
    /// so every model that is not calm is as uncertain as the liveliest.
    unranged: MotionModels,
    /// How long after its bearing a camera counts as one that holds (supports) a track, s.
    pub(crate) holding_s: f64,
    detector: Option<ManoeuvreDetector>,
}

/// A detector of manoeuvres (Kalinov 2019).
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum ManoeuvreDetector {
    /// The paper's, on the smoothed residual.
    Residual(SmoothedResidual),
    /// On the normalised innovation squared.
    Innovation(NormalisedInnovation),
}

impl MotionSetup {
    pub(crate) fn new(config: &Tracking) -> Result<Self, FusionConfigError> {
        let single = MotionModels::single(config.acceleration_density);
        let (models, detector) = match config.manoeuvres {
            Manoeuvres::Models => {
                let models: Vec<MotionModel> = config.models.iter().map(motion_model).collect();
                let rates = ModeRates {
                    switching_per_s: config.switching_rate_per_s,
                    calming_per_s: config.calming_rate_per_s,
                    prior_s: config.restlessness_prior_s,
                };
                (MotionModels::new(&models, rates), None)
            }
            Manoeuvres::None => (single, None),
            Manoeuvres::SmoothedResidual => {
                let detector = SmoothedResidual::new(config.residual_window, config.residual_scale);
                (single, Some(ManoeuvreDetector::Residual(detector)))
            }
            Manoeuvres::Innovation => {
                let detector = NormalisedInnovation::new(
                    config.innovation_window,
                    config.innovation_false_alarm,
                );
                (single, Some(ManoeuvreDetector::Innovation(detector)))
            }
        };
        let models = models.ok_or(FusionConfigError {
            key: "tracking.models",
            value: config.models.len() as f64,
            must: "one to four models with densities of 0 and more and positive shares".to_owned(),
        })?;
        let unranged = models.partial();
        Ok(Self { models, unranged, holding_s: config.coasting_after_s, detector })
    }

    /// The models of a track that two cameras see (`ranged`), or of one whose motion along its only
    /// sight line cannot be observed.
    pub(crate) fn models(&self, ranged: bool) -> &MotionModels {
        if ranged { &self.models } else { &self.unranged }
    }

    /// Mean density of the acceleration over all models of a triangulated track, m^2/s^3.
    pub(crate) fn density(&self, probabilities: &[f64]) -> f64 {
        self.models.models().iter().zip(probabilities).map(|(model, p)| model.density * p).sum()
    }

    pub(crate) fn detector(&self) -> Option<ManoeuvreDetector> {
        self.detector.clone()
    }
}

fn motion_model(model: &FlightModel) -> MotionModel {
    MotionModel { density: model.acceleration_density, share: model.share, calm: model.calm }
}
