mod data_time;
mod recorder;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context;
use crossfix_message::{Channel, Key};
use crossfix_recording::{RecordingError, RecordingWriter, Source};
use crossfix_transport::{Delivery, Role, Subscription};

use self::recorder::{FileWriter, Recorder};
use crate::config;
use crate::health::{self, HealthArgs, HealthReporter};
use crate::lookout::Lookout;
use crate::network;
use crate::output;
use crate::service;
use crate::shutdown::{LAST_WORDS, LAST_WORK, LEAVE, Shutdown};

const POLL: Duration = Duration::from_millis(50);

/// Record everything that a site publishes.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  crossfix record -c configs/site/network.toml -o today.mcap")]
pub struct Args {
    /// The network's file (TOML).
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// The recording (MCAP) to write. If it is there already it stays, and a new one is written
    /// beside it: today-2.mcap.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Replace a recording that is there already.
    #[arg(long)]
    overwrite: bool,
    #[command(flatten)]
    health: HealthArgs,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_reload().with_stdin(args.stop_with_stdin);
    let network = config::load_network(&args.config)?;
    // The file comes last: what cannot record must not touch it.
    let Some(link) = network::open(&network, &Role::Observer, &shutdown)? else {
        return Ok(());
    };
    let cameras: Vec<_> = network.cameras.keys().cloned().collect();
    let mut lookout = Lookout::for_cameras(&link, &network, &cameras)?;
    let mut subscription = link.subscribe(&[Key::everything_of(link.site())])?;
    let mut health =
        HealthReporter::new(&args.health, &link, Channel::RecorderHealth, Delivery::Queued)?;
    let (mut writer, path) = create(&args.output, args.overwrite)?;
    writer.sign(&Source {
        run: link.run().to_string(),
        host: network::host(),
        ..Source::of("record")
    })?;
    let mut recorder = Recorder::new(writer, &network, link.run());
    let alive = link.declare_alive(Channel::RecorderAlive)?;
    tracing::info!("recording `{}` to {}, run {}", link.site(), path.display(), link.run());

    service::ready(&format!("recording to {}", path.display()));
    let recorded = work(&mut recorder, &mut subscription, &mut lookout, &mut health, &shutdown)
        .context("recording has stopped; the rest of the site goes on");
    drop((subscription, alive, health, lookout));
    let finished = recorded.and_then(|()| Ok(recorder.finish()?));
    link.close(LEAVE)?;
    output::line(format!("{} messages recorded to {}", finished?, path.display()));
    Ok(())
}

/// A new file under the name that was asked for, or under the first of `today-2.mcap`,
/// `today-3.mcap` .. that is free: a recorder that is started again must not destroy what it
/// recorded before.
fn create(asked: &Path, overwrite: bool) -> anyhow::Result<(FileWriter, PathBuf)> {
    // A device or a pipe has nothing that could be lost.
    if overwrite || (asked.exists() && !asked.is_file()) {
        return Ok((RecordingWriter::create(asked)?, asked.to_owned()));
    }
    for path in output::names(asked) {
        match RecordingWriter::create_new(&path) {
            Err(RecordingError::Exists { .. }) => {}
            Err(error) => return Err(error.into()),
            Ok(writer) => {
                output::say_other_name(asked, &path);
                return Ok((writer, path));
            }
        }
    }
    anyhow::bail!("{} is there, and so is every other name of it that was tried", asked.display())
}

/// Records until it is asked to stop, and for a moment what is still on its way.
fn work(
    recorder: &mut Recorder,
    subscription: &mut Subscription,
    lookout: &mut Lookout,
    reporter: &mut HealthReporter,
    shutdown: &Shutdown,
) -> anyhow::Result<()> {
    let mut said_at = Instant::now();
    while !shutdown.requested() {
        if let Some(received) = subscription.next(POLL) {
            recorder.take(received)?;
        }
        if said_at.elapsed() >= health::PERIOD {
            said_at = Instant::now();
            service::alive();
            if shutdown.take_reload() {
                tracing::warn!(
                    "the recorder reads its configuration at its start alone: restart it"
                );
            }
            lookout.look(said_at);
            let health = recorder.health(subscription.refused(), false, reporter)?;
            reporter.say(&health)?;
            // What was flushed survives a crash of the machine's programs.
            recorder.flush()?;
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
