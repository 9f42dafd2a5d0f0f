use crossfix_message::{
    BearingFrame, CameraCalibration, Channel, CueFrame, Health, Payload, Preview, TrackEvent,
    TrackFrame, TruthFrame,
};

/// The full protobuf name of a channel's messages; `None` for liveliness tokens, which carry no
/// message.
pub fn schema_of(channel: &Channel) -> Option<&'static str> {
    Some(match channel {
        Channel::Bearings(_) => BearingFrame::SCHEMA,
        Channel::Calibration(_) => CameraCalibration::SCHEMA,
        Channel::Preview(_) => Preview::SCHEMA,
        Channel::CameraHealth(_) | Channel::FusionHealth | Channel::RecorderHealth => {
            Health::SCHEMA
        }
        Channel::Tracks | Channel::Smoothed => TrackFrame::SCHEMA,
        Channel::Events => TrackEvent::SCHEMA,
        Channel::Cues => CueFrame::SCHEMA,
        Channel::Truth => TruthFrame::SCHEMA,
        Channel::Alive(_) | Channel::FusionAlive | Channel::RecorderAlive => return None,
    })
}
