//! The results of a calibration, for people and for programs.

use crossfix_calibration::{
    CalibratedCamera, CameraResult, ClockResult, FlightResult, LandmarkMisfit,
};
use crossfix_message::{CameraName, Datum};
use serde::Serialize;

use super::beside_survey::BesideSurvey;
use super::compare::Difference;
use super::cost::Cost;
use super::hold_out::Worth;
use super::remarks::{self, Rests};
use super::verdict;
use crate::output;

/// The results of a calibration.
#[derive(Debug, Serialize)]
pub struct Figures {
    cameras: Vec<CameraFigures>,
    /// Cameras that could not be calibrated, with the reason.
    refused: Vec<(String, String)>,
    /// Root mean square of the log's residuals per axis, m, without the positions left out; absent
    /// without a log.
    log_residual_m: Option<f64>,
    /// Number of log positions left out because they lie far from the fitted trajectory.
    log_left_out: Option<usize>,
    /// Fit of each landmark in each camera's picture.
    landmarks: Vec<LandmarkFigures>,
    /// Remarks for people.
    remarks: Vec<String>,
    #[serde(flatten)]
    of_site: OfSite,
    /// Error of the site as a whole; absent with only one camera.
    datum: Option<DatumFigures>,
    /// Power spectral density of the target's jerk, m^2/s^5.
    jerk: f64,
}

/// Results for the site that is written, that is, without the wrong cameras.
#[derive(Debug, Serialize)]
pub struct OfSite {
    /// Fit of the surveyed positions and distances.
    pub survey: BesideSurvey,
    /// Predicted accuracy of a target; absent where no two cameras see one.
    pub cost: Option<Cost>,
    /// Accuracy on the held-out part; absent if none was held out.
    pub held_out: Option<Worth>,
    /// Difference from the earlier calibration; absent without one.
    pub beside_prior: Option<Difference>,
}

#[derive(Debug, Serialize)]
struct LandmarkFigures {
    landmark: String,
    camera: String,
    /// Clicked pixel minus predicted pixel; absent if the landmark is behind the camera.
    residual_px: Option<[f64; 2]>,
    /// The same in SDs of click and place together.
    deviations: f64,
}

impl From<&LandmarkMisfit> for LandmarkFigures {
    fn from(misfit: &LandmarkMisfit) -> Self {
        Self {
            landmark: misfit.landmark.clone(),
            camera: misfit.camera.to_string(),
            residual_px: misfit.residual_px.map(Into::into),
            deviations: misfit.deviations,
        }
    }
}

impl LandmarkFigures {
    fn row(&self) -> Vec<String> {
        let [right, below] = [0, 1].map(|axis| self.beside(axis));
        let deviations = format!("{:.1}", self.deviations);
        vec![self.landmark.clone(), self.camera.clone(), right, below, deviations]
    }

    /// The residual along an axis of the image, in words.
    fn beside(&self, axis: usize) -> String {
        self.residual_px.map_or_else(|| "behind it".to_owned(), |px| format!("{:+.1}", px[axis]))
    }
}

/// Standard deviations of the errors that the site has as a whole.
#[derive(Debug, Serialize)]
struct DatumFigures {
    position_sd_m: [f64; 3],
    turn_sd_mrad: [f64; 3],
    scale_sd: f64,
    time_sd_s: f64,
}

/// Above these SDs nothing has determined where the site is, how it is turned, or its time: m,
/// mrad, s. With half of it the same: what nothing determines keeps SDs that are far above.
const UNKNOWN: [f64; 3] = [100.0, 1e3, 10.0];

/// The text of a figure with its SD, if the SD is less than that of something `unknown`.
fn known(sd: f64, unknown: f64, text: String) -> String {
    if sd < unknown { text } else { "not known".to_owned() }
}

impl std::fmt::Display for DatumFigures {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let largest = |values: [f64; 3]| values.into_iter().fold(0.0, f64::max);
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
    /// Share of the image in which the lens is known well enough for bearings.
    image_share: f64,
    clock_ahead_s: f64,
    clock_sd_s: f64,
    clock_rate: f64,
    clock_wander_ms: f64,
    halves_ratio: Option<f64>,
    readout_ms: f64,
    readout_sd_ms: f64,
    verdict: String,
}

impl CameraFigures {
    fn row(&self) -> Vec<String> {
        vec![
            self.name.clone(),
            format!("{} of {}", self.used, self.labels),
            format!("{:.2}", self.residual_px),
            format!("{:.2}", self.residual_mrad),
            format!("{:.3}", self.position_sd_m),
            format!("{:.2}", self.pointing_sd_mrad),
            format!("{:.3}", self.clock_ahead_s),
            format!("{:.1}", self.clock_sd_s * 1e3),
            format!("{:.0}", self.clock_rate * 1e6),
            format!("{:.1}", self.clock_wander_ms),
            format!("{:.1} ± {:.1}", self.readout_ms, self.readout_sd_ms),
            format!("{:+.2} %", 100.0 * (self.focal_ratio - 1.0)),
            format!("{:.0} %", 100.0 * self.image_share),
            output::number(self.halves_ratio, 1),
            self.verdict.clone(),
        ]
    }
}

/// A copy of a result without the wrong cameras.
pub fn without_wrong(result: &FlightResult) -> FlightResult {
    let mut believed = result.clone();
    take_out_wrong(&mut believed);
    believed
}

/// Removes wrong cameras from a result, and returns their names.
pub fn take_out_wrong(result: &mut FlightResult) -> Vec<CameraName> {
    result.cameras.extract_if(.., |camera| is_wrong(camera)).map(|camera| camera.name).collect()
}

fn is_wrong(camera: &CameraResult) -> bool {
    CameraFigures::from(camera).verdict.starts_with(verdict::WRONG)
}

impl From<&CameraResult> for CameraFigures {
    fn from(camera: &CameraResult) -> Self {
        let focal_px = camera.intrinsics().fx;
        let clock = &camera.clock;
        let wander_ms = wander_s(clock) * 1e3;
        let middle = &clock.knots[clock.knots.len() / 2];
        let covariance = &camera.pose_covariance;
        let position_sd_m = covariance.fixed_view::<3, 3>(3, 3).trace().sqrt();
        let pointing_sd_mrad = covariance.fixed_view::<3, 3>(0, 0).trace().sqrt() * 1e3;
        let pose_sd =
            verdict::PoseSd { position_m: position_sd_m, pointing_mrad: pointing_sd_mrad };
        Self {
            verdict: verdict::of(camera, pose_sd, wander_ms),
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
            image_share: CalibratedCamera::from(camera).over_image().share,
            clock_ahead_s: middle.ahead_s,
            clock_sd_s: middle.sd_s,
            clock_rate: clock.rate,
            clock_wander_ms: wander_ms,
            halves_ratio: camera.halves_ratio,
            readout_ms: clock.readout_s * 1e3,
            readout_sd_ms: clock.readout_sd_s * 1e3,
        }
    }
}

/// How far a clock's knots depart from the line through the middle one, from least to most, s.
fn wander_s(clock: &ClockResult) -> f64 {
    let middle = &clock.knots[clock.knots.len() / 2];
    let departures = clock
        .knots
        .iter()
        .map(|knot| knot.ahead_s - middle.ahead_s - clock.rate * (knot.time_s - middle.time_s));
    let (least, most) = departures
        .fold((0.0_f64, 0.0_f64), |(least, most), off_s| (least.min(off_s), most.max(off_s)));
    most - least
}

/// The results for a program.
pub fn figures(result: &FlightResult, of_site: OfSite, rests: Rests) -> Figures {
    let mut remarks = remarks::of(result, rests);
    remarks.extend(of_site.survey.remark());
    Figures {
        cameras: result.cameras.iter().map(CameraFigures::from).collect(),
        refused: result
            .refused
            .iter()
            .map(|(name, why)| (name.to_string(), why.to_string()))
            .collect(),
        log_residual_m: result.log.map(|log| log.residual_m),
        log_left_out: result.log.map(|log| log.left_out),
        landmarks: result.landmarks.iter().map(LandmarkFigures::from).collect(),
        remarks,
        of_site,
        datum: result.datum.as_ref().map(DatumFigures::from),
        jerk: result.jerk,
    }
}

/// The results as a text for people.
pub fn render(result: &FlightResult, figures: &Figures) -> String {
    let refused: String = figures
        .refused
        .iter()
        .map(|(name, why)| format!("\n\ncamera `{name}` is not calibrated: it {why}"))
        .collect();
    let log = result.log.map_or_else(String::new, |log| {
        format!(
            "\n\nthe log lies {:.3} m beside the way, root mean square per axis; \
             {} of its {} places lie farther off and are left out",
            log.residual_m, log.left_out, log.samples
        )
    });
    let landmarks = paragraph(landmark_table(&figures.landmarks));
    let survey = paragraph(figures.of_site.survey.render());
    let datum = paragraph(figures.datum.as_ref());
    let cost = paragraph(figures.of_site.cost.as_ref());
    let held_out = paragraph(figures.of_site.held_out.as_ref());
    let beside_prior = paragraph(
        figures
            .of_site
            .beside_prior
            .as_ref()
            .map(|beside| format!("beside the earlier calibration:\n\n{}", beside.render())),
    );
    let remarks: String = figures.remarks.iter().map(|remark| format!("\n\n{remark}")).collect();
    format!(
        "{}{refused}{survey}{landmarks}{log}{datum}{cost}{held_out}{remarks}{beside_prior}",
        camera_table(&figures.cameras)
    )
}

/// A text with an empty line before it, if there is one.
fn paragraph(text: Option<impl std::fmt::Display>) -> String {
    text.map_or_else(String::new, |text| format!("\n\n{text}"))
}

fn camera_table(cameras: &[CameraFigures]) -> String {
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
        "image",
        "halves",
        "verdict",
    ];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    rows.extend(cameras.iter().map(CameraFigures::row));
    output::table(&rows)
}

/// How each landmark fits, if there are any.
fn landmark_table(landmarks: &[LandmarkFigures]) -> Option<String> {
    let head = ["landmark", "camera", "right of it [px]", "below [px]", "deviations"];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    rows.extend(landmarks.iter().map(LandmarkFigures::row));
    (!landmarks.is_empty()).then(|| output::table(&rows))
}
