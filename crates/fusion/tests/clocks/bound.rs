//! The Cramer-Rao bound of clocks: what all bearings of a scene, taken at once, can tell of them.

use nalgebra::{DMatrix, DVector, Point3, Vector3};

use crate::common::{Eye, Path, SD_RAD, Scene};
use crate::tally::{Clock, PoseSd};

/// Length of a piece of a turning way, s.
const PIECE_S: f64 = 0.5;
/// Standard deviation of a drift beforehand, s/s: the configuration's default.
const DRIFT_SD: f64 = 3e-5;
/// Of a coefficient of the way beforehand, m: it holds what nothing else does.
const VAGUE_M: f64 = 1e4;

/// What is known beforehand of how a target flies.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Way {
    /// Straight: six unknowns.
    Straight,
    /// With a white jerk of 1 m^2/s^5.
    Turning,
}

impl Way {
    fn coefficients(self, until_s: f64) -> usize {
        match self {
            Self::Straight => 2,
            Self::Turning => (until_s / PIECE_S).ceil() as usize + 3,
        }
    }

    /// How much each coefficient counts at a time.
    fn at(self, t: f64) -> Vec<(usize, f64)> {
        if self == Self::Straight {
            return vec![(0, 1.0), (1, t)];
        }
        let first = (t / PIECE_S).floor();
        let u = t / PIECE_S - first;
        let v = 1.0 - u;
        let weights = [
            v.powi(3),
            3.0 * u.powi(3) - 6.0 * u * u + 4.0,
            1.0 + 3.0 * u * (1.0 + u * v),
            u.powi(3),
        ];
        weights
            .into_iter()
            .enumerate()
            .map(|(i, weight)| (first as usize + i, weight / 6.0))
            .collect()
    }
}

/// The least standard deviation, s (root mean square over these clocks), with which their offsets
/// at the end of a scene of one target can be known, where poses are known to this.
pub fn bound(scene: &Scene, clocks: &[Clock], pose_sd: PoseSd, way: Way) -> f64 {
    let (path, end) = (&scene.paths[0], scene.time_s.end);
    let way_end = 3 * way.coefficients(end);
    let clocks_end = way_end + 2 * clocks.len();
    let n = clocks_end + 6 * scene.eyes.len();
    let mut information = DMatrix::<f64>::zeros(n, n);
    (0..way_end).for_each(|i| information[(i, i)] += VAGUE_M.powi(-2));
    for (i, clock) in clocks.iter().enumerate() {
        information[(way_end + 2 * i, way_end + 2 * i)] = clock.sd_s.powi(-2);
        information[(way_end + 2 * i + 1, way_end + 2 * i + 1)] = DRIFT_SD.powi(-2);
    }
    for i in clocks_end..n {
        let is_rotation = (i - clocks_end) % 6 < 3;
        let sd = if is_rotation { pose_sd.rotation_sd } else { pose_sd.position_sd };
        information[(i, i)] = sd.max(1e-9).powi(-2);
    }
    for start in 0..(way_end / 3).saturating_sub(3) {
        for (i, a) in [-1.0, 3.0, -3.0, 1.0].into_iter().enumerate() {
            for (k, b) in [-1.0, 3.0, -3.0, 1.0].into_iter().enumerate() {
                for axis in 0..3 {
                    information[(3 * (start + i) + axis, 3 * (start + k) + axis)] +=
                        a * b / PIECE_S.powi(5);
                }
            }
        }
    }
    for (index, eye) in scene.eyes.iter().enumerate() {
        let clock = clocks.iter().position(|clock| clock.camera == eye.name.as_str());
        for t in (0..).map(|k| eye.phase_s + f64::from(k) / eye.rate_hz).take_while(|t| *t < end) {
            let Some(place) = path(t).filter(|place| eye.camera.sees(*place)) else { continue };
            let mut shifts: Vec<(usize, Vector3<f64>)> = Vec::new();
            for (coefficient, weight) in way.at(t) {
                shifts.extend(
                    (0..3).map(|axis| (3 * coefficient + axis, Vector3::ith(axis, weight))),
                );
            }
            let velocity = velocity(path, t);
            if let Some(place) = clock.map(|clock| way_end + 2 * clock) {
                shifts.extend([(place, -velocity), (place + 1, -velocity * t)]);
            }
            let pose = clocks_end + 6 * index;
            let away = place - eye.camera.pose().position();
            for axis in 0..3 {
                let unit = Vector3::ith(axis, 1.0);
                shifts.extend([(pose + axis, unit.cross(&away)), (pose + 3 + axis, unit)]);
            }
            add_bearing(&mut information, eye, place, &shifts);
        }
    }
    let factor = information.cholesky().unwrap();
    let variance = |clock: usize| {
        let mut at_the_end = DVector::zeros(n);
        (at_the_end[way_end + 2 * clock], at_the_end[way_end + 2 * clock + 1]) = (1.0, end);
        at_the_end.dot(&factor.solve(&at_the_end))
    };
    ((0..clocks.len()).map(variance).sum::<f64>() / clocks.len() as f64).sqrt()
}

fn velocity(path: &Path, t: f64) -> Vector3<f64> {
    (path(t + 5e-4).unwrap() - path(t - 5e-4).unwrap()) / 1e-3
}

/// Adds what a bearing tells, of which each unknown moves the place by a vector.
fn add_bearing(
    information: &mut DMatrix<f64>,
    eye: &Eye,
    place: Point3<f64>,
    shifts: &[(usize, Vector3<f64>)],
) {
    let away = place - eye.camera.pose().position();
    let across = |shift: &Vector3<f64>| shift - away * (away.dot(shift) / away.norm_squared());
    let weight = (SD_RAD * away.norm()).powi(-2);
    for (i, a) in shifts {
        let across = across(a) * weight;
        for (k, b) in shifts {
            information[(*i, *k)] += across.dot(b);
        }
    }
}
