//! A site's data in Foxglove's well-known schemas, so that Foxglove and Rerun show them without
//! Crossfix.
//!
//! These are written in addition to our own messages, never instead of them: they contain less.

use crossfix_geometry::Geodetic;
use crossfix_message::{
    AreaName, CameraCalibration, Channel, DistortionModel, Key, Preview, Timestamp, Track,
    TrackFrame, TrackState, Vector3, decode,
};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use prost::Message;

use crate::situation::Situation;

/// Foxglove's messages, as defined in `proto/foxglove/foxglove.proto`.
#[allow(missing_docs, clippy::all)]
pub mod wire {
    include!("generated/foxglove.rs");
}

/// The definitions of these messages as a `google.protobuf.FileDescriptorSet`, the schema of all of
/// them.
pub fn file_descriptor_set() -> &'static [u8] {
    include_bytes!("generated/foxglove.bin")
}

/// Name of the site's coordinate frame: local east, north, up.
const SITE_FRAME: &str = "site";
/// Number of topics for tracks: a topic has the last two digits of the track's number, so that a
/// recorder that writes for years has no more than a hundred. Two tracks whose numbers differ by a
/// multiple of it share a topic: with half of it, by 50.
const TOPICS_OF_TRACKS: u64 = 100;
/// Least time between two writings of the tracks' places, s. With half of it these take twice the
/// room; with twice as much a target at 30 m/s moves in steps of 6 m.
const PLACE_PERIOD_S: f64 = 0.1;

/// A message in one of Foxglove's schemas.
#[derive(Clone, Debug, PartialEq)]
pub struct FoxgloveMessage {
    /// The topic: `/camera/north/image`.
    pub topic: String,
    /// The schema's full name: `foxglove.CompressedImage`.
    pub schema: &'static str,
    /// The data time of the message.
    pub time: Timestamp,
    /// The encoded message.
    pub data: Vec<u8>,
}

/// Whether pictures are written in Foxglove's schema too: they are most of a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PictureExport {
    /// They are written.
    Said,
    /// They are left out.
    LeftOut,
}

/// Translates the messages of a site's channels into Foxglove's schemas.
#[derive(Debug)]
pub struct FoxgloveView {
    pictures: PictureExport,
    situation: Option<Situation>,
    said_at: Option<Timestamp>,
}

impl FoxgloveView {
    /// A view of a site; with an anchor it also writes where on the Earth the targets are.
    pub fn new(
        site: &crossfix_message::SiteName,
        anchor: Option<Geodetic>,
        pictures: PictureExport,
    ) -> Self {
        let situation = anchor.map(|anchor| Situation::new(site.clone(), anchor));
        Self { pictures, situation, said_at: None }
    }

    /// The Foxglove messages that follow from a message on a channel. Bytes that are not a valid
    /// message give none.
    pub fn of(&mut self, key: &Key, data: &[u8], time: Timestamp) -> Vec<FoxgloveMessage> {
        match &key.channel {
            // The channel says which camera it is: a message that names another one is ignored.
            Channel::Calibration(camera) => decode::<CameraCalibration>(data)
                .ok()
                .filter(|message| message.camera == camera.as_str())
                .map(|message| self.of_calibration(&message, time))
                .unwrap_or_default(),
            Channel::Preview(camera) if self.pictures == PictureExport::Said => {
                decode::<Preview>(data)
                    .ok()
                    .filter(|message| message.camera == camera.as_str())
                    .map(|message| vec![of_preview(message)])
                    .unwrap_or_default()
            }
            Channel::Tracks => decode::<TrackFrame>(data)
                .map(|message| self.of_tracks(key.area.as_ref(), &message))
                .unwrap_or_default(),
            _ => Vec::new(),
        }
    }

    fn of_calibration(
        &mut self,
        message: &CameraCalibration,
        time: Timestamp,
    ) -> Vec<FoxgloveMessage> {
        if let Some(situation) = &mut self.situation {
            situation.add_calibration(message);
        }
        let camera = &message.camera;
        let lens = said(format!("/camera/{camera}/calibration"), time, &lens_of(message, time));
        let pose = transform_of(message, time);
        let mut messages = vec![lens];
        messages.extend(pose.map(|pose| said(format!("/camera/{camera}/pose"), time, &pose)));
        messages
    }

    fn of_tracks(&mut self, area: Option<&AreaName>, frame: &TrackFrame) -> Vec<FoxgloveMessage> {
        if let Some(situation) = &mut self.situation {
            situation.add_tracks(area, frame);
        }
        let time = Timestamp::from_nanos(frame.time_ns);
        if self.said_at.is_some_and(|at| (0.0..PLACE_PERIOD_S).contains(&time.seconds_since(at))) {
            return Vec::new();
        }
        self.said_at = Some(time);
        let mut messages: Vec<FoxgloveMessage> =
            frame.tracks.iter().filter_map(|track| pose_of(track, time)).collect();
        let snapshot = self.situation.as_mut().and_then(|situation| situation.snapshot(0.0));
        messages.extend(snapshot.iter().flat_map(fixes_of));
        messages
    }
}

/// A message of Foxglove's with the name of its schema.
trait Named: Message {
    const SCHEMA: &'static str;
}

macro_rules! named {
    ($($type:ident)*) => {$(
        impl Named for wire::$type {
            const SCHEMA: &'static str = concat!("foxglove.", stringify!($type));
        }
    )*};
}

named!(CameraCalibration FrameTransform PoseInFrame LocationFix CompressedImage);

fn said<M: Named>(topic: String, time: Timestamp, message: &M) -> FoxgloveMessage {
    FoxgloveMessage { topic, schema: M::SCHEMA, time, data: message.encode_to_vec() }
}

fn stamp(time: Timestamp) -> Option<prost_types::Timestamp> {
    /// A second, ns.
    const SECOND: i64 = 1_000_000_000;
    let nanos = i32::try_from(time.nanos().rem_euclid(SECOND)).unwrap_or(0);
    Some(prost_types::Timestamp { seconds: time.nanos().div_euclid(SECOND), nanos })
}

fn vector(from: Vector3) -> wire::Vector3 {
    wire::Vector3 { x: from.x, y: from.y, z: from.z }
}

/// A lens: K and P as in OpenCV; pixel coordinates count from the centre of the first pixel, as
/// ours do.
fn lens_of(message: &CameraCalibration, time: Timestamp) -> wire::CameraCalibration {
    let CameraCalibration { fx, fy, cx, cy, .. } = *message;
    let (model, coefficients) = match message.distortion_model() {
        DistortionModel::Fisheye => ("kannala_brandt", message.distortion.clone()),
        DistortionModel::BrownConrady => ("plumb_bob", message.distortion.clone()),
        DistortionModel::None | DistortionModel::Unspecified => ("plumb_bob", vec![0.0; 5]),
    };
    wire::CameraCalibration {
        timestamp: stamp(time),
        frame_id: message.camera.clone(),
        width: message.width,
        height: message.height,
        distortion_model: model.to_owned(),
        d: coefficients,
        k: vec![fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: vec![fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
}

/// A camera's pose; `None` for a camera on a mount.
fn transform_of(message: &CameraCalibration, time: Timestamp) -> Option<wire::FrameTransform> {
    let rotation = <[f64; 9]>::try_from(message.rotation.as_slice()).ok()?;
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_row_slice(&rotation));
    let turn = UnitQuaternion::from_rotation_matrix(&rotation);
    Some(wire::FrameTransform {
        timestamp: stamp(time),
        parent_frame_id: SITE_FRAME.to_owned(),
        child_frame_id: message.camera.clone(),
        translation: Some(vector(message.position?)),
        rotation: Some(wire::Quaternion { x: turn.i, y: turn.j, z: turn.k, w: turn.w }),
    })
}

fn of_preview(message: Preview) -> FoxgloveMessage {
    let time = Timestamp::from_nanos(message.capture_time_ns);
    let topic = format!("/camera/{}/image", message.camera);
    let format = message.media_type.trim_start_matches("image/").to_owned();
    let image = wire::CompressedImage {
        timestamp: stamp(time),
        frame_id: message.camera,
        data: message.data,
        format,
    };
    said(topic, time, &image)
}

/// The topic of a track's data.
fn topic_of(track_id: u64, what: &str) -> String {
    // The track's number within its run is its identity modulo 2^20.
    format!("/track/{:02}/{what}", track_id % (1 << 20) % TOPICS_OF_TRACKS)
}

/// A sure track's position in the site's frame; `None` if the track is not sure.
fn pose_of(track: &Track, time: Timestamp) -> Option<FoxgloveMessage> {
    let position = track.position.filter(|_| is_sure(track.state()))?;
    let pose = wire::PoseInFrame {
        timestamp: stamp(time),
        frame_id: SITE_FRAME.to_owned(),
        pose: Some(wire::Pose {
            position: Some(vector(position)),
            orientation: Some(wire::Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }),
        }),
    };
    Some(said(topic_of(track.id, "pose"), time, &pose))
}

/// The positions of the sure targets on the Earth.
fn fixes_of(snapshot: &crate::Snapshot) -> Vec<FoxgloveMessage> {
    let sure = snapshot.targets.iter().filter(|target| is_sure(target.state));
    sure.map(|target| fix_of(target, snapshot.time)).collect()
}

/// Whether a track of this state has a position that Foxglove should show.
fn is_sure(state: TrackState) -> bool {
    matches!(state, TrackState::Confirmed | TrackState::Coasting)
}

fn fix_of(target: &crate::Target, time: Timestamp) -> FoxgloveMessage {
    let covariance = target.covariance.fixed_view::<3, 3>(0, 0).into_owned();
    let fix = wire::LocationFix {
        timestamp: stamp(time),
        frame_id: SITE_FRAME.to_owned(),
        latitude: target.place.latitude_deg(),
        longitude: target.place.longitude_deg(),
        altitude: target.place.height(),
        position_covariance: covariance.transpose().as_slice().to_vec(),
        position_covariance_type: wire::location_fix::PositionCovarianceType::Known.into(),
        heading: Some(target.motion().course_deg.value.to_radians()),
        velocity: Some(vector(target.velocity.into())),
    };
    said(topic_of(target.id, "location"), time, &fix)
}
