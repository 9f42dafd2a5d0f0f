use nalgebra::{Matrix6, Unit, Vector3, Vector6};

/// How much a system of equations says about its unknowns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observability {
    /// Number of unknowns, or combinations of them, that the data determine better than the prior
    /// scale.
    pub rank: usize,
    /// Number of unknowns.
    pub unknowns: usize,
    /// Largest singular value of the system over the smallest; infinite if that is 0.
    pub condition_number: f64,
    /// Combination that the data determine least; `None` if they determine everything well enough.
    pub weak_axis: Option<WeakAxis>,
}

/// The quantity that makes up the greater part of a combination of unknowns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Quantity {
    /// The position, or a range.
    Position,
    /// The velocity.
    Velocity,
    /// The acceleration.
    Acceleration,
}

/// The worst determined combination of the unknowns of a degenerate system.
///
/// Unknowns are compared in units of their prior scales: the combination is the singular vector of
/// the scaled system, and this is the greatest part of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WeakAxis {
    /// The quantity that cannot be observed.
    pub quantity: Quantity,
    /// Along which line, world frame; its greatest component is positive.
    pub direction: Unit<Vector3<f64>>,
}

/// What a combination of unknowns has of one quantity.
#[derive(Clone, Copy, Debug)]
struct Part {
    quantity: Quantity,
    vector: Vector3<f64>,
}

impl WeakAxis {
    /// The part of a combination with the greatest norm; `None` if the combination is zero.
    fn of_parts(parts: &[Part]) -> Option<Self> {
        let largest = parts.iter().max_by(|a, b| a.vector.norm().total_cmp(&b.vector.norm()))?;
        let &Part { quantity, vector } = largest;
        let direction = Unit::try_new(vector, f64::MIN_POSITIVE)?;
        let sign = if direction[direction.iamax()] < 0.0 { -1.0 } else { 1.0 };
        Some(Self { quantity, direction: Unit::new_unchecked(direction.into_inner() * sign) })
    }

    /// The same for a combination of ranges followed by velocity, then acceleration: a range that
    /// is not known is a place on that range's line that is not known.
    pub(crate) fn of_ranges(
        combination: &[f64],
        directions: &[Unit<Vector3<f64>>],
    ) -> Option<Self> {
        let (ranges, motion) = combination.split_at_checked(directions.len())?;
        let along = ranges.iter().zip(directions).map(|(range, a)| a.into_inner() * *range);
        let along = along.max_by(|a, b| a.norm().total_cmp(&b.norm())).unwrap_or_default();
        // All ranges together are one part: they move with the one target.
        let length = ranges.iter().map(|range| range * range).sum::<f64>().sqrt();
        let position = along.try_normalize(f64::MIN_POSITIVE).unwrap_or_default() * length;
        let mut parts = vec![Part { quantity: Quantity::Position, vector: position }];
        let quantities = [Quantity::Velocity, Quantity::Acceleration];
        let motion = motion.chunks_exact(3).map(Vector3::from_column_slice);
        let motion = quantities.into_iter().zip(motion);
        parts.extend(motion.map(|(quantity, vector)| Part { quantity, vector }));
        Self::of_parts(&parts)
    }
}

impl Observability {
    /// Of a system in which everything can be observed.
    pub fn full(unknowns: usize, condition_number: f64) -> Self {
        Self { rank: unknowns, unknowns, condition_number, weak_axis: None }
    }

    /// Of a system that has not been examined yet.
    pub(crate) fn unexamined(unknowns: usize) -> Self {
        Self { rank: 0, unknowns, condition_number: f64::INFINITY, weak_axis: None }
    }

    /// Whether all unknowns can be observed.
    pub fn is_full(&self) -> bool {
        self.rank == self.unknowns
    }

    /// From the singular values of a system whose unknowns are scaled to 1 and whose right-hand
    /// side is in metres, compared with the noise of the right-hand side in metres.
    ///
    /// A direction of singular value s is known to `noise / s` of its scale; beyond 1 the prior
    /// scale knows better. A fixed threshold on the condition number does not do: noise makes a
    /// singular system look regular. If the rank is not full, `weak_axis` is called with the index
    /// of the least singular value and says what its singular vector means.
    pub(crate) fn of_singular_values(
        values: &[f64],
        noise: f64,
        weak_axis: impl FnOnce(usize) -> Option<WeakAxis>,
    ) -> Self {
        let largest = values.iter().copied().fold(0.0, f64::max);
        let smallest = values.iter().copied().fold(f64::INFINITY, f64::min);
        let rank = values.iter().filter(|&&value| determined(value, noise, largest)).count();
        let worst = values.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1));
        let degenerate = worst.filter(|_| rank < values.len());
        Self {
            rank,
            unknowns: values.len(),
            condition_number: if smallest > 0.0 { largest / smallest } else { f64::INFINITY },
            weak_axis: degenerate.and_then(|(index, _)| weak_axis(index)),
        }
    }

    /// From the data's Fisher information on position and velocity, compared with prior scales.
    pub fn of_information(
        information: &Matrix6<f64>,
        position_scale: f64,
        velocity_scale: f64,
    ) -> Self {
        let [p, v] = [position_scale, velocity_scale];
        let scale = Matrix6::from_diagonal(&Vector6::new(p, p, p, v, v, v));
        // D I D, D the prior scales: an eigenvalue is how many times better than its scale a
        // combination is known, squared.
        let scaled = scale * information * scale;
        // The singular values of the scaled and whitened system, whose noise is 1.
        let singular = |eigenvalue: &f64| eigenvalue.max(0.0).sqrt();
        let values: Vec<f64> = scaled.symmetric_eigenvalues().iter().map(singular).collect();
        // The vectors cost as much again, and a good track never asks for them.
        Self::of_singular_values(&values, 1.0, |_| least_known(&scaled))
    }
}

/// The combination of position and velocity of which an information matrix says least.
fn least_known(information: &Matrix6<f64>) -> Option<WeakAxis> {
    let eigen = information.symmetric_eigen();
    let combination = eigen.eigenvectors.column(eigen.eigenvalues.imin());
    let of_state = [(Quantity::Position, 0), (Quantity::Velocity, 3)];
    let parts = of_state.map(|(quantity, row)| Part {
        quantity,
        vector: combination.fixed_rows::<3>(row).into_owned(),
    });
    WeakAxis::of_parts(&parts)
}

/// Whether the data determine the direction of a singular value.
pub(crate) fn determined(value: f64, noise: f64, largest: f64) -> bool {
    // Beside the noise, rounding: what is 1e-12 of the largest is nothing.
    value > noise.max(largest * 1e-12)
}
