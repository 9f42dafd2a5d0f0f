//! Rows of landmarks that were clicked in the cameras' pictures, beside a flight.

use crossfix_message::CameraName;
use nalgebra::{DMatrix, DVector, Dyn, OMatrix, U3, Vector2};

use super::model::POSE_AND_CLOCK;
use super::noise::Tails;
use super::normal::Derivative;
use super::rows::{ResidualRow, Sink, UNSEEN};
use super::state::{Flight, FlightState};
use crate::landmarks::seen::{self, ClickResidual, POSE};
use crate::survey::{Click, SurveyedLandmark};

/// A landmark's click, compared with where a flight's calibration has it.
#[derive(Clone, Debug)]
pub struct LandmarkMisfit {
    /// Its name.
    pub landmark: String,
    /// Whose picture it was clicked in.
    pub camera: CameraName,
    /// The click less where the landmark should be seen, pixels; `None` behind the camera.
    pub residual_px: Option<Vector2<f64>>,
    /// The same in standard deviations of the click and the landmark's place together: about one
    /// per axis where the stated deviations hold.
    pub deviations: f64,
}

/// A click in the picture of one of the flight's cameras.
#[derive(Clone, Copy, Debug)]
struct FlightClick<'a> {
    /// The camera's index.
    camera: usize,
    click: &'a Click,
}

impl<'a> FlightClick<'a> {
    /// `None` if the camera takes no part.
    fn of(click: &'a Click, flight: &Flight<'_>) -> Option<Self> {
        let camera = flight.cameras.iter().position(|camera| camera.name == click.camera)?;
        Some(Self { camera, click })
    }
}

impl FlightState {
    /// Rows of landmarks in the pictures. The error of a landmark's place is common to all cameras
    /// that see it, so its clicks are whitened together.
    pub(super) fn landmark_rows(&self, flight: &Flight<'_>, sink: &mut impl Sink) {
        for landmark in &flight.survey.landmarks {
            let clicks = self.clicks(flight, landmark);
            if clicks.iter().any(|(_, seen)| seen.is_none()) {
                // Counted as far off as can be: otherwise moving the landmark out of sight would
                // lower the cost.
                sink.take(&[(Vec::new(), UNSEEN), (Vec::new(), UNSEEN)], Tails::Heavy);
            }
            let seen: Vec<(FlightClick<'_>, ClickResidual)> =
                clicks.into_iter().filter_map(|(click, seen)| Some((click, seen?))).collect();
            // Its place may be another landmark's, or a click may have missed it.
            sink.take(&self.whitened_clicks(&seen).unwrap_or_default(), Tails::Heavy);
        }
    }

    /// A landmark's clicks in the pictures of the flight's cameras, and how the state sees each.
    fn clicks<'a>(
        &self,
        flight: &Flight<'_>,
        landmark: &'a SurveyedLandmark,
    ) -> Vec<(FlightClick<'a>, Option<ClickResidual>)> {
        let clicks = landmark.clicks.iter();
        let clicks = clicks.filter_map(|click| FlightClick::of(click, flight));
        clicks.map(|click| (click, self.see_click(&click, landmark))).collect()
    }

    /// How the state sees a landmark's click; `None` behind the camera.
    fn see_click(&self, click: &FlightClick<'_>, of: &SurveyedLandmark) -> Option<ClickResidual> {
        let camera = &self.cameras[click.camera];
        let state = seen::PoseAndLens {
            rotation: camera.rotation,
            centre: camera.centre,
            intrinsics: camera.intrinsics,
        };
        seen::see(&of.at, click.click.pixel, &state)
    }

    fn whitened_clicks(
        &self,
        clicks: &[(FlightClick<'_>, ClickResidual)],
    ) -> Option<Vec<ResidualRow>> {
        let (starts, rows) = (self.starts(), 2 * clicks.len());
        let mut by_place = OMatrix::<f64, Dyn, U3>::zeros(rows);
        let mut noise = DMatrix::zeros(rows, rows);
        let mut residual = DVector::zeros(rows);
        for (k, (FlightClick { click, .. }, seen)) in clicks.iter().enumerate() {
            by_place.fixed_rows_mut::<2>(2 * k).copy_from(&seen.by_place);
            residual.fixed_rows_mut::<2>(2 * k).copy_from(&seen.residual);
            (2 * k..2 * k + 2).for_each(|row| noise[(row, row)] = click.sd_px.powi(2));
        }
        // Covariance of all clicks: own noise, and the place's error that all of them share.
        noise += &by_place * by_place.transpose();
        let whitening = noise.cholesky()?.l().try_inverse()?;
        residual = &whitening * residual;
        let row = |row: usize| (derivatives(clicks, &whitening, row, &starts), residual[row]);
        Some((0..rows).map(row).collect())
    }

    /// The misfit of each click.
    pub(super) fn landmark_misfits(&self, flight: &Flight<'_>) -> Vec<LandmarkMisfit> {
        let misfits = flight.survey.landmarks.iter().flat_map(|landmark| {
            let clicks = self.clicks(flight, landmark).into_iter();
            clicks.map(|(click, seen)| LandmarkMisfit::of(landmark, click.click, seen.as_ref()))
        });
        misfits.collect()
    }
}

impl LandmarkMisfit {
    fn of(landmark: &SurveyedLandmark, click: &Click, seen: Option<&ClickResidual>) -> Self {
        Self {
            landmark: landmark.name.clone(),
            camera: click.camera.clone(),
            residual_px: seen.map(|seen| -seen.residual),
            deviations: seen.and_then(|seen| deviations(seen, click)).unwrap_or(UNSEEN),
        }
    }
}

/// Derivatives of a row of the whitened clicks.
fn derivatives(
    clicks: &[(FlightClick<'_>, ClickResidual)],
    whitening: &DMatrix<f64>,
    row: usize,
    starts: &[usize],
) -> Vec<Derivative> {
    let mut terms = Vec::new();
    // The whitening matrix is lower triangular: each row only depends on its own click and those
    // before.
    for (k, (FlightClick { camera, .. }, seen)) in clicks[..=row / 2].iter().enumerate() {
        let by = whitening.view((row, 2 * k), (1, 2)) * &seen.by;
        // A landmark tells nothing of the clock: its unknowns are skipped between pose and lens.
        let unknown = |own: usize| if own < POSE { own } else { own - POSE + POSE_AND_CLOCK };
        let own = by.iter().enumerate();
        terms.extend(own.map(|(own, value)| (starts[*camera] + unknown(own), *value)));
    }
    terms
}

fn deviations(seen: &ClickResidual, click: &Click) -> Option<f64> {
    let weight = seen.noise(click.sd_px).try_inverse()?;
    Some(seen.residual.dot(&(weight * seen.residual)).sqrt())
}
