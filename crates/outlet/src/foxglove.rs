//! Foxglove's well-known schemas: what a site says, so that Foxglove and Rerun show it without Crossfix.
//!
//! Written beside our own messages, never instead of them: they hold less.

use crossfix_geometry::Geodetic;
use crossfix_message::{
    AreaName, CameraCalibration, Channel, DistortionModel, Key, Preview, Timestamp, Track,
    TrackFrame, TrackState, Vector3, decode,
};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use prost::Message;

use crate::situation::Situation;

/// Foxglove's messages, as `proto/foxglove/foxglove.proto` has them.
#[allow(missing_docs, clippy::all)]
pub mod wire {
    include!("generated/foxglove.rs");
}

/// The definitions of these messages as a `google.protobuf.FileDescriptorSet`: the schema of all.
pub fn file_descriptor_set() -> &'static [u8] {
    include_bytes!("generated/foxglove.bin")
}

/// The frame of the site: local east, north, up.
const SITE_FRAME: &str = "site";
/// A track's topic has its number's last two digits: a recorder that writes for years has no more than
/// a hundred of them.
const TOPICS_OF_TRACKS: u64 = 100;
/// A track's place is said so often at most, s.
const PLACE_PERIOD_S: f64 = 0.1;

/// A message in one of Foxglove's schemas.
#[derive(Clone, Debug, PartialEq)]
pub struct FoxgloveMessage {
    /// The topic: `/camera/north/image`.
    pub topic: String,
    /// The schema's full name: `foxglove.CompressedImage`.
    pub schema: &'static str,
    /// What time it speaks of.
    pub time: Timestamp,
    /// The message.
    pub data: Vec<u8>,
}

/// Whether pictures are said again in Foxglove's schema: they are most of a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pictures {
    /// They are.
    Said,
    /// They are left out.
    LeftOut,
}

/// Says in Foxglove's schemas what goes over a site's channels.
#[derive(Debug)]
pub struct FoxgloveView {
    pictures: Pictures,
    situation: Option<Situation>,
    said_at: Option<Timestamp>,
}

impl FoxgloveView {
    /// Of a site; with an anchor it says where on the Earth the targets are, too.
    pub fn new(
        site: &crossfix_message::SiteName,
        anchor: Option<Geodetic>,
        pictures: Pictures,
    ) -> Self {
        let situation = anchor.map(|anchor| Situation::new(site.clone(), anchor));
        Self { pictures, situation, said_at: None }
    }

    /// What a message on a channel says in Foxglove's schemas. Bytes that are no such message say
    /// nothing.
    pub fn of(&mut self, key: &Key, data: &[u8], time: Timestamp) -> Vec<FoxgloveMessage> {
        match &key.channel {
            // Whose it is the channel says: a message that says otherwise is nobody's.
            Channel::Calibration(camera) => decode::<CameraCalibration>(data)
                .ok()
                .filter(|message| message.camera == camera.as_str())
                .map(|message| self.of_calibration(&message, time))
                .unwrap_or_default(),
            Channel::Preview(camera) if self.pictures == Pictures::Said => decode::<Preview>(data)
                .ok()
                .filter(|message| message.camera == camera.as_str())
                .map(|message| vec![of_preview(message)])
                .unwrap_or_default(),
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
            situation.hear_calibration(message);
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
            situation.hear(area, frame);
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

/// A message of Foxglove's and its name.
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
    const SECOND: i64 = 1_000_000_000;
    let nanos = i32::try_from(time.nanos().rem_euclid(SECOND)).unwrap_or(0);
    Some(prost_types::Timestamp { seconds: time.nanos().div_euclid(SECOND), nanos })
}

fn vector(from: Vector3) -> wire::Vector3 {
    wire::Vector3 { x: from.x, y: from.y, z: from.z }
}

/// A lens: K and P as OpenCV has them, with pixels counted as ours from the middle of the first.
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

/// Where a camera stands and looks; `None` of one that turns.
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

/// The topic of a track's place.
fn topic_of(track_id: u64, what: &str) -> String {
    // A run's numbers are what is left of 2^20.
    format!("/track/{:02}/{what}", track_id % (1 << 20) % TOPICS_OF_TRACKS)
}

/// A sure track's place in the site.
fn pose_of(track: &Track, time: Timestamp) -> Option<FoxgloveMessage> {
    let is_sure = matches!(track.state(), TrackState::Confirmed | TrackState::Coasting);
    let position = track.position.filter(|_| is_sure)?;
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

/// The targets on the Earth.
fn fixes_of(snapshot: &crate::Snapshot) -> Vec<FoxgloveMessage> {
    let is_there = |target: &&crate::Target| {
        matches!(target.state, TrackState::Confirmed | TrackState::Coasting)
    };
    let fix = |target: &crate::Target| {
        let topic = topic_of(target.id, "location");
        let covariance = target.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let fix = wire::LocationFix {
            timestamp: stamp(snapshot.time),
            frame_id: SITE_FRAME.to_owned(),
            latitude: target.place.latitude_deg(),
            longitude: target.place.longitude_deg(),
            altitude: target.place.height(),
            position_covariance: covariance.transpose().as_slice().to_vec(),
            position_covariance_type: wire::location_fix::PositionCovarianceType::Known.into(),
            heading: Some(target.motion().course_deg.value.to_radians()),
            velocity: Some(vector(target.velocity.into())),
        };
        said(topic, snapshot.time, &fix)
    };
    snapshot.targets.iter().filter(is_there).map(fix).collect()
}
