//! Where the sight lines of one target meet.

use nalgebra::{Matrix2, Matrix3, Vector3};

use super::ScaleSample;

/// Where the sight lines of one target meet.
pub(super) struct Meeting {
    pub(super) place: Vector3<f64>,
    /// Covariance of the place.
    pub(super) spread: Matrix3<f64>,
    /// Sum of the squared residuals of the lines.
    pub(super) squares: f64,
}

impl Meeting {
    /// Weighted least squares, with the inverse covariance of each line.
    pub(super) fn of(samples: &[ScaleSample], weights: &[Matrix2<f64>]) -> Option<Self> {
        let (mut information, mut pull) = (Matrix3::zeros(), Vector3::zeros());
        for (sample, weight) in samples.iter().zip(weights) {
            let weighed = sample.by_position.transpose() * weight;
            information += weighed * sample.by_position;
            pull += weighed * sample.residual;
        }
        let spread = information.try_inverse()?;
        let place = spread * pull;
        let squares = samples.iter().zip(weights).map(|(sample, weight)| {
            let missed = sample.residual - sample.by_position * place;
            missed.dot(&(weight * missed))
        });
        Some(Self { place, spread, squares: squares.sum() })
    }
}
