use nalgebra::{Matrix3, Point3, Vector3};

use crate::GeometryError;

/// Equatorial radius of the WGS84 ellipsoid, m.
const EQUATORIAL_RADIUS_M: f64 = 6_378_137.0;
/// Flattening of the WGS84 ellipsoid.
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// Square of the first eccentricity of the WGS84 ellipsoid, e^2 = f (2 - f).
const ECCENTRICITY_SQUARED: f64 = FLATTENING * (2.0 - FLATTENING);
/// Steps of the latitude's iteration: each reduces the error by a factor of 200, and the first
/// leaves 1e-5. With half of it 1.6 mm would be left.
const LATITUDE_STEPS: usize = 6;

/// A place on or above the Earth: WGS84, with the height above the ellipsoid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geodetic {
    latitude: f64,
    longitude: f64,
    height: f64,
}

impl Geodetic {
    /// A place from latitude (degrees north), longitude (degrees east) and height (metres above the
    /// ellipsoid).
    ///
    /// # Errors
    /// [`GeometryError::Geodetic`] naming the number that is out of range.
    pub fn from_degrees(
        latitude_deg: f64,
        longitude_deg: f64,
        height_m: f64,
    ) -> Result<Self, GeometryError> {
        check_range("the latitude", latitude_deg, 90.0, "from -90 to 90 degrees")?;
        check_range("the longitude", longitude_deg, 180.0, "from -180 to 180 degrees")?;
        check_range("the height", height_m, 1e5, "at most 100 km from the ellipsoid")?;
        Ok(Self {
            latitude: latitude_deg.to_radians(),
            longitude: longitude_deg.to_radians(),
            height: height_m,
        })
    }

    /// Geodetic latitude, rad, north positive.
    pub fn latitude(&self) -> f64 {
        self.latitude
    }

    /// Longitude, rad, east positive.
    pub fn longitude(&self) -> f64 {
        self.longitude
    }

    /// Height above the ellipsoid, m.
    pub fn height(&self) -> f64 {
        self.height
    }

    /// Geodetic latitude, degrees.
    pub fn latitude_deg(&self) -> f64 {
        self.latitude.to_degrees()
    }

    /// Longitude, degrees.
    pub fn longitude_deg(&self) -> f64 {
        self.longitude.to_degrees()
    }

    /// The place in the Earth's own axes (ECEF), m.
    fn earth_centred(&self) -> Point3<f64> {
        let (sin, cos) = self.latitude.sin_cos();
        // Radius of curvature N = a / sqrt(1 - e^2 sin^2 lat); distance from the axis
        // (N + h) cos lat, z = (N (1 - e^2) + h) sin lat.
        let normal = EQUATORIAL_RADIUS_M / (1.0 - ECCENTRICITY_SQUARED * sin * sin).sqrt();
        let from_axis = (normal + self.height) * cos;
        Point3::new(
            from_axis * self.longitude.cos(),
            from_axis * self.longitude.sin(),
            (normal * (1.0 - ECCENTRICITY_SQUARED) + self.height) * sin,
        )
    }

    /// The place at a point of the Earth's own axes (ECEF, m), by iteration of Bowring's reduced
    /// latitude.
    fn from_earth_centred(point: Point3<f64>) -> Self {
        let from_axis = point.x.hypot(point.y);
        let polar_radius = EQUATORIAL_RADIUS_M * (1.0 - FLATTENING);
        let second = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED);
        // Start: exact on the ellipsoid.
        let mut latitude = point.z.atan2(from_axis * (1.0 - ECCENTRICITY_SQUARED));
        for _ in 0..LATITUDE_STEPS {
            // With p the distance from the axis and b = a (1 - f): tan beta = (1 - f) tan lat, then
            // tan lat = (z + e'^2 b sin^3 beta) / (p - e^2 a cos^3 beta).
            let reduced = ((1.0 - FLATTENING) * latitude.sin()).atan2(latitude.cos());
            let (sin, cos) = reduced.sin_cos();
            latitude = (point.z + second * polar_radius * sin.powi(3))
                .atan2(from_axis - ECCENTRICITY_SQUARED * EQUATORIAL_RADIUS_M * cos.powi(3));
        }
        let (sin, cos) = latitude.sin_cos();
        // h = p cos lat + z sin lat - a sqrt(1 - e^2 sin^2 lat) is valid at the poles as well,
        // where p / cos lat - N is not.
        let surface = EQUATORIAL_RADIUS_M * (1.0 - ECCENTRICITY_SQUARED * sin * sin).sqrt();
        let height = from_axis * cos + point.z * sin - surface;
        Self { latitude, longitude: point.y.atan2(point.x), height }
    }
}

/// A number of a place, refused unless it is at most `most` from zero.
fn check_range(
    what: &'static str,
    value: f64,
    most: f64,
    must: &'static str,
) -> Result<(), GeometryError> {
    // A NaN is in no range.
    let good = (-most..=most).contains(&value);
    if good { Ok(()) } else { Err(GeometryError::Geodetic { what, value, must }) }
}

/// The site's world frame on the Earth: local east, north, up at an anchor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalFrame {
    origin: Point3<f64>,
    /// Columns: east, north and up at the anchor, in the Earth's axes.
    earth_from_local: Matrix3<f64>,
}

impl LocalFrame {
    /// The frame whose origin is the anchor.
    pub fn at(anchor: Geodetic) -> Self {
        let (sin_latitude, cos_latitude) = anchor.latitude.sin_cos();
        let (sin_longitude, cos_longitude) = anchor.longitude.sin_cos();
        // East, north = up x east, and up in the Earth's axes.
        let east = Vector3::new(-sin_longitude, cos_longitude, 0.0);
        let up =
            Vector3::new(cos_latitude * cos_longitude, cos_latitude * sin_longitude, sin_latitude);
        let earth_from_local = Matrix3::from_columns(&[east, up.cross(&east), up]);
        Self { origin: anchor.earth_centred(), earth_from_local }
    }

    /// Where on Earth a point of the local frame (ENU, m) is.
    pub fn geodetic(&self, point: Point3<f64>) -> Geodetic {
        Geodetic::from_earth_centred(self.origin + self.earth_from_local * point.coords)
    }

    /// The rotation of a vector from this frame into the axes of another: those of a frame 5 km
    /// away are turned by 0.8 mrad.
    pub fn axes_at(&self, other: &Self) -> Matrix3<f64> {
        other.earth_from_local.transpose() * self.earth_from_local
    }

    /// Where in the local frame (ENU, m) a place on Earth is.
    pub fn local(&self, place: Geodetic) -> Point3<f64> {
        Point3::from(self.earth_from_local.transpose() * (place.earth_centred() - self.origin))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// 53 deg 48' 33.820" N, 2 deg 07' 46.380" E, 73 m: the worked example of IOGP's guidance note
    /// 7-2, 4.1.1.
    fn example() -> Geodetic {
        let degrees = |d: f64, m: f64, s: f64| d + m / 60.0 + s / 3600.0;
        Geodetic::from_degrees(degrees(53.0, 48.0, 33.820), degrees(2.0, 7.0, 46.380), 73.0)
            .unwrap()
    }

    #[test]
    fn the_guidance_notes_example_in_the_earths_axes() {
        let published = Point3::new(3_771_793.968, 140_253.342, 5_124_304.349);
        assert!(
            (example().earth_centred() - published).norm() < 2e-3,
            "{}",
            example().earth_centred()
        );
    }

    #[test]
    fn the_guidance_notes_example_in_local_axes() {
        let frame = LocalFrame::at(Geodetic::from_degrees(55.0, 5.0, 200.0).unwrap());
        let published = Point3::new(-189_013.869, -128_642.040, -4_220.171);
        assert!((frame.local(example()) - published).norm() < 2e-3, "{}", frame.local(example()));
    }

    #[test]
    fn a_hundred_metres_by_the_radii_of_curvature() {
        let latitude = 45_f64.to_radians();
        let frame = LocalFrame::at(Geodetic::from_degrees(45.0, 10.0, 0.0).unwrap());
        let root = (1.0 - ECCENTRICITY_SQUARED * latitude.sin().powi(2)).sqrt();
        let across = EQUATORIAL_RADIUS_M / root;
        let along = EQUATORIAL_RADIUS_M * (1.0 - ECCENTRICITY_SQUARED) / root.powi(3);
        let east = frame.geodetic(Point3::new(100.0, 0.0, 0.0));
        let north = frame.geodetic(Point3::new(0.0, 100.0, 0.0));
        // 6 388 838 m and 6 367 382 m: a hundred metres are 1.2683e-3 and 0.8998e-3 degrees.
        let expected = (100.0 / (across * latitude.cos())).to_degrees();
        assert!((east.longitude_deg() - 10.0 - expected).abs() < 1e-9);
        assert!((expected - 1.2683e-3).abs() < 1e-6, "{expected}");
        let expected = (100.0 / along).to_degrees();
        assert!((north.latitude_deg() - 45.0 - expected).abs() < 1e-8);
        assert!((expected - 0.8998e-3).abs() < 1e-7, "{expected}");
        // The tangent plane rises above the ellipsoid by d^2 / 2R.
        assert!((north.height() - 100.0_f64.powi(2) / (2.0 * along)).abs() < 1e-6);
    }

    #[test]
    fn what_is_on_no_map_is_named() {
        let refused = |latitude, longitude, height| {
            Geodetic::from_degrees(latitude, longitude, height).unwrap_err().to_string()
        };
        assert!(refused(91.0, 0.0, 0.0).contains("latitude"));
        assert!(refused(0.0, f64::NAN, 0.0).contains("longitude"));
        assert!(refused(0.0, 0.0, f64::INFINITY).contains("height"));
    }

    proptest! {
        #[test]
        fn a_place_comes_back_from_the_local_frame(
            latitude in -90.0..90.0, longitude in -180.0..180.0, height in -400.0..9000.0,
            x in -2e4..2e4, y in -2e4..2e4, z in -500.0..5000.0,
        ) {
            let frame = LocalFrame::at(Geodetic::from_degrees(latitude, longitude, height).unwrap());
            let point = Point3::new(x, y, z);
            prop_assert!((frame.local(frame.geodetic(point)) - point).norm() < 1e-6);
        }
    }
}
