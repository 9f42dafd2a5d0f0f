//! Selects the labels of one target where cameras followed several things at once and no log tells
//! them apart.
//!
//! Two cameras see one thing where the sight lines of a piece of one camera's labels meet those of
//! the other's, with one relative pose and one offset of their clocks. Short pieces of other things
//! meet by chance; the relative pose that joins most pieces is the true one.

use super::course::Course;
use super::error::LEAST_LABELS;
use super::model::frame_time;
use super::model::{CameraLabels, Label};
use super::pairs::{self, RelativePose, Sights};
use super::{pieces, start, triangulation};
use crate::survey::Survey;

/// Where fewer labels than this share are simultaneous with others, those are of birds, which the
/// fits tolerate; a target that is followed twice is none of it. With half of it a few birds cause
/// the search, for the same labels.
const LEAST_AT_ONCE: f64 = 0.02;
/// This many things are tried per camera, those that it followed longest (with half of it a target
/// is missed that was followed for less time than two others), ...
const THINGS: usize = 4;
/// ... of this many pairs of cameras, those of which both followed something longest (with half of
/// it all pairs of four cameras): each takes seconds for a long flight, ...
const PAIRS: usize = 12;
/// ... and this many pairs of things are extended by other pieces. With half of it the right pair
/// may be left out where two cameras saw little of the target together.
const SEEDS: usize = 12;
/// Sight lines of one thing miss each other by less than this in the median, rad: lens files leave
/// up to 4 mrad. With half of it such cameras find no thing in common.
const MOST_ASIDE_RAD: f64 = 6e-3;
/// A piece with more than this share of labels simultaneous with the target's is of another thing.
/// With half of it a piece is lost where the target was labelled twice in one frame of twenty.
const MOST_AT_ONCE: f64 = 0.1;
/// How often two cameras' relative pose is computed again from all joined pieces. With half of it
/// pieces that only the better pose fits are not joined.
const ROUNDS: usize = 3;

/// A camera's labels in pieces.
struct Things<'a> {
    camera: &'a CameraLabels,
    frame_s: f64,
    pieces: Vec<Vec<Label>>,
    sights: Vec<Sights>,
    /// Pieces (by index) that continue one another, the longest chain first.
    chains: Vec<Vec<usize>>,
}

impl<'a> Things<'a> {
    fn of(camera: &'a CameraLabels) -> Self {
        let frame_s = frame_time(camera);
        let (pieces, _) = pieces::of_one_thing(camera, frame_s);
        let sights = |piece: &Vec<Label>| Sights::of(&start::of_labels(camera, piece.clone()));
        let sights = pieces.iter().map(sights).collect();
        let mut chains = pieces::chains(&pieces, f64::from(camera.intrinsics.size.width));
        let labels = |chain: &Vec<usize>| chain.iter().map(|k| pieces[*k].len()).sum::<usize>();
        chains.sort_by_key(|chain| std::cmp::Reverse(labels(chain)));
        Self { camera, frame_s, sights, chains, pieces }
    }

    /// The share of labels that are simultaneous with others.
    fn at_once(&self) -> f64 {
        let labels = &self.camera.labels;
        let within_s = 0.5 * self.frame_s;
        let pairs = labels.windows(2).filter(|pair| pair[1].time_s - pair[0].time_s < within_s);
        pairs.count() as f64 / labels.len().max(1) as f64
    }

    /// Number of labels in some pieces.
    fn labels(&self, taken: &[usize]) -> usize {
        taken.iter().map(|piece| self.pieces[*piece].len()).sum()
    }

    /// Directions of the labels of some pieces.
    fn seen(&self, taken: &[usize]) -> Sights {
        let pieces: Vec<&Sights> = taken.iter().map(|piece| &self.sights[*piece]).collect();
        Sights::together(&pieces)
    }

    /// The labels of some pieces, in the order of their times.
    fn own(&self, taken: &[usize]) -> CameraLabels {
        let labels = taken.iter().flat_map(|piece| self.pieces[*piece].iter().copied());
        start::of_labels(self.camera, labels.collect())
    }

    /// The labels that fit a course; all where too few do.
    fn along(&self, course: Option<&Course>) -> CameraLabels {
        let by_course = course
            .and_then(|course| start::among_others(self.camera, course, self.frame_s))
            .filter(|own| own.labels.len() >= LEAST_LABELS);
        by_course.unwrap_or_else(|| self.camera.clone())
    }

    /// Whether a piece was followed at other times than these labels.
    fn is_beside(&self, piece: usize, own: &CameraLabels) -> bool {
        let is_at_once =
            |label: &&Label| start::at_once(&own.labels, label.time_s, 0.5 * self.frame_s);
        let at_once = self.pieces[piece].iter().filter(is_at_once).count();
        (at_once as f64) < MOST_AT_ONCE * self.pieces[piece].len() as f64
    }
}

/// Two cameras, which of their pieces are of one target, and their relative pose.
struct Joined {
    cameras: [usize; 2],
    pieces: [Vec<usize>; 2],
    pair: RelativePose,
    labels: usize,
}

/// Each camera's labels of the one target that most of them show; all its labels where nothing was
/// followed beside it, or no two cameras tell.
pub(super) fn of_one_target(cameras: &[&CameraLabels], survey: &Survey) -> Vec<CameraLabels> {
    let things: Vec<Things<'_>> = cameras.iter().map(|camera| Things::of(camera)).collect();
    let as_they_are = || cameras.iter().map(|camera| (*camera).clone()).collect();
    if things.iter().all(|things| things.at_once() < LEAST_AT_ONCE) {
        return as_they_are();
    }
    let mut seeds = seeds(&things, survey);
    seeds.sort_by(|a, b| a.pair.range_uncertainty.total_cmp(&b.pair.range_uncertainty));
    seeds.truncate(SEEDS);
    let joined = seeds.into_iter().filter_map(|seed| seed.joined(&things, survey));
    let Some(best) = joined.max_by_key(|joined| joined.labels) else { return as_they_are() };
    best.labels_of_all(&things)
}

/// Pairs of the things that two cameras followed longest, each pair taken to be one thing.
fn seeds(things: &[Things<'_>], survey: &Survey) -> Vec<Joined> {
    let longest =
        |things: &Things<'_>| things.chains.first().map_or(0, |chain| things.labels(chain));
    let mut pairs: Vec<[usize; 2]> = (0..things.len())
        .flat_map(|first| (first + 1..things.len()).map(move |second| [first, second]))
        .collect();
    // A pair is as good as the camera of it that followed something for the shorter time.
    let least = |pair: &[usize; 2]| pair.map(|camera| longest(&things[camera])).into_iter().min();
    pairs.sort_by_key(|pair| std::cmp::Reverse(least(pair)));
    pairs.truncate(PAIRS);
    let mut seeds = Vec::new();
    for cameras in pairs {
        let begun_with = cameras.map(|camera| {
            let chains = things[camera].chains.iter().take(THINGS);
            chains.map(|chain| (chain, things[camera].seen(chain))).collect::<Vec<_>>()
        });
        for (a, seen_a) in &begun_with[0] {
            for (b, seen_b) in &begun_with[1] {
                let both = cameras.map(|camera| things[camera].camera);
                seeds.extend(ways(both, [seen_a, seen_b], survey).into_iter().map(|pair| Joined {
                    cameras,
                    pieces: [(*a).clone(), (*b).clone()],
                    pair,
                    labels: seen_a.len() + seen_b.len(),
                }));
            }
        }
    }
    seeds
}

/// Possible relative poses of two cameras: from an earlier calibration, or from what they saw.
fn ways(cameras: [&CameraLabels; 2], sights: [&Sights; 2], survey: &Survey) -> Vec<RelativePose> {
    match cameras.map(|camera| survey.known(&camera.name)) {
        [Some(a), Some(b)] => {
            let poses = [a, b].map(|known| known.camera.pose());
            pairs::known(sights[0], sights[1], poses).into_iter().collect()
        }
        _ => pairs::find(sights[0], sights[1]),
    }
}

impl Joined {
    /// Extended by all pieces of the same target; `None` if too few labels are left.
    fn joined(mut self, things: &[Things<'_>], survey: &Survey) -> Option<Self> {
        for _ in 0..ROUNDS {
            // First what does not fit the pose goes, then what does is added; then the pose is
            // computed again.
            while self.leave_worst_out(things) {}
            while self.join_next(things) {}
            let counts = [0, 1].map(|side| things[self.cameras[side]].labels(&self.pieces[side]));
            if counts.into_iter().any(|count| count < LEAST_LABELS) {
                return None;
            }
            let sights = self.seen(things);
            let cameras = self.cameras.map(|camera| things[camera].camera);
            let ways = ways(cameras, sights.each_ref(), survey).into_iter();
            self.pair = ways.min_by(|a, b| a.range_uncertainty.total_cmp(&b.range_uncertainty))?;
            let before = std::mem::replace(&mut self.labels, counts.into_iter().sum());
            if self.labels == before {
                break;
            }
        }
        Some(self)
    }

    fn seen(&self, things: &[Things<'_>]) -> [Sights; 2] {
        [0, 1].map(|side| things[self.cameras[side]].seen(&self.pieces[side]))
    }

    fn own(&self, things: &[Things<'_>]) -> [CameraLabels; 2] {
        [0, 1].map(|side| things[self.cameras[side]].own(&self.pieces[side]))
    }

    /// Removes the piece that misses what the other camera saw of the target most; `false` if none
    /// misses it.
    fn leave_worst_out(&mut self, things: &[Things<'_>]) -> bool {
        let sights = self.seen(things);
        let mut worst = (MOST_ASIDE_RAD, None);
        for side in [0, 1] {
            for (place, piece) in self.pieces[side].iter().enumerate() {
                let seen = &things[self.cameras[side]].sights[*piece];
                let both = if side == 0 { [seen, &sights[1]] } else { [&sights[0], seen] };
                // Where too few sight lines are simultaneous, nothing speaks against a piece.
                let aside = self.pair.aside(both[0], both[1]).unwrap_or(0.0);
                if aside > worst.0 {
                    worst = (aside, Some((side, place)));
                }
            }
        }
        let (_, Some((side, place))) = worst else { return false };
        self.pieces[side].remove(place);
        true
    }

    /// Adds the piece that meets what the other camera saw of the target best; `false` if none
    /// does.
    fn join_next(&mut self, things: &[Things<'_>]) -> bool {
        let own = self.own(things);
        let sights = self.seen(things);
        let mut best: Option<(f64, usize, usize)> = None;
        for side in [0, 1] {
            let of_camera = &things[self.cameras[side]];
            for (piece, seen) in of_camera.sights.iter().enumerate() {
                // One thing is in one place at a time: a piece that was followed beside the
                // target's is another's.
                if self.pieces[side].contains(&piece) || !of_camera.is_beside(piece, &own[side]) {
                    continue;
                }
                let both = if side == 0 { [seen, &sights[1]] } else { [&sights[0], seen] };
                let aside = self.pair.aside(both[0], both[1]).unwrap_or(f64::INFINITY);
                if aside < best.map_or(MOST_ASIDE_RAD, |(least, ..)| least) {
                    best = Some((aside, side, piece));
                }
            }
        }
        let Some((_, side, piece)) = best else { return false };
        self.pieces[side].push(piece);
        true
    }

    /// These two cameras' labels of the target, and the others' labels that fit where these two saw
    /// it.
    fn labels_of_all(&self, things: &[Things<'_>]) -> Vec<CameraLabels> {
        let own = self.own(things);
        let sights = self.seen(things);
        let poses = self.pair.start_poses();
        let states = [0, 1].map(|side| start::state(&own[side], &Course::nowhere(), poses[side]));
        let placed = [0, 1].map(|side| (&sights[side], &states[side]));
        let course = Course::of(&triangulation::log(&placed));
        let labels = things.iter().enumerate().map(|(index, things)| {
            // The two have their pieces already; the others follow the course that these two give.
            match self.cameras.iter().position(|camera| *camera == index) {
                Some(side) => own[side].clone(),
                None => things.along(course.as_ref()),
            }
        });
        labels.collect()
    }
}
