//! Clutter: bearings that a camera reports of other objects than the targets that are followed.

use std::f64::consts::PI;

use crossfix_message::Timestamp;

use super::KnownCamera;

/// Time over which a camera's number of unassigned bearings is averaged, in units of the time for
/// which a bearing holds a track. With twice as much a flock of birds that has passed makes every
/// bearing count less for twice as long.
const MEMORY: f64 = 2.0;
/// Unassigned bearings per exposure that are added to the mean: clutter may always be there,
/// however little was seen. With half of it a bearing of a camera that has seen no clutter counts
/// for 0.7 more (ln 2) in a log-likelihood ratio.
const LEAST_PER_EXPOSURE: f64 = 0.02;
/// Least solid angle of an image, sr: a microradian squared, which keeps densities finite for any
/// lens. With half of it the same.
const LEAST_VIEW_SR: f64 = 1e-12;

/// Running mean of the number of a camera's bearings in an exposure that belong to no track that
/// two cameras support, with the time of the last exposure; nothing before the first.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct ClutterRate(Option<(Timestamp, f64)>);

impl ClutterRate {
    /// Takes an exposure in; a bearing holds a track for `holding_s`.
    pub(super) fn see(&mut self, time: Timestamp, unassigned: usize, holding_s: f64) {
        let unassigned = unassigned as f64;
        let mean = self.0.map_or(unassigned, |(last, mean)| {
            let weight = (time.seconds_since(last) / (MEMORY * holding_s)).clamp(0.0, 1.0);
            mean + (unassigned - mean) * weight
        });
        self.0 = Some((time, mean));
    }

    /// Density of the clutter, 1/sr about the optical axis.
    pub(super) fn per_sr(&self, known: &KnownCamera) -> Option<f64> {
        self.0.map(|(_, mean)| (mean + LEAST_PER_EXPOSURE) / view_sr(known))
    }
}

/// Solid angle of a camera's image, sr about the optical axis.
pub(crate) fn view_sr(known: &KnownCamera) -> f64 {
    let lens = known.camera.model().intrinsics();
    let [width, height] = [lens.size.width, lens.size.height].map(f64::from);
    // Whatever a calibration says, no camera sees more than all directions or less than a point.
    // A pixel about the optical axis covers 1 / (fx fy) sr.
    ((width / lens.fx) * (height / lens.fy)).clamp(LEAST_VIEW_SR, 4.0 * PI)
}
