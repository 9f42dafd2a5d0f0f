use nalgebra::{Matrix6, Vector6};

/// How much a system of equations says about its unknowns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observability {
    /// Unknowns, or combinations of them, that the data determine better than the prior scale.
    pub rank: usize,
    /// Number of unknowns.
    pub unknowns: usize,
    /// Largest singular value of the system by the smallest; infinite if that is 0.
    pub condition_number: f64,
}

impl Observability {
    /// Whether everything asked for can be seen.
    pub fn is_full(&self) -> bool {
        self.rank == self.unknowns
    }

    /// Of the singular values of a system whose unknowns are scaled to 1 and whose right-hand side
    /// is in metres, against the noise of the right-hand side in metres.
    ///
    /// A direction of singular value s is known to `noise / s` of its scale; beyond 1 the prior
    /// scale knows better. A fixed threshold on the condition number does not do: noise makes a
    /// singular system look regular.
    pub(crate) fn of_singular_values(values: &[f64], noise: f64) -> Self {
        let largest = values.iter().copied().fold(0.0, f64::max);
        let smallest = values.iter().copied().fold(f64::INFINITY, f64::min);
        Self {
            rank: values.iter().filter(|&&value| determined(value, noise, largest)).count(),
            unknowns: values.len(),
            condition_number: if smallest > 0.0 { largest / smallest } else { f64::INFINITY },
        }
    }

    /// Of a position and velocity whose data have given Fisher information, against prior scales.
    pub fn of_information(information: &Matrix6<f64>, position_scale: f64, velocity_scale: f64) -> Self {
        let [p, v] = [position_scale, velocity_scale];
        let scale = Matrix6::from_diagonal(&Vector6::new(p, p, p, v, v, v));
        let eigenvalues = (scale * information * scale).symmetric_eigenvalues();
        let values: Vec<f64> = eigenvalues.iter().map(|value| value.max(0.0).sqrt()).collect();
        Self::of_singular_values(&values, 1.0)
    }
}

/// Whether a direction of a singular value is determined by the data.
pub(crate) fn determined(value: f64, noise: f64, largest: f64) -> bool {
    value > noise.max(largest * 1e-12)
}
