mod data_time;
mod files;
pub mod foxglove;
mod pictures;
mod recorder;
mod syncing;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context;
use crossfix_message::{Channel, Key};
use crossfix_recording::{RecordingError, Source};
use crossfix_transport::{Delivery, Role, Subscription};

use self::files::{Limits, RecordFiles, Room};
use self::foxglove::WithFoxglove;
use self::pictures::VideoArgs;
use self::recorder::Recorder;
use self::syncing::Syncing;
use crate::commands::examples;
use crate::config;
use crate::health::{self, HealthArgs, HealthReporter};
use crate::lookout::Lookout;
use crate::network;
use crate::output;
use crate::service;
use crate::shutdown::{LAST_WORDS, LAST_WORK, LEAVE, Shutdown};

/// How long the disk may take to store the end of the last file. With half of it a power cut soon
/// after the end may cost the last second on a slow disk.
const SYNCED_WITHIN: Duration = Duration::from_millis(300);
/// Most old recordings that are removed before the first file begins: on a slow disk a hundred take
/// seconds. With half as many a disk that others have filled may have no room at the start.
const MOST_AT_START: u32 = 100;
/// How long it waits for a message before it checks whether to stop. With twice as much a stop may
/// come a tenth of a second late.
const POLL: Duration = Duration::from_millis(50);

/// Record everything that a site publishes.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix record -c configs/site/network.toml -o today.mcap",
    "crossfix record -c configs/site/network.toml -o site.mcap --rotate-min 10 --quota-gb 200",
]))]
pub struct Args {
    /// The network's file (TOML).
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// The recording (MCAP) to write. An existing file is kept: the new one is then called, for
    /// example, today-2.mcap.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Replace an existing recording.
    #[arg(long)]
    overwrite: bool,
    #[command(flatten)]
    limits: Limits,
    #[command(flatten)]
    video: VideoArgs,
    /// What to write a second time in Foxglove's schemas, so that the files open in Foxglove and
    /// Rerun without Crossfix. Pictures are the largest part of a recording.
    #[arg(long, value_enum, default_value_t)]
    foxglove: WithFoxglove,
    #[command(flatten)]
    health: HealthArgs,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_reload().with_stdin(args.stop_with_stdin);
    let network = config::load_network(&args.config)?;
    let mut files = RecordFiles::new(&args.output, args.overwrite, args.limits)?;
    // The file is created last: a recorder that cannot start must not touch it.
    let Some(link) = network::open(&network, &Role::Recorder, &shutdown)? else {
        return Ok(());
    };
    let cameras: Vec<_> = network.cameras.keys().cloned().collect();
    let lookout = Lookout::for_cameras(&link, &network, &cameras)?;
    let subscription = link.subscribe(&[Key::everything_of(link.site())])?;
    let health =
        HealthReporter::new(&args.health, &link, Channel::RecorderHealth, Delivery::Queued)?;
    let source =
        Source { run: link.run().to_string(), host: network::host(), ..Source::of("record") };
    // Makes the room that was lacking when an earlier recorder stopped.
    (0..MOST_AT_START).take_while(|_| files.make_room() < Room::Pictures).for_each(drop);
    let foxglove = args.foxglove.view(&network.site, config::anchor_of(&network)?);
    let mut recorder =
        Recorder::new(files.create(&source)?, &network, link.run(), args.video, foxglove);
    let alive = link.declare_alive(Channel::RecorderAlive)?;
    let path = files.path().display().to_string();
    tracing::info!("recording `{}` to {path}, run {}", link.site(), link.run());

    service::ready(&format!("recording to {path}"));
    let mut disk = Disk { files, source, syncing: Syncing::start()?, rescued: None };
    let mut network_parts = NetworkParts { subscription, lookout, reporter: health };
    let recorded = work(&mut recorder, &mut disk, &mut network_parts, &shutdown)
        .context("recording has stopped; the rest of the site goes on");
    drop((network_parts, alive));
    let finished = recorded.and_then(|()| Ok(recorder.finish()?));
    let Disk { files, syncing, .. } = disk;
    if let Err(error) = syncing.finish(files.path(), SYNCED_WITHIN) {
        tracing::warn!("the end of {} may not be on the disk: {error}", files.path().display());
    }
    link.close(LEAVE)?;
    let path = files.path().display();
    output::line(match finished? {
        (messages, 1) => format!("{messages} messages recorded to {path}"),
        (messages, files) => format!("{messages} messages recorded to {files} files, last {path}"),
    });
    Ok(())
}

/// What the recorder has open on the network.
struct NetworkParts {
    subscription: Subscription,
    lookout: Lookout,
    reporter: HealthReporter,
}

/// The files on the disk, and their syncing.
struct Disk {
    files: RecordFiles,
    source: Source,
    syncing: Syncing,
    /// When a failed file was last replaced by a new one.
    rescued: Option<Instant>,
}

impl Disk {
    /// The work of each second: flushes, so that what is written survives a crash of the program
    /// and, once synced, of the machine; and replaces a full file with the next.
    fn keep(&mut self, recorder: &mut Recorder) -> anyhow::Result<()> {
        recorder.heed(self.files.make_room());
        recorder.flush()?;
        if let Err(error) = self.syncing.ask(self.files.path()) {
            let error = anyhow::Error::new(error).context("what was written is not on it");
            recorder.note_trouble("sync", &error);
        }
        if self.files.is_full() {
            // One file that is too long is better than none.
            if let Err(error) = self.next(recorder) {
                recorder.note_trouble("next file", &error);
            }
        }
        Ok(())
    }

    fn next(&mut self, recorder: &mut Recorder) -> anyhow::Result<()> {
        let before = self.files.path().to_owned();
        let writer = self.files.create(&self.source)?;
        recorder.go_on(writer)?;
        self.syncing.end(before);
        Ok(())
    }

    /// Handles a file that cannot be written any more. With rotation the oldest file is removed,
    /// and recording goes on in a new one: the disk filled up between two checks.
    fn rescue(&mut self, recorder: &mut Recorder, error: anyhow::Error) -> anyhow::Result<()> {
        let lately = |at: Instant| at.elapsed() < health::PERIOD;
        let is_of_disk = error.downcast_ref().is_some_and(RecordingError::is_of_disk);
        if !is_of_disk || !self.files.rotates() || self.rescued.is_some_and(lately) {
            return Err(error);
        }
        self.rescued = Some(Instant::now());
        recorder.note_trouble("write", &error);
        let free = self.files.free();
        self.files.remove_oldest(free);
        self.next(recorder).context(error)
    }
}

/// Records until asked to stop, and then for a moment what is still on its way.
fn work(
    recorder: &mut Recorder,
    disk: &mut Disk,
    network: &mut NetworkParts,
    shutdown: &Shutdown,
) -> anyhow::Result<()> {
    let NetworkParts { subscription, lookout, reporter } = network;
    let mut said_at = Instant::now();
    while !shutdown.requested() {
        if let Some(received) = subscription.next(POLL)
            && let Err(error) = recorder.take(received)
        {
            disk.rescue(recorder, error.into())?;
        }
        if said_at.elapsed() >= health::PERIOD {
            said_at = Instant::now();
            service::alive();
            if shutdown.take_reload() {
                tracing::warn!(
                    "the recorder reads its configuration at its start alone: restart it"
                );
            }
            lookout.check(said_at);
            let kept = match recorder.health(subscription.refused(), false, reporter) {
                Ok(health) => {
                    reporter.say(&health)?;
                    disk.keep(recorder)
                }
                Err(error) => Err(error.into()),
            };
            kept.or_else(|error| disk.rescue(recorder, error))?;
        }
    }
    service::stopping();
    while !shutdown.overdue(LAST_WORDS)
        && let Some(received) = subscription.next(POLL)
    {
        recorder.take(received)?;
    }
    subscription.stop();
    while !shutdown.overdue(LAST_WORK)
        && let Some(received) = subscription.next(Duration::ZERO)
    {
        recorder.take(received)?;
    }
    subscription.give_up();
    let health = recorder.health(subscription.refused(), true, reporter)?;
    reporter.say(&health)
}
