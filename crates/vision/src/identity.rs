//! Identity: whether what is followed is the target, which has come to where it is, or the scene,
//! which was there before.

use crate::ImagePoint;
use crate::arrival::{PlaceThen, PlacedReference};
use crate::fit::TargetFit;
use crate::frame::FrameInput;
use crate::motion::ImageMotion;
use crate::scene::ScenePicture;
use crate::scene_turn::SceneTurn;
use crate::scratch::Scratch;
use crate::state::TargetBelief;
use crate::tracker_part::TrackerPart;
use crate::uneven_turn;

/// How long a target that was found again must have been seen before it is believed, s: until then
/// a mistake costs what is known of where it went, and nothing is learnt of it. With half of it a
/// mistake is learnt after a quarter of a second.
const PROBATION_S: f64 = 0.5;
/// Rate at which the scene takes the place of a target that is followed, 1/s. With ten times as
/// much, certainty falls where nothing is known against the target; with a tenth, a cloud is
/// followed for seconds.
const GOES_PER_S: f64 = 0.1;
/// Rate at which a target takes its place back from the scene, 1/s. With half of it a target taken
/// for the scene by mistake counts as seen again after 0.7 s instead of 0.35, where nothing more is
/// known.
const COMES_PER_S: f64 = 2.0;
/// Probability that what a search has found is the target: the search has asked more of it than is
/// asked of what is followed. With half of it nothing that is found would count as seen before the
/// scene speaks for it.
const FOUND: f64 = 0.9;
/// Standard deviation of a target's contrast about its usual one, as a share of that, within the
/// third of a second that a cloud's edge takes. With half of it a target dimmed by half lies at 3.3
/// standard deviations instead of 1.7, and is sooner taken for noise.
const CONTRAST_SD: f64 = 0.3;
/// Standard deviation of the largest of many placements' contrasts in noise, over that of one
/// placement: a third to a half of it. With half of it a largest contrast that is off by one
/// deviation of a placement hardly counts as noise.
const BEST_SD: f64 = 0.5;
/// Least share of the reference that must be the target's: with less, nobody knows the usual
/// contrast. With half of it a reference of half noise is compared too, whose contrast is off by as
/// much.
const CLEAR: f64 = 0.9;
/// Most that one image counts by its contrast, log likelihood ratio: noise may be other than white.
/// With half of it a target that has become noise counts as unseen after four images instead of
/// two, at 30 per second, where nothing else is known.
const MOST: f64 = 2.0;
/// Images that are closer together than this count as no more than one, s: blur and compression
/// last from one to the next. With half of it sixty images a second count twice as much as thirty.
const NEWS_S: f64 = 1.0 / 30.0;
/// Number of the scene's pictures in which a target remembers its place: more than there are. With
/// half of it the same.
const MOST_PICTURES: usize = 16;

/// Belief that what is followed is the target.
#[derive(Clone, Debug)]
pub(crate) struct TargetIdentity {
    /// Probability that it is the target.
    probability: f64,
    /// Places of the target in the scene's pictures, by the pictures' numbers.
    in_pictures: Vec<(u64, ImagePoint)>,
    /// Speed of the target when it was last seen for sure, px/s, ...
    speed_px_s: f64,
    /// ... and where what it was before was at the beginning.
    last_in_scene: Option<ImagePoint>,
    /// What was known before it was found again, as long as the find is not sure.
    probation: Option<Probation>,
}

/// State of a target before it was found again.
#[derive(Clone, Debug)]
struct Probation {
    motion: ImageMotion,
    unseen_s: f64,
    last_seen: ImagePoint,
    missed: u32,
    /// Number of the newest picture of the scene then.
    picture: u64,
    /// How long it has been seen since, s.
    seen_s: f64,
}

impl TargetIdentity {
    /// Identity of a target that somebody has shown.
    pub(crate) fn new() -> Self {
        Self {
            probability: 1.0,
            in_pictures: Vec::with_capacity(MOST_PICTURES),
            speed_px_s: 0.0,
            last_in_scene: None,
            probation: None,
        }
    }

    /// Notes that somebody has said where it is.
    pub(crate) fn set_given(&mut self) {
        (self.probability, self.probation) = (1.0, None);
        self.in_pictures.clear();
        (self.speed_px_s, self.last_in_scene) = (0.0, None);
    }

    /// Whether it has been found again, and is not believed yet.
    pub(crate) fn is_on_probation(&self) -> bool {
        self.probation.is_some()
    }

    /// Notes its place in the scene in the image before, if it was seen for sure.
    pub(crate) fn note_last_place(&mut self, state: &TargetBelief, frame: FrameInput<'_>) {
        if state.unseen_s > 0.0 || self.probation.is_some() {
            return;
        }
        // `turned` is that of this image already, and `last_seen` is in the image before.
        let now = frame.scene_moved.place(state.last_seen);
        self.last_in_scene = Some(frame.scene.turned().place(now));
    }

    /// Notes its place when a picture of the scene was taken, if it was seen.
    pub(crate) fn note_picture(&mut self, state: &TargetBelief, number: u64) {
        // While it is unseen, its place is not known.
        if state.unseen_s > 0.0 {
            return;
        }
        if self.probation.is_none() {
            self.speed_px_s = state.velocity().x.hypot(state.velocity().y);
        }
        let in_pictures = &mut self.in_pictures;
        if in_pictures.len() >= MOST_PICTURES {
            in_pictures.remove(0);
        }
        in_pictures.push((number, state.last_seen));
    }

    /// Log-likelihood ratio that the target has come to a place, against that what is there now was
    /// there before: by the first picture of the scene that shows it, and by the first that shows
    /// whether the thing turns with the camera; 0 if none does.
    ///
    /// In a picture that was taken while it was lost, the target is taken to have been elsewhere if
    /// it has moved on since, as fast as when it was last seen or as it must have to be here by
    /// now. A target that hovered, and is where it was, may be in all of the pictures.
    pub(crate) fn arrival_log_ratio(
        &self,
        state: &TargetBelief,
        frame: FrameInput<'_>,
        place: ImagePoint,
        scratch: &mut Scratch,
    ) -> f64 {
        if !frame.config.has(TrackerPart::Arrival) {
            return 0.0;
        }
        let placed = PlacedReference {
            reference: state.appearance.working.image(),
            energy: f64::from(state.appearance.energy()),
            place,
            noise: f64::from(state.noise),
            usual: state.usual_contrast * f64::from(state.appearance.clear_share()),
        };
        let longest = placed.reference.width().max(placed.reference.height()) as f64;
        let Scratch { buffers, comparison, .. } = scratch;
        comparison.take(frame.image, placed, &mut buffers.resampler);
        // It has moved on from a picture's time if its speed would have taken it farther than its
        // length since, and out of reach of that place.
        let speed = self.speed_px_s.max(self.least_speed(state, frame, place));
        let mut against = |picture: &ScenePicture, turn: SceneTurn| {
            let (seen, then) = (self.place_in(picture), turn.place(place));
            // After a turn by more than that reaches, what is found nowhere is taken to have come
            // all the same: a target over which a camera turns fast has no other evidence.
            let reach_px = uneven_turn::reach_px([then.x - place.x, then.y - place.y]);
            let has_moved_on = speed * picture.age_s() > longest + reach_px;
            // A picture counts only if the target was elsewhere in it: at a place that is known, or
            // lost and gone on since.
            if seen.is_none() && !(self.was_lost(state, picture) && has_moved_on) {
                return None;
            }
            let then = PlaceThen { picture, place: then, turn, reach_px, seen };
            comparison.with(then, placed, &mut buffers.resampler)
        };
        let pictures = || frame.scene.pictures();
        let scene = pictures().find_map(|picture| against(picture, picture.turn()));
        // What is written into the video, or lies on the lens, turns with the camera.
        let has_turned = |[right, down]: [f64; 2]| right.hypot(down) > longest;
        let mut turned = pictures().filter(|picture| has_turned(picture.turn().moves(place)));
        let lens = turned.find_map(|picture| against(picture, SceneTurn::none()));
        let scene = scene.map_or(0.0, |arrival| arrival.log_ratio(placed.usual));
        // The worse of both: it must have come into the scene and must not be on the lens.
        lens.map_or(scene, |arrival| scene.min(arrival.on_lens_log_ratio(placed.usual)))
    }

    fn place_in(&self, picture: &ScenePicture) -> Option<ImagePoint> {
        let mut seen = self.in_pictures.iter();
        seen.find(|(number, _)| *number == picture.number()).map(|(_, seen)| *seen)
    }

    /// Whether the target may have been lost when a picture of the scene was taken.
    fn was_lost(&self, state: &TargetBelief, picture: &ScenePicture) -> bool {
        let lost_since = self.probation.as_ref().map(|probation| probation.picture);
        state.is_searching() || lost_since.is_some_and(|newest| picture.number() <= newest)
    }

    /// Least speed with which a lost target can have come to a place by now, px/s.
    fn least_speed(&self, state: &TargetBelief, frame: FrameInput<'_>, place: ImagePoint) -> f64 {
        let Some(last) = self.last_in_scene else { return 0.0 };
        let last = frame.scene.turned().inverse().place(last);
        let lost_s = self.probation.as_ref().map_or(state.unseen_s, |probation| probation.unseen_s);
        // |place now - where what was at its last place is now| / time lost.
        (place.x - last.x).hypot(place.y - last.y) / lost_s.max(frame.interval)
    }

    /// Updates the probability that what is followed is the target and neither the scene nor noise,
    /// and returns it: a Markov chain of two states, updated with whether what is at the place has
    /// come there, and whether that stands out as the target does.
    pub(crate) fn measurement_update(
        &mut self,
        state: &TargetBelief,
        frame: FrameInput<'_>,
        fit: TargetFit,
        scratch: &mut Scratch,
    ) -> f64 {
        // Images that follow each other sooner count as no more than one.
        let share = (frame.interval / NEWS_S).min(1.0);
        let placements = scratch.ratios.samples().len() as f64;
        let above_noise = if frame.config.has(TrackerPart::UsualContrast) {
            above_noise_log_ratio(state, fit.contrast, placements)
        } else {
            0.0
        };
        let log_ratio =
            share * (self.arrival_log_ratio(state, frame, fit.place, scratch) + above_noise);
        // Prediction of the chain towards its stationary share, then Bayes' rule.
        let settled = COMES_PER_S / (COMES_PER_S + GOES_PER_S);
        let kept = (-frame.interval * (GOES_PER_S + COMES_PER_S)).exp();
        let before = settled + (self.probability - settled) * kept;
        self.probability = before / (before + (1.0 - before) * (-log_ratio).exp());
        self.probability
    }

    /// Begins a probation: a search has found something.
    pub(crate) fn begin_probation(&mut self, state: &TargetBelief, frame: FrameInput<'_>) {
        self.probation = frame.config.has(TrackerPart::Probation).then(|| Probation {
            motion: state.motion.clone(),
            unseen_s: state.unseen_s,
            last_seen: state.last_seen,
            missed: state.missed,
            picture: frame.scene.newest(),
            seen_s: 0.0,
        });
        self.probability = FOUND;
    }

    /// Predicts what was known before it was found again to the time of the next image.
    pub(crate) fn predict_probation(&mut self, frame: FrameInput<'_>) {
        if let Some(probation) = &mut self.probation {
            probation.motion.predict(frame.interval, frame.sides());
            probation.unseen_s += frame.interval;
        }
    }

    /// Ends a probation: what was found again is lost again, so it was something else, and what was
    /// known before is restored. False if there was no probation.
    pub(crate) fn fail_probation(&mut self, state: &mut TargetBelief) -> bool {
        let Some(before) = self.probation.take() else { return false };
        (state.motion, state.unseen_s, state.last_seen) =
            (before.motion, before.unseen_s, before.last_seen);
        // The images missed on probation count as well, so that it is still searched for.
        state.missed = state.missed.max(before.missed);
        self.in_pictures.retain(|(number, _)| *number <= before.picture);
        true
    }

    /// Adds to the time that it has been seen on probation, s, weighted by the certainty.
    pub(crate) fn go_on_with_probation(&mut self, seen_s: f64) {
        if let Some(probation) = &mut self.probation {
            probation.seen_s += seen_s;
            if probation.seen_s >= PROBATION_S {
                self.probation = None;
            }
        }
    }
}

/// Log-likelihood ratio of a contrast being the target's, whose usual one is known, against it
/// being the largest of a number of placements' in noise.
fn above_noise_log_ratio(state: &TargetBelief, contrast: f64, placements: f64) -> f64 {
    let deviation =
        f64::from(state.noise / state.appearance.energy().max(f32::MIN_POSITIVE)).sqrt();
    let clear = f64::from(state.appearance.clear_share());
    if clear < CLEAR {
        return 0.0;
    }
    let usual = state.usual_contrast * clear;
    // The largest of n normal values is about sd sqrt(2 ln n).
    let best_of_noise = deviation * (2.0 * placements.max(2.0).ln()).sqrt();
    let normal = |off: f64, sd: f64| -0.5 * (off / sd).powi(2) - sd.ln();
    let target = normal(contrast - usual, (CONTRAST_SD * usual).hypot(deviation));
    (target - normal(contrast - best_of_noise, BEST_SD * deviation)).clamp(-MOST, 0.0)
}
