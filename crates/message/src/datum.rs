use std::ops::Range;

use nalgebra::{Matrix3, Matrix6, Point3, SMatrix, Vector3 as Vector};

use crate::covariance::is_covariance;
use crate::{SiteDatum, Timestamp};

/// Largest standard deviation that is accepted (m, rad, s, ratios); anything larger is not known at
/// all: the Earth is as large in metres. With half of it the same.
const LARGEST_SD: f64 = 1e7;

/// Uncertainty of a site as a whole: errors that all its places and times have in common.
///
/// Tracks of one site do not notice these errors, and their covariances do not contain them.
/// Whoever compares tracks with places from elsewhere adds this covariance.
///
/// ```
/// use crossfix_message::{Datum, Timestamp};
/// use nalgebra::{Point3, SMatrix, Vector3};
///
/// // The log that the site was calibrated by may lie 2 m beside, and is level to 10 mrad.
/// let sd: [f64; 9] = [2.0, 2.0, 2.0, 0.01, 0.01, 0.01, 0.0, 0.0, 0.0];
/// let covariance = SMatrix::from_diagonal(&sd.map(|sd| sd * sd).into());
/// let datum = Datum { middle: Point3::origin(), time: Timestamp::EPOCH, covariance };
/// let of_state = datum.of_state(&Point3::new(300.0, 0.0, 0.0), &Vector3::zeros(), Timestamp::EPOCH);
/// assert!((of_state[(0, 0)].sqrt() - 2.0).abs() < 1e-9);
/// assert!((of_state[(2, 2)].sqrt() - 2.0_f64.hypot(300.0 * 0.01)).abs() < 1e-9);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Datum {
    /// The point about which the site turns and grows, local ENU, m.
    pub middle: Point3<f64>,
    /// The reference time of the clocks' errors: lateness is the common offset at this time, and
    /// slowness accumulates from it.
    pub time: Timestamp,
    /// Covariance of shift (m, 3), turn (rad, 3), growth (a ratio), lateness (s) and slowness (a
    /// ratio): true less stated.
    pub covariance: SMatrix<f64, { Datum::WAYS }, { Datum::WAYS }>,
}

impl Datum {
    /// Number of parameters by which a site may be off as a whole.
    pub const WAYS: usize = 9;
    /// Index of the first of three turns among them.
    pub const TURN: usize = 3;
    /// Index of growth.
    pub const GROWTH: usize = 6;
    /// Index of lateness, the clocks' common offset.
    pub const LATE: usize = 7;
    /// Index of slowness, the clocks' common rate.
    pub const SLOW: usize = 8;

    /// Index ranges of parameters that share a unit.
    const UNITS: [Range<usize>; 5] = [
        0..Self::TURN,
        Self::TURN..Self::GROWTH,
        Self::GROWTH..Self::LATE,
        Self::LATE..Self::SLOW,
        Self::SLOW..Self::WAYS,
    ];

    /// Standard deviations, in the covariance's order.
    pub fn sd(&self) -> [f64; Self::WAYS] {
        std::array::from_fn(|way| self.covariance[(way, way)].max(0.0).sqrt())
    }

    /// Covariance of the position (m) and velocity (m/s) of a target at a place at a time, owing to
    /// these errors.
    pub fn of_state(
        &self,
        position: &Point3<f64>,
        velocity: &Vector<f64>,
        time: Timestamp,
    ) -> Matrix6<f64> {
        let arm = position - self.middle;
        // J C J', with J the derivatives of position p and velocity v. With arm = p - middle: a
        // turn w adds w x arm to p and w x v to v; growth g adds g arm and g v; lateness d adds
        // -d v to p; slowness s adds -s v (t - time) to p and -s v to v.
        let mut by_datum = SMatrix::<f64, 6, { Self::WAYS }>::zeros();
        by_datum.fixed_view_mut::<3, 3>(0, 0).copy_from(&Matrix3::identity());
        by_datum.fixed_view_mut::<3, 3>(0, Self::TURN).copy_from(&-arm.cross_matrix());
        by_datum.fixed_view_mut::<3, 1>(0, Self::GROWTH).copy_from(&arm);
        by_datum.fixed_view_mut::<3, 1>(0, Self::LATE).copy_from(&-velocity);
        let slow = -velocity * time.seconds_since(self.time);
        by_datum.fixed_view_mut::<3, 1>(0, Self::SLOW).copy_from(&slow);
        by_datum.fixed_view_mut::<3, 3>(3, Self::TURN).copy_from(&-velocity.cross_matrix());
        by_datum.fixed_view_mut::<3, 1>(3, Self::GROWTH).copy_from(velocity);
        by_datum.fixed_view_mut::<3, 1>(3, Self::SLOW).copy_from(&-velocity);
        by_datum * self.covariance * by_datum.transpose()
    }

    /// Whether its numbers are possible.
    pub fn is_possible(&self) -> bool {
        self.middle.iter().all(|value| value.is_finite())
            && is_covariance(&self.covariance, &Self::UNITS)
            && self.sd().iter().all(|sd| *sd <= LARGEST_SD)
    }
}

impl From<&Datum> for SiteDatum {
    fn from(datum: &Datum) -> Self {
        Self {
            middle: Some(datum.middle.into()),
            time_ns: datum.time.nanos(),
            // Symmetric, so row order and column order are the same.
            covariance: datum.covariance.as_slice().to_vec(),
        }
    }
}

impl SiteDatum {
    /// Reads the message; `None` where it describes no datum.
    pub fn parse(&self) -> Option<Datum> {
        let is_whole = self.covariance.len() == Datum::WAYS * Datum::WAYS;
        let datum = Datum {
            middle: self.middle?.into(),
            time: Timestamp::from_nanos(self.time_ns),
            covariance: is_whole.then(|| SMatrix::from_row_slice(&self.covariance))?,
        };
        datum.is_possible().then_some(datum)
    }
}
