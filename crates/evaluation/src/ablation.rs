//! What each part of the image tracker brings: the frames that are lost without it, less those that
//! are lost with all parts, on drawn scenes and on labelled videos.

mod drawn;
mod trial;

use std::collections::BTreeMap;

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_vision::{ImageTrack, PixelBox, TrackPhase, TrackerConfig, TrackerPart};

use self::drawn::{DrawnRun, KINDS};
use self::trial::{Trial, TrialScore};
use crate::papers::{Table, TableRow, ValidationOptions, all_runs, mean};

/// Starts on a video: the first box, given exactly, 4 px beside its target, too large by half, and
/// as of a second later. Together they are what an operator's hand does.
const STARTS: [ClipStart; 4] = [
    ClipStart { aside_px: 0.0, larger: 1.0, later_s: 0.0 },
    ClipStart { aside_px: 4.0, larger: 1.0, later_s: 0.0 },
    ClipStart { aside_px: 0.0, larger: 1.5, later_s: 0.0 },
    ClipStart { aside_px: 0.0, larger: 1.0, later_s: 1.0 },
];

/// How a target of a video is given.
#[derive(Clone, Copy, Debug)]
struct ClipStart {
    aside_px: f64,
    larger: f64,
    later_s: f64,
}

impl ClipStart {
    fn of(self, label: PixelBox) -> PixelBox {
        let mut centre = label.centre();
        centre.x += self.aside_px;
        PixelBox::about(centre, self.larger * label.width, self.larger * label.height)
    }
}

/// All parts, and all but one.
fn configurations() -> impl Iterator<Item = TrackerConfig> {
    let without = TrackerPart::ALL.map(|part| TrackerConfig::default().without(part));
    std::iter::once(TrackerConfig::default()).chain(without)
}

/// Scores of one run: with all parts, then without each of [`TrackerPart::ALL`].
type RunScores = Vec<TrialScore>;

/// The ablation on drawn scenes: a table for each kind of scene, and one for all of them. `runs` of
/// `options` is the number of scenes of each kind; `progress` is told the number of kinds done, the
/// number of all, and the next.
pub fn ablate_drawn(
    options: ValidationOptions,
    mut progress: impl FnMut(usize, usize, &str),
) -> Vec<Table> {
    let (mut tables, mut together) = (Vec::new(), Vec::new());
    for (done, kind) in KINDS.iter().enumerate() {
        progress(done, KINDS.len(), kind.title);
        let scores = all_runs(options.runs, |run| DrawnRun::new(kind, options.seed, run).scores());
        tables.push(table(kind.name, kind.title, &scores));
        together.extend(scores);
    }
    progress(KINDS.len(), KINDS.len(), "");
    tables.push(table("ablation-drawn", "all drawn scenes", &together));
    tables
}

/// The ablation on one labelled video after another.
#[derive(Debug, Default)]
pub struct ClipAblation {
    runs: Vec<RunScores>,
}

impl ClipAblation {
    /// Takes in what a video has shown.
    pub fn take(&mut self, clip: ClipTrials) {
        self.runs.extend(clip.scores());
    }

    /// The table of all videos so far; every start on each of them is a run.
    pub fn table(&self) -> Table {
        table("ablation-clips", "the videos, from four starts", &self.runs)
    }
}

/// One labelled video, through the tracker with all parts and without each, from every start.
///
/// ```
/// use std::collections::BTreeMap;
///
/// use crossfix_correlation::Plane;
/// use crossfix_evaluation::{ClipAblation, ClipTrials};
/// use crossfix_message::Timestamp;
/// use crossfix_vision::PixelBox;
///
/// let label = PixelBox { x: 30.0, y: 20.0, width: 8.0, height: 5.0 };
/// let mut clip = ClipTrials::new((0..20).map(|frame| (frame, label)).collect());
/// let spot = |x: usize, y: usize| (30..38).contains(&x) && (20..25).contains(&y);
/// for frame in 0..20 {
///     let image = Plane::from_fn(64, 48, |x, y| if spot(x, y) { 60.0 } else { 180.0 });
///     clip.step(frame, &image, Timestamp::from_seconds(frame as f64 / 30.0));
/// }
/// let mut ablation = ClipAblation::default();
/// ablation.take(clip);
/// // With all parts none of the frames is lost.
/// assert_eq!(ablation.table().rows[0].ours, 0.0);
/// ```
#[derive(Debug)]
pub struct ClipTrials {
    labels: BTreeMap<u64, PixelBox>,
    /// Time of the first labelled frame.
    began: Option<Timestamp>,
    /// Per start, the trials of all configurations; empty before the start's time.
    starts: [Vec<Trial>; STARTS.len()],
}

impl ClipTrials {
    /// The trials of a video with these boxes of its one target, by the numbers of the frames.
    pub fn new(labels: BTreeMap<u64, PixelBox>) -> Self {
        Self { labels, began: None, starts: std::array::from_fn(|_| Vec::new()) }
    }

    /// Follows the target into a frame. Frames must come in order.
    pub fn step(&mut self, frame: u64, image: &Plane, time: Timestamp) {
        let label = self.labels.get(&frame).copied();
        if label.is_some() {
            self.began = self.began.or(Some(time));
        }
        let Some(began) = self.began else { return };
        for (start, trials) in STARTS.iter().zip(&mut self.starts) {
            let is_time = time.seconds_since(began) >= start.later_s;
            if let Some(label) = label.filter(|_| is_time && trials.is_empty()) {
                trials.extend(configurations().filter_map(|c| Trial::new(c, start.of(label))));
            }
            for trial in trials {
                trial.step(image, time, label);
            }
        }
    }

    /// Per start that the video was long enough for, the scores of all configurations.
    fn scores(self) -> impl Iterator<Item = RunScores> {
        let begun = self.starts.into_iter().filter(|trials| !trials.is_empty());
        begun.map(|trials| trials.into_iter().map(Trial::score).collect())
    }
}

/// The table of some runs: lost with all parts, and how much more is lost without each.
fn table(name: &'static str, title: &str, runs: &[RunScores]) -> Table {
    let lost = |run: &RunScores, index: usize| run.get(index).map_or(f64::NAN, TrialScore::lost);
    let longest = |index: usize| {
        let wrong = runs.iter().filter_map(|run| run.get(index)).map(|score| score.longest_wrong_s);
        wrong.fold(0.0, f64::max)
    };
    let with_all: Vec<f64> = runs.iter().map(|run| 100.0 * lost(run, 0)).collect();
    let mut rows = vec![TableRow::new("all parts: lost, %", longest(0), mean(&with_all))];
    for (index, part) in (1..).zip(TrackerPart::ALL) {
        // The same images: the difference of each run, so that what is hard in it cancels.
        let more: Vec<f64> =
            runs.iter().map(|run| 100.0 * (lost(run, index) - lost(run, 0))).collect();
        rows.push(TableRow::new(format!("without: {part}"), longest(index), mean(&more)));
    }
    Table {
        name,
        title: format!("What each part of the tracker brings on {title}"),
        x: "wrong for, s",
        y: "lost without it, less with all, %",
        rows,
    }
}

/// Whether a track claims to be on its target.
fn is_claimed(track: &ImageTrack) -> bool {
    track.phase != TrackPhase::Searching
}
