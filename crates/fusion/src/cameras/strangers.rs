//! What a camera reports beside the targets that are followed.

use std::f64::consts::PI;

use crossfix_message::Timestamp;

use super::KnownCamera;

/// How long the strangers of a camera are averaged over, in times for which a bearing holds a
/// track.
const MEMORY: f64 = 2.0;
/// Strangers in an exposure that may always be, however few there were.
const LEAST_STRANGERS: f64 = 0.02;
/// No image covers less than this, sr: a microradian squared, which keeps densities finite for any
/// lens.
const LEAST_VIEW_SR: f64 = 1e-12;

/// Bearings of a camera in an exposure that belong to no track that is held in its place: their
/// running mean, as of the last exposure; nothing before the first.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Strangers(Option<(Timestamp, f64)>);

impl Strangers {
    /// Takes an exposure in; a bearing holds a track for `holding_s`.
    pub(super) fn see(&mut self, time: Timestamp, strangers: usize, holding_s: f64) {
        let strangers = strangers as f64;
        let mean = self.0.map_or(strangers, |(last, mean)| {
            let weight = (time.seconds_since(last) / (MEMORY * holding_s)).clamp(0.0, 1.0);
            mean + (strangers - mean) * weight
        });
        self.0 = Some((time, mean));
    }

    /// How many bearings are nobody's, 1/sr about the optical axis.
    pub(super) fn per_sr(&self, known: &KnownCamera) -> Option<f64> {
        self.0.map(|(_, mean)| (mean + LEAST_STRANGERS) / view_sr(known))
    }
}

/// How much a camera sees, sr about the optical axis.
pub(crate) fn view_sr(known: &KnownCamera) -> f64 {
    let lens = known.camera.model().intrinsics();
    let [width, height] = [lens.size.width, lens.size.height].map(f64::from);
    // Whatever a calibration says, no camera sees more than all directions or less than a point.
    ((width / lens.fx) * (height / lens.fy)).clamp(LEAST_VIEW_SR, 4.0 * PI)
}
