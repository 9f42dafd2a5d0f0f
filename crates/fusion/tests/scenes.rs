//! Scenes that decide whether a fusion centre is of use: targets that cross, meet and part, leave
//! and come back; cameras that fail, hardly overlap, are only two, are slow or quick. Truth and
//! noise are known; each scene says who is who afterwards and how far each track is off.
//!
//! Bearings have a standard deviation of half a milliradian, 7.5 cm at 150 m: three cameras at 10
//! Hz hold a target that flies straight to a few centimetres, and 0.25 m is far beyond chance.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;
#[path = "common/flight.rs"]
mod flight;

use common::{Eye, Path, SD_RAD, Scene, eye, found, site, straight};
use crossfix_fusion::{FusionConfig, Manoeuvres, TrackStatus};
use flight::Flight;
use nalgebra::{Point3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Farther off than this no track may be where nothing special happens, m.
const CLOSE_M: f64 = 0.25;
/// Seeds of each scene.
const SEEDS: std::ops::Range<u64> = 0..10;

/// Misses and clutter as they are on a good day.
fn good_day(paths: Vec<Path>, seconds: f64) -> Scene {
    Scene { detection: 0.9, clutter: 1.0, ..Scene::new(paths, seconds) }
}

/// Every target has a track of its own, and there are no others.
fn assert_one_each(flight: &Flight, targets: usize, seed: u64) -> Vec<Option<u64>> {
    let ids = flight.ids();
    let mut known: Vec<u64> = ids.iter().flatten().copied().collect();
    known.sort_unstable();
    known.dedup();
    assert_eq!((known.len(), flight.confirmed()), (targets, targets), "seed {seed}: {ids:?}");
    ids
}

#[test]
fn targets_that_cross_keep_their_numbers() {
    for seed in SEEDS {
        // At 5 s all three are within a metre of each other.
        let paths = vec![
            straight([-40.0, 0.0, 40.0], [8.0, 0.0, 0.0]),
            straight([0.0, -30.0, 40.5], [0.0, 6.0, 0.0]),
            straight([20.0, 20.5, 45.0], [-4.0, -4.0, -1.0]),
        ];
        let mut flight = Flight::new(good_day(paths, 10.0), seed);
        let before = assert_one_each(flight.until(4.0), 3, seed);
        let after = assert_one_each(flight.until(9.5), 3, seed);
        assert_eq!(before, after, "seed {seed}");
        assert!((0..3).all(|target| flight.error(target) < CLOSE_M), "seed {seed}");
        assert_eq!(flight.fusion.counters().get("tracks_born"), 3, "seed {seed}");
    }
}

#[test]
fn a_target_that_one_camera_at_a_time_sees_is_found_and_kept() {
    for (turn_s, found_by_s) in [(1.0, 4.0), (4.0, 9.5)] {
        for seed in SEEDS {
            let path = || straight([0.0, -20.0, 45.0], [4.0, 2.0, 0.2]);
            let scene = Scene::new(vec![path()], 24.0);
            let mut flight = Flight::with(FusionConfig::default(), scene, seed, |frame| {
                let turn = frame.capture_time_ns as f64 / 1e9 / turn_s;
                if frame.camera != ["a", "b", "c"][turn as usize % 3] {
                    frame.tracks.clear();
                }
                true
            });
            let before = assert_one_each(flight.until(found_by_s), 1, seed);
            let after = assert_one_each(flight.until(22.0), 1, seed);
            assert_eq!(before, after, "seed {seed}");
            assert!(flight.error(0) < 3.0, "seed {seed}: {}", flight.error(0));
            assert_eq!(flight.fusion.counters().get("tracks_born"), 1, "seed {seed}");
        }
    }
}

#[test]
fn two_targets_that_one_camera_at_a_time_sees_are_both_found() {
    for seed in SEEDS {
        // Each camera sees both from the same exposure on.
        let paths = vec![
            straight([0.0, -20.0, 45.0], [4.0, 2.0, 0.2]),
            straight([20.0, 30.0, 60.0], [-3.0, -2.0, 0.1]),
        ];
        let scene = Scene::new(paths, 12.0);
        let mut flight = Flight::with(FusionConfig::default(), scene, seed, |frame| {
            if frame.camera != ["a", "b", "c"][(frame.capture_time_ns / 2_000_000_000) as usize % 3]
            {
                frame.tracks.clear();
            }
            true
        });
        assert_one_each(flight.until(11.0), 2, seed);
    }
}

/// A target that hovers, and sways by so many metres in the wind.
fn hovering(sway_m: f64) -> Path {
    Box::new(move |t| {
        let (east, north) = ((1.3 * t).sin(), (0.9 * t).cos());
        Some(Point3::new(10.0 + sway_m * east, 5.0 + sway_m * north, 40.0))
    })
}

/// It was there before the cameras began to look: it is told from nothing that stands in their
/// views but by how its lines meet, and nothing else stands there.
#[test]
fn a_target_that_hovers_from_the_beginning_is_found_by_two_cameras_and_by_three_slow_ones() {
    for (cameras, rate_hz, detection) in
        [(2, 10.0, 0.9), (2, 2.0, 0.9), (3, 5.0, 0.5), (3, 2.0, 0.9)]
    {
        let mut found = 0;
        for (seed, sway_m) in SEEDS.flat_map(|seed| [0.0, 0.3].map(|sway_m| (seed, sway_m))) {
            let scene = Scene { detection, ..Scene::new(vec![hovering(sway_m)], 20.0) };
            let mut eyes = site()[..cameras].to_vec();
            eyes.iter_mut().for_each(|eye| eye.rate_hz = rate_hz);
            let mut flight = Flight::new(Scene { eyes, ..scene }, seed);
            found += usize::from(flight.until(20.0).track(0).is_some());
            assert!(flight.confirmed() <= 1, "{cameras} at {rate_hz} Hz, seed {seed}");
        }
        assert!(found >= 18, "{cameras} cameras at {rate_hz} Hz: {found} of 20");
    }
}

/// Comes from `side` metres off the x axis to `near` metres from it, stays for ten seconds, parts.
fn meeting(side: f64, near: f64) -> Path {
    Box::new(move |t| {
        // A smooth step of 0 to 1 within four seconds.
        let step = |from: f64| {
            let x = ((t - from) / 4.0).clamp(0.0, 1.0);
            x * x * (3.0 - 2.0 * x)
        };
        let off = side + (near - side) * (step(3.0) - step(17.0));
        Some(Point3::new(-36.0 + 3.0 * t, off, 40.0))
    })
}

#[test]
fn targets_that_fly_together_for_ten_seconds_part_with_their_numbers() {
    for seed in SEEDS {
        // Together they are 2 m apart.
        let mut flight =
            Flight::new(good_day(vec![meeting(-15.0, -1.0), meeting(15.0, 1.0)], 24.0), seed);
        let before = assert_one_each(flight.until(3.0), 2, seed);
        let together = assert_one_each(flight.until(12.0), 2, seed);
        let after = assert_one_each(flight.until(23.5), 2, seed);
        assert_eq!((&before, &before), (&together, &after), "seed {seed}");
        assert!((0..2).all(|target| flight.error(target) < CLOSE_M), "seed {seed}");
    }
}

/// A target of which nothing is to be seen from one time to another.
fn hidden(path: Path, from_s: f64, to_s: f64) -> Path {
    Box::new(move |t| path(t).filter(|_| !(from_s..to_s).contains(&t)))
}

/// False bearings of a frame, on average, where a target is away: nothing that could be taken for
/// it, and 60 a second that could.
const NOTHING_AND_CLUTTER: [f64; 2] = [0.0, 2.0];

#[test]
fn a_target_out_of_sight_for_three_seconds_keeps_its_number() {
    for (clutter, seed) in
        NOTHING_AND_CLUTTER.into_iter().flat_map(|c| SEEDS.map(move |seed| (c, seed)))
    {
        let path = || straight([-30.0, 10.0, 40.0], [5.0, -1.0, 0.0]);
        let scene = Scene { clutter, ..good_day(vec![hidden(path(), 5.0, 8.0)], 12.0) };
        let mut flight = Flight::new(scene, seed);
        let before = assert_one_each(flight.until(5.0), 1, seed);
        let coasting = found(&flight.until(7.8).fusion, &path()).map(|t| (Some(t.id.0), t.status));
        assert_eq!(coasting, Some((before[0], TrackStatus::Coasting)), "seed {seed}");
        assert_eq!(assert_one_each(flight.until(11.5), 1, seed), before, "seed {seed}");
        assert!(flight.error(0) < CLOSE_M, "seed {seed}");
        assert_eq!(flight.fusion.counters().get("tracks_born"), 1, "seed {seed}");
    }
}

#[test]
fn however_many_cameras_miss_it_a_hidden_target_keeps_its_number() {
    for cameras in [4, 8, 16] {
        let eyes: Vec<Eye> = (0..cameras)
            .map(|i| {
                let (sin, cos) =
                    (f64::from(i) / f64::from(cameras) * std::f64::consts::TAU).sin_cos();
                let phase_s = 0.1 * f64::from(i) / f64::from(cameras);
                eye(
                    &format!("ring-{i}"),
                    [150.0 * cos, 150.0 * sin, 3.0],
                    [0.0, 0.0, 40.0],
                    phase_s,
                )
            })
            .collect();
        for seed in 0..3 {
            let path = straight([-20.0, 10.0, 40.0], [4.0, -1.0, 0.0]);
            let scene =
                Scene { eyes: eyes.clone(), ..good_day(vec![hidden(path, 4.0, 7.0)], 10.0) };
            let mut flight = Flight::new(scene, seed);
            let before = assert_one_each(flight.until(4.0), 1, seed);
            let after = assert_one_each(flight.until(9.5), 1, seed);
            assert_eq!(before, after, "{cameras} cameras, seed {seed}");
        }
    }
}

#[test]
fn a_target_that_leaves_the_field_of_view_for_long_is_lost_and_found_as_another() {
    for (clutter, seed) in
        NOTHING_AND_CLUTTER.into_iter().flat_map(|c| SEEDS.map(move |seed| (c, seed)))
    {
        // Up out of all cameras' sight, which ends at some 105 m, and down again, within half a
        // minute.
        let path: Path = Box::new(|t| {
            let turn = (t - 4.0).clamp(0.0, 30.0) / 30.0 * std::f64::consts::TAU;
            Some(Point3::new(-20.0 + t, 5.0, 140.0 - 100.0 * turn.cos()))
        });
        let mut flight = Flight::new(Scene { clutter, ..good_day(vec![path], 38.0) }, seed);
        let before = assert_one_each(flight.until(8.0), 1, seed);
        assert_eq!(flight.until(20.0).fusion.tracks().count(), 0, "seed {seed}");
        assert_eq!(flight.fusion.counters().get("tracks_lost"), 1, "seed {seed}");
        let after = assert_one_each(flight.until(37.5), 1, seed);
        assert_ne!(before, after, "seed {seed}");
        assert!(flight.error(0) < CLOSE_M, "seed {seed}");
        assert_eq!(flight.fusion.counters().get("tracks_confirmed"), 2, "seed {seed}");
    }
}

#[test]
fn a_camera_that_dies_and_comes_back_costs_no_track() {
    for seed in SEEDS {
        let paths = vec![
            straight([-25.0, 10.0, 40.0], [3.0, -1.0, 0.0]),
            straight([20.0, 25.0, 50.0], [-1.0, -3.0, 0.0]),
        ];
        let dead = |seconds: f64| (5.0..10.0).contains(&seconds);
        let mut flight =
            Flight::with(FusionConfig::default(), good_day(paths, 16.0), seed, |frame| {
                frame.camera != "b" || !dead(frame.capture_time_ns as f64 / 1e9)
            });
        let before = assert_one_each(flight.until(5.0), 2, seed);
        for second in [9.5, 15.5] {
            assert_eq!(assert_one_each(flight.until(second), 2, seed), before, "seed {seed}");
            assert!((0..2).all(|target| flight.error(target) < CLOSE_M), "seed {seed}");
        }
        let counters = flight.fusion.counters();
        assert_eq!(
            (counters.get("tracks_born"), counters.get("rejected_late")),
            (2, 0),
            "seed {seed}"
        );
    }
}

#[test]
fn a_target_is_handed_from_pair_to_pair_of_cameras_that_hardly_overlap() {
    // Along a road, each camera looks straight across it and sees some 100 m of it; neighbours
    // share a fifth of that with the next pair.
    let eyes: Vec<Eye> = (0..6)
        .map(|i| {
            let (pair, second) = (f64::from(i / 2), f64::from(i % 2));
            let middle = 80.0 * pair;
            let at = [middle + 60.0 * (second - 0.5), -90.0, 2.0 + 3.0 * second];
            eye(&format!("road-{i}"), at, [middle, 0.0, 20.0], 0.015 * f64::from(i))
        })
        .collect();
    for seed in SEEDS {
        let path = straight([-35.0, 0.0, 20.0], [12.0, 0.0, 0.1]);
        let mut flight =
            Flight::new(Scene { eyes: eyes.clone(), ..good_day(vec![path], 18.0) }, seed);
        let first = assert_one_each(flight.until(2.0), 1, seed);
        for second in 3..18 {
            assert_eq!(
                assert_one_each(flight.until(f64::from(second)), 1, seed),
                first,
                "seed {seed}"
            );
            assert!(flight.error(0) < CLOSE_M, "seed {seed}, {second} s");
        }
        assert_eq!(flight.fusion.counters().get("tracks_born"), 1, "seed {seed}");
    }
}

/// A flight that starts at about walking pace, driven by white acceleration of a power spectral
/// density, m^2/s^3, in steps of 10 ms.
fn drawn(density: f64, seconds: f64, seed: u64) -> Path {
    const STEP_S: f64 = 0.01;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = move || -> f64 { StandardNormal.sample(&mut rng) };
    let mut velocity = Vector3::from_fn(|_, _| normal());
    let mut place = Point3::new(0.0, 0.0, 45.0);
    let mut places = Vec::new();
    for _ in 0..=(seconds / STEP_S).ceil() as usize + 1 {
        places.push((place, velocity));
        place += velocity * STEP_S;
        velocity += Vector3::from_fn(|_, _| normal()) * (density * STEP_S).sqrt();
    }
    Box::new(move |t| {
        let (place, velocity) = places.get((t / STEP_S).max(0.0) as usize)?;
        Some(place + velocity * (t % STEP_S))
    })
}

/// Of 200 flights drawn from the filter's own model how many are found within ten seconds, their
/// mean NEES and the mean variance of a position, m^2.
fn honesty(eyes: &[Eye]) -> (u32, f64, f64) {
    const RUNS: u32 = 200;
    const DENSITY: f64 = 0.3;
    let mut config = FusionConfig::default();
    config.tracking.manoeuvres = Manoeuvres::None;
    config.tracking.acceleration_density = DENSITY;
    let (mut found, mut nees, mut variance) = (0, 0.0, 0.0);
    for seed in 0..u64::from(RUNS) {
        let scene =
            Scene { eyes: eyes.to_vec(), ..good_day(vec![drawn(DENSITY, 10.1, seed)], 10.0) };
        let mut flight = Flight::with(config.clone(), scene, 1000 + seed, |_| true);
        if let Some(track) = flight.until(10.0).track(0) {
            variance += track.state().position_covariance().trace() / 3.0;
            nees += flight.nees(0);
            found += 1;
        }
    }
    (found, nees / f64::from(found), variance / f64::from(found))
}

#[test]
fn two_cameras_know_less_than_three_and_both_say_so_honestly() {
    let (of_three, three, three_variance) = honesty(&site());
    let (of_two, two, two_variance) = honesty(&site()[..2]);
    assert_eq!(of_three, 200);
    assert_eq!(of_two, 200);
    // Chi-square of six degrees of freedom: the mean of 200 has a standard deviation of 0.245.
    for nees in [three, two] {
        assert!((nees - 6.0).abs() < 3.0 * (12.0_f64 / 200.0).sqrt(), "{nees}");
    }
    assert!(two_variance > 1.2 * three_variance, "{two_variance} {three_variance}");
    assert!(three_variance < (150.0 * SD_RAD).powi(2), "less than a single bearing's");
}

#[test]
fn thirty_pictures_a_second_and_one_a_second_find_the_same_target() {
    for (rate_hz, seconds, close_m) in [(30.0, 4.0, CLOSE_M), (1.0, 25.0, 2.0 * CLOSE_M)] {
        for seed in SEEDS {
            let path = straight([-25.0, 10.0, 40.0], [2.0, -1.0, 0.1]);
            let mut scene = good_day(vec![path], seconds);
            for (i, eye) in scene.eyes.iter_mut().enumerate() {
                (eye.rate_hz, eye.phase_s) = (rate_hz, i as f64 / (3.0 * rate_hz));
            }
            let mut flight = Flight::new(scene, seed);
            let middle = assert_one_each(flight.until(seconds / 2.0), 1, seed);
            assert_eq!(assert_one_each(flight.until(seconds), 1, seed), middle, "seed {seed}");
            assert!(flight.error(0) < close_m, "seed {seed} at {rate_hz} Hz: {}", flight.error(0));
        }
    }
}
