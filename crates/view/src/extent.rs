use nalgebra::{Point3, Vector3};

/// A box along the world's axes that contains all points it was given.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct BoundingBox(Option<Bounds>);

/// Two opposite corners of a box.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bounds {
    /// The least coordinates on every axis.
    pub(crate) low: Point3<f64>,
    /// The greatest coordinates on every axis.
    pub(crate) high: Point3<f64>,
}

impl BoundingBox {
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
        let bounds = self.0.get_or_insert(Bounds { low: point, high: point });
        bounds.low = bounds.low.inf(&point);
        bounds.high = bounds.high.sup(&point);
    }

    /// Whether no point was included.
    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_none()
    }

    /// Its lowest and highest corner; both at the origin if the box is empty.
    pub(crate) fn bounds(&self) -> Bounds {
        self.0.unwrap_or(Bounds { low: Point3::origin(), high: Point3::origin() })
    }

    /// Its eight corners.
    pub(crate) fn corners(&self) -> impl Iterator<Item = Point3<f64>> + use<> {
        let Bounds { low, high } = self.bounds();
        let pick = move |upper: bool, axis: usize| if upper { high[axis] } else { low[axis] };
        (0..8_usize).map(move |corner| {
            Point3::from(Vector3::from_fn(|axis, _| pick(corner >> axis & 1 == 1, axis)))
        })
    }

    /// Its centre.
    pub(crate) fn middle(&self) -> Point3<f64> {
        let Bounds { low, high } = self.bounds();
        nalgebra::center(&low, &high)
    }
}
