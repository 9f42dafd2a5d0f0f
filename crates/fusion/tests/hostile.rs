//! Whatever cameras, clocks, a network or an operator give the fusion centre, it answers with what
//! can be, or not at all. `fuzz/` runs the same driver with a fuzzer; its corpus is replayed here.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;
#[path = "hostile/driver.rs"]
mod driver;

use std::ops::Range;
use std::time::{Duration, Instant};

use common::{Eye, Scene, bearing, calibration, clutter, eye, found, fusion_of, site, straight};
use crossfix_fusion::{
    Fusion, FusionConfig, InitiationMethod, Output, Rejection, RejectionReason, SpatialSolver,
};
use crossfix_message::{BearingFrame, BearingTrack};
use nalgebra::{Point3, Vector3};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

proptest! {
    #![proptest_config(ProptestConfig { cases: 60, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_survived(data in prop::collection::vec(any::<u8>(), 0..160)) {
        driver::drive(&data);
        // The same with clocks, poses and numbers of the configuration by its last bytes.
        driver::drive(&[&data, driver::MARK].concat());
    }
}

#[test]
fn the_corpus_is_survived() {
    let corpus = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/corpus/fusion");
    let mut files = 0;
    for entry in std::fs::read_dir(corpus).unwrap() {
        driver::drive(&std::fs::read(entry.unwrap().path()).unwrap());
        files += 1;
    }
    assert!(files > 0, "the corpus is empty");
}

fn of_the_site() -> Fusion {
    fusion_of(FusionConfig::default(), &site())
}

/// Takes frames in one by one and returns what came out.
fn ingest_all(fusion: &mut Fusion, frames: &[BearingFrame]) -> Vec<Output> {
    frames.iter().flat_map(|frame| fusion.ingest(frame)).collect()
}

/// Two targets that fly straight, for some seconds from a time on.
fn two_targets(time_s: Range<f64>) -> Scene {
    let paths = vec![
        straight([-25.0, 5.0, 40.0], [2.0, 1.0, 0.2]),
        straight([20.0, 15.0, 50.0], [-1.0, -2.0, 0.0]),
    ];
    Scene { time_s, ..Scene::new(paths, 0.0) }
}

/// An ordinary target comes from `from_s` on and must be found, exactly one track where it is.
fn finds_an_ordinary_target(fusion: &mut Fusion, from_s: f64) {
    let x = -10.0 - 5.0 * from_s;
    let scene = Scene {
        time_s: from_s..from_s + 4.0,
        ..Scene::new(vec![straight([x, -20.0, 35.0], [5.0, 0.0, 0.0])], 0.0)
    };
    site().iter().for_each(|eye| fusion.calibrate(&calibration(eye)).unwrap());
    ingest_all(fusion, &scene.frames(99));
    fusion.flush();
    let truth = scene.paths.first().unwrap();
    let track = found(fusion, truth).unwrap();
    let error = track.state().position() - truth(track.updated_at.seconds()).unwrap();
    assert!(track.updated_at.seconds() > from_s + 3.8, "{track:?}");
    assert!(error.norm() < 0.2, "{error}");
}

#[test]
fn what_comes_twice_is_counted_once_and_changes_nothing() {
    let frames = two_targets(0.0..3.0).frames(1);
    let (mut once, mut twice) = (of_the_site(), of_the_site());
    let expected = ingest_all(&mut once, &frames);
    let doubled: Vec<BearingFrame> = frames.iter().flat_map(|f| [f.clone(), f.clone()]).collect();
    let outputs = ingest_all(&mut twice, &doubled);
    let useful: Vec<Output> =
        outputs.into_iter().filter(|o| !matches!(o, Output::Rejected(_))).collect();
    assert_eq!(useful, expected);
    assert_eq!(twice.counters().get("rejected_duplicate"), frames.len() as u64);
    finds_an_ordinary_target(&mut twice, 4.0);
}

#[test]
fn a_network_that_swaps_one_cameras_frames_costs_one_of_them() {
    let scene = two_targets(0.0..6.0);
    let mut frames = scene.frames(11);
    let of_b: Vec<usize> = (0..frames.len()).filter(|&i| frames[i].camera == "b").collect();
    of_b.chunks_exact(2).skip(10).for_each(|pair| frames.swap(pair[0], pair[1]));
    let mut fusion = of_the_site();
    ingest_all(&mut fusion, &frames);
    assert_eq!(fusion.counters().get("rejected_late"), 1, "the first, for nobody knew");
    assert_eq!(fusion.counters().get("frames_out_of_order"), 19);
    assert!(scene.paths.iter().all(|path| found(&fusion, path).is_some()));
    assert_eq!(fusion.counters().get("tracks_lost"), 0);
    finds_an_ordinary_target(&mut fusion, 7.0);
}

#[test]
fn frames_that_come_too_late_are_refused_and_counted() {
    let mut fusion = of_the_site();
    let frames = two_targets(0.0..4.0).frames(2);
    // Every tenth frame comes a second after its time.
    let delay = |i: usize, frame: &BearingFrame| {
        frame.capture_time_ns + if i % 10 == 9 && i < 80 { 1_000_000_000 } else { 0 }
    };
    let mut order: Vec<(i64, &BearingFrame)> =
        frames.iter().enumerate().map(|(i, frame)| (delay(i, frame), frame)).collect();
    order.sort_by_key(|(arrival, _)| *arrival);
    for (_, frame) in order {
        fusion.ingest(frame);
    }
    assert_eq!(fusion.counters().get("rejected_late"), 8);
    assert_eq!(fusion.counters().get("tracks_confirmed"), 2);
    assert_eq!(fusion.counters().get("tracks_lost"), 0);
    finds_an_ordinary_target(&mut fusion, 5.0);
}

#[test]
fn a_camera_whose_clock_jumps_and_jumps_back_is_followed_and_stops_nobody() {
    let mut fusion = of_the_site();
    let scene = two_targets(0.0..9.0);
    let frames = scene.frames(3);
    let all = frames.len() as u64;
    for mut frame in frames {
        let second = frame.capture_time_ns / 1_000_000_000;
        if frame.camera == "c" {
            frame.capture_time_ns += match second {
                2 => 3_600_000_000_000,
                4 => -3_600_000_000_000,
                _ => 0,
            };
        }
        fusion.ingest(&frame);
        // Two cameras are enough to go on with.
        if second > 1 {
            assert!(
                scene.paths.iter().all(|path| found(&fusion, path).is_some()),
                "second {second}"
            );
        }
    }
    // Ahead by an hour, right, behind by an hour, right.
    assert_eq!(fusion.counters().get("clock_steps"), 4);
    fusion.flush();
    assert!(all - fusion.counters().get("exposures") < 10, "{:?}", fusion.counters());
    assert_eq!(fusion.counters().get("tracks_confirmed"), 2);
    assert_eq!(fusion.counters().get("tracks_lost"), 0);
    finds_an_ordinary_target(&mut fusion, 10.0);
}

/// Two cameras more than [`site`].
fn five() -> Vec<Eye> {
    let mut eyes = site();
    eyes.push(eye("d", [-40.0, 150.0, 4.0], [0.0, 0.0, 40.0], 0.015));
    eyes.push(eye("e", [-30.0, -160.0, 2.0], [0.0, 0.0, 40.0], 0.08));
    eyes
}

#[test]
fn two_clocks_ahead_vouch_for_each_other_and_blind_nobody() {
    for (ahead_s, until_s, refused) in [(60.0, 2.3, 3), (3600.0, 3.0, 10)] {
        let scene = Scene { eyes: five(), ..two_targets(0.0..9.0) };
        let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
        for mut frame in scene.frames(3) {
            let t = frame.capture_time_ns as f64 / 1e9;
            if ["d", "e"].contains(&frame.camera.as_str()) && (2.0..until_s).contains(&t) {
                frame.capture_time_ns += (ahead_s * 1e9) as i64;
            }
            fusion.ingest(&frame);
        }
        // Until it is clear that their clocks have stepped, for which one of the two waits.
        assert_eq!(fusion.counters().get("rejected_future"), refused);
        assert_eq!(fusion.counters().get("clock_steps"), 2, "there and back");
        assert_eq!(fusion.counters().get("rejected_late"), 0);
        assert_eq!(fusion.counters().get("tracks_born"), 2);
        assert!(scene.paths.iter().all(|path| found(&fusion, path).is_some()));
    }
}

#[test]
fn a_clock_ahead_after_one_that_died_ahead_blinds_nobody() {
    let scene = Scene { eyes: five(), ..two_targets(0.0..9.0) };
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    for mut frame in scene.frames(3) {
        let t = frame.capture_time_ns as f64 / 1e9;
        match frame.camera.as_str() {
            "d" if t >= 2.1 => continue,
            "d" if t >= 2.0 => frame.capture_time_ns += 3_600_000_000_000,
            "e" if (7.0..7.1).contains(&t) => frame.capture_time_ns += 3_590_000_000_000,
            _ => {}
        }
        fusion.ingest(&frame);
    }
    assert_eq!(fusion.counters().get("rejected_future"), 2);
    assert_eq!(fusion.counters().get("rejected_late"), 0);
    assert!(scene.paths.iter().all(|path| found(&fusion, path).is_some()));
}

/// A site whose clocks are all ahead for a second, of agents that number their frames or do not.
fn all_clocks_ahead(ahead_ns: i64, numbered: bool) -> (Scene, Fusion) {
    let scene = two_targets(0.0..10.0);
    let mut fusion = of_the_site();
    for mut frame in scene.frames(3) {
        if (2_000_000_000..3_000_000_000).contains(&frame.capture_time_ns) {
            frame.capture_time_ns += ahead_ns;
        }
        frame.sequence *= u64::from(numbered);
        fusion.ingest(&frame);
    }
    (scene, fusion)
}

#[test]
fn after_all_clocks_were_ahead_the_order_is_taken_up_anew_and_targets_are_found() {
    let (scene, mut fusion) = all_clocks_ahead(600_000_000_000, false);
    assert_eq!(fusion.counters().get("event_time_restarts"), 1);
    // Two seconds and a few frames, not ten minutes.
    assert!(fusion.counters().get("rejected_late") < 75, "{:?}", fusion.counters());
    assert!(scene.paths.iter().all(|path| found(&fusion, path).is_some()));
    fusion.flush();
    let count = |name| fusion.counters().get(name);
    let refused = count("rejected_late") + count("rejected_future");
    assert_eq!(count("frames"), count("exposures") + refused, "{:?}", fusion.counters());
}

#[test]
fn two_cameras_whose_clocks_were_ahead_at_first_find_targets() {
    let mut scene = two_targets(0.0..12.0);
    scene.eyes.truncate(2);
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    for mut frame in scene.frames(3) {
        if frame.capture_time_ns < 1_000_000_000 {
            frame.capture_time_ns += 600_000_000_000;
        }
        frame.sequence = 0;
        fusion.ingest(&frame);
    }
    assert_eq!(fusion.counters().get("event_time_restarts"), 1);
    assert!(scene.paths.iter().all(|path| found(&fusion, path).is_some()));
}

#[test]
fn clocks_that_are_all_ten_minutes_ahead_and_numbered_frames_lose_no_frame_and_targets_are_found() {
    let (scene, mut fusion) = all_clocks_ahead(600_000_000_000, true);
    assert!(scene.paths.iter().all(|path| found(&fusion, path).is_some()));
    fusion.flush();
    let count = |name| fusion.counters().get(name);
    let refused = count("rejected_late") + count("rejected_future");
    assert_eq!(count("frames"), count("exposures") + refused, "{:?}", fusion.counters());
    assert!(refused < 75, "{:?}", fusion.counters());
}

#[test]
fn where_frames_are_numbered_the_tracks_outlive_all_clocks_being_ahead() {
    let (scene, mut fusion) = all_clocks_ahead(1_500_000_000, true);
    assert!(scene.paths.iter().all(|path| found(&fusion, path).is_some()));
    fusion.flush();
    let count = |name| fusion.counters().get(name);
    assert_eq!((count("tracks_born"), count("site_time_steps")), (2, 2));
    assert_eq!(count("frames"), count("exposures"), "{:?}", fusion.counters());
}

#[test]
fn two_cameras_at_the_same_place_make_no_target_of_their_own() {
    let mut scene = two_targets(0.0..6.0);
    let beside = Eye { name: "d".parse().unwrap(), phase_s: 0.05, ..scene.eyes[0].clone() };
    scene.eyes = vec![scene.eyes.remove(0), beside];
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    ingest_all(&mut fusion, &scene.frames(4));
    fusion.flush();
    assert_eq!(fusion.counters().get("exposures"), 120);
    assert_eq!(fusion.tracks().filter(|track| track.is_confirmed()).count(), 0);
    [&"a", &"d"].iter().for_each(|name| drop(fusion.camera_ended(&name.parse().unwrap())));
    finds_an_ordinary_target(&mut fusion, 7.0);
}

#[test]
fn bearings_that_never_meet_make_no_track() {
    let mut fusion = of_the_site();
    // Each camera has something of its own above the middle, all of them at other heights.
    let mut frames = Scene::new(vec![], 6.0).frames(5);
    for frame in &mut frames {
        let down = match frame.camera.as_str() {
            "a" => -0.3,
            "b" => 0.0,
            _ => 0.3,
        };
        frame.tracks = vec![bearing(Vector3::new(0.0, down, 1.0), 1)];
    }
    ingest_all(&mut fusion, &frames);
    fusion.flush();
    assert_eq!(fusion.counters().get("exposures"), 180);
    assert_eq!(fusion.counters().get("tracks_born"), 0);
    finds_an_ordinary_target(&mut fusion, 7.0);
}

/// Takes in a scene of two targets in which every camera also reports `more` from 2 s to 2.5 s;
/// returns how long the slowest frame took. Both targets must be held.
fn flooded(fusion: &mut Fusion, mut more: impl FnMut(&Eye) -> Vec<Vector3<f64>>) -> Duration {
    let scene = two_targets(0.0..4.0);
    let (mut slowest, mut floods) = (Duration::ZERO, 0);
    for mut frame in scene.frames(6) {
        if (2.0..2.5).contains(&(frame.capture_time_ns as f64 / 1e9)) {
            let eye = scene.eyes.iter().find(|eye| eye.name.as_str() == frame.camera).unwrap();
            frame
                .tracks
                .extend(more(eye).into_iter().zip(100..).map(|(towards, id)| bearing(towards, id)));
            floods += 1;
        }
        let start = Instant::now();
        fusion.ingest(&frame);
        slowest = slowest.max(start.elapsed());
    }
    assert_eq!(floods, 15);
    assert!(scene.paths.iter().all(|path| found(fusion, path).is_some()));
    slowest
}

/// In the dev profile it is half a second on two busy cores.
const BOUNDED: Duration = Duration::from_secs(20);

#[test]
fn ten_thousand_false_bearings_of_every_camera_are_survived_in_bounded_time() {
    let mut fusion = of_the_site();
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let slowest = flooded(&mut fusion, |eye| clutter(&eye.camera, 10_000, &mut rng));
    println!("the slowest frame took {slowest:?}");
    assert!(slowest < BOUNDED, "{slowest:?}");
    assert_eq!(fusion.counters().get("tracks_born"), 2, "no combination of clutter lasts");
    finds_an_ordinary_target(&mut fusion, 5.0);
}

#[test]
fn a_frame_of_more_bearings_than_a_picture_has_is_cut_and_told() {
    let mut fusion = of_the_site();
    let one = bearing(Vector3::z(), 1);
    let frame =
        BearingFrame { camera: "a".into(), tracks: vec![one; 10_300], ..Default::default() };
    let outputs = fusion.ingest(&frame);
    let reasons = outputs.iter().filter_map(|output| match output {
        Output::Rejected(rejection) => Some(&rejection.reason),
        _ => None,
    });
    assert_eq!(reasons.collect::<Vec<_>>(), [&RejectionReason::Crowded { left_out: 300 }]);
    assert_eq!(fusion.counters().get("frames_crowded"), 1);
}

/// Frames that have come, and have neither been worked on nor refused.
fn waiting(fusion: &Fusion) -> u64 {
    let count = |name| fusion.counters().get(name);
    count("frames") - count("exposures") - count("rejected_late") - count("rejected_future")
}

#[test]
fn of_a_camera_alone_little_waits() {
    let mut fusion = of_the_site();
    for k in 0..200 {
        let tracks = vec![bearing(Vector3::z(), 1); 20];
        let capture_time_ns = k * 33_000_000;
        let frame =
            BearingFrame { camera: "a".into(), capture_time_ns, tracks, ..Default::default() };
        fusion.ingest(&frame);
        assert!(waiting(&fusion) <= 17, "{}", waiting(&fusion));
    }
}

#[test]
fn of_a_learnt_clock_that_is_flooded_no_more_waits_than_may() {
    let circling = |t: f64| Point3::new(40.0 * (0.3 * t).cos(), 40.0 * (0.3 * t).sin(), 45.0);
    let scene = Scene::new(vec![Box::new(move |t| Some(circling(t)))], 20.0);
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    let mut last = 0;
    for mut frame in scene.frames(1) {
        if frame.camera == "b" {
            frame.capture_time_ns += 200_000_000;
        }
        frame.capture_time_sd_s = if frame.camera == "a" { 0.0 } else { 0.2 };
        last = last.max(frame.capture_time_ns);
        fusion.ingest(&frame);
    }
    let learnt =
        fusion.cameras().filter_map(|camera| camera.clock).any(|clock| clock.offset_s > 0.15);
    assert!(learnt, "{:?}", fusion.cameras().collect::<Vec<_>>());
    for k in 1..=20_000 {
        let camera = if k % 2 == 0 { "b" } else { "a" }.into();
        let capture_time_ns = last + 1_000 * k;
        let frame =
            BearingFrame { camera, capture_time_ns, capture_time_sd_s: 0.2, ..Default::default() };
        fusion.ingest(&frame);
    }
    // Six thousand for their order, and as many for the clocks.
    assert!((6_000..=12_000).contains(&waiting(&fusion)), "{}", waiting(&fusion));
}

#[test]
fn two_hundred_bearings_that_are_all_alike_are_survived_in_bounded_time_by_every_method() {
    let solvers =
        [SpatialSolver::Map, SpatialSolver::Stacked, SpatialSolver::Triple, SpatialSolver::Pair];
    let mut configs = vec![FusionConfig::default(); 5];
    for (config, solver) in configs.iter_mut().zip(solvers) {
        (config.initiation.method, config.initiation.solver) = (InitiationMethod::Grouping, solver);
    }
    for config in configs {
        let method = (config.initiation.method, config.initiation.solver);
        let mut fusion = fusion_of(config, &site());
        // All cameras' lines meet, so that every combination is as good as any other.
        let place = Point3::new(5.0, -10.0, 60.0);
        let slowest =
            flooded(&mut fusion, |eye| vec![eye.camera.pose().camera_from_world(place); 200]);
        println!("{method:?}: the slowest frame took {slowest:?}");
        assert!(slowest < BOUNDED, "{method:?}: {slowest:?}");
    }
}

#[test]
fn a_covariance_of_zero_is_refused_and_counted() {
    let mut fusion = of_the_site();
    let scene = two_targets(0.0..4.0);
    let mut frames = scene.frames(7);
    for frame in &mut frames {
        let certain = BearingTrack { covariance_xx: 0.0, covariance_yy: 0.0, ..frame.tracks[0] };
        frame.tracks.push(certain);
    }
    let outputs = ingest_all(&mut fusion, &frames);
    let impossible = |output: &&Output| {
        matches!(output, Output::Rejected(Rejection { reason: RejectionReason::Bearing(_), .. }))
    };
    assert_eq!(outputs.iter().filter(impossible).count(), frames.len());
    assert_eq!(fusion.counters().get("rejected_bearing"), frames.len() as u64);
    assert!(scene.paths.iter().all(|path| found(&fusion, path).is_some()), "the others are used");
    finds_an_ordinary_target(&mut fusion, 5.0);
}

#[test]
fn a_camera_that_is_moved_and_calibrated_anew_loses_no_target() {
    let mut fusion = of_the_site();
    let before = two_targets(0.0..3.0);
    let mut after = two_targets(3.0..6.0);
    after.eyes[2] = Eye { rate_hz: 10.0, ..eye("c", [-20.0, 150.0, 4.0], [0.0, 0.0, 40.0], 0.067) };
    ingest_all(&mut fusion, &before.frames(8));
    fusion.flush();
    let ids = |fusion: &Fusion| -> Vec<Option<u64>> {
        before.paths.iter().map(|path| Some(found(fusion, path)?.id.0)).collect()
    };
    let known = ids(&fusion);
    assert!(known.iter().all(Option::is_some), "{known:?}");
    fusion.calibrate(&calibration(&after.eyes[2])).unwrap();
    ingest_all(&mut fusion, &after.frames(9));
    assert_eq!(ids(&fusion), known, "the same tracks go on");
    assert_eq!(fusion.counters().get("tracks_born"), 2);
    finds_an_ordinary_target(&mut fusion, 7.0);
}
