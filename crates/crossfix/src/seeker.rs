//! A camera that looks for what the fusion centre tells it to look for: where it should point, and
//! which of the tracks in its image is the target.
//!
//! The wide cameras hand a target over, the narrow one turns there, searches, and locks (Klochko's
//! first paper, chapter 2). A track is the target if it is where the cue has it, by both covariances
//! together (equation 4.8 there). The head stares and does not chase: what stands still against the
//! sky is the sky, and a detector that sees the sky go by finds nothing.

mod place;

use std::f64::consts::TAU;

use crossfix_geometry::{CameraModel, PanTilt, ScanAngles};
use crossfix_message::{
    BearingTrack, CameraName, Cue, CueFrame, Cued, ImageTrackState, TakenOver, Timestamp,
};
use nalgebra::{Matrix2, Rotation3, Unit, Vector3};

use self::place::{Place, long_axis, place_at, squared_distance};

/// Cues hold for so long after the last one came, s of data time: as far as they look ahead.
const VALID_S: f64 = 2.0;
/// A track may be the target if it lies within this of where the cue has it, squared in the
/// deviations of both: P = 0.999 of two degrees of freedom.
const GATE: f64 = 13.8;
/// It is the target if it has been the likeliest for so many images: one is chance, as a bird passes
/// through.
const IMAGES: u32 = 3;
/// Another must be so much less likely, squared in the deviations: twenty times.
const RUNNER_UP: f64 = 6.0;
/// The target may leave the middle by so much of the way to the image's border before the head
/// turns again. With more of it a target that turns has left the image before the head has; with
/// less it turns all the time.
const OFF_MIDDLE: f64 = 0.6;
/// A turn by less than this of half the view shows nothing new.
const LEAST_TURN: f64 = 0.1;
/// The head aims so far ahead at most, s: targets turn.
const LONGEST_LEAD_S: f64 = 1.5;
/// How long a head stares where a target may be, s, before it looks at the next place of a stripe, from
/// when it stands there: a detector takes half a second to find what moves.
const STARE_S: f64 = 1.5;
/// Views of a stripe lie so close together, as a share of the view.
const STEP: f64 = 0.8;
/// A stripe is looked along to so many deviations on both sides: 19 of 20 targets are there.
const SEARCHED_SDS: f64 = 2.0;
/// A stripe of more views than this has its nearest ones looked at.
const MOST_VIEWS: i32 = 40;
/// What has not been seen for so long is seen no more, s: a detector misses one now and then.
const MISSED_S: f64 = 0.5;
/// What was found so lately is still what it looks for, s, though a surer target is told of: a turn and
/// a stare.
const FOUND_S: f64 = 4.0;
/// More cues, or more times of one, than a fusion centre tells are of none.
const MOST_CUES: usize = 64;
const MOST_TIMES: usize = 16;

/// Where a camera pointed in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pointed {
    /// Where it always does: nothing turns it.
    Fixed,
    /// Nobody knows: its mount says nothing.
    Unknown,
    /// Where its mount says, which turns it.
    Turning(ScanAngles),
    /// Where its mount says, which stood still.
    Settled(ScanAngles),
}

/// What turns a camera, as an agent sees it.
pub trait Mount: Send {
    /// Tells it to turn to where it says that these angles are.
    fn aim(&mut self, angles: ScanAngles);

    /// Where it pointed in the newest image.
    fn pointed(&mut self) -> Pointed;

    /// Whether it turns where it is told at present.
    fn obeys(&self) -> bool {
        true
    }
}

/// What a camera should do, by what it has seen.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Orders {
    /// Where its mount should point from now on.
    pub aim: Option<ScanAngles>,
    /// Which of its tracks is what it was told to look for.
    pub taken_over: Option<TakenOver>,
}

/// The view along a stripe that is looked at.
#[derive(Clone, Copy, Debug)]
struct Search {
    view: i32,
    /// Since when the head has stood there; `None` on its way.
    since: Option<Timestamp>,
}

/// A track that may be the target.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Candidate {
    image_track: u64,
    images: u32,
    seen: Timestamp,
}

/// Looks for what it is told to look for.
#[derive(Debug)]
pub struct Seeker {
    mount: Option<PanTilt>,
    /// What each angle that the mount says is off by, rad.
    angle_sd_rad: f64,
    /// Half of the shorter side of the view, and of its diagonal, rad.
    half_view: f64,
    half_diagonal: f64,
    cues: CueFrame,
    /// What it is on, and where that was last, in the frame at rest.
    of: Option<Cued>,
    last: Option<Unit<Vector3<f64>>>,
    candidate: Option<Candidate>,
    /// When it was found last, in this view or in one before.
    found: Option<Timestamp>,
    search: Option<Search>,
    holds: bool,
    /// Where its mount was told to point last.
    ordered: Option<ScanAngles>,
}

impl Seeker {
    /// For a camera that a mount turns, or that stands still.
    pub fn new(model: &CameraModel, mount: Option<PanTilt>, angle_sd_rad: f64) -> Self {
        let lens = model.intrinsics();
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

    /// Takes in what the fusion centre says; what it never would is no cue.
    pub fn hear(&mut self, cues: CueFrame) {
        self.cues = cues;
        self.cues.cues.truncate(MOST_CUES);
        self.cues.cues.retain(|cue| {
            let is_named =
                |of: &Cued| of.camera.is_empty() || of.camera.parse::<CameraName>().is_ok();
            cue.of.as_ref().is_some_and(is_named) && cue.ahead.len() <= MOST_TIMES
        });
    }

    /// Its mount does not turn at present: it sees on where it is.
    pub fn hold(&mut self, holds: bool) {
        self.holds = holds;
    }

    /// What to do, by the tracks of an image that was taken at a time by the camera's clock, and where
    /// it pointed then.
    pub fn look(&mut self, time: Timestamp, pointed: Pointed, tracks: &[BearingTrack]) -> Orders {
        let Some((cue, now)) = self.choose(time) else { return Orders::default() };
        self.last = Some(now.direction);
        let taken = match pointed {
            Pointed::Fixed => {
                let at_rest = ScanAngles { azimuth: 0.0, elevation: 0.0 };
                self.recognise(&now, at_rest, tracks, time)
            }
            Pointed::Settled(angles) => self.recognise(&now, angles, tracks, time),
            Pointed::Unknown | Pointed::Turning(_) => None,
        };
        if taken.is_some() {
            self.found = Some(time);
        }
        let mount = self.mount.filter(|_| !self.holds);
        let aim = mount.and_then(|mount| self.aim(&mount, pointed, &cue, &now, time));
        if aim.is_some() {
            // Of another view nothing is known.
            (self.candidate, self.ordered) = (None, aim);
        }
        let taken_over =
            taken.map(|image_track_id| TakenOver { image_track_id, of: self.of.clone() });
        Orders { aim, taken_over }
    }

    /// The cue of what it is on, and where that is; if there is none any more, or it is a poor one that
    /// nothing was found of, of what is best looked for.
    fn choose(&mut self, time: Timestamp) -> Option<(Cue, Place)> {
        let is_sure = |cue: &Cue| cue.of.as_ref().is_some_and(|of| of.track_id != 0);
        let is_found = self.found.is_some_and(|found| is_lately(found, time, FOUND_S));
        let reached: Vec<(&Cue, Place)> = self
            .cues
            .cues
            .iter()
            .filter_map(|cue| Some((cue, place_at(cue, time)?)))
            .filter(|(cue, place)| is_valid(cue, time) && self.reaches(place))
            .collect();
        let sure = || reached.iter().filter(|(cue, _)| is_sure(cue));
        let same = reached.iter().find(|(cue, _)| cue.of == self.of);
        let same = same.filter(|(cue, _)| is_sure(cue) || is_found || sure().next().is_none());
        // What one camera saw becomes a track, and what it is on has another name: it is where it was.
        let away = |place: &Place| self.last.map_or(TAU, |last| last.angle(&place.direction));
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

    /// Whether a place can be brought into view.
    fn reaches(&self, place: &Place) -> bool {
        let (_, long_sd) = long_axis(place);
        let (nearest, view) = match &self.mount {
            Some(mount) => (axis(mount, mount.aim(&place.direction)), self.half_view),
            None => (Vector3::z(), self.half_diagonal),
        };
        nearest.angle(&place.direction) < view + SEARCHED_SDS * long_sd
    }

    /// The track that is where the cue has the target, if it has been for some images.
    fn recognise(
        &mut self,
        now: &Place,
        angles: ScanAngles,
        tracks: &[BearingTrack],
        time: Timestamp,
    ) -> Option<u64> {
        let turned = self.mount.map_or_else(Rotation3::identity, |mount| turn_of(&mount, angles));
        let seen = tracks.iter().filter(|track| track.state() == ImageTrackState::Tracking);
        let angle_sd_rad = self.mount.map_or(0.0, |_| self.angle_sd_rad);
        let now = Place {
            covariance: now.covariance + Matrix2::identity() * angle_sd_rad.powi(2),
            ..*now
        };
        let mut near: Vec<(f64, u64)> = seen
            .filter_map(|track| Some((squared_distance(&now, &turned, track)?, track.track_id)))
            .filter(|(squared, _)| *squared <= GATE)
            .collect();
        near.sort_by(|one, other| one.0.total_cmp(&other.0));
        // What it has recognised before stays the target while it is there.
        let known = self.candidate.filter(|candidate| {
            candidate.images >= IMAGES && near.iter().any(|(_, id)| *id == candidate.image_track)
        });
        let clear = match near[..] {
            [(_, first)] => Some(first),
            [(nearest, first), (next, _), ..] if next > nearest + RUNNER_UP => Some(first),
            _ => None,
        };
        let Some(image_track) = known.map_or(clear, |candidate| Some(candidate.image_track)) else {
            // A detector misses one now and then.
            self.candidate = self.candidate.filter(|before| is_lately(before.seen, time, MISSED_S));
            return None;
        };
        let before = self.candidate.filter(|before| before.image_track == image_track);
        let images = before.map_or(1, |before| before.images + 1);
        self.candidate = Some(Candidate { image_track, images, seen: time });
        (images >= IMAGES).then_some(image_track)
    }

    /// Where to point from now on, if that is elsewhere than where it does or soon will.
    fn aim(
        &mut self,
        mount: &PanTilt,
        pointed: Pointed,
        cue: &Cue,
        now: &Place,
        time: Timestamp,
    ) -> Option<ScanAngles> {
        let (angles, is_settled) = match pointed {
            Pointed::Settled(angles) => (angles, true),
            // While it turns, what counts is where it will stand.
            Pointed::Turning(angles) => (self.ordered.unwrap_or(angles), false),
            Pointed::Fixed | Pointed::Unknown => return None,
        };
        let (long_axis, long_sd) = long_axis(now);
        if long_sd * SEARCHED_SDS > self.half_view {
            // A view along a stripe is looked at once the head is there.
            let stripe = Some((long_axis, long_sd)).filter(|_| is_settled);
            return stripe.and_then(|stripe| self.search(mount, angles, now, stripe, time));
        }
        self.search = None;
        let soon = place_at(cue, time.plus_seconds(0.5))?;
        let rate = now.direction.angle(&soon.direction) / 0.5;
        let may_be_off = OFF_MIDDLE * self.half_view + if is_settled { 0.0 } else { rate };
        if now.direction.angle(&axis(mount, angles)) < may_be_off {
            return None;
        }
        // It comes in on one side and leaves on the other.
        let lead_s = (OFF_MIDDLE * self.half_view / rate.max(1e-6)).min(LONGEST_LEAD_S);
        let there = place_at(cue, time.plus_seconds(lead_s))?;
        self.worth_turning(mount, angles, mount.aim(&there.direction))
    }

    /// An aim, if it shows something else; where a target is as near as the mount brings it already, none
    /// does.
    fn worth_turning(
        &self,
        mount: &PanTilt,
        angles: ScanAngles,
        aim: ScanAngles,
    ) -> Option<ScanAngles> {
        let turn = axis(mount, aim).angle(&axis(mount, angles));
        (turn > LEAST_TURN * self.half_view).then_some(aim)
    }

    /// The next view along a stripe, from the middle to both ends and again.
    fn search(
        &mut self,
        mount: &PanTilt,
        angles: ScanAngles,
        now: &Place,
        (axis, long_sd): (Vector3<f64>, f64),
        time: Timestamp,
    ) -> Option<ScanAngles> {
        // What is recognised is stared at: two cameras together will soon know where it is.
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
        // 0, 1, -1, 2, -2, ...
        let side = if view % 2 == 1 { 1.0 } else { -1.0 };
        let offset = side * f64::from((view + 1) / 2) * step;
        let turn = Rotation3::new(now.direction.cross(&axis) * offset);
        self.worth_turning(mount, angles, mount.aim(&(turn * now.direction)))
    }
}

/// Where the camera looks along with its mount at angles, in its frame at rest.
fn axis(mount: &PanTilt, angles: ScanAngles) -> Vector3<f64> {
    turn_of(mount, angles) * Vector3::z()
}

/// Whether a time lies no more than so many seconds back.
fn is_lately(then: Timestamp, now: Timestamp, seconds: f64) -> bool {
    (0.0..=seconds).contains(&now.seconds_since(then))
}

/// Whether a cue is of about now.
fn is_valid(cue: &Cue, time: Timestamp) -> bool {
    let said = cue.ahead.first().map(|first| Timestamp::from_nanos(first.time_ns));
    said.is_some_and(|said| time.seconds_since(said).abs() <= VALID_S)
}

/// From the camera's frame as it is turned to that at rest.
fn turn_of(mount: &PanTilt, angles: ScanAngles) -> Rotation3<f64> {
    mount.rest().rotation().inverse() * mount.pose(angles).rotation()
}

#[cfg(test)]
mod tests;
