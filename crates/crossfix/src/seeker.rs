//! A camera that searches for the targets that the fusion centre's cues name: where it should
//! point, and which of the tracks in its image is the target.
//!
//! The wide cameras hand a target over, the narrow one turns there, searches, and locks (Klochko's
//! first paper, chapter 2). A track is the target if it lies where the cue predicts, in the sum of
//! both covariances (equation 4.8 there). The head stares and does not chase: the detector takes
//! what is still in the image for background, and while the background moves through the image it
//! finds nothing.

mod place;

use std::f64::consts::TAU;

use crossfix_geometry::{CameraModel, PanTilt, ScanAngles};
use crossfix_message::{
    BearingTrack, CameraName, Cue, CueFrame, Cued, ImageTrackState, TakenOver, Timestamp,
};
use nalgebra::{Matrix2, Rotation3, Unit, Vector3};

use self::place::{PredictedDirection, long_axis, place_at, squared_distance};

/// Validity of a cue after it came, s of data time: as far as cues predict. With half of it a
/// camera that gets no cue for a second forgets its target.
const VALID_S: f64 = 2.0;
/// Gate on the squared Mahalanobis distance of a track from the cue's prediction, with the sum of
/// both covariances: P = 0.999 with two degrees of freedom. With half of it the target would be
/// missed in one image of thirty.
const GATE: f64 = 13.8;
/// A track is the target once it has been the likeliest for this many images: one could be chance,
/// as a bird passes through. Of evidence, not of time: with half of it one image of a bird would
/// do.
const IMAGES: u32 = 3;
/// The second-best track's squared distance must be larger by this much: its likelihood is then
/// twenty times smaller. With half of it 4.5 times would do, and a bird beside the target might be
/// taken for it.
const RUNNER_UP: f64 = 6.0;
/// How far the target may be from the image centre, as a fraction of the half view, before the head
/// turns again. With more of it a target that changes course leaves the image before the head has
/// turned; with less the head turns all the time.
const OFF_MIDDLE: f64 = 0.6;
/// How long a turn takes, s: while the head turns, the target may be further off by its way in this
/// time. With half of it a head that takes this long might be sent elsewhere on its way.
const TURN_S: f64 = 1.0;
/// A turn by less than this fraction of half the view shows nothing new. With half of it the camera
/// is more often blind for a turn that gains little.
const LEAST_TURN: f64 = 0.1;
/// The head aims at most this far ahead, s: targets change course. With twice as much it waits
/// where one that changes course never comes.
const LONGEST_LEAD_S: f64 = 1.5;
/// How long a head stares at each view of a search, s, counted from when it stands there: a
/// detector takes half a second to find what moves. With half of it a quarter of a second would be
/// left to recognise it.
const STARE_S: f64 = 1.5;
/// Spacing of the views of a search along the cue's error ellipse, as a fraction of the view. With
/// half of it a search has twice as many views; with twice as much there are gaps between them.
const STEP: f64 = 0.8;
/// The search reaches this many SDs to both sides along the ellipse's long axis: 19 of 20 targets
/// are there. With half of it one in three would lie beyond.
const SEARCHED_SDS: f64 = 2.0;
/// Of a search that would need more views than this, only the nearest are looked at. With half as
/// many a target farther along a long stripe is never looked at.
const MOST_VIEWS: i32 = 40;
/// A track not seen for this long is no longer a candidate, s: a detector misses one now and then.
/// With half of it the count of its images starts again after a gap of a third of a second.
const MISSED_S: f64 = 0.5;
/// A target found within this time is kept even if there is a cue of a surer target, s: time for a
/// turn and a stare. With half of it such a target would be left before the next view has been
/// looked at.
const FOUND_S: f64 = 4.0;
/// Most cues that are accepted: a fusion centre sends no more. With half of it the same.
const MOST_CUES: usize = 64;
/// Most times per cue that are accepted: a fusion centre sends no more. With half of it the same.
const MOST_TIMES: usize = 16;

/// Where a camera pointed when an image was exposed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pointed {
    /// Always the same way: it has no mount.
    Fixed,
    /// Unknown: its mount reports nothing.
    Unknown,
    /// Where its mount reports, while turning.
    Turning(ScanAngles),
    /// Where its mount reports, having stood still.
    Settled(ScanAngles),
}

/// A camera's mount, as an agent uses it.
pub trait Mount: Send {
    /// Tells the mount to turn to these angles, in the mount's own readings.
    fn aim(&mut self, angles: ScanAngles);

    /// Where the camera pointed in the newest image.
    fn pointed(&mut self) -> Pointed;

    /// Whether the mount currently obeys orders to turn.
    fn obeys(&self) -> bool {
        true
    }
}

/// Orders to a camera, given what it has seen.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Orders {
    /// Where the mount should point from now on.
    pub aim: Option<ScanAngles>,
    /// The camera's track that is the target of the cue.
    pub taken_over: Option<TakenOver>,
}

/// Progress of a search: the view along the error ellipse that is looked at.
#[derive(Clone, Copy, Debug)]
struct Search {
    view: i32,
    /// Since when the head has stood there; `None` while it turns there.
    since: Option<Timestamp>,
}

/// A track that may be the target, and the number of images for which it has been.
#[derive(Clone, Copy, Debug, PartialEq)]
struct CandidateTrack {
    image_track: u64,
    images: u32,
    seen: Timestamp,
}

/// Chooses a cue, points the camera at its target, and recognises the target's track.
#[derive(Debug)]
pub struct Seeker {
    mount: Option<PanTilt>,
    /// Standard deviation of each angle that the mount reports, rad.
    angle_sd_rad: f64,
    /// Half of the view's shorter side, and half of its diagonal, rad.
    half_view: f64,
    half_diagonal: f64,
    cues: CueFrame,
    /// The target looked for, and its last expected direction, in the frame at rest.
    of: Option<Cued>,
    last: Option<Unit<Vector3<f64>>>,
    candidate: Option<CandidateTrack>,
    /// When the target was last recognised, in this view or an earlier one.
    found: Option<Timestamp>,
    search: Option<Search>,
    holds: bool,
    /// The last order to the mount.
    ordered: Option<ScanAngles>,
}

impl Seeker {
    /// A seeker for a camera on a mount, or for one that stands still.
    pub fn new(model: &CameraModel, mount: Option<PanTilt>, angle_sd_rad: f64) -> Self {
        let lens = model.intrinsics();
        // Half view of a pinhole camera: tan a = (pixels / 2) / focal length.
        let half_view = |pixels: u32, focal: f64| (f64::from(pixels) / 2.0 / focal).atan();
        let half_view =
            half_view(lens.size.width, lens.fx).min(half_view(lens.size.height, lens.fy));
        let [x, y] = [f64::from(lens.size.width) / lens.fx, f64::from(lens.size.height) / lens.fy];
        let half_diagonal = (x.hypot(y) / 2.0).atan();
        Self {
            mount,
            angle_sd_rad,
            half_view,
            half_diagonal,
            cues: CueFrame::default(),
            of: None,
            last: None,
            candidate: None,
            found: None,
            search: None,
            holds: false,
            ordered: None,
        }
    }

    /// Takes in the fusion centre's cues; those beyond the limits are dropped or cut.
    pub fn take_cues(&mut self, cues: CueFrame) {
        self.cues = cues;
        self.cues.cues.truncate(MOST_CUES);
        self.cues.cues.retain(|cue| {
            let is_named =
                |of: &Cued| of.camera.is_empty() || of.camera.parse::<CameraName>().is_ok();
            cue.of.as_ref().is_some_and(is_named) && cue.ahead.len() <= MOST_TIMES
        });
    }

    /// Sets whether the mount cannot turn at present; the camera then goes on observing where it
    /// points.
    pub fn hold(&mut self, holds: bool) {
        self.holds = holds;
    }

    /// Orders for the camera, given the tracks of an image, its time by the camera's clock, and
    /// where it pointed then.
    pub fn observe(
        &mut self,
        time: Timestamp,
        pointed: Pointed,
        tracks: &[BearingTrack],
    ) -> Orders {
        let Some((cue, now)) = self.choose(time) else { return Orders::default() };
        self.last = Some(now.direction);
        let recognised = match pointed {
            Pointed::Fixed => {
                let at_rest = ScanAngles { azimuth: 0.0, elevation: 0.0 };
                self.recognise(&now, at_rest, tracks, time)
            }
            Pointed::Settled(angles) => self.recognise(&now, angles, tracks, time),
            Pointed::Unknown | Pointed::Turning(_) => None,
        };
        if recognised.is_some() {
            self.found = Some(time);
        }
        let mount = self.mount.filter(|_| !self.holds);
        let aim = mount.and_then(|mount| self.aim(&mount, pointed, &cue, &now, time));
        if aim.is_some() {
            // Nothing is known about tracks in another view.
            (self.candidate, self.ordered) = (None, aim);
        }
        let taken_over =
            recognised.map(|image_track_id| TakenOver { image_track_id, of: self.of.clone() });
        Orders { aim, taken_over }
    }

    /// The cue to follow, and the predicted place of its target: that of the present target; if
    /// that is gone, or its cue is of no track and has led to nothing while surer ones exist, the
    /// best other cue.
    fn choose(&mut self, time: Timestamp) -> Option<(Cue, PredictedDirection)> {
        let is_sure = |cue: &Cue| cue.of.as_ref().is_some_and(|of| of.track_id != 0);
        let is_found = self.found.is_some_and(|found| is_lately(found, time, FOUND_S));
        let reached: Vec<(&Cue, PredictedDirection)> = self
            .cues
            .cues
            .iter()
            .filter_map(|cue| Some((cue, place_at(cue, time)?)))
            .filter(|(cue, place)| is_valid(cue, time) && self.reaches(place))
            .collect();
        let sure = || reached.iter().filter(|(cue, _)| is_sure(cue));
        let same = reached.iter().find(|(cue, _)| cue.of == self.of);
        let same = same.filter(|(cue, _)| is_sure(cue) || is_found || sure().next().is_none());
        // When a single camera's target becomes a track its cue changes its name: the track nearest
        // to the last direction is assumed to be it.
        let away =
            |place: &PredictedDirection| self.last.map_or(TAU, |last| last.angle(&place.direction));
        let beside = sure().min_by(|a, b| away(&a.1).total_cmp(&away(&b.1)));
        let beside = beside.filter(|(_, place)| away(place) < self.half_view);
        let best = same.or(beside).or_else(|| sure().next()).or(reached.first());
        let (cue, place) = best.map(|(cue, place)| ((*cue).clone(), *place))?;
        if cue.of != self.of {
            (self.candidate, self.found, self.search) = (None, None, None);
            self.of = cue.of.clone();
        }
        Some((cue, place))
    }

    /// Whether a predicted place, within its uncertainty, can be brought into view.
    fn reaches(&self, place: &PredictedDirection) -> bool {
        let (_, long_sd) = long_axis(place);
        let (nearest, view) = match &self.mount {
            Some(mount) => (axis(mount, mount.aim(&place.direction)), self.half_view),
            None => (Vector3::z(), self.half_diagonal),
        };
        nearest.angle(&place.direction) < view + SEARCHED_SDS * long_sd
    }

    /// The track that has matched the cue's prediction for long enough, if any.
    fn recognise(
        &mut self,
        now: &PredictedDirection,
        angles: ScanAngles,
        tracks: &[BearingTrack],
        time: Timestamp,
    ) -> Option<u64> {
        let turned = self.mount.map_or_else(Rotation3::identity, |mount| turn_of(&mount, angles));
        let seen = tracks.iter().filter(|track| track.state() == ImageTrackState::Tracking);
        let angle_sd_rad = self.mount.map_or(0.0, |_| self.angle_sd_rad);
        let now = PredictedDirection {
            covariance: now.covariance + Matrix2::identity() * angle_sd_rad.powi(2),
            ..*now
        };
        let mut near: Vec<(f64, u64)> = seen
            .filter_map(|track| Some((squared_distance(&now, &turned, track)?, track.track_id)))
            .filter(|(squared, _)| *squared <= GATE)
            .collect();
        near.sort_by(|one, other| one.0.total_cmp(&other.0));
        // A track that has been recognised before stays the target while it is in the gate.
        let known = self.candidate.filter(|candidate| {
            candidate.images >= IMAGES && near.iter().any(|(_, id)| *id == candidate.image_track)
        });
        let clear = match near[..] {
            [(_, first)] => Some(first),
            [(nearest, first), (next, _), ..] if next > nearest + RUNNER_UP => Some(first),
            _ => None,
        };
        let Some(image_track) = known.map_or(clear, |candidate| Some(candidate.image_track)) else {
            // A detector misses a target now and then, so the candidate is kept for a while.
            self.candidate = self.candidate.filter(|before| is_lately(before.seen, time, MISSED_S));
            return None;
        };
        let before = self.candidate.filter(|before| before.image_track == image_track);
        let images = before.map_or(1, |before| before.images + 1);
        self.candidate = Some(CandidateTrack { image_track, images, seen: time });
        (images >= IMAGES).then_some(image_track)
    }

    /// Where to point from now on, if that differs from where it points or is about to.
    fn aim(
        &mut self,
        mount: &PanTilt,
        pointed: Pointed,
        cue: &Cue,
        now: &PredictedDirection,
        time: Timestamp,
    ) -> Option<ScanAngles> {
        let (angles, is_settled) = match pointed {
            Pointed::Settled(angles) => (angles, true),
            // While it turns, what counts is where it will stop.
            Pointed::Turning(angles) => (self.ordered.unwrap_or(angles), false),
            Pointed::Fixed | Pointed::Unknown => return None,
        };
        let (long_axis, long_sd) = long_axis(now);
        if long_sd * SEARCHED_SDS > self.half_view {
            // A view of the search begins once the head stands there.
            if !is_settled {
                return None;
            }
            return self.search(mount, angles, now, long_axis, long_sd, time);
        }
        self.search = None;
        let soon = place_at(cue, time.plus_seconds(0.5))?;
        let rate = now.direction.angle(&soon.direction) / 0.5;
        let on_its_way = if is_settled { 0.0 } else { rate * TURN_S };
        let may_be_off = OFF_MIDDLE * self.half_view + on_its_way;
        if now.direction.angle(&axis(mount, angles)) < may_be_off {
            return None;
        }
        // Aim ahead of the target by the time it takes to cross the permitted part of half the
        // view, so that it enters on one side and leaves on the other.
        let lead_s = (OFF_MIDDLE * self.half_view / rate.max(1e-6)).min(LONGEST_LEAD_S);
        let there = place_at(cue, time.plus_seconds(lead_s))?;
        self.worth_turning(mount, angles, mount.aim(&there.direction))
    }

    /// An aim, if it changes the view enough. If the target is out of the mount's range and the
    /// head is already as near as it gets, there is none.
    fn worth_turning(
        &self,
        mount: &PanTilt,
        angles: ScanAngles,
        aim: ScanAngles,
    ) -> Option<ScanAngles> {
        let turn = axis(mount, aim).angle(&axis(mount, angles));
        (turn > LEAST_TURN * self.half_view).then_some(aim)
    }

    /// The next view of a search along the ellipse's long axis, from the middle outwards to both
    /// ends, and then again.
    fn search(
        &mut self,
        mount: &PanTilt,
        angles: ScanAngles,
        now: &PredictedDirection,
        axis: Vector3<f64>,
        long_sd: f64,
        time: Timestamp,
    ) -> Option<ScanAngles> {
        // A recognised target is stared at: with a second camera its position will soon be known.
        if self.candidate.is_some() || self.found.is_some_and(|f| is_lately(f, time, STARE_S)) {
            return None;
        }
        let step = 2.0 * self.half_view * STEP;
        let ends = (((long_sd * SEARCHED_SDS) / step).ceil() as i32).min(MOST_VIEWS / 2);
        let view = match &mut self.search {
            None => 0,
            Some(search) => {
                let since = *search.since.get_or_insert(time);
                if time.seconds_since(since) < STARE_S {
                    return None;
                }
                (search.view + 1) % (2 * ends + 1)
            }
        };
        self.search = Some(Search { view, since: None });
        // Offsets in views: 0, 1, -1, 2, -2, ...
        let side = if view % 2 == 1 { 1.0 } else { -1.0 };
        let offset = side * f64::from((view + 1) / 2) * step;
        // Turning about direction x axis moves the view along the long axis.
        let turn = Rotation3::new(now.direction.cross(&axis) * offset);
        self.worth_turning(mount, angles, mount.aim(&(turn * now.direction)))
    }
}

/// Optical axis with the mount at these angles, in the camera's frame at rest.
fn axis(mount: &PanTilt, angles: ScanAngles) -> Vector3<f64> {
    turn_of(mount, angles) * Vector3::z()
}

/// Whether `then` lies at most `seconds` before `now`.
fn is_lately(then: Timestamp, now: Timestamp, seconds: f64) -> bool {
    (0.0..=seconds).contains(&now.seconds_since(then))
}

/// Whether a cue's first time lies within [`VALID_S`] of a time.
fn is_valid(cue: &Cue, time: Timestamp) -> bool {
    let said = cue.ahead.first().map(|first| Timestamp::from_nanos(first.time_ns));
    said.is_some_and(|said| time.seconds_since(said).abs() <= VALID_S)
}

/// Rotation from the camera's frame as turned to its frame at rest.
fn turn_of(mount: &PanTilt, angles: ScanAngles) -> Rotation3<f64> {
    mount.rest().rotation().inverse() * mount.pose(angles).rotation()
}

#[cfg(test)]
mod tests;
