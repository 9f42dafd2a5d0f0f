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
    least: f64,
    most: f64,
}

const fn range(key: &'static str, value: f64, least: f64, most: f64) -> KeyRange {
    KeyRange { key, value, least, most }
}

/// A key and its number.
type NumberKey = (&'static str, fn(&FusionConfig) -> f64);

/// Keys of equal weights for all bearings.
const OF_EQUAL_WEIGHTS: &[NumberKey] = &[("bearings.equal_sd_rad", |c| c.bearings.equal_sd_rad)];
/// Keys of the papers' pairs of lines.
const OF_PAIRS: &[NumberKey] = &[("initiation.pair_gate_m2", |c| c.initiation.pair_gate_m2)];
/// Keys of the papers' grouping of fixes.
const OF_GROUPING: &[NumberKey] =
    &[("initiation.temporal_gate_m", |c| c.initiation.temporal_gate_m.unwrap_or(f64::NAN))];
/// Keys of the initiation by hypotheses.
const OF_HYPOTHESES: &[NumberKey] = &[
    ("initiation.birth_density_per_m3", |c| c.initiation.birth_density_per_m3),
    ("initiation.pair_s", |c| c.initiation.pair_s),
];
/// Keys of a single motion model.
const OF_ONE_MODEL: &[NumberKey] =
    &[("tracking.acceleration_density", |c| c.tracking.acceleration_density)];
/// Keys of several motion models.
const OF_MODELS: &[NumberKey] = &[
    ("tracking.switching_rate_per_s", |c| c.tracking.switching_rate_per_s),
    ("tracking.calming_rate_per_s", |c| c.tracking.calming_rate_per_s),
    ("tracking.restlessness_prior_s", |c| c.tracking.restlessness_prior_s),
];
/// Keys of the manoeuvre detector by smoothed residuals.
const OF_SMOOTHED_RESIDUAL: &[NumberKey] = &[
    ("tracking.residual_window", |c| c.tracking.residual_window as f64),
    ("tracking.residual_scale", |c| c.tracking.residual_scale),
];
/// Keys of the manoeuvre detector by innovations.
const OF_INNOVATION: &[NumberKey] = &[
    ("tracking.innovation_window", |c| c.tracking.innovation_window as f64),
    ("tracking.innovation_false_alarm", |c| c.tracking.innovation_false_alarm),
];

impl KeyRange {
    fn check(&self) -> Result<(), FusionConfigError> {
        let &Self { key, value, least, most } = self;
        // NaN is in no range.
        if (least..=most).contains(&value) {
            return Ok(());
        }
        Err(FusionConfigError {
            key,
            value,
            must: format!("from {} to {}", plain(least), plain(most)),
        })
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
        let ranges = [self.time_and_bearings(), self.initiation_ranges(), self.tracking_ranges()];
        ranges.iter().flatten().try_for_each(KeyRange::check)?;
        self.models()?;
        self.probabilities()?;
        self.unused().map_or(Ok(()), Err)
    }

    /// Finds a number that differs from the default although none of the chosen methods uses it:
    /// whoever has set it thinks that it does something.
    fn unused(&self) -> Option<FusionConfigError> {
        let Self { bearings, initiation, tracking, .. } = self;
        let usual = Self::default();
        let grouping = initiation.method == InitiationMethod::Grouping;
        let pairs = grouping && initiation.solver == SpatialSolver::Pair;
        // The gate between fixes is from the covariances unless it is given.
        let one_model = tracking.manoeuvres != Manoeuvres::Models
            || (grouping && initiation.temporal_gate_m.is_none());
        let keys = [
            (bearings.weighting == Weighting::Equal, OF_EQUAL_WEIGHTS),
            (pairs, OF_PAIRS),
            (grouping, OF_GROUPING),
            (!grouping, OF_HYPOTHESES),
            (one_model, OF_ONE_MODEL),
            (tracking.manoeuvres == Manoeuvres::Models, OF_MODELS),
            (tracking.manoeuvres == Manoeuvres::SmoothedResidual, OF_SMOOTHED_RESIDUAL),
            (tracking.manoeuvres == Manoeuvres::Innovation, OF_INNOVATION),
        ];
        let unused = keys.into_iter().filter(|(is_used, _)| !is_used).flat_map(|(_, keys)| keys);
        let mut set =
            unused.filter(|(_, number)| number(self).to_bits() != number(&usual).to_bits());
        set.next().map(|(key, number)| {
            let must = "left out: the method that is chosen does not use it".to_owned();
            FusionConfigError { key, value: number(self), must }
        })
    }

    fn time_and_bearings(&self) -> Vec<KeyRange> {
        let Self { event_time, bearings, clocks, .. } = self;
        vec![
            range("event_time.lateness_s", event_time.lateness_s, 1e-3, 60.0),
            range("event_time.max_ahead_s", event_time.max_ahead_s, 1e-3, 3600.0),
            range("bearings.equal_sd_rad", bearings.equal_sd_rad, 1e-9, 0.1),
            range("bearings.systematic_sd_rad", bearings.systematic_sd_rad, 0.0, 0.1),
            range("clocks.least_sd_s", clocks.least_sd_s, 1e-9, 10.0),
            range("clocks.drift_sd", clocks.drift_sd, 1e-12, 0.1),
        ]
    }

    fn initiation_ranges(&self) -> Vec<KeyRange> {
        let it = &self.initiation;
        vec![
            range("initiation.birth_density_per_m3", it.birth_density_per_m3, 1e-30, 1.0),
            range("initiation.period_s", it.period_s, 1e-4, 60.0),
            range("initiation.pair_s", it.pair_s, 1e-3, 3600.0),
            range("initiation.velocity_prior_sd_mps", it.velocity_prior_sd_mps, 1e-3, 1e4),
            range("initiation.max_range_m", it.max_range_m, 1e-2, 1e6),
            range("initiation.pair_gate_m2", it.pair_gate_m2, 1e-9, 1e9),
            range("initiation.temporal_gate_m", it.temporal_gate_m.unwrap_or(1.0), 1e-6, 1e6),
            range("initiation.periods", it.periods as f64, 2.0, 20.0),
            range("initiation.fixes", it.fixes as f64, 1.0, it.periods as f64),
            range("initiation.shared_lines", it.shared_lines as f64, 0.0, 64.0),
        ]
    }

    fn tracking_ranges(&self) -> Vec<KeyRange> {
        let it = &self.tracking;
        vec![
            range("tracking.switching_rate_per_s", it.switching_rate_per_s, 1e-9, 100.0),
            range("tracking.calming_rate_per_s", it.calming_rate_per_s, 1e-9, 100.0),
            range("tracking.restlessness_prior_s", it.restlessness_prior_s, 1e-3, 1e6),
            range("tracking.acceleration_density", it.acceleration_density, 1e-12, 1e6),
            range("tracking.residual_window", it.residual_window as f64, 1.0, 1000.0),
            range("tracking.residual_scale", it.residual_scale, 1e-3, 1e3),
            range("tracking.innovation_window", it.innovation_window as f64, 1.0, 1000.0),
            range("tracking.clutter_per_sr", it.clutter_per_sr, 1e-9, 1e6),
            range("tracking.confirm_score", it.confirm_score, 1e-3, MAX_SCORE),
            range("tracking.coasting_after_s", it.coasting_after_s, 1e-3, 3600.0),
            range("tracking.lost_after_s", it.lost_after_s, 1e-3, 3600.0),
            range("tracking.max_position_sd_m", it.max_position_sd_m, 1e-3, 1e5),
            range("tracking.smoothing_s", it.smoothing_s, 0.0, 2.0),
        ]
    }

    fn models(&self) -> Result<(), FusionConfigError> {
        let key = "tracking.models.acceleration_density";
        let density = |model: &FlightModel| range(key, model.acceleration_density, 0.0, 1e6);
        self.tracking.models.iter().map(density).try_for_each(|range| range.check())?;
        MotionSetup::new(&self.tracking).map(drop)
    }

    fn probabilities(&self) -> Result<(), FusionConfigError> {
        let Self { initiation, tracking, .. } = self;
        let probabilities = [
            ("initiation.spatial_gate_probability", initiation.spatial_gate_probability),
            ("tracking.gate_probability", tracking.gate_probability),
            ("tracking.detection_probability", tracking.detection_probability),
            ("tracking.innovation_false_alarm", tracking.innovation_false_alarm),
        ];
        for (key, value) in probabilities {
            if !(value > 0.0 && value < 1.0) {
                return Err(FusionConfigError {
                    key,
                    value,
                    must: "a probability between 0 and 1".to_owned(),
                });
            }
        }
        Ok(())
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
        let config = FusionConfig::default();
        let tables =
            [config.time_and_bearings(), config.initiation_ranges(), config.tracking_ranges()];
        for range in tables.iter().flatten() {
            assert_eq!(range.check(), Ok(()), "the default is in its range");
            for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1.0, 1e150] {
                let odd = KeyRange { value, ..*range };
                assert!(odd.check().is_err(), "{} may be {value}", odd.key);
            }
        }
    }
}
