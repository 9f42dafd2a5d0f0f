//! Two real targets: the drone of the drone-tracking-datasets and itself half a minute later, in the
//! same cameras.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use crossfix_evaluation::TrackHistory;
use crossfix_fusion::{Fusion, FusionConfig, Output};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, Channel, Timestamp, TruthFrame, decode,
};
use crossfix_tests::{messages, real_data, succeed};
use nalgebra::{Point3, Vector3};

/// The second target is where the first will be so much later.
const SHIFT_S: f64 = 30.0;
/// A track within this of a target is its own, m.
const NEAR_M: f64 = 2.0;

/// A camera's labels in order of time.
struct Labels(Vec<(f64, BearingTrack)>);

impl Labels {
    /// The label of a time between two labels at most 1.7 frames apart.
    fn at(&self, t: f64, interval: f64) -> Option<BearingTrack> {
        let after = self.0.partition_point(|(time, _)| *time < t);
        let ((t0, before), (t1, next)) = (self.0.get(after.checked_sub(1)?)?, self.0.get(after)?);
        if t1 - t0 > 1.7 * interval {
            return None;
        }
        let share = (t - t0) / (t1 - t0);
        let [u, v] = [before, next].map(|track| Vector3::from(track.bearing.unwrap()));
        let between = (u * (1.0 - share) + v * share).normalize();
        Some(BearingTrack { track_id: 2, bearing: Some(between.into()), ..*before })
    }
}

fn time_of(frame: &BearingFrame) -> f64 {
    Timestamp::from_nanos(frame.capture_time_ns).seconds()
}

fn labels_of(frames: &[BearingFrame]) -> BTreeMap<String, Labels> {
    let mut labels: BTreeMap<String, Labels> = BTreeMap::new();
    for frame in frames {
        let own = labels.entry(frame.camera.clone()).or_insert(Labels(Vec::new()));
        own.0.extend(frame.tracks.first().map(|track| (time_of(frame), *track)));
    }
    labels
}

/// Where the drone was, and when (s).
fn truth_of(recording: &Path) -> Vec<(f64, Point3<f64>)> {
    let place = |data: &[u8]| decode::<TruthFrame>(data).unwrap().targets[0].position.unwrap().into();
    let entries = messages(recording, |channel| *channel == Channel::Truth);
    entries.into_iter().map(|entry| (entry.data_time.seconds(), place(&entry.data))).collect()
}

#[test]
fn two_real_targets_are_both_followed_and_never_taken_for_each_other() {
    let Some(data) = real_data() else { return };
    let folder = tempfile::tempdir().unwrap();
    let half = folder.path().join("half.mcap");
    let source = data.join("eth-multiview-drone").display().to_string();
    let intervals =
        BTreeMap::from([("gopro3", 1.0 / 59.94), ("sony5100", 1.0 / 29.97), ("sonyG", 1.0 / 50.0)]);
    let names = intervals.keys().copied().collect::<Vec<_>>().join(",");
    let arguments = ["import", "drone-tracking-datasets", &source, "--dataset", "3", "--cameras", &names];
    succeed(&[&arguments[..], &["-o", &half.display().to_string()]].concat());

    let mut fusion = Fusion::new(FusionConfig::default()).unwrap();
    for entry in messages(&half, |channel| matches!(channel, Channel::Calibration(_))) {
        fusion.calibrate(&decode::<CameraCalibration>(&entry.data).unwrap()).unwrap();
    }
    let frames: Vec<BearingFrame> = messages(&half, |channel| matches!(channel, Channel::Bearings(_)))
        .into_iter()
        .map(|entry| decode(&entry.data).unwrap())
        .collect();
    let labels = labels_of(&frames);
    let truth = truth_of(&half);
    let all_see = |t: f64| intervals.iter().all(|(name, interval)| labels[*name].at(t, *interval).is_some());

    let mut history = TrackHistory::default();
    for frame in frames {
        let later = labels[&frame.camera].at(time_of(&frame) + SHIFT_S, intervals[frame.camera.as_str()]);
        let mut both = frame;
        both.tracks.extend(later);
        for output in fusion.ingest(&both) {
            if let Output::Tracks(frame) = output {
                history.add(&frame);
            }
        }
    }
    let mut owners: BTreeMap<u64, BTreeSet<usize>> = BTreeMap::new();
    let (mut instants, mut squares, mut extra) = (0, Vec::new(), 0);
    for &(t, first) in truth.iter().filter(|(t, _)| all_see(*t) && all_see(t + SHIFT_S)) {
        let Some((_, second)) = truth.iter().find(|(time, _)| (time - t - SHIFT_S).abs() < 1e-3) else {
            continue;
        };
        instants += 1;
        for estimate in history.at(Timestamp::from_seconds(t)) {
            let distances = [first, *second].map(|place| (estimate.state.position() - place).norm());
            let nearest = usize::from(distances[1] < distances[0]);
            if distances[nearest] < NEAR_M {
                owners.entry(estimate.id).or_default().insert(nearest);
                squares.push(distances[nearest].powi(2));
            } else {
                extra += 1;
            }
        }
    }
    assert!(instants > 100, "{instants} instants");
    let coverage = squares.len() as f64 / f64::from(2 * instants);
    let rmse = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
    assert!((0.99..=1.0).contains(&coverage), "coverage {coverage:.4}");
    assert!(
        owners.values().all(|targets| targets.len() == 1),
        "tracks that changed their target: {owners:?}"
    );
    assert_eq!(extra, 0, "tracks that are no target");
    assert!(rmse <= 0.15, "position RMSE {rmse:.4} m");
}
