//! The volume of air that a plan is made for, cut into cubes.

use crossfix_geometry::Camera;
use nalgebra::{Matrix3, Point3, Vector3};
use thiserror::Error;

/// Largest number of cubes of a volume: a cube takes some microseconds per camera. With half of it
/// the smallest cubes that a volume may have are a quarter larger.
const MOST_CELLS: f64 = 100_000.0;
/// Number of cubes along the longest side where their size is not given. With half of it a map
/// shows little; with twice as many there are eight times as many cubes.
const DEFAULT_CELLS_ALONG: f64 = 12.0;
/// Least eigenvalue of `sum (I - uu')` over the cameras' optical axes u, per camera: below it the
/// axes are too nearly parallel to cross. For two cameras that is an angle of 3.6 degrees. With
/// half of it, 2.6 degrees would do, where an axis that is off by one degree shifts the crossing by
/// a third of its distance.
const PARALLEL: f64 = 1e-3;
/// Half the default volume's width, relative to the median distance of the cameras from where their
/// axes cross. With half of it the volume has an eighth of the air; with twice as much it reaches
/// to the cameras.
const DEFAULT_REACH: f64 = 0.5;

/// What is wrong with a volume.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum VolumeError {
    /// A corner is not finite, or the second is not beyond the first.
    #[error(
        "the volume from {min:?} to {max:?} m is empty: each number of the second must be larger"
    )]
    Empty {
        /// The low corner.
        min: [f64; 3],
        /// The high corner.
        max: [f64; 3],
    },
    /// A cube's side that is not a positive length.
    #[error("the step is {step_m} m: it must be a positive number of metres")]
    Step {
        /// The side.
        step_m: f64,
    },
    /// Too many cubes.
    #[error("{cells:.0} cells are more than 100 000: take a larger step than {step_m} m")]
    TooMany {
        /// How many.
        cells: f64,
        /// The side.
        step_m: f64,
    },
    /// No volume is obvious.
    #[error("the cameras' optical axes do not cross in front of them: say which volume you mean")]
    NoCrossing,
}

/// A box of the world, local ENU, cut into cubes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Volume {
    min: Point3<f64>,
    step_m: f64,
    cells: [usize; 3],
}

impl Volume {
    /// The cubes of side `step_m` that cover the box between two corners, m; without a side, of a
    /// round side that cuts the longest edge into about twelve.
    ///
    /// # Errors
    /// [`VolumeError`] if the box is empty, the step is not a positive length, or there are too
    /// many cubes.
    pub fn new(
        min: Point3<f64>,
        max: Point3<f64>,
        step_m: Option<f64>,
    ) -> Result<Self, VolumeError> {
        let sides = max - min;
        if !sides.iter().all(|side| *side > 0.0 && side.is_finite()) {
            return Err(VolumeError::Empty { min: min.into(), max: max.into() });
        }
        let step_m = step_m.unwrap_or_else(|| round_number(sides.max() / DEFAULT_CELLS_ALONG));
        if !(step_m > 0.0 && step_m.is_finite()) {
            return Err(VolumeError::Step { step_m });
        }
        // An excess of a rounding error needs no cube of its own.
        let counts = sides.map(|side| (side / step_m - 1e-6).ceil().max(1.0));
        let cells: f64 = counts.product();
        if cells > MOST_CELLS {
            return Err(VolumeError::TooMany { cells, step_m });
        }
        Ok(Self { min, step_m, cells: [counts.x, counts.y, counts.z].map(|count| count as usize) })
    }

    /// A box round the point where the cameras' optical axes cross; it reaches half of the cameras'
    /// median distance from that point to each side, but not below the lowest camera's height
    /// (corners are rounded).
    ///
    /// # Errors
    /// [`VolumeError::NoCrossing`] where the axes do not cross in front of the cameras.
    pub fn where_axes_cross(cameras: &[Camera], step_m: Option<f64>) -> Result<Self, VolumeError> {
        let middle = crossing(cameras).ok_or(VolumeError::NoCrossing)?;
        let mut distances: Vec<f64> =
            cameras.iter().map(|camera| (middle - camera.pose().position()).norm()).collect();
        distances.sort_by(f64::total_cmp);
        let median = distances.get(distances.len() / 2).copied().ok_or(VolumeError::NoCrossing)?;
        // Round corners are easier to read.
        let round = round_number(DEFAULT_REACH * median / 12.0);
        let half = Vector3::repeat((DEFAULT_REACH * median / round).round() * round);
        let middle = (middle / round).map(f64::round) * round;
        let mut min = middle - half;
        let lowest =
            cameras.iter().map(|camera| camera.pose().position().z).fold(f64::INFINITY, f64::min);
        min.z = min.z.max((lowest / round).floor() * round).min(middle.z - round);
        Self::new(min, middle + half, step_m)
    }

    /// The low corner, m.
    pub fn min(&self) -> Point3<f64> {
        self.min
    }

    /// The high corner of the last cube, m.
    pub fn max(&self) -> Point3<f64> {
        self.min + Vector3::from(self.cells.map(|count| count as f64 * self.step_m))
    }

    /// The middle, m.
    pub fn middle(&self) -> Point3<f64> {
        nalgebra::center(&self.min, &self.max())
    }

    /// Side of a cube, m.
    pub fn step_m(&self) -> f64 {
        self.step_m
    }

    /// From corner to corner, m.
    pub fn diagonal_m(&self) -> f64 {
        (self.max() - self.min).norm()
    }

    /// The middle of a cube, by its column, row and layer.
    fn centre(&self, cube: [usize; 3]) -> Point3<f64> {
        self.min + Vector3::from(cube.map(|index| (index as f64 + 0.5) * self.step_m))
    }

    /// The cubes' middles, layer by layer from below, with the index of the layer.
    pub fn centres(&self) -> impl Iterator<Item = (usize, Point3<f64>)> + '_ {
        let [columns, rows, layers] = self.cells;
        let row = move |(z, y)| (0..columns).map(move |x| (z, self.centre([x, y, z])));
        (0..layers).flat_map(move |z| (0..rows).map(move |y| (z, y))).flat_map(row)
    }
}

/// The nearest of 1, 2, 5, 10, ... to a number, by ratio.
fn round_number(value: f64) -> f64 {
    let power = 10.0_f64.powf(value.log10().floor());
    let near = |factor: &f64| (value / (factor * power)).ln().abs();
    let factor = [1.0, 2.0, 5.0, 10.0].into_iter().min_by(|a, b| near(a).total_cmp(&near(b)));
    factor.unwrap_or(1.0) * power
}

/// The point nearest to all optical axes (least squares), if they cross and it is in front of all
/// cameras.
fn crossing(cameras: &[Camera]) -> Option<Point3<f64>> {
    let (mut across, mut places) = (Matrix3::zeros(), Vector3::zeros());
    for camera in cameras {
        let axis = camera.pose().rotation() * Vector3::z();
        // Normal equations: sum of (I - u u') x = sum of (I - u u') c
        let projection = Matrix3::identity() - axis * axis.transpose();
        across += projection;
        places += projection * camera.pose().position().coords;
    }
    let crosses = across.symmetric_eigenvalues().min() > PARALLEL * cameras.len() as f64;
    let middle = Point3::from(across.try_inverse().filter(|_| crosses)? * places);
    cameras.iter().all(|camera| camera.pose().camera_from_world(middle).z > 0.0).then_some(middle)
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::{Distortion, ImageSize, Intrinsics, Pose};

    use super::*;

    fn camera(position: [f64; 3], target: [f64; 3]) -> Camera {
        let size = ImageSize { width: 1000, height: 800 };
        let lens = Intrinsics {
            size,
            fx: 900.0,
            fy: 900.0,
            cx: 500.0,
            cy: 400.0,
            distortion: Distortion::None,
        };
        Camera::new(lens, Pose::looking_at(position.into(), target.into()).unwrap()).unwrap()
    }

    #[test]
    fn cubes_cover_the_box_layer_by_layer() {
        let volume =
            Volume::new(Point3::origin(), Point3::new(30.0, 20.0, 15.0), Some(10.0)).unwrap();
        let centres: Vec<_> = volume.centres().collect();
        assert_eq!(centres.len(), 3 * 2 * 2);
        assert_eq!(centres.first(), Some(&(0, Point3::new(5.0, 5.0, 5.0))));
        assert_eq!(centres.last(), Some(&(1, Point3::new(25.0, 15.0, 15.0))));
        assert_eq!(volume.max(), Point3::new(30.0, 20.0, 20.0));
    }

    #[test]
    fn impossible_volumes_are_named() {
        let (low, high) = (Point3::origin(), Point3::new(1e4, 1e4, 1e4));
        assert!(matches!(Volume::new(high, low, None), Err(VolumeError::Empty { .. })));
        let nowhere = Point3::new(f64::NAN, 1.0, 1.0);
        assert!(matches!(Volume::new(low, nowhere, None), Err(VolumeError::Empty { .. })));
        assert!(matches!(Volume::new(low, high, Some(0.0)), Err(VolumeError::Step { .. })));
        assert!(matches!(Volume::new(low, high, Some(1.0)), Err(VolumeError::TooMany { .. })));
    }

    #[test]
    fn the_default_volume_lies_where_the_axes_cross() {
        let target = [10.0, -20.0, 50.0];
        let cameras = [camera([100.0, 0.0, 3.0], target), camera([0.0, 100.0, 4.0], target)];
        let volume = Volume::where_axes_cross(&cameras, None).unwrap();
        assert!((volume.middle() - Point3::from(target)).xy().norm() < volume.step_m());
        assert!(volume.min().z < 50.0 && volume.max().z > 90.0, "{volume:?}");
        assert!(volume.min().z >= 0.0);
        // Cameras side by side, and back to back.
        for (first, second) in
            [([0.0, 99.0, 3.0], [10.0, 99.0, 3.0]), ([0.0, -99.0, 3.0], [10.0, 9.0, 3.0])]
        {
            let apart = [camera([0.0, 0.0, 3.0], first), camera([10.0, 0.0, 3.0], second)];
            assert_eq!(Volume::where_axes_cross(&apart, None), Err(VolumeError::NoCrossing));
        }
    }

    #[test]
    fn steps_are_round() {
        for (value, expected) in
            [(0.9, 1.0), (1.0, 1.0), (1.1, 1.0), (3.0, 2.0), (4.0, 5.0), (7.5, 10.0), (0.04, 0.05)]
        {
            assert!((round_number(value) - expected).abs() < 1e-9, "{value}");
        }
    }
}
