//! Reports of a site's components as one table.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crossfix_message::{
    CameraHealth, CameraName, CameraStanding, Channel, Health, Key, TrackFrame, TrackState, decode,
};
use crossfix_transport::{Identity, NetworkConfig};
use serde::Serialize;

use crate::output;

/// A component that has not sent a health message for this long is silent: they are due every
/// second. With half of it one that is a quarter of a second late would do; with twice as much a
/// dead component is seen after five seconds.
const SILENT: Duration = Duration::from_millis(2500);
/// A track without news for this long has ended. With twice as much a target that is gone is
/// counted for twice as long.
const TRACK_LIVES: Duration = Duration::from_secs(2);
/// Most tracks that are counted. Likewise, components that are no cameras of the network's file are
/// not shown, so that data from outside cannot fill the memory. With half of it the count would end
/// at 5000.
const MOST_TRACKS: usize = 10_000;

/// Most problems shown of one component. With half of it the last of many would be missing.
const MOST_PROBLEMS: usize = 10;
/// Most characters shown of a problem: two lines of a terminal. With half of it the end of a long
/// one would be missing.
const MOST_LETTERS: usize = 200;

/// Text from elsewhere as one line without control characters, which could affect the terminal.
fn printable(text: &str) -> String {
    let shown = text.chars().map(|letter| if letter.is_control() { ' ' } else { letter });
    shown.take(MOST_LETTERS).collect()
}

/// A component's last health message, and when it was received.
#[derive(Clone, Debug)]
struct HeardHealth {
    health: Health,
    at: Instant,
}

/// State of one component of a site.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ComponentRow {
    /// The camera's name, `fusion` (`fusion-west` of an area) or `recorder`.
    pub name: String,
    /// The component's state in a word or two.
    pub state: String,
    /// Frames or messages per second.
    pub rate_hz: f64,
    /// 99 % quantile of the time from an image's last byte to its published bearings, ms; of a live
    /// camera.
    pub latency_ms: Option<f64>,
    /// How far its clock is ahead of the site's, as estimated from tracks, ms, ...
    pub clock_ms: Option<f64>,
    /// ... and the standard deviation of that, ms.
    pub clock_sd_ms: Option<f64>,
    /// Number of tracks: of a camera in its image, of the fusion centre in space.
    pub tracks: u32,
    /// Processor time, cores.
    pub cores: Option<f64>,
    /// Memory, MB.
    pub memory_mb: Option<f64>,
    /// Temperature of the hottest part of its host, degrees Celsius.
    pub temperature_c: Option<f64>,
    /// Problems that need a person's attention.
    pub problems: Vec<String>,
}

/// State of a site.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Status {
    pub site: String,
    /// The cameras of the network's file, the fusion centre, and the recorder if it is heard.
    pub parts: Vec<ComponentRow>,
    /// Number of tracks that are confirmed or coasting.
    pub confirmed: usize,
    /// Number of tracks that only one camera follows.
    pub one_camera: usize,
}

/// All that has been received of a site.
#[derive(Debug)]
pub struct Board {
    site: String,
    cameras: Vec<CameraName>,
    /// Names of the fusion centres: `fusion`, or `fusion-west` and so on.
    centres: Vec<String>,
    parts: BTreeMap<String, HeardHealth>,
    tracks: BTreeMap<u64, (TrackState, Instant)>,
}

impl Board {
    /// An empty board for a network's site.
    pub fn new(network: &NetworkConfig) -> Self {
        let centres = network.centres().map(|(area, _)| Identity::Fusion(area).to_string());
        Self {
            site: network.site.to_string(),
            cameras: network.cameras.keys().cloned().collect(),
            centres: centres.collect(),
            parts: BTreeMap::new(),
            tracks: BTreeMap::new(),
        }
    }

    /// Takes a message in; one that cannot be read is ignored.
    pub fn take(&mut self, key: &Key, data: &[u8], at: Instant) {
        let name = match &key.channel {
            Channel::CameraHealth(camera) if self.cameras.contains(camera) => camera.to_string(),
            Channel::FusionHealth => {
                let name = Identity::Fusion(key.area.clone()).to_string();
                if !self.centres.contains(&name) {
                    return;
                }
                name
            }
            Channel::RecorderHealth => "recorder".to_owned(),
            Channel::Tracks => return self.hear_tracks(data, at),
            _ => return,
        };
        if let Ok(health) = decode(data) {
            self.parts.insert(name, HeardHealth { health, at });
        }
    }

    fn hear_tracks(&mut self, data: &[u8], at: Instant) {
        self.tracks.retain(|_, (_, said)| at.saturating_duration_since(*said) < TRACK_LIVES);
        let frame: TrackFrame = decode(data).unwrap_or_default();
        for track in frame.tracks {
            if self.tracks.len() < MOST_TRACKS {
                self.tracks.insert(track.id, (track.state(), at));
            }
        }
    }

    /// The state of the site now.
    pub fn status(&self, now: Instant) -> Status {
        // Clock estimates of a fusion centre that has died are out of date.
        let is_heard = |heard: &&HeardHealth| now.saturating_duration_since(heard.at) <= SILENT;
        let heard = self.centres.iter().filter_map(|centre| self.parts.get(centre));
        let clocks: Vec<&CameraHealth> =
            heard.filter(is_heard).flat_map(|heard| &heard.health.cameras).collect();
        let cameras = self.cameras.iter().map(|camera| {
            // Of several centres that listen to the camera, the one that trusts it least.
            let of_camera = clocks.iter().filter(|clock| clock.camera == camera.as_str());
            let clock = of_camera.max_by_key(|clock| clock.standing);
            self.part(camera.as_str(), clock.copied(), now)
        });
        let centres = self.centres.iter().map(|centre| self.part(centre, None, now));
        let recorder =
            self.parts.contains_key("recorder").then(|| self.part("recorder", None, now));
        Status {
            site: self.site.clone(),
            parts: cameras.chain(centres).chain(recorder).collect(),
            confirmed: self.count_tracks(&[TrackState::Confirmed, TrackState::Coasting], now),
            one_camera: self.count_tracks(&[TrackState::OneCamera], now),
        }
    }

    /// Number of tracks that were lately in one of these states.
    fn count_tracks(&self, wanted: &[TrackState], now: Instant) -> usize {
        let lives = |said: Instant| now.saturating_duration_since(said) < TRACK_LIVES;
        let tracks = self.tracks.values();
        tracks.filter(|(state, said)| wanted.contains(state) && lives(*said)).count()
    }

    fn part(&self, name: &str, clock: Option<&CameraHealth>, now: Instant) -> ComponentRow {
        let nobody = Health::default();
        let heard = self.parts.get(name);
        // For a camera that is not heard, earlier clock estimates say nothing.
        let clock = clock.filter(|_| heard.is_some());
        let health = heard.map_or(&nobody, |heard| &heard.health);
        let load = health.load.as_ref();
        let p99_us = health.counters.iter().find(|one| one.name == "arrival_to_bearings_p99_us");
        ComponentRow {
            name: name.to_owned(),
            state: state(heard, clock, now),
            rate_hz: health.rate_hz,
            latency_ms: p99_us.map(|p99_us| p99_us.value as f64 * 1e-3),
            clock_ms: clock.map(|clock| clock.clock_offset_s * 1e3),
            clock_sd_ms: clock.map(|clock| clock.clock_relative_sd_s * 1e3),
            tracks: health.tracks,
            cores: load.map(|load| load.process_cores),
            memory_mb: load.map(|load| load.process_memory as f64 * 1e-6),
            temperature_c: load.and_then(|load| load.temperature_c),
            problems: health
                .problems
                .iter()
                .take(MOST_PROBLEMS)
                .map(|one| printable(one))
                .collect(),
        }
    }
}

/// A component's state in a word or two.
fn state(heard: Option<&HeardHealth>, clock: Option<&CameraHealth>, now: Instant) -> String {
    let Some(HeardHealth { health, at }) = heard else { return "not heard".to_owned() };
    let silent = now.saturating_duration_since(*at);
    let word = match clock.map(CameraHealth::standing) {
        _ if health.ended => "has ended",
        _ if silent > SILENT => return format!("silent for {:.0} s", silent.as_secs_f64()),
        Some(CameraStanding::Excluded) => "left out",
        Some(CameraStanding::Doubted) => "doubted",
        _ if !health.problems.is_empty() => "has trouble",
        _ => "good",
    };
    word.to_owned()
}

impl Status {
    /// The site's state as a screen of text.
    pub fn text(&self) -> String {
        let head = [
            "part",
            "state",
            "a second",
            "latency [ms]",
            "clock [ms]",
            "tracks",
            "cores",
            "MB",
            "C",
        ];
        let mut rows = vec![head.map(str::to_owned).to_vec()];
        rows.extend(self.parts.iter().map(ComponentRow::row));
        let mut lines = vec![format!("site `{}`", self.site), output::table(&rows)];
        let [confirmed, one_camera] = [self.confirmed, self.one_camera];
        lines.push(format!(
            "{confirmed} confirmed tracks, {one_camera} that one camera alone follows"
        ));
        for part in &self.parts {
            lines.extend(part.problems.iter().map(|problem| format!("{}: {problem}", part.name)));
        }
        lines.join("\n")
    }
}

/// A number of the table; nothing where it is not known.
fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or(String::new(), |value| format!("{value:.digits$}"))
}

impl ComponentRow {
    fn row(&self) -> Vec<String> {
        let clock = match (self.clock_ms, self.clock_sd_ms) {
            (Some(ahead), Some(sd)) => format!("{ahead:+.1} ± {sd:.1}"),
            _ => String::new(),
        };
        vec![
            self.name.clone(),
            self.state.clone(),
            format!("{:.1}", self.rate_hz),
            number(self.latency_ms, 1),
            clock,
            self.tracks.to_string(),
            number(self.cores, 2),
            number(self.memory_mb, 0),
            number(self.temperature_c, 0),
        ]
    }
}

#[cfg(test)]
mod tests {
    use crossfix_message::{Counter, HostLoad, Payload, Track};

    use super::*;

    fn board() -> Board {
        let network = "site = \"field\"\nfusion = \"tcp/127.0.0.1:7450\"\n[cameras]\n\
                       north = \"tcp/127.0.0.1:7451\"\neast = \"tcp/127.0.0.1:7452\"\n";
        Board::new(&toml::from_str(network).unwrap())
    }

    fn key(channel: Channel) -> Key {
        Key::new("field".parse().unwrap(), channel)
    }

    fn of(name: &str) -> Key {
        key(Channel::CameraHealth(name.parse().unwrap()))
    }

    #[test]
    fn each_part_is_shown_with_what_it_said_and_who_says_nothing_is_silent() {
        let (mut board, begun) = (board(), Instant::now());
        let north = Health {
            rate_hz: 29.97,
            counters: vec![Counter { name: "arrival_to_bearings_p99_us".into(), value: 12_300 }],
            load: Some(HostLoad {
                process_cores: 0.41,
                process_memory: 166_000_000,
                ..Default::default()
            }),
            problems: vec!["sees nothing:\x1bthe stream has ended".into()],
            tracks: 2,
            ..Default::default()
        };
        board.take(&of("north"), &north.encode(), begun);
        // A message from no camera of the site.
        board.take(&of("stranger"), &north.encode(), begun);
        let clock = CameraHealth {
            camera: "north".into(),
            standing: CameraStanding::Good.into(),
            clock_offset_s: 0.005,
            clock_relative_sd_s: 0.0007,
            ..Default::default()
        };
        let fusion = Health { cameras: vec![clock], rate_hz: 80.0, ..Default::default() };
        board.take(&key(Channel::FusionHealth), &fusion.encode(), begun + Duration::from_secs(3));
        board.take(&key(Channel::FusionHealth), &[0xff; 9], begun + Duration::from_secs(3));
        let status = board.status(begun + Duration::from_secs(1));
        let names: Vec<&str> = status.parts.iter().map(|part| part.name.as_str()).collect();
        assert_eq!(names, ["east", "north", "fusion"]);
        let text = status.text();
        let north = text.lines().find(|line| line.starts_with("north")).unwrap();
        for shown in ["has trouble", "30.0", "12.3", "+5.0 ± 0.7", " 2 ", "0.41", "166"] {
            assert!(north.contains(shown), "{shown} in {north}");
        }
        assert!(text.contains("east") && text.contains("not heard"), "{text}");
        assert!(text.ends_with("north: sees nothing: the stream has ended"), "{text}");
        let later = board.status(begun + Duration::from_secs(5));
        assert_eq!(later.parts[1].state, "silent for 5 s");
    }

    #[test]
    fn tracks_that_live_are_counted() {
        let (mut board, begun) = (board(), Instant::now());
        let track =
            |id: u64, state: TrackState| Track { id, state: state.into(), ..Default::default() };
        let take_tracks = |board: &mut Board, tracks: Vec<Track>, at: Instant| {
            board.take(
                &key(Channel::Tracks),
                &TrackFrame { tracks, ..Default::default() }.encode(),
                at,
            );
        };
        let both = vec![track(1, TrackState::Confirmed), track(2, TrackState::OneCamera)];
        take_tracks(&mut board, both, begun);
        take_tracks(
            &mut board,
            vec![track(3, TrackState::Coasting)],
            begun + Duration::from_secs(1),
        );
        let counted = |board: &Board, seconds: u64| {
            let status = board.status(begun + Duration::from_secs(seconds));
            (status.confirmed, status.one_camera)
        };
        assert_eq!(counted(&board, 1), (2, 1));
        assert_eq!(counted(&board, 2), (1, 0));
        take_tracks(&mut board, vec![track(3, TrackState::Lost)], begun + Duration::from_secs(2));
        assert_eq!(counted(&board, 2), (0, 0));
    }
}
