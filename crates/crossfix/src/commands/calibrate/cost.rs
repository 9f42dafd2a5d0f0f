//! Predicted accuracy of a target's position at a calibrated site, and how much of its error is due
//! to the calibration.

use crossfix_calibration::{CalibratedCamera, FlightResult, SiteCalibration};
use crossfix_evaluation::bound::{Assumptions, PlannedCamera, Summary, Volume, predict};
use nalgebra::Point3;
use serde::Serialize;

use crate::planned;

/// This share of the positions at either end of each axis is not part of the volume: take-off and
/// landing are outside the watched air. With half of it ten seconds on the ground before a flight
/// of ten minutes would stretch the volume to the ground.
const LEFT_OUT_SHARE: f64 = 0.025;
/// Least side of the volume, m: a flight in one plane gets some air around it. With half of it the
/// same; without it the volume of a level flight would be empty.
const LEAST_SIDE_M: f64 = 2.0;
/// How long a target is assumed to be seen, s, as in `plan`. With half of it half as many bearings
/// count.
const WINDOW_S: f64 = 1.0;
/// Speed at which a target is assumed to fly straight, m/s, as in `plan`. With half of it errors of
/// clocks weigh half as much.
const SPEED_MPS: f64 = 15.0;
/// SD of what is known of its velocity beforehand, m/s per axis: as large as the speed. With half
/// of it the same where two cameras see the target, as the bearings determine it far better.
const VELOCITY_PRIOR_MPS: f64 = 15.0;

/// Accuracy of a target's position in the air that the flight passed through.
#[derive(Debug, Serialize)]
pub struct Cost {
    /// The box's sides, east, north, up, m.
    sides_m: [f64; 3],
    /// Share of the volume in which a fix is possible.
    fixed: f64,
    /// Position SD, m, that half of the cells with a fix do not exceed, ...
    median_sd_m: f64,
    /// ... and the one that nine tenths of them do not exceed.
    worst_tenth_sd_m: f64,
    /// The median SD if poses, lenses and clocks were exact.
    median_sd_of_exact_cameras_m: f64,
}

impl Cost {
    /// `None` where no two cameras see the flown volume.
    pub fn of(result: &FlightResult) -> Option<Self> {
        let site = SiteCalibration::from(result);
        let planned = |camera: &CalibratedCamera| planned::of_calibrated(camera, 0.0);
        let cameras: Vec<PlannedCamera> = site.cameras().iter().map(planned).collect();
        let volume = flown_through(result)?;
        let assumptions = Assumptions {
            window_s: WINDOW_S,
            speed_mps: SPEED_MPS,
            velocity_prior_sd_mps: Some(VELOCITY_PRIOR_MPS),
            target: None,
            max_range_m: None,
        };
        let exact: Vec<PlannedCamera> = cameras.iter().map(PlannedCamera::exact).collect();
        let [found, of_exact] =
            [cameras, exact].map(|cameras| Summary::of(&predict(&cameras, &volume, &assumptions)));
        Some(Self {
            sides_m: (volume.max() - volume.min()).into(),
            fixed: found.fixed,
            median_sd_m: found.position_sd_median_m?,
            worst_tenth_sd_m: found.position_sd_90_m?,
            median_sd_of_exact_cameras_m: of_exact.position_sd_median_m?,
        })
    }
}

impl std::fmt::Display for Cost {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [east, north, up] = self.sides_m;
        write!(
            f,
            "a target in the air that was flown through ({east:.0} x {north:.0} x {up:.0} m, \
             {:.0} % of it with a fix) will be known to {:.3} m in half of it and to {:.3} m in \
             nine tenths, after {WINDOW_S} s; by exact cameras to {:.3} m in half of it",
            100.0 * self.fixed,
            self.median_sd_m,
            self.worst_tenth_sd_m,
            self.median_sd_of_exact_cameras_m,
        )
    }
}

/// Least and greatest coordinate of the box along an axis: the quantiles q and 1 - q of the
/// target's coordinates, widened where they are too close.
fn side(mut along: Vec<f64>) -> Option<[f64; 2]> {
    along.sort_unstable_by(f64::total_cmp);
    let last = along.len().checked_sub(1)?;
    let beyond = (LEFT_OUT_SHARE * last as f64) as usize;
    let (low, high) = (along[beyond], along[last - beyond]);
    let wider = (0.5 * (LEAST_SIDE_M - (high - low))).max(0.0);
    Some([low - wider, high + wider])
}

/// The box around the target's positions.
fn flown_through(result: &FlightResult) -> Option<Volume> {
    let places =
        || result.cameras.iter().flat_map(|camera| &camera.fitted).map(|label| label.place);
    let ends = [0, 1, 2].map(|axis| side(places().map(|place| place[axis]).collect()));
    let [Some(east), Some(north), Some(up)] = ends else { return None };
    let corner = |k: usize| Point3::new(east[k], north[k], up[k]);
    Volume::new(corner(0), corner(1), None).ok()
}
