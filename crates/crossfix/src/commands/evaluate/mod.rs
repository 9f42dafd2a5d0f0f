mod comparison;

use std::path::{Path, PathBuf};

use anyhow::ensure;
use crossfix_evaluation::{
    Delays, Estimate, Evaluator, Latency, LatencyRecorder, Report, Sightings, TargetReport,
    TrackHistory, TrueTarget,
};
use crossfix_message::{
    BearingFrame, CameraCalibration, Channel, Datum, Timestamp, TrackFrame, TrueState, TruthFrame,
};
use crossfix_recording::Entry;
use serde::Serialize;

use super::numbers;
use crate::commands::examples;
use crate::output;
use crate::recorded::{self, Lacks};

/// Compare the tracks of a recording with the truth in it, or two runs with each other.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix evaluate tracks.mcap --json",
    "crossfix evaluate tracks.mcap --min-cameras 3",
    "crossfix evaluate before.mcap after.mcap --save both.rrd",
]))]
pub struct Args {
    /// The recording (MCAP) with tracks and truth.
    recording: PathBuf,
    /// A second run over the same data: both are compared with the truth of the first.
    #[arg(value_name = "RECORDING")]
    beside: Option<PathBuf>,
    /// Draw both runs and the truth into one picture for Rerun (.rrd).
    #[cfg(feature = "viewer")]
    #[arg(long, value_name = "RRD", requires = "beside")]
    save: Option<PathBuf>,
    #[command(flatten)]
    question: Question,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// What is compared, and how.
#[derive(Clone, Debug, clap::Args)]
pub struct Question {
    /// A second recording (MCAP) with the truth, if the first has none.
    #[arg(long, value_name = "FILE")]
    pub truth: Option<PathBuf>,
    /// A track farther from a target than this is not counted as that target's, metres.
    #[arg(long, default_value_t = 5.0, value_name = "METRES", value_parser = numbers::distance)]
    pub cutoff_m: f64,
    /// Leave out this much time after the first truth, seconds.
    #[arg(long, default_value_t = 0.0, value_name = "SECONDS", value_parser = numbers::seconds)]
    pub skip_s: f64,
    /// Standard deviation of the truth's own positions, metres per axis.
    #[arg(
        long,
        default_value_t = 0.0,
        value_name = "METRES",
        value_parser = numbers::metres_or_none
    )]
    pub truth_sd: f64,
    /// Count only the instants at which at least this many cameras saw something, both in the frame
    /// just before and in the frame just after.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub min_cameras: usize,
    /// Use the smoothed tracks (of `fuse --lag`) instead of the live ones.
    #[arg(long)]
    pub smoothed: bool,
}

impl Default for Question {
    fn default() -> Self {
        Self {
            truth: None,
            cutoff_m: 5.0,
            skip_s: 0.0,
            truth_sd: 0.0,
            min_cameras: 0,
            smoothed: false,
        }
    }
}

/// The results of one run.
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    /// Comparison of the tracks with the truth.
    #[serde(flatten)]
    pub report: Report,
    /// Time from a bearing to the tracks that it changes; absent in data without arrival times.
    pub latency: Option<Latency>,
    /// What could not be read: the figures cover the rest.
    pub lacks: Lacks,
}

/// What is read from a recording for its evaluation.
#[derive(Default)]
struct EvaluatedRun {
    truth: Vec<TruthFrame>,
    tracks: TrackHistory,
    track_frames: u64,
    sightings: Sightings,
    latency: LatencyRecorder,
    /// Uncertainty that the site has as a whole.
    datum: Option<Datum>,
}

impl EvaluatedRun {
    /// The tracks at a time. The truth comes from elsewhere, so its own error and the error of the
    /// site as a whole are added to the tracks' covariances.
    fn estimates(&self, time: Timestamp, truth_sd_m: f64) -> Vec<Estimate> {
        let mut estimates = self.tracks.at(time);
        for Estimate { state, .. } in &mut estimates {
            for axis in 0..3 {
                state.covariance[(axis, axis)] += truth_sd_m * truth_sd_m;
            }
            if let Some(datum) = &self.datum {
                state.covariance += datum.of_state(&state.position(), &state.velocity(), time);
            }
        }
        estimates
    }

    /// Refuses tracks and truth of different times: nothing can be said of either.
    fn ensure_overlaps(&self, truth: &[Timestamp]) -> anyhow::Result<()> {
        let (Some([first, last]), [begins, .., ends]) = (self.tracks.span(), truth) else {
            return Ok(());
        };
        ensure!(
            first <= *ends && *begins <= last,
            "the tracks are from {first} to {last}, the truth from {begins} to {ends}: they have no \
             time in common"
        );
        Ok(())
    }

    fn read(&mut self, path: &Path, smoothed: bool) -> anyhow::Result<Lacks> {
        let mut lacks = Lacks::default();
        recorded::for_each(path, &mut lacks, |lacks, entry| {
            self.add(&entry, smoothed, lacks);
            Ok(())
        })?;
        lacks.say(path);
        Ok(lacks)
    }

    /// Adds a message of the recording; of the tracks only the smoothed or only the live ones.
    fn add(&mut self, entry: &Entry, smoothed: bool, lacks: &mut Lacks) {
        match entry.key.channel {
            Channel::Calibration(_) => {
                let message = lacks.read::<CameraCalibration>(&entry.data);
                let datum = message.and_then(|message| message.datum?.parse());
                self.datum = self.datum.take().or(datum);
            }
            Channel::Truth => self.truth.extend(lacks.read::<TruthFrame>(&entry.data)),
            Channel::Tracks | Channel::Smoothed
                if smoothed == (entry.key.channel == Channel::Smoothed) =>
            {
                if let Some(frame) = lacks.read::<TrackFrame>(&entry.data) {
                    self.track_frames += 1;
                    self.latency.tracks(&frame.camera, frame.camera_sequence, entry.arrival);
                    self.tracks.add(&frame);
                }
            }
            Channel::Bearings(_) => {
                if let Some(frame) = lacks.read::<BearingFrame>(&entry.data) {
                    self.latency.bearing(&frame.camera, frame.sequence, entry.arrival);
                    self.sightings.add(&frame);
                }
            }
            _ => {}
        }
    }
}

fn targets(frame: &TruthFrame) -> Vec<TrueTarget> {
    frame.targets.iter().filter_map(target).collect()
}

/// A target whose position and velocity are known.
fn target(state: &TrueState) -> Option<TrueTarget> {
    Some(TrueTarget {
        id: state.id,
        position: state.position?.into(),
        velocity: state.velocity?.into(),
    })
}

/// Evaluates a recording.
pub fn evaluate(recording: &Path, question: &Question) -> anyhow::Result<Evaluation> {
    let mut run = EvaluatedRun::default();
    let mut lacks = run.read(recording, question.smoothed)?;
    lacks.ensure_found(run.track_frames > 0, "tracks", recording)?;
    if let Some(path) = &question.truth {
        let mut other = EvaluatedRun::default();
        let theirs = other.read(path, question.smoothed)?;
        theirs.ensure_found(!other.truth.is_empty(), "truth", path)?;
        run.truth = other.truth;
        lacks.damage = lacks.damage.or(theirs.damage);
    }
    ensure!(
        !run.truth.is_empty(),
        "{} holds no truth: give a recording that does with --truth",
        recording.display()
    );
    run.truth.sort_by_key(|frame| frame.time_ns);
    let is_finite = |state: &TrueState| target(state).is_none_or(|target| target.is_finite());
    ensure!(
        run.truth.iter().flat_map(|frame| &frame.targets).all(is_finite),
        "the truth has a position or a velocity that is no number"
    );
    let times: Vec<Timestamp> =
        run.truth.iter().map(|f| Timestamp::from_nanos(f.time_ns)).collect();
    run.ensure_overlaps(&times)?;
    let start = times[0].plus_seconds(question.skip_s);
    let mut evaluator = Evaluator::new(question.cutoff_m);
    for ((frame, &time), cameras) in
        run.truth.iter().zip(&times).zip(run.sightings.cameras_at(&times))
    {
        if time >= start && cameras >= question.min_cameras {
            evaluator.add(time, &targets(frame), &run.estimates(time, question.truth_sd));
        }
    }
    let report = evaluator.report();
    ensure!(
        report.instants > 0,
        "of the {} instants of the truth none is at least {} s after the first \
         and seen by at least {} cameras",
        times.len(),
        question.skip_s,
        question.min_cameras
    );
    // Imported data arrive when they are captured, so their latency is meaningless.
    let latency = run.latency.latency().filter(|latency| latency.p99_ms > 0.0);
    Ok(Evaluation { report, latency, lacks })
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    if let Some(beside) = &args.beside {
        return run_beside(args, beside);
    }
    let evaluation = evaluate(&args.recording, &args.question)?;
    if args.json {
        return output::json(&evaluation);
    }
    output::line(render(&evaluation));
    Ok(())
}

fn run_beside(args: &Args, beside: &Path) -> anyhow::Result<()> {
    let compared = comparison::compare(&args.recording, beside, &args.question)?;
    #[cfg(feature = "viewer")]
    if let Some(path) = &args.save {
        comparison::draw(&args.recording, beside, &args.question, path)?;
    }
    if args.json {
        return output::json(&compared);
    }
    output::line(comparison::render(&compared, [&args.recording, beside]));
    Ok(())
}

/// Titles of the table's columns. Each NEES has its expected value in brackets.
const TITLES: [&str; 9] = [
    "target",
    "detected",
    "tracked",
    "RMSE [m]",
    "RMSE [m/s]",
    "NEES (6)",
    "median (5.3)",
    "position (3)",
    "velocity (3)",
];

/// What the titles leave out, for below the table.
const LEGEND: &str = "\
    RMSE of the position and of the velocity. NEES, with its expected value in brackets: mean and\n\
    median for position and velocity together, then the mean for each alone.";

/// The results as a text for people, at most 100 columns wide.
pub fn render(evaluation: &Evaluation) -> String {
    let Evaluation { report, latency, .. } = evaluation;
    let mut rows = vec![TITLES.map(str::to_owned).to_vec()];
    rows.extend(report.targets.iter().map(row));
    let latency = latency.map_or_else(String::new, |latency| {
        format!("\nbearing to track: p50 {:.1} ms, p99 {:.1} ms", latency.p50_ms, latency.p99_ms)
    });
    format!(
        "{}\n{LEGEND}\n\n\
         {} instants, {} answers: {} off by more than 1 m, {} by more than 4 SD\n\
         {} false answers (farther than {} m from every target)\n\
         {} false tracks, {} changes of identity, OSPA {:.3} m, GOSPA {:.3} m\n{}{latency}",
        output::table(&rows),
        report.instants,
        report.answers,
        percent(report.share_off_by_1_m),
        percent(report.share_beyond_4_sd),
        report.false_answers,
        report.cutoff_m,
        report.false_tracks,
        report.id_switches,
        report.ospa_m,
        report.gospa_m,
        waits(&report.delays),
    )
}

/// The table's row of a target.
fn row(target: &TargetReport) -> Vec<String> {
    vec![
        target.target.to_string(),
        if target.detected { "yes" } else { "no" }.to_owned(),
        format!("{:.1} %", 100.0 * target.share_tracked),
        output::number(target.position_rmse_m, 3),
        output::number(target.velocity_rmse_mps, 3),
        output::number(target.nees.mean, 2),
        output::number(target.nees.median, 2),
        output::number(target.position_nees.mean, 2),
        output::number(target.velocity_nees.mean, 2),
    ]
}

fn percent(share: Option<f64>) -> String {
    share.map_or_else(|| "-".to_owned(), |share| format!("{:.2} %", 100.0 * share))
}

/// How long the targets waited for answers, in words.
fn waits(delays: &Delays) -> String {
    let first = delays.first_s.map_or_else(
        || "a target was never answered for".to_owned(),
        |first| format!("first answer after {first:.1} s"),
    );
    let next = match delays.returns {
        0 => String::new(),
        returns => format!(
            "; of {returns} returns half answered for within {}, 90 % within {}",
            seconds_or_never(delays.next_median_s),
            seconds_or_never(delays.next_p90_s)
        ),
    };
    let unanswered = match delays.unanswered {
        0 => String::new(),
        1 => "; one stretch of more than a second without any answer".to_owned(),
        many => format!("; {many} stretches of more than a second without any answer"),
    };
    format!("{first}{next}{unanswered}")
}

fn seconds_or_never(value: Option<f64>) -> String {
    value.map_or_else(|| "never".to_owned(), |value| format!("{value:.1} s"))
}
