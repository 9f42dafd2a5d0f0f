//! A recording read with another calibration, which replaces its times, lenses and poses.

use std::cell::Cell;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::path::Path;

use crossfix_calibration::SiteCalibration;
use crossfix_message::{
    BearingFrame, CameraCalibration, Channel, Payload, Preview, Timestamp, decode,
};
use crossfix_recording::Entry;

use crate::calibrated::{self, middle_time, recalibrate};

/// A calibration file that replaces what was recorded.
#[derive(Clone, Debug)]
pub struct Recalibration {
    site: SiteCalibration,
    /// Number of bearings for which the calibration has no direction.
    left_out: Cell<u64>,
}

impl Recalibration {
    /// Reads the file.
    pub fn load(path: &Path) -> anyhow::Result<Self> {
        calibrated::load(path).map(Self::of)
    }

    /// From a calibration that is in no file yet.
    pub fn of(site: SiteCalibration) -> Self {
        Self { site, left_out: Cell::new(0) }
    }

    /// The entry as it would have been recorded with this calibration. Entries that cannot be read
    /// or that belong to no camera of the file stay as they are.
    pub fn applied(&self, entry: Entry) -> Entry {
        self.changed(&entry).unwrap_or(entry)
    }

    fn changed(&self, entry: &Entry) -> Option<Entry> {
        let (data_time, data) = match &entry.key.channel {
            Channel::Calibration(name) => {
                let camera = self.site.camera(name)?;
                let message = self.site.message(camera, Timestamp::EPOCH);
                // The file knows no mounts: its pose is that at rest. A recorded calibration that
                // cannot be read may have had a mount, so it stays as it is.
                let recorded = decode::<CameraCalibration>(&entry.data).ok()?;
                let mount = recorded.parse().ok().map(|known| known.mount);
                let message = match mount.or(recorded.mount.is_none().then_some(None))? {
                    Some(mount) => message.on_mount(&mount.resting_at(*camera.camera.pose())),
                    None if recorded.takes_cues => message.taking_cues(),
                    None => message,
                };
                (Timestamp::EPOCH, message.encode())
            }
            Channel::Bearings(name) => {
                let mut frame: BearingFrame = decode(&entry.data).ok()?;
                let left_out = recalibrate(&mut frame, self.site.camera(name)?);
                self.left_out.set(self.left_out.get() + left_out);
                (Timestamp::from_nanos(frame.capture_time_ns), frame.encode_unstamped())
            }
            Channel::Preview(name) => {
                let mut preview: Preview = decode(&entry.data).ok()?;
                let camera = self.site.camera(name)?;
                let time = middle_time(camera, preview.capture_time_ns).0;
                preview.capture_time_ns = time.nanos();
                (time, preview.encode_unstamped())
            }
            _ => return None,
        };
        // The delay from capture to arrival stays as recorded.
        let arrival = entry.arrival.plus_seconds(data_time.seconds_since(entry.data_time));
        Some(Entry { key: entry.key.clone(), data_time, arrival, data })
    }

    /// Logs how many bearings were left out.
    fn say(&self) {
        if self.left_out.get() > 0 {
            tracing::warn!(
                "{} bearings are left out: nobody knows the lens where they are in the image \
                 (calibrate with a flight through all of it)",
                self.left_out.get()
            );
        }
    }

    /// Most by which the cameras' times can move apart, s.
    fn spread_s(&self) -> f64 {
        let knots = self.site.cameras().iter().flat_map(|camera| &camera.clock.knots_s);
        let all: Vec<f64> = knots.map(|knot| knot[1]).chain([0.0]).collect();
        let least = all.iter().copied().fold(f64::INFINITY, f64::min);
        let most = all.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        // Clocks go on at their rate after the last knot.
        most - least + SPARE_S
    }
}

/// Allowance for the drift of a clock after its last knot, s. At a rate of 1e-4 that is the drift
/// of fourteen hours. With half of it entries may be out of order after seven.
const SPARE_S: f64 = 5.0;

/// Entries in the order of their new times: each waits until no older one can come.
#[derive(Debug)]
pub struct Reordered {
    recalibration: Recalibration,
    waiting: BinaryHeap<Reverse<(Timestamp, u64)>>,
    entries: BTreeMap<u64, Entry>,
    next: u64,
    spread_s: f64,
}

impl Reordered {
    /// Starts with no entry waiting.
    pub fn new(recalibration: Recalibration) -> Self {
        // Entries that were read to find a range must not be counted twice.
        recalibration.left_out.set(0);
        let spread_s = recalibration.spread_s();
        Self {
            recalibration,
            waiting: BinaryHeap::new(),
            entries: BTreeMap::new(),
            next: 0,
            spread_s,
        }
    }

    /// Takes the recording's next entry; returns those for which the wait is over.
    pub fn take(&mut self, entry: Entry) -> impl Iterator<Item = Entry> {
        let own = entry.data_time;
        let entry = self.recalibration.applied(entry);
        self.waiting.push(Reverse((entry.data_time, self.next)));
        self.entries.insert(self.next, entry);
        self.next += 1;
        self.release(own.plus_seconds(-self.spread_s))
    }

    /// All entries that still wait.
    pub fn finish(&mut self) -> impl Iterator<Item = Entry> {
        self.recalibration.say();
        self.release(Timestamp::MAX)
    }

    /// The waiting entries up to a time, in order; each is removed when it is asked for.
    fn release(&mut self, until: Timestamp) -> impl Iterator<Item = Entry> {
        std::iter::from_fn(move || {
            let &Reverse((time, number)) = self.waiting.peek()?;
            if time > until {
                return None;
            }
            self.waiting.pop();
            self.entries.remove(&number)
        })
    }
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::{PanTilt, Pose, ScanAngles};
    use crossfix_message::{CameraName, Key, Pointing};
    use nalgebra::{Point3, Vector3};

    use super::*;
    use crate::calibrated::tests::SITE;

    /// Cues and the mount's range come from the recorded message, not from the calibration.
    #[test]
    fn a_camera_on_a_mount_stays_on_it_and_its_rest_is_the_new_pose() {
        let site = SiteCalibration::from_toml(SITE).unwrap();
        let new = site.cameras()[0].camera.clone();
        let recalibration = Recalibration::of(site);
        let name: CameraName = "north".parse().unwrap();
        let of = |message: CameraCalibration| {
            let channel = Channel::Calibration(name.clone());
            let key = Key::new("site".parse().unwrap(), channel);
            let entry = Entry {
                key,
                data_time: Timestamp::EPOCH,
                arrival: Timestamp::EPOCH,
                data: message.encode(),
            };
            decode::<CameraCalibration>(&recalibration.applied(entry).data).unwrap()
        };
        let old = Pose::looking_at(Point3::origin(), Point3::new(0.0, 1.0, 0.0)).unwrap();
        let recorded = CameraCalibration::new(&name, &new.posed(old), Timestamp::EPOCH);
        let mount = PanTilt::new(old, [-1.0, 1.5], [-0.2, 1.2]).unwrap();

        let turned = of(recorded.clone().on_mount(&mount)).parse().unwrap();
        assert_eq!(turned.mount.unwrap().azimuth(), [-1.0, 1.5]);
        let pointing = Pointing { azimuth: 0.5, elevation: 0.1, ..Default::default() };
        let axis = turned.pointed(Some(&pointing)).unwrap().pose().rotation() * Vector3::z();
        let angles = ScanAngles { azimuth: 0.5, elevation: 0.1 };
        let expected = mount.resting_at(*new.pose()).pose(angles).rotation() * Vector3::z();
        assert!((axis - expected).norm() < 1e-12, "{axis}");

        let standing = of(recorded.clone().taking_cues());
        assert!(standing.takes_cues && standing.mount.is_none());
        assert!(!of(recorded).takes_cues);
    }
}
