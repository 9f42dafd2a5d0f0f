//! Where a camera on a mount points.

use crossfix_geometry::ScanAngles;
use crossfix_message::Pointing;

use super::KnownCamera;
use crate::uncertainty::CorrelatedNoise;

/// How long the error of the angles that a mount reports lasts while the mount does not turn, s:
/// longer than it looks in one direction. With a tenth of it a camera that stares at a target for a
/// minute would count as having measured its direction many times over.
const DWELL_S: f64 = 100.0;
/// A mount has turned if it reports a direction this many deviations from the one before. If each
/// reading errs afresh, 2 % of them pass for a turn, after which the camera forgets what stands in
/// its view; with half of it more than a third would.
const TURNED_SDS: f64 = 4.0;
/// Angles that differ by less than this are the same, rad: what is left of a number on its way.
/// With half of it the same.
const SAME_RAD: f64 = 1e-9;
/// A mount whose angles have at least this standard deviation says nothing, rad. With half of it
/// the same: angles known to 30 degrees lead to no target.
const WORST_SD_RAD: f64 = 1.0;

/// Where a camera on a mount pointed in an exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ReportedPointing {
    angles: ScanAngles,
    /// Standard deviation of the direction along the axis that is known worse, rad.
    sd_rad: f64,
    /// Whether the mount stood still.
    pub(crate) is_settled: bool,
}

impl ReportedPointing {
    /// Reads the pointing of a frame; `None` if it is impossible.
    pub(crate) fn read(message: &Pointing) -> Option<Self> {
        let angles = message.angles()?;
        // An azimuth error a turns the direction by a cos(elevation).
        let sd_rad = (message.azimuth_sd * angles.elevation.cos()).max(message.elevation_sd);
        let possible = |sd: f64| (0.0..WORST_SD_RAD).contains(&sd);
        let both = possible(message.azimuth_sd) && possible(message.elevation_sd);
        both.then_some(Self { angles, sd_rad, is_settled: message.settled })
    }

    /// Whether the mount has turned since it pointed as `before`.
    pub(crate) fn has_turned_from(&self, before: &Self) -> bool {
        let by = (self.angles.azimuth - before.angles.azimuth)
            .hypot(self.angles.elevation - before.angles.elevation);
        !before.is_settled || by > TURNED_SDS * self.sd_rad + SAME_RAD
    }
}

impl KnownCamera {
    /// The camera turned to where its mount points; unchanged if no mount turns it.
    pub(crate) fn pointed(&self, pointed: &ReportedPointing) -> Self {
        let Some(mount) = &self.mount else { return self.clone() };
        Self {
            camera: self.camera.posed(mount.pose(pointed.angles)),
            lasting: with_pointing(self.lasting, pointed),
            is_turning: !pointed.is_settled,
            ..self.clone()
        }
    }
}

/// Lasting noise of a camera's bearings together with the error of its mount's angles: the larger
/// of the two determines how long it lasts.
fn with_pointing(lasting: CorrelatedNoise, pointed: &ReportedPointing) -> CorrelatedNoise {
    let time_s = if pointed.sd_rad > lasting.sd_rad { DWELL_S } else { lasting.time_s };
    CorrelatedNoise { sd_rad: lasting.sd_rad.hypot(pointed.sd_rad), time_s }
}
