//! Two calibrations of a site compared with each other.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use crossfix_calibration::{CalibratedCamera, SiteCalibration, compare_sites};
use crossfix_geometry::{Camera, Pose};
use nalgebra::{Point3, Rotation3, Vector3};

/// Three cameras that look at one place from 60 m.
const SITE: &str = r#"
    form = 1
    [[camera]]
    name = "north"
    position_m = [0.0, 0.0, 0.0]
    rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    pose_covariance = [[1e-6, 0, 0, 0, 0, 0], [0, 1e-6, 0, 0, 0, 0], [0, 0, 1e-6, 0, 0, 0],
                       [0, 0, 0, 1e-4, 0, 0], [0, 0, 0, 0, 1e-4, 0], [0, 0, 0, 0, 0, 1e-4]]
    range_m = 60.0
    [camera.lens]
    model = "pinhole"
    size = [1000, 500]
    focal_px = [1000.0, 1000.0]
    centre_px = [500.0, 250.0]
    distortion = []
    covariance = [[0.0, 0, 0, 0], [0.0, 0, 0, 0], [0.0, 0, 0, 0], [0.0, 0, 0, 0]]
    pose_by_lens = [[0.0, 0, 0, 0], [0.0, 0, 0, 0], [0.0, 0, 0, 0],
                    [0.0, 0, 0, 0], [0.0, 0, 0, 0], [0.0, 0, 0, 0]]
    [camera.clock]
    knots_s = [[0.0, 30.0, 0.001], [100.0, 30.0, 0.001]]
    rate = 0.0
    rate_sd = 0.0
    wander_s = 0.0
    readout_s = 0.02
    [camera.noise]
    white_px = 0.5
    lasting_px = 0.0
    lasting_s = 1.0
    frame_s = 0.04
"#;

fn cameras() -> Vec<CalibratedCamera> {
    let pattern = SiteCalibration::from_toml(SITE).unwrap().cameras()[0].clone();
    let places = [[0.0, 60.0, 2.0], [52.0, -30.0, 3.0], [-52.0, -30.0, 1.0]];
    let camera = |([x, y, z], name): ([f64; 3], &str)| {
        let pose = Pose::looking_at(Point3::new(x, y, z), Point3::new(0.0, 0.0, 20.0)).unwrap();
        with_pose(&pattern, name, pose)
    };
    places.into_iter().zip(["north", "east", "west"]).map(camera).collect()
}

fn with_pose(camera: &CalibratedCamera, name: &str, pose: Pose) -> CalibratedCamera {
    let intrinsics = *camera.camera.model().intrinsics();
    CalibratedCamera {
        name: name.parse().unwrap(),
        camera: Camera::new(intrinsics, pose).unwrap(),
        ..camera.clone()
    }
}

#[test]
fn what_all_cameras_are_off_by_is_no_difference_of_any() {
    let (first, shift) = (cameras(), Vector3::new(3.0, -2.0, 1.0));
    let turn = Rotation3::new(Vector3::new(0.002, -0.001, 0.003));
    let (size, later_s) = (1.01, 0.4);
    let moved = |camera: &CalibratedCamera| {
        let pose = camera.camera.pose();
        let place = turn * pose.position() * size + shift;
        let rotation = turn * pose.rotation();
        let name = camera.name.as_str();
        let mut moved = with_pose(camera, name, Pose::new(*rotation.matrix(), place).unwrap());
        moved.range_m *= size;
        moved.clock.knots_s.iter_mut().for_each(|knot| knot[1] += later_s);
        moved
    };
    let second = SiteCalibration::of(first.iter().map(moved).collect());
    let found = compare_sites(&SiteCalibration::of(first), &second).unwrap();
    let found_move = found.moved.unwrap();
    assert!(found_move.turn.rotation_to(&turn).angle() < 1e-6, "{found_move:?}");
    assert!((found_move.size - size).abs() < 1e-6, "{found_move:?}");
    let middle = found_move.middle;
    let expected = turn * middle * size + shift - middle;
    assert!((found_move.shift - expected).norm() < 1e-4, "{found_move:?}");
    assert!((found_move.later_s.unwrap() - later_s).abs() < 1e-9);
    assert_eq!((found.cameras.len(), found.missing.len()), (3, 0));
    for camera in &found.cameras {
        assert!(camera.apart_rad < 1e-6 && camera.later_s.unwrap().abs() < 1e-9, "{camera:?}");
    }
}

#[test]
fn a_camera_that_was_knocked_stands_out() {
    let first = cameras();
    let mut second = first.clone();
    let pose = second[1].camera.pose();
    let turned = pose.rotation() * Rotation3::new(Vector3::new(0.0, 0.02, 0.0));
    second[1] = with_pose(&first[1], "east", Pose::new(*turned.matrix(), pose.position()).unwrap());
    second[2].name = "south".parse().unwrap();
    let mut before = first.clone();
    before.push(with_pose(&first[2], "south", *first[2].camera.pose()));
    let found = compare_sites(&SiteCalibration::of(before), &SiteCalibration::of(second)).unwrap();
    assert_eq!(found.missing, ["west".parse().unwrap()]);
    let [north, east, south] = &found.cameras[..] else { panic!("{found:?}") };
    // What is said is 1.5 mrad: half of what it was turned by is taken for the site's.
    assert!(east.deviations > 3.0 && east.apart_rad > 4e-3, "{east:?}");
    for other in [north, south] {
        assert!(other.deviations < 0.8 * east.deviations, "{other:?} {east:?}");
    }
}

/// Of two cameras a move of the site would take on what one was turned by.
#[test]
fn two_cameras_are_compared_as_they_are() {
    let first: Vec<_> = cameras().into_iter().take(2).collect();
    let mut second = first.clone();
    let pose = second[1].camera.pose();
    let turned = pose.rotation() * Rotation3::new(Vector3::new(0.0, 0.02, 0.0));
    second[1] = with_pose(&first[1], "east", Pose::new(*turned.matrix(), pose.position()).unwrap());
    let found = compare_sites(&SiteCalibration::of(first), &SiteCalibration::of(second)).unwrap();
    assert!(found.moved.is_none());
    let [north, east] = &found.cameras[..] else { panic!("{found:?}") };
    assert!(north.most_rad < 1e-9, "{north:?}");
    // About its upright axis, on which a pixel's two axes share.
    assert!((0.010..0.0145).contains(&east.apart_rad), "{east:?}");
}

#[test]
fn sites_without_a_camera_in_common_cannot_be_compared() {
    let (first, mut second) = (cameras(), cameras());
    second
        .iter_mut()
        .for_each(|camera| camera.name = format!("{}-2", camera.name).parse().unwrap());
    let [first, second] = [first, second].map(SiteCalibration::of);
    assert!(compare_sites(&first, &second).is_none());
}
