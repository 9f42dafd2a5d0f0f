//! Why nothing is found where cameras see something at the same time.
//!
//! Wrong poses, clocks that are off and targets beyond all range look the same: no track. While
//! there is none, the lines of every two cameras are compared, and what most comparisons show is
//! said in one sentence.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;

use crossfix_message::{CameraName, Timestamp};

use crate::cameras::Rooted;
use crate::initiation::{Passing, Passings, lines_with_pose};
use crate::spatial::TimedLine;
use crate::{Exposure, Initiation, Sighting};

/// How long there must have been no track before anything is said, s: a target is found within two.
/// With half of it one that is found a little late is preceded by a warning.
const PATIENCE_S: f64 = 5.0;
/// How often two cameras are compared, s. With half of it the comparisons that count are those of
/// 2.5 s.
const INTERVAL_S: f64 = 0.25;
/// How often a conclusion is drawn, s: counting costs more than comparing. With half of it the
/// reason is known up to half a second sooner, at twice the cost.
const CONCLUDED_EVERY_S: f64 = 1.0;
/// Number of comparisons of two cameras that count: those of the last five seconds. With half of it
/// a bird that passes decides what is said.
const REMEMBERED: usize = 20;
/// Share of these comparisons in which both cameras must have seen something. With half of it
/// clutter that both see now and then counts as a target that is not found.
const LEAST_SHARE: f64 = 0.8;
/// What an agent has followed in its image for this long is something, s: clutter comes and goes.
/// With half of it more of that is compared, and lines of clutter miss each other.
const SOMETHING_S: f64 = 1.0;
/// Exposures further apart than this are not compared, s. With half of it cameras of 1 Hz are
/// seldom compared; with twice as much, what a target may fly in between hides what is wrong.
const MAX_APART_S: f64 = 0.5;
/// Cameras that are nearer to each other than this stand in the same place, m: what they see has no
/// range. No survey is as good; a pose that was copied is the same to the last digit. With half of
/// it the same.
const SAME_PLACE_M: f64 = 1e-3;
/// Bounds on time and memory.
struct ComparedBounds {
    /// Lines of one exposure that are compared. With half of it the one target among twenty image
    /// tracks may not be compared.
    lines: usize,
    /// Image tracks of a camera that are remembered. Beyond it new ones are not looked at until old
    /// ones have gone; half of it is more than an image holds.
    image_tracks: usize,
}

/// The numbers in use; what half of each does is said at its field.
const BOUNDS: ComparedBounds = ComparedBounds { lines: 30, image_tracks: 1_000 };

/// Why no target is found.
#[derive(Clone, Debug, PartialEq)]
pub struct WhyNothing {
    /// The two cameras that show it most clearly.
    pub cameras: [CameraName; 2],
    /// What their lines do.
    pub lines: UnmetLines,
}

/// What the lines of two cameras do where no target is found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum UnmetLines {
    /// They pass each other.
    Apart {
        /// The median over the comparisons of the smallest distance, m.
        by_m: f64,
    },
    /// They come near each other behind a camera, or beyond the longest range.
    Nowhere {
        /// The longest range, m.
        max_range_m: f64,
    },
    /// They meet, but not as any target's motion would explain.
    Unsteady,
    /// They begin in the same place.
    Together,
}

impl WhyNothing {
    /// Whether another finding says the same, with its numbers within a third.
    fn is_like(&self, other: &Self) -> bool {
        let lines = match (self.lines, other.lines) {
            (UnmetLines::Apart { by_m: one }, UnmetLines::Apart { by_m: two }) => {
                (one / two).ln().abs() < 0.3
            }
            (one, two) => one == two,
        };
        lines && self.cameras == other.cameras
    }
}

impl fmt::Display for WhyNothing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [one, other] = &self.cameras;
        write!(f, "cameras `{one}` and `{other}` see something at the same time, ")?;
        match self.lines {
            UnmetLines::Apart { by_m } => {
                let digits = usize::from(by_m < 10.0);
                write!(
                    f,
                    "but their lines miss each other by {by_m:.digits$} m: check poses and clocks"
                )
            }
            UnmetLines::Nowhere { max_range_m } => {
                let km = max_range_m / 1000.0;
                write!(
                    f,
                    "but their lines meet nowhere within {km} km of both: check poses and \
                     `max_range_m`"
                )
            }
            UnmetLines::Unsteady => {
                write!(f, "and their lines meet, but not as one target's: check clocks and poses")
            }
            UnmetLines::Together => {
                write!(f, "but they stand in the same place: check whether a pose was copied")
            }
        }
    }
}

impl UnmetLines {
    fn of(passing: Passing, max_range_m: f64) -> Self {
        match passing {
            Passing::Nowhere => Self::Nowhere { max_range_m },
            Passing::Apart { by_m } => Self::Apart { by_m },
            Passing::Close => Self::Unsteady,
        }
    }

    fn counter(&self) -> &'static str {
        match self {
            Self::Nowhere { .. } => "unfound_lines_meet_nowhere",
            Self::Apart { .. } => "unfound_lines_miss_each_other",
            Self::Unsteady => "unfound_lines_meet",
            Self::Together => "unfound_lines_from_one_place",
        }
    }

    const RANKS: usize = 4;

    /// Of two that are equally frequent, the one that tells more is the reason: it has the greater
    /// rank.
    fn rank(&self) -> usize {
        match self {
            Self::Together => 0,
            Self::Nowhere { .. } => 1,
            Self::Apart { .. } => 2,
            Self::Unsteady => 3,
        }
    }

    /// How far apart the lines pass each other, m.
    fn miss_m(&self) -> f64 {
        match self {
            Self::Apart { by_m } => *by_m,
            Self::Nowhere { .. } => f64::INFINITY,
            Self::Unsteady | Self::Together => 0.0,
        }
    }
}

/// The time for which an image track has been there.
#[derive(Clone, Copy, Debug)]
struct FollowedTime {
    first: Timestamp,
    last: Timestamp,
}

/// What one camera has seen lately.
#[derive(Clone, Debug)]
struct LatelySeen {
    time: Timestamp,
    lines: Vec<TimedLine>,
    /// By its image tracks.
    followed: BTreeMap<u64, FollowedTime>,
    first: Timestamp,
    /// Whether it has ever followed anything for [`SOMETHING_S`].
    follows: bool,
}

/// Two cameras' last comparisons.
#[derive(Clone, Debug)]
struct PairComparisons {
    time: Timestamp,
    /// `None` where one of the cameras saw nothing.
    shown: VecDeque<Option<UnmetLines>>,
}

impl PairComparisons {
    /// Whether both cameras have seen something in most comparisons, and these are enough.
    fn is_steady(&self) -> bool {
        let both = self.shown.iter().flatten().count();
        // Half of the memory is enough to say something.
        self.shown.len() * 2 >= REMEMBERED && both as f64 >= LEAST_SHARE * self.shown.len() as f64
    }

    /// What comparisons of this rank have shown.
    fn of_rank(&self, rank: usize) -> impl Iterator<Item = &UnmetLines> {
        self.shown.iter().flatten().filter(move |lines| lines.rank() == rank)
    }

    /// The one in the middle of those of a rank, by how far the lines miss each other.
    fn typical(&self, rank: usize) -> Option<UnmetLines> {
        let mut lines: Vec<UnmetLines> = self.of_rank(rank).copied().collect();
        lines.sort_by(|one, other| one.miss_m().total_cmp(&other.miss_m()));
        lines.get(lines.len() / 2).copied()
    }
}

/// Compares cameras while nothing is found.
#[derive(Clone, Debug)]
pub(crate) struct Unmet {
    passings: Passings,
    max_range_m: f64,
    seen: BTreeMap<CameraName, LatelySeen>,
    pairs: BTreeMap<[CameraName; 2], PairComparisons>,
    /// Since when there has been no track.
    since: Option<Timestamp>,
    /// When a conclusion was drawn last.
    concluded: Option<Timestamp>,
    why: Option<WhyNothing>,
}

impl Unmet {
    pub(crate) fn new(config: &Initiation) -> Self {
        Self {
            passings: Passings::new(config),
            max_range_m: config.max_range_m,
            seen: BTreeMap::new(),
            pairs: BTreeMap::new(),
            since: None,
            concluded: None,
            why: None,
        }
    }

    /// Why nothing is found; `None` as long as something is, or while the reason is not clear.
    pub(crate) fn why(&self) -> Option<&WhyNothing> {
        self.why.as_ref()
    }

    /// Notes that there is a target: what was compared before says nothing of what comes after it.
    pub(crate) fn found(&mut self) {
        self.pairs.clear();
        (self.since, self.concluded, self.why) = (None, None, None);
    }

    /// Takes in an exposure's bearings that belong to no track; returns what each comparison has
    /// shown, as the name of its counter.
    pub(crate) fn see(&mut self, exposure: &Exposure) -> Vec<&'static str> {
        let now = exposure.time;
        let since = *self.since.get_or_insert(now);
        let lines = self.note(exposure);
        let mut counted = Vec::new();
        let others = self.seen.iter().filter(|(name, seen)| {
            **name != exposure.camera && now.seconds_since(seen.time).abs() <= MAX_APART_S
        });
        for (other, seen) in others {
            let mut names = [exposure.camera.clone(), other.clone()];
            names.sort();
            let fresh = PairComparisons { time: now, shown: VecDeque::new() };
            let is_new = !self.pairs.contains_key(&names);
            let pair = self.pairs.entry(names).or_insert(fresh);
            if !is_new && now.seconds_since(pair.time) < INTERVAL_S {
                continue;
            }
            let shown = compared(&lines, &seen.lines, &self.passings, self.max_range_m);
            counted.extend(shown.as_ref().map(UnmetLines::counter));
            pair.time = now;
            pair.shown.push_back(shown);
            if pair.shown.len() > REMEMBERED {
                pair.shown.pop_front();
            }
        }
        let is_due = self.concluded.is_none_or(|then| now.seconds_since(then) >= CONCLUDED_EVERY_S);
        if is_due && now.seconds_since(since) >= PATIENCE_S {
            self.concluded = Some(now);
            // A camera that is silent, or that sees nothing any more, has no part in it.
            self.pairs.retain(|_, pair| now.seconds_since(pair.time) <= PATIENCE_S);
            let before = self.why.take();
            self.why = self.conclusion();
            // The same sentence stays as it is, whatever its digits do.
            if let Some(before) =
                before.filter(|before| self.why.as_ref().is_some_and(|why| why.is_like(before)))
            {
                self.why = Some(before);
            }
        }
        counted
    }

    /// Keeps an exposure's lines of what its agent has followed for a while, and returns these
    /// lines.
    fn note(&mut self, exposure: &Exposure) -> Vec<TimedLine> {
        let now = exposure.time;
        let nothing = || LatelySeen {
            time: now,
            lines: Vec::new(),
            followed: BTreeMap::new(),
            first: now,
            follows: false,
        };
        let seen = self.seen.entry(exposure.camera.clone()).or_insert_with(nothing);
        seen.followed.retain(|_, followed| now.seconds_since(followed.last) <= SOMETHING_S);
        let mut lines = Vec::new();
        let moving = exposure.sightings.iter().filter(|seen| seen.rooted != Rooted::Yes).count();
        for (Sighting { image_track, rooted, .. }, (_, timed)) in
            exposure.sightings.iter().zip(lines_with_pose(exposure))
        {
            let full = seen.followed.len() >= BOUNDS.image_tracks;
            if *rooted == Rooted::Yes || (full && !seen.followed.contains_key(image_track)) {
                continue;
            }
            let begun = FollowedTime { first: now, last: now };
            let followed = seen.followed.entry(*image_track).or_insert(begun);
            followed.last = now;
            let is_followed = now.seconds_since(followed.first) >= SOMETHING_S;
            seen.follows |= is_followed;
            // Software that numbers the bearings of each image anew follows nothing. Where image
            // after image shows one or two, they are of something: clutter is more, or is missing.
            let is_all =
                !seen.follows && now.seconds_since(seen.first) >= 2.0 * SOMETHING_S && moving <= 2;
            if (is_followed || is_all) && lines.len() < BOUNDS.lines {
                lines.push(timed);
            }
        }
        (seen.time, seen.lines) = (now, lines.clone());
        lines
    }

    /// What most comparisons of the cameras that see something have shown, and the two cameras that
    /// show it most clearly.
    fn conclusion(&self) -> Option<WhyNothing> {
        let steady: Vec<(&[CameraName; 2], &PairComparisons)> =
            self.pairs.iter().filter(|(_, pair)| pair.is_steady()).collect();
        let count = |pair: &PairComparisons, rank| pair.of_rank(rank).count();
        let total = |rank| -> usize { steady.iter().map(|(_, pair)| count(pair, rank)).sum() };
        // The commonest finding of all steady pairs, and of these pairs the one that shows it most
        // often.
        let shown = (0..UnmetLines::RANKS).filter(|rank| total(*rank) > 0);
        let most = shown.max_by_key(|rank| total(*rank))?;
        let (cameras, pair) = steady.iter().max_by_key(|(_, pair)| count(pair, most))?;
        Some(WhyNothing { cameras: (*cameras).clone(), lines: pair.typical(most)? })
    }
}

/// What the two closest lines of two cameras do; `None` if one of them saw nothing.
fn compared(
    one: &[TimedLine],
    other: &[TimedLine],
    passings: &Passings,
    max_range_m: f64,
) -> Option<UnmetLines> {
    let (first, second) = (one.first()?, other.first()?);
    if (first.line.origin - second.line.origin).norm() < SAME_PLACE_M {
        return Some(UnmetLines::Together);
    }
    let passing = |(first, second)| UnmetLines::of(passings.of(first, second), max_range_m);
    let all = one.iter().flat_map(|first| other.iter().map(move |second| (first, second)));
    all.map(passing).min_by(|a, b| a.miss_m().total_cmp(&b.miss_m()))
}
