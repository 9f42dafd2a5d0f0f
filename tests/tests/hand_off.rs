//! From the wide cameras to a narrow one that turns: how soon, whether it is on what it says, and
//! what its bearings are worth.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a test that cannot set itself up has failed, and one that measures says what it found"
)]

use std::collections::BTreeMap;
use std::path::Path;

use crossfix_fusion::{Fusion, FusionConfig, Output};
use crossfix_message::{
    BearingFrame, CameraCalibration, CameraName, Channel, ImageTrackState, Timestamp, TrackFrame,
    TrackState, TruthFrame, decode,
};
use crossfix_recording::Entry;
use crossfix_tests::{messages, succeed};
use nalgebra::{Point3, Unit, Vector3};

/// The narrow camera's track is taken from this long after the first wide one saw the target on, s.
const SOON_S: f64 = 4.0;

/// Where each target is at the times of the truth.
struct Truth(BTreeMap<u64, Vec<(f64, Point3<f64>)>>);

impl Truth {
    fn of(recording: &Path) -> Self {
        let mut paths: BTreeMap<u64, Vec<(f64, Point3<f64>)>> = BTreeMap::new();
        for entry in messages(recording, |channel| *channel == Channel::Truth) {
            for target in decode::<TruthFrame>(&entry.data).unwrap().targets {
                let place = Point3::from(target.position.unwrap());
                paths.entry(target.id).or_default().push((entry.data_time.seconds(), place));
            }
        }
        Self(paths)
    }

    /// Where all are at a time, between two that are told.
    fn at(&self, t: f64) -> Vec<(u64, Point3<f64>)> {
        let between = |path: &Vec<(f64, Point3<f64>)>| {
            let after = path.partition_point(|(time, _)| *time < t);
            let ((t0, from), (t1, to)) = (path.get(after.checked_sub(1)?)?, path.get(after)?);
            Some(from + (to - from) * ((t - t0) / (t1 - t0)))
        };
        self.0.iter().filter_map(|(id, path)| Some((*id, between(path)?))).collect()
    }
}

fn seconds(time_ns: i64) -> f64 {
    Timestamp::from_nanos(time_ns).seconds()
}

/// The cameras' messages, in their order.
fn of_cameras(recording: &Path, without: Option<&str>) -> Vec<Entry> {
    messages(recording, |channel| {
        matches!(channel, Channel::Bearings(_) | Channel::Calibration(_))
            && channel.camera().is_some_and(|camera| Some(camera.as_str()) != without)
    })
}

/// Fuses what cameras have said.
fn fused(entries: &[Entry]) -> Vec<TrackFrame> {
    let mut fusion = Fusion::new(FusionConfig::default()).unwrap();
    let mut tracks = Vec::new();
    let mut keep = |outputs: Vec<Output>| {
        tracks.extend(outputs.into_iter().filter_map(|output| match output {
            Output::Tracks(frame) => Some(frame),
            _ => None,
        }));
    };
    for entry in entries {
        match &entry.key.channel {
            Channel::Calibration(_) => {
                fusion.calibrate(&decode::<CameraCalibration>(&entry.data).unwrap()).unwrap();
            }
            _ => keep(fusion.ingest(&decode::<BearingFrame>(&entry.data).unwrap())),
        }
    }
    keep(fusion.flush());
    tracks
}

/// The target that a place is nearest to.
fn nearest(truth: &[(u64, Point3<f64>)], place: Point3<f64>) -> u64 {
    let away = |(_, there): &&(u64, Point3<f64>)| (there - place).norm();
    truth.iter().min_by(|a, b| away(a).total_cmp(&away(b))).unwrap().0
}

/// The target that a track of the fusion centre is, by where it is said to be at most.
fn targets_of(tracks: &[TrackFrame], truth: &Truth) -> BTreeMap<u64, u64> {
    let mut votes: BTreeMap<u64, BTreeMap<u64, u32>> = BTreeMap::new();
    for frame in tracks {
        let there = truth.at(seconds(frame.time_ns));
        for track in frame.tracks.iter().filter(|_| !there.is_empty()) {
            let target = nearest(&there, track.position.unwrap().into());
            *votes.entry(track.id).or_default().entry(target).or_default() += 1;
        }
    }
    let most = |votes: BTreeMap<u64, u32>| votes.into_iter().max_by_key(|(_, count)| *count);
    votes.into_iter().filter_map(|(id, votes)| Some((id, most(votes)?.0))).collect()
}

/// Root mean square of how far a target's track lies beside it as seen from a place, m, at some
/// times.
fn beside(
    tracks: &[TrackFrame],
    truth: &Truth,
    seen_from: Point3<f64>,
    when: impl Fn(f64) -> Option<u64>,
) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for frame in tracks {
        let t = seconds(frame.time_ns);
        let Some(target) = when(t) else { continue };
        let there = truth.at(t);
        let Some((_, place)) = there.iter().find(|(id, _)| *id == target) else { continue };
        let along = Unit::new_normalize(place - seen_from);
        let confirmed = |track: &&crossfix_message::Track| track.state() == TrackState::Confirmed;
        for track in frame.tracks.iter().filter(confirmed) {
            let off: Vector3<f64> = Point3::from(track.position.unwrap()) - place;
            if off.norm() < 3.0 {
                sum += (off - along.into_inner() * off.dot(&along)).norm_squared();
                count += 1.0;
            }
        }
    }
    (sum / count).sqrt()
}

#[test]
fn a_narrow_camera_is_on_the_target_soon_and_makes_its_track_better() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("out");
    let arguments = ["-q", "demo", "--hand-off", "--duration", "14", "--json", "--output"];
    succeed(&[&arguments[..], &[output.to_str().unwrap()]].concat());
    let recording = output.join("demo.mcap");
    let truth = Truth::of(&recording);
    let entries = of_cameras(&recording, None);
    let narrow: CameraName = "narrow".parse().unwrap();

    let calibration = entries
        .iter()
        .find(|entry| entry.key.channel == Channel::Calibration(narrow.clone()))
        .map(|entry| decode::<CameraCalibration>(&entry.data).unwrap().parse().unwrap())
        .unwrap();
    let frames: Vec<BearingFrame> = entries
        .iter()
        .filter(|entry| matches!(entry.key.channel, Channel::Bearings(_)))
        .map(|entry| decode(&entry.data).unwrap())
        .collect();
    let with = fused(&entries);
    // Tracks keep their numbers when what was recorded is fused again.
    let targets = targets_of(&with, &truth);

    let is_narrow = |frame: &&BearingFrame| frame.camera == "narrow";
    let sees = |frame: &&BearingFrame| {
        frame.tracks.iter().any(|track| track.state() == ImageTrackState::Tracking)
    };
    let wide = frames.iter().filter(|frame| !is_narrow(frame)).find(sees).unwrap();
    let first_s = seconds(wide.capture_time_ns);
    let (mut looks, mut right, mut soonest_s) = (0, 0, f64::INFINITY);
    let mut on: Vec<(f64, u64)> = Vec::new();
    for frame in frames.iter().filter(is_narrow) {
        let Some(taken) = frame.taken_over.first() else { continue };
        let t = seconds(frame.capture_time_ns);
        soonest_s = soonest_s.min(t - first_s);
        let track = frame.tracks.iter().find(|track| track.track_id == taken.image_track_id);
        let camera = calibration.pointed(frame.pointing.as_ref()).unwrap();
        let direction: Vector3<f64> = track.unwrap().bearing.unwrap().into();
        let line = camera.pose().rotation() * direction;
        let origin = camera.pose().position();
        let away = |place: Point3<f64>| (place - origin).angle(&line);
        let there = truth.at(t);
        let seen = there.iter().min_by(|a, b| away(a.1).total_cmp(&away(b.1)));
        let Some((target, place)) = seen else { continue };
        looks += 1;
        let said = taken.of.as_ref().and_then(|of| targets.get(&of.track_id));
        right += u32::from(said == Some(target) && away(*place) < 2e-3);
        on.push((t, *target));
    }
    println!("first {soonest_s:.2} s after a wide camera; {looks} looks, {right} of what it says");
    assert!(soonest_s < SOON_S, "{soonest_s}");
    assert!(looks > 80 && f64::from(right) >= 0.98 * f64::from(looks), "{right} of {looks}");

    let without = fused(&of_cameras(&recording, Some("narrow")));
    let origin = calibration.camera.pose().position();
    // While it is on a target, after the first second.
    let when = |t: f64| {
        let after = on.partition_point(|(time, _)| *time < t);
        let (before, target) = *on.get(after.checked_sub(1)?)?;
        (t - before < 0.1 && t > on[0].0 + 1.0).then_some(target)
    };
    let [with_m, without_m] = [&with, &without].map(|tracks| beside(tracks, &truth, origin, when));
    println!("beside its line: {with_m:.4} m with it, {without_m:.4} m without");
    assert!(with_m < 0.8 * without_m, "{with_m} {without_m}");
}
