//! What each part of the image tracker brings: the frames that are lost without it, less those that
//! are lost with all parts, on drawn scenes and on labelled videos.

mod drawn;
mod trial;

use std::collections::BTreeMap;

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_vision::{PixelBox, TrackerConfig, TrackerPart};

use self::drawn::{DrawnRun, KINDS};
use self::trial::{Trial, TrialScore};
use crate::papers::{Table, TableRow, ValidationOptions, all_runs, mean};

/// Starts on a video: the first box, given exactly, 4 px beside its target, too large by half, and
/// a second later. Together they are what an operator's hand does; with half of the offsets the
/// trials would say less of how starts are put right.
const STARTS: [TrialStart; 4] = [
    TrialStart { aside_px: 0.0, larger: 1.0, later_s: 0.0 },
    TrialStart { aside_px: 4.0, larger: 1.0, later_s: 0.0 },
    TrialStart { aside_px: 0.0, larger: 1.5, later_s: 0.0 },
    TrialStart { aside_px: 0.0, larger: 1.0, later_s: 1.0 },
];

/// How a target is given.
#[derive(Clone, Copy, Debug)]
struct TrialStart {
    aside_px: f64,
    larger: f64,
    later_s: f64,
}

impl TrialStart {
    fn of(self, label: PixelBox) -> PixelBox {
        let mut centre = label.centre();
        centre.x += self.aside_px;
        PixelBox::about(centre, self.larger * label.width, self.larger * label.height)
    }
}

/// All parts, and all but each of `parts`.
fn configurations(parts: &[TrackerPart]) -> impl Iterator<Item = TrackerConfig> {
    let without = parts.iter().map(|part| TrackerConfig::default().without(*part));
    std::iter::once(TrackerConfig::default()).chain(without)
}

/// Scores of one run: with all parts, then without each of some.
type RunScores = Vec<TrialScore>;

/// What each of `parts` brings on drawn scenes: a table of the frames lost for each kind of scene,
/// and for all of them that and one of the error of the centre. `runs` of `options` is the number
/// of scenes of each kind; `progress` is given the number of kinds done, the number of all, and the
/// next.
///
/// ```
/// use crossfix_evaluation::{ValidationOptions, ablate_drawn};
///
/// // No part is left out: how well the tracker does on two scenes of each kind.
/// let tables = ablate_drawn(ValidationOptions { runs: 2, seed: 5 }, &[], |_, _, _| ());
/// // Six kinds, and two tables of all of them.
/// assert_eq!(tables.len(), 8);
/// // Of two scenes of wires few frames are lost.
/// assert!(tables[2].rows[0].ours < 20.0);
/// ```
pub fn ablate_drawn(
    options: ValidationOptions,
    parts: &[TrackerPart],
    mut progress: impl FnMut(usize, usize, &str),
) -> Vec<Table> {
    let (mut tables, mut together) = (Vec::new(), Vec::new());
    for (done, kind) in KINDS.iter().enumerate() {
        progress(done, KINDS.len(), kind.title);
        let scores =
            all_runs(options.runs, |run| DrawnRun::new(kind, options.seed, run).scores(parts));
        tables.push(lost(kind.name, kind.title, &scores, parts));
        together.extend(scores);
    }
    progress(KINDS.len(), KINDS.len(), "");
    tables.push(lost("ablation-drawn", "all drawn scenes", &together, parts));
    tables.push(off_centre("ablation-drawn-centre", "all drawn scenes", &together, parts));
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

    /// The tables of all videos so far, of the frames lost and of the error of the centre; every
    /// start on each of them is a run.
    pub fn tables(&self) -> [Table; 2] {
        let (title, parts) = ("the videos, from four starts", &TrackerPart::ALL);
        [
            lost("ablation-clips", title, &self.runs, parts),
            off_centre("ablation-clips-centre", title, &self.runs, parts),
        ]
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
/// let [lost, _] = ablation.tables();
/// assert_eq!(lost.rows[0].ours, 0.0);
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
                let given = start.of(label);
                let all = configurations(&TrackerPart::ALL);
                trials.extend(all.map(|config| Trial::new(config, given)));
            }
            for trial in trials {
                trial.step(image, time, label);
            }
        }
    }

    /// Whether there has been a labelled frame.
    pub fn has_begun(&self) -> bool {
        self.began.is_some()
    }

    /// Per start that the video was long enough for, the scores of all configurations.
    fn scores(self) -> impl Iterator<Item = RunScores> {
        let begun = self.starts.into_iter().filter(|trials| !trials.is_empty());
        begun.map(|trials| trials.into_iter().map(Trial::score).collect())
    }
}

/// The frames lost in some runs with all parts, and how many more without each.
fn lost(name: &'static str, title: &str, runs: &[RunScores], parts: &[TrackerPart]) -> Table {
    Table {
        name,
        title: format!("What each part of the tracker brings on {title}: frames not lost"),
        x: "wrong for, s",
        y: "lost without it, less with all, %",
        rows: rows(runs, parts, "lost, %", |score| 100.0 * score.lost()),
    }
}

/// The error of the centre while the target is followed, with all parts, and how much larger it is
/// without each.
fn off_centre(name: &'static str, title: &str, runs: &[RunScores], parts: &[TrackerPart]) -> Table {
    Table {
        name,
        title: format!("What each part of the tracker brings on {title}: the centre"),
        x: "wrong for, s",
        y: "RMS without it, less with all, px",
        rows: rows(runs, parts, "RMS, px", TrialScore::rms_px),
    }
}

/// Longest time for which something else was shown as the target, in any run of a configuration, s.
fn longest_wrong_s(runs: &[RunScores], index: usize) -> f64 {
    runs.iter().map(|run| run[index].longest_wrong_s).fold(0.0, f64::max)
}

/// Rows of a figure with all parts, then of what is added to it without each.
fn rows(
    runs: &[RunScores],
    parts: &[TrackerPart],
    unit: &str,
    figure: impl Fn(&TrialScore) -> f64,
) -> Vec<TableRow> {
    let figures = |index: usize| runs.iter().map(move |run| &run[index]).map(&figure);
    let with_all: Vec<f64> = figures(0).collect();
    let row = |series: String, index: usize, values: &[f64]| {
        TableRow::new(series, longest_wrong_s(runs, index), mean(values))
    };
    let without = (1..).zip(parts).map(|(index, part)| {
        // The same images: the difference of each run, so that what is hard in it cancels. A run
        // that is lost at once has no centre.
        let more = figures(index).zip(&with_all).map(|(one, all)| one - all);
        let more: Vec<f64> = more.filter(|more| more.is_finite()).collect();
        row(format!("without: {part}"), index, &more)
    });
    let known: Vec<f64> = with_all.iter().copied().filter(|all| all.is_finite()).collect();
    std::iter::once(row(format!("all parts: {unit}"), 0, &known)).chain(without).collect()
}
