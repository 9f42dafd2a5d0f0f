//! Sites of whose poses nobody has declared how good they are: as good as a careful survey's, or
//! exact, as drawn ones are. How well the lines meet tells which, and a lucky one of them does not.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]
#![allow(dead_code, reason = "each test uses what it needs of the common scene")]

mod common;

use common::{Eye, Path, SD_RAD, Scene, bearing, site, straight};
use crossfix_fusion::{Fusion, FusionConfig};
use crossfix_geometry::{Camera, Pose, tangent_basis};
use crossfix_message::{BearingFrame, CameraCalibration, Timestamp};
use nalgebra::{Point3, Rotation3, Unit, Vector2, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// What a careful survey leaves, rad and m per axis.
const TURN_SD: f64 = 1e-3;
const SHIFT_SD: f64 = 0.05;

/// The eyes as they truly stand, `errors` times as badly as a careful survey leaves them.
fn drawn(eyes: &[Eye], errors: f64, random: &mut ChaCha8Rng) -> Vec<Eye> {
    let mut vector =
        |sd: f64| Vector3::from_fn(|_, _| -> f64 { StandardNormal.sample(random) }) * sd * errors;
    let displaced = eyes.iter().map(|eye| {
        let pose = eye.camera.pose();
        let rotation = Rotation3::new(vector(TURN_SD)) * pose.rotation();
        let pose = Pose::new(rotation.into_inner(), pose.position() + vector(SHIFT_SD)).unwrap();
        Eye { camera: Camera::new(*eye.camera.model().intrinsics(), pose).unwrap(), ..eye.clone() }
    });
    displaced.collect()
}

/// A target that circles and one that flies straight, for 20 s before these eyes.
fn scene(eyes: Vec<Eye>) -> Scene {
    let circling: Path = Box::new(|t| {
        let (east, north) = (0.15 * t).sin_cos();
        Some(Point3::new(35.0 * east, 35.0 * north, 45.0))
    });
    let paths = vec![circling, straight([-30.0, 20.0, 60.0], [2.0, -1.0, 0.1])];
    Scene { eyes, detection: 0.9, clutter: 0.2, ..Scene::new(paths, 20.0) }
}

/// The answers before these eyes, each of which in truth stands elsewhere.
fn answers(eyes: &[Eye], errors: f64, seed: u64) -> Vec<[f64; 2]> {
    let scene = scene(drawn(eyes, errors, &mut ChaCha8Rng::seed_from_u64(seed)));
    answers_to(eyes, &scene, &scene.frames(seed))
}

/// The errors of all answers to these frames after the third second: in metres, and in units of the
/// stated deviation.
fn answers_to(eyes: &[Eye], scene: &Scene, frames: &[BearingFrame]) -> Vec<[f64; 2]> {
    let mut fusion = Fusion::new(FusionConfig::default()).unwrap();
    for eye in eyes {
        let said = CameraCalibration::new(&eye.name, &eye.camera, Timestamp::EPOCH);
        fusion.calibrate(&said).unwrap();
    }
    let mut answers = Vec::new();
    for frame in frames {
        fusion.ingest(frame);
        for track in fusion.tracks().filter(|track| track.is_confirmed()) {
            let now = track.updated_at.seconds();
            let off = |path: &Path| (track.state().position() - path(now).unwrap()).norm();
            let error = scene.paths.iter().map(off).fold(f64::INFINITY, f64::min);
            let sd = track.state().position_covariance().trace().sqrt();
            if now > 3.0 {
                answers.push([error, error / sd]);
            }
        }
    }
    answers
}

/// The share of answers that are more than four of their stated deviations off.
fn share_beyond(answers: impl Iterator<Item = [f64; 2]>) -> f64 {
    let answers: Vec<_> = answers.collect();
    assert!(answers.len() > 10_000, "{}", answers.len());
    let beyond = answers.iter().filter(|[_, deviations]| *deviations > 4.0).count();
    beyond as f64 / answers.len() as f64
}

/// Of a site of two cameras one number shows how well its lines meet, and of a site of three three.
/// When each pose was believed as far as they alone told, 8 % of the answers of two cameras and 7 %
/// of those of three were beyond four deviations.
#[test]
fn a_lucky_pose_is_not_taken_for_an_exact_one() {
    for cameras in [2, 3] {
        let eyes = &site()[..cameras];
        let share = share_beyond((0..60).flat_map(|seed| answers(eyes, 1.0, seed)));
        assert!(share < 0.02, "{cameras} cameras: {share} of the answers beyond four deviations");
    }
}

/// Where the poses are exact, the lines show it: the tracks then claim what exact bearings would be
/// good for, far less than a careful survey's 0.15 m at 150 m. In one site of twenty they may miss
/// each other by chance as those of a camera that is off.
#[test]
fn exact_poses_are_found_to_be_exact() {
    const SITES: u64 = 40;
    for (cameras, most_m, mean_m) in [(2, 0.09, 0.075), (3, 0.06, 0.056)] {
        let mut claims = Vec::new();
        for seed in 0..SITES {
            let answers = answers(&site()[..cameras], 0.0, seed);
            let late = &answers[answers.len() / 2..];
            let stated = late.iter().map(|[metres, deviations]| metres / deviations).sum::<f64>();
            claims.push(stated / late.len() as f64);
            let squares: f64 = late.iter().map(|[_, deviations]| deviations.powi(2)).sum();
            assert!(squares / (late.len() as f64) < 3.0, "{cameras}, seed {seed}: {squares}");
        }
        let unsure = claims.iter().filter(|metres| **metres >= most_m).count();
        assert!(unsure <= SITES as usize / 20, "{cameras} cameras: {claims:?}");
        assert!(
            claims.iter().all(|metres| *metres < 1.1 * most_m),
            "{cameras} cameras: {claims:?}"
        );
        let mean = claims.iter().sum::<f64>() / claims.len() as f64;
        assert!(mean < mean_m, "{cameras} cameras: {mean} m");
    }
}

/// What image trackers say of all targets: each sits beside the middle of its target for good,
/// within what it reports, and for the first half second it is a good deal farther off than that.
fn followed(scene: &Scene, random: &mut ChaCha8Rng) -> Vec<BearingFrame> {
    let mut normal =
        |sd: f64| Vector2::from_fn(|_, _| -> f64 { StandardNormal.sample(random) }) * sd;
    let mut frames = Vec::new();
    for eye in &scene.eyes {
        let beside: Vec<_> =
            scene.paths.iter().map(|_| (normal(0.6 * SD_RAD), normal(2.0 * SD_RAD))).collect();
        for k in 0..500_u32 {
            let seconds = eye.phase_s + f64::from(k) / 25.0;
            let tracks =
                scene.paths.iter().zip(&beside).zip(1..).map(|((path, (stays, first)), id)| {
                    let place = path(seconds).unwrap();
                    let exact = Unit::new_normalize(eye.camera.pose().camera_from_world(place));
                    let settles = if seconds < 0.5 { *first } else { Vector2::zeros() };
                    let off = stays + settles + normal(0.2 * SD_RAD);
                    bearing(exact.into_inner() + tangent_basis(&exact) * off, id)
                });
            frames.push(BearingFrame {
                camera: eye.name.to_string(),
                sequence: u64::from(k),
                capture_time_ns: (seconds * 1e9).round() as i64,
                tracks: tracks.collect(),
                ..Default::default()
            });
        }
    }
    frames.sort_by_key(|frame| frame.capture_time_ns);
    frames
}

/// Before it is known that the errors of image trackers last, they pass for errors of the poses;
/// that must not be held against the poses afterwards.
#[test]
fn exact_poses_are_found_to_be_exact_by_what_image_trackers_say() {
    let eyes = site();
    let scene = scene(eyes.clone());
    let mut answers = Vec::new();
    for seed in 0..10 {
        let frames = followed(&scene, &mut ChaCha8Rng::seed_from_u64(seed));
        answers.extend(answers_to(&eyes, &scene, &frames));
    }
    let mean =
        |of: fn(&[f64; 2]) -> f64| answers.iter().map(of).sum::<f64>() / answers.len() as f64;
    // Lines that are 0.3 mrad off at 150 m, of which three meet: 0.06 m. It was 0.18 m.
    let stated = mean(|[metres, deviations]| metres / deviations);
    assert!(stated < 0.1, "{stated} m");
    let squares = mean(|[_, deviations]| deviations.powi(2));
    assert!(squares < 3.0, "{squares}");
}

/// Nor are poses that err as those of a careful survey taken for exact ones by that. It was 0.9 %
/// of the answers of three cameras.
#[test]
fn a_lucky_pose_is_not_taken_for_an_exact_one_by_what_image_trackers_say() {
    for (cameras, most) in [(2, 0.02), (3, 0.005)] {
        let eyes = &site()[..cameras];
        let answers = (0..40).flat_map(|seed| {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let scene = scene(drawn(eyes, 1.0, &mut random));
            let frames = followed(&scene, &mut random);
            answers_to(eyes, &scene, &frames)
        });
        let share = share_beyond(answers);
        assert!(share < most, "{cameras} cameras: {share} of the answers beyond four deviations");
    }
}

/// A wrong pose shifts every line of its camera alike. When it counted anew in each of them, the
/// lines told of two things before two cameras, and the one target that hovers there was not found
/// within ten seconds in eight of these sites.
#[test]
fn two_cameras_find_what_hovers() {
    let mut found_in = 0;
    for seed in 0..20 {
        let eyes = &site()[..2];
        let hovering: Path = Box::new(|t| {
            let sway = Vector3::new((0.9 * t).sin(), (0.7 * t).cos(), (0.5 * t).sin()) * 0.1;
            Some(Point3::new(0.0, 0.0, 45.0) + sway)
        });
        let truly = drawn(eyes, 1.0, &mut ChaCha8Rng::seed_from_u64(seed));
        let scene = Scene { eyes: truly, detection: 0.8, ..Scene::new(vec![hovering], 10.0) };
        let frames = scene.frames(seed);
        found_in += usize::from(!answers_to(eyes, &scene, &frames).is_empty());
    }
    assert!(found_in >= 19, "found in {found_in} of 20 sites");
}
