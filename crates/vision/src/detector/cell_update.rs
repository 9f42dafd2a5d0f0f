//! How the background's cells learn an image.

use pulp::Arch;

/// A squared change counts in the learnt mean and variance for at most this many variances: what
/// passes by is no noise of the place. With half of it flickering leaves take twice as long to be
/// learnt; without it the first target makes its path blind, and the place where it was before it
/// was found looks like something that has come.
pub(super) const OUTLYING: f32 = 16.0;
/// Standard deviation by which contrasts vary from place to place when the light changes, as a
/// share of the contrast. With half of it a cloud's shadow changes sharp edges by three standard
/// deviations.
const CONTRAST_SPREAD: f32 = 0.03;

/// Squared slope, (levels per cell)^2, by central differences between the neighbours.
#[inline(always)]
pub(super) fn slope_squared([left, right]: [f32; 2], [above, below]: [f32; 2]) -> f32 {
    0.25 * ((right - left) * (right - left) + (below - above) * (below - above))
}

/// One image's update of the background's cells.
#[derive(Clone, Copy, Debug)]
pub(super) struct CellUpdate {
    /// Least weight of this image: that of a background which forgets exponentially.
    pub(super) share: f32,
    pub(super) noise: f32,
    pub(super) sway: f32,
    pub(super) contrast: f32,
}

/// One row of the background, or a part of it.
#[derive(Debug)]
pub(super) struct BackgroundRow<'a> {
    pub(super) now: &'a [f32],
    pub(super) textures: &'a [f32],
    pub(super) mean: &'a mut [f32],
    pub(super) variance: &'a mut [f32],
    pub(super) learnt_images: &'a mut [f32],
    pub(super) change: &'a mut [f32],
}

impl CellUpdate {
    /// Variance of each cell's change in a row, from the scene's sway and the light: `sway slope^2
    /// + (CONTRAST_SPREAD mean)^2`.
    pub(super) fn textures(self, above: &[f32], here: &[f32], below: &[f32], to: &mut Vec<f32>) {
        let Self { sway, .. } = self;
        to.clear();
        to.resize(here.len(), 0.0);
        Arch::new().dispatch(|| {
            let columns = here.windows(3).zip(&above[1..]).zip(&below[1..]);
            for (out, ((near, above), below)) in to[1..].iter_mut().zip(columns) {
                // Beside the sway, light changes the contrast of every cell by a share of its own.
                let lit = CONTRAST_SPREAD * near[1];
                *out = sway * slope_squared([near[0], near[2]], [*above, *below]) + lit * lit;
            }
        });
    }

    pub(super) fn learn(self, row: BackgroundRow<'_>) {
        let Self { share, noise, contrast, .. } = self;
        Arch::new().dispatch(|| {
            let learnt =
                row.mean.iter_mut().zip(row.variance).zip(row.learnt_images).zip(row.change);
            for ((((mean, variance), learnt_images), change), (now, texture)) in
                learnt.zip(row.now.iter().zip(row.textures))
            {
                let is_new = *learnt_images == 0.0;
                // A young cell is the plain mean of its images, an old one forgets exponentially.
                let share = share.max((*learnt_images + 1.0).recip());
                let off = if is_new { 0.0 } else { now - contrast * *mean };
                // In standard deviations; mean and variance learn from it with a limit on outliers.
                // The mean of n images has a variance of its own, an n-th of theirs.
                let usual = variance.max(noise);
                let of_mean = usual * learnt_images.max(1.0).recip();
                *change = off / (usual + of_mean + texture).sqrt();
                let most = (OUTLYING * usual).sqrt();
                *mean =
                    if is_new { now / contrast } else { *mean + share * off.clamp(-most, most) };
                *variance = if is_new {
                    0.0
                } else {
                    *variance + share * ((off * off).min(OUTLYING * usual) - *variance)
                };
                *learnt_images += 1.0;
            }
        });
    }
}
