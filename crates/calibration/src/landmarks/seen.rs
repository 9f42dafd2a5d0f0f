//! Predicted image of a landmark, with derivatives.

use crossfix_geometry::{Intrinsics, Pixel};
use nalgebra::{
    DVector, Dyn, Matrix2, Matrix2x3, Matrix3, OMatrix, Point3, Rotation3, U2, Vector2,
};

use crate::lens;
use crate::survey::LandmarkPlace;

/// Number of unknowns of a pose: rotation about the camera's axes (rad), then its centre (m).
pub(crate) const POSE: usize = 6;

/// A camera's pose and lens.
#[derive(Clone, Debug)]
pub(crate) struct PoseAndLens {
    pub(crate) rotation: Rotation3<f64>,
    pub(crate) centre: Point3<f64>,
    pub(crate) intrinsics: Intrinsics,
}

impl PoseAndLens {
    pub(super) fn moved(&self, step: &DVector<f64>) -> Self {
        Self {
            rotation: self.rotation * Rotation3::new(step.fixed_rows::<3>(0).into_owned()),
            centre: self.centre + step.fixed_rows::<3>(3),
            intrinsics: lens::moved(&self.intrinsics, &step.as_slice()[POSE..]),
        }
    }
}

/// A click, compared with where a state has the landmark.
#[derive(Clone, Debug)]
pub(crate) struct ClickResidual {
    /// The predicted pixel less the click, pixels.
    pub(crate) residual: Vector2<f64>,
    /// Derivatives by pose and lens.
    pub(crate) by: OMatrix<f64, U2, Dyn>,
    /// Derivatives by the error of the landmark's own place or direction, in its standard
    /// deviations.
    pub(crate) by_place: Matrix2x3<f64>,
    /// Derivatives by a turn of all directions about east, north and up, rad; zero for a place.
    pub(crate) by_sky_turn: Matrix2x3<f64>,
}

impl ClickResidual {
    /// Covariance of the click, with that due to the landmark's own place, pixels^2.
    pub(crate) fn noise(&self, click_sd_px: f64) -> Matrix2<f64> {
        self.by_place * self.by_place.transpose() + Matrix2::identity() * click_sd_px.powi(2)
    }
}

/// A landmark as a state sees it, compared with its click; `None` behind the camera.
pub(crate) fn see(
    at: &LandmarkPlace,
    clicked: Pixel,
    state: &PoseAndLens,
) -> Option<ClickResidual> {
    let camera_from_world = state.rotation.inverse();
    let offset = match at {
        LandmarkPlace::Place { position, .. } => camera_from_world * (position - state.centre),
        LandmarkPlace::Direction { direction, .. } => camera_from_world * direction.into_inner(),
    };
    let seen = lens::project(&state.intrinsics, &offset)?;
    let by_place: Matrix2x3<f64> = seen.by_point * camera_from_world.matrix();
    let count = lens::numbers(&state.intrinsics);
    let mut by = OMatrix::<f64, U2, Dyn>::zeros(POSE + count);
    // R <- R exp(d) turns the point in the camera by point x d.
    by.fixed_columns_mut::<3>(0).copy_from(&(seen.by_point * offset.cross_matrix()));
    let (by_place, by_sky_turn) = match at {
        LandmarkPlace::Place { sd_m, .. } => {
            by.fixed_columns_mut::<3>(3).copy_from(&-by_place);
            (by_place * Matrix3::from_diagonal(sd_m), Matrix2x3::zeros())
        }
        LandmarkPlace::Direction { direction, sd_rad } => {
            (by_place * *sd_rad, -by_place * direction.cross_matrix())
        }
    };
    for (number, by_number) in seen.by_lens[..count].iter().enumerate() {
        by.set_column(POSE + number, by_number);
    }
    let residual = seen.pixel - Vector2::new(clicked.x(), clicked.y());
    Some(ClickResidual { residual, by, by_place, by_sky_turn })
}
