//! A camera that looks for what the fusion centre tells it to look for: where it should point, and
//! which of the tracks in its image is the target.
//!
//! The wide cameras hand a target over, the narrow one turns there, searches, and locks (Klochko's
//! first paper, chapter 2). A track is the target if it is where the cue has it, by both covariances
//! together (equation 4.8 there). The head stares and does not chase: what stands still against the
//! sky is the sky, and a detector that sees the sky go by finds nothing.

use std::f64::consts::TAU;

use crossfix_geometry::{CameraModel, PanTilt, ScanAngles, tangent_basis, turn_vector};
use crossfix_message::{
    BearingTrack, CameraName, Cue, CueFrame, Cued, Expected, ImageTrackState, TakenOver, Timestamp,
};
use nalgebra::{Matrix2, Rotation3, SymmetricEigen, Unit, Vector2, Vector3};

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
}

/// Where something should be at a time, in the camera's frame at rest.
#[derive(Clone, Copy, Debug)]
struct Place {
    direction: Unit<Vector3<f64>>,
    /// Along the tangents of the direction, rad^2.
    covariance: Matrix2<f64>,
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
}

/// Looks for what it is told to look for.
#[derive(Debug)]
pub struct Seeker {
    mount: Option<PanTilt>,
    /// What each angle that the mount says is off by, rad.
    angle_sd_rad: f64,
    /// Half of the shorter side of the view, rad.
    half_view: f64,
    cues: CueFrame,
    /// What it is on, and where that was last, in the frame at rest.
    of: Option<Cued>,
    last: Option<Unit<Vector3<f64>>>,
    candidate: Option<Candidate>,
    search: Option<Search>,
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
        Self {
            mount,
            angle_sd_rad,
            half_view,
            cues: CueFrame::default(),
            of: None,
            last: None,
            candidate: None,
            search: None,
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

    /// What to do, by the tracks of an image that was taken at a time by the camera's clock, and where
    /// it pointed then.
    pub fn look(&mut self, time: Timestamp, pointed: Pointed, tracks: &[BearingTrack]) -> Orders {
        let Some((cue, now)) = self.choose(time) else { return Orders::default() };
        self.last = Some(now.direction);
        let taken = match pointed {
            Pointed::Fixed => {
                self.recognise(&now, ScanAngles { azimuth: 0.0, elevation: 0.0 }, tracks)
            }
            Pointed::Settled(angles) => self.recognise(&now, angles, tracks),
            Pointed::Unknown | Pointed::Turning(_) => None,
        };
        let aim = self.mount.and_then(|mount| self.aim(&mount, pointed, &cue, &now, time));
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
        let is_found = self.candidate.is_some_and(|candidate| candidate.images >= IMAGES);
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
            (self.candidate, self.search) = (None, None);
            self.of = cue.of.clone();
        }
        Some((cue, place))
    }

    /// Whether a place can be brought into view.
    fn reaches(&self, place: &Place) -> bool {
        let Some(mount) = &self.mount else { return true };
        let nearest = axis(mount, mount.aim(&place.direction));
        let (_, long_sd) = long_axis(place);
        nearest.angle(&place.direction) < self.half_view + SEARCHED_SDS * long_sd
    }

    /// The track that is where the cue has the target, if it has been for some images.
    fn recognise(
        &mut self,
        now: &Place,
        angles: ScanAngles,
        tracks: &[BearingTrack],
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
        let image_track = known.map_or(clear, |candidate| Some(candidate.image_track));
        self.candidate = image_track.map(|image_track| {
            let before = self.candidate.filter(|before| before.image_track == image_track);
            Candidate { image_track, images: before.map_or(1, |before| before.images + 1) }
        });
        self.candidate
            .filter(|candidate| candidate.images >= IMAGES)
            .map(|candidate| candidate.image_track)
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
        if self.candidate.is_some() {
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

/// Whether a cue is of about now.
fn is_valid(cue: &Cue, time: Timestamp) -> bool {
    let said = cue.ahead.first().map(|first| Timestamp::from_nanos(first.time_ns));
    said.is_some_and(|said| time.seconds_since(said).abs() <= VALID_S)
}

/// From the camera's frame as it is turned to that at rest.
fn turn_of(mount: &PanTilt, angles: ScanAngles) -> Rotation3<f64> {
    mount.rest().rotation().inverse() * mount.pose(angles).rotation()
}

/// The longer axis of where something may be, and its deviation, rad.
fn long_axis(place: &Place) -> (Vector3<f64>, f64) {
    let axes = SymmetricEigen::new(place.covariance);
    let (index, variance) = axes.eigenvalues.argmax();
    let axis = tangent_basis(&place.direction) * axes.eigenvectors.column(index);
    (axis, variance.max(0.0).sqrt())
}

/// How far a track is from where something should be, squared in the deviations of both.
fn squared_distance(
    expected: &Place,
    turned: &Rotation3<f64>,
    track: &BearingTrack,
) -> Option<f64> {
    let own = Unit::try_new(Vector3::from(track.bearing?), 1e-6)?;
    let direction = turned * own;
    let tangents = tangent_basis(&expected.direction).transpose();
    let turn = Rotation3::rotation_between(&expected.direction, &direction)?;
    let offset: Vector2<f64> = tangents * turn_vector(&turn).cross(&expected.direction);
    let [xx, xy, yy] = [track.covariance_xx, track.covariance_xy, track.covariance_yy];
    // The track's tangents as they lie in those of the expectation.
    let carried = turn.inverse() * (turned.matrix() * tangent_basis(&own));
    let to_expected = tangents * carried;
    let own = to_expected * Matrix2::new(xx, xy, xy, yy) * to_expected.transpose();
    let squared = offset.dot(&((expected.covariance + own).try_inverse()? * offset));
    (squared >= 0.0).then_some(squared)
}

/// Where a cue has its target at a time: between what it says of the times about it.
fn place_at(cue: &Cue, time: Timestamp) -> Option<Place> {
    let seconds = |one: &Expected| Timestamp::from_nanos(one.time_ns).seconds_since(time);
    let after = cue.ahead.iter().position(|one| seconds(one) >= 0.0);
    let after = after.unwrap_or(cue.ahead.len().checked_sub(1)?).max(1);
    let [Some(one), other] = [cue.ahead.get(after - 1), cue.ahead.get(after)] else { return None };
    let (from, to) = (read(one)?, read(other.unwrap_or(one))?);
    let (from_s, to_s) = (seconds(one), other.map_or(0.0, seconds));
    let share = if to_s > from_s { -from_s / (to_s - from_s) } else { 0.0 };
    // What is earlier than it says is as it says.
    let share = share.clamp(0.0, 1.5);
    let turn = Rotation3::rotation_between(&from.direction, &to.direction)?;
    let part = Rotation3::new(turn_vector(&turn) * share);
    Some(Place {
        direction: part * from.direction,
        covariance: from.covariance * (1.0 - share.min(1.0)) + to.covariance * share.min(1.0),
    })
}

fn read(expected: &Expected) -> Option<Place> {
    let direction = Unit::try_new(Vector3::from(expected.bearing?), 1e-6)?;
    let [xx, xy, yy] = [expected.covariance_xx, expected.covariance_xy, expected.covariance_yy];
    let covariance = Matrix2::new(xx, xy, xy, yy);
    let possible = covariance.cholesky().is_some() && covariance.trace() < TAU.powi(2);
    let finite = direction.iter().all(|part| part.is_finite());
    (possible && finite).then_some(Place { direction, covariance })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

    use crossfix_geometry::{Distortion, ImageSize, Intrinsics, Pose};
    use nalgebra::Point3;

    use super::*;

    fn model() -> CameraModel {
        CameraModel::new(Intrinsics {
            size: ImageSize { width: 640, height: 480 },
            fx: 3000.0,
            fy: 3000.0,
            cx: 319.5,
            cy: 239.5,
            distortion: Distortion::None,
        })
        .unwrap()
    }

    fn mount() -> PanTilt {
        let rest = Pose::looking_at(Point3::origin(), Point3::new(0.0, 100.0, 0.0)).unwrap();
        PanTilt::new(rest, [-3.0, 3.0], [-0.3, 1.4]).unwrap()
    }

    /// A cue of track 7 that turns to the left, of a time; `sds` along both tangents, rad.
    fn cue(time_s: f64, azimuth: f64, rate: f64, sds: [f64; 2]) -> CueFrame {
        let ahead = [0.0, 0.25, 0.5, 1.0, 2.0].map(|ahead_s| {
            let paper = ScanAngles { azimuth: azimuth + rate * ahead_s, elevation: 0.2 }.bearing();
            Expected {
                time_ns: Timestamp::from_seconds(time_s + ahead_s).nanos(),
                bearing: Some(crossfix_geometry::camera_from_paper(paper.into_inner()).into()),
                covariance_xx: sds[0].powi(2),
                covariance_xy: 0.0,
                covariance_yy: sds[1].powi(2),
            }
        });
        let of = Some(Cued { track_id: 7, ..Default::default() });
        let cue = Cue { of, ahead: ahead.to_vec(), range_m: 100.0, log_range_sd: 0.01 };
        CueFrame { cues: vec![cue], ..Default::default() }
    }

    /// A track that a head at angles sees where angles of the frame at rest are.
    fn track(id: u64, at: ScanAngles, azimuth: f64, elevation: f64) -> BearingTrack {
        let paper = ScanAngles { azimuth, elevation }.bearing().into_inner();
        let direction = crossfix_geometry::camera_from_paper(paper);
        BearingTrack {
            track_id: id,
            bearing: Some((turn_of(&mount(), at).inverse() * direction).into()),
            covariance_xx: 1e-8,
            covariance_yy: 1e-8,
            state: ImageTrackState::Tracking.into(),
            ..Default::default()
        }
    }

    fn seconds(t: f64) -> Timestamp {
        Timestamp::from_seconds(t)
    }

    const REST: ScanAngles = ScanAngles { azimuth: 0.0, elevation: 0.0 };

    #[test]
    fn it_turns_ahead_of_the_target_and_stares_while_that_crosses_the_view() {
        let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
        assert_eq!(seeker.look(seconds(0.9), Pointed::Settled(REST), &[]), Orders::default());
        seeker.hear(cue(1.0, 0.8, 0.05, [1e-3; 2]));
        let aim = seeker.look(seconds(1.0), Pointed::Settled(REST), &[]).aim.unwrap();
        assert!(aim.azimuth > 0.82 && aim.azimuth < 0.88, "{aim:?}");
        assert!((aim.elevation - 0.2).abs() < 1e-4);
        // On the way it is told nothing else, but where the target is quite elsewhere; and there it
        // stays until the target is past.
        let half = ScanAngles { azimuth: 0.4, elevation: 0.1 };
        assert_eq!(seeker.look(seconds(1.1), Pointed::Turning(half), &[]).aim, None);
        seeker.hear(cue(1.1, -0.8, 0.05, [1e-3; 2]));
        let other = seeker.look(seconds(1.1), Pointed::Turning(half), &[]).aim.unwrap();
        assert!(other.azimuth < -0.7, "{other:?}");
        seeker.hear(cue(1.1, 0.805, 0.05, [1e-3; 2]));
        let aim = seeker.look(seconds(1.1), Pointed::Turning(half), &[]).aim.unwrap();
        assert!((aim.azimuth - 0.854).abs() < 1e-3, "{aim:?}");
        let turned: Vec<f64> = (0..40)
            .map(|k| 1.2 + 0.1 * f64::from(k))
            .filter(|&t| {
                seeker.hear(cue(t, 0.8 + 0.05 * (t - 1.0), 0.05, [1e-3; 2]));
                seeker.look(seconds(t), Pointed::Settled(aim), &[]).aim.is_some()
            })
            .collect();
        assert!((2.5..3.3).contains(&turned[0]), "{turned:?}");
    }

    #[test]
    fn a_track_is_taken_over_when_it_has_been_where_the_cue_is_for_three_images() {
        let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
        seeker.hear(cue(1.0, 0.5, 0.0, [1e-3; 2]));
        let at = ScanAngles { azimuth: 0.48, elevation: 0.21 };
        let look = |seeker: &mut Seeker, tracks: &[BearingTrack]| {
            let orders = seeker.look(seconds(1.1), Pointed::Settled(at), tracks);
            orders.taken_over.map(|taken| (taken.image_track_id, taken.of.unwrap().track_id))
        };
        let (target, bird) = (track(3, at, 0.5005, 0.2), track(4, at, 0.47, 0.2));
        assert_eq!(look(&mut seeker, &[bird, target]), None);
        assert_eq!(look(&mut seeker, &[bird, target]), None);
        assert_eq!(look(&mut seeker, &[bird, target]), Some((3, 7)));
        // One that passes as near is no rival any more; one that was there from the first is.
        let rival = track(5, at, 0.4998, 0.2);
        assert_eq!(look(&mut seeker, &[rival, target]), Some((3, 7)));
        let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
        seeker.hear(cue(1.0, 0.5, 0.0, [1e-3; 2]));
        assert!((0..10).all(|_| look(&mut seeker, &[rival, target]).is_none()));
    }

    #[test]
    fn a_stripe_is_looked_along_from_its_middle_to_both_ends() {
        let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
        let (mut at, mut views) = (REST, Vec::new());
        for k in 0..200 {
            let t = 0.1 * f64::from(k);
            seeker.hear(cue(t, 0.6, 0.0, [0.3, 1e-3]));
            if let Some(aim) = seeker.look(seconds(t), Pointed::Settled(at), &[]).aim {
                at = aim;
                views.push(aim.azimuth - 0.6);
            }
        }
        let reach = views.iter().fold(0.0f64, |most, view| most.max(view.abs()));
        assert!((0.5..0.75).contains(&reach), "{views:?}");
        assert!(views[0].abs() < 1e-6 && views[1] * views[2] < 0.0, "{views:?}");
        let mut sorted = views[..9].to_vec();
        sorted.sort_by(f64::total_cmp);
        // No gaps: the view is 160 mrad high.
        assert!(sorted.windows(2).all(|two| two[1] - two[0] < 0.16), "{sorted:?}");
        // What is seen on it is stared at.
        let seen = track(9, at, at.azimuth, at.elevation);
        let looks = (0..60).map(|k| 20.0 + 0.1 * f64::from(k));
        let orders: Vec<Orders> = looks
            .map(|t| {
                seeker.hear(cue(t, 0.6, 0.0, [0.3, 1e-1]));
                seeker.look(seconds(t), Pointed::Settled(at), &[seen])
            })
            .collect();
        assert!(orders.iter().skip(3).all(|orders| orders.aim.is_none()));
        assert_eq!(orders[5].taken_over.as_ref().unwrap().image_track_id, 9);
    }

    #[test]
    fn old_and_impossible_cues_move_nothing() {
        let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
        seeker.hear(cue(1.0, 0.8, 0.05, [1e-3; 2]));
        assert_eq!(seeker.look(seconds(4.0), Pointed::Settled(REST), &[]), Orders::default());
        let spoil: [fn(&mut Expected); 5] = [
            |one| one.bearing = None,
            |one| one.bearing = Some(Vector3::zeros().into()),
            |one| one.bearing = Some(Vector3::new(f64::NAN, 0.0, 1.0).into()),
            |one| one.covariance_xx = f64::INFINITY,
            |one| one.covariance_yy = -1.0,
        ];
        for spoil in spoil {
            let mut cues = cue(1.0, 0.8, 0.05, [1e-3; 2]);
            cues.cues[0].ahead.iter_mut().for_each(spoil);
            seeker.hear(cues);
            assert_eq!(seeker.look(seconds(1.0), Pointed::Settled(REST), &[]), Orders::default());
        }
        let mut empty = cue(1.0, 0.8, 0.05, [1e-3; 2]);
        empty.cues[0].ahead.clear();
        seeker.hear(empty);
        assert_eq!(seeker.look(seconds(1.0), Pointed::Settled(REST), &[]), Orders::default());
    }

    #[test]
    fn a_camera_that_stands_still_takes_over_and_turns_nothing() {
        let mut seeker = Seeker::new(&model(), None, 0.0);
        seeker.hear(cue(1.0, 0.02, 0.0, [1e-3; 2]));
        let seen = track(3, REST, 0.02, 0.2);
        let orders: Vec<Orders> =
            (0..3).map(|_| seeker.look(seconds(1.1), Pointed::Fixed, &[seen])).collect();
        assert!(orders.iter().all(|orders| orders.aim.is_none()));
        assert_eq!(orders[2].taken_over.as_ref().unwrap().image_track_id, 3);
    }

    /// The angles that a mount says are off by a good deal more than the cue is.
    #[test]
    fn what_the_angles_are_off_by_widens_the_gate() {
        for (angle_sd_rad, taken) in [(0.0, false), (3e-3, true)] {
            let mut seeker = Seeker::new(&model(), Some(mount()), angle_sd_rad);
            seeker.hear(cue(1.0, 0.5, 0.0, [6e-4; 2]));
            let (said, truth) = (0.5, 0.504);
            let [at, really] = [said, truth].map(|azimuth| ScanAngles { azimuth, elevation: 0.2 });
            let target = track(3, really, 0.5, 0.2);
            let looks = (0..4).map(|_| seeker.look(seconds(1.1), Pointed::Settled(at), &[target]));
            assert_eq!(looks.last().unwrap().taken_over.is_some(), taken);
        }
    }

    /// A mount that turns by so much a second, and stands still for so long before it says so.
    fn stares(slow_rad_per_s: f64, settles_s: f64) -> Vec<f64> {
        let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
        let (mut at, mut to, mut arrives) = (REST, REST, 0.0);
        let mut stood: Vec<f64> = Vec::new();
        for k in 0..600 {
            let t = 0.05 * f64::from(k);
            seeker.hear(cue(t, 0.6, 0.0, [0.3, 1e-3]));
            let pointed = if t < arrives { Pointed::Turning(at) } else { Pointed::Settled(to) };
            if t >= arrives {
                at = to;
                *stood.last_mut().unwrap_or(&mut 0.0) += 0.05;
            }
            if let Some(aim) = seeker.look(seconds(t), pointed, &[]).aim {
                assert!(t >= arrives, "it is told nothing else on its way");
                arrives = t + (aim.azimuth - at.azimuth).abs() / slow_rad_per_s + settles_s;
                to = aim;
                stood.push(0.0);
            }
        }
        stood
    }

    #[test]
    fn a_slow_head_stares_as_long_at_each_view_of_a_stripe_as_a_quick_one() {
        for (slow_rad_per_s, settles_s) in [(50.0, 0.0), (0.5, 0.9), (0.2, 2.0)] {
            let stood = stares(slow_rad_per_s, settles_s);
            let whole = &stood[..stood.len() - 1];
            assert!(whole.len() >= 2 && whole.iter().all(|s| (1.4..1.7).contains(s)), "{stood:?}");
        }
    }

    #[test]
    fn what_the_mount_does_not_reach_is_left_for_what_it_does() {
        let reach = mount();
        let mut seeker = Seeker::new(&model(), Some(reach), 0.0);
        // Behind it, as near as it comes to it, another in reach.
        let mut cues = cue(1.0, 3.12, 0.02, [1e-3; 2]);
        cues.cues.push(cue(1.0, 1.0, 0.02, [1e-3; 2]).cues.remove(0));
        cues.cues[1].of = Some(Cued { track_id: 8, ..Default::default() });
        seeker.hear(cues);
        let aim = seeker.look(seconds(1.0), Pointed::Settled(REST), &[]).aim.unwrap();
        assert!((0.9..1.1).contains(&aim.azimuth), "{aim:?}");
        // At the end of the reach, where the mount says a little else than what it was told.
        let mut seeker = Seeker::new(&model(), Some(reach), 0.0);
        let mut turns = 0;
        let mut at = REST;
        for k in 0..100 {
            let t = 1.0 + 0.05 * f64::from(k);
            seeker.hear(cue(t, 3.05, 0.0, [1e-3; 2]));
            if let Some(aim) = seeker.look(seconds(t), Pointed::Settled(at), &[]).aim {
                turns += 1;
                at = ScanAngles { azimuth: aim.azimuth + 1e-4, ..aim };
            }
        }
        assert_eq!(turns, 1);
    }

    #[test]
    fn a_track_is_preferred_to_what_one_camera_saw_unless_that_is_found() {
        let of_one = |time_s: f64| {
            let mut cues = cue(time_s, 0.3, 0.0, [1e-2; 2]);
            cues.cues[0].of = Some(Cued { camera: "north".into(), ..Default::default() });
            cues
        };
        let both = |time_s: f64| {
            let mut cues = of_one(time_s);
            cues.cues.push(cue(time_s, -0.5, 0.0, [1e-3; 2]).cues.remove(0));
            cues
        };
        let at = ScanAngles { azimuth: 0.3, elevation: 0.2 };
        let seen = track(4, at, 0.3, 0.2);
        for (tracks, leaves) in [(&[][..], true), (&[seen][..], false)] {
            let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
            for k in 0..4 {
                let t = 1.0 + 0.1 * f64::from(k);
                seeker.hear(of_one(t));
                seeker.look(seconds(t), Pointed::Settled(at), tracks);
            }
            seeker.hear(both(1.4));
            let aim = seeker.look(seconds(1.4), Pointed::Settled(at), tracks).aim;
            assert_eq!(aim.is_some_and(|aim| aim.azimuth < 0.0), leaves, "{aim:?}");
            // What it has found becomes a track beside another: it stays on it.
            if !leaves {
                let mut cues = cue(1.5, -0.5, 0.0, [1e-3; 2]);
                cues.cues.push(cue(1.5, 0.301, 0.0, [1e-3; 2]).cues.remove(0));
                cues.cues[1].of = Some(Cued { track_id: 9, ..Default::default() });
                seeker.hear(cues);
                assert_eq!(seeker.look(seconds(1.5), Pointed::Settled(at), tracks).aim, None);
            }
        }
    }

    #[test]
    fn while_nobody_knows_where_it_points_nothing_is_taken_over_and_nothing_turned() {
        let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
        seeker.hear(cue(1.0, 0.02, 0.0, [1e-3; 2]));
        let seen = track(3, REST, 0.02, 0.2);
        assert!((0..9).all(|_| {
            seeker.look(seconds(1.1), Pointed::Unknown, &[seen]) == Orders::default()
        }));
        // Who it is of is copied into every frame.
        let mut long = cue(1.0, 0.02, 0.0, [1e-3; 2]);
        long.cues[0].of = Some(Cued { camera: "x".repeat(1 << 20), ..Default::default() });
        seeker.hear(long);
        assert_eq!(seeker.look(seconds(1.1), Pointed::Settled(REST), &[seen]), Orders::default());
        // Of a future that is not near.
        seeker.hear(cue(9.0, 0.02, 0.0, [1e-3; 2]));
        assert_eq!(seeker.look(seconds(1.1), Pointed::Settled(REST), &[seen]), Orders::default());
    }
}
