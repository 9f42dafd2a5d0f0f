use super::*;

fn message() -> CameraCalibration {
    let intrinsics = Intrinsics {
        size: ImageSize { width: 640, height: 480 },
        fx: 700.0,
        fy: 701.0,
        cx: 320.0,
        cy: 240.0,
        distortion: Distortion::BrownConrady([-0.1, 0.02, 1e-4, -2e-4, 0.0]),
    };
    let pose = Pose::looking_at(Point3::new(10.0, 20.0, 2.0), Point3::new(0.0, 0.0, 50.0)).unwrap();
    let camera = Camera::new(intrinsics, pose).unwrap();
    CameraCalibration::new(&"north".parse().unwrap(), &camera, Timestamp::EPOCH)
}

#[test]
fn a_camera_survives_its_message() {
    let message = message();
    let parsed = message.parse().unwrap();
    let again = CameraCalibration::new(&parsed.name, &parsed.camera, parsed.valid_from);
    assert_eq!(again.fx, message.fx);
    assert_eq!(again.distortion, message.distortion);
    for (ours, theirs) in again.rotation.iter().zip(&message.rotation) {
        assert!((ours - theirs).abs() < 1e-12);
    }
    assert_eq!(message.hash, message.content_hash());
}

#[test]
fn a_flight_has_corrected_the_clock_and_who_knows_that_it_wanders_has_not() {
    let noise = LastingNoise { sd_rad: 1e-3, time_s: 0.5 };
    assert!(message().with_lasting_errors(noise, 1e-3).corrects_clock());
    assert!(!message().with_lasting_errors(noise, 0.0).corrects_clock());
    let wanders = message().with_clock_wander(2e-3);
    assert!(!wanders.corrects_clock());
    assert_eq!(wanders.hash, wanders.content_hash());
    assert_eq!(wanders.parse().unwrap().clock_wander_s, 2e-3);
}

fn mounted() -> CameraCalibration {
    let camera = message().parse().unwrap().camera;
    let mount = PanTilt::new(*camera.pose(), [-1.0, 2.0], [-0.2, 1.2]).unwrap();
    CameraCalibration::new(&"north".parse().unwrap(), &camera, Timestamp::EPOCH).on_mount(&mount)
}

#[test]
fn a_mount_survives_its_message_and_a_reader_that_knows_none_refuses_the_camera() {
    let parsed = mounted().parse().unwrap();
    let mount = parsed.mount.unwrap();
    assert_eq!((mount.azimuth(), mount.elevation()), ([-1.0, 2.0], [-0.2, 1.2]));
    assert!(parsed.takes_cues && mount.rest() == parsed.camera.pose());
    let as_older = CameraCalibration { mount: None, ..mounted() };
    assert!(matches!(as_older.parse(), Err(CalibrationError::NoPose { .. })));
    let both = CameraCalibration { rotation: message().rotation, ..mounted() };
    assert!(matches!(both.parse(), Err(CalibrationError::Shape { part: "mount", .. })));
    let mut torn = mounted();
    torn.mount.as_mut().unwrap().elevation_max = f64::NAN;
    assert!(matches!(torn.parse(), Err(CalibrationError::Geometry { .. })));
}

#[test]
fn a_camera_on_a_mount_is_where_its_frame_says_and_nowhere_without() {
    let parsed = mounted().parse().unwrap();
    let pointing = Pointing { azimuth: 0.3, elevation: 0.1, ..Default::default() };
    let turned = parsed.pointed(Some(&pointing)).unwrap();
    assert_eq!(turned.pose().position(), parsed.camera.pose().position());
    assert!(turned.pose().rotation().angle_to(parsed.camera.pose().rotation()) > 0.25);
    assert!(parsed.pointed(None).is_none());
    let impossible = Pointing { elevation: 2.0, ..pointing };
    assert!(parsed.pointed(Some(&impossible)).is_none());
    // A camera that stands still ignores any pointing.
    let still = message().parse().unwrap();
    assert_eq!(still.pointed(Some(&pointing)).unwrap().pose(), still.camera.pose());
}

#[test]
fn an_uncertain_pose_is_read_in_the_worlds_axes_and_an_impossible_one_is_named() {
    let uncertain = message().with_pose_sd(0.01, 0.1);
    let covariance = uncertain.parse().unwrap().pose_covariance.unwrap();
    assert!((covariance[(1, 1)] - 1e-4).abs() < 1e-12 && (covariance[(4, 4)] - 0.01).abs() < 1e-12);
    let mut torn = uncertain.clone();
    torn.pose_covariance.pop();
    assert!(matches!(torn.parse(), Err(CalibrationError::Shape { part: "pose_covariance", .. })));
    let mut negative = uncertain;
    negative.pose_covariance[0] = -1.0;
    assert!(matches!(negative.parse(), Err(CalibrationError::Covariance { .. })));
    for place in [0, 1, 35] {
        let mut nan = message().with_pose_sd(0.01, 0.1);
        nan.pose_covariance[place] = f64::NAN;
        assert!(matches!(nan.parse(), Err(CalibrationError::Covariance { .. })), "{place}");
    }
    for (rotation_sd, position_sd) in [(1.1, 0.1), (0.01, 1e150)] {
        let unknown = message().with_pose_sd(rotation_sd, position_sd);
        assert!(matches!(unknown.parse(), Err(CalibrationError::Covariance { .. })));
    }
}

#[test]
fn a_nan_focal_length_and_a_torn_rotation_are_named() {
    let nan = CameraCalibration { fx: f64::NAN, ..message() };
    assert!(matches!(nan.parse(), Err(CalibrationError::Geometry { .. })));
    let mut torn = message();
    torn.rotation.pop();
    assert!(matches!(torn.parse(), Err(CalibrationError::Shape { part: "rotation", .. })));
}
