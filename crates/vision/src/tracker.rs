//! All targets of one camera's images: those that it is given, and those that the detector finds.
//!
//! What all targets of an image need is made once: the picture of the scene, the detector's
//! background, the map of what has changed. One lost target is searched for in an image, by turns,
//! so that it costs the others nothing.

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use nalgebra::Matrix2;

use crate::config::Algorithm;
use crate::detector::Detector;
use crate::followed::{Followed, Follower, TakenUpBy, describe};
use crate::followed_target::LEAST_MOVE_PX;
use crate::frame::{FrameInput, Measurement, OtherTarget, Others};
use crate::scene::SceneMemory;
use crate::scene_turn::SceneTurn;
use crate::scratch::Scratch;
use crate::snapshot::BackgroundSnapshot;
use crate::{
    ImagePoint, ImageTrackId, PixelBox, TargetFeatures, TrackerConfig, TrackerConfigError,
    TrackerPart,
};

/// Longest time between images, s; longer ones are cut to it: after such a pause nothing is known
/// of a target anyway. With half of it a camera of less than two images per second forgets its
/// scene with each.
const LONGEST_INTERVAL: f64 = 1.0;
/// Shortest time between images, s; shorter ones are lengthened to it: no camera is faster. With
/// half of it the same.
const SHORTEST_INTERVAL: f64 = 1e-4;

/// The life of a 2D track.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrackPhase {
    /// Taken up in this image.
    Tentative,
    /// Measured in this image.
    Tracking,
    /// Not measured in this image: a prediction.
    Coasting,
    /// Not measured for several images, or not sure in any place for long: the prediction is a
    /// guess, and the target is searched for.
    Searching,
}

/// One target in one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageTrack {
    /// The track. While a target that was given is lost, something else that moves may be shown
    /// under its id, with a `certainty` of at most 0.5.
    pub id: ImageTrackId,
    /// Phase of its life.
    pub phase: TrackPhase,
    /// The filters' estimate of the centre, px.
    pub position: ImagePoint,
    /// Its velocity, px/s.
    pub velocity: ImagePoint,
    /// Covariance of position and velocity on x and on y; absent until there is a velocity.
    pub covariances: Option<[Matrix2<f64>; 2]>,
    /// The centre as measured in this image alone.
    pub measured: Option<Measurement>,
    /// Sides of the box, px.
    pub width: f64,
    /// Sides of the box, px.
    pub height: f64,
    /// Correlation at the best place, 0 to 1, and 0 while the target is searched for; with the
    /// papers' algorithm, the peak of its measure.
    pub score: f64,
    /// Probability that the target is at the best place and nowhere else.
    pub certainty: f64,
    /// Normalised innovation squared, summed over both axes: chi-square with two degrees of freedom
    /// if the filters are consistent; absent if nothing was predicted.
    pub nis: Option<f64>,
    /// How it looks and moves; absent with the papers' algorithm.
    pub features: Option<TargetFeatures>,
}

/// A candidate that keeps to its place for this long is dropped, s: a target that can be
/// distinguished from its scene has by then gone further than its size, if it moves at all. Half of
/// it is little more than a candidate needs to be shown.
const STAYS_S: f64 = 1.5;

/// Refused images in a row that must agree with each other before the tracker believes them and not
/// the last accepted one. With one, as with half of it, two late images in a row take the time back
/// and forget the scene.
const RESYNCHRONISE_AFTER: u32 = 3;

/// When an image was taken, and its sides.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Shot {
    time: Timestamp,
    sides: [usize; 2],
}

impl Shot {
    fn follows(self, before: Self) -> bool {
        self.time > before.time && self.sides == before.sides
    }
}

/// Finds and follows targets in one image stream.
///
/// Images must come in the order of their times; one whose time is not after the last one's, or
/// whose size differs from the last one's, is answered with no tracks and counted. After three of
/// these that agree with each other, the fourth is accepted; if it has another size, what was
/// followed is given up.
#[derive(Debug)]
pub struct ImageTracker {
    pub(crate) config: TrackerConfig,
    pub(crate) scratch: Scratch,
    snapshot: Option<BackgroundSnapshot>,
    pub(crate) scene: SceneMemory,
    pub(crate) detector: Option<Detector>,
    pub(crate) waiting: Vec<PixelBox>,
    pub(crate) followed: Vec<Followed>,
    pub(crate) tracks: Vec<ImageTrack>,
    /// Memory for the places of [`Others`].
    places: Vec<OtherTarget>,
    pub(crate) next_id: u64,
    /// Candidates are numbered down from the largest number; their numbers are never published.
    pub(crate) next_candidate: u64,
    last: Option<Shot>,
    refused: u64,
    /// The newest refused image, and how many refused ones in a row agreed with each other.
    refused_last: Option<(Shot, u32)>,
}

impl ImageTracker {
    /// A tracker that follows nothing yet.
    ///
    /// # Errors
    /// [`TrackerConfigError`] if a number of the configuration makes no sense.
    pub fn new(config: TrackerConfig) -> Result<Self, TrackerConfigError> {
        config.validate()?;
        let detector = config.detector.clone().map(Detector::new);
        let scene = if config.has(TrackerPart::CameraTurns) {
            SceneMemory::default()
        } else {
            SceneMemory::unregistered()
        };
        Ok(Self {
            config,
            scratch: Scratch::default(),
            snapshot: None,
            scene,
            detector,
            waiting: Vec::new(),
            followed: Vec::new(),
            tracks: Vec::new(),
            places: Vec::new(),
            next_id: 1,
            next_candidate: u64::MAX - 1,
            last: None,
            refused: 0,
            refused_last: None,
        })
    }

    /// Takes a target up in the next image. A box that no target can have is left out.
    pub fn take_up(&mut self, place: PixelBox) {
        if place.is_possible() {
            self.waiting.push(place);
        }
    }

    /// Gives a target's place in the next image (an operator's, a cue): it is used instead of a
    /// measured one. Together with the box it starts the track from two measurements (Herasymenko
    /// 2021, eqs. 13-14). A track that is not there, or a place that no image has, is ignored.
    pub fn cue(&mut self, id: ImageTrackId, place: ImagePoint) {
        let known = self.followed.iter_mut().find(|followed| followed.id == id);
        if let Some(followed) = known.filter(|_| place.is_possible()) {
            followed.cue = Some(place);
        }
    }

    /// Notes that the camera has been turned since the last image, so that nothing in the next one
    /// is where it was. What was followed is given up, and the numbers of tracks go on.
    pub fn look_elsewhere(&mut self) {
        self.followed.clear();
        self.tracks.clear();
        self.forget_scene();
        self.last = None;
    }

    /// Forgets what the scene looks like and where lost targets may be in it.
    fn forget_scene(&mut self) {
        self.snapshot = None;
        self.scene.clear();
        self.detector = self.config.detector.clone().map(Detector::new);
        for followed in &mut self.followed {
            if let Follower::Posterior(target) = &mut followed.target {
                target.search_memory.forget_places();
                target.state.is_in_snapshot = false;
            }
        }
    }

    /// Number of images that were refused.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Follows all targets into the next image and returns its tracks, ordered by id. An image
    /// without new, lost, doubtful, noisy or given-up targets, and none at its border, allocates no
    /// memory, but for the detector.
    pub fn step(&mut self, image: &Plane, time: Timestamp) -> &[ImageTrack] {
        let shot = Shot { time, sides: [image.width(), image.height()] };
        if image.samples().is_empty() || !self.admits(shot) {
            self.refused += 1;
            return &[];
        }
        let interval = self.advance_to(shot);
        let scene_moved = self.register(image, interval);
        self.follow(image, time, interval, scene_moved);
        self.give_up(time);
        self.tracks.retain(|track| self.followed.iter().any(|followed| followed.id == track.id));
        self.take_up_new(image, time, interval);
        self.keep_snapshot(image, time);
        self.keep_scene(image);
        &self.tracks
    }

    /// Advances to the time of an accepted image, and returns the interval since the last one, s.
    fn advance_to(&mut self, shot: Shot) -> f64 {
        let since = self.last.map(|last| shot.time.seconds_since(last.time));
        if since.is_some_and(|since| since > LONGEST_INTERVAL) {
            // Nobody knows what the camera did meanwhile.
            self.forget_scene();
        }
        self.last = Some(shot);
        since.map_or(LONGEST_INTERVAL, |since| since.clamp(SHORTEST_INTERVAL, LONGEST_INTERVAL))
    }

    /// Registers an image with the scene, and returns where what was in the image before is now.
    fn register(&mut self, image: &Plane, interval: f64) -> SceneTurn {
        if self.config.algorithm == Algorithm::Posterior {
            self.scene.register(image, interval)
        } else {
            SceneTurn::none()
        }
    }

    /// The lost target whose turn it is to be searched for.
    fn next_sought(&self) -> Option<ImageTrackId> {
        // Where a candidate stands in for a target, something moves already: what a search finds
        // beside that is more often the scene.
        self.followed
            .iter()
            .filter(|f| f.target.is_searching() && f.stand_in.is_none() && !f.is_candidate())
            // The one whose last search is longest ago; those never searched for come first.
            .min_by_key(|f| f.searched)
            .map(|f| f.id)
    }

    /// Two targets that were taken up on one place are two from when they are apart.
    fn part_those_apart(&mut self) {
        for index in 0..self.followed.len() {
            let one = &self.followed[index];
            let other = self.followed.iter().find(|other| Some(other.id) == one.began_on);
            let here = one.target.box_after(0.0);
            if !other.is_some_and(|other| other.target.box_after(0.0).is_near(&here)) {
                self.followed[index].began_on = None;
            }
        }
    }

    /// Notes where each target is expected in the next image, for the others.
    fn note_places(&mut self, interval: f64, scene_moved: SceneTurn) {
        // Where the camera has been jerked nobody knows yet whether the targets have moved with it.
        let is_jerked = |place: &PixelBox| {
            let [right, down] = scene_moved.moves(place.centre());
            right.hypot(down) >= LEAST_MOVE_PX
        };
        self.places.clear();
        self.places.extend(self.followed.iter().map(|followed| OtherTarget {
            id: followed.id,
            since: followed.since,
            measured_at: followed.measured_at,
            began_on: followed.began_on,
            place: followed.expected(interval).filter(|place| !is_jerked(place)),
        }));
    }

    /// Follows all targets into an image, and makes its tracks.
    fn follow(&mut self, image: &Plane, time: Timestamp, interval: f64, scene_moved: SceneTurn) {
        self.part_those_apart();
        self.note_places(interval, scene_moved);
        let turn = self.next_sought();
        let frame = FrameInput {
            image,
            interval,
            snapshot: self.snapshot.as_ref(),
            scene: &self.scene,
            scene_moved,
            may_search: false,
            others: Others::default(),
            config: &self.config,
        };
        self.tracks.clear();
        for (own, followed) in self.followed.iter_mut().enumerate() {
            let may_search = turn == Some(followed.id);
            let others = Others { all: &self.places, own };
            let frame = FrameInput { may_search, others, ..frame };
            if frame.may_search {
                followed.searched = Some(time);
            }
            let step = followed.target.step(frame, followed.cue.take(), &mut self.scratch);
            if step.measured.is_some() {
                followed.measured_at = time;
            }
            self.places[own].place = step.measured.and_then(|_| followed.expected(0.0));
            let phase = match step.measured {
                Some(_) => TrackPhase::Tracking,
                None if followed.target.is_lost() => TrackPhase::Searching,
                None => TrackPhase::Coasting,
            };
            self.tracks.push(describe(followed.id, &followed.target, phase, step));
        }
    }

    /// Keeps an image among the scene's pictures, where it is to be one; each target notes where it
    /// is in that.
    fn keep_scene(&mut self, image: &Plane) {
        if self.config.algorithm == Algorithm::Posterior
            && let Some(number) = self.scene.keep(image)
        {
            for followed in &mut self.followed {
                if let Follower::Posterior(target) = &mut followed.target {
                    target.identity.note_picture(&target.state, number);
                }
            }
        }
    }

    /// Whether an image is accepted: it follows the last one, or enough refused images agree with
    /// each other and not with the last one. Those are right: a camera has changed its mode, or one
    /// clock reading was from the future.
    fn admits(&mut self, shot: Shot) -> bool {
        if self.last.is_none_or(|last| shot.follows(last)) {
            self.refused_last = None;
            return true;
        }
        let agreed = match self.refused_last {
            Some((before, agreed)) if shot.follows(before) => agreed + 1,
            _ => 1,
        };
        self.refused_last = Some((shot, agreed));
        if agreed <= RESYNCHRONISE_AFTER {
            return false;
        }
        self.refused_last = None;
        if self.last.is_some_and(|last| last.sides != shot.sides) {
            // Places in pictures of another size mean nothing.
            self.followed.clear();
        }
        // Times that the wrong clock reading gave mean nothing either.
        for followed in &mut self.followed {
            (followed.measured_at, followed.since, followed.searched) =
                (shot.time, shot.time, None);
        }
        self.forget_scene();
        self.last = None;
        true
    }

    /// Keeps a snapshot for later losses, while every target is seen: from time to time, and when a
    /// target is new.
    fn keep_snapshot(&mut self, image: &Plane, time: Timestamp) {
        let all_seen = self
            .followed
            .iter()
            .all(|followed| followed.is_candidate() || followed.target.is_seen());
        // What a candidate is on may be the scene.
        let targets = || self.followed.iter().filter(|followed| !followed.is_candidate());
        let new = targets()
            .any(|followed| followed.target.belief().is_some_and(|belief| !belief.is_in_snapshot));
        let old = self.snapshot.as_ref().is_none_or(|snapshot| snapshot.is_old(time));
        let posterior = self.config.algorithm == Algorithm::Posterior;
        if !posterior || self.followed.is_empty() || !all_seen || !(new || old) {
            return;
        }
        let former = self.snapshot.take();
        let seen = targets().filter_map(|followed| Some(followed.target.belief()?.last_seen));
        let turned = self.scene.turned();
        self.snapshot = Some(BackgroundSnapshot::of(image, turned, time, seen, former));
        for followed in &mut self.followed {
            let is_in_it = !followed.is_candidate();
            if let Follower::Posterior(target) = &mut followed.target {
                target.state.is_in_snapshot = is_in_it;
            }
        }
    }

    /// Drops targets that the detector found and nobody has measured for long, candidates that stay
    /// in their place, and of two tracks of one target the candidate, or else the younger (but none
    /// that was given).
    fn give_up(&mut self, now: Timestamp) {
        let patience = self.config.give_up_after_s;
        self.followed.retain(|f| {
            f.origin == TakenUpBy::Given || now.seconds_since(f.measured_at) <= patience
        });
        // Such candidates would take the places of others, and cover a target that hovers there.
        self.followed.retain(|followed| !followed.stays(now));
        let mut index = 0;
        while index < self.followed.len() {
            let (older, rest) = self.followed.split_at(index);
            let is_of = |other: &Followed| are_one(&other.target, &rest[0].target);
            let is_double = rest[0].origin != TakenUpBy::Given && older.iter().any(is_of);
            let is_known = rest[0].is_candidate()
                && rest[1..].iter().any(|younger| !younger.is_candidate() && is_of(younger));
            let doubled = is_double || is_known;
            if doubled {
                self.followed.remove(index);
            } else {
                index += 1;
            }
        }
    }
}

impl Followed {
    /// Whether it is a candidate that has stayed in its place for too long.
    fn stays(&self, now: Timestamp) -> bool {
        self.is_candidate() && !self.has_moved() && now.seconds_since(self.since) > STAYS_S
    }
}

/// Two targets that lie on each other are two where they will be apart after this long, s: they fly
/// past each other. With half of it the younger of two that overtake each other is given up; with
/// twice as much two tracks of one target are shown for longer.
const PARTED_S: f64 = 0.5;

/// Whether two tracks are of one target: they lie on each other, now and in a while. One that is
/// lost is not where it is guessed to be.
fn are_one(older: &Follower, younger: &Follower) -> bool {
    let are_near = |after| older.box_after(after).is_near(&younger.box_after(after));
    !older.is_searching() && are_near(0.0) && are_near(PARTED_S)
}
