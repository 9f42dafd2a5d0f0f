use serde::{Deserialize, Serialize};

/// How alike two images are: the measures of Lytvynets 2020, chapter 3. `h` is the gate, `g` the
/// reference placed at (x, y) of it; a map of similarity is largest where they are most alike.
///
/// (3.1) and (3.6) as printed return the displacement with the wrong sign (erratum); here a peak at
/// (x, y) always is the reference with its top left sample at (x, y) of the gate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Similarity {
    /// Cross-correlation `K = sum h g` (3.1).
    CrossCorrelation,
    /// Normalised cross-correlation `R = sum h g / sqrt(sum h^2 sum g^2)` (3.3), from 0 to 1 on
    /// brightness.
    Normalised,
    /// (3.3) with the means removed, from -1 to 1: what is meant, by its range and its
    /// insensitivity to brightness (erratum). Weighted by the reference's window. The default.
    #[default]
    ZeroMeanNormalised,
    /// Phase correlation, (3.7) with `q = |H* G|^-1` (3.8). Only the placements that do not wrap
    /// round are returned with [`Extent::Linear`].
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
/// `q = |H* G|^-whitening exp(-(wx^2 + wy^2) / (2 band^2))`, frequencies in cycles a sample.
///
/// Whitening 0 is the plain correlation of deviations, 1 the phase correlation; a band of 0.15 to
/// 0.3 leaves the noise of the high frequencies out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpectralWeight {
    /// From 0 to 1.
    pub whitening: f32,
    /// Cycles a sample, more than 0.
    pub band: f32,
}

/// What a reference does that hangs over the gate's border.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Extent {
    /// It does not: only placements wholly inside are looked at. The default.
    #[default]
    Linear,
    /// It comes in again on the other side: as many placements as the gate has samples.
    Circular,
}
