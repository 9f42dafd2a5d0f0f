use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context;
use crossfix_fusion::Output;
use crossfix_message::{Channel, Key, Payload, Timestamp};
use crossfix_transport::{Delivery, Link, LinkPublisher, Received, Reception, Role, Subscription};

use crate::centre::Centre;
use crate::commands::numbers;
use crate::config::{self, FusionFile};
use crate::health::{self, HealthArgs, HealthReporter};
use crate::lookout::Lookout;
use crate::network::{self, rivalry};
use crate::output;
use crate::service;
use crate::shutdown::{LAST_WORDS, LAST_WORK, LEAVE, Shutdown};

const POLL: Duration = Duration::from_millis(20);

/// Run the fusion centre: bearings in, tracks out.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  crossfix fuse -c configs/site/fusion.toml")]
pub struct Args {
    /// The fusion centre's configuration (TOML).
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Override a key of the configuration, e.g. event_time.lateness_s=1.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Publish each state of a track once more this long after it, seconds, as the bearings since
    /// have told: on `fusion/smoothed`, beside those that go out at once.
    #[arg(long, value_name = "SECONDS", value_parser = numbers::positive, allow_negative_numbers = true)]
    lag: Option<f64>,
    #[command(flatten)]
    health: HealthArgs,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

/// The fusion centre on its network.
struct Station {
    centre: Centre,
    link: Link,
    tracks: LinkPublisher,
    smoothed: LinkPublisher,
    events: LinkPublisher,
    cues: LinkPublisher,
    health: HealthReporter,
    reception: Reception,
    lookout: Lookout,
    /// What time it was in the data at the last report.
    said_at: Timestamp,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_reload().with_stdin(args.stop_with_stdin);
    let file = FusionFile::load(Some(&args.config), &args.sets)?;
    let network = file.network.as_ref().with_context(|| {
        format!("{}: key `network` is missing: name the network file", args.config.display())
    })?;
    let network = config::load_network(network)?;
    let cameras = file.cameras.clone().unwrap_or_else(|| network.cameras.keys().cloned().collect());
    let Some(link) = network::open(&network, &Role::Fusion, &shutdown)? else {
        return Ok(());
    };
    let everybody: Vec<_> = network.cameras.keys().cloned().collect();
    let lookout = Lookout::for_cameras(&link, &network, &everybody)?;
    let mut station = Station {
        centre: Centre::new(file.fusion().smoothed(args.lag), Some(cameras))?,
        tracks: link.publisher(Channel::Tracks, Delivery::Queued)?,
        smoothed: link.publisher(Channel::Smoothed, Delivery::Queued)?,
        events: link.publisher(Channel::Events, Delivery::Queued)?,
        cues: link.publisher(Channel::Cues, Delivery::Queued)?,
        health: HealthReporter::new(&args.health, &link, Channel::FusionHealth, Delivery::Queued)?,
        reception: Reception::default(),
        lookout,
        said_at: Timestamp::EPOCH,
        link,
    };
    let kinds = ["bearings", "calibration", "health"];
    let site = station.link.site().clone();
    let mut subscription =
        station.link.subscribe(&kinds.map(|kind| Key::of_all_cameras(&site, kind)))?;
    let alive = station.link.declare_alive(Channel::FusionAlive)?;
    tracing::info!("the fusion centre of `{site}` is up, run {}", station.link.run());

    service::ready("fusing");
    station.work(&subscription, &shutdown)?;
    service::stopping();
    station.finish(&mut subscription, &shutdown)?;
    let frames = station.centre.frames();
    let Station { link, tracks, smoothed, events, cues, health, lookout, .. } = station;
    drop((alive, subscription, tracks, smoothed, events, cues, health, lookout));
    link.close(LEAVE)?;
    output::line(format!("fusion centre: {frames} track frames published"));
    Ok(())
}

impl Station {
    fn work(&mut self, subscription: &Subscription, shutdown: &Shutdown) -> anyhow::Result<()> {
        let mut healthy_at = Instant::now();
        while !shutdown.requested() {
            if let Some(received) = subscription.next(POLL) {
                self.take(&received)?;
            }
            if healthy_at.elapsed() >= health::PERIOD {
                healthy_at = Instant::now();
                service::alive();
                if shutdown.take_reload() {
                    tracing::warn!(
                        "the fusion centre reads its configuration at its start alone: restart it"
                    );
                }
                self.lookout.look(healthy_at);
                self.centre.remind(healthy_at);
                self.say_health(subscription, false)?;
            }
        }
        Ok(())
    }

    /// Handles what is on its way, for a moment, and what waits.
    fn finish(
        &mut self,
        subscription: &mut Subscription,
        shutdown: &Shutdown,
    ) -> anyhow::Result<()> {
        while !shutdown.overdue(LAST_WORDS)
            && let Some(received) = subscription.next(POLL)
        {
            self.take(&received)?;
        }
        subscription.stop();
        while !shutdown.overdue(LAST_WORK)
            && let Some(received) = subscription.next(Duration::ZERO)
        {
            self.take(&received)?;
        }
        subscription.give_up();
        let last = self.centre.flush();
        self.publish(last)?;
        self.say_health(subscription, true)
    }

    fn take(&mut self, received: &Received) -> anyhow::Result<()> {
        let Received { key, data, origin, at } = received;
        // Names come from outside: those that are not configured are not kept count of.
        let is_ours = key.channel.camera().is_some_and(|camera| self.centre.listens_to(camera));
        if let Some(origin) = origin.filter(|_| is_ours) {
            let missing = self.reception.see(key, origin, *at);
            if missing > 0 {
                self.centre.warn(&format!("missing {key}"), || {
                    format!(
                        "{missing} messages on `{key}` were lost on the way from run {}",
                        origin.run
                    )
                });
            }
        }
        let sender = origin.map_or_else(
            || " from an unknown program".to_owned(),
            |o| format!(" from run {}", o.run),
        );
        let outputs = self.centre.take(&key.channel, data, &sender);
        self.publish(outputs)
    }

    fn publish(&self, outputs: Vec<Output>) -> anyhow::Result<()> {
        for output in outputs {
            match output {
                Output::Tracks(frame) => self.tracks.put(frame.encode())?,
                Output::Smoothed(frame) => self.smoothed.put(frame.encode())?,
                Output::Event(event) => {
                    let number = crossfix_message::TrackNumber(event.track_id);
                    tracing::info!("track {number} {}", event.kind().as_str_name());
                    self.events.put(event.encode())?;
                }
                Output::Cues(cues) => self.cues.put(cues.encode())?,
                Output::Rejected(_) | Output::Camera(..) => {}
            }
        }
        Ok(())
    }

    fn say_health(&mut self, subscription: &Subscription, ended: bool) -> anyhow::Result<()> {
        let refused = subscription.refused();
        let mut health = self.centre.health(&[
            ("received_dropped", refused.dropped),
            ("received_missing", self.reception.missing()),
            ("received_too_long", refused.too_long),
        ]);
        health.ended = ended;
        health.present = self.lookout.cameras_here();
        let gone = self.lookout.cameras_gone().filter(|camera| !self.centre.has_ended(camera));
        health.problems.extend(gone.map(|camera| {
            format!("camera `{camera}` is gone: its agent has died, or the way to it is cut")
        }));
        health.is_playing = self.centre.now() > self.said_at;
        self.said_at = self.centre.now();
        for (key, runs) in self.reception.rivals(Instant::now()) {
            let rivalry = rivalry(key, runs);
            self.centre.warn(&format!("rivals {key}"), || rivalry.clone());
            health.problems.push(rivalry);
        }
        let health = self.health.completed(health);
        self.health.say(&health)
    }
}
