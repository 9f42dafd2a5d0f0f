//! A site as seen from above: cameras, tracks, and events.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use crossfix_geometry::{Camera, Pixel};
use crossfix_message::{
    Calibration, CameraCalibration, CameraName, Channel, Timestamp, Track, TrackEvent, TrackFrame,
    TrackNumber, TrackState, decode,
};
use nalgebra::Vector3;
use serde::Serialize;

/// A track without news for this long has ended. With twice as much a target that is gone is drawn
/// for twice as long.
const TRACK_LIVES: Duration = Duration::from_secs(2);
/// Most tracks that are drawn: with more the plan is unreadable. With half as many a swarm of more
/// than 500 would be drawn in part.
const MOST_TRACKS: usize = 1000;
/// Number of events that are shown. With half as many what was before the last 50 would be gone.
const MOST_EVENTS: usize = 100;

/// A camera on the plan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraOnPlan {
    pub name: String,
    /// East and north, m.
    pub at: [f64; 2],
    /// Azimuths of the view's two edges, degrees from north, clockwise; absent for a camera on a
    /// mount.
    pub view_deg: Option<[f64; 2]>,
}

/// A track on the plan.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PlannedTrack {
    /// The track's identity as a text, as JavaScript's numbers have too few digits.
    pub id: String,
    pub number: String,
    /// `confirmed`, `coasting` or `one camera`.
    pub state: &'static str,
    /// East, north and up, m.
    pub at: [f64; 3],
    /// Velocity east, north and up, m/s.
    pub velocity: [f64; 3],
    /// Horizontal covariance: east-east, east-north, north-north, m^2.
    pub covariance: [f64; 3],
}

/// An event of a track or a camera.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Event {
    /// Data time, seconds since the Unix epoch.
    pub time_s: f64,
    pub what: String,
}

/// The plan of a site as it is now.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Plan {
    /// The time of the newest tracks, seconds since the Unix epoch.
    pub time_s: Option<f64>,
    pub cameras: Vec<CameraOnPlan>,
    pub tracks: Vec<PlannedTrack>,
    /// The newest event first.
    pub events: Vec<Event>,
}

/// All that has been received of a site.
#[derive(Debug, Default)]
pub struct PlanBoard {
    known: Vec<CameraName>,
    cameras: BTreeMap<CameraName, CameraOnPlan>,
    tracks: BTreeMap<u64, (Track, Instant)>,
    events: VecDeque<Event>,
    time: Option<Timestamp>,
}

impl PlanBoard {
    /// A board for a site with these cameras.
    pub fn new(known: Vec<CameraName>) -> Self {
        Self { known, ..Self::default() }
    }

    /// Takes a message in; one that cannot be read is ignored.
    pub fn take(&mut self, channel: &Channel, data: &[u8], at: Instant) {
        match channel {
            Channel::Calibration(name) if self.known.contains(name) => {
                let message = decode::<CameraCalibration>(data).ok();
                let calibration = message.and_then(|message| message.parse().ok());
                if let Some(calibration) = calibration {
                    self.cameras.insert(name.clone(), planned(name, &calibration));
                }
            }
            Channel::Tracks => {
                let frame: TrackFrame = decode(data).unwrap_or_default();
                self.time = Some(Timestamp::from_nanos(frame.time_ns)).max(self.time);
                self.tracks
                    .retain(|_, (_, said)| at.saturating_duration_since(*said) < TRACK_LIVES);
                for track in frame.tracks {
                    if self.tracks.len() < MOST_TRACKS || self.tracks.contains_key(&track.id) {
                        self.tracks.insert(track.id, (track, at));
                    }
                }
            }
            Channel::Events => {
                if let Ok(event) = decode::<TrackEvent>(data) {
                    self.note(&event);
                }
            }
            _ => {}
        }
    }

    fn note(&mut self, event: &TrackEvent) {
        let time_s = Timestamp::from_nanos(event.time_ns).seconds();
        self.events.push_front(Event { time_s, what: event.to_string() });
        self.events.truncate(MOST_EVENTS);
    }

    /// The plan as it is now.
    pub fn plan(&self, now: Instant) -> Plan {
        let lives = |said: &Instant| now.saturating_duration_since(*said) < TRACK_LIVES;
        let tracks = self.tracks.values().filter(|(_, said)| lives(said));
        Plan {
            time_s: self.time.map(Timestamp::seconds),
            cameras: self.cameras.values().cloned().collect(),
            tracks: tracks.filter_map(|(track, _)| planned_track(track)).collect(),
            events: self.events.iter().cloned().collect(),
        }
    }
}

fn planned(name: &CameraName, calibration: &Calibration) -> CameraOnPlan {
    let place = calibration.camera.pose().position();
    let view_deg = calibration.mount.is_none().then(|| view(&calibration.camera)).flatten();
    CameraOnPlan { name: name.to_string(), at: [place.x, place.y], view_deg }
}

/// Azimuths, degrees, of the directions through the middles of the image's left and right edges.
fn view(camera: &Camera) -> Option<[f64; 2]> {
    let size = camera.model().intrinsics().size;
    let middle = f64::from(size.height) / 2.0;
    let left = azimuth_deg(camera, Pixel::new(0.0, middle))?;
    let right = azimuth_deg(camera, Pixel::new(f64::from(size.width), middle))?;
    Some([left, right])
}

fn azimuth_deg(camera: &Camera, pixel: Pixel) -> Option<f64> {
    let direction = camera.model().direction(pixel).ok()?;
    let line: Vector3<f64> = camera.pose().rotation() * direction.into_inner();
    Some(line.x.atan2(line.y).to_degrees())
}

fn planned_track(track: &Track) -> Option<PlannedTrack> {
    let state = match track.state() {
        TrackState::Confirmed => "confirmed",
        TrackState::Coasting => "coasting",
        TrackState::OneCamera => "one camera",
        TrackState::Tentative | TrackState::Lost | TrackState::Unspecified => return None,
    };
    let (at, velocity) = (track.position?, track.velocity?);
    let covariance = |index: usize| track.covariance.get(index).copied().unwrap_or(0.0);
    let covariance = [covariance(0), covariance(1), covariance(7)];
    let numbers = [at.x, at.y, at.z, velocity.x, velocity.y, velocity.z];
    let is_drawable = numbers.iter().chain(&covariance).all(|number| number.is_finite());
    is_drawable.then(|| PlannedTrack {
        id: track.id.to_string(),
        number: TrackNumber(track.id).to_string(),
        state,
        at: [at.x, at.y, at.z],
        velocity: [velocity.x, velocity.y, velocity.z],
        covariance,
    })
}
