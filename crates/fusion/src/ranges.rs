//! Admissible range of each number of the configuration: wide enough for anything that flies,
//! narrow enough that no number makes the fusion slow, or its sums too large or too small to be
//! told apart.

use crate::motion::MotionSetup;
use crate::tracker::association::MAX_SCORE;
use crate::{
    FlightModel, FusionConfig, FusionConfigError, InitiationMethod, Manoeuvres, SpatialSolver,
    Weighting,
};

/// A number of the configuration, with the range in which it makes sense.
struct KeyRange {
    key: &'static str,
    value: f64,
    bounds: Bounds,
    /// Whether the chosen methods use it.
    is_used: bool,
}

/// Where a number makes sense.
#[derive(Clone, Copy)]
enum Bounds {
    FromTo(f64, f64),
    /// Between 0 and 1, which are not possible.
    Probability,
}

const fn range(key: &'static str, value: f64, least: f64, most: f64) -> KeyRange {
    KeyRange { key, value, bounds: Bounds::FromTo(least, most), is_used: true }
}

const fn probability(key: &'static str, value: f64) -> KeyRange {
    KeyRange { key, value, bounds: Bounds::Probability, is_used: true }
}

impl KeyRange {
    /// The same, of which only some methods make use, which are chosen or not.
    const fn used_if(self, is_used: bool) -> Self {
        Self { is_used, ..self }
    }

    fn check(&self) -> Result<(), FusionConfigError> {
        let &Self { key, value, bounds, .. } = self;
        // NaN is in no range.
        let (is_possible, must) = match bounds {
            Bounds::FromTo(least, most) => (
                (least..=most).contains(&value),
                format!("from {} to {}", plain(least), plain(most)),
            ),
            Bounds::Probability => {
                (value > 0.0 && value < 1.0, "a probability between 0 and 1".to_owned())
            }
        };
        is_possible.then_some(()).ok_or(FusionConfigError { key, value, must })
    }

    fn is_same(&self, other: &Self) -> bool {
        self.key == other.key && self.value.to_bits() == other.value.to_bits()
    }
}

/// A number as people write it: with a power of ten where there would be many noughts.
pub(crate) fn plain(value: f64) -> String {
    if value == 0.0 || (1e-4..1e7).contains(&value) {
        value.to_string()
    } else {
        format!("{value:e}")
    }
}

impl FusionConfig {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first [`FusionConfigError`].
    pub fn validate(&self) -> Result<(), FusionConfigError> {
        self.numbers().iter().try_for_each(KeyRange::check)?;
        self.models()?;
        self.unused().map_or(Ok(()), Err)
    }

    /// Finds a number that differs from the default although none of the chosen methods uses it:
    /// whoever has set it thinks that it does something.
    fn unused(&self) -> Option<FusionConfigError> {
        let usual = Self::default().numbers();
        let mut unused = self.numbers().into_iter().filter(|number| !number.is_used);
        let set = unused.find(|number| !usual.iter().any(|usual| usual.is_same(number)))?;
        let must = "left out: the method that is chosen does not use it".to_owned();
        Some(FusionConfigError { key: set.key, value: set.value, must })
    }

    fn numbers(&self) -> Vec<KeyRange> {
        let all = [self.time_and_bearings(), self.initiation_numbers(), self.tracking_numbers()];
        all.into_iter().flatten().collect()
    }

    fn time_and_bearings(&self) -> Vec<KeyRange> {
        let Self { event_time, bearings, clocks, .. } = self;
        vec![
            range("event_time.lateness_s", event_time.lateness_s, 1e-3, 60.0),
            range("event_time.max_ahead_s", event_time.max_ahead_s, 1e-3, 3600.0),
            range("bearings.equal_sd_rad", bearings.equal_sd_rad, 1e-9, 0.1)
                .used_if(bearings.weighting == Weighting::Equal),
            range("bearings.systematic_sd_rad", bearings.systematic_sd_rad, 0.0, 0.1),
            range("clocks.least_sd_s", clocks.least_sd_s, 1e-9, 10.0),
            range("clocks.drift_sd", clocks.drift_sd, 1e-12, 0.1),
        ]
    }

    fn groups(&self) -> bool {
        self.initiation.method == InitiationMethod::Grouping
    }

    fn initiation_numbers(&self) -> Vec<KeyRange> {
        let (it, groups) = (&self.initiation, self.groups());
        let pairs = groups && it.solver == SpatialSolver::Pair;
        let mut numbers = vec![
            range("initiation.birth_density_per_m3", it.birth_density_per_m3, 1e-30, 1.0)
                .used_if(!groups),
            range("initiation.period_s", it.period_s, 1e-4, 60.0),
            range("initiation.pair_s", it.pair_s, 1e-3, 3600.0).used_if(!groups),
            range("initiation.velocity_prior_sd_mps", it.velocity_prior_sd_mps, 1e-3, 1e4),
            range("initiation.max_range_m", it.max_range_m, 1e-2, 1e6),
            range("initiation.pair_gate_m2", it.pair_gate_m2, 1e-9, 1e9).used_if(pairs),
            range("initiation.periods", it.periods as f64, 2.0, 20.0),
            range("initiation.fixes", it.fixes as f64, 1.0, it.periods as f64),
            range("initiation.shared_lines", it.shared_lines as f64, 0.0, 64.0),
            probability("initiation.spatial_gate_probability", it.spatial_gate_probability),
        ];
        // The gate between fixes is from the covariances unless it is given.
        numbers.extend(
            it.temporal_gate_m
                .map(|gate| range("initiation.temporal_gate_m", gate, 1e-6, 1e6).used_if(groups)),
        );
        numbers
    }

    fn tracking_numbers(&self) -> Vec<KeyRange> {
        let it = &self.tracking;
        let by = |manoeuvres| it.manoeuvres == manoeuvres;
        let models = by(Manoeuvres::Models);
        let one_model = !models || (self.groups() && self.initiation.temporal_gate_m.is_none());
        let (residual, innovation) = (by(Manoeuvres::SmoothedResidual), by(Manoeuvres::Innovation));
        vec![
            range("tracking.switching_rate_per_s", it.switching_rate_per_s, 1e-9, 100.0)
                .used_if(models),
            range("tracking.calming_rate_per_s", it.calming_rate_per_s, 1e-9, 100.0)
                .used_if(models),
            range("tracking.restlessness_prior_s", it.restlessness_prior_s, 1e-3, 1e6)
                .used_if(models),
            range("tracking.acceleration_density", it.acceleration_density, 1e-12, 1e6)
                .used_if(one_model),
            range("tracking.residual_window", it.residual_window as f64, 1.0, 1000.0)
                .used_if(residual),
            range("tracking.residual_scale", it.residual_scale, 1e-3, 1e3).used_if(residual),
            range("tracking.innovation_window", it.innovation_window as f64, 1.0, 1000.0)
                .used_if(innovation),
            probability("tracking.innovation_false_alarm", it.innovation_false_alarm)
                .used_if(innovation),
            range("tracking.clutter_per_sr", it.clutter_per_sr, 1e-9, 1e6),
            range("tracking.confirm_score", it.confirm_score, 1e-3, MAX_SCORE),
            range("tracking.coasting_after_s", it.coasting_after_s, 1e-3, 3600.0),
            range("tracking.lost_after_s", it.lost_after_s, 1e-3, 3600.0),
            range("tracking.max_position_sd_m", it.max_position_sd_m, 1e-3, 1e5),
            range("tracking.smoothing_s", it.smoothing_s, 0.0, 2.0),
            probability("tracking.gate_probability", it.gate_probability),
            probability("tracking.detection_probability", it.detection_probability),
        ]
    }

    fn models(&self) -> Result<(), FusionConfigError> {
        let key = "tracking.models.acceleration_density";
        let density = |model: &FlightModel| range(key, model.acceleration_density, 0.0, 1e6);
        self.tracking.models.iter().map(density).try_for_each(|range| range.check())?;
        MotionSetup::new(&self.tracking).map(drop)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The message with which a configuration with one change is refused.
    fn refused(change: impl FnOnce(&mut FusionConfig)) -> String {
        let mut config = FusionConfig::default();
        change(&mut config);
        config.validate().unwrap_err().to_string()
    }

    #[test]
    fn a_number_out_of_its_range_is_refused_with_its_key_and_the_range() {
        assert_eq!(FusionConfig::default().validate(), Ok(()));
        assert_eq!(
            refused(|c| c.initiation.birth_density_per_m3 = 1e150),
            "`initiation.birth_density_per_m3` is 1e150: it must be from 1e-30 to 1"
        );
        assert_eq!(
            refused(|c| c.tracking.acceleration_density = 3.5),
            "`tracking.acceleration_density` is 3.5: it must be left out: the method that is chosen does not use it"
        );
        let mut grouping = FusionConfig::default();
        grouping.initiation.method = InitiationMethod::Grouping;
        grouping.tracking.acceleration_density = 3.5;
        assert_eq!(grouping.validate(), Ok(()), "the gate between fixes uses it");
        assert_eq!(
            refused(|c| c.tracking.clutter_per_sr = 0.0),
            "`tracking.clutter_per_sr` is 0: it must be from 1e-9 to 1000000"
        );
        assert_eq!(
            refused(|c| c.event_time.lateness_s = f64::NAN),
            "`event_time.lateness_s` is NaN: it must be from 0.001 to 60"
        );
        assert_eq!(
            refused(|c| c.initiation.fixes = 5),
            "`initiation.fixes` is 5: it must be from 1 to 4"
        );
        assert_eq!(
            refused(|c| c.tracking.models[1].acceleration_density = f64::INFINITY),
            "`tracking.models.acceleration_density` is inf: it must be from 0 to 1000000"
        );
        assert_eq!(
            refused(|c| c.tracking.gate_probability = 1.0),
            "`tracking.gate_probability` is 1: it must be a probability between 0 and 1"
        );
    }

    #[test]
    fn nothing_that_is_not_a_number_is_taken_anywhere() {
        let mut config = FusionConfig::default();
        config.initiation.temporal_gate_m = Some(1.0);
        for range in config.numbers() {
            assert_eq!(range.check(), Ok(()), "the default is in its range");
            for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1.0, 1e150] {
                let odd = KeyRange { value, ..range };
                assert!(odd.check().is_err(), "{} may be {value}", odd.key);
            }
        }
    }
}
