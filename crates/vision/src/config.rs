//! The configuration of the image tracker: what may be set, with its defaults and ranges.

use crossfix_correlation::{Extent, Similarity, SpectralWeight};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::{ReferenceStrategy, TrackerPart};

/// How targets are followed. Lengths in pixels, brightness in the image's own unit, times in
/// seconds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrackerConfig {
    /// Which algorithm. Default [`Algorithm::Posterior`].
    pub algorithm: Algorithm,
    /// How the reference follows the target's appearance. Default: the mean of its images.
    pub reference: ReferenceStrategy,
    /// The gate, the region in which a target is looked for. Default: four standard deviations of
    /// the prediction, and at least the papers' three sides.
    pub gate: GateRule,
    /// Whether the reference follows the target's size and direction. Default true.
    pub follow_shape: bool,
    /// Pixels added to each side of the target's box to make the reference. Default 2: most of what
    /// is known of a target's place comes from its edge.
    pub margin_px: f64,
    /// Floor of the standard deviation of the image's noise: one level. Default 1, a level of 8
    /// bits; the noise above it is measured in every image. The per-pixel filters' noises are in
    /// this unit.
    pub noise_floor: f64,
    /// Standard deviation of the white acceleration of the liveliest target, px/s^2 (Herasymenko
    /// 2021, eq. 4: the largest acceleration by root 3). Default 900, a pixel per frame squared at
    /// 30 frames per second. How lively each target is, from even flight on, is learnt from its
    /// images; the papers' algorithm takes all for the liveliest.
    pub acceleration_sd_px: f64,
    /// Standard deviation of the velocity of a target that is taken up, px/s. Default 120.
    pub start_velocity_sd_px: f64,
    /// Standard deviation of a place that is given (a box, a cue), px. Default 0.1.
    pub given_sd_px: f64,
    /// Standard deviation of a given box about its target, px: a box that is too large or lies
    /// beside what stands out there is moved onto that. 0 takes every box as it is. Default 4.
    pub box_sd_px: f64,
    /// Standard deviation of the box's centre about the target's own, px: this error is the same in
    /// all images of a track, and part of every covariance that is answered until somebody says
    /// where the target is. Default 0.1.
    pub centre_sd_px: f64,
    /// Floor of the prediction's standard deviation, px. Default 0.3.
    pub prediction_floor_px: f64,
    /// Inverse of the share of the reference's energy that a mismatch with the target may take.
    /// Default 30; at 60 textured background is taken for targets.
    pub mismatch: f64,
    /// Standard deviation of an image's contrast about what is expected, as a share of it. Default
    /// 0.5.
    pub contrast_sd: f64,
    /// Share of the images in which a target can be seen, apart from a blur or a bird in front of
    /// it. Default 0.95.
    pub visible_probability: f64,
    /// Share of the prior that is uniform over the gate. Default 0.01; it doubles with every image
    /// without the target, up to a half.
    pub anywhere_share: f64,
    /// Growth of the search area for a lost target, px/s. Default 750.
    pub search_growth_px: f64,
    /// Standard deviation of the velocity of a target found again, px/s. Default 150.
    pub search_velocity_sd_px: f64,
    /// A target found by the detector and not seen for this long is given up, s. Default 0.5.
    /// One taken up by an operator is never given up.
    pub give_up_after_s: f64,
    /// Settings of [`Algorithm::Paper`] alone.
    pub paper: PaperConfig,
    /// Finds targets by itself. Absent (default): only given boxes are followed, and found again
    /// where they are lost.
    pub detector: Option<DetectorConfig>,
    /// A part that is left out ([`Self::without`]), to measure what it brings. Not a setting: no
    /// file has it. Default: none.
    #[serde(skip)]
    pub left_out: Option<TrackerPart>,
}

/// How a target's place is decided.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Algorithm {
    /// By the posterior over all placements: the likelihood of the zero-mean correlation in the
    /// measured noise, the filters' prediction as prior, and a fit between the pixels.
    #[default]
    Posterior,
    /// To the letter of Herasymenko 2021 and Lytvynets 2020: one peak of one measure in a gate of
    /// three sides, and filters of fixed noise. `gate`, `margin_px` and `follow_shape` do not
    /// matter to it.
    Paper,
}

/// The gate (Herasymenko 2021, section 1; Lytvynets 2020, eqs. 4.8 and 5.12).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum GateRule {
    /// A rectangle of three times the reference's sides.
    ThreeSided,
    /// At least that, and wide enough for this many standard deviations of the prediction.
    Innovation {
        /// Standard deviations. Default 4.
        sigmas: f64,
    },
    /// As wide as the ellipse `r' D^-1 r <= l^2` that contains the target with a probability
    /// (Lytvynets 2020, eqs. 4.8 to 4.11); a measurement outside it is discarded.
    Ellipsoid {
        /// Probability, 0 to 1.
        probability: f64,
    },
}

impl Default for GateRule {
    fn default() -> Self {
        Self::Innovation { sigmas: 4.0 }
    }
}

/// Settings of the papers' own algorithm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PaperConfig {
    /// The similarity measure (Lytvynets 2020, chapter 3). Default: cross-correlation.
    pub similarity: Similarity,
    /// Whether the correlation wraps round the gate. Default circular, as a product of spectra
    /// does.
    pub extent: Extent,
    /// Whether the reference is the whole gate about the target. Default true.
    pub whole_gate: bool,
    /// Whether the peak is refined between the pixels. Default false.
    pub sub_pixel: bool,
    /// Standard deviation of a measurement, px. Default 1.
    pub measurement_sd_px: f64,
}

impl Default for PaperConfig {
    fn default() -> Self {
        Self {
            similarity: Similarity::CrossCorrelation,
            extent: Extent::Circular,
            whole_gate: true,
            sub_pixel: false,
            measurement_sd_px: 1.0,
        }
    }
}

impl Default for TrackerConfig {
    fn default() -> Self {
        Self {
            algorithm: Algorithm::default(),
            reference: ReferenceStrategy::default(),
            gate: GateRule::default(),
            follow_shape: true,
            margin_px: 2.0,
            noise_floor: 1.0,
            acceleration_sd_px: 900.0,
            start_velocity_sd_px: 120.0,
            given_sd_px: 0.1,
            box_sd_px: 4.0,
            centre_sd_px: 0.1,
            prediction_floor_px: 0.3,
            mismatch: 30.0,
            contrast_sd: 0.5,
            visible_probability: 0.95,
            anywhere_share: 0.01,
            search_growth_px: 750.0,
            search_velocity_sd_px: 150.0,
            give_up_after_s: 0.5,
            paper: PaperConfig::default(),
            detector: None,
            left_out: None,
        }
    }
}

impl TrackerConfig {
    /// The algorithm of Herasymenko 2021 and Lytvynets 2020 as their tables were made: fixed
    /// reference, gate of three sides.
    pub fn paper() -> Self {
        Self {
            algorithm: Algorithm::Paper,
            reference: ReferenceStrategy::Fixed,
            gate: GateRule::ThreeSided,
            follow_shape: false,
            ..Self::default()
        }
    }
}

/// How targets are found: what stands out of its surroundings, and did not before.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DetectorConfig {
    /// Allowed rate of finds that are no target, 1/min, from 0.000001 to 1000000. Default 1.
    pub false_tracks_a_minute: f64,
    /// Averaging time of the background, s, from 0.1 to 10000. Default 5: clouds are others by
    /// then, and what hovers for that long becomes background unless it was found before.
    pub background_s: f64,
    /// Most targets followed at once, from 1 to 1000. Default 50.
    pub max_targets: usize,
}

impl Default for DetectorConfig {
    fn default() -> Self {
        Self { false_tracks_a_minute: 1.0, background_s: 5.0, max_targets: 50 }
    }
}

/// A number of the configuration that is outside its range.
#[derive(Clone, Debug, PartialEq, Error)]
#[error("`{key}` is {value}: it must be {must}")]
pub struct TrackerConfigError {
    /// The key.
    pub key: &'static str,
    /// Its value.
    pub value: f64,
    /// Its range.
    pub must: &'static str,
}

fn check(
    key: &'static str,
    value: f64,
    good: bool,
    must: &'static str,
) -> Result<(), TrackerConfigError> {
    if good { Ok(()) } else { Err(TrackerConfigError { key, value, must }) }
}

impl DetectorConfig {
    fn validate(&self) -> Result<(), TrackerConfigError> {
        let rate = self.false_tracks_a_minute;
        check(
            "detector.false_tracks_a_minute",
            rate,
            (1e-6..=1e6).contains(&rate),
            "from 0.000001 to 1000000",
        )?;
        let most = self.max_targets;
        check("detector.max_targets", most as f64, (1..=1000).contains(&most), "from 1 to 1000")?;
        let memory = self.background_s;
        check(
            "detector.background_s",
            memory,
            (0.1..=1e4).contains(&memory),
            "from 0.1 to 10000 s",
        )?;
        Ok(())
    }
}

impl TrackerConfig {
    /// Checks every number against its range.
    ///
    /// # Errors
    /// The first [`TrackerConfigError`].
    pub fn validate(&self) -> Result<(), TrackerConfigError> {
        let positive = [
            ("noise_floor", self.noise_floor),
            ("acceleration_sd_px", self.acceleration_sd_px),
            ("start_velocity_sd_px", self.start_velocity_sd_px),
            ("given_sd_px", self.given_sd_px),
            ("prediction_floor_px", self.prediction_floor_px),
            ("mismatch", self.mismatch),
            ("contrast_sd", self.contrast_sd),
            ("search_growth_px", self.search_growth_px),
            ("search_velocity_sd_px", self.search_velocity_sd_px),
            ("give_up_after_s", self.give_up_after_s),
            ("paper.measurement_sd_px", self.paper.measurement_sd_px),
        ];
        for (key, value) in positive {
            check(key, value, (1e-6..=1e6).contains(&value), "from 0.000001 to 1000000")?;
        }
        let centre = self.centre_sd_px;
        check("centre_sd_px", centre, (0.0..=100.0).contains(&centre), "from 0 to 100 px")?;
        let given = self.box_sd_px;
        check("box_sd_px", given, (0.0..=100.0).contains(&given), "from 0 to 100 px")?;
        let within = |value: f64| value > 0.0 && value < 1.0;
        let visible = self.visible_probability;
        check("visible_probability", visible, within(visible), "between 0 and 1")?;
        check(
            "anywhere_share",
            self.anywhere_share,
            within(self.anywhere_share),
            "between 0 and 1",
        )?;
        let margin = self.margin_px;
        check("margin_px", margin, (0.0..=100.0).contains(&margin), "from 0 to 100 px")?;
        self.validate_paper()?;
        self.validate_gate_and_reference()?;
        self.detector.as_ref().map_or(Ok(()), DetectorConfig::validate)
    }

    fn validate_paper(&self) -> Result<(), TrackerConfigError> {
        if let Similarity::CrossSpectrum(SpectralWeight { whitening, band }) = self.paper.similarity
        {
            let good = (0.0..=1.0).contains(&whitening);
            check(
                "paper.similarity.cross-spectrum.whitening",
                f64::from(whitening),
                good,
                "from 0 to 1",
            )?;
            let good = (1e-3..=1e3).contains(&band);
            check(
                "paper.similarity.cross-spectrum.band",
                f64::from(band),
                good,
                "from 0.001 to 1000",
            )?;
        }
        if self.paper.whole_gate && self.paper.extent == Extent::Linear {
            let must = "false where the extent is linear: a reference as large as the gate has one \
                        place in it";
            check("paper.whole_gate", 1.0, false, must)?;
        }
        Ok(())
    }

    fn validate_gate_and_reference(&self) -> Result<(), TrackerConfigError> {
        let within = |value: f64| value > 0.0 && value < 1.0;
        match self.gate {
            GateRule::ThreeSided => {}
            GateRule::Innovation { sigmas } => {
                check("gate.sigmas", sigmas, (0.0..=100.0).contains(&sigmas), "from 0 to 100")?;
            }
            GateRule::Ellipsoid { probability } => {
                check("gate.probability", probability, within(probability), "between 0 and 1")?;
            }
        }
        match self.reference {
            ReferenceStrategy::Smoothing { memory } => {
                let holds = (0.0..=1.0).contains(&memory);
                check("reference.memory", f64::from(memory), holds, "from 0 to 1")?;
            }
            ReferenceStrategy::Mean { least_share } => {
                let holds = (0.0..=1.0).contains(&least_share);
                check("reference.least_share", f64::from(least_share), holds, "from 0 to 1")?;
            }
            ReferenceStrategy::PixelImm(imm) => {
                let noises = [
                    ("reference.constant_sd", imm.constant_sd),
                    ("reference.drift_sd", imm.drift_sd),
                    ("reference.jump_sd", imm.jump_sd),
                ];
                for (key, sd) in noises {
                    check(key, f64::from(sd), (0.0..=1e6).contains(&sd), "from 0 to 1000000")?;
                }
                let rate = imm.jump_rate;
                check(
                    "reference.jump_rate",
                    f64::from(rate),
                    (1e-2..=1e2).contains(&rate),
                    "from 0.01 to 100",
                )?;
                let stay = f64::from(imm.stay);
                check("reference.stay", stay, within(stay), "between 0 and 1")?;
            }
            ReferenceStrategy::Fixed | ReferenceStrategy::Replacement => {}
        }
        Ok(())
    }
}
