//! What the fusion centre finds out about its cameras: their clocks from the tracks, and which of
//! them cannot be believed.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;

use common::{Eye, Scene, eye, found, fusion_of, site, straight};
use std::collections::BTreeMap;

use crossfix_fusion::{ClockEstimate, Clocks, Fusion, FusionConfig, Output, Standing};
use crossfix_geometry::{Camera, Pose, tangent_basis};
use crossfix_message::{BearingFrame, CameraCalibration, CameraName, LastingNoise, Timestamp};
use nalgebra::{Matrix6, Point3, Rotation3, Unit, Vector2, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// A clock that is wrong: ahead by so much at time 0, and gaining.
#[derive(Clone, Copy)]
struct Clock {
    offset_s: f64,
    drift: f64,
}

/// A target that circles at 12 m/s around the middle of the site.
fn circling() -> common::Path {
    let (radius, speed) = (40.0, 12.0);
    Box::new(move |t| {
        let (sin, cos) = (speed / radius * t).sin_cos();
        Some(Point3::new(radius * cos, radius * sin, 45.0 + 5.0 * (0.2 * t).sin()))
    })
}

/// The frames with the times that these clocks give them, in the order in which they are taken.
fn with_clocks(
    frames: Vec<BearingFrame>,
    clocks: &[(&str, Clock)],
    sd_s: f64,
) -> Vec<BearingFrame> {
    frames
        .into_iter()
        .map(|mut frame| {
            if let Some((_, clock)) = clocks.iter().find(|(camera, _)| *camera == frame.camera) {
                let time = frame.capture_time_ns as f64 / 1e9;
                frame.capture_time_ns +=
                    ((clock.offset_s + clock.drift * time) * 1e9).round() as i64;
                frame.capture_time_sd_s = sd_s;
            }
            frame
        })
        .collect()
}

fn clock_of(fusion: &Fusion, camera: &str) -> ClockEstimate {
    fusion.cameras().find(|report| report.camera.as_str() == camera).unwrap().clock.unwrap()
}

#[test]
fn offsets_of_200_ms_and_drifts_of_50_ppm_are_recovered_within_a_minute() {
    let wrong = [
        ("b", Clock { offset_s: 0.2, drift: 5e-5 }),
        ("c", Clock { offset_s: -0.2, drift: -5e-5 }),
    ];
    let mut squares = Vec::new();
    for seed in 0..4 {
        let mut scene = Scene::new(vec![circling()], 60.0);
        for eye in &mut scene.eyes {
            eye.rate_hz = 30.0;
            eye.phase_s /= 3.0;
        }
        let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
        for frame in with_clocks(scene.frames(seed), &wrong, 0.2) {
            fusion.ingest(&frame);
        }
        fusion.flush();
        for (camera, clock) in wrong {
            let estimate = clock_of(&fusion, camera);
            let error = estimate.offset_s - (clock.offset_s + clock.drift * 60.0);
            assert!(
                error.abs() < 4.0 * estimate.sd_s,
                "seed {seed}, {camera}: {error} s, {estimate:?}"
            );
            squares.push(error * error);
        }
        assert!(clock_of(&fusion, "a").sd_s.abs() < 1e-12, "a clock without deviation is right");
    }
    let rms = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
    assert!(rms < 1e-3, "{rms} s");
}

#[test]
fn what_all_clocks_have_in_common_stays_unknown_and_is_said() {
    let scene = Scene::new(vec![circling()], 30.0);
    let all = ["a", "b", "c"].map(|camera| (camera, Clock { offset_s: 0.05, drift: 0.0 }));
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    for frame in with_clocks(scene.frames(3), &all, 0.1) {
        fusion.ingest(&frame);
    }
    fusion.flush();
    for camera in ["a", "b", "c"] {
        let estimate = clock_of(&fusion, camera);
        // Three clocks of 0.1 s each: their mean is known to 0.1 / sqrt(3) and no better.
        assert!((0.05..0.065).contains(&estimate.sd_s), "{estimate:?}");
        assert!(estimate.relative_sd_s < 2e-3, "{estimate:?}");
    }
}

#[test]
fn a_trusted_camera_sets_the_time_of_the_others() {
    let scene = Scene::new(vec![circling()], 40.0);
    let all = [("a", 0.0), ("b", 0.03), ("c", -0.05)]
        .map(|(c, offset_s)| (c, Clock { offset_s, drift: 0.0 }));
    let trusted: CameraName = "a".parse().unwrap();
    let clocks = Clocks { trusted: vec![trusted], ..Clocks::default() };
    let mut fusion = fusion_of(FusionConfig { clocks, ..FusionConfig::default() }, &scene.eyes);
    for frame in with_clocks(scene.frames(4), &all, 0.1) {
        fusion.ingest(&frame);
    }
    for (camera, clock) in all {
        let estimate = clock_of(&fusion, camera);
        assert!((estimate.offset_s - clock.offset_s).abs() < 1e-3, "{camera}: {estimate:?}");
    }
}

/// Five cameras, so that one of them can be outvoted.
fn five() -> Vec<Eye> {
    let middle = [0.0, 0.0, 40.0];
    let mut eyes = site();
    eyes.push(eye("d", [-40.0, 150.0, 4.0], middle, 0.015));
    eyes.push(eye("e", [-30.0, -160.0, 2.0], middle, 0.08));
    eyes
}

#[test]
fn a_camera_that_was_knocked_is_left_out_and_comes_back_when_it_is_straightened() {
    let scene = Scene { eyes: five(), ..Scene::new(vec![circling()], 60.0) };
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    let standing =
        |fusion: &Fusion| fusion.cameras().find(|r| r.camera.as_str() == "b").unwrap().standing;
    for mut frame in scene.frames(5) {
        let time = frame.capture_time_ns as f64 / 1e9;
        if frame.camera == "b" && (15.0..35.0).contains(&time) {
            for track in &mut frame.tracks {
                let turned = Rotation3::from_euler_angles(0.0, 0.02, 0.0)
                    * Vector3::from(track.bearing.unwrap());
                track.bearing = Some(turned.into());
            }
        }
        fusion.ingest(&frame);
        if (14.8..15.0).contains(&time) {
            assert_eq!(standing(&fusion), Standing::Good);
        }
        if (34.8..35.0).contains(&time) {
            assert_eq!(standing(&fusion), Standing::Excluded);
        }
    }
    fusion.flush();
    assert_eq!(standing(&fusion), Standing::Good);
    assert_eq!(fusion.counters().get("cameras_excluded"), 1);
    assert_eq!(fusion.counters().get("cameras_readmitted"), 1);
    assert!(found(&fusion, &scene.paths[0]).is_some());
    assert_eq!(fusion.tracks().filter(|track| track.is_confirmed()).count(), 1);
}

#[test]
fn a_camera_worse_than_it_says_counts_less() {
    let scene = Scene { eyes: five(), ..Scene::new(vec![circling()], 40.0) };
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    for mut frame in scene.frames(6) {
        if frame.camera == "c" {
            // It claims a third of the deviation that its bearings have.
            for track in &mut frame.tracks {
                track.covariance_xx /= 9.0;
                track.covariance_yy /= 9.0;
            }
        }
        fusion.ingest(&frame);
    }
    let reports: Vec<_> = fusion.cameras().collect();
    let worse = reports.iter().find(|report| report.camera.as_str() == "c").unwrap();
    assert_eq!(worse.standing, Standing::Doubted);
    assert!((7.5..11.0).contains(&worse.noise_factor), "{worse:?}");
    let others = reports.iter().filter(|report| report.camera.as_str() != "c");
    assert!(others.clone().all(|report| report.standing == Standing::Good), "{reports:?}");
}

/// When a target is found, s, where the third of three cameras is turned about one of its axes, rad;
/// no track may be anywhere else.
fn found_after_s(path: common::Path, axis: Vector3<f64>, turned: f64) -> Option<f64> {
    let scene = Scene::new(vec![path], 10.0);
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    let turn = Rotation3::new(axis * turned);
    let mut after_s = None;
    for mut frame in scene.frames(6) {
        if frame.camera == "c" {
            for track in &mut frame.tracks {
                track.bearing = Some((turn * Vector3::from(track.bearing.unwrap())).into());
            }
        }
        fusion.ingest(&frame);
        let is_any = fusion.tracks().any(|track| track.is_confirmed());
        let is_right = found(&fusion, &scene.paths[0]).is_some();
        assert!(is_right || !is_any, "turned by {turned}: a track that is wrong");
        let time = Timestamp::from_nanos(frame.capture_time_ns);
        after_s = after_s.or_else(|| is_right.then(|| time.seconds()));
    }
    after_s
}

/// A great speed explains the line of a turned camera in each period anew. For as long as such a
/// set of three kept the two good cameras' pair waiting, nothing was found in forty seconds.
#[test]
fn two_of_three_cameras_find_a_target_while_the_third_is_turned() {
    let paths = [circling, || straight([-40.0, 10.0, 45.0], [4.0, 1.0, 0.2])];
    for turned in [0.005, 0.01, 0.02, 0.03, 0.05, 0.1] {
        for (path, axis) in paths.iter().flat_map(|path| [(path, 0), (path, 1)]) {
            let after_s = found_after_s(path(), Vector3::ith(axis, 1.0), turned);
            assert!(after_s.is_some_and(|s| s < 8.0), "{turned} about {axis}: {after_s:?}");
        }
    }
}

/// The cameras that are said to see none of the targets, after twelve seconds of a target in which
/// the frames of the third of three cameras were changed.
fn alone(change: impl Fn(&mut BearingFrame)) -> Vec<String> {
    let scene = Scene::new(vec![circling()], 12.0);
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    for mut frame in scene.frames(6) {
        if frame.camera == "c" {
            change(&mut frame);
        }
        fusion.ingest(&frame);
    }
    assert!(found(&fusion, &scene.paths[0]).is_some());
    assert!(fusion.cameras().all(|report| report.standing != Standing::Excluded));
    let alone = fusion.cameras().filter(|report| report.is_alone);
    alone.map(|report| report.camera.to_string()).collect()
}

#[test]
fn a_camera_of_three_that_is_turned_is_no_longer_good_without_a_word() {
    assert_eq!(alone(|_| {}), [""; 0]);
    let turned = alone(|frame| {
        for track in &mut frame.tracks {
            let turn = Rotation3::from_euler_angles(0.0, 0.05, 0.0);
            track.bearing = Some((turn * Vector3::from(track.bearing.unwrap())).into());
        }
    });
    assert_eq!(turned, ["c"]);
    assert_eq!(alone(|frame| frame.tracks.clear()), [""; 0], "something may stand before it");
}

/// The calibration of a camera whose pose is off by deviations of its rotation (rad) and place (m)
/// along each axis.
fn wrongly_posed(
    eye: &Eye,
    rotation_sd: f64,
    position_sd: f64,
    rng: &mut ChaCha8Rng,
) -> CameraCalibration {
    let mut normal = |sd: f64| Vector3::from_fn(|_, _| -> f64 { StandardNormal.sample(rng) }) * sd;
    let pose = eye.camera.pose();
    let rotation = *(pose.rotation() * Rotation3::new(normal(rotation_sd))).matrix();
    let wrong = Pose::new(rotation, pose.position() + normal(position_sd)).unwrap();
    let camera = Camera::new(*eye.camera.model().intrinsics(), wrong).unwrap();
    CameraCalibration::new(&eye.name, &camera, Timestamp::EPOCH)
}

/// Mean NEES over runs in each of which the poses are off by what their calibrations say.
fn nees_with_wrong_poses(runs: u32, rotation_sd: f64, position_sd: f64) -> f64 {
    let scene = Scene::new(vec![straight([-40.0, 30.0, 50.0], [8.0, -6.0, 0.5])], 8.0);
    let mut sum = 0.0;
    for run in 0..runs {
        let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
        let mut rng = ChaCha8Rng::seed_from_u64(u64::from(run));
        for eye in &scene.eyes {
            let message = wrongly_posed(eye, rotation_sd, position_sd, &mut rng);
            fusion.calibrate(&message.with_pose_sd(rotation_sd, position_sd)).unwrap();
        }
        sum += last_nees(&mut fusion, &scene.frames(1000 + u64::from(run)), &scene.paths[0]);
    }
    sum / f64::from(runs)
}

/// The squared distance of the last track's place from the path, by its covariance: three if that
/// is honest.
fn last_nees(fusion: &mut Fusion, frames: &[BearingFrame], path: &common::Path) -> f64 {
    let mut outputs: Vec<Output> = frames.iter().flat_map(|frame| fusion.ingest(frame)).collect();
    outputs.extend(fusion.flush());
    let last = outputs.iter().rev().find_map(|output| match output {
        Output::Tracks(frame) => Some(frame),
        _ => None,
    });
    let frame = last.unwrap();
    let track = &frame.tracks[0];
    let covariance =
        Matrix6::from_row_slice(&track.covariance).fixed_view::<3, 3>(0, 0).into_owned();
    let place: Point3<f64> = track.position.unwrap().into();
    let error = place - path(frame.time_ns as f64 / 1e9).unwrap();
    (error.transpose() * covariance.try_inverse().unwrap() * error).x
}

/// Mean NEES over runs in which each camera's bearings err by `noise` beside their own noise, of
/// which the fusion knows what is `declared`.
fn nees_with_lasting_noise(runs: u32, noise: LastingNoise, declared: Option<LastingNoise>) -> f64 {
    let scene = Scene::new(vec![straight([-40.0, 30.0, 50.0], [8.0, -6.0, 0.5])], 8.0);
    let mut sum = 0.0;
    for run in 0..runs {
        let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
        for eye in &scene.eyes {
            if let Some(noise) = declared {
                let message = common::calibration(eye).with_lasting_errors(noise, 0.0);
                fusion.calibrate(&message).unwrap();
            }
        }
        let mut frames = scene.frames(1000 + u64::from(run));
        let mut rng = ChaCha8Rng::seed_from_u64(u64::from(run));
        let mut errors: BTreeMap<String, (f64, Vector2<f64>)> = BTreeMap::new();
        for frame in &mut frames {
            let time_s = frame.capture_time_ns as f64 / 1e9;
            let mut drawn = || -> Vector2<f64> {
                Vector2::from_fn(|_, _| StandardNormal.sample(&mut rng)) * noise.sd_rad
            };
            let error = match errors.get(&frame.camera) {
                None => drawn(),
                Some((before_s, before)) => {
                    let kept = (-(time_s - before_s) / noise.time_s).exp();
                    before * kept + drawn() * (1.0 - kept * kept).sqrt()
                }
            };
            errors.insert(frame.camera.clone(), (time_s, error));
            for track in &mut frame.tracks {
                let direction = Unit::new_normalize(Vector3::from(track.bearing.unwrap()));
                let moved = direction.into_inner() + tangent_basis(&direction) * error;
                track.bearing = Some(moved.normalize().into());
            }
        }
        sum += last_nees(&mut fusion, &frames, &scene.paths[0]);
    }
    sum / f64::from(runs)
}

#[test]
fn noise_that_lasts_is_in_the_covariance_where_it_is_declared() {
    let runs = 200;
    let noise = LastingNoise { sd_rad: 5e-4, time_s: 1.0 };
    let standard_error = (6.0 / f64::from(runs)).sqrt();
    let nees = nees_with_lasting_noise(runs, noise, Some(noise));
    assert!((nees - 3.0).abs() < 4.0 * standard_error, "{nees}");
    let unknown = nees_with_lasting_noise(runs, noise, None);
    assert!(unknown > 6.0, "{unknown}: the noise would not matter");
}

#[test]
fn the_uncertainty_of_poses_is_in_the_covariance_however_many_bearings_there_are() {
    let runs = 200;
    let nees = nees_with_wrong_poses(runs, 1e-3, 0.05);
    // Three degrees of freedom. The filter also treats the shift as noise of each bearing, which
    // makes it a little careful.
    let standard_error = (6.0 / f64::from(runs)).sqrt();
    assert!((2.0..3.0 + 3.0 * standard_error).contains(&nees), "{nees}");
}

#[test]
fn where_half_of_the_cameras_see_something_steadily_beside_a_target_the_poses_are_worse_than_they_say()
 {
    let mut squares = Vec::new();
    for seed in 0..30 {
        let mut rng = ChaCha8Rng::seed_from_u64(100 + seed);
        let mut scene = Scene::new(vec![circling()], 25.0);
        scene.eyes.push(eye("d", [-70.0, 130.0, 4.0], [0.0, 0.0, 40.0], 0.05));
        let mut fusion = Fusion::new(FusionConfig::default()).unwrap();
        for eye in &scene.eyes {
            // A metre off along each axis, and nobody says so.
            fusion.calibrate(&wrongly_posed(eye, 0.0, 1.0, &mut rng)).unwrap();
        }
        for frame in scene.frames(seed) {
            fusion.ingest(&frame);
        }
        let tracks: Vec<_> = fusion.tracks().filter(|track| track.is_confirmed()).collect();
        let [track] = tracks[..] else {
            // Lines that miss each other by too much for any two begin no track; two pairs of
            // cameras may each have one that fits them.
            assert_eq!(
                tracks.is_empty(),
                fusion.why_nothing().is_some(),
                "seed {seed}: nothing found is said"
            );
            continue;
        };
        let lately = |time: Timestamp| track.updated_at.seconds_since(time) < 1.0;
        let cameras = track.residuals.values().filter(|residual| lately(residual.time)).count();
        assert!(cameras >= 3, "seed {seed}: {cameras} cameras agree");
        let error = track.state().position() - circling()(track.updated_at.seconds()).unwrap();
        assert!(error.norm() < 2.0, "seed {seed}: {error}");
        squares
            .push(error.dot(&(track.state().position_covariance().try_inverse().unwrap() * error)));
    }
    squares.sort_by(f64::total_cmp);
    assert!(squares.len() >= 15, "{squares:?}");
    // Three degrees of freedom: a median of 2.4 would be honest. Errors of which half are too small
    // to show are underestimated: it is 8, and was 10 while no explanation had all poses off.
    assert!(squares[squares.len() / 2] < 9.0, "{squares:?}");
}
