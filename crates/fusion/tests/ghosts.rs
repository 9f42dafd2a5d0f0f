//! Targets that are not there: lines of several real ones that cross, and tracks that live on what
//! one camera alone sees.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;

use common::{Path, Scene, found, fusion_of, site, straight};
use crossfix_fusion::{FusedTrack, Fusion, FusionConfig, TrackStatus};
use crossfix_message::BearingFrame;
use nalgebra::{Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Thirty pictures a second of each camera.
fn quick_site() -> Vec<common::Eye> {
    let mut eyes = site();
    for eye in &mut eyes {
        eye.rate_hz = 30.0;
        eye.phase_s /= 3.0;
    }
    eyes
}

/// Straight flights through where all cameras look, at up to 15 m/s per axis.
fn crowd(count: usize, rng: &mut ChaCha8Rng) -> Vec<Path> {
    (0..count)
        .map(|_| {
            let mut within = |half: f64| rng.random_range(-half..half);
            let middle = [within(40.0), within(40.0), 45.0 + within(15.0)];
            let velocity = [within(15.0), within(15.0), within(3.0)];
            straight([0, 1, 2].map(|i: usize| middle[i] - 4.0 * velocity[i]), velocity)
        })
        .collect()
}

/// Epochs of half a second with the number of confirmed tracks at each.
fn confirmed_over_time(fusion: &mut Fusion, frames: &[BearingFrame]) -> Vec<usize> {
    let mut counts = Vec::new();
    for frame in frames {
        fusion.ingest(frame);
        let epoch = (frame.capture_time_ns / 500_000_000) as usize;
        if epoch > counts.len() {
            counts.push(fusion.tracks().filter(|track| track.is_confirmed()).count());
        }
    }
    counts
}

/// Ghosts and looks, where each camera sees fifteen targets that the two others do not, 675 pairs
/// of lines; the poses are known to so much, rad and m, and each clock to so much, s.
fn ghosts_of_strangers([rotation_sd, position_sd]: [f64; 2], clock_sd: f64) -> (usize, usize) {
    let eyes = quick_site();
    let (mut epochs, mut ghosts) = (0, 0);
    for seed in 0..4 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut frames: Vec<BearingFrame> = Vec::new();
        for eye in &eyes {
            let scene = Scene {
                eyes: vec![eye.clone()],
                clutter: 1.0,
                ..Scene::new(crowd(15, &mut rng), 8.0)
            };
            let ahead: f64 = StandardNormal.sample(&mut rng);
            let mut own = scene.frames(seed);
            for frame in &mut own {
                frame.capture_time_ns += (ahead * clock_sd * 1e9) as i64;
                frame.capture_time_sd_s = clock_sd;
            }
            frames.extend(own);
        }
        frames.sort_by_key(|frame| frame.capture_time_ns);
        let mut fusion = Fusion::new(FusionConfig::default()).unwrap();
        for eye in &eyes {
            fusion
                .calibrate(&common::calibration(eye).with_pose_sd(rotation_sd, position_sd))
                .unwrap();
        }
        let counts = confirmed_over_time(&mut fusion, &frames);
        epochs += counts.len();
        ghosts += counts.iter().sum::<usize>();
    }
    (ghosts, epochs)
}

#[test]
fn targets_that_one_camera_each_sees_make_next_to_no_tracks() {
    // Before lines were compared with each camera's own there were 308 in 60 looks, and 1299 where
    // lines pass each other by the poses' 30 cm; while lines of two objects by turns were taken for
    // one that a camera alone sees badly, 0 and 12.
    for poses in [[0.0, 0.0], [1e-3, 0.05]] {
        let (ghosts, epochs) = ghosts_of_strangers(poses, 0.0);
        assert!(ghosts * 10 <= epochs, "{poses:?}: {ghosts} ghosts in {epochs} looks");
    }
    // 1234 in 63 while nothing was compared before clocks of 30 ms.
    let (ghosts, epochs) = ghosts_of_strangers([0.0, 0.0], 0.03);
    assert!(ghosts <= epochs, "{ghosts} ghosts in {epochs} looks");
}

#[test]
fn a_track_that_only_one_of_the_cameras_goes_on_seeing_is_a_direction_and_says_so() {
    for seed in 0..5 {
        let path = || straight([-20.0, 10.0, 40.0], [2.0, -1.0, 0.1]);
        let scene = Scene { detection: 0.9, clutter: 1.0, ..Scene::new(vec![path()], 16.0) };
        let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
        let mut followed = 0;
        for mut frame in scene.frames(seed) {
            let time = frame.capture_time_ns as f64 / 1e9;
            if time > 5.0 && frame.camera != "a" {
                frame.tracks.clear();
            }
            fusion.ingest(&frame);
            if (4.9..5.0).contains(&time) {
                assert!(found(&fusion, &path()).is_some(), "seed {seed}");
            }
            // As long as it is there, the truth lies within what it claims to know.
            for track in fusion.tracks().filter(|track| track.is_confirmed()) {
                let error = track.state().position() - path()(track.updated_at.seconds()).unwrap();
                let spread = track.state().position_covariance().cholesky().unwrap();
                assert!(error.dot(&spread.solve(&error)) < 30.0, "seed {seed}, {time} s: {error}");
                followed += usize::from(time > 5.0);
            }
        }
        assert!(followed > 0, "seed {seed}");
        let left: Vec<TrackStatus> = fusion.tracks().map(|track| track.status).collect();
        assert_eq!(left, [TrackStatus::OneCamera], "seed {seed}");
    }
}

/// Whether a track is more than four of its own deviations from where the target is.
fn is_far_off(track: &FusedTrack, path: &Path) -> bool {
    let error = track.state().position() - path(track.updated_at.seconds()).unwrap();
    let spread = track.state().position_covariance().cholesky().unwrap();
    error.dot(&spread.solve(&error)) > 16.0
}

/// Flies straight until a time, then accelerates by 3 m/s^2 for three seconds along the sight line
/// of the first camera.
fn along_the_sight_line(x: f64, onset_s: f64) -> Path {
    let eye = Point3::new(-150.0, -20.0, 2.0);
    let (from, velocity) = (Point3::new(x, 10.0, 40.0), Vector3::new(2.0, 1.0, 0.1));
    let away = (from + velocity * onset_s - eye).normalize();
    Box::new(move |t| {
        let (turning, after) = ((t - onset_s).clamp(0.0, 3.0), (t - onset_s - 3.0).max(0.0));
        Some(from + velocity * t + away * (1.5 * turning.powi(2) + 9.0 * after))
    })
}

#[test]
fn what_a_target_does_along_the_last_cameras_sight_line_lies_within_what_is_claimed() {
    let (mut far_off, mut answers) = (0, 0);
    for (seed, onset_s) in (0..10).zip([10.0, 11.0, 12.0].into_iter().cycle()) {
        let path = || along_the_sight_line(-30.0 + 5.0 * seed as f64, onset_s);
        let scene = Scene::new(vec![path()], onset_s + 6.0);
        let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
        for mut frame in scene.frames(seed) {
            let time = frame.capture_time_ns as f64 / 1e9;
            if time > 9.0 && frame.camera != "a" {
                frame.tracks.clear();
            }
            fusion.ingest(&frame);
            for track in fusion.tracks().filter(|track| track.is_confirmed() && time > 9.0) {
                far_off += usize::from(is_far_off(track, &path()));
                answers += 1;
            }
        }
    }
    assert!(answers > 500, "{answers}");
    // Beyond four deviations: with one axis of every turn taken for seen it were a quarter.
    assert!(far_off * 100 <= answers, "{far_off} of {answers}");
}

/// Circles of 15 m at 8 m/s, thirty to sixty metres from the first camera.
fn circling(phase: f64) -> Path {
    Box::new(move |t| {
        let (sin, cos) = (phase + 8.0 / 15.0 * t).sin_cos();
        Some(Point3::new(-112.0 + 15.0 * cos, -7.0 + 15.0 * sin, 20.0))
    })
}

/// A target circles near a camera while the other two lose it, and each of fifty bearings a second
/// is off by 2 mrad, a tenth of a metre. Within a second the range is no longer known to a tenth,
/// and in Cartesian coordinates it ran away (2.4 % beyond four deviations).
#[test]
fn near_a_noisy_camera_that_is_left_alone_no_range_is_made_up() {
    const NOISE_RAD: f64 = 2e-3;
    let (mut far_off, mut answers) = (0, 0);
    for seed in 0..40 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut eyes = site();
        eyes.iter_mut().for_each(|eye| eye.rate_hz = 50.0);
        let path = || circling(seed as f64);
        let scene = Scene { eyes, ..Scene::new(vec![path()], 12.0) };
        let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
        for mut frame in scene.frames(seed) {
            let time = frame.capture_time_ns as f64 / 1e9;
            if time > 9.5 && frame.camera != "a" {
                frame.tracks.clear();
            }
            for track in &mut frame.tracks {
                let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
                let noise = Vector3::from_fn(|_, _| NOISE_RAD * normal());
                let direction = Vector3::from(track.bearing.unwrap()) + noise;
                track.bearing = Some(direction.normalize().into());
                (track.covariance_xx, track.covariance_yy) = (NOISE_RAD.powi(2), NOISE_RAD.powi(2));
            }
            fusion.ingest(&frame);
            for track in fusion.tracks().filter(|track| track.is_confirmed() && time > 9.5) {
                far_off += usize::from(is_far_off(track, &path()));
                answers += 1;
            }
        }
    }
    assert!(answers > 10_000, "{answers}");
    assert!(far_off * 500 <= answers, "{far_off} of {answers}");
}

#[test]
fn what_two_cameras_see_one_after_the_other_is_one_target_only_if_it_is() {
    let (mut ghosts, mut crossings) = (0, 0);
    for seed in 0..40 {
        // The first camera sees one target and loses it; the second one sees another, elsewhere,
        // from then on.
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let scene = Scene { detection: 0.9, ..Scene::new(crowd(2, &mut rng), 8.0) };
        let others = [(0, "a", 0.0..4.0), (1, "b", 4.0..8.0)].map(|(path, camera, time_s)| {
            let only = crowd(2, &mut ChaCha8Rng::seed_from_u64(seed)).swap_remove(path);
            (camera, Scene { time_s, detection: 0.9, ..Scene::new(vec![only], 8.0) })
        });
        let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
        for (camera, scene) in others {
            for frame in scene.frames(seed).into_iter().filter(|frame| frame.camera == camera) {
                crossings += usize::from(!frame.tracks.is_empty());
                fusion.ingest(&frame);
            }
        }
        fusion.flush();
        ghosts += fusion.counters().get("tracks_confirmed");
    }
    assert!(crossings > 2000, "{crossings}");
    assert_eq!(ghosts, 0, "of 40");
}

/// Points that stand near the horizon of one camera, up to four degrees above it and 2 km away.
fn horizon_of(eye: &common::Eye, count: usize, rng: &mut ChaCha8Rng) -> Vec<Path> {
    let origin = eye.camera.pose().position();
    let ahead = eye.camera.pose().rotation().matrix().column(2).into_owned();
    (0..count)
        .map(|_| {
            let azimuth = ahead.y.atan2(ahead.x) + rng.random_range(-0.45..0.45_f64);
            let elevation = rng.random_range(0.005..0.07_f64);
            let level = elevation.cos();
            let towards =
                Vector3::new(level * azimuth.cos(), level * azimuth.sin(), elevation.sin());
            straight((origin + towards * 2000.0).coords.into(), [0.0; 3])
        })
        .collect()
}

/// Eight things stand near the horizon of each of three cameras, other ones in each. Some of their
/// 512 sets of lines cross within what poses are known to, and stay so for as long as one looks.
#[test]
fn what_stands_near_the_horizon_of_each_camera_is_no_target_and_what_flies_before_it_is() {
    let (mut found_s, mut ghosts) = (Vec::new(), 0);
    for seed in 0..16 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let eyes = quick_site();
        let flight = || straight([-20.0, -10.0, 45.0], [4.0, 2.0, 0.0]);
        let mut frames: Vec<BearingFrame> = Vec::new();
        for eye in &eyes {
            let paths = horizon_of(eye, 8, &mut rng).into_iter().chain([flight()]).collect();
            let scene = Scene { eyes: vec![eye.clone()], clutter: 0.5, ..Scene::new(paths, 6.0) };
            frames.extend(scene.frames(seed));
        }
        frames.sort_by_key(|frame| frame.capture_time_ns);
        let mut fusion = Fusion::new(FusionConfig::default()).unwrap();
        for eye in &eyes {
            // A careful survey, which the poses are better than.
            fusion.calibrate(&common::calibration(eye).with_pose_sd(1e-3, 0.05)).unwrap();
        }
        for frame in &frames {
            fusion.ingest(frame);
            if found(&fusion, &flight()).is_some() && found_s.len() as u64 == seed {
                found_s.push(frame.capture_time_ns as f64 / 1e9);
            }
        }
        ghosts += fusion.tracks().filter(|track| track.is_confirmed()).count() - 1;
    }
    assert_eq!(ghosts, 0);
    assert_eq!(found_s.len(), 16);
    assert!(found_s.iter().all(|seconds| *seconds < 1.0), "{found_s:?}");
}

/// How many tracks are confirmed before cameras with so many things of their own near the horizon.
fn ghosts_of_horizons(eyes: &[common::Eye], count: usize, detection: f64, seconds: f64) -> u64 {
    let mut ghosts = 0;
    for seed in 0..20 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut frames: Vec<BearingFrame> = Vec::new();
        for (eye, of_eye) in eyes.iter().zip(0..) {
            let paths = horizon_of(eye, count, &mut rng);
            let eyes = vec![eye.clone()];
            let scene = Scene { eyes, detection, ..Scene::new(paths, seconds) };
            // Each camera with noise and misses of its own.
            frames.extend(scene.frames(100 * seed + of_eye));
        }
        frames.sort_by_key(|frame| frame.capture_time_ns);
        let mut fusion = Fusion::new(FusionConfig::default()).unwrap();
        for eye in eyes {
            fusion.calibrate(&common::calibration(eye).with_pose_sd(1e-3, 0.05)).unwrap();
        }
        frames.iter().for_each(|frame| drop(fusion.ingest(frame)));
        ghosts += fusion.counters().get("tracks_confirmed");
    }
    ghosts
}

/// Before two cameras it takes few such things until some of their lines cross: with four each in
/// one site of six, and with one each before six cameras nearly as often.
#[test]
fn what_stands_near_the_horizon_of_two_cameras_or_six_is_no_target() {
    let two = &quick_site()[..2];
    assert_eq!(ghosts_of_horizons(two, 4, 1.0, 8.0), 0);
    // What is seldom detected stands there in between, too. One that is seen so seldom that it
    // passes for new is there whether or not such things are counted.
    assert!(ghosts_of_horizons(two, 4, 0.4, 40.0) <= 1);
    let ring: Vec<common::Eye> = (0..6)
        .map(|k| {
            let (east, north) = (f64::from(k) * 1.05).sin_cos();
            let at = [150.0 * east, 150.0 * north, 3.0];
            common::eye(&format!("ring{k}"), at, [0.0, 0.0, 40.0], 0.015 * f64::from(k))
        })
        .collect();
    assert_eq!(ghosts_of_horizons(&ring, 1, 1.0, 8.0), 0);
}

/// What two cameras see standing in one place, and nothing else stands in their views, is a target:
/// a lamp between them cannot be told from a drone that hovers.
#[test]
fn a_lone_lamp_that_two_cameras_see_is_a_target() {
    let lamp = || straight([5.0, -8.0, 35.0], [0.0; 3]);
    let eyes = quick_site()[..2].to_vec();
    let scene = Scene { eyes, ..Scene::new(vec![lamp()], 8.0) };
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    scene.frames(1).iter().for_each(|frame| drop(fusion.ingest(frame)));
    assert!(found(&fusion, &lamp()).is_some());
}

/// What one camera follows is real, but it is no target for a false bearing of another camera that
/// lies near its line's plane.
#[test]
fn what_one_camera_follows_makes_no_target_with_clutter_of_another() {
    let eyes = site();
    let (mut ghosts, mut looks) = (0, 0);
    for seed in 0..10 {
        let drones = (0..4).map(|k| {
            let k = f64::from(k);
            straight(
                [-30.0 + 15.0 * k, 30.0 - 12.0 * k, 30.0 + 8.0 * k],
                [0.5 - 0.2 * k, 0.3 * k - 0.4, 0.1],
            )
        });
        let of = |eye: usize, paths, clutter| {
            let eyes = vec![eyes[eye].clone()];
            Scene { eyes, detection: 0.9, clutter, ..Scene::new(paths, 60.0) }.frames(seed)
        };
        let mut frames = of(0, drones.collect(), 0.0);
        frames.extend(of(1, Vec::new(), 1.0));
        frames.sort_by_key(|frame| frame.capture_time_ns);
        let mut fusion = fusion_of(FusionConfig::default(), &eyes[..2]);
        let confirmed = confirmed_over_time(&mut fusion, &frames);
        ghosts += confirmed.iter().sum::<usize>();
        looks += confirmed.len();
    }
    // There were 93.
    assert!(ghosts * 400 < looks, "{ghosts} ghosts in {looks} looks");
}
