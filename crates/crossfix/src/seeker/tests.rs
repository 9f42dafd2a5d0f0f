#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use crossfix_geometry::{Distortion, ImageSize, Intrinsics, Pose};
use crossfix_message::Expected;
use nalgebra::Point3;

use super::*;

fn model() -> CameraModel {
    CameraModel::new(Intrinsics {
        size: ImageSize { width: 640, height: 480 },
        fx: 3000.0,
        fy: 3000.0,
        cx: 319.5,
        cy: 239.5,
        distortion: Distortion::None,
    })
    .unwrap()
}

fn mount() -> PanTilt {
    let rest = Pose::looking_at(Point3::origin(), Point3::new(0.0, 100.0, 0.0)).unwrap();
    PanTilt::new(rest, [-3.0, 3.0], [-0.3, 1.4]).unwrap()
}

/// A cue of track 7, which turns to the left, at a time; `sds` along both tangents, rad.
fn cue(time_s: f64, azimuth: f64, rate: f64, sds: [f64; 2]) -> CueFrame {
    let ahead = [0.0, 0.25, 0.5, 1.0, 2.0].map(|ahead_s| {
        let paper = ScanAngles { azimuth: azimuth + rate * ahead_s, elevation: 0.2 }.bearing();
        Expected {
            time_ns: Timestamp::from_seconds(time_s + ahead_s).nanos(),
            bearing: Some(crossfix_geometry::camera_from_paper(paper.into_inner()).into()),
            covariance_xx: sds[0].powi(2),
            covariance_xy: 0.0,
            covariance_yy: sds[1].powi(2),
        }
    });
    let of = Some(Cued { track_id: 7, ..Default::default() });
    let cue = Cue { of, ahead: ahead.to_vec(), range_m: 100.0, log_range_sd: 0.01 };
    CueFrame { cues: vec![cue], ..Default::default() }
}

/// A track at these angles of the frame at rest, as seen by a head at `at`.
fn track(id: u64, at: ScanAngles, azimuth: f64, elevation: f64) -> BearingTrack {
    let paper = ScanAngles { azimuth, elevation }.bearing().into_inner();
    let direction = crossfix_geometry::camera_from_paper(paper);
    BearingTrack {
        track_id: id,
        bearing: Some((turn_of(&mount(), at).inverse() * direction).into()),
        covariance_xx: 1e-8,
        covariance_yy: 1e-8,
        state: ImageTrackState::Tracking.into(),
        ..Default::default()
    }
}

fn seconds(t: f64) -> Timestamp {
    Timestamp::from_seconds(t)
}

const REST: ScanAngles = ScanAngles { azimuth: 0.0, elevation: 0.0 };

#[test]
fn it_turns_ahead_of_the_target_and_stares_while_that_crosses_the_view() {
    let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
    assert_eq!(seeker.observe(seconds(0.9), Pointed::Settled(REST), &[]), Orders::default());
    seeker.take_cues(cue(1.0, 0.8, 0.05, [1e-3; 2]));
    let aim = seeker.observe(seconds(1.0), Pointed::Settled(REST), &[]).aim.unwrap();
    assert!(aim.azimuth > 0.82 && aim.azimuth < 0.88, "{aim:?}");
    assert!((aim.elevation - 0.2).abs() < 1e-4);
    // On the way it gets no new order unless the target is somewhere quite different; once there it
    // stays until the target has passed.
    let half = ScanAngles { azimuth: 0.4, elevation: 0.1 };
    assert_eq!(seeker.observe(seconds(1.1), Pointed::Turning(half), &[]).aim, None);
    seeker.take_cues(cue(1.1, -0.8, 0.05, [1e-3; 2]));
    let other = seeker.observe(seconds(1.1), Pointed::Turning(half), &[]).aim.unwrap();
    assert!(other.azimuth < -0.7, "{other:?}");
    seeker.take_cues(cue(1.1, 0.805, 0.05, [1e-3; 2]));
    let aim = seeker.observe(seconds(1.1), Pointed::Turning(half), &[]).aim.unwrap();
    assert!((aim.azimuth - 0.854).abs() < 1e-3, "{aim:?}");
    let turned: Vec<f64> = (0..40)
        .map(|k| 1.2 + 0.1 * f64::from(k))
        .filter(|&t| {
            seeker.take_cues(cue(t, 0.8 + 0.05 * (t - 1.0), 0.05, [1e-3; 2]));
            seeker.observe(seconds(t), Pointed::Settled(aim), &[]).aim.is_some()
        })
        .collect();
    assert!((2.5..3.3).contains(&turned[0]), "{turned:?}");
}

#[test]
fn a_track_is_taken_over_when_it_has_been_where_the_cue_is_for_three_images() {
    let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
    seeker.take_cues(cue(1.0, 0.5, 0.0, [1e-3; 2]));
    let at = ScanAngles { azimuth: 0.48, elevation: 0.21 };
    let look = |seeker: &mut Seeker, tracks: &[BearingTrack]| {
        let orders = seeker.observe(seconds(1.1), Pointed::Settled(at), tracks);
        orders.taken_over.map(|taken| (taken.image_track_id, taken.of.unwrap().track_id))
    };
    let (target, bird) = (track(3, at, 0.5005, 0.2), track(4, at, 0.47, 0.2));
    assert_eq!(look(&mut seeker, &[bird, target]), None);
    assert_eq!(look(&mut seeker, &[bird, target]), None);
    assert_eq!(look(&mut seeker, &[bird, target]), Some((3, 7)));
    // Once the target is recognised, another that passes as near is no rival; one there from the
    // start is.
    let rival = track(5, at, 0.4998, 0.2);
    assert_eq!(look(&mut seeker, &[rival, target]), Some((3, 7)));
    let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
    seeker.take_cues(cue(1.0, 0.5, 0.0, [1e-3; 2]));
    assert!((0..10).all(|_| look(&mut seeker, &[rival, target]).is_none()));
}

#[test]
fn a_stripe_is_looked_along_from_its_middle_to_both_ends() {
    let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
    let (mut at, mut views) = (REST, Vec::new());
    for k in 0..200 {
        let t = 0.1 * f64::from(k);
        seeker.take_cues(cue(t, 0.6, 0.0, [0.3, 1e-3]));
        if let Some(aim) = seeker.observe(seconds(t), Pointed::Settled(at), &[]).aim {
            at = aim;
            views.push(aim.azimuth - 0.6);
        }
    }
    let reach = views.iter().fold(0.0f64, |most, view| most.max(view.abs()));
    assert!((0.5..0.75).contains(&reach), "{views:?}");
    assert!(views[0].abs() < 1e-6 && views[1] * views[2] < 0.0, "{views:?}");
    let mut sorted = views[..9].to_vec();
    sorted.sort_by(f64::total_cmp);
    // No gaps: the view is 160 mrad high.
    assert!(sorted.windows(2).all(|two| two[1] - two[0] < 0.16), "{sorted:?}");
    // A track seen during the search is stared at.
    let seen = track(9, at, at.azimuth, at.elevation);
    let looks = (0..60).map(|k| 20.0 + 0.1 * f64::from(k));
    let orders: Vec<Orders> = looks
        .map(|t| {
            seeker.take_cues(cue(t, 0.6, 0.0, [0.3, 1e-1]));
            seeker.observe(seconds(t), Pointed::Settled(at), &[seen])
        })
        .collect();
    assert!(orders.iter().skip(3).all(|orders| orders.aim.is_none()));
    assert_eq!(orders[5].taken_over.as_ref().unwrap().image_track_id, 9);
}

#[test]
fn old_and_impossible_cues_move_nothing() {
    let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
    seeker.take_cues(cue(1.0, 0.8, 0.05, [1e-3; 2]));
    assert_eq!(seeker.observe(seconds(4.0), Pointed::Settled(REST), &[]), Orders::default());
    let spoil: [fn(&mut Expected); 5] = [
        |one| one.bearing = None,
        |one| one.bearing = Some(Vector3::zeros().into()),
        |one| one.bearing = Some(Vector3::new(f64::NAN, 0.0, 1.0).into()),
        |one| one.covariance_xx = f64::INFINITY,
        |one| one.covariance_yy = -1.0,
    ];
    for spoil in spoil {
        let mut cues = cue(1.0, 0.8, 0.05, [1e-3; 2]);
        cues.cues[0].ahead.iter_mut().for_each(spoil);
        seeker.take_cues(cues);
        assert_eq!(seeker.observe(seconds(1.0), Pointed::Settled(REST), &[]), Orders::default());
    }
    let mut empty = cue(1.0, 0.8, 0.05, [1e-3; 2]);
    empty.cues[0].ahead.clear();
    seeker.take_cues(empty);
    assert_eq!(seeker.observe(seconds(1.0), Pointed::Settled(REST), &[]), Orders::default());
}

#[test]
fn a_camera_that_stands_still_takes_over_what_it_sees_and_turns_nothing() {
    let wide = Intrinsics { fx: 1000.0, fy: 1000.0, ..*model().intrinsics() };
    let mut seeker = Seeker::new(&CameraModel::new(wide).unwrap(), None, 0.0);
    // Another target's cue is first, but outside the image.
    let mut cues = cue(1.0, 1.5, 0.0, [1e-3; 2]);
    cues.cues.push(cue(1.0, 0.02, 0.0, [1e-3; 2]).cues.remove(0));
    cues.cues[1].of = Some(Cued { track_id: 8, ..Default::default() });
    seeker.take_cues(cues);
    let seen = track(3, REST, 0.02, 0.2);
    let orders: Vec<Orders> =
        (0..3).map(|_| seeker.observe(seconds(1.1), Pointed::Fixed, &[seen])).collect();
    assert!(orders.iter().all(|orders| orders.aim.is_none()));
    let taken = orders[2].taken_over.as_ref().unwrap();
    assert_eq!((taken.image_track_id, taken.of.as_ref().unwrap().track_id), (3, 8));
}

/// A detector misses an image, or the mount does not obey: the seeker stays on the target it has
/// found.
#[test]
fn what_is_found_is_not_left_for_one_image_without_it_nor_for_orders_that_nobody_heeds() {
    let stripe = |t: f64| {
        let mut cues = cue(t, 0.3, 0.0, [0.3, 1e-1]);
        cues.cues[0].of = Some(Cued { camera: "north".into(), ..Default::default() });
        cues
    };
    let at = ScanAngles { azimuth: 0.3, elevation: 0.2 };
    let seen = track(4, at, 0.3, 0.2);
    let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
    for k in 0..60 {
        let t = 1.0 + 0.05 * f64::from(k);
        seeker.take_cues(stripe(t));
        let missed = [20, 30, 31].contains(&k);
        let tracks = if missed { &[][..] } else { std::slice::from_ref(&seen) };
        let orders = seeker.observe(seconds(t), Pointed::Settled(at), tracks);
        assert_eq!(orders.aim, None, "{k}");
        assert_eq!(orders.taken_over.is_some(), k >= 2 && !missed, "{k}");
    }
    // The target is off the middle, but the head may not turn.
    let aside = ScanAngles { azimuth: 0.3 - 0.06, elevation: 0.2 };
    let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
    seeker.hold(true);
    let seen = track(4, aside, 0.3, 0.2);
    let looks: Vec<Orders> = (0..5)
        .map(|k| {
            let t = 1.0 + 0.05 * f64::from(k);
            seeker.take_cues(cue(t, 0.3, 0.0, [1e-3; 2]));
            seeker.observe(seconds(t), Pointed::Settled(aside), &[seen])
        })
        .collect();
    assert!(looks.iter().all(|orders| orders.aim.is_none()) && looks[4].taken_over.is_some());
    seeker.hold(false);
    let orders = seeker.observe(seconds(1.25), Pointed::Settled(aside), &[seen]);
    assert!(orders.aim.is_some());
}

/// The mount's angles are wrong by much more than the cue's SD.
#[test]
fn what_the_angles_are_off_by_widens_the_gate() {
    for (angle_sd_rad, taken) in [(0.0, false), (3e-3, true)] {
        let mut seeker = Seeker::new(&model(), Some(mount()), angle_sd_rad);
        seeker.take_cues(cue(1.0, 0.5, 0.0, [6e-4; 2]));
        let (said, truth) = (0.5, 0.504);
        let [at, really] = [said, truth].map(|azimuth| ScanAngles { azimuth, elevation: 0.2 });
        let target = track(3, really, 0.5, 0.2);
        let looks = (0..4).map(|_| seeker.observe(seconds(1.1), Pointed::Settled(at), &[target]));
        assert_eq!(looks.last().unwrap().taken_over.is_some(), taken);
    }
}

/// Where a head stared that turns at `slow_rad_per_s`, and reports having settled `settles_s` after
/// it stood still.
fn stares(slow_rad_per_s: f64, settles_s: f64) -> Vec<f64> {
    let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
    let (mut at, mut to, mut arrives) = (REST, REST, 0.0);
    let mut stood: Vec<f64> = Vec::new();
    for k in 0..600 {
        let t = 0.05 * f64::from(k);
        seeker.take_cues(cue(t, 0.6, 0.0, [0.3, 1e-3]));
        let pointed = if t < arrives { Pointed::Turning(at) } else { Pointed::Settled(to) };
        if t >= arrives {
            at = to;
            *stood.last_mut().unwrap_or(&mut 0.0) += 0.05;
        }
        if let Some(aim) = seeker.observe(seconds(t), pointed, &[]).aim {
            assert!(t >= arrives, "it is told nothing else on its way");
            arrives = t + (aim.azimuth - at.azimuth).abs() / slow_rad_per_s + settles_s;
            to = aim;
            stood.push(0.0);
        }
    }
    stood
}

#[test]
fn a_slow_head_stares_as_long_at_each_view_of_a_stripe_as_a_quick_one() {
    for (slow_rad_per_s, settles_s) in [(50.0, 0.0), (0.5, 0.9), (0.2, 2.0)] {
        let stood = stares(slow_rad_per_s, settles_s);
        let whole = &stood[..stood.len() - 1];
        assert!(whole.len() >= 2 && whole.iter().all(|s| (1.4..1.7).contains(s)), "{stood:?}");
    }
}

#[test]
fn what_the_mount_does_not_reach_is_left_for_what_it_does() {
    let reach = mount();
    let mut seeker = Seeker::new(&model(), Some(reach), 0.0);
    // The first target is behind the mount's range, the second one within.
    let mut cues = cue(1.0, 3.12, 0.02, [1e-3; 2]);
    cues.cues.push(cue(1.0, 1.0, 0.02, [1e-3; 2]).cues.remove(0));
    cues.cues[1].of = Some(Cued { track_id: 8, ..Default::default() });
    seeker.take_cues(cues);
    let aim = seeker.observe(seconds(1.0), Pointed::Settled(REST), &[]).aim.unwrap();
    assert!((0.9..1.1).contains(&aim.azimuth), "{aim:?}");
    // At the end of its range the mount reports slightly different angles than it was told.
    let mut seeker = Seeker::new(&model(), Some(reach), 0.0);
    let mut turns = 0;
    let mut at = REST;
    for k in 0..100 {
        let t = 1.0 + 0.05 * f64::from(k);
        seeker.take_cues(cue(t, 3.05, 0.0, [1e-3; 2]));
        if let Some(aim) = seeker.observe(seconds(t), Pointed::Settled(at), &[]).aim {
            turns += 1;
            at = ScanAngles { azimuth: aim.azimuth + 1e-4, ..aim };
        }
    }
    assert_eq!(turns, 1);
}

#[test]
fn a_track_is_preferred_to_what_one_camera_saw_unless_that_is_found() {
    let of_one = |time_s: f64| {
        let mut cues = cue(time_s, 0.3, 0.0, [1e-2; 2]);
        cues.cues[0].of = Some(Cued { camera: "north".into(), ..Default::default() });
        cues
    };
    let both = |time_s: f64| {
        let mut cues = of_one(time_s);
        cues.cues.push(cue(time_s, -0.5, 0.0, [1e-3; 2]).cues.remove(0));
        cues
    };
    let at = ScanAngles { azimuth: 0.3, elevation: 0.2 };
    let seen = track(4, at, 0.3, 0.2);
    for (tracks, leaves) in [(&[][..], true), (&[seen][..], false)] {
        let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
        for k in 0..4 {
            let t = 1.0 + 0.1 * f64::from(k);
            seeker.take_cues(of_one(t));
            seeker.observe(seconds(t), Pointed::Settled(at), tracks);
        }
        seeker.take_cues(both(1.4));
        let aim = seeker.observe(seconds(1.4), Pointed::Settled(at), tracks).aim;
        assert_eq!(aim.is_some_and(|aim| aim.azimuth < 0.0), leaves, "{aim:?}");
        // The found target becomes a track, and there is another: the seeker stays on its own.
        if !leaves {
            let mut cues = cue(1.5, -0.5, 0.0, [1e-3; 2]);
            cues.cues.push(cue(1.5, 0.301, 0.0, [1e-3; 2]).cues.remove(0));
            cues.cues[1].of = Some(Cued { track_id: 9, ..Default::default() });
            seeker.take_cues(cues);
            assert_eq!(seeker.observe(seconds(1.5), Pointed::Settled(at), tracks).aim, None);
        }
    }
}

#[test]
fn while_nobody_knows_where_it_points_nothing_is_taken_over_and_nothing_turned() {
    let mut seeker = Seeker::new(&model(), Some(mount()), 0.0);
    seeker.take_cues(cue(1.0, 0.02, 0.0, [1e-3; 2]));
    let seen = track(3, REST, 0.02, 0.2);
    assert!(
        (0..9).all(|_| {
            seeker.observe(seconds(1.1), Pointed::Unknown, &[seen]) == Orders::default()
        })
    );
    // The target's name is copied into every frame, so an overlong one is refused.
    let mut long = cue(1.0, 0.02, 0.0, [1e-3; 2]);
    long.cues[0].of = Some(Cued { camera: "x".repeat(1 << 20), ..Default::default() });
    seeker.take_cues(long);
    assert_eq!(seeker.observe(seconds(1.1), Pointed::Settled(REST), &[seen]), Orders::default());
    // A cue from too far in the future.
    seeker.take_cues(cue(9.0, 0.02, 0.0, [1e-3; 2]));
    assert_eq!(seeker.observe(seconds(1.1), Pointed::Settled(REST), &[seen]), Orders::default());
}
