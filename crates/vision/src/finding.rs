//! What is new in an image: boxes that somebody gave, and finds of the detector, which may be a
//! target that was lost.

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;

use crate::config::Algorithm;
use crate::detector::{Detector, Found, KnownTarget};
use crate::figure::meant;
use crate::followed::{Followed, Follower, TakenUpBy, describe};
use crate::frame::{FrameInput, Others, TargetStep};
use crate::scene_turn::SceneTurn;
use crate::{
    DetectorConfig, ImageTrack, ImageTrackId, ImageTracker, PixelBox, TrackPhase, TrackerConfig,
    TrackerPart,
};

/// Most candidates, things that are followed because they may be a lost target: each costs as much
/// as a target. With 20 an image of a panning camera takes up to 42 ms instead of 14, and no more
/// is found; with half of it a lost target among others that move has a stand-in less often.
const MOST_CANDIDATES: usize = 6;
/// A candidate is shown in a lost target's place after this long, s: as long as what a search has
/// found is on probation. With half of it half a percent more of a still camera's frames are right,
/// and as many fewer of a panning one's.
const CANDIDATE_S: f64 = 0.5;
/// For this long after it was given a target may be taken up again where it shows, s: a video's
/// compression hides a bird of five pixels for some images. Longer, and something else may
/// have flown into the box by then; with half of it one that compression hides for longer is not
/// put right (reasoned, not measured).
const SHOWN_WITHIN_S: f64 = 0.5;
/// Largest ratio of a candidate's mean side to the target's, either way: of a drone before trees
/// only the brightest part is found. With half of it a part of less than a quarter of its area
/// stands in for nothing.
const STAND_IN_SIZES: f64 = 4.0;
/// Largest probability that is stated for a candidate being the target: nothing is known for it but
/// that it moves, and that nothing else has been found. With half of it only the number that is
/// stated changes.
const STAND_IN_CERTAINTY: f64 = 0.5;

impl ImageTracker {
    /// Takes up the boxes that somebody gave, and what the detector finds: a target that was lost,
    /// or a new one.
    pub(crate) fn take_up_new(&mut self, image: &Plane, time: Timestamp, interval: f64) {
        let given = std::mem::take(&mut self.waiting);
        let found = self.detect(image, interval, &given);
        self.take_up_late(image, time);
        for given in given {
            let meant = self.meant(image, given);
            self.take_up_at(image, meant.unwrap_or(given), TakenUpBy::Given, time);
            if let Some(followed) = self.followed.last_mut() {
                followed.unshown = meant.is_none().then_some(given);
            }
        }
        // A stand-in may look like its target by now.
        for index in 0..self.followed.len() {
            let stand_in = self.followed[index].stand_in;
            let place = self
                .followed
                .iter()
                .find(|f| Some(f.id) == stand_in)
                .map(|f| f.target.box_after(0.0));
            if let Some(place) = place {
                self.is_lost_one(image, place, time, interval);
            }
        }
        for found in found {
            if !self.is_lost_one(image, found.place, time, interval) {
                self.take_up_found(image, found, time);
            }
        }
        self.show_stand_ins(time);
    }

    fn take_up_found(&mut self, image: &Plane, found: Found, time: Timestamp) {
        let has_room = match &self.config.detector {
            Some(config) => self.followed.len() < config.max_targets,
            None => self.followed.iter().filter(|f| f.is_candidate()).count() < MOST_CANDIDATES,
        };
        if !has_room {
            return;
        }
        let Found { place, gone_px } = found;
        let is_candidate = self.config.detector.is_none();
        let origin = TakenUpBy::Detected {
            first: place.centre(),
            turned: self.scene.turned(),
            // A candidate has to show by itself that it moves.
            has_moved: !is_candidate && gone_px > place.width.max(place.height),
            is_candidate,
        };
        self.take_up_at(image, place, origin, time);
    }

    fn take_up_at(&mut self, image: &Plane, place: PixelBox, origin: TakenUpBy, time: Timestamp) {
        let is_candidate = matches!(origin, TakenUpBy::Detected { is_candidate: true, .. });
        let id = if is_candidate { &mut self.next_candidate } else { &mut self.next_id };
        let number = *id;
        *id = if is_candidate { number - 1 } else { number + 1 };
        let id = ImageTrackId(number);
        let mut target = Follower::new(image, place, &mut self.scratch, &self.config);
        if origin == TakenUpBy::Given {
            target.begin_centring(&self.config);
        }
        let is_beneath = |f: &&Followed| f.target.box_after(0.0).is_near(&target.box_after(0.0));
        let began_on = self.followed.iter().find(is_beneath).map(|followed| followed.id);
        let step = TargetStep { measured: None, score: 1.0, certainty: 1.0, nis: None };
        self.tracks.push(describe(id, &target, TrackPhase::Tentative, step));
        self.followed.push(Followed {
            id,
            origin,
            target,
            began_on,
            measured_at: time,
            since: time,
            searched: None,
            cue: None,
            stand_in: None,
            unshown: None,
        });
    }

    /// Shows stand-ins: while a target is lost, something else that moves may be it.
    fn show_stand_ins(&mut self, time: Timestamp) {
        for lost in 0..self.followed.len() {
            let followed = &self.followed[lost];
            let is_lost = followed.origin == TakenUpBy::Given && followed.target.is_searching();
            let stand_in = if is_lost { self.stand_in_of(followed, time) } else { None };
            self.followed[lost].stand_in = stand_in;
            let track = |id| self.tracks.iter().position(|track| track.id == id);
            if let (Some(shown), Some(instead)) =
                (track(self.followed[lost].id), stand_in.and_then(track))
            {
                let certainty = self.tracks[instead].certainty.min(STAND_IN_CERTAINTY);
                self.tracks[shown] =
                    ImageTrack { id: self.tracks[shown].id, certainty, ..self.tracks[instead] };
            }
        }
        // Candidates are numbered from above, so that all numbers beyond the next one are
        // candidates'.
        self.tracks.retain(|track| track.id.0 <= self.next_candidate);
    }

    /// The candidate that stands in for a lost target: the one that did before, or one that stands
    /// in for no other target.
    fn stand_in_of(&self, lost: &Followed, time: Timestamp) -> Option<ImageTrackId> {
        let is_before = |followed: &&Followed| Some(followed.id) == lost.stand_in;
        let before =
            self.followed.iter().find(is_before).filter(|before| !before.target.is_searching());
        before
            .or_else(|| {
                self.followed.iter().find(|followed| self.may_stand_in(followed, lost, time))
            })
            .map(|followed| followed.id)
    }

    fn may_stand_in(&self, followed: &Followed, lost: &Followed, time: Timestamp) -> bool {
        let [width, height] = lost.target.size();
        let [w, h] = followed.target.size();
        let larger = ((w * h) / (width * height)).sqrt();
        followed.is_candidate()
            && followed.has_moved()
            && followed.target.is_seen()
            && time.seconds_since(followed.since) > CANDIDATE_S
            && (1.0 / STAND_IN_SIZES..=STAND_IN_SIZES).contains(&larger)
            && self.followed.iter().all(|other| other.stand_in != Some(followed.id))
    }

    /// Takes up again what was given by a box in which nothing stood out, if it is not seen and
    /// something stands out there now.
    fn take_up_late(&mut self, image: &Plane, time: Timestamp) {
        for index in 0..self.followed.len() {
            let followed = &mut self.followed[index];
            followed.unshown.take_if(|_| time.seconds_since(followed.since) > SHOWN_WITHIN_S);
            let Some(given) = followed.unshown.filter(|_| !followed.target.is_seen()) else {
                continue;
            };
            let Some(meant) = self.meant(image, given) else { continue };
            let mut target = Follower::new(image, meant, &mut self.scratch, &self.config);
            target.begin_centring(&self.config);
            let followed = &mut self.followed[index];
            (followed.target, followed.unshown, followed.measured_at) = (target, None, time);
            let step = TargetStep { measured: None, score: 1.0, certainty: 1.0, nis: None };
            let track = describe(followed.id, &followed.target, TrackPhase::Tentative, step);
            if let Some(shown) = self.tracks.iter_mut().find(|shown| shown.id == followed.id) {
                *shown = track;
            }
        }
    }

    /// The box of the target that somebody meant by a given box; `None` if the image does not show
    /// it.
    fn meant(&mut self, image: &Plane, place: PixelBox) -> Option<PixelBox> {
        let TrackerConfig { algorithm, box_sd_px, noise_floor, .. } = self.config;
        if algorithm == Algorithm::Paper || box_sd_px <= 0.0 {
            return Some(place);
        }
        // The noise is that of the surroundings: the ground below a sky has other noise.
        let PixelBox { x, y, width, height } = place;
        let corner = [x - width, y - height].map(|at| at as isize);
        let sides = [width, height].map(|side| (3.0 * side).ceil().max(9.0) as usize);
        let noise = self.scratch.meter.variance_within(image, corner, sides, noise_floor as f32);
        meant(image, place, box_sd_px, noise.sqrt())
    }

    /// Runs the detector where it is configured, and while a target is lost.
    fn call_detector(&mut self) {
        if self.config.detector.is_some() || self.config.algorithm == Algorithm::Paper {
            return;
        }
        if self.followed.iter().all(|followed| followed.is_candidate() || followed.target.is_seen())
        {
            self.detector = None;
            self.followed.retain(|followed| !followed.is_candidate());
        } else if self.detector.is_none()
            && self.config.has(TrackerPart::StandIns)
            && self.followed.iter().any(|f| !f.is_candidate() && f.target.is_searching())
        {
            self.detector = Some(Detector::new(DetectorConfig::default()));
        }
    }

    /// What the detector finds beside the targets that are followed or just given; targets that it
    /// takes for the scene are given up.
    fn detect(&mut self, image: &Plane, interval: f64, given: &[PixelBox]) -> Vec<Found> {
        self.call_detector();
        let Some(detector) = &mut self.detector else { return Vec::new() };
        let turned = self.scene.turned();
        for followed in &mut self.followed {
            let place = followed.target.box_after(0.0);
            let (at, side) = (place.centre(), place.width.max(place.height));
            // Nobody knows where a lost target is.
            if let TakenUpBy::Detected { first, turned: then, has_moved, .. } = &mut followed.origin
                && followed.target.is_seen()
            {
                let gone = [at.x - first.x, at.y - first.y];
                // Where what was at its first place is now.
                let first = then.and_then(turned.inverse()).place(*first);
                let in_scene = [at.x - first.x, at.y - first.y];
                // What is on the lens keeps its place in the image, what belongs to the scene its
                // place there: only the smaller of both distances shows a target.
                *has_moved |= gone[0].hypot(gone[1]).min(in_scene[0].hypot(in_scene[1])) > side;
            }
        }
        // A lost target is no longer where it is guessed to be: it may be found there, and
        // something else too.
        let seen = self.followed.iter().filter(|followed| !followed.target.is_searching());
        let known = seen.map(|followed| KnownTarget {
            id: followed.id,
            place: followed.target.box_after(0.0),
            is_watched: followed.has_moved(),
            velocity_sd: followed.velocity_sd_if_found(),
        });
        // A target to be has no number yet: this one is nobody's.
        let given = given.iter().map(|place| KnownTarget {
            id: ImageTrackId(u64::MAX),
            place: *place,
            is_watched: false,
            velocity_sd: None,
        });
        let known: Vec<KnownTarget> = known.chain(given).collect();
        let findings = detector.step(image, interval, turned, &known);
        self.followed.retain(|followed| !findings.scene.contains(&followed.id));
        self.tracks.retain(|track| !findings.scene.contains(&track.id));
        findings.found
    }

    /// Whether what the detector has found is a target that was lost: then the likeliest such
    /// target goes on there.
    fn is_lost_one(
        &mut self,
        image: &Plane,
        place: PixelBox,
        time: Timestamp,
        interval: f64,
    ) -> bool {
        let frame = FrameInput {
            image,
            interval,
            snapshot: None,
            scene: &self.scene,
            scene_moved: SceneTurn::none(),
            may_search: false,
            others: Others::default(),
            config: &self.config,
        };
        let scratch = &mut self.scratch;
        let sightings =
            self.followed.iter_mut().filter(|f| !f.is_candidate()).filter_map(|followed| {
                let Follower::Posterior(target) = &mut followed.target else { return None };
                let seen = target.sighting(frame, place, scratch)?;
                Some((followed, seen))
            });
        let best =
            sightings.max_by(|(_, one), (_, other)| one.log_ratio.total_cmp(&other.log_ratio));
        let Some((followed, seen)) = best else { return false };
        let Follower::Posterior(target) = &mut followed.target else { return false };
        let step = target.go_on_at(frame, seen, &mut self.scratch);
        followed.measured_at = time;
        let track = describe(followed.id, &followed.target, TrackPhase::Tracking, step);
        if let Some(shown) = self.tracks.iter_mut().find(|shown| shown.id == followed.id) {
            *shown = track;
        }
        true
    }
}
