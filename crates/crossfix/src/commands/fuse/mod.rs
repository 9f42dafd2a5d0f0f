mod border;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context;
use crossfix_fusion::Output;
use crossfix_message::{CameraName, Channel, Key, Payload, SiteName, Timestamp};
use crossfix_transport::{
    Delivery, Identity, Link, LinkPublisher, Received, Reception, Role, Subscription,
};

use self::border::AreaBorder;
use crate::centre::Centre;
use crate::commands::examples;
use crate::commands::numbers;
use crate::config::{self, FusionFile};
use crate::health::{self, HealthArgs, HealthReporter};
use crate::lookout::Lookout;
use crate::network::{self, rivalry};
use crate::output;
use crate::service;
use crate::shutdown::{LAST_WORDS, LAST_WORK, LEAVE, Shutdown};

/// How long it waits for a message before it checks whether to stop. With twice as much a stop may
/// come 40 ms late.
const POLL: Duration = Duration::from_millis(20);

/// Run the fusion centre: bearings in, tracks out.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix fuse -c configs/site/fusion.toml",
]))]
pub struct Args {
    /// The fusion centre's configuration (TOML).
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Override a key of the configuration, e.g. event_time.lateness_s=1.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Publish each state of a track once more this long after it, seconds, as the bearings since
    /// have told: on `fusion/smoothed`, beside those that go out at once.
    #[arg(long, value_name = "SECONDS", value_parser = numbers::lag)]
    lag: Option<f64>,
    #[command(flatten)]
    health: HealthArgs,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

/// A running fusion centre with its network connections.
struct Station {
    centre: Centre,
    /// The exchange with neighbouring areas, if there are any.
    border: Option<AreaBorder>,
    link: Link,
    tracks: LinkPublisher,
    smoothed: LinkPublisher,
    events: LinkPublisher,
    cues: LinkPublisher,
    health: HealthReporter,
    reception: Reception,
    lookout: Lookout,
    /// Data time at the last report.
    said_at: Timestamp,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_reload().with_stdin(args.stop_with_stdin);
    let file = FusionFile::load(Some(&args.config), &args.sets)?;
    let network = file.network.as_ref().with_context(|| {
        format!("{}: key `network` is missing: name the network file", args.config.display())
    })?;
    let network = config::load_network(network)?;
    let everybody = network
        .cameras_of(file.area.as_ref())
        .with_context(|| format!("key `area` of {}", args.config.display()))?;
    let cameras = file.cameras.clone().unwrap_or_else(|| everybody.clone());
    let Some(link) = network::open(&network, &Role::Fusion(file.area.clone()), &shutdown)? else {
        return Ok(());
    };
    let lookout = Lookout::for_cameras(&link, &network, &everybody)?;
    let config = file.fusion().smoothed(args.lag);
    let border = file.area.as_ref().map(|area| AreaBorder::new(&network, area, &config));
    let mut station = Station {
        centre: Centre::new(config, Some(cameras))?,
        border,
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
    let site = station.link.site().clone();
    let mut subscription = station.link.subscribe(&station.heard(&everybody))?;
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

/// The keys of what is published of a camera that the fusion needs.
fn of_camera(site: &SiteName, camera: &CameraName) -> [String; 3] {
    [Channel::Bearings, Channel::Calibration, Channel::CameraHealth]
        .map(|channel| Key::new(site.clone(), channel(camera.clone())).to_string())
}

impl Station {
    /// The key expressions that it subscribes to. In an area, only those of its own cameras and of
    /// the neighbouring areas: data that nobody there subscribes to are not sent there.
    fn heard(&self, cameras: &[CameraName]) -> Vec<String> {
        let site = self.link.site();
        match &self.border {
            None => ["bearings", "calibration", "health"]
                .map(|kind| Key::of_all_cameras(site, kind))
                .to_vec(),
            Some(border) => {
                let of_cameras = cameras.iter().flat_map(|camera| of_camera(site, camera));
                of_cameras.chain(border.tracks_beside(site)).collect()
            }
        }
    }

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
                self.lookout.check(healthy_at);
                self.centre.remind(healthy_at);
                self.say_health(subscription, false)?;
            }
        }
        Ok(())
    }

    /// Handles for a moment what is still on its way, and then what is queued.
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
        // Names come from outside, so no counts are kept for cameras that are not configured.
        let is_ours = match key.channel.camera() {
            Some(camera) => self.centre.listens_to(camera),
            None => key.area.is_some(),
        };
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
        if let (Some(border), Some(area)) = (&mut self.border, &key.area) {
            if let Err(error) = border.add_tracks(area, data) {
                let what = format!("what area `{area}` says of its tracks");
                self.centre.refuse(&what, &sender, &error);
            }
            return Ok(());
        }
        let outputs = self.centre.take(&key.channel, data, &sender);
        self.publish(outputs)
    }

    fn publish(&mut self, outputs: Vec<Output>) -> anyhow::Result<()> {
        let outputs = match &mut self.border {
            Some(border) => border.published(outputs),
            None => outputs,
        };
        for output in outputs {
            match output {
                Output::Tracks(frame) => self.tracks.put(frame.encode())?,
                Output::Smoothed(frame) => self.smoothed.put(frame.encode())?,
                Output::Event(event) => {
                    tracing::info!("{event}");
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
        health.component = Identity::Fusion(self.link.key(Channel::Tracks).area).to_string();
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
