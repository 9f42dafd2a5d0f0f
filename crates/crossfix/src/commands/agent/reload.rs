//! A live camera's file, read again while its agent runs (SIGHUP, `systemctl reload`).

use crossfix_message::{ClockSource, Payload, Timestamp};
use crossfix_vision::ImageTracker;

use super::Agent;
use super::live::StreamFollower;
use crate::config::CameraFile;
use crate::pace::wall_seconds;

/// A file that was read again, and the keys whose changes need a restart.
struct Again {
    file: CameraFile,
    /// Names of the keys that need a restart.
    waits: Vec<&'static str>,
}

impl Again {
    /// The new file, with the keys that need a restart kept as in the old one.
    fn of(new: CameraFile, old: &CameraFile) -> anyhow::Result<Self> {
        let mut waits = Vec::new();
        // A source opened with the clock `arrival` was given the SD of its arrival times when it
        // was opened.
        let by_arrival = old.clock_source() == ClockSource::Arrival;
        // Sources hold passwords, so they are compared as text and never shown.
        let is_other_source = toml::to_string(&new.source)? != toml::to_string(&old.source)?;
        for (key, is_other) in [
            ("name", new.name != old.name),
            ("network", new.network != old.network),
            ("source", is_other_source),
            ("clock.source", new.clock.source != old.clock.source),
            ("clock.sd_s", by_arrival && new.clock.sd_s != old.clock.sd_s),
            ("boxes", new.boxes != old.boxes),
            ("mount", new.mount != old.mount),
            ("takes_cues", new.takes_cues != old.takes_cues),
        ] {
            if is_other {
                waits.push(key);
            }
        }
        let mut file = new;
        file.name.clone_from(&old.name);
        file.network.clone_from(&old.network);
        file.source.clone_from(&old.source);
        file.clock.source = old.clock.source;
        if by_arrival {
            file.clock.sd_s = old.clock.sd_s;
        }
        file.boxes.clone_from(&old.boxes);
        file.mount.clone_from(&old.mount);
        file.takes_cues = old.takes_cues;
        Ok(Self { file, waits })
    }
}

impl Agent {
    /// Reads the camera's file again: pose, lens, clock, preview and the tracker's parameters take
    /// effect at once. A file with an error changes nothing.
    pub(super) fn reload(&mut self, watch: &mut StreamFollower) -> anyhow::Result<()> {
        let name = self.identity.name.clone();
        match self.read_again(watch) {
            Ok(waits) if waits.is_empty() => {
                tracing::info!(
                    "camera `{name}`: {} is read again, but not its password",
                    self.config.display()
                );
            }
            Ok(waits) => tracing::warn!(
                "camera `{name}`: {} is read again; what it says of {} holds once the agent is \
                 started again",
                self.config.display(),
                waits.join(", ")
            ),
            Err(error) => {
                tracing::warn!("camera `{name}` goes on as it was: {error:#}");
            }
        }
        // The calibration is published again before anything else.
        self.calibrated_at = None;
        self.keep_up()
    }

    /// Applies the changes that can take effect at once; returns the keys that cannot.
    fn read_again(&mut self, watch: &mut StreamFollower) -> anyhow::Result<Vec<&'static str>> {
        let Again { file, waits } =
            Again::of(CameraFile::load(&self.config, &self.sets)?, &watch.file)?;
        let camera = file.camera(&self.config)?;
        let size = self.identity.camera.model().intrinsics().size;
        let new_size = camera.model().intrinsics().size;
        anyhow::ensure!(
            new_size == size,
            "the lens is for {}x{} now and the camera sends {}x{}: restart the agent",
            new_size.width,
            new_size.height,
            size.width,
            size.height
        );
        let calibrated = file.calibrated()?;
        // This host's clock may show anything; the new calibration must begin after the last image.
        let wall = Timestamp::from_seconds(wall_seconds());
        let now = if self.frames > 0 { self.now } else { wall };
        let message = match &calibrated {
            // Published times are already common times.
            Some(calibrated) if self.frames > 0 => calibrated.message(now),
            Some(calibrated) => calibrated.message(calibrated.common(now)),
            None => file.calibration(&camera, now)?,
        };
        let message = file.with_mount(message, camera.pose())?;
        if file.tracker != watch.file.tracker {
            watch.tracker = ImageTracker::new(file.tracker.clone())?;
            tracing::info!("targets are searched for again, by other parameters");
        }
        self.calibration = message.encode();
        self.calibrated = calibrated;
        self.identity.camera = camera;
        watch.file = file;
        Ok(waits)
    }
}
