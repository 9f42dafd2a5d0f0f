//! Receivers that scan (Klochko 2020, eq. 2): each meets the target at a time of its own.

use crossfix_fusion::{Fusion, FusionConfig, Output};
use crossfix_geometry::{
    Camera, Distortion, GeometryError, ImageSize, Intrinsics, Pose, ScanAngles, ScanMeasurement,
    camera_from_paper,
};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, CameraName, ImageTrackState, Payload, Timestamp,
    TrackState,
};
use nalgebra::{Point3, Unit, Vector3};

const VELOCITY: Vector3<f64> = Vector3::new(12.0, -5.0, 1.0);

fn place(time_s: f64) -> Point3<f64> {
    Point3::new(-20.0, 10.0, 60.0) + VELOCITY * time_s
}

/// A receiver that scans 60 degrees to each side of the direction to the middle of the site.
fn receiver(position: Point3<f64>) -> Result<Camera, GeometryError> {
    let intrinsics = Intrinsics {
        size: ImageSize { width: 3600, height: 3600 },
        fx: 1000.0,
        fy: 1000.0,
        cx: 1799.5,
        cy: 1799.5,
        distortion: Distortion::None,
    };
    Camera::new(intrinsics, Pose::looking_at(position, Point3::new(0.0, 0.0, 40.0))?)
}

/// The message of one meeting of beam and target.
fn meeting(
    name: &CameraName,
    receiver: &Camera,
    sequence: u64,
    time_s: f64,
) -> Result<BearingFrame, GeometryError> {
    let seen = receiver.pose().camera_from_world(place(time_s));
    let angles = ScanAngles::of(&Unit::new_normalize(camera_from_paper(seen)));
    let bearing = ScanMeasurement { angles, azimuth_sd: 1e-3, elevation_sd: 5e-4 }.bearing()?;
    let covariance = bearing.covariance();
    let track = BearingTrack {
        track_id: 1,
        bearing: Some(bearing.direction().into_inner().into()),
        covariance_xx: covariance.m11,
        covariance_xy: covariance.m12,
        covariance_yy: covariance.m22,
        state: ImageTrackState::Tracking.into(),
        ..Default::default()
    };
    let frame = BearingFrame {
        camera: name.to_string(),
        sequence,
        capture_time_ns: Timestamp::from_seconds(time_s).nanos(),
        tracks: vec![track],
        ..Default::default()
    };
    Ok(frame.stamped())
}

#[test]
fn three_scanning_receivers_make_a_track_of_angles_met_at_different_times() {
    let mut fusion = Fusion::new(FusionConfig::default()).unwrap();
    let receivers =
        [("a", 120.0, -90.0), ("b", -130.0, -80.0), ("c", 10.0, 140.0)].map(|(name, x, y)| {
            (name.parse::<CameraName>().unwrap(), receiver(Point3::new(x, y, 2.0)).unwrap())
        });
    for (name, receiver) in &receivers {
        let exact = CameraCalibration::new(name, receiver, Timestamp::EPOCH).with_pose_sd(0.0, 0.0);
        fusion.calibrate(&exact).unwrap();
    }
    let mut outputs = Vec::new();
    for scan in 0..8 {
        for ((name, receiver), delay) in receivers.iter().zip([0.0, 0.17, 0.31]) {
            let time_s = 0.5 * scan as f64 + delay;
            outputs.extend(fusion.ingest(&meeting(name, receiver, scan, time_s).unwrap()));
        }
    }
    outputs.extend(fusion.flush());
    let mut frames = outputs.iter().filter_map(|output| match output {
        Output::Tracks(frame) => Some(frame),
        _ => None,
    });
    let last = frames.next_back().unwrap();
    let [track] = last.tracks.as_slice() else { panic!("{:?}", last.tracks) };
    assert_eq!(track.state(), TrackState::Confirmed);
    let position: Point3<f64> = track.position.unwrap().into();
    let velocity: Vector3<f64> = track.velocity.unwrap().into();
    let time_s = Timestamp::from_nanos(last.time_ns).seconds();
    assert!((position - place(time_s)).norm() < 0.1, "{position}");
    assert!((velocity - VELOCITY).norm() < 0.2, "{velocity}");
}
