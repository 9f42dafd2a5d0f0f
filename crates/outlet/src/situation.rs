//! All tracks at one time: a fusion centre sends each track at its own time, and only those that
//! have changed.

use std::collections::BTreeMap;

use crossfix_geometry::{Geodetic, LocalFrame};
use crossfix_message::{
    AreaName, CameraCalibration, Datum, SiteName, Timestamp, Track, TrackFrame, TrackState,
};
use nalgebra::{Matrix3, Matrix6, Point3, Vector3};

use crate::Target;

/// A track of which nothing was heard for this long is lost, s: a fusion centre sends each of its
/// tracks at least every half second. With half of it, tracks are lost on a link that stutters.
const SILENCE_S: f64 = 2.0;
/// Most tracks that are kept; a fusion centre has a thousand at most. With half of it those of five
/// full fusion centres fit, and new tracks beyond them are left out.
const MOST_TRACKS: usize = 10_000;
/// Most fusion centres whose time is kept. The tracks of one more are kept, but its restart is not
/// noticed; with half of it, from the 501st on.
const MOST_CENTRES: usize = 1000;

/// Where all targets are at one instant.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot {
    /// The site.
    pub site: SiteName,
    /// The time, by the data.
    pub time: Timestamp,
    /// The sure targets, ordered by id: confirmed tracks, those that one camera follows and those
    /// not seen lately; and, once, those that were lost since the snapshot before.
    pub targets: Vec<Target>,
}

/// A track as it was last heard, in the site's axes.
#[derive(Clone, Debug)]
struct KnownTrack {
    state: TrackState,
    time: Timestamp,
    time_sd_s: f64,
    seen: Timestamp,
    position: Point3<f64>,
    velocity: Vector3<f64>,
    covariance: Matrix6<f64>,
}

/// Takes in tracks, each at its own time, and predicts all of them to one time.
#[derive(Clone, Debug)]
pub struct Situation {
    site: SiteName,
    frame: LocalFrame,
    /// The error that the whole site has in common.
    datum: Option<Datum>,
    tracks: BTreeMap<u64, KnownTrack>,
    /// The newest time heard from each fusion centre, by its area.
    newest: BTreeMap<Option<AreaName>, Timestamp>,
    now: Option<Timestamp>,
}

fn is_sure(state: TrackState) -> bool {
    matches!(state, TrackState::Confirmed | TrackState::Coasting | TrackState::OneCamera)
}

impl KnownTrack {
    /// Reads a track of a message; `None` if it has no position, or a number is not finite.
    fn parse(track: &Track, frame: &TrackFrame) -> Option<Self> {
        let covariance = <[f64; 36]>::try_from(track.covariance.as_slice()).ok()?;
        let known = Self {
            state: track.state(),
            time: Timestamp::from_nanos(frame.time_ns),
            time_sd_s: frame.time_sd_s,
            seen: Timestamp::from_nanos(track.updated_ns),
            position: track.position?.into(),
            velocity: track.velocity?.into(),
            covariance: Matrix6::from_row_slice(&covariance),
        };
        let mut numbers = known.position.iter().chain(&known.velocity).chain(&known.covariance);
        (numbers.all(|number| number.is_finite()) && known.time_sd_s.is_finite()).then_some(known)
    }

    /// The track predicted to another time at constant velocity, as a target on the Earth.
    fn at(&self, time: Timestamp, frame: &LocalFrame, datum: Option<&Datum>, id: u64) -> Target {
        let elapsed = time.seconds_since(self.time);
        let position = self.position + self.velocity * elapsed;
        // F = [I, dt I; 0, I], P = F P F' + datum
        let mut transition = Matrix6::identity();
        transition.fixed_view_mut::<3, 3>(0, 3).copy_from(&(Matrix3::identity() * elapsed));
        let mut covariance = transition * self.covariance * transition.transpose();
        if let Some(datum) = datum {
            covariance += datum.of_state(&position, &self.velocity, time);
        }
        // An error of the time moves the target along its velocity: P += v v' time_sd^2.
        let mut places = covariance.fixed_view_mut::<3, 3>(0, 0);
        places += self.velocity * self.velocity.transpose() * self.time_sd_s.powi(2);
        let place = frame.geodetic(position);
        // Turns the site's axes into east, north, up at the target.
        let turn = frame.axes_at(&LocalFrame::at(place));
        let mut turns = Matrix6::zeros();
        turns.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
        turns.fixed_view_mut::<3, 3>(3, 3).copy_from(&turn);
        Target {
            id,
            state: self.state,
            place,
            velocity: turn * self.velocity,
            covariance: turns * covariance * turns.transpose(),
            seen: self.seen,
        }
    }
}

impl Situation {
    /// A situation of a site whose origin is at an anchor, before anything was heard.
    pub fn new(site: SiteName, anchor: Geodetic) -> Self {
        let frame = LocalFrame::at(anchor);
        Self {
            site,
            frame,
            datum: None,
            tracks: BTreeMap::new(),
            newest: BTreeMap::new(),
            now: None,
        }
    }

    /// Takes in a calibration: the error that it states for the whole site is part of all tracks'
    /// covariances from then on.
    pub fn add_calibration(&mut self, calibration: &CameraCalibration) {
        let datum = calibration.datum.as_ref().and_then(|datum| datum.parse());
        self.datum = datum.or(self.datum.take());
    }

    /// Takes in the tracks of a fusion centre: that of `area`, if there are several. A track
    /// without a position, or with a number that is not finite, is left out.
    pub fn add_tracks(&mut self, area: Option<&AreaName>, frame: &TrackFrame) {
        let time = Timestamp::from_nanos(frame.time_ns);
        let area = area.cloned();
        if self.newest.get(&area).is_some_and(|newest| newest.seconds_since(time) > SILENCE_S) {
            // Time has gone back: a fusion centre that was restarted, or another replay. The tracks
            // so far belong to another time.
            self.tracks.clear();
            self.newest.clear();
            self.now = None;
        }
        if self.newest.len() < MOST_CENTRES || self.newest.contains_key(&area) {
            let newest = self.newest.entry(area).or_insert(time);
            *newest = time.max(*newest);
        }
        self.now = Some(self.now.map_or(time, |now| now.max(time)));
        for track in &frame.tracks {
            let was_sure = self.tracks.get(&track.id).is_some_and(|known| is_sure(known.state));
            let is_news = is_sure(track.state()) || was_sure;
            if !is_news || (!was_sure && self.tracks.len() >= MOST_TRACKS) {
                continue;
            }
            match (KnownTrack::parse(track, frame), self.tracks.get_mut(&track.id)) {
                (Some(known), _) => drop(self.tracks.insert(track.id, known)),
                // A lost track may come without its position.
                (None, Some(known)) => known.state = track.state(),
                (None, None) => {}
            }
        }
    }

    /// All targets at the newest time that was heard; `None` if nothing was heard yet. `silent_s`
    /// is how long the fusion centre has been silent since, s: after two seconds all its tracks are
    /// lost.
    pub fn snapshot(&mut self, silent_s: f64) -> Option<Snapshot> {
        let time = self.now?;
        for known in self.tracks.values_mut() {
            let unsaid_s = silent_s.max(time.seconds_since(known.time));
            if !is_sure(known.state) || unsaid_s > SILENCE_S {
                known.state = TrackState::Lost;
            }
        }
        let targets = self.tracks.iter().map(|(&id, known)| {
            // A lost target is not predicted: it stays where it was.
            let at = if known.state == TrackState::Lost { known.time } else { time };
            known.at(at, &self.frame, self.datum.as_ref(), id)
        });
        let targets = targets.collect();
        self.tracks.retain(|_, known| known.state != TrackState::Lost);
        Some(Snapshot { site: self.site.clone(), time, targets })
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use crossfix_message::Vector3 as WireVector;

    use super::*;

    const START: f64 = 1.79e9;

    fn situation() -> Situation {
        let anchor = Geodetic::from_degrees(48.0, 11.0, 500.0).unwrap();
        Situation::new("field".parse().unwrap(), anchor)
    }

    fn frame(time_s: f64, id: u64, state: TrackState, x: f64) -> TrackFrame {
        TrackFrame {
            time_ns: Timestamp::from_seconds(START + time_s).nanos(),
            time_sd_s: 0.01,
            tracks: vec![Track {
                id,
                state: state.into(),
                position: Some(WireVector { x, y: 0.0, z: 0.0 }),
                velocity: Some(WireVector { x: 10.0, y: 0.0, z: 0.0 }),
                covariance: (0..36).map(|k| if k % 7 == 0 { 0.04 } else { 0.0 }).collect(),
                ..Default::default()
            }],
            ..Default::default()
        }
    }

    #[test]
    fn all_tracks_are_said_at_one_time_with_what_it_is_off_by() {
        let mut situation = situation();
        assert_eq!(situation.snapshot(0.0), None);
        situation.add_tracks(None, &frame(0.0, 1, TrackState::Confirmed, 0.0));
        situation.add_tracks(None, &frame(0.5, 2, TrackState::Confirmed, 0.0));
        let snapshot = situation.snapshot(0.0).unwrap();
        assert_eq!(snapshot.time, Timestamp::from_seconds(START + 0.5));
        let [one, two] = &snapshot.targets[..] else { panic!("{snapshot:?}") };
        // One: 5 m east at 48 degrees north.
        assert_relative_eq!(one.place.longitude_deg(), 11.0 + 5.0 / 74_625.0, epsilon = 1e-7);
        assert_relative_eq!(two.place.longitude_deg(), 11.0, epsilon = 1e-12);
        // Variances: 0.2 m of position; for the first track also 0.2 m/s for half a second; 10 m/s
        // times 10 ms.
        let east = |target: &Target| target.place_sd_m().x;
        assert_relative_eq!(east(two), (0.04_f64 + 0.01).sqrt(), epsilon = 1e-9);
        assert_relative_eq!(east(one), (0.04_f64 + 0.01 + 0.01).sqrt(), epsilon = 1e-9);
    }

    #[test]
    fn a_lost_track_is_said_once_and_one_that_is_not_sure_never() {
        let mut situation = situation();
        situation.add_tracks(None, &frame(0.0, 1, TrackState::Tentative, 0.0));
        assert!(situation.snapshot(0.0).unwrap().targets.is_empty());
        situation.add_tracks(None, &frame(0.1, 1, TrackState::Confirmed, 0.0));
        assert_eq!(situation.snapshot(0.0).unwrap().targets[0].state, TrackState::Confirmed);
        situation.add_tracks(None, &frame(0.2, 1, TrackState::Lost, 0.0));
        assert_eq!(situation.snapshot(0.0).unwrap().targets[0].state, TrackState::Lost);
        assert!(situation.snapshot(0.0).unwrap().targets.is_empty());
    }

    #[test]
    fn tracks_of_a_fusion_centre_that_is_gone_are_lost() {
        let mut situation = situation();
        situation.add_tracks(None, &frame(0.0, 1, TrackState::Confirmed, 0.0));
        situation.add_tracks(None, &frame(3.0, 2, TrackState::Confirmed, 0.0));
        let states: Vec<_> =
            situation.snapshot(0.0).unwrap().targets.iter().map(|target| target.state).collect();
        assert_eq!(states, [TrackState::Lost, TrackState::Confirmed]);
    }

    #[test]
    fn tracks_of_a_fusion_centre_that_says_nothing_any_more_are_lost_once() {
        let mut situation = situation();
        situation.add_tracks(None, &frame(0.0, 1, TrackState::Confirmed, 0.0));
        assert_eq!(situation.snapshot(1.0).unwrap().targets[0].state, TrackState::Confirmed);
        assert_eq!(situation.snapshot(2.5).unwrap().targets[0].state, TrackState::Lost);
        assert!(situation.snapshot(3.5).unwrap().targets.is_empty());
    }

    #[test]
    fn where_time_goes_back_what_is_heard_then_counts() {
        let mut situation = situation();
        situation.add_tracks(None, &frame(100.0, 1, TrackState::Confirmed, 0.0));
        situation.add_tracks(None, &frame(0.0, 2, TrackState::Confirmed, 0.0));
        let snapshot = situation.snapshot(0.0).unwrap();
        assert_eq!(snapshot.time, Timestamp::from_seconds(START));
        assert_eq!(snapshot.targets.iter().map(|target| target.id).collect::<Vec<_>>(), [2]);
    }

    #[test]
    fn numbers_that_are_none_are_left_out() {
        let mut situation = situation();
        let mut bad = frame(0.0, 1, TrackState::Confirmed, f64::NAN);
        situation.add_tracks(None, &bad);
        bad.tracks[0].position = None;
        situation.add_tracks(None, &bad);
        assert!(situation.snapshot(0.0).unwrap().targets.is_empty());
    }
}
