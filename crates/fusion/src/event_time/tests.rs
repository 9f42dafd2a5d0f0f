use proptest::prelude::*;

use super::*;

fn exposure(camera: &str, time_s: f64) -> Exposure {
    Exposure {
        camera: camera.parse().unwrap(),
        sequence: 0,
        time: Timestamp::from_seconds(time_s),
        uncertainty: crate::uncertainty::CameraUncertainty::of_time(0.0),
        pointed: None,
        clutter_per_sr: 1.0,
        correction_s: 0.0,
        sightings: vec![],
    }
}

fn drain(buffer: &mut EventBuffer) -> Vec<f64> {
    let mut times = Vec::new();
    while let Some(next) = buffer.release() {
        let Ok(exposure) = next else { continue };
        buffer.mark_processed(exposure.time);
        times.push(exposure.time.seconds());
    }
    times
}

#[test]
fn a_frame_waits_for_the_slowest_camera() {
    let mut buffer = EventBuffer::new(EventTime::default());
    buffer.insert(exposure("a", 1.0)).unwrap();
    buffer.insert(exposure("b", 1.1)).unwrap();
    buffer.insert(exposure("a", 1.2)).unwrap();
    assert_eq!(drain(&mut buffer), [1.0, 1.1]);
    buffer.insert(exposure("b", 1.3)).unwrap();
    assert_eq!(drain(&mut buffer), [1.2]);
}

#[test]
fn frames_out_of_order_are_told_and_put_into_order() {
    let mut buffer = EventBuffer::new(EventTime::default());
    assert_eq!(buffer.insert(exposure("a", 1.1)), Ok(ExposureArrival::InOrder));
    assert_eq!(buffer.insert(exposure("a", 1.0)), Ok(ExposureArrival::OutOfOrder));
    assert_eq!(buffer.insert(exposure("a", 1.1)), Err(RejectionReason::Duplicate));
    buffer.insert(exposure("b", 2.0)).unwrap();
    buffer.insert(exposure("a", 2.0)).unwrap();
    assert_eq!(drain(&mut buffer), [1.0, 1.1, 2.0, 2.0]);
}

#[test]
fn what_is_overtaken_is_taken_until_something_later_is_worked_on() {
    let mut buffer = EventBuffer::new(EventTime::default());
    for (camera, time_s) in [("a", 1.0), ("a", 1.2), ("b", 1.25)] {
        buffer.insert(exposure(camera, time_s)).unwrap();
    }
    // Two come out, and the second waits for the clocks.
    buffer.release().unwrap().unwrap();
    buffer.mark_processed(Timestamp::from_seconds(1.0));
    assert_eq!(buffer.release().unwrap().unwrap().time, Timestamp::from_seconds(1.2));
    assert_eq!(buffer.insert(exposure("a", 1.1)), Ok(ExposureArrival::OutOfOrder));
    assert_eq!(buffer.release().unwrap().unwrap().time, Timestamp::from_seconds(1.1));
    buffer.mark_processed(Timestamp::from_seconds(1.2));
    let late = buffer.insert(exposure("a", 1.15)).unwrap_err();
    assert!(
        matches!(late, RejectionReason::Late { by_s } if (by_s - 0.05).abs() < 1e-9),
        "{late:?}"
    );
}

#[test]
fn what_comes_at_the_time_of_the_last_is_taken_and_what_comes_twice_is_told_from_what_is_late() {
    let mut buffer = EventBuffer::new(EventTime::default());
    for (camera, time_s) in [("a", 1.0), ("c", 1.0), ("a", 1.1), ("c", 1.1), ("c", 1.2)] {
        buffer.insert(exposure(camera, time_s)).unwrap();
    }
    assert_eq!(drain(&mut buffer), [1.0, 1.0, 1.1, 1.1]);
    assert_eq!(buffer.insert(exposure("b", 1.1)), Ok(ExposureArrival::InOrder));
    assert_eq!(drain(&mut buffer), [1.1]);
    for (camera, time_s) in [("a", 1.0), ("b", 1.1), ("c", 1.1), ("c", 1.2)] {
        assert_eq!(buffer.insert(exposure(camera, time_s)), Err(RejectionReason::Duplicate));
    }
    assert!(matches!(buffer.insert(exposure("b", 1.0)), Err(RejectionReason::Late { .. })));
}

/// Takes in frames of `b`, and of `a` in pairs whose second comes first; returns how many are
/// refused.
fn swapped(buffer: &mut EventBuffer, tenths: std::ops::Range<u32>) -> usize {
    let mut refused = 0;
    for k in tenths {
        let t = 0.1 * f64::from(k);
        let of_a = if k % 2 == 0 { t + 0.1 } else { t - 0.1 };
        refused += usize::from(buffer.insert(exposure("a", of_a)).is_err());
        buffer.insert(exposure("b", t + 0.15)).unwrap();
        drain(buffer);
    }
    refused
}

#[test]
fn a_camera_whose_frames_overtake_each_other_is_waited_for_from_then_on() {
    let mut buffer = EventBuffer::new(EventTime::default());
    assert_eq!(swapped(&mut buffer, 0..100), 1);
    // For a while nobody relies on the order of `a`, then everybody does again.
    let mut waits = Vec::new();
    for k in 100..400 {
        let t = 0.1 * f64::from(k);
        buffer.insert(exposure("a", t + 0.1)).unwrap();
        buffer.insert(exposure("b", t + 0.15)).unwrap();
        let newest = drain(&mut buffer).last().copied();
        waits.push(newest.is_none_or(|newest| newest < t + 0.09));
    }
    let (first, last) = waits.split_at(90);
    assert!(first.iter().all(|wait| *wait) && last[20..].iter().all(|wait| !wait), "{waits:?}");
}

#[test]
fn a_clock_that_was_ahead_is_waited_for_when_it_is_right_again() {
    for (ahead_s, refused) in [(5.0, vec![21, 22]), (3600.0, vec![20, 21, 22])] {
        let mut buffer = EventBuffer::new(EventTime::default());
        buffer.expect(&"c".parse().unwrap());
        let mut errors = Vec::new();
        for k in 0..60 {
            let t = 0.1 * f64::from(k);
            buffer.insert(exposure("a", t)).unwrap();
            buffer.insert(exposure("b", t)).unwrap();
            // `c` comes 0.3 s after the others.
            let wrong = if k == 20 { ahead_s } else { 0.0 };
            if k >= 3 && buffer.insert(exposure("c", t - 0.3 + wrong)).is_err() {
                errors.push(k);
            }
            drain(&mut buffer);
        }
        // When `c` was ahead nobody waited for it: the others were worked on up to 2.0 s.
        assert_eq!(errors, refused);
    }
}

#[test]
fn a_silent_camera_holds_nobody_up_for_longer_than_the_lateness() {
    let mut buffer = EventBuffer::new(EventTime::default());
    buffer.insert(exposure("c", 0.0)).unwrap();
    for i in 1..20 {
        buffer.insert(exposure("a", f64::from(i) * 0.1)).unwrap();
        buffer.insert(exposure("b", f64::from(i) * 0.1 + 0.01)).unwrap();
    }
    let released = drain(&mut buffer);
    assert!(*released.last().unwrap() > 1.3, "{released:?}");
    assert!(matches!(buffer.insert(exposure("c", 0.5)), Err(RejectionReason::Late { .. })));
}

#[test]
fn a_camera_that_should_be_heard_is_waited_for_in_the_beginning_and_not_for_ever() {
    let mut buffer = EventBuffer::new(EventTime::default());
    for camera in ["a", "b", "c"] {
        buffer.expect(&camera.parse().unwrap());
    }
    buffer.insert(exposure("a", 0.0)).unwrap();
    buffer.insert(exposure("b", 0.0)).unwrap();
    assert_eq!(drain(&mut buffer), []);
    buffer.insert(exposure("c", 0.0)).unwrap();
    assert_eq!(drain(&mut buffer), [0.0, 0.0, 0.0]);
    for i in 1..40 {
        buffer.insert(exposure("a", f64::from(i) * 0.1)).unwrap();
        buffer.insert(exposure("b", f64::from(i) * 0.1)).unwrap();
    }
    // `c` is silent: after two seconds only the two others count.
    assert!(drain(&mut buffer).last().is_some_and(|&time| time > 3.85));
}

#[test]
fn one_camera_from_the_future_is_refused_and_drags_nobody() {
    let mut buffer = EventBuffer::new(EventTime::default());
    // The liar comes first, when there is nothing to compare it with.
    buffer.insert(exposure("liar", 1e6)).unwrap();
    for i in 0..10 {
        buffer.insert(exposure("a", f64::from(i))).unwrap();
        buffer.insert(exposure("b", f64::from(i) + 0.01)).unwrap();
    }
    // Ten of `a` and nine of `b`: the tenth of `b` waits for `a`.
    assert_eq!(drain(&mut buffer).len(), 19);
    assert!(matches!(
        buffer.insert(exposure("liar", 1e6 + 1.0)),
        Err(RejectionReason::Future { .. })
    ));
}

#[test]
fn after_a_common_pause_two_cameras_bring_the_time_back() {
    let mut buffer = EventBuffer::new(EventTime::default());
    buffer.insert(exposure("a", 0.0)).unwrap();
    buffer.insert(exposure("b", 0.0)).unwrap();
    assert!(buffer.insert(exposure("a", 60.0)).is_err());
    buffer.insert(exposure("b", 60.01)).unwrap();
    buffer.insert(exposure("a", 60.02)).unwrap();
    assert!(drain(&mut buffer).contains(&60.01));
}

/// Takes in ten frames a second of `cameras`, as `change` makes them (`None`: none); returns how
/// many are refused.
fn run(
    buffer: &mut EventBuffer,
    cameras: usize,
    seconds: std::ops::Range<u32>,
    change: impl Fn(usize, f64) -> Option<f64>,
) -> usize {
    let mut refused = 0;
    for k in seconds.start * 10..seconds.end * 10 {
        for camera in 0..cameras {
            let t = 0.1 * f64::from(k) + 0.1 * camera as f64 / cameras as f64;
            let Some(time_s) = change(camera, t) else { continue };
            let name = format!("c{camera:02}");
            refused += usize::from(buffer.insert(exposure(&name, time_s)).is_err());
            while let Some(next) = buffer.release() {
                match next {
                    Ok(exposure) => buffer.mark_processed(exposure.time),
                    Err(_) => refused += 1,
                }
            }
        }
    }
    refused
}

fn between(range: std::ops::Range<f64>, t: f64, ahead_s: f64) -> f64 {
    if range.contains(&t) { t + ahead_s } else { t }
}

#[test]
fn a_minority_of_clocks_ahead_costs_its_own_frames_alone() {
    for (ahead_s, until_s, wrong) in [(60.0, 5.3, 6), (3600.0, 6.0, 20), (1.503, 6.0, 0)] {
        let mut buffer = EventBuffer::new(EventTime::default());
        let lie = |camera, t| Some(if camera > 2 { between(5.0..until_s, t, ahead_s) } else { t });
        let refused = run(&mut buffer, 5, 0..40, lie);
        assert!((wrong..=wrong + 2).contains(&refused), "{ahead_s}: {refused}");
    }
}

#[test]
fn a_clock_ahead_is_not_vouched_for_by_one_that_is_dead() {
    let mut buffer = EventBuffer::new(EventTime::default());
    let lie = |camera, t| match camera {
        3 => (t < 5.1).then(|| between(5.0..5.1, t, 3600.0)),
        4 => Some(between(10.0..10.1, t, 3590.0)),
        _ => Some(t),
    };
    assert_eq!(run(&mut buffer, 5, 0..40, lie), 2);
}

#[test]
fn sixteen_cameras_are_not_dragged_by_seven() {
    let mut buffer = EventBuffer::new(EventTime::default());
    let lie = |camera, t| Some(if camera < 7 { between(5.0..6.0, t, 9.003) } else { t });
    assert_eq!(run(&mut buffer, 16, 0..20, lie), 0, "within what may be ahead they wait");
    assert!(
        drain(&mut buffer).is_empty() && buffer.waiting.load().0 <= 16,
        "{}",
        buffer.waiting.load().0
    );
}

#[test]
fn the_last_of_three_cameras_is_followed_after_a_while() {
    let mut buffer = EventBuffer::new(EventTime::default());
    let dead = |camera, t| (camera == 0 || t < 5.0).then_some(t);
    assert_eq!(run(&mut buffer, 3, 0..20, dead), 0);
    assert!(buffer.released > Timestamp::from_seconds(19.3), "{:?}", buffer.released);
    // The others come back and are waited for again.
    assert_eq!(run(&mut buffer, 3, 20..25, |_, t| Some(t)), 0);
    assert!(buffer.released > Timestamp::from_seconds(24.8), "{:?}", buffer.released);
}

#[test]
fn a_camera_that_comes_back_with_a_later_clock_drags_nobody() {
    for (ahead_s, all) in [(3.0, 0), (100.0, 150)] {
        let mut buffer = EventBuffer::new(EventTime::default());
        let later = |camera, t| match camera {
            2 if (5.0..10.0).contains(&t) => None,
            2 => Some(between(10.0..f64::INFINITY, t, ahead_s)),
            _ => Some(t),
        };
        let refused = run(&mut buffer, 3, 0..25, later);
        assert!((all..all + 2).contains(&refused), "{ahead_s}: {refused}");
        assert!(buffer.released > Timestamp::from_seconds(24.8), "{:?}", buffer.released);
    }
}

#[test]
fn where_most_clocks_come_back_from_ahead_the_order_is_taken_up_anew() {
    for cameras in [1, 2, 3, 5] {
        let mut buffer = EventBuffer::new(EventTime::default());
        let refused = run(&mut buffer, cameras, 0..40, |_, t| Some(between(5.0..7.0, t, 600.0)));
        assert!(buffer.take_rewind().is_some(), "{cameras} cameras");
        // For the 2 s that they must be behind, for which they are waited for, and a few frames.
        assert!(refused < 40 * cameras, "{cameras} cameras: {refused}");
        assert!(buffer.released > Timestamp::from_seconds(39.0), "{:?}", buffer.released);
        assert!(buffer.released < Timestamp::from_seconds(40.1), "{:?}", buffer.released);
    }
}

#[test]
fn what_a_network_held_back_is_late_and_not_a_clock_that_was_ahead() {
    let mut buffer = EventBuffer::new(EventTime::default());
    run(&mut buffer, 3, 0..5, |_, t| Some(t));
    run(&mut buffer, 3, 5..9, |camera, t| (camera == 0).then_some(t));
    // Four seconds of two cameras come at once.
    run(&mut buffer, 3, 5..9, |camera, t| (camera > 0).then_some(t));
    run(&mut buffer, 3, 9..20, |_, t| Some(t));
    assert_eq!(buffer.take_rewind(), None);
}

/// Three cameras at 30 Hz until `until_s`; the third is silent from 10 to 20 s and says it all
/// then, maybe the newest first. Returns what is done with each frame, by its camera.
fn backlog(
    buffer: &mut EventBuffer,
    until_s: f64,
    newest_first: bool,
) -> Vec<(&'static str, Result<ExposureArrival, RejectionReason>)> {
    let mut heard = Vec::new();
    let mut held_back = Vec::new();
    for k in 0..(30.0 * until_s) as u32 {
        let t = f64::from(k) / 30.0;
        if (10.0..20.0).contains(&t) {
            held_back.push(t + 0.02);
        } else {
            let now = t + 0.02;
            let mut all: Vec<f64> = std::mem::take(&mut held_back);
            all.insert(if newest_first { 0 } else { all.len() }, now);
            heard.extend(all.into_iter().map(|time| ("c", buffer.insert(exposure("c", time)))));
        }
        for (camera, phase) in [("a", 0.0), ("b", 0.01)] {
            heard.push((camera, buffer.insert(exposure(camera, t + phase))));
        }
        assert_eq!(buffer.take_rewind(), None, "at {t} s");
        drain(buffer);
    }
    heard
}

#[test]
fn what_a_camera_says_all_at_once_of_ten_seconds_moves_nobody() {
    for newest_first in [false, true] {
        let mut buffer = EventBuffer::new(EventTime::default());
        let heard = backlog(&mut buffer, 30.0, newest_first);
        let refused = |of: &str| heard.iter().filter(|(c, how)| *c == of && how.is_err()).count();
        assert_eq!((refused("a"), refused("b")), (0, 0));
        // Of the third at most the frames before the lateness are refused, and none later.
        assert!(refused("c") as f64 <= 30.0 * 10.0, "{}", refused("c"));
        assert!(heard.iter().rev().take(800).all(|(_, how)| how.is_ok()));
    }
}

#[test]
fn a_camera_whose_clock_is_a_second_behind_holds_nobody_up_for_long() {
    let mut buffer = EventBuffer::new(EventTime::default());
    let mut waits = Vec::new();
    for k in 0..900_u32 {
        let t = f64::from(k) / 30.0;
        let behind_s = if (300..600).contains(&k) { 1.0 } else { 0.0 };
        for (camera, time_s) in [("a", t), ("b", t + 0.01), ("c", t + 0.02 - behind_s)] {
            let _ = buffer.insert(exposure(camera, time_s));
        }
        let newest = drain(&mut buffer).last().copied();
        waits.push(newest.is_none_or(|newest| newest < t - 0.1));
    }
    let waited = |range: std::ops::Range<usize>| waits[range].iter().filter(|wait| **wait).count();
    assert_eq!(waited(10..300), 0);
    // Waited for two seconds at its first jump, and not after that; nor when it is right again.
    assert!(waited(300..600) <= 75, "{}", waited(300..600));
    assert_eq!((waited(400..600), waited(610..900)), (0, 0));
}

#[test]
fn a_camera_alone_whose_clock_went_back_is_followed_after_a_while() {
    let mut buffer = EventBuffer::new(EventTime::default());
    let mut last = None;
    for k in 0..900_u32 {
        let t = f64::from(k) / 30.0;
        // Two cameras die at 10 s; the clock of the third goes back by a minute at 11 s.
        let of_third = if t < 11.0 { t + 0.02 } else { t - 60.0 };
        let all = [("a", t), ("b", t + 0.01), ("c", of_third)];
        for (camera, time_s) in all.into_iter().skip(if t < 10.0 { 0 } else { 2 }) {
            let _ = buffer.insert(exposure(camera, time_s));
        }
        last = drain(&mut buffer).last().copied().or(last);
    }
    assert!(last.is_some_and(|last| (-32.0..-30.0).contains(&last)), "{last:?}");
}

fn crowded(camera: &str, time_s: f64, sightings: usize) -> Exposure {
    let line = crossfix_geometry::SightLine {
        origin: nalgebra::Point3::origin(),
        direction: nalgebra::Vector3::x_axis(),
        basis: nalgebra::Matrix3x2::identity(),
        covariance: nalgebra::Matrix2::identity(),
    };
    let sighting =
        crate::Sighting { image_track: 1, line, rooted: crate::cameras::Rooted::Unknown };
    Exposure { sightings: vec![sighting; sightings], ..exposure(camera, time_s) }
}

#[test]
fn sightings_that_wait_are_counted_and_bounded() {
    let patient = EventTime { lateness_s: 60.0, ..EventTime::default() };
    let mut buffer = EventBuffer::new(patient);
    buffer.insert(exposure("b", 0.0)).unwrap();
    let mut most = 0;
    for k in 1..40 {
        buffer.insert(crowded("a", 0.1 * f64::from(k), 10_000)).unwrap();
        drain(&mut buffer);
        most = most.max(buffer.waiting.load().1);
    }
    assert_eq!(most, 100_000);
    while buffer.pop().is_some() {}
    assert_eq!(buffer.waiting.load(), (0, 0));
}

#[test]
fn exposures_that_wait_are_counted_and_bounded() {
    let mut buffer = EventBuffer::new(EventTime::default());
    buffer.insert(exposure("b", 0.0)).unwrap();
    for k in 1..10_000 {
        buffer.insert(exposure("a", 1e-6 * f64::from(k))).unwrap();
        drain(&mut buffer);
    }
    assert_eq!(buffer.waiting.load().0, 6_000);
}

#[test]
fn a_camera_alone_is_followed_after_the_lateness() {
    let mut buffer = EventBuffer::new(EventTime::default());
    buffer.expect(&"b".parse().unwrap());
    assert_eq!(run(&mut buffer, 1, 0..60, |_, t| Some(t)), 0);
    assert!((5..7).contains(&buffer.waiting.load().0), "{}", buffer.waiting.load().0);
}

proptest! {
    #[test]
    fn the_order_of_arrival_changes_nothing(seed in proptest::collection::vec(0..1000u32, 30)) {
        let frames: Vec<Exposure> =
            (0..30).map(|i| exposure(["a", "b", "c"][i % 3], 0.01 * i as f64)).collect();
        let mut shuffled: Vec<(u32, Exposure)> = seed.into_iter().zip(frames).collect();
        shuffled.sort_by_key(|(key, _)| *key);
        let mut buffer = EventBuffer::new(EventTime::default());
        let mut released = Vec::new();
        for (_, frame) in shuffled {
            buffer.insert(frame).unwrap();
        }
        while let Some(Ok(frame)) = buffer.pop() {
            released.push(frame.time);
        }
        prop_assert_eq!(released.len(), 30);
        prop_assert!(released.is_sorted());
    }
}

#[test]
fn a_clock_that_races_costs_nobody_else_a_frame() {
    let mut buffer = EventBuffer::new(EventTime::default());
    let (mut refused, mut raced) = (Vec::new(), 0.0);
    for tick in 0..6000_u32 {
        // Two hundred ticks a second; the third camera races from 10 to 20 s, a second each tick.
        let t = f64::from(tick) / 200.0;
        let races = (10.0..20.0).contains(&t);
        raced += f64::from(u8::from(races));
        let mut all = Vec::new();
        if tick % 8 == 0 {
            all.push(("a", t));
        }
        if tick % 10 == 3 {
            all.push(("b", t));
        }
        if races {
            all.push(("c", t + raced));
        } else if tick % 7 == 0 {
            all.push(("c", t));
        }
        for (camera, time_s) in all {
            if buffer.insert(exposure(camera, time_s)).is_err() && camera != "c" {
                refused.push(t);
            }
        }
        assert_eq!(buffer.take_rewind(), None, "at {t} s");
        drain(&mut buffer);
    }
    assert!(refused.is_empty(), "{refused:?}");
}

#[test]
fn those_that_outlive_cameras_whose_clocks_were_ahead_are_followed() {
    // Five cameras; three, or two with two that are right, are an hour ahead and die at 20 s.
    for ahead in [3, 2] {
        let mut buffer = EventBuffer::new(EventTime::default());
        let cameras = 2 + ahead;
        let change = |camera: usize, t: f64| match camera {
            0 | 1 => Some(t),
            _ => (t < 20.0).then_some(t + 3600.0),
        };
        run(&mut buffer, cameras, 0..120, change);
        let refused = run(&mut buffer, cameras, 120..130, change);
        assert_eq!(refused, 0, "{ahead} ahead");
        assert!(buffer.released > Timestamp::from_seconds(129.0), "{:?}", buffer.released);
    }
}
