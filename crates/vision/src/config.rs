use serde::{Deserialize, Serialize};
use thiserror::Error;

/// How targets are followed. Lengths in pixels, brightness in 8-bit levels, times in seconds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrackerConfig {
    /// Pixels added to each side of the target's box to make the reference. Default 2.
    pub margin_px: f64,
    /// Standard deviation of the reference's Gaussian window as a share of its sides; the larger,
    /// the more the background counts. Default 0.28.
    pub window_share: f64,
    /// Standard deviation of the image's noise, levels: a floor under local contrast. Default 1.
    pub noise_floor: f64,
    /// Weight of the correlation against the prediction's log density. Default 25.
    pub score_weight: f64,
    /// Floor of the prediction's standard deviation in that density, px. Default 2.
    pub prediction_floor_px: f64,
    /// Standard deviation of the target's white acceleration, px/s^2 (000, equation 4: the largest
    /// acceleration by root 3). Default 900, a pixel a frame squared at 30 frames a second.
    pub acceleration_sd_px: f64,
    /// Standard deviation of a measurement of full quality, px. Default 0.5.
    pub measurement_sd_px: f64,
    /// Scores at which a measurement's quality is 0 and 1. Default 0.3 and 0.6.
    pub quality_scores: [f64; 2],
    /// Scores at which the reference adapts not at all and fully. Default 0.4 and 0.7.
    pub adaptation_scores: [f64; 2],
    /// Weight of the old reference at full adaptation (003). Default 0.93.
    pub reference_memory: f64,
    /// Weight of the first reference in the score, which holds the reference in its place. Default 0.15.
    pub anchor_share: f64,
    /// Threshold of the ellipsoidal gate on the innovation, `r' D^-1 r <= l^2` (001, 4.8). Default 25.
    pub gate_threshold: f64,
    /// The gate's half sides are at least this many standard deviations of the innovation, and at
    /// least the reference's sides: the papers' gate of three sides. Default 4.
    pub gate_sigmas: f64,
    /// Frames without a measurement after which a target is searched for. Default 3.
    pub search_after_frames: u32,
    /// How fast the gate's half sides grow in the search, px/s. Default 750.
    pub search_growth_px: f64,
    /// Score that ends the search. Default 0.55.
    pub search_score: f64,
    /// Standard deviation of the velocity after a search, px/s. Default 150.
    pub search_velocity_sd_px: f64,
    /// Share of the velocity that a target without a measurement keeps in a thirtieth of a second.
    /// Default 0.9.
    pub coasting_velocity: f64,
    /// A target found by the detector and not measured for this long is given up, s. Default 0.5.
    /// One taken up by an operator is never given up.
    pub give_up_after_s: f64,
    /// Finds targets by itself. Absent (default): only given boxes are followed.
    pub detector: Option<DetectorConfig>,
}

impl Default for TrackerConfig {
    fn default() -> Self {
        Self {
            margin_px: 2.0,
            window_share: 0.28,
            noise_floor: 1.0,
            score_weight: 25.0,
            prediction_floor_px: 2.0,
            acceleration_sd_px: 900.0,
            measurement_sd_px: 0.5,
            quality_scores: [0.3, 0.6],
            adaptation_scores: [0.4, 0.7],
            reference_memory: 0.93,
            anchor_share: 0.15,
            gate_threshold: 25.0,
            gate_sigmas: 4.0,
            search_after_frames: 3,
            search_growth_px: 750.0,
            search_score: 0.55,
            search_velocity_sd_px: 150.0,
            coasting_velocity: 0.9,
            give_up_after_s: 0.5,
            detector: None,
        }
    }
}

/// How targets are found: difference from a slow background, threshold, connected regions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DetectorConfig {
    /// Share of the old background kept in a frame. Default 0.98.
    pub background_memory: f64,
    /// Frames that make the first background. Default 10.
    pub warm_up_frames: u32,
    /// Difference that counts, in standard deviations of the image's noise. Default 6.
    pub threshold_sigmas: f64,
    /// Least and greatest number of pixels of a region. Default 6 and 2500.
    pub area_px: [usize; 2],
    /// Frames in a row in which a region must be seen near its place. Default 3.
    pub confirm_frames: u32,
    /// How far a region may move in a frame, px. Default 20.
    pub max_step_px: f64,
    /// Most targets followed at once. Default 16.
    pub max_targets: usize,
}

impl Default for DetectorConfig {
    fn default() -> Self {
        Self {
            background_memory: 0.98,
            warm_up_frames: 10,
            threshold_sigmas: 6.0,
            area_px: [6, 2500],
            confirm_frames: 3,
            max_step_px: 20.0,
            max_targets: 16,
        }
    }
}

/// A number of the configuration that makes no sense.
#[derive(Clone, Debug, PartialEq, Error)]
#[error("`{key}` is {value}: it must be {must}")]
pub struct ConfigError {
    /// The key.
    pub key: &'static str,
    /// What it is.
    pub value: f64,
    /// What it must be.
    pub must: &'static str,
}

impl TrackerConfig {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first [`ConfigError`].
    pub fn validate(&self) -> Result<(), ConfigError> {
        let check = |key, value: f64, good: bool, must| {
            if good { Ok(()) } else { Err(ConfigError { key, value, must }) }
        };
        let positive = [
            ("window_share", self.window_share),
            ("noise_floor", self.noise_floor),
            ("score_weight", self.score_weight),
            ("prediction_floor_px", self.prediction_floor_px),
            ("acceleration_sd_px", self.acceleration_sd_px),
            ("measurement_sd_px", self.measurement_sd_px),
            ("gate_threshold", self.gate_threshold),
            ("gate_sigmas", self.gate_sigmas),
            ("search_velocity_sd_px", self.search_velocity_sd_px),
            ("give_up_after_s", self.give_up_after_s),
        ];
        for (key, value) in positive {
            check(key, value, value.is_finite() && value > 0.0, "a positive number")?;
        }
        let shares = [
            ("reference_memory", self.reference_memory),
            ("anchor_share", self.anchor_share),
            ("coasting_velocity", self.coasting_velocity),
        ];
        for (key, value) in shares {
            check(key, value, (0.0..=1.0).contains(&value), "from 0 to 1")?;
        }
        let margin = self.margin_px;
        check("margin_px", margin, (0.0..=100.0).contains(&margin), "from 0 to 100 px")?;
        for (key, [low, high]) in
            [("quality_scores", self.quality_scores), ("adaptation_scores", self.adaptation_scores)]
        {
            check(key, low, low < high, "smaller than the second of the two")?;
        }
        if let Some(detector) = &self.detector {
            let memory = detector.background_memory;
            check("detector.background_memory", memory, (0.0..1.0).contains(&memory), "from 0 to 1")?;
            let sigmas = detector.threshold_sigmas;
            check("detector.threshold_sigmas", sigmas, sigmas > 0.0, "a positive number")?;
        }
        Ok(())
    }
}
