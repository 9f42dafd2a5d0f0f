//! A camera of one's own: publishes bearings to a fusion centre over the network, as an agent does,
//! for whoever has a tracker already.
//!
//! Run three of them, each under a camera's name of the network's file, beside `crossfix fuse`:
//!
//! ```text
//! cargo run --release -p crossfix-transport --example publish_bearings -- north
//! ```
//!
//! This one stands at a corner of a triangle and "sees" a target that circles 40 m above its
//! middle.
#![allow(clippy::print_stdout, reason = "a program that prints")]

use std::collections::BTreeMap;
use std::error::Error;
use std::thread::sleep;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crossfix_geometry::{
    Bearing, Camera, Distortion, ImageSize, Intrinsics, PixelCovariance, Pose,
};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, CameraName, Channel, ImageTrackState, Payload,
    Timestamp,
};
use crossfix_transport::{Delivery, Link, Mode, NetworkConfig, Role};
use nalgebra::Point3;

/// The cameras of the site: name, place in metres east, north and up, and endpoint.
const SITE: [(&str, [f64; 3], &str); 3] = [
    ("north", [15.0, 120.0, 3.0], "tcp/127.0.0.1:7451"),
    ("east", [110.0, -70.0, 2.0], "tcp/127.0.0.1:7452"),
    ("west", [-120.0, -60.0, 4.0], "tcp/127.0.0.1:7453"),
];
/// Interval of the frames: 25 per second.
const PERIOD: Duration = Duration::from_millis(40);
/// How long it publishes: 40 s.
const FRAMES: u64 = 1000;

fn main() -> Result<(), Box<dyn Error>> {
    let name = std::env::args().nth(1).ok_or("which camera: north, east or west?")?;
    let &(_, place, _) = SITE.iter().find(|(known, ..)| *known == name).ok_or("no such camera")?;
    let name: CameraName = name.parse()?;
    let lens = Intrinsics {
        size: ImageSize { width: 1920, height: 1080 },
        fx: 1460.0,
        fy: 1460.0,
        cx: 959.5,
        cy: 539.5,
        distortion: Distortion::None,
    };
    let pose = Pose::looking_at(place.into(), [0.0, 0.0, 40.0].into())?;
    let camera = Camera::new(lens, pose)?;

    let link = Link::open(&network()?, &Role::Camera(name.clone()))?;
    let calibrations = link.publisher(Channel::Calibration(name.clone()), Delivery::Queued)?;
    let bearings = link.publisher(Channel::Bearings(name.clone()), Delivery::Queued)?;
    // Held for as long as the camera is there: its end tells the fusion centre that none come.
    let _alive = link.declare_alive(Channel::Alive(name.clone()))?;
    let calibration = CameraCalibration::new(&name, &camera, Timestamp::EPOCH).encode();
    for sequence in 0..FRAMES {
        // Said again and again, for those who come late.
        if sequence % 50 == 0 {
            calibrations.put(calibration.clone())?;
        }
        let seconds = SystemTime::now().duration_since(UNIX_EPOCH)?.as_secs_f64();
        bearings.put(exposure(&name, &camera, sequence, seconds).encode())?;
        sleep(PERIOD);
    }
    println!("{FRAMES} exposures published");
    Ok(())
}

/// The network's file, written out: `configs/site/network.toml` says the same.
fn network() -> Result<NetworkConfig, Box<dyn Error>> {
    let mut cameras = BTreeMap::new();
    for (name, _, endpoint) in SITE {
        cameras.insert(name.parse()?, endpoint.to_owned());
    }
    Ok(NetworkConfig {
        site: "airfield".parse()?,
        mode: Mode::Peer,
        routers: Vec::new(),
        unsecured: false,
        security: None,
        anchor: None,
        fusion: Some("tcp/127.0.0.1:7450".to_owned()),
        areas: BTreeMap::new(),
        cameras,
    })
}

/// What the camera saw at a time: here a target that circles, where a tracker's answer would be.
fn exposure(name: &CameraName, camera: &Camera, sequence: u64, seconds: f64) -> BearingFrame {
    let (sine, cosine) = (0.3 * seconds).sin_cos();
    let target = Point3::new(30.0 * cosine, 30.0 * sine, 40.0);
    let seen = camera.project(target).and_then(|pixel| {
        let covariance = PixelCovariance::isotropic(0.3);
        let bearing = camera.model().bearing(pixel, covariance).ok()?;
        Some(message(&bearing))
    });
    BearingFrame {
        camera: name.to_string(),
        sequence,
        capture_time_ns: Timestamp::from_seconds(seconds).nanos(),
        capture_time_sd_s: 0.001,
        tracks: seen.into_iter().collect(),
        ..Default::default()
    }
}

fn message(bearing: &Bearing) -> BearingTrack {
    let covariance = bearing.covariance();
    BearingTrack {
        track_id: 1,
        bearing: Some(bearing.direction().into_inner().into()),
        covariance_xx: covariance.m11,
        covariance_xy: covariance.m12,
        covariance_yy: covariance.m22,
        state: ImageTrackState::Tracking.into(),
        ..Default::default()
    }
}
