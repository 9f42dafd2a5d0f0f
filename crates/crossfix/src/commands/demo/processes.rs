//! The processes of a demo: components of a site, as a person would start them.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};

use super::{Args, CameraStreams, DemoFiles, Ending, PATIENCE, text};

/// A process of the demo; it is stopped when this value is dropped.
struct Component {
    name: String,
    child: Child,
}

impl Component {
    /// Starts this program with a subcommand; its logs go to a file.
    fn start(name: &str, folder: &Path, arguments: &[&str]) -> anyhow::Result<Self> {
        let program = std::env::current_exe().context("cannot find this program's own file")?;
        let log = folder.join("logs").join(format!("{name}.log"));
        let log = std::fs::File::create(&log)
            .with_context(|| format!("cannot write {}", log.display()))?;
        let child = Command::new(program)
            .args(arguments)
            .arg("--stop-with-stdin")
            .stdin(Stdio::piped())
            .stdout(log.try_clone()?)
            .stderr(log)
            .spawn()
            .with_context(|| format!("cannot start `{name}`"))?;
        Ok(Self { name: name.to_owned(), child })
    }

    /// Whether the process still runs; an error if it failed.
    fn runs(&mut self, folder: &Path) -> anyhow::Result<bool> {
        match self.child.try_wait()? {
            None => Ok(true),
            Some(status) if status.success() => Ok(false),
            Some(status) => {
                let log = folder.join("logs").join(format!("{}.log", self.name));
                let text = std::fs::read_to_string(&log).unwrap_or_default();
                let last = text.lines().rev().take(3).collect::<Vec<_>>().into_iter().rev();
                bail!("`{}` failed ({status}):\n{}", self.name, last.collect::<Vec<_>>().join("\n"))
            }
        }
    }

    /// Asks the process to stop by closing its stdin.
    fn ask_to_stop(&mut self) {
        drop(self.child.stdin.take());
    }

    /// Asks the process to stop, and waits for it.
    fn stop(mut self) -> anyhow::Result<()> {
        self.ask_to_stop();
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if let Some(status) = self.child.try_wait()? {
                ensure!(status.success(), "`{}` ended with {status}; see its log", self.name);
                return Ok(());
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        bail!("`{}` does not stop", self.name)
    }
}

impl Drop for Component {
    fn drop(&mut self) {
        // After `stop` there is no process left to end; on an error this is the last resort.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What receives the cameras' messages.
pub(super) struct CentreProcesses {
    recorder: Component,
    fusion: Component,
    viewer: Option<Component>,
}

impl CentreProcesses {
    pub(super) fn start(args: &Args, files: &DemoFiles) -> anyhow::Result<Self> {
        let start =
            |name: &str, arguments: &[&str]| Component::start(name, &files.folder, arguments);
        let (network, recording) = (text(&files.network), text(&files.recording));
        let record = ["record", "-c", &network, "-o", &recording, "--overwrite"];
        let view = ["view", "-c", &network];
        Ok(Self {
            recorder: start("recorder", &record)?,
            fusion: start("fusion", &["fuse", "-c", &text(&files.fusion)])?,
            viewer: args.view.then(|| start("viewer", &view)).transpose()?,
        })
    }
}

/// The processes that stand for the cameras.
pub(super) struct CameraProcesses {
    /// They end with the scene: its agents, or the cameras whose streams agents watch.
    players: Vec<Component>,
    /// Agents that watch a stream: they go on after it has ended.
    watchers: Vec<Component>,
}

impl CameraProcesses {
    pub(super) fn start(files: &DemoFiles, begins_at: f64) -> anyhow::Result<Self> {
        let begin = format!("{begins_at:.6}");
        let mut agents = Vec::new();
        for (name, file) in &files.cameras {
            let arguments =
                ["agent", "-c", &text(file), "--wait-for-recorder", "--start-at", &begin];
            agents.push(Component::start(name.as_str(), &files.folder, &arguments)?);
        }
        let Some(CameraStreams { address, scene, truth }) = &files.streams else {
            return Ok(Self { players: agents, watchers: Vec::new() });
        };
        let (scene, address, truth) = (text(scene), address.to_string(), text(truth));
        let arguments =
            ["simulate", &scene, "--rtsp", &address, "--start-at", &begin, "-o", &truth];
        let streams = Component::start("cameras", &files.folder, &arguments)?;
        Ok(Self { players: vec![streams], watchers: agents })
    }

    /// Whether the scene goes on; an error if a process has failed.
    pub(super) fn go_on(&mut self, folder: &Path) -> anyhow::Result<bool> {
        for watcher in &mut self.watchers {
            watcher.runs(folder)?;
        }
        let mut running = Vec::new();
        for mut player in std::mem::take(&mut self.players) {
            if player.runs(folder)? {
                running.push(player);
            }
        }
        self.players = running;
        Ok(!self.players.is_empty())
    }
}

/// Stops all components, those that send first.
pub(super) fn stop_all(
    centre: CentreProcesses,
    cameras: CameraProcesses,
    ending: Ending,
) -> anyhow::Result<()> {
    let CentreProcesses { mut recorder, mut fusion, viewer } = centre;
    let CameraProcesses { mut players, mut watchers } = cameras;
    if ending == Ending::Interrupted {
        // All are asked at once, as one that is asked to stop waits for no other.
        players.iter_mut().chain([&mut fusion, &mut recorder]).for_each(Component::ask_to_stop);
    }
    watchers.iter_mut().for_each(Component::ask_to_stop);
    for component in players.into_iter().chain(watchers) {
        component.stop()?;
    }
    fusion.stop()?;
    recorder.stop()?;
    if let Some(viewer) = viewer
        && let Err(error) = viewer.stop()
    {
        tracing::warn!("no live view: {error}");
    }
    Ok(())
}
