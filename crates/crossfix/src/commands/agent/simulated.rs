//! Cameras of a simulated scene, and the scene's truth.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::Context;
use crossfix_geometry::ScanAngles;
use crossfix_message::{Channel, Payload, Timestamp, TrueState, TruthFrame};
use crossfix_simulation::{MountState, Scene, SimulatedCamera, SimulatedMount, World};
use crossfix_transport::{Delivery, Link, LinkPublisher};
use crossfix_video::{CaptureTime, Frame, FrameSource, Pixels, VideoError};

use super::{Agent, Start};
use crate::config::{self, CameraFile};
use crate::pace::Pace;
use crate::seeker::{Mount, Pointed};
use crate::shutdown::Shutdown;

/// A simulated mount, with the time (s) and pointing of the camera's newest frame.
#[derive(Debug)]
struct TurnedMount {
    mount: SimulatedMount,
    newest: Option<(f64, MountState)>,
}

/// A simulated mount, shared by the camera and the agent.
#[derive(Clone, Debug)]
struct SharedMount(Arc<Mutex<TurnedMount>>);

impl SharedMount {
    fn new(mount: SimulatedMount) -> Self {
        Self(Arc::new(Mutex::new(TurnedMount { mount, newest: None })))
    }

    fn with<T>(&self, act: impl FnOnce(&mut TurnedMount) -> T) -> T {
        // A panic cannot leave the state half changed.
        act(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Where the mount points in an exposure around a time, s.
    fn expose(&self, t: f64, exposure_s: f64) -> ScanAngles {
        self.with(|turned| {
            let [begin, middle] = [t - exposure_s / 2.0, t].map(|t| turned.mount.at(t));
            let settled = begin.settled && middle.settled;
            turned.newest = Some((t, MountState { settled, ..middle }));
            middle.truth
        })
    }
}

impl Mount for SharedMount {
    fn aim(&mut self, angles: ScanAngles) {
        self.with(|turned| {
            let now = turned.newest.map_or(0.0, |(t, _)| t);
            turned.mount.aim(now, angles);
        });
    }

    fn pointed(&mut self) -> Pointed {
        // Each frame is processed before the next one is read.
        let newest =
            self.with(|turned| turned.newest.map(|(_, state)| (state.said, state.settled)));
        match newest {
            Some((angles, true)) => Pointed::Settled(angles),
            Some((angles, false)) => Pointed::Turning(angles),
            None => Pointed::Unknown,
        }
    }
}

/// A simulated camera as a source of frames, with times as its own clock shows them.
struct SimulatedSource {
    world: World,
    camera: SimulatedCamera,
    mount: Option<SharedMount>,
    start: Timestamp,
    next: u64,
}

impl SimulatedSource {
    /// A camera's view of a scene that begins `start` seconds after the Unix epoch.
    fn open(path: &Path, file: &CameraFile, start: f64) -> anyhow::Result<Self> {
        let scene: Scene = config::load(path, &[], config::FileKind::Scene)?;
        let world =
            scene.build().with_context(|| format!("the scene {} has an error", path.display()))?;
        let camera = world
            .camera(file.name.as_str())
            .with_context(|| format!("the scene {} has no camera `{}`", path.display(), file.name))?
            .clone();
        let mount = camera.mount().map(SharedMount::new);
        Ok(Self { world, camera, mount, start: Timestamp::from_seconds(start), next: 0 })
    }
}

impl FrameSource for SimulatedSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        if self.next >= self.camera.frames() {
            return Ok(None);
        }
        let rendered = match &self.mount {
            None => self.camera.frame(self.next),
            Some(mount) => {
                let exposure_s = self.camera.description().exposure_s;
                let angles = mount.expose(self.camera.true_time(self.next), exposure_s);
                self.camera.frame_pointing(self.next, angles)
            }
        };
        self.next += 1;
        Ok(Some(Frame {
            index: rendered.index,
            capture: CaptureTime { time: self.start.plus_seconds(rendered.own_s), sd_s: 0.0 },
            live: None,
            width: rendered.width,
            height: rendered.height,
            pixels: Pixels::Gray8(rendered.brightness),
        }))
    }
}

impl Agent {
    /// Follows targets in a scene's images, in real time, until its end.
    pub(super) fn play_scene(
        &mut self,
        file: &CameraFile,
        scene: &Path,
        publish_truth: bool,
        start: &Start,
    ) -> anyhow::Result<()> {
        let mut source = SimulatedSource::open(scene, file, start.wall_s)?;
        let mount = source.mount.clone().map(|mount| Box::new(mount) as Box<dyn Mount>);
        self.begin_to_seek(file, mount)?;
        let truth = if publish_truth {
            Some(TruthPublisher::new(&self.link, source.world.clone(), start.wall_s)?)
        } else {
            None
        };
        let shutdown = self.shutdown.clone();
        let from_s = start.joined_s;
        let truth = truth.map(|truth| std::thread::spawn(move || truth.run(from_s, &shutdown)));
        // The frames carry wall times, from the start on.
        let begins = Timestamp::from_seconds(start.wall_s);
        let seen = self.watch(file, &mut source, begins, start, 1.0);
        if let Some(thread) = truth {
            let _ = thread.join();
        }
        seen
    }
}

/// Publishes the true positions of a scene's targets ten times per second.
struct TruthPublisher {
    publisher: LinkPublisher,
    world: World,
    start: f64,
}

impl TruthPublisher {
    /// Positions per second of data, Hz: a target at 20 m/s moves by 2 m between two. Tracks are
    /// compared at these times; with half of it, at half as many.
    const RATE_HZ: f64 = 10.0;

    /// A publisher for a scene that begins `start` seconds after the Unix epoch.
    fn new(link: &Link, world: World, start: f64) -> anyhow::Result<Self> {
        Ok(Self { publisher: link.publisher(Channel::Truth, Delivery::Queued)?, world, start })
    }

    /// Publishes from `from_s` seconds after the scene's beginning until its end.
    fn run(self, from_s: f64, shutdown: &Shutdown) {
        let pace = Pace::beginning_at(self.start, 1.0);
        for step in 0..(self.world.duration_s() * Self::RATE_HZ) as u32 {
            let t = f64::from(step) / Self::RATE_HZ;
            if t < from_s {
                continue;
            }
            if !pace.wait(t, shutdown) {
                return;
            }
            let frame = truth_frame(&self.world, t, Timestamp::from_seconds(self.start));
            if let Err(error) = self.publisher.put(frame.encode()) {
                tracing::warn!("truth is not published any more: {error}");
                return;
            }
        }
    }
}

/// The truth of a scene at `t` seconds after its beginning.
pub fn truth_frame(world: &World, t: f64, begins: Timestamp) -> TruthFrame {
    let targets = world.truth(t).into_iter().map(|state| TrueState {
        id: state.id,
        position: Some(state.position.into()),
        velocity: Some(state.velocity.into()),
    });
    TruthFrame {
        time_ns: begins.plus_seconds(t).nanos(),
        targets: targets.collect(),
        ..Default::default()
    }
}
