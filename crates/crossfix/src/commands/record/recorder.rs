use std::collections::BTreeMap;
use std::time::Instant;

use crossfix_message::{
    Channel, Counter, Health, Key, Payload, SiteName, Timestamp, decode, glance,
};
use crossfix_outlet::foxglove::FoxgloveView;
use crossfix_recording::{Entry, RecordingError};
use crossfix_transport::{NetworkConfig, Received, Reception, RefusedCounts, RunId};

use super::data_time::{DataTime, Said};
use super::files::{FileWriter, Room};
use super::foxglove;
use super::pictures::{Pictures, VideoArgs};
use crate::health::HealthReporter;
use crate::network::rivalry;
use crate::pace::wall_seconds;
use crate::repeats::Repeats;

/// Most bytes of messages kept until data set the data time: what a site of a hundred cameras
/// sends without data in minutes. Further ones are recorded with the time of their arrival: with
/// half of it, after half as long.
const MOST_EARLY_BYTES: usize = 8 << 20;

/// Decides what to record of each message; uses no clock but the messages' arrival times, and no
/// network.
pub struct Recorder {
    writer: FileWriter,
    site: SiteName,
    run: RunId,
    network: NetworkConfig,
    times: DataTime,
    early: Vec<Entry>,
    early_bytes: usize,
    reception: Reception,
    repeats: Repeats,
    counts: UnrecordedCounts,
    /// What each file must begin with: the cameras' newest calibrations, and the fusion centre's
    /// newest message on their clocks.
    standing: BTreeMap<Key, Entry>,
    pictures: Pictures<(Entry, Said)>,
    foxglove: Option<FoxgloveView>,
    room: Room,
    /// Trouble with the disk since the last health message.
    trouble: Option<String>,
    /// Number of earlier files, and of the messages in them.
    before: (u64, u64),
}

/// Counts of messages that were not recorded, or not as they should be.
#[derive(Clone, Copy, Debug, Default)]
struct UnrecordedCounts {
    /// From cameras and fusion centres that the network's file does not name.
    foreign: u64,
    malformed: u64,
    /// Of a newer major version: recorded all the same.
    newer: u64,
    /// Left out because the disk had no room.
    no_room: u64,
}

/// What is not recorded for lack of room, as a text.
fn lacking(room: Room) -> Option<&'static str> {
    match room {
        Room::Pictures => None,
        Room::Messages => Some("the disk is full: pictures are not recorded"),
        Room::Tracks => {
            Some("the disk is full: only bearings, calibrations and tracks are recorded")
        }
    }
}

/// The least room on the disk with which a message is recorded.
pub(super) fn room_for(channel: &Channel) -> Room {
    match channel {
        Channel::Bearings(_)
        | Channel::Calibration(_)
        | Channel::Tracks
        | Channel::Events
        | Channel::RecorderHealth => Room::Tracks,
        Channel::Preview(_) => Room::Pictures,
        _ => Room::Messages,
    }
}

impl Recorder {
    /// A recorder of a network's site.
    pub fn new(
        writer: FileWriter,
        network: &NetworkConfig,
        run: RunId,
        video: VideoArgs,
        foxglove: Option<FoxgloveView>,
    ) -> Self {
        Self {
            writer,
            site: network.site.clone(),
            run,
            network: network.clone(),
            times: DataTime::default(),
            early: Vec::new(),
            early_bytes: 0,
            reception: Reception::default(),
            repeats: Repeats::default(),
            counts: UnrecordedCounts::default(),
            standing: BTreeMap::new(),
            pictures: Pictures::new(video),
            foxglove,
            room: Room::default(),
            trouble: None,
            before: (0, 0),
        }
    }

    /// Goes on in another file, which begins with what is still valid. If the previous one cannot
    /// be closed properly, what was flushed to it is safe.
    ///
    /// # Errors
    /// [`RecordingError`] if the new file cannot be written.
    pub fn go_on(&mut self, writer: FileWriter) -> Result<(), RecordingError> {
        let full = std::mem::replace(&mut self.writer, writer);
        let (files, messages) = self.before;
        self.before = (files + 1, messages + full.messages());
        if let Err(error) = full.finish() {
            self.note_trouble("end", &error.into());
        }
        let said = self.times.now();
        for entry in self.standing.clone().into_values() {
            self.write(entry, said)?;
        }
        Ok(())
    }

    /// Sets the room on the disk, by which it is decided what is recorded.
    pub fn heed(&mut self, room: Room) {
        if room != self.room {
            tracing::warn!("{}", lacking(room).unwrap_or("the disk has room for everything again"));
        }
        self.room = room;
    }

    /// Notes trouble with the disk that does not end the recording; the next health message reports
    /// it, too.
    pub fn note_trouble(&mut self, kind: &str, error: &anyhow::Error) {
        self.trouble = Some(format!("the disk: {error:#}"));
        self.repeats.warn(kind, Instant::now(), || format!("the disk: {error:#}"));
    }

    /// Records a message, if it is one of the site's.
    ///
    /// # Errors
    /// [`RecordingError`] if the file cannot be written.
    pub fn take(&mut self, received: Received) -> Result<(), RecordingError> {
        let Received { key, data, origin, at } = received;
        // Its own health is written by the recorder itself.
        if key.channel == Channel::RecorderHealth
            && origin.is_some_and(|origin| origin.run == self.run)
        {
            return Ok(());
        }
        if !self.network.names(&key) {
            self.counts.foreign += 1;
            self.repeats.warn("foreign", at, || {
                format!("`{key}` is of nobody in the network's file: not recorded")
            });
            return Ok(());
        }
        let sender =
            origin.map_or_else(|| "an unknown program".to_owned(), |o| format!("run {}", o.run));
        let missing = origin.map_or(0, |origin| self.reception.see(&key, origin, at));
        if missing > 0 {
            self.repeats.warn(&format!("missing {key}"), at, || {
                format!("{missing} messages on `{key}` from {sender} did not arrive")
            });
        }
        let seen = match glance(&key.channel, &data) {
            Ok(Some(seen)) => seen,
            Ok(None) => return Ok(()),
            Err(error) => {
                self.counts.malformed += 1;
                self.repeats.warn(&format!("malformed {key}"), at, || {
                    format!("a message on `{key}` from {sender} is not recorded: {error}")
                });
                return Ok(());
            }
        };
        if self.room < room_for(&key.channel) {
            self.counts.no_room += 1;
            return Ok(());
        }
        let arrival = Timestamp::from_seconds(wall_seconds());
        let said = if seen.is_readable {
            self.times.of(&key.channel, seen.time)
        } else {
            self.counts.newer += 1;
            self.repeats.warn(&format!("newer {key}"), at, || {
                format!(
                    "`{key}` from {sender} is of a newer version: recorded, but this build cannot \
                     read it"
                )
            });
            self.times.now()
        };
        self.record(Entry { key, data_time: seen.time, arrival, data }, said, at)
    }

    /// Records an entry of the site, or keeps it waiting if it is a picture.
    fn record(&mut self, entry: Entry, said: Said, at: Instant) -> Result<(), RecordingError> {
        if matches!(entry.key.channel, Channel::Preview(_)) {
            let bytes = entry.data.len();
            let picture = self.pictures.take((entry, said), bytes, at);
            return picture.map_or(Ok(()), |(entry, said)| self.write(entry, said));
        }
        if entry.key.channel == Channel::Tracks && self.pictures.wants_tracks() {
            self.write_pictures(&entry, at)?;
        }
        self.write(entry, said)
    }

    /// Records the pictures that have waited for these tracks.
    fn write_pictures(&mut self, tracks: &Entry, at: Instant) -> Result<(), RecordingError> {
        let Ok(tracks) = decode(&tracks.data) else { return Ok(()) };
        let wanted: Vec<_> = self.pictures.see(&tracks, at).collect();
        if self.room < Room::Pictures {
            self.counts.no_room += wanted.len() as u64;
            return Ok(());
        }
        wanted.into_iter().try_for_each(|(entry, said)| self.write(entry, said))
    }

    fn write(&mut self, entry: Entry, said: Said) -> Result<(), RecordingError> {
        match said {
            Said::At(data_time) => {
                self.release(data_time)?;
                self.put(&Entry { data_time, ..entry })
            }
            Said::BeforeAnyData if self.early_bytes < MOST_EARLY_BYTES => {
                self.early_bytes += entry.data.len();
                self.early.push(entry);
                Ok(())
            }
            Said::BeforeAnyData => self.put(&Entry { data_time: entry.arrival, ..entry }),
        }
    }

    /// Records the messages from before the first data, at the time of the first data.
    fn release(&mut self, now: Timestamp) -> Result<(), RecordingError> {
        self.early_bytes = 0;
        for entry in std::mem::take(&mut self.early) {
            self.put(&Entry { data_time: now.max(entry.data_time), ..entry })?;
        }
        Ok(())
    }

    fn put(&mut self, entry: &Entry) -> Result<(), RecordingError> {
        if matches!(entry.key.channel, Channel::Calibration(_) | Channel::FusionHealth) {
            self.standing.insert(entry.key.clone(), entry.clone());
        }
        match self.writer.write(entry) {
            Err(error @ RecordingError::TooLong { .. }) => {
                self.counts.malformed += 1;
                self.repeats.warn("too long", Instant::now(), || error.to_string());
                Ok(())
            }
            Err(error) => Err(error),
            Ok(()) => match &mut self.foxglove {
                Some(view) => foxglove::write(&mut self.writer, view, entry),
                None => Ok(()),
            },
        }
    }

    /// The recorder's health, which is also recorded here; to be published by the caller.
    ///
    /// # Errors
    /// [`RecordingError`] if the file cannot be written.
    pub fn health(
        &mut self,
        refused: RefusedCounts,
        ended: bool,
        reporter: &mut HealthReporter,
    ) -> Result<Health, RecordingError> {
        let now = Instant::now();
        self.repeats.remind(now);
        let counted = [
            ("pictures_left_out", self.pictures.left_out()),
            ("received_dropped", refused.dropped),
            ("received_foreign_camera", self.counts.foreign),
            ("received_malformed", self.counts.malformed),
            ("received_missing", self.reception.missing()),
            ("received_no_room", self.counts.no_room),
            ("received_newer_version", self.counts.newer),
            ("received_too_long", refused.too_long),
        ];
        let mut problems = Vec::new();
        problems.extend(lacking(self.room).map(str::to_owned));
        problems.extend(self.trouble.take());
        for (key, runs) in self.reception.rivals(now) {
            let rivalry = rivalry(key, runs);
            self.repeats.warn(&format!("rivals {key}"), now, || rivalry.clone());
            problems.push(rivalry);
        }
        let time = match self.times.now() {
            Said::At(time) => time,
            Said::BeforeAnyData => Timestamp::EPOCH,
        };
        let health = Health {
            component: "recorder".to_owned(),
            time_ns: time.nanos(),
            handled: self.before.1 + self.writer.messages(),
            counters: counted
                .into_iter()
                .map(|(name, value)| Counter { name: name.to_owned(), value })
                .collect(),
            problems,
            ended,
            ..Default::default()
        };
        let health = reporter.completed(health);
        let entry = Entry {
            key: Key::new(self.site.clone(), Channel::RecorderHealth),
            data_time: time,
            arrival: Timestamp::from_seconds(wall_seconds()),
            data: health.encode(),
        };
        let said = self.times.now();
        self.write(entry, said)?;
        Ok(health)
    }

    /// Flushes, so that everything recorded so far survives a crash of the program.
    ///
    /// # Errors
    /// [`RecordingError`] if the file cannot be written.
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.writer.flush()
    }

    /// Closes the file with its index; returns the numbers of messages recorded and of files.
    ///
    /// # Errors
    /// [`RecordingError`] if the file cannot be written.
    pub fn finish(mut self) -> Result<(u64, u64), RecordingError> {
        self.repeats.end();
        // No data ever set the data time, so the arrival by wall clock is used.
        for entry in std::mem::take(&mut self.early) {
            self.put(&Entry { data_time: entry.arrival, ..entry })?;
        }
        let (files, messages) = self.before;
        Ok((messages + self.writer.finish()?, files + 1))
    }
}
