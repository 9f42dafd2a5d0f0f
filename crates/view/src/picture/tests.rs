use crossfix_geometry::{Distortion, ImageSize, Intrinsics, PanTilt, Pose};
use crossfix_message::{BearingFrame, CameraName, Payload, Pointing, Track};
use rerun::RecordingStreamBuilder;

use super::*;

fn picture() -> SitePicture {
    SitePicture::new(RecordingStreamBuilder::new("test").memory().unwrap().0).unwrap()
}

fn deliver(picture: &mut SitePicture, channel: &Channel, arrival_s: f64, data: &[u8]) {
    assert!(picture.show(channel, Timestamp::from_seconds(arrival_s), data).unwrap().is_none());
}

fn track(time_s: f64) -> Vec<u8> {
    let place = Some(Vector3::new(1.0, 2.0, 3.0).into());
    let track = Track {
        id: 1,
        state: TrackState::Confirmed.into(),
        position: place,
        velocity: place,
        ..Default::default()
    };
    let time_ns = Timestamp::from_seconds(time_s).nanos();
    TrackFrame { time_ns, tracks: vec![track], ..Default::default() }.encode()
}

fn bearings(time_s: f64) -> Vec<u8> {
    let capture_time_ns = Timestamp::from_seconds(time_s).nanos();
    BearingFrame { camera: "north".into(), capture_time_ns, ..Default::default() }.encode()
}

#[test]
fn tracks_of_a_fusion_centre_that_is_gone_are_not_drawn_for_ever() {
    let mut picture = picture();
    let north = Channel::Bearings("north".parse().unwrap());
    deliver(&mut picture, &Channel::Tracks, 100.0, &track(10.0));
    deliver(&mut picture, &north, 102.0, &bearings(12.0));
    assert_eq!(picture.drawn.len(), 1, "it may only be late");
    deliver(&mut picture, &north, 104.0, &bearings(14.0));
    assert!(picture.drawn.is_empty() && picture.trails.is_empty());
    // The same where no message comes at all.
    deliver(&mut picture, &Channel::Tracks, 105.0, &track(15.0));
    picture.clear_silent(Timestamp::from_seconds(109.0)).unwrap();
    assert!(picture.drawn.is_empty());
}

#[test]
fn neither_a_clock_from_the_future_nor_tracks_made_later_are_ghosts() {
    let mut picture = picture();
    let north = Channel::Bearings("north".parse().unwrap());
    deliver(&mut picture, &Channel::Tracks, 100.0, &track(10.0));
    deliver(&mut picture, &north, 100.1, &bearings(1e6));
    assert_eq!(picture.drawn.len(), 1, "a camera's clock is wrong");
    // Tracks that were fused long after the recording.
    deliver(&mut picture, &north, 1.79e9, &bearings(10.1));
    assert_eq!(picture.drawn.len(), 1);
}

#[test]
fn a_camera_on_a_mount_is_drawn_as_its_last_frame_says() {
    let mut picture = picture();
    let name: CameraName = "north".parse().unwrap();
    let rest = Pose::looking_at(Point3::origin(), Point3::new(0.0, 100.0, 0.0)).unwrap();
    let lens = Intrinsics {
        size: ImageSize { width: 640, height: 480 },
        fx: 3000.0,
        fy: 3000.0,
        cx: 319.5,
        cy: 239.5,
        distortion: Distortion::None,
    };
    let mount = PanTilt::new(rest, [-2.0, 2.0], [-0.2, 1.2]).unwrap();
    let camera = Camera::new(lens, rest).unwrap();
    let message =
        CameraCalibration::new(&name, &camera, Timestamp::EPOCH).on_mount(&mount).encode();
    deliver(&mut picture, &Channel::Calibration(name.clone()), 1.0, &message);
    let mut look = |azimuth: f64, time_s: f64| {
        let frame = BearingFrame {
            camera: name.to_string(),
            capture_time_ns: Timestamp::from_seconds(time_s).nanos(),
            pointing: Some(Pointing { azimuth, ..Default::default() }),
            ..Default::default()
        };
        deliver(&mut picture, &Channel::Bearings(name.clone()), time_s, &frame.encode());
        // The calibration is repeated; it does not turn the camera back.
        deliver(&mut picture, &Channel::Calibration(name.clone()), time_s, &message);
        picture.cameras["north"].camera.pose().rotation() * Vector3::z()
    };
    // West is to the left of north.
    for (azimuth, time_s) in [(0.0, 2.0), (0.5, 3.0), (-0.5, 4.0)] {
        let axis = look(azimuth, time_s);
        assert!((axis - Vector3::new(-azimuth.sin(), azimuth.cos(), 0.0)).norm() < 1e-9);
    }
}
