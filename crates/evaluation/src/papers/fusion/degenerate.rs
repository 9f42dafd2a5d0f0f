//! Where the paper's system of equations breaks down: one period of three cameras whose times or
//! places do not determine position and velocity.

use crossfix_fusion::papers::{pair, triple};
use crossfix_fusion::spatial::{Observability, Quantity, TimedLine, WeakAxis, map};
use crossfix_message::Timestamp;
use nalgebra::{Matrix6, Point3, Vector3, Vector6};

use super::super::ValidationOptions;
use super::super::runs::{self, Noise};
use super::super::table::{Limit, SampleStatistic, Table, TableRow, mean, root_mean_square, share};
use super::site::{LAYOUTS, PERIODS, PaperSite, StraightTarget, line, tangent_noise};
use super::{INDEPENDENT_RUNS, VELOCITY_SD, independent_tolerance};

/// Number of runs of a layout for each run of the options. With half of it standard errors are 1.4
/// times as large.
const CHEAP: usize = 10;
/// Standard deviation of the prior on the velocity in the independent implementation's table, m/s.
/// With half of it the MAP's velocities would have smaller errors than the independent
/// implementation's.
const PRIOR_SD: f64 = 30.0;
/// Above this condition number the independent implementation's solver uses the pseudo-inverse.
/// With half of it the same: a layout's is below 500 or infinite.
const WORST_CONDITION: f64 = 1e9;
/// Condition number above which a matrix counts as singular. The largest finite one of a layout is
/// 469, and rounding leaves some 1e16 of an infinite one: half of it gives the same.
const SINGULAR: f64 = 1e12;

/// Known figures of a layout, from elsewhere.
struct KnownFigures {
    condition: f64,
    degeneracy: Degeneracy,
    /// `None` where the independent implementation has none.
    errors: Option<IndependentErrors>,
}

/// The independent implementation's root mean squared errors of position, m, and velocity, m/s.
struct IndependentErrors {
    papers: [f64; 2],
    map: [f64; 2],
}

/// Whether the fixes of a layout must state that they are degenerate.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Degeneracy {
    /// None may.
    Regular,
    /// It depends on where the target is, and on what is known of its velocity.
    OfPlace,
    /// All must: the times alone make them degenerate.
    OfTimes,
}

const fn independent(
    condition: f64,
    degeneracy: Degeneracy,
    papers: [f64; 2],
    map: [f64; 2],
) -> KnownFigures {
    KnownFigures { condition, degeneracy, errors: Some(IndependentErrors { papers, map }) }
}

/// A layout that the independent implementation does not have: its condition number is `numpy`'s.
const fn condition_alone(condition: f64, degeneracy: Degeneracy) -> KnownFigures {
    KnownFigures { condition, degeneracy, errors: None }
}

/// Figures of [`LAYOUTS`], in their order: the independent implementation's.
const INDEPENDENT: [KnownFigures; 8] = [
    independent(20.0, Degeneracy::Regular, [0.27, 2.2], [0.26, 2.1]),
    independent(202.0, Degeneracy::OfPlace, [1.5, 14.7], [1.3, 12.0]),
    independent(f64::INFINITY, Degeneracy::OfTimes, [6.5, 32.0], [3.2, 16.0]),
    independent(f64::INFINITY, Degeneracy::OfTimes, [0.17, 34.0], [0.15, 16.0]),
    independent(f64::INFINITY, Degeneracy::OfTimes, [0.18, 27.0], [0.12, 26.0]),
    condition_alone(94.5, Degeneracy::OfPlace),
    independent(469.0, Degeneracy::OfPlace, [3.1, 118.0], [0.44, 12.0]),
    independent(f64::INFINITY, Degeneracy::OfPlace, [3.6, 117.0], [0.41, 11.0]),
];

/// Names of the solvers, in the order of [`answers`].
const SOLVERS: [&str; 3] = ["papers' inverse", "rank against the noise", "map, 30 m/s prior"];

/// A solver's answer for one period.
struct SolvedState {
    position: Point3<f64>,
    velocity: Vector3<f64>,
    /// Time of that position.
    time: Timestamp,
    observability: Option<Observability>,
}

/// Klochko 2020 to the letter (eqs. 10 and 11): the inverse, or the minimum-norm solution where the
/// condition number exceeds [`WORST_CONDITION`], and the range refined from the pair.
fn papers_inverse(lines: &[TimedLine; 3]) -> Option<SolvedState> {
    let [first, second, third] = lines;
    let mut a = Matrix6::zeros();
    let mut b = Vector6::zeros();
    // Unknowns: three ranges and the velocity; r1 u1 - rk uk + v dt_k = ck - c1 for k = 2, 3.
    for (row, column, other) in [(0, 1, second), (3, 2, third)] {
        let dt = other.time.seconds_since(first.time);
        a.fixed_view_mut::<3, 1>(row, 0).copy_from(&first.line.direction);
        a.fixed_view_mut::<3, 1>(row, column).copy_from(&-other.line.direction.into_inner());
        a.fixed_view_mut::<3, 3>(row, 3).fill_diagonal(dt);
        b.fixed_rows_mut::<3>(row).copy_from(&(other.line.origin - first.line.origin));
    }
    let values = a.singular_values();
    let x = if values.max() < WORST_CONDITION * values.min() {
        a.lu().solve(&b)?
    } else {
        a.pseudo_inverse(values.max() / WORST_CONDITION).ok()? * b
    };
    let velocity: Vector3<f64> = x.fixed_rows::<3>(3).into_owned();
    let dt = second.time.seconds_since(first.time);
    let position = pair(first, second, velocity * dt)?.position;
    Some(SolvedState { position, velocity, time: first.time, observability: None })
}

/// The answers of [`SOLVERS`] in their order.
fn answers(lines: &[TimedLine; 3]) -> [Option<SolvedState>; 3] {
    let [first, second, third] = lines;
    let ours = triple([first, second, third], VELOCITY_SD).map(|solution| SolvedState {
        position: solution.position,
        velocity: solution.velocity,
        time: first.time,
        observability: Some(solution.observability),
    });
    let posterior = map(lines, first.time, PRIOR_SD).map(|solution| SolvedState {
        position: solution.state.position(),
        velocity: solution.state.velocity(),
        time: first.time,
        observability: Some(solution.observability()),
    });
    [papers_inverse(lines), ours, posterior]
}

/// The sight lines of the middle period.
fn lines(
    layout: &PaperSite,
    target: &StraightTarget,
    mut noise: Option<&mut Noise>,
) -> Option<[TimedLine; 3]> {
    let cameras = layout.cameras().ok()?;
    let seen = cameras.iter().zip(layout.delays).map(|(camera, delay)| {
        let time = (PERIODS / 2) as f64 + delay;
        line(camera, target.at(time), tangent_noise(noise.as_deref_mut()), time)
    });
    seen.collect::<Option<Vec<TimedLine>>>()?.try_into().ok()
}

/// A solver's answer in one run, compared with the truth.
#[derive(Clone, Copy)]
struct SolverOutcome {
    /// Errors of position, m, and velocity, m/s.
    errors: [f64; 2],
    observability: Option<Observability>,
    /// Whether the rank is the same as for lines without noise.
    rank_is_true: bool,
}

impl SolverOutcome {
    fn of(answer: &SolvedState, target: &StraightTarget, rank_is_true: bool) -> Self {
        Self {
            errors: [
                (answer.position - target.at(answer.time.seconds())).norm(),
                (answer.velocity - target.velocity).norm(),
            ],
            observability: answer.observability,
            rank_is_true,
        }
    }
}

fn run(layout: &PaperSite, noise: &mut Noise) -> [Option<SolverOutcome>; 3] {
    let target = StraightTarget::random(noise);
    let (Some(noisy), Some(exact)) =
        (lines(layout, &target, Some(noise)), lines(layout, &target, None))
    else {
        return [None; 3];
    };
    let rank =
        |answer: &Option<SolvedState>| answer.as_ref().and_then(|a| Some(a.observability?.rank));
    let ranks = answers(&exact).map(|answer| rank(&answer));
    let mut outcomes = [None; 3];
    for ((outcome, answer), true_rank) in outcomes.iter_mut().zip(answers(&noisy)).zip(ranks) {
        let rank_is_true = rank(&answer) == true_rank;
        *outcome = answer.map(|answer| SolverOutcome::of(&answer, &target, rank_is_true));
    }
    outcomes
}

/// How one solver's fixes describe what they do not determine.
fn said(
    series: &str,
    at: f64,
    outcomes: &[&SolverOutcome],
    degeneracy: Degeneracy,
) -> Vec<TableRow> {
    let of_solver: Vec<Observability> = outcomes.iter().filter_map(|o| o.observability).collect();
    if of_solver.is_empty() {
        return Vec::new();
    }
    let weak: Vec<WeakAxis> = of_solver.iter().filter_map(|o| o.weak_axis).collect();
    let row = |what: &str, figure| TableRow::new(format!("{series}: {what}"), at, figure);
    let mut degenerate = row("share that say so", share(of_solver.iter().map(|o| !o.is_full())));
    degenerate.limit = match degeneracy {
        Degeneracy::Regular => Some(Limit::AtMost(0.01)),
        Degeneracy::OfPlace => None,
        Degeneracy::OfTimes => Some(Limit::AtLeast(0.99)),
    };
    // Noise must not make a singular system look regular.
    let truly = share(outcomes.iter().map(|o| o.rank_is_true));
    let truly = row("rank is that without noise", truly).limit(Limit::AtLeast(0.95));
    let mut rows = vec![degenerate, truly];
    if !weak.is_empty() {
        let velocity = share(weak.iter().map(|axis| axis.quantity == Quantity::Velocity));
        rows.push(row("of these, of a velocity", velocity));
        for (index, axis) in ["x", "y", "z"].into_iter().enumerate() {
            let along: Vec<f64> = weak.iter().map(|weak| weak.direction[index].abs()).collect();
            rows.push(row(&format!("mean |{axis}| of the axis"), mean(&along)));
        }
    }
    rows
}

/// Requirement on a solver's error. The MAP's must not exceed the independent implementation's. The
/// papers' inverse must have the same error, as it serves for comparison, except where noise makes
/// a singular matrix look regular: its error has no finite variance there.
fn asked(solver: usize, degeneracy: Degeneracy, value: f64, tolerance: f64) -> Option<Limit> {
    match (SOLVERS[solver], degeneracy) {
        (name, _) if name == SOLVERS[2] => Some(Limit::AtMost(value + tolerance)),
        (_, Degeneracy::OfPlace) => None,
        _ => Some(Limit::Near { value, tolerance }),
    }
}

/// Condition numbers, errors, and what the fixes state of their degeneracy.
pub(super) fn tables(options: ValidationOptions) -> Vec<Table> {
    let (mut conditions, mut positions, mut velocities, mut says) =
        (vec![], vec![], vec![], vec![]);
    for (number, (layout, known)) in LAYOUTS.iter().zip(&INDEPENDENT).enumerate() {
        let at = (number + 1) as f64;
        conditions.push(condition_row(layout, known, at));
        let runs = runs::all(CHEAP * options.runs, |index| {
            run(layout, &mut Noise::new(options.seed, index))
        });
        for (solver, name) in SOLVERS.into_iter().enumerate() {
            let answered: Vec<&SolverOutcome> =
                runs.iter().filter_map(|run| run[solver].as_ref()).collect();
            let series = format!("{}: {name}", layout.name);
            let errors = known.errors.as_ref();
            let expected = [errors.map(|e| e.papers), None, errors.map(|e| e.map)][solver];
            for (quantity, rows) in [&mut positions, &mut velocities].into_iter().enumerate() {
                let errors: Vec<f64> =
                    answered.iter().map(|outcome| outcome.errors[quantity]).collect();
                let figure = root_mean_square(&errors);
                let mut row = TableRow::new(&series, at, figure);
                if let Some(value) = expected.map(|expected| expected[quantity]) {
                    let digit = [0.01, 1.0][quantity];
                    let tolerance = independent_tolerance(
                        figure.standard_error,
                        errors.len(),
                        INDEPENDENT_RUNS,
                        digit,
                    );
                    row = row.independent(value);
                    row.limit = asked(solver, known.degeneracy, value, tolerance);
                }
                rows.push(row);
            }
            says.extend(said(&series, at, &answered, known.degeneracy));
        }
    }
    let table =
        |name, title: &str, y, rows| Table { name, title: title.to_owned(), x: "layout", y, rows };
    vec![
        table(
            "degenerate-condition",
            "Condition number of the papers' system, target at rest",
            "",
            conditions,
        ),
        table("degenerate-position", "RMS error of the position, one period", "m", positions),
        table("degenerate-velocity", "RMS error of the velocity, one period", "m/s", velocities),
        table("degenerate-said", "What degenerate fixes say of themselves", "share", says),
    ]
}

fn condition_row(layout: &PaperSite, known: &KnownFigures, at: f64) -> TableRow {
    let exact = lines(layout, &StraightTarget::at_rest(Point3::origin()), None);
    let solution =
        exact.and_then(|[first, second, third]| triple([&first, &second, &third], VELOCITY_SD));
    let condition = solution.map_or(f64::NAN, |s| s.observability.condition_number);
    let row = TableRow::new(layout.name, at, SampleStatistic::exact(condition));
    if known.condition > SINGULAR {
        return row.limit(Limit::AtLeast(SINGULAR));
    }
    let tolerance = 0.05 * known.condition;
    row.independent(known.condition).limit(Limit::Near { value: known.condition, tolerance })
}
