//! Triangulation of the target by cameras whose poses are known roughly.

use crossfix_geometry::Ray;
use nalgebra::{Matrix3, Point3, Unit, Vector3};

use super::model::{CameraUnknowns, FlightLog, LogErrors, LogSample};
use super::pairs::{LEAST_PARALLAX_RAD, Sights};

/// Interval at which the target is placed, s. With half of it the same, in twice the time, as the
/// trajectory's knots are 0.2 s apart.
const STEP_S: f64 = 0.1;
/// Sight lines that miss their common place by more than this are not of one target, rad. With half
/// of it lens files that are 10 mrad off in a corner leave gaps in the trajectory.
const MOST_ASIDE_RAD: f64 = 0.02;
/// Least misfit assumed while lenses and clocks are not known, rad. With half of it lines that
/// happen to meet state the trajectory twice as well.
const LEAST_ASIDE_RAD: f64 = 1e-3;

/// The target's places as a log, by the cameras' common time.
pub(super) fn log(cameras: &[(&Sights, &CameraUnknowns)]) -> FlightLog {
    let (mut from, mut to) = (f64::INFINITY, f64::NEG_INFINITY);
    for (sights, state) in cameras {
        if let Some(own) = sights.span() {
            from = from.min(state.clock.common_s(own.start));
            to = to.max(state.clock.common_s(own.end));
        }
    }
    let steps = ((to - from) / STEP_S).max(0.0) as usize;
    let placed = (0..steps).filter_map(|k| sample(cameras, from + k as f64 * STEP_S));
    let (samples, mut errors_m): (Vec<LogSample>, Vec<f64>) = placed.unzip();
    errors_m.sort_unstable_by(f64::total_cmp);
    let sd_m = errors_m.get(errors_m.len() / 2).copied().unwrap_or(1.0);
    FlightLog { samples, errors: LogErrors { sd_m, drift_sd_m: 0.0, drift_time_s: 1.0 } }
}

/// The target's place at a common time, and how far it may be off, m.
fn sample(cameras: &[(&Sights, &CameraUnknowns)], time_s: f64) -> Option<(LogSample, f64)> {
    let lines = cameras.iter().filter_map(|(sights, state)| sight_line(sights, state, time_s));
    let (position, error_m) = place(&lines.collect::<Vec<_>>())?;
    Some((LogSample { time_s, position }, error_m))
}

/// A camera's line of sight to the target at a common time.
fn sight_line(sights: &Sights, state: &CameraUnknowns, time_s: f64) -> Option<Ray> {
    // At this stage clocks have neither rate nor wander.
    let direction = Unit::new_unchecked(sights.at(time_s - state.clock.offset_s)?);
    Some(Ray { origin: state.centre, direction: state.rotation * direction })
}

/// The place nearest to all lines, and how far it may be off, m. `None` where they do not meet, or
/// meet behind a camera or at too small an angle to tell.
pub(super) fn place(lines: &[Ray]) -> Option<(Point3<f64>, f64)> {
    let across =
        |ray: &Ray| Matrix3::identity() - ray.direction.as_ref() * ray.direction.transpose();
    let sum: Matrix3<f64> = lines.iter().map(across).sum();
    let right: Vector3<f64> = lines.iter().map(|ray| across(ray) * ray.origin.coords).sum();
    // Normal equations: sum of (I - d d') x = sum of (I - d d') c. Two lines that meet at an angle
    // have 1 - cos(angle) as the least eigenvalue.
    let least = sum.symmetric_eigenvalues().min();
    if lines.len() < 2 || least < LEAST_PARALLAX_RAD * LEAST_PARALLAX_RAD / 2.0 {
        return None;
    }
    let place = Point3::from(sum.cholesky()?.solve(&right));
    let mut worst = LEAST_ASIDE_RAD;
    let mut range_m = 0.0_f64;
    for Ray { origin, direction } in lines {
        let aside = (place - origin).angle(direction);
        worst = worst.max(aside);
        range_m = range_m.max((place - origin).norm());
    }
    // The worst misfit in metres, enlarged where the lines meet at small angles.
    (worst < MOST_ASIDE_RAD).then(|| (place, worst * range_m / least.sqrt()))
}
