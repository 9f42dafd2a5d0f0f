//! Where a camera on a mount points.

use crossfix_geometry::ScanAngles;
use crossfix_message::Pointing;

use super::KnownCamera;
use crate::uncertainty::LastingNoise;

/// What a mount says of where it points stays as wrong as it is until it turns, s: longer than it
/// looks in one direction. With a tenth of it a camera that stares at a target for a minute would be
/// taken to have told its direction many times over.
const DWELL_S: f64 = 100.0;
/// A mount that says it points so many deviations from where it pointed before has turned.
const TURNED_SDS: f64 = 4.0;
/// Angles that differ by less than this are one, rad: what is left of a number on its way.
const SAME_RAD: f64 = 1e-9;
/// A mount that knows where it points no better than this says nothing, rad.
const WORST_SD_RAD: f64 = 1.0;

/// Where a camera on a mount pointed in an exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pointed {
    angles: ScanAngles,
    /// Standard deviation of the direction along the axis that is known worse, rad.
    sd_rad: f64,
    /// Whether it stood still.
    pub(crate) is_settled: bool,
}

impl Pointed {
    /// As a frame says it; `None` if that is impossible.
    pub(crate) fn read(message: &Pointing) -> Option<Self> {
        let angles = message.angles()?;
        let sd_rad = (message.azimuth_sd * angles.elevation.cos()).max(message.elevation_sd);
        let possible = |sd: f64| (0.0..WORST_SD_RAD).contains(&sd);
        let both = possible(message.azimuth_sd) && possible(message.elevation_sd);
        both.then_some(Self { angles, sd_rad, is_settled: message.settled })
    }

    /// Whether it has turned since it pointed there.
    pub(crate) fn has_turned_from(&self, before: &Self) -> bool {
        let by = (self.angles.azimuth - before.angles.azimuth)
            .hypot(self.angles.elevation - before.angles.elevation);
        !before.is_settled || by > TURNED_SDS * self.sd_rad + SAME_RAD
    }
}

impl KnownCamera {
    /// The camera as it points; as it is, if nothing turns it.
    pub(crate) fn pointed(&self, pointed: &Pointed) -> Self {
        let Some(mount) = &self.mount else { return self.clone() };
        Self {
            camera: self.camera.posed(mount.pose(pointed.angles)),
            lasting: with_pointing(self.lasting, pointed),
            is_turning: !pointed.is_settled,
            ..self.clone()
        }
    }
}

/// What lasts of a camera's noise, with what its mount's angles are off by: the larger of the two
/// says for how long.
fn with_pointing(lasting: LastingNoise, pointed: &Pointed) -> LastingNoise {
    let time_s = if pointed.sd_rad > lasting.sd_rad { DWELL_S } else { lasting.time_s };
    LastingNoise { sd_rad: lasting.sd_rad.hypot(pointed.sd_rad), time_s }
}
