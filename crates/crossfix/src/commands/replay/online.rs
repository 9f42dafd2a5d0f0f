//! Replay onto the network, in real time or faster.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::ensure;
use crossfix_message::{
    BearingFrame, CameraName, Channel, CueFrame, Health, Key, Payload, Preview, Timestamp,
    TrackEvent, TrackFrame, TruthFrame, decode, glance,
};
use crossfix_recording::Entry;
use crossfix_transport::{AliveToken, Delivery, Link, LinkPublisher, NetworkConfig, Role};

use super::{Args, Contents, TimeRange, calibrations};
use crate::commands::agent::CALIBRATION_PERIOD;
use crate::config;
use crate::network;
use crate::output;
use crate::pace::Pace;
use crate::recorded::{self, Lacks};
use crate::shutdown::{LEAVE, LONG_LEAVE, Shutdown};

/// Time for listeners to connect before the first message, s. With half of it listeners that take
/// longer miss the first messages.
const RUN_UP_S: f64 = 2.0;
/// Time between the last message of a pass and the first of the next, s: a few frames. With half of
/// it the same.
const SEAM_S: f64 = 0.1;

/// Whether such messages come from cameras.
fn is_cameras(channel: &Channel) -> bool {
    !matches!(
        channel,
        Channel::Tracks
            | Channel::Smoothed
            | Channel::Events
            | Channel::Cues
            | Channel::FusionHealth
            | Channel::RecorderHealth
    )
}

/// Publishes a range of a recording's bytes under the network's site.
pub fn publish(
    args: &Args,
    network: &Path,
    range: TimeRange,
    contents: &Contents,
) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen();
    let network = config::load_network(network)?;
    let Some(link) =
        network::open(&network, &Role::Cameras { and_fusion: args.tracks }, &shutdown)?
    else {
        return Ok(());
    };
    ensure_heard(&args.recording, contents, &network)?;
    tracing::info!("publishing as the cameras of `{}` in {RUN_UP_S} s", link.site());
    let delivery = if args.speed > 0.0 { Delivery::Queued } else { Delivery::Every };
    let mut stage = Stage::new(link, delivery);
    let mut left_out = LeftOut::default();
    stage.appear(&network, args.tracks)?;
    if !range.is_whole {
        stage.calibrate(calibrations(&args.recording, range)?, &network)?;
    }
    let mut pass = Pass { goes_on: args.again, ..Pass::default() };
    // The run-up takes the same time at any speed.
    if Pace::beginning_in(RUN_UP_S, 1.0).wait(0.0, &shutdown) {
        let pace = Pace::beginning_in(0.0, args.speed);
        loop {
            let mut lacks = Lacks::default();
            let before = stage.published;
            recorded::for_each_until(&args.recording, &mut lacks, &shutdown, |_, entry| {
                let wanted = range.holds(&entry) && (args.tracks || is_cameras(&entry.key.channel));
                if !wanted || !left_out.admits(&entry, &network) {
                    return Ok(());
                }
                let since_s = entry.data_time.seconds_since(range.from) + pass.by_s;
                if pace.wait(since_s, &shutdown) {
                    stage.put(pass.shifted(entry))?;
                    stage.repeat_calibrations()?;
                }
                Ok(())
            })?;
            lacks.say(&args.recording);
            if !args.again || shutdown.requested() {
                break;
            }
            ensure!(
                stage.published > before,
                "nothing in that range can be played again and again"
            );
            pass.begin_again(range.from);
        }
    }
    let Stage { link, publishers, alive, published, .. } = stage;
    // Gives the last messages time to leave.
    std::thread::sleep(Duration::from_millis(200));
    drop((publishers, alive));
    link.close(if shutdown.requested() { LEAVE } else { LONG_LEAVE })?;
    output::line(format!("{published} messages published{left_out}"));
    Ok(())
}

/// Counts of the messages that are not published, because nobody on the network would use them.
#[derive(Debug, Default)]
struct LeftOut {
    /// From cameras that the network's file does not name.
    foreign: u64,
    /// Damaged, or of a newer major version.
    unreadable: u64,
}

impl LeftOut {
    /// Whether a message is of use on the network; counts it here if it is not.
    fn admits(&mut self, entry: &Entry, network: &NetworkConfig) -> bool {
        let camera = entry.key.channel.camera();
        if camera.is_some_and(|camera| !network.cameras.contains_key(camera)) {
            self.foreign += 1;
            return false;
        }
        let seen = glance(&entry.key.channel, &entry.data);
        let is_readable = seen.is_ok_and(|seen| seen.is_none_or(|seen| seen.is_readable));
        self.unreadable += u64::from(!is_readable);
        is_readable
    }
}

impl fmt::Display for LeftOut {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let reasons = [
            (self.foreign, "of cameras that the network's file does not name"),
            (self.unreadable, "that cannot be read: damaged, or of a newer version"),
        ];
        let mut separator = "; left out: ";
        for (count, reason) in reasons.into_iter().filter(|(count, _)| *count > 0) {
            write!(f, "{separator}{count} {reason}")?;
            separator = ", ";
        }
        Ok(())
    }
}

/// Refuses a recording of which nobody on the network would hear or read anything, and says what
/// they would not.
fn ensure_heard(
    recording: &Path,
    contents: &Contents,
    network: &NetworkConfig,
) -> anyhow::Result<()> {
    let &Contents { messages, newer, .. } = contents;
    recorded::ensure_readable(recording, messages, newer)?;
    let recording = recording.display();
    let is_known = |camera: &&CameraName| network.cameras.contains_key(*camera);
    let unknown: Vec<String> = contents
        .cameras
        .iter()
        .filter(|camera| !is_known(camera))
        .map(|camera| format!("`{camera}`"))
        .collect();
    if unknown.is_empty() {
        return Ok(());
    }
    let said = format!(
        "the network of site `{}` lacks cameras of {recording}: {}",
        network.site,
        unknown.join(", ")
    );
    ensure!(unknown.len() < contents.cameras.len(), said);
    tracing::warn!("{said}");
    Ok(())
}

/// Publishes each message on the key under which it was recorded, but in the site that listens now.
struct Stage {
    link: Link,
    delivery: Delivery,
    publishers: BTreeMap<Key, LinkPublisher>,
    /// Tokens of presence for the components that the replay stands in for.
    alive: Vec<AliveToken>,
    published: u64,
    /// The newest calibration of each camera, and when they were last published.
    calibrations: BTreeMap<Key, Entry>,
    calibrated: Instant,
}

impl Stage {
    fn new(link: Link, delivery: Delivery) -> Self {
        Self {
            link,
            delivery,
            publishers: BTreeMap::new(),
            alive: Vec::new(),
            published: 0,
            calibrations: BTreeMap::new(),
            calibrated: Instant::now(),
        }
    }

    /// Publishes the calibrations that hold where a range begins. They are none of the range's
    /// messages, and not counted among those.
    fn calibrate(&mut self, valid: Vec<Entry>, network: &NetworkConfig) -> anyhow::Result<()> {
        let mut uncounted = LeftOut::default();
        let mut wanted = valid.into_iter().filter(|entry| uncounted.admits(entry, network));
        wanted.try_for_each(|entry| self.send(entry))
    }

    fn appear(&mut self, network: &NetworkConfig, and_fusion: bool) -> anyhow::Result<()> {
        for camera in network.cameras.keys() {
            self.alive.push(self.link.declare_alive(Channel::Alive(camera.clone()))?);
        }
        for (area, _) in network.centres().filter(|_| and_fusion) {
            self.alive.push(self.link.declare_alive_of(area, Channel::FusionAlive)?);
        }
        Ok(())
    }

    /// Publishes the calibrations again, as agents do: who begins to listen later needs them.
    fn repeat_calibrations(&mut self) -> anyhow::Result<()> {
        if self.calibrated.elapsed() < CALIBRATION_PERIOD {
            return Ok(());
        }
        self.calibrated = Instant::now();
        for entry in self.calibrations.values().cloned().collect::<Vec<_>>() {
            self.send(entry)?;
        }
        Ok(())
    }

    fn put(&mut self, entry: Entry) -> anyhow::Result<()> {
        self.send(entry)?;
        self.published += 1;
        Ok(())
    }

    fn send(&mut self, entry: Entry) -> anyhow::Result<()> {
        if matches!(entry.key.channel, Channel::Calibration(_)) {
            self.calibrations.insert(entry.key.clone(), entry.clone());
        }
        let Key { area, channel, .. } = &entry.key;
        if !self.publishers.contains_key(&entry.key) {
            let is_picture = matches!(channel, Channel::Preview(_));
            let delivery = if is_picture { Delivery::Picture } else { self.delivery };
            let publisher = self.link.publisher_of(area.clone(), channel.clone(), delivery)?;
            self.publishers.insert(entry.key.clone(), publisher);
        }
        if let Some(publisher) = self.publishers.get(&entry.key) {
            publisher.put(entry.data)?;
        }
        Ok(())
    }
}

/// One pass through the recording. A single pass publishes the recorded bytes; if it is repeated,
/// times and frame numbers continue from one pass to the next.
#[derive(Debug, Default)]
struct Pass {
    by_s: f64,
    /// Whether passes are repeated: then no source reports its end.
    goes_on: bool,
    /// The newest data time of this pass, before the shift.
    newest: Option<Timestamp>,
    /// For each camera the offset added to its frame numbers, and the number after its highest so
    /// far.
    numbers: BTreeMap<CameraName, (u64, u64)>,
}

impl Pass {
    fn begin_again(&mut self, from: Timestamp) {
        let lasted_s = self.newest.map_or(0.0, |newest| newest.seconds_since(from));
        self.by_s += lasted_s.max(0.0) + SEAM_S;
        self.newest = None;
        for (base, next) in self.numbers.values_mut() {
            *base = *next;
        }
    }

    fn shifted(&mut self, entry: Entry) -> Entry {
        self.newest = self.newest.max(Some(entry.data_time));
        let is_recorded = self.by_s == 0.0 && !self.goes_on;
        let moved = self.moved(&entry.key.channel, &entry.data);
        match moved {
            Some(data) if !is_recorded => Entry { data, ..entry },
            _ => entry,
        }
    }

    /// The message shifted in time; `None` if it cannot be read.
    fn moved(&mut self, channel: &Channel, data: &[u8]) -> Option<Vec<u8>> {
        let by_s = self.by_s;
        let moved =
            |nanos: &mut i64| *nanos = Timestamp::from_nanos(*nanos).plus_seconds(by_s).nanos();
        Some(match channel {
            Channel::Bearings(camera) => {
                let mut message: BearingFrame = decode(data).ok()?;
                let (base, next) = self.numbers.entry(camera.clone()).or_default();
                message.sequence = message.sequence.saturating_add(*base);
                *next = (*next).max(message.sequence.saturating_add(1));
                moved(&mut message.capture_time_ns);
                message.encode_unstamped()
            }
            // The time from which a calibration is valid stays as it is.
            Channel::Calibration(_) => return None,
            Channel::Preview(_) => {
                let mut message: Preview = decode(data).ok()?;
                moved(&mut message.capture_time_ns);
                message.encode_unstamped()
            }
            Channel::CameraHealth(_) | Channel::FusionHealth | Channel::RecorderHealth => {
                let mut message: Health = decode(data).ok()?;
                moved(&mut message.time_ns);
                // The source has not ended, as another pass follows.
                message.ended = false;
                message.encode_unstamped()
            }
            Channel::Tracks | Channel::Smoothed => {
                let mut message: TrackFrame = decode(data).ok()?;
                moved(&mut message.time_ns);
                for track in &mut message.tracks {
                    moved(&mut track.updated_ns);
                    moved(&mut track.born_ns);
                    track.residuals.iter_mut().for_each(|residual| moved(&mut residual.time_ns));
                }
                message.encode_unstamped()
            }
            Channel::Events => {
                let mut message: TrackEvent = decode(data).ok()?;
                moved(&mut message.time_ns);
                message.encode_unstamped()
            }
            Channel::Cues => {
                let mut message: CueFrame = decode(data).ok()?;
                moved(&mut message.time_ns);
                let ahead = message.cues.iter_mut().flat_map(|cue| &mut cue.ahead);
                ahead.for_each(|expected| moved(&mut expected.time_ns));
                message.encode_unstamped()
            }
            Channel::Truth => {
                let mut message: TruthFrame = decode(data).ok()?;
                moved(&mut message.time_ns);
                message.encode_unstamped()
            }
            Channel::Alive(_) | Channel::FusionAlive | Channel::RecorderAlive => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use crossfix_message::Key;

    use super::*;

    #[test]
    fn a_second_pass_goes_on_where_the_first_ended() {
        let key = Key::new("field".parse().unwrap(), Channel::Bearings("north".parse().unwrap()));
        let entry = |sequence: u64| {
            let time = Timestamp::from_seconds(100.0 + sequence as f64 * 0.1);
            let frame =
                BearingFrame { sequence, capture_time_ns: time.nanos(), ..Default::default() }
                    .stamped();
            Entry {
                key: key.clone(),
                data_time: time,
                arrival: time,
                data: frame.encode_unstamped(),
            }
        };
        let mut pass = Pass::default();
        let first: Vec<Entry> = (0..10).map(|k| pass.shifted(entry(k))).collect();
        assert_eq!(first, (0..10).map(entry).collect::<Vec<_>>(), "the recorded bytes");
        for round in 1..3 {
            pass.begin_again(Timestamp::from_seconds(100.0));
            for k in 0..10 {
                let frame: BearingFrame = decode(&pass.shifted(entry(k)).data).unwrap();
                assert_eq!(frame.sequence, 10 * round + k);
                let at = Timestamp::from_nanos(frame.capture_time_ns).seconds();
                assert!((at - (100.0 + (10 * round + k) as f64 * 0.1)).abs() < 1e-6, "{at}");
            }
        }
    }
}
