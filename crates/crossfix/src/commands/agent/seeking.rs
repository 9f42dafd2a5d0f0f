//! An agent whose camera searches for the targets that the fusion centre's cues name.

use std::time::{Duration, Instant};

use anyhow::ensure;
use crossfix_correlation::Plane;
use crossfix_geometry::ScanAngles;
use crossfix_message::{BearingFrame, CueFrame, Key, Pointing, Timestamp, decode};
use crossfix_transport::Subscription;
use crossfix_video::CaptureTime;
use crossfix_vision::ImageTracker;

use super::Agent;
use crate::config::CameraFile;
#[cfg(feature = "onvif")]
use crate::onvif::OnvifMount;
#[cfg(not(feature = "onvif"))]
use crate::parts;
use crate::seeker::{Mount, Orders, Pointed, Seeker};

/// A mount that turns for longer than this is reported as a problem: no turn between two views
/// takes so long. With half of it a mount of 10 degrees per second that turns to the opposite side
/// would be reported.
const LONGEST_TURN: Duration = Duration::from_secs(30);
/// A view is unchanged while the mount's reported angles stay within this many SDs. With half of it
/// noise in its reports would look like a turn, and the tracker would start again.
const SAME_SDS: f64 = 3.0;

/// Connects the seeker of a camera with its cues and its mount.
pub(super) struct Seeking {
    seeker: Seeker,
    cues: Subscription,
    mount: Option<Box<dyn Mount>>,
    angle_sd_rad: f64,
    /// Since when the mount has been turning.
    restless: Option<Instant>,
    /// Where the camera pointed in the newest image, ...
    pointed: Pointed,
    /// ... and in the images that the tracker has, all of one view; `None` if it has none.
    view: Option<ScanAngles>,
    /// The track that was last reported as taken over, so that it is logged only once.
    said: Option<u64>,
}

impl Seeking {
    /// Asks the mount where it pointed in the newest image; returns whether that is another view
    /// than the tracker's.
    fn point(&mut self) -> bool {
        self.pointed = self.mount.as_mut().map_or(Pointed::Fixed, |mount| mount.pointed());
        let turns = matches!(self.pointed, Pointed::Turning(_));
        self.restless = turns.then(|| self.restless.unwrap_or_else(Instant::now));
        let before = self.view;
        self.view = match self.pointed {
            Pointed::Fixed => return false,
            Pointed::Unknown | Pointed::Turning(_) => None,
            Pointed::Settled(angles) => {
                Some(before.filter(|at| self.is_same(*at, angles)).unwrap_or(angles))
            }
        };
        before.is_some() && self.view != before
    }

    /// Whether two angles are equal within the mount's accuracy.
    fn is_same(&self, one: ScanAngles, other: ScanAngles) -> bool {
        let within = SAME_SDS * self.angle_sd_rad;
        (one.azimuth - other.azimuth).abs() <= within
            && (one.elevation - other.elevation).abs() <= within
    }

    /// The mount's pointing for the message; `None` if there is nothing to report.
    fn pointing(&self) -> Option<Pointing> {
        let (ScanAngles { azimuth, elevation }, settled) = match self.pointed {
            Pointed::Fixed | Pointed::Unknown => return None,
            Pointed::Turning(angles) => (angles, false),
            Pointed::Settled(angles) => (angles, true),
        };
        let (azimuth_sd, elevation_sd) = (self.angle_sd_rad, self.angle_sd_rad);
        Some(Pointing { azimuth, elevation, azimuth_sd, elevation_sd, settled })
    }

    /// Takes in new cues and applies them to a frame: marks in it the track that is taken over, and
    /// orders the mount where to turn.
    fn seek(&mut self, frame: &mut BearingFrame) {
        while let Some(received) = self.cues.next(Duration::ZERO) {
            // A malformed message has no effect.
            let Ok(cues) = decode::<CueFrame>(&received.data) else { continue };
            if cues.camera == frame.camera {
                self.seeker.take_cues(cues);
            }
        }
        self.seeker.hold(self.mount.as_ref().is_some_and(|mount| !mount.obeys()));
        let time = Timestamp::from_nanos(frame.capture_time_ns);
        let Orders { aim, taken_over } = self.seeker.observe(time, self.pointed, &frame.tracks);
        if let (Some(mount), Some(aim)) = (&mut self.mount, aim) {
            mount.aim(aim);
        }
        if let Some(taken) = &taken_over
            && self.said != Some(taken.image_track_id)
        {
            self.said = Some(taken.image_track_id);
            let of = taken.of.as_ref().map_or(0, |of| of.track_id);
            let number = crossfix_message::TrackNumber(of);
            tracing::info!("its track {} is taken for track {number}", taken.image_track_id);
        }
        frame.taken_over.extend(taken_over);
    }
}

/// A live camera's mount, if the camera's file says how to command it.
#[cfg(feature = "onvif")]
pub(super) fn mount_of(file: &CameraFile) -> anyhow::Result<Option<Box<dyn Mount>>> {
    let Some(mount) = &file.mount else { return Ok(None) };
    let Some(onvif) = &mount.onvif else { return Ok(None) };
    let head = OnvifMount::start(onvif, mount.angle_sd_mrad * 1e-3)?;
    Ok(Some(Box::new(head)))
}

/// A live camera's mount: an error if the file needs ONVIF, which this build leaves out.
#[cfg(not(feature = "onvif"))]
pub(super) fn mount_of(file: &CameraFile) -> anyhow::Result<Option<Box<dyn Mount>>> {
    let has_onvif = file.mount.as_ref().is_some_and(|mount| mount.onvif.is_some());
    if has_onvif { Err(parts::is_left_out("mounts by ONVIF", "onvif")) } else { Ok(None) }
}

impl Agent {
    /// Starts listening to cues, if the camera's file asks for it. `mount` is given if it can be
    /// commanded.
    pub(super) fn begin_to_seek(
        &mut self,
        file: &CameraFile,
        mount: Option<Box<dyn Mount>>,
    ) -> anyhow::Result<()> {
        if !file.looks_for_cues() {
            return Ok(());
        }
        ensure!(
            file.mount.is_none() || mount.is_some(),
            "section [mount]: nothing turns this source's camera; [mount.onvif] turns network \
             cameras"
        );
        let camera = &self.identity.camera;
        let angle_sd_rad = file.mount.as_ref().map_or(0.0, |mount| mount.angle_sd_mrad * 1e-3);
        // Cues may come from any of the fusion centres that listen to this camera.
        let cues = Key::of_all_centres(self.link.site(), "cues");
        self.seeking = Some(Seeking {
            seeker: Seeker::new(camera.model(), file.pan_tilt(camera.pose())?, angle_sd_rad),
            cues: self.link.subscribe(&[cues])?,
            mount: mount.filter(|_| file.mount.is_some()),
            angle_sd_rad,
            restless: None,
            pointed: Pointed::Fixed,
            view: None,
            said: None,
        });
        Ok(())
    }

    /// Follows targets into the image with a sequence number; `time` is the tracker's. While a
    /// mount turns the camera nothing is followed, as then everything in the image moves.
    pub(super) fn see(
        &mut self,
        tracker: &mut ImageTracker,
        image: &Plane,
        index: u64,
        time: Timestamp,
        capture: CaptureTime,
    ) -> BearingFrame {
        if self.seeking.as_mut().is_some_and(Seeking::point) {
            tracker.look_elsewhere();
        }
        let pointed = self.seeking.as_ref().map_or(Pointed::Fixed, |seeking| seeking.pointed);
        let is_settled = matches!(pointed, Pointed::Fixed | Pointed::Settled(_));
        self.without_pointing += u64::from(pointed == Pointed::Unknown);
        let tracks = if is_settled { tracker.step(image, time) } else { &[] };
        let (frame, unseen) = self.identity.bearing_frame(index, capture, tracks);
        self.unseen_bearings += unseen;
        let pointing = self.seeking.as_ref().and_then(Seeking::pointing);
        BearingFrame { pointing, ..frame }
    }

    /// The mount's current problem, if any.
    pub(super) fn trouble_of_mount(&self) -> Option<String> {
        let seeking = self.seeking.as_ref()?;
        let what = match seeking.pointed {
            Pointed::Unknown => "does not say where it points",
            _ if seeking.restless.is_some_and(|since| since.elapsed() > LONGEST_TURN) => {
                "never stands still, or says angles that are noisier than `mount.angle_sd_mrad`"
            }
            _ => return None,
        };
        Some(format!("its mount {what}: its images are of no use"))
    }

    /// Applies the fusion centre's cues to a frame.
    pub(super) fn seek(&mut self, frame: &mut BearingFrame) {
        if let Some(seeking) = &mut self.seeking {
            seeking.seek(frame);
        }
    }
}
