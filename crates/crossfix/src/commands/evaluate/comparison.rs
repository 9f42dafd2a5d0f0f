//! Comparison of two runs over the same data.

use std::path::Path;

use anyhow::{Context, ensure};
use crossfix_evaluation::Report;
#[cfg(feature = "viewer")]
use crossfix_message::Timestamp;
#[cfg(feature = "viewer")]
use crossfix_view::PlaceInTime;
use serde::Serialize;

use super::{EvaluatedRun, Evaluation, Question, evaluate};
use crate::output;

/// The results of two runs.
#[derive(Debug, Serialize)]
pub struct Comparison {
    a: Evaluation,
    b: Evaluation,
}

/// Evaluates two recordings against one truth: that of the question, else that in the first.
pub fn compare(a: &Path, b: &Path, question: &Question) -> anyhow::Result<Comparison> {
    let truth = question.truth.clone().unwrap_or_else(|| a.to_owned());
    let question = Question { truth: Some(truth), ..question.clone() };
    let evaluated =
        |path: &Path| evaluate(path, &question).with_context(|| path.display().to_string());
    let compared = Comparison { a: evaluated(a)?, b: evaluated(b)? };
    for (run, path) in [(&compared.a, a), (&compared.b, b)] {
        ensure!(
            run.report.completeness > 0.0 || run.report.answers == 0,
            "{} has no track near any target: are both recordings of the same time and place?",
            path.display()
        );
    }
    Ok(compared)
}

/// A figure of a run: its label, how it is read from the report, and its decimals.
type Figure = (&'static str, fn(&Report) -> Option<f64>, usize);

/// The figures that are compared, in the order of the table.
const FIGURES: [Figure; 12] = [
    ("instants", |report| Some(report.instants as f64), 0),
    ("answers", |report| Some(report.answers as f64), 0),
    ("targets tracked [%]", |report| Some(100.0 * report.completeness), 2),
    ("position RMSE [m]", |report| report.position_rmse_m, 4),
    ("velocity RMSE [m/s]", |report| report.velocity_rmse_mps, 4),
    ("NEES (6)", |report| report.nees.mean, 2),
    ("off by more than 1 m [%]", |report| report.share_off_by_1_m.map(percent), 3),
    ("beyond 4 SD [%]", |report| report.share_beyond_4_sd.map(percent), 3),
    ("false tracks", |report| Some(report.false_tracks as f64), 0),
    ("changes of identity", |report| Some(report.id_switches as f64), 0),
    ("OSPA [m]", |report| Some(report.ospa_m), 4),
    ("first answer [s]", |report| report.delays.first_s, 2),
];

fn percent(share: f64) -> f64 {
    100.0 * share
}

/// Table of both runs' figures and their difference.
pub fn render(comparison: &Comparison, names: [&Path; 2]) -> String {
    let Comparison { a, b } = comparison;
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let [first, second] = names.map(name);
    let mut rows = vec![vec![String::new(), first, second, "difference".to_owned()]];
    rows.extend(FIGURES.iter().map(|(what, figure, decimals)| {
        let (a, b) = (figure(&a.report), figure(&b.report));
        let difference = a.zip(b).map(|(a, b)| format!("{:+.decimals$}", b - a));
        vec![
            (*what).to_owned(),
            output::number(a, *decimals),
            output::number(b, *decimals),
            difference.unwrap_or_else(|| "-".to_owned()),
        ]
    }));
    output::table(&rows)
}

/// Draws both runs and the truth beside each other for Rerun.
#[cfg(feature = "viewer")]
pub fn draw(a: &Path, b: &Path, question: &Question, path: &Path) -> anyhow::Result<()> {
    use crossfix_view::{ComparedRun, ComparisonPicture};

    let (mut first, mut second) = (EvaluatedRun::default(), EvaluatedRun::default());
    first.read(a, question.smoothed)?;
    second.read(b, question.smoothed)?;
    let truth = match &question.truth {
        Some(path) => {
            let mut other = EvaluatedRun::default();
            other.read(path, question.smoothed)?;
            other.truth
        }
        None => first.truth.clone(),
    };
    let mut places: Vec<PlaceInTime> = truth
        .iter()
        .flat_map(|frame| {
            let time = Timestamp::from_nanos(frame.time_ns);
            super::targets(frame).into_iter().map(move |target| PlaceInTime {
                time,
                id: target.id,
                place: target.position,
            })
        })
        .collect();
    places.sort_by_key(|at| (at.time, at.id));
    let mut times: Vec<Timestamp> = places.iter().map(|at| at.time).collect();
    times.dedup();
    let drawn = [(a, &first), (b, &second)].map(|(path, run)| ComparedRun {
        name: path.display().to_string(),
        tracks: times.iter().flat_map(|time| tracks_at(run, *time)).collect(),
    });
    let picture = ComparisonPicture { truth: places, runs: drawn.into() };
    let draft = output::Draft::new(path, &[a, b])?;
    picture.draw(&crossfix_view::save(draft.path())?).context("the picture is not complete")?;
    draft.keep()
}

/// Where a run has tracks at a time.
#[cfg(feature = "viewer")]
fn tracks_at(run: &EvaluatedRun, time: Timestamp) -> impl Iterator<Item = PlaceInTime> {
    run.estimates(time, 0.0).into_iter().map(move |estimate| PlaceInTime {
        time,
        id: estimate.id,
        place: estimate.state.position(),
    })
}
