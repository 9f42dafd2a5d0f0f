//! The results of a plan, for programs and for people.

use crossfix_evaluation::bound::{
    Advice, Assumptions, CandidatePlace, Cell, Contribution, PlannedCamera, Score, Summary,
    TargetSize, Volume, advise, contributions, layers, predict, smallest_target,
};
use serde::Serialize;

use crate::output;

/// Number of candidate places that are named. Ground and obstacles are not known: with one alone
/// there would be no other where it is impossible.
const NAMED: usize = 3;
/// Least distance between named candidates, as a share of the volume's diagonal. With half of it
/// one obstacle may exclude all of them.
const APART: f64 = 0.25;

/// All predictions of a plan.
#[derive(Debug, Serialize)]
pub struct PlanReport {
    /// The volume's low corner, ENU, m.
    pub min_m: [f64; 3],
    /// Its high corner, m.
    pub max_m: [f64; 3],
    /// Side of a cell, m.
    pub step_m: f64,
    pub assumptions: Assumptions,
    /// The smallest target that two cameras see at the volume's centre, m.
    pub smallest_target_m: Option<f64>,
    pub whole: Summary,
    pub layers: Vec<Summary>,
    pub cameras: Vec<Contribution>,
    pub advice: Option<Advice>,
    pub best: Vec<CandidatePlace>,
    pub cells: Vec<Cell>,
}

impl PlanReport {
    pub fn new(cameras: &[PlannedCamera], volume: &Volume, assumptions: Assumptions) -> Self {
        let cells = predict(cameras, volume, &assumptions);
        let advice = advise(cameras, volume, &assumptions);
        let best =
            advice.as_ref().map(|advice| advice.best_apart(NAMED, APART * volume.diagonal_m()));
        let smallest =
            |target: TargetSize| smallest_target(cameras, volume.middle(), target.least_px);
        Self {
            smallest_target_m: assumptions.target.and_then(smallest),
            min_m: volume.min().into(),
            max_m: volume.max().into(),
            step_m: volume.step_m(),
            assumptions,
            whole: Summary::of(&cells),
            layers: layers(&cells),
            cameras: contributions(cameras, volume, &assumptions, &cells),
            best: best.unwrap_or_default(),
            advice,
            cells,
        }
    }
}

fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

fn place(place: [f64; 3]) -> String {
    // Adding 0.0 removes the sign of a negative zero.
    let [x, y, z] = place.map(|v| v.round() + 0.0);
    format!("({x:.0}, {y:.0}, {z:.0})")
}

/// The assumptions, one per line.
pub fn assumed(report: &PlanReport) -> String {
    let assumed = &report.assumptions;
    let target = assumed.target.map_or_else(
        || "targets of any size".to_owned(),
        |target| {
            format!("targets of {} m, seen where they span {} px", target.size_m, target.least_px)
        },
    );
    format!(
        "{} cells of {} m from {} to {} m (east, north, up)\n\
         {target}, and fly straight at {} m/s; SD at the end of {} s of bearings, a lower bound",
        report.whole.cells,
        report.step_m,
        place(report.min_m),
        place(report.max_m),
        assumed.speed_mps,
        assumed.window_s,
    )
}

fn layer_table(report: &PlanReport) -> String {
    let head = [
        "altitude [m]",
        "with a fix",
        "position SD [m]: 50 %",
        "90 %",
        "velocity SD [m/s]: 50 %",
        "degenerate",
    ];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    let whole = report
        .layers
        .iter()
        .all(|layer| (layer.altitude_m - layer.altitude_m.round()).abs() < 1e-6);
    let decimals = if whole { 0 } else { 1 };
    rows.extend(
        report
            .layers
            .iter()
            .map(|layer| layer_row(format!("{:.decimals$}", layer.altitude_m), layer)),
    );
    rows.push(layer_row("all".to_owned(), &report.whole));
    output::table(&rows)
}

fn layer_row(name: String, layer: &Summary) -> Vec<String> {
    vec![
        name,
        percent(layer.fixed),
        output::number(layer.position_sd_median_m, 3),
        output::number(layer.position_sd_90_m, 3),
        output::number(layer.velocity_sd_median_mps, 3),
        layer.degenerate.map_or_else(|| "-".to_owned(), percent),
    ]
}

fn camera_table(report: &PlanReport) -> String {
    let head = [
        "camera",
        "rate [1/s]",
        "clock SD [ms]",
        "bearing SD [mrad]",
        "rotation SD [mrad]",
        "position SD [m]",
        "reach [m]",
        "sees",
        "without it: with a fix",
        "target's SD [m]: 50 %",
    ];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    rows.extend(report.cameras.iter().map(|camera| {
        vec![
            camera.name.clone(),
            format!("{:.0}", camera.rate_hz),
            format!("{:.1}", 1e3 * camera.clock_sd_s),
            format!("{:.2}", 1e3 * camera.bearing_sd_rad),
            format!("{:.2}", 1e3 * camera.rotation_sd_rad),
            format!("{:.3}", camera.position_sd_m),
            output::number(camera.reach_m, 0),
            percent(camera.sees),
            percent(camera.without.fixed),
            output::number(camera.without.position_sd_median_m, 3),
        ]
    }));
    output::table(&rows)
}

/// The median SD over the volume, if more than half of it has a fix.
fn median(score: &Score) -> Option<f64> {
    (score.fixed > 0.5).then_some(score.median_sd_m)
}

/// How the site fares with one more camera at a place, or with none.
fn advice_row(place: String, score: &Score) -> Vec<String> {
    vec![place, percent(score.fixed), output::number(median(score), 3)]
}

fn advice_table(report: &PlanReport, advice: &Advice) -> String {
    let head = ["one more camera at [m]", "with a fix", "position SD [m]: 50 % of the volume"];
    let none = advice_row("none".to_owned(), &advice.now);
    let mut rows = vec![head.map(str::to_owned).to_vec(), none];
    rows.extend(report.best.iter().map(|best| advice_row(place(best.position_m), &best.score)));
    format!(
        "{}\n(like `{}`, aimed at {}; ground and obstacles are not known)",
        output::table(&rows),
        advice.like,
        place(advice.look_at_m),
    )
}

/// The sentence with the most important number.
pub fn conclusion(report: &PlanReport) -> Option<String> {
    let (advice, best) = (report.advice.as_ref()?, report.best.first()?);
    let (now, then) = (advice.now, best.score);
    let metres = |sd: f64| format!("{sd:.3} m");
    let medians = median(&then).map_or_else(String::new, |then| {
        let now = median(&now).map_or_else(|| "none".to_owned(), metres);
        format!(", median position SD {} instead of {now}", metres(then))
    });
    Some(format!(
        "camera {} helps most at {}: fixes in {} of the volume instead of {}{medians}",
        report.cameras.len() + 1,
        place(best.position_m),
        percent(then.fixed),
        percent(now.fixed),
    ))
}

/// The results as a text for people.
pub fn render(report: &PlanReport) -> String {
    let mut parts = vec![assumed(report), layer_table(report), camera_table(report)];
    parts.extend(report.smallest_target_m.map(|size| {
        format!(
            "the smallest target that two cameras see in the volume's middle: {size:.2} m \
             (--target-size)"
        )
    }));
    parts.extend(report.advice.as_ref().map(|advice| advice_table(report, advice)));
    parts.extend(conclusion(report));
    parts.join("\n\n")
}
