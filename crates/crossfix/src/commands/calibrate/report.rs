//! What a calibration has found, for people and for programs.

use crossfix_calibration::{CameraResult, FlightResult};
use crossfix_message::{CameraName, Datum};
use serde::Serialize;

use crate::output;

/// A focal length that has moved by more than this share is remarked on.
const REMARKED: f64 = 0.003;

/// The figures of a calibration.
#[derive(Debug, Serialize)]
pub struct Figures {
    cameras: Vec<CameraFigures>,
    /// Cameras that could not be calibrated, and why not.
    refused: Vec<(String, String)>,
    /// Root mean square of the log's residuals per axis, m; absent without a log.
    log_residual_m: Option<f64>,
    /// Absent of one camera alone.
    datum: Option<DatumFigures>,
    /// Power of the target's jerk, m^2/s^5.
    jerk: f64,
}

/// What the site may be off by as a whole: standard deviations.
#[derive(Debug, Serialize)]
struct DatumFigures {
    position_sd_m: [f64; 3],
    turn_sd_mrad: [f64; 3],
    scale_sd: f64,
    time_sd_s: f64,
}

/// Beyond this nothing has said where the site is, which way round or when, m, mrad, s.
const UNKNOWN: [f64; 3] = [100.0, 1e3, 10.0];

impl std::fmt::Display for DatumFigures {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let largest = |values: [f64; 3]| values.into_iter().fold(0.0, f64::max);
        let known = |value: f64, unknown: f64, text: String| {
            if value < unknown { text } else { "not known".to_owned() }
        };
        let (position_m, turn_mrad) = (largest(self.position_sd_m), largest(self.turn_sd_mrad));
        write!(
            f,
            "the site as a whole: position {}, turn {}, size {}, time {}",
            known(position_m, UNKNOWN[0], format!("± {position_m:.3} m")),
            known(turn_mrad, UNKNOWN[1], format!("± {turn_mrad:.2} mrad")),
            known(self.scale_sd, 1.0, format!("± {:.3} %", self.scale_sd * 100.0)),
            known(self.time_sd_s, UNKNOWN[2], format!("± {:.1} ms", self.time_sd_s * 1e3)),
        )
    }
}

impl From<&Datum> for DatumFigures {
    fn from(datum: &Datum) -> Self {
        let [east, north, up, about_east, about_north, about_up, scale_sd, time_sd_s, _] =
            datum.sd();
        let turn_sd_mrad = [about_east, about_north, about_up].map(|sd| sd * 1e3);
        Self { position_sd_m: [east, north, up], turn_sd_mrad, scale_sd, time_sd_s }
    }
}

#[derive(Debug, Serialize)]
struct CameraFigures {
    name: String,
    labels: usize,
    used: usize,
    residual_px: f64,
    residual_mrad: f64,
    noise_white_px: f64,
    noise_lasting_px: f64,
    noise_lasting_s: f64,
    position_m: [f64; 3],
    position_sd_m: f64,
    pointing_sd_mrad: f64,
    focal_ratio: f64,
    focal_ratio_sd: f64,
    clock_ahead_s: f64,
    clock_sd_s: f64,
    clock_rate: f64,
    clock_wander_ms: f64,
    halves_ratio: Option<f64>,
    readout_ms: f64,
    readout_sd_ms: f64,
    verdict: &'static str,
}

/// A camera whose pointing is known worse than this is weak, mrad: at 100 m a target lies half a
/// metre aside. With half of it a minute's flight would not do.
const WEAK_POINTING_MRAD: f64 = 5.0;
/// Nor may it stand this uncertainly, m.
const WEAK_POSITION_M: f64 = 0.5;
/// Labels that err by more than this are of something else, mrad: lens files leave up to 4.
const WRONG_MRAD: f64 = 8.0;
/// A focal length that has moved by more than this share is not the file's lens, or nothing told how
/// far off the target was: lenses move by 2 %.
const WEAK_FOCAL: f64 = 0.025;
/// A camera of whose labels less than this share fits has seen something else as well.
const WEAK_SHARE: f64 = 0.8;

/// What to think of a camera, and what to do about it.
fn verdict(camera: &CameraResult, [position_m, pointing_mrad]: [f64; 2]) -> &'static str {
    let noise_mrad = camera.noise.sd_px() / camera.intrinsics().fx * 1e3;
    // The image's rows go down in the world where the camera is not held upside down.
    let is_upside_down = camera.camera.pose().rotation().matrix()[(2, 1)] > 0.5;
    if is_upside_down {
        "wrong: upside down, so heights may count downwards in the log or survey (north-east-down?)"
    } else if noise_mrad > WRONG_MRAD {
        "wrong: its labels lie far beside the target's way (another target or lens file?)"
    } else if (camera.used as f64) < WEAK_SHARE * camera.labels as f64 {
        "weak: many labels are not the target's"
    } else if (camera.focal_ratio - 1.0).abs() > WEAK_FOCAL {
        "weak: its focal length is far from its file's (another lens file, or fly nearer and farther)"
    } else if position_m > WEAK_POSITION_M || pointing_mrad > WEAK_POINTING_MRAD {
        "weak: fly longer, near and far, high and low, through all of its image"
    } else {
        "good"
    }
}

/// Takes the cameras out of a result that are wrong, and names them.
pub fn take_out_wrong(result: &mut FlightResult) -> Vec<CameraName> {
    let is_wrong =
        |camera: &mut CameraResult| CameraFigures::from(&*camera).verdict.starts_with(WRONG);
    result.cameras.extract_if(.., is_wrong).map(|camera| camera.name).collect()
}

/// How the verdict of a camera begins that must not be used.
const WRONG: &str = "wrong";

impl From<&CameraResult> for CameraFigures {
    fn from(camera: &CameraResult) -> Self {
        let focal_px = camera.intrinsics().fx;
        let clock = &camera.clock;
        let knots = clock.knots.iter();
        let straight = |knot: &crossfix_calibration::ClockKnot| {
            let middle = &clock.knots[clock.knots.len() / 2];
            knot.ahead_s - middle.ahead_s - clock.rate * (knot.time_s - middle.time_s)
        };
        let (least, most) = knots.fold((0.0_f64, 0.0_f64), |(least, most), knot| {
            (least.min(straight(knot)), most.max(straight(knot)))
        });
        let middle = &clock.knots[clock.knots.len() / 2];
        let covariance = &camera.pose_covariance;
        let position_sd_m = covariance.fixed_view::<3, 3>(3, 3).trace().sqrt();
        let pointing_sd_mrad = covariance.fixed_view::<3, 3>(0, 0).trace().sqrt() * 1e3;
        Self {
            verdict: verdict(camera, [position_sd_m, pointing_sd_mrad]),
            name: camera.name.to_string(),
            labels: camera.labels,
            used: camera.used,
            residual_px: camera.residual_px,
            residual_mrad: camera.residual_px / focal_px * 1e3,
            noise_white_px: camera.noise.white_px,
            noise_lasting_px: camera.noise.lasting_px,
            noise_lasting_s: camera.noise.lasting_s,
            position_m: camera.camera.pose().position().coords.into(),
            position_sd_m,
            pointing_sd_mrad,
            focal_ratio: camera.focal_ratio,
            focal_ratio_sd: camera.focal_ratio_sd,
            clock_ahead_s: middle.ahead_s,
            clock_sd_s: middle.sd_s,
            clock_rate: clock.rate,
            clock_wander_ms: (most - least) * 1e3,
            halves_ratio: camera.halves_ratio,
            readout_ms: clock.readout_s * 1e3,
            readout_sd_ms: clock.readout_sd_s * 1e3,
        }
    }
}

/// The figures for a program.
pub fn figures(result: &FlightResult) -> Figures {
    Figures {
        cameras: result.cameras.iter().map(CameraFigures::from).collect(),
        refused: result
            .refused
            .iter()
            .map(|(name, why)| (name.to_string(), why.to_string()))
            .collect(),
        log_residual_m: result.log_residual_m,
        datum: result.datum.as_ref().map(DatumFigures::from),
        jerk: result.jerk,
    }
}

/// The figures for people.
pub fn render(result: &FlightResult) -> String {
    let head = [
        "camera",
        "labels used",
        "residual [px]",
        "[mrad]",
        "centre SD [m]",
        "pointing SD [mrad]",
        "clock [s]",
        "SD [ms]",
        "rate [1e-6]",
        "wander [ms]",
        "read-out [ms]",
        "focal length",
        "halves",
        "verdict",
    ];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    let figures = figures(result);
    for camera in &figures.cameras {
        rows.push(vec![
            camera.name.clone(),
            format!("{} of {}", camera.used, camera.labels),
            format!("{:.2}", camera.residual_px),
            format!("{:.2}", camera.residual_mrad),
            format!("{:.3}", camera.position_sd_m),
            format!("{:.2}", camera.pointing_sd_mrad),
            format!("{:.3}", camera.clock_ahead_s),
            format!("{:.1}", camera.clock_sd_s * 1e3),
            format!("{:.0}", camera.clock_rate * 1e6),
            format!("{:.1}", camera.clock_wander_ms),
            format!("{:.1} ± {:.1}", camera.readout_ms, camera.readout_sd_ms),
            format!("{:+.2} %", 100.0 * (camera.focal_ratio - 1.0)),
            output::number(camera.halves_ratio, 1),
            camera.verdict.to_owned(),
        ]);
    }
    let moved = figures.cameras.iter().any(|camera| (camera.focal_ratio - 1.0).abs() > REMARKED);
    let remark = if moved {
        "\n\nA lens's focal length is shorter or longer at a distance than near the checkerboard that \
         its file was made with: that is usual up to 2 %."
    } else {
        ""
    };
    let refused: String = figures
        .refused
        .iter()
        .map(|(name, why)| format!("\n\ncamera `{name}` is not calibrated: it {why}"))
        .collect();
    let log = figures.log_residual_m.map_or_else(String::new, |metres| {
        format!("\n\nthe log lies {metres:.3} m beside the way, root mean square per axis")
    });
    let datum = figures.datum.map_or_else(String::new, |datum| format!("\n\n{datum}"));
    format!("{}{refused}{log}{datum}{remark}", output::table(&rows))
}
