//! Cues: where cameras that are turned on request should look for targets.
//!
//! One camera hands angles over; the other turns there, searches, and locks (Klochko's first paper,
//! chapter 2; for a scanning thermal receiver Klochko 2020, eq. 3). Here all cameras together hand
//! over, so a cue is a position in space as seen from the other camera. If one camera alone sees a
//! target, the range is unknown, and the cue is a stripe: the first camera's sight line as the
//! other one sees it.

use std::collections::BTreeMap;

use crossfix_filter::KinematicState;
use crossfix_geometry::{Bearing, BearingModel, tangent_basis, turn_between, turn_vector};
use crossfix_message::{
    CameraName, Cue, CueFrame, Cued, Expected, Payload, Timestamp, Vector3 as WireVector,
};
use nalgebra::{Matrix2, Matrix3, Point3, Rotation3, Unit, Vector3, Vector6};

use crate::cameras::KnownCamera;
use crate::range_chart::StateChart;
use crate::uncertainty::{CameraUncertainty, SharedTies};

/// Interval between the cues for a camera, s of data time: in that time a target at 100 m that
/// flies at 20 m/s moves by 20 mrad. With half of it twice as many messages tell of 10 mrad each.
const EVERY_S: f64 = 0.1;
/// Times ahead for which a cue predicts the bearing, s: far enough for a head that turns for a
/// second and gets no new cue for another. With half of each such a head has nothing to turn to in
/// that second.
const AHEAD_S: [f64; 5] = [0.0, 0.25, 0.5, 1.0, 2.0];
/// Most targets in one cue message: a camera looks for one at a time, and the one that it is on
/// must be among them. With half of it a camera that is on the 17th nearest is no longer told of
/// it.
const MAX_CUES: usize = 32;
/// Nodes and weights of the five-point Gauss-Hermite rule for the mean and variance of a function
/// of a standard normal variable: exact for polynomials up to the ninth power.
const NODES: [(f64, f64); 5] = [
    (0.0, 8.0 / 15.0),
    (1.355_626_179_974_266, 0.222_075_922_005_612_6),
    (-1.355_626_179_974_266, 0.222_075_922_005_612_6),
    (2.856_970_013_872_806, 0.011_257_411_327_720_69),
    (-2.856_970_013_872_806, 0.011_257_411_327_720_69),
];

/// A target's predicted states for cueing, at one time.
#[derive(Clone, Debug)]
pub(crate) struct CueTarget {
    /// Its identity.
    pub(crate) of: Cued,
    /// Position and velocity now and at each time ahead.
    pub(crate) ahead: [KinematicState; AHEAD_S.len()],
    /// Position of the camera that alone sees it; `None` if several do.
    pub(crate) seen_from: Option<Point3<f64>>,
}

impl CueTarget {
    /// A target whose state at any time from `now` on is given by `expected`.
    pub(crate) fn new(
        of: Cued,
        now: Timestamp,
        seen_from: Option<Point3<f64>>,
        expected: impl Fn(Timestamp) -> KinematicState,
    ) -> Self {
        Self { of, ahead: AHEAD_S.map(|ahead_s| expected(now.plus_seconds(ahead_s))), seen_from }
    }
}

/// When each camera was last sent a cue.
#[derive(Clone, Debug, Default)]
pub(crate) struct Cueing {
    told: BTreeMap<CameraName, Timestamp>,
}

impl Cueing {
    /// Whether a camera's next cue is due; if so, notes that it is sent.
    pub(crate) fn is_due(&mut self, camera: &CameraName, now: Timestamp) -> bool {
        let told = self.told.get(camera);
        // It is due as well if time has gone back.
        let due = told.is_none_or(|told| !(0.0..EVERY_S).contains(&now.seconds_since(*told)));
        if due {
            self.told.insert(camera.clone(), now);
        }
        due
    }
}

/// The estimate of a camera's clock.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OwnClock {
    /// By how much it is ahead, s.
    pub(crate) ahead_s: f64,
    /// Standard deviation of `ahead_s` relative to the other cameras' clocks, s.
    pub(crate) sd_s: f64,
}

/// The cue message for a camera: tracks first, then targets that one other camera alone sees; each
/// group by range, the nearest first.
pub(crate) fn cues(
    camera: &CameraName,
    known: &KnownCamera,
    now: Timestamp,
    clock: OwnClock,
    targets: &[CueTarget],
    max_range_m: f64,
) -> CueFrame {
    let own_now = now.plus_seconds(clock.ahead_s);
    let uncertainty = CameraUncertainty { time_sd_s: clock.sd_s, ..known.uncertainty() };
    // A camera needs no cue for what it alone sees itself.
    let others = targets.iter().filter(|target| target.of.camera != camera.as_str());
    let mut cues: Vec<Cue> = others
        .filter_map(|target| cue(known, &uncertainty, own_now, target))
        .filter(|cue| cue.range_m <= max_range_m)
        .collect();
    let is_track = |cue: &Cue| cue.of.as_ref().is_some_and(|of| of.track_id != 0);
    cues.sort_by(|one, other| {
        let by_range = one.range_m.total_cmp(&other.range_m);
        is_track(other).cmp(&is_track(one)).then(by_range)
    });
    cues.truncate(MAX_CUES);
    let frame =
        CueFrame { time_ns: now.nanos(), camera: camera.to_string(), cues, ..Default::default() };
    frame.stamped()
}

/// The cue of one target for one camera; `None` if the target lies at the camera itself, or may lie
/// anywhere.
fn cue(
    known: &KnownCamera,
    uncertainty: &CameraUncertainty,
    own_now: Timestamp,
    target: &CueTarget,
) -> Option<Cue> {
    let origin = known.camera.pose().position();
    let here = &target.ahead[0];
    let away = here.position() - origin;
    let range_m = away.norm();
    // sd(ln r) = sqrt(a' P a) / r^2 with a = p - c, of length r.
    let along = away.dot(&(here.position_covariance() * away)).max(0.0);
    let ahead = target.ahead.iter().zip(AHEAD_S).map(|(state, ahead_s)| {
        expected(known, uncertainty, state, target.seen_from, own_now.plus_seconds(ahead_s))
    });
    Some(Cue {
        of: Some(target.of.clone()),
        ahead: ahead.collect::<Option<_>>()?,
        range_m,
        log_range_sd: along.sqrt() / range_m.powi(2),
    })
}

/// The predicted bearing of a state in the camera's own frame; `None` if it is too uncertain for a
/// bearing.
fn expected(
    known: &KnownCamera,
    uncertainty: &CameraUncertainty,
    state: &KinematicState,
    seen_from: Option<Point3<f64>>,
    time: Timestamp,
) -> Option<Expected> {
    let origin = known.camera.pose().position();
    let (direction, covariance) = seen(state, origin, seen_from.filter(|from| *from != origin))?;
    let model = BearingModel::along(direction, (state.position() - origin).norm());
    let shared = uncertainty.shared(&model, state.velocity());
    let to_world: &Rotation3<f64> = known.camera.pose().rotation();
    let own = to_world.inverse() * direction;
    // World frame and camera frame have different tangents at the direction: turn the covariance.
    let turn = (to_world.matrix() * tangent_basis(&own)).transpose() * model.basis;
    let covariance = turn * (covariance + shared) * turn.transpose();
    if covariance.diagonal().max() > Bearing::WIDEST_RAD.powi(2) {
        return None;
    }
    Some(Expected {
        time_ns: time.nanos(),
        bearing: Some(WireVector::from(own.into_inner())),
        covariance_xx: covariance.m11,
        covariance_xy: covariance.m12,
        covariance_yy: covariance.m22,
    })
}

/// Mean direction and covariance (rad^2, along the direction's tangents) in which a state is seen
/// from `origin`. If one camera alone sees the target, from `seen_from`, the logarithm of its range
/// from there is unknown, and the moments are taken over that.
fn seen(
    state: &KinematicState,
    origin: Point3<f64>,
    seen_from: Option<Point3<f64>>,
) -> Option<(Unit<Vector3<f64>>, Matrix2<f64>)> {
    let places = match seen_from.and_then(|from| StateChart::by_range(from, state)) {
        Some(chart) => along_range(&chart, state),
        None => vec![WeightedPlace::of(state)],
    };
    let models: Vec<_> = places
        .into_iter()
        .filter_map(|WeightedPlace { weight, place, spread }| {
            Some((weight, BearingModel::new(origin, place)?, spread))
        })
        .collect();
    let sum: Vector3<f64> =
        // Mean direction of the nodes, put back on the sphere.
        models.iter().map(|(weight, model, _)| model.direction.into_inner() * *weight).sum();
    let direction = Unit::try_new(sum, 1e-9)?;
    let tangents = tangent_basis(&direction).transpose();
    let mut covariance = Matrix2::zeros();
    for (weight, model, spread) in models {
        // Offsets are measured along great circles: a stripe may be longer than a tangent plane is
        // flat. Covariance = sum of weight * (spread between the places + spread H P H' of each
        // place).
        let turn = turn_between(&model.direction, &direction)?;
        let aside = tangents * turn_vector(&turn).cross(&-direction.into_inner());
        let by = tangents * (turn.matrix() * model.basis) * model.by_position();
        covariance += (aside * aside.transpose() + by * spread * by.transpose()) * weight;
    }
    Some((direction, covariance))
}

/// A place where the target may be.
#[derive(Clone, Copy, Debug)]
struct WeightedPlace {
    weight: f64,
    place: Point3<f64>,
    /// Covariance of the place, m^2.
    spread: Matrix3<f64>,
}

impl WeightedPlace {
    /// The one place of a state.
    fn of(state: &KinematicState) -> Self {
        Self { weight: 1.0, place: state.position(), spread: state.position_covariance() }
    }
}

/// Positions along an uncertain range, each with the covariance that remains once the range is
/// given.
fn along_range(chart: &StateChart, state: &KinematicState) -> Vec<WeightedPlace> {
    let (covariance, _) = chart.expressed(&state.covariance, &SharedTies::zeros());
    let variance = covariance.m33;
    if variance <= 0.0 {
        return vec![WeightedPlace::of(state)];
    }
    let tied: Vector6<f64> = covariance.column(2).into_owned();
    // Given the log range: mean c x / sqrt(v) at node x, covariance P - c c' / v, where c is the
    // column of the log range in P and v its variance.
    let left = covariance - tied * tied.transpose() / variance;
    let places = NODES.map(|(node, weight)| {
        let point = chart.point(&(tied * (node / variance.sqrt())));
        let left = left.fixed_view::<3, 3>(0, 0);
        let spread = point.place_by * left * point.place_by.transpose();
        WeightedPlace { weight, place: point.place, spread }
    });
    places.to_vec()
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix6;

    use super::*;

    fn state(place: Point3<f64>, covariance: Matrix3<f64>) -> KinematicState {
        let mut all = Matrix6::identity() * 0.01;
        all.fixed_view_mut::<3, 3>(0, 0).copy_from(&covariance);
        let mut mean = Vector6::zeros();
        mean.fixed_rows_mut::<3>(0).copy_from(&place.coords);
        KinematicState { mean, covariance: all }
    }

    #[test]
    fn the_nodes_are_a_normal_variables() {
        let moment = |power: i32| -> f64 { NODES.iter().map(|(x, w)| w * x.powi(power)).sum() };
        for (power, value) in [(0, 1.0), (1, 0.0), (2, 1.0), (4, 3.0), (6, 15.0), (8, 105.0)] {
            assert!((moment(power) - value).abs() < 1e-9, "{power}: {}", moment(power));
        }
    }

    #[test]
    fn a_place_is_seen_as_wide_as_it_is_unknown_and_far_away() {
        let place =
            state(Point3::new(0.0, 200.0, 0.0), Matrix3::from_diagonal(&[4.0, 9.0, 1.0].into()));
        let (direction, covariance) = seen(&place, Point3::origin(), None).unwrap();
        assert!((direction.into_inner() - Vector3::y()).norm() < 1e-12);
        let by_axis =
            tangent_basis(&direction) * covariance * tangent_basis(&direction).transpose();
        assert!((by_axis[(0, 0)] - 1e-4).abs() < 1e-9, "{by_axis}");
        assert!((by_axis[(2, 2)] - 0.25e-4).abs() < 1e-9, "{by_axis}");
    }

    /// For another camera, a target of unknown range is a stripe: its length is checked against
    /// many ranges.
    #[test]
    fn an_unknown_range_is_a_stripe_along_the_others_sight_line() {
        let (one, other) = (Point3::origin(), Point3::new(100.0, 0.0, 0.0));
        // 300 m, within a factor of 1.5 or so, and a milliradian across.
        let log_sd: f64 = 0.4;
        let spread = Matrix3::from_diagonal(&[0.09, (300.0 * log_sd).powi(2), 0.09].into());
        let target = state(Point3::new(0.0, 300.0, 0.0), spread);
        let (direction, covariance) = seen(&target, other, Some(one)).unwrap();
        // A thousand ranges of equal probability.
        let angles: Vec<f64> = (0..1000)
            .map(|k| {
                let share = (f64::from(k) + 0.5) / 1000.0;
                let range = 300.0 * (log_sd * normal_quantile(share)).exp();
                f64::atan2(range, -100.0)
            })
            .collect();
        let mean = angles.iter().sum::<f64>() / 1000.0;
        let variance = angles.iter().map(|angle| (angle - mean).powi(2)).sum::<f64>() / 1000.0;
        let found = f64::atan2(direction.y, direction.x);
        assert!((found - mean).abs() < 0.1 * variance.sqrt(), "{found} {mean}");
        let axes = covariance.symmetric_eigen();
        let (long, short) = (axes.eigenvalues.max().sqrt(), axes.eigenvalues.min().sqrt());
        assert!((long / variance.sqrt() - 1.0).abs() < 0.1, "{long} {}", variance.sqrt());
        assert!(short < 0.002, "{short}");
        // For the camera that sees the target it is no stripe.
        let (_, covariance) = seen(&target, one, None).unwrap();
        assert!(covariance.trace().sqrt() < 0.002);
    }

    /// Quantile of a standard normal variable, by summing its density.
    fn normal_quantile(share: f64) -> f64 {
        let (mut x, mut below) = (-6.0, 0.0);
        while below < share {
            let step = 1e-3;
            below +=
                (-f64::powi(x + step / 2.0, 2) / 2.0).exp() / std::f64::consts::TAU.sqrt() * step;
            x += step;
        }
        x
    }
}
