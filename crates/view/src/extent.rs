use nalgebra::{Point3, Vector3};

/// A box along the world's axes that contains all points it was given.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Extent(Option<(Point3<f64>, Point3<f64>)>);

impl Extent {
    /// The smallest box of these points.
    pub(crate) fn of(points: impl IntoIterator<Item = Point3<f64>>) -> Self {
        let mut extent = Self::default();
        points.into_iter().for_each(|point| extent.include(point));
        extent
    }

    /// Enlarges the box to contain a point; a point that is not finite is ignored.
    pub(crate) fn include(&mut self, point: Point3<f64>) {
        if !point.iter().all(|v| v.is_finite()) {
            return;
        }
        let (low, high) = self.0.get_or_insert((point, point));
        *low = low.inf(&point);
        *high = high.sup(&point);
    }

    /// Whether no point was included.
    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_none()
    }

    /// Lowest and highest corner; both at the origin if the box is empty.
    pub(crate) fn bounds(&self) -> (Point3<f64>, Point3<f64>) {
        self.0.unwrap_or((Point3::origin(), Point3::origin()))
    }

    /// Its eight corners.
    pub(crate) fn corners(&self) -> impl Iterator<Item = Point3<f64>> + use<> {
        let (low, high) = self.bounds();
        let pick = move |upper: bool, axis: usize| if upper { high[axis] } else { low[axis] };
        (0..8_usize).map(move |corner| {
            Point3::from(Vector3::from_fn(|axis, _| pick(corner >> axis & 1 == 1, axis)))
        })
    }

    /// Its centre.
    pub(crate) fn middle(&self) -> Point3<f64> {
        let (low, high) = self.bounds();
        nalgebra::center(&low, &high)
    }
}
