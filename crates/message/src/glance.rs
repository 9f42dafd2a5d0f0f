use crate::size::{Value, fields};
use crate::{
    BearingFrame, CameraCalibration, Channel, CueFrame, DecodeError, Health, Payload, Preview,
    Timestamp, TrackEvent, TrackFrame, TruthFrame, VERSION,
};

/// What a recorder must know of a message. Nothing else is read of it, so that a message of a newer
/// version can be kept, and a large one costs nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Glance {
    /// The data time of the message; the epoch if it has none.
    pub time: Timestamp,
    /// Whether this build can read it; `false` if its sender speaks a newer major version.
    pub is_readable: bool,
}

/// Reads the data time and readability from the bytes of a channel's message without decoding it;
/// `None` for channels that carry no messages.
///
/// # Errors
/// [`DecodeError::Malformed`] if the bytes are no protobuf message.
///
/// ```
/// use crossfix_message::{BearingFrame, Channel, Payload, Timestamp, glance};
/// let frame = BearingFrame { capture_time_ns: 7, ..Default::default() };
/// let seen = glance(&Channel::Bearings("north".parse()?), &frame.encode())?.unwrap();
/// assert_eq!(seen.time, Timestamp::from_nanos(7));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn glance(channel: &Channel, bytes: &[u8]) -> Result<Option<Glance>, DecodeError> {
    let seen = match channel {
        Channel::Bearings(_) => of::<BearingFrame>(bytes),
        Channel::Calibration(_) => of::<CameraCalibration>(bytes),
        Channel::Preview(_) => of::<Preview>(bytes),
        Channel::CameraHealth(_) | Channel::FusionHealth | Channel::RecorderHealth => {
            of::<Health>(bytes)
        }
        Channel::Tracks | Channel::Smoothed => of::<TrackFrame>(bytes),
        Channel::Events => of::<TrackEvent>(bytes),
        Channel::Cues => of::<CueFrame>(bytes),
        Channel::Truth => of::<TruthFrame>(bytes),
        Channel::Alive(_) | Channel::FusionAlive | Channel::RecorderAlive => return Ok(None),
    };
    seen.map(Some)
}

/// Number of the field `version` of every message.
const VERSION_TAG: u32 = 1;
/// Number of the field `major` in `version`.
const MAJOR_TAG: u32 = 1;

fn of<M: Payload>(bytes: &[u8]) -> Result<Glance, DecodeError> {
    let mut seen = Glance { time: Timestamp::EPOCH, is_readable: true };
    let read = fields(bytes, |tag, value| {
        match value {
            Value::Bytes(version) if tag == VERSION_TAG => {
                if let Some(major) = major(version)? {
                    seen.is_readable = major <= u64::from(VERSION.major);
                }
            }
            Value::SixtyFour(nanos) if tag == M::TIME_TAG => {
                seen.time = Timestamp::from_nanos(i64::from_le_bytes(nanos));
            }
            _ => {}
        }
        Ok(true)
    });
    read.map_err(|source| DecodeError::Malformed { schema: M::SCHEMA, source })?;
    Ok(seen)
}

/// The field `major` of the bytes of a version.
fn major(version: &[u8]) -> Result<Option<u64>, prost::DecodeError> {
    let mut found = None;
    fields(version, |tag, value| {
        if let (MAJOR_TAG, Value::Varint(major)) = (tag, value) {
            found = Some(major);
        }
        Ok(true)
    })?;
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Version;

    #[test]
    fn every_message_shows_the_time_that_it_speaks_of() {
        let camera = || "north".parse().unwrap();
        let time = Timestamp::from_nanos(1_790_000_000_000_000_007);
        let ns = time.nanos();
        let shown =
            |channel: Channel, bytes: Vec<u8>| glance(&channel, &bytes).unwrap().unwrap().time;
        let messages = [
            (
                Channel::Bearings(camera()),
                BearingFrame { capture_time_ns: ns, ..Default::default() }.encode(),
            ),
            (
                Channel::Calibration(camera()),
                CameraCalibration { valid_from_ns: ns, ..Default::default() }.encode(),
            ),
            (
                Channel::Preview(camera()),
                Preview { capture_time_ns: ns, ..Default::default() }.encode(),
            ),
            (
                Channel::CameraHealth(camera()),
                Health { time_ns: ns, ..Default::default() }.encode(),
            ),
            (Channel::Tracks, TrackFrame { time_ns: ns, ..Default::default() }.encode()),
            (Channel::Events, TrackEvent { time_ns: ns, ..Default::default() }.encode()),
            (Channel::Cues, CueFrame { time_ns: ns, ..Default::default() }.encode()),
            (Channel::Truth, TruthFrame { time_ns: ns, ..Default::default() }.encode()),
        ];
        for (channel, bytes) in messages {
            assert_eq!(shown(channel.clone(), bytes), time, "{channel:?}");
        }
        assert_eq!(shown(Channel::FusionHealth, Health::default().encode()), Timestamp::EPOCH);
        assert!(glance(&Channel::FusionAlive, &[]).unwrap().is_none());
    }

    #[test]
    fn a_newer_major_version_is_seen_and_damage_is_named() {
        let newer = BearingFrame {
            version: Some(Version { major: VERSION.major + 1, minor: 0 }),
            capture_time_ns: 5,
            ..Default::default()
        };
        let channel = Channel::Bearings("north".parse().unwrap());
        let seen = glance(&channel, &newer.encode_unstamped()).unwrap().unwrap();
        assert!(!seen.is_readable);
        assert!(matches!(glance(&channel, &[0xff; 40]), Err(DecodeError::Malformed { .. })));
    }
}
