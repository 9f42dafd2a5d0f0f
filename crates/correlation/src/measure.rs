use serde::{Deserialize, Serialize};

/// Similarity of two images: the measures of Lytvynets 2020, chapter 3, whose equations are cited
/// by their numbers. `h` is the gate, `g` the reference placed at (x, y) of it; a map of similarity
/// is largest where they are most alike.
///
/// (3.1) and (3.6) as printed return the displacement with the wrong sign (erratum); here a peak at
/// (x, y) always means that the reference's top left sample lies at (x, y) of the gate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Similarity {
    /// Cross-correlation `K = sum h g` (3.1).
    CrossCorrelation,
    /// Normalised cross-correlation `R = sum h g / sqrt(sum h^2 sum g^2)` (3.3), from 0 to 1 on
    /// brightness (which is not negative).
    Normalised,
    /// (3.3) with the means removed, from -1 to 1: what the thesis means, as its stated range and
    /// insensitivity to brightness show (erratum). Weighted by the reference's window. The default.
    #[default]
    ZeroMeanNormalised,
    /// Phase correlation, (3.7) with `q = |H* G|^-1` (3.8). With [`Extent::Linear`] only the
    /// placements that do not wrap round are returned.
    Phase,
    /// The cross-spectrum with a weight `q` (3.7; erratum: the exponent is `x wx / N + y wy / M`).
    CrossSpectrum(SpectralWeight),
    /// Sum of absolute differences (3.10), negated.
    AbsoluteDifferences,
    /// Root of the sum of squared differences (3.11), negated.
    SquaredDifferences,
    /// Largest absolute difference (3.12), negated.
    MaximumDifference,
}

/// The weight of a frequency in the cross-spectrum:
/// `q = |H* G|^-whitening exp(-(wx^2 + wy^2) / (2 band^2))`, frequencies in cycles per sample.
///
/// Whitening 0 is the plain correlation of deviations, 1 the phase correlation; a band of 0.15 to
/// 0.3 leaves the noise of the high frequencies out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpectralWeight {
    /// Exponent of the whitening, from 0 to 1.
    pub whitening: f32,
    /// Standard deviation of the Gaussian band, cycles per sample, more than 0.
    pub band: f32,
}

/// Treatment of placements where the reference extends beyond the gate's border.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Extent {
    /// There are none: only placements wholly inside the gate are evaluated. The default.
    #[default]
    Linear,
    /// The gate continues periodically: as many placements as the gate has samples.
    Circular,
}
