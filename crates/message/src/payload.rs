use prost::Message;
use thiserror::Error;

use crate::size::{self, MOST_DECODED_BYTES, Repeated};
use crate::{
    BearingFrame, CameraCalibration, CueFrame, Health, Preview, TrackEvent, TrackFrame, TruthFrame,
    VERSION, Version,
};

/// A message type that stands alone on the wire and in recordings.
pub trait Payload: Message + Default + Clone {
    /// Its full protobuf name, which is the schema's name in a recording.
    const SCHEMA: &'static str;
    /// Number of the field that holds its data time.
    const TIME_TAG: u32;
    /// Its lists, by which its size in memory is known before it is decoded.
    const LISTS: &'static [Repeated];

    /// The version that its sender was built with, if it states one.
    fn version(&self) -> Option<Version>;

    /// The same message stamped with this build's version.
    #[must_use]
    fn stamped(self) -> Self;

    /// The bytes for wire and recording, stamped with this build's version.
    fn encode(&self) -> Vec<u8>;

    /// Decodes a message, whatever its version and size; only for use by [`decode`].
    ///
    /// # Errors
    /// If the bytes are no such message.
    #[doc(hidden)]
    fn of_bytes(bytes: &[u8]) -> Result<Self, prost::DecodeError>;

    /// The bytes with the version that the message has, as if from another sender.
    fn encode_unstamped(&self) -> Vec<u8> {
        self.encode_to_vec()
    }
}

macro_rules! payload {
    ($($type:ident, time $time_tag:literal, $lists:ident;)*) => {$(
        impl Payload for $type {
            const SCHEMA: &'static str = concat!("crossfix.v1.", stringify!($type));
            const TIME_TAG: u32 = $time_tag;
            const LISTS: &'static [Repeated] = size::$lists;

            fn version(&self) -> Option<Version> {
                self.version
            }

            fn stamped(mut self) -> Self {
                self.version = Some(VERSION);
                self
            }

            // Both are implemented here and not in the trait, so that they are compiled and
            // optimised with this crate, and not again in each crate that uses them.
            fn encode(&self) -> Vec<u8> {
                self.clone().stamped().encode_to_vec()
            }

            fn of_bytes(bytes: &[u8]) -> Result<Self, prost::DecodeError> {
                Message::decode(bytes)
            }
        }
    )*};
}

payload! {
    BearingFrame, time 4, BEARING_FRAME;
    CameraCalibration, time 14, NOTHING;
    TrackFrame, time 3, TRACK_FRAME;
    TrackEvent, time 2, NOTHING;
    CueFrame, time 2, CUE_FRAME;
    Health, time 3, HEALTH;
    Preview, time 3, NOTHING;
    TruthFrame, time 2, TRUTH_FRAME;
}

/// Why bytes are not a message that this build can read.
#[derive(Debug, Error)]
pub enum DecodeError {
    /// The bytes are no such message.
    #[error("the bytes are no {schema}")]
    Malformed {
        /// The message that was expected.
        schema: &'static str,
        /// What the decoder says.
        #[source]
        source: prost::DecodeError,
    },
    /// The message would take more memory than any real one.
    #[error(
        "a {schema} of {wire_bytes} bytes would take more than {MOST_DECODED_BYTES} bytes of memory"
    )]
    TooLarge {
        /// The message that was expected.
        schema: &'static str,
        /// Its length.
        wire_bytes: usize,
    },
    /// The sender speaks a newer major version.
    #[error("{schema} of version {theirs}, this build reads up to {ours}: update this side")]
    NewerMajor {
        /// The message that was expected.
        schema: &'static str,
        /// The sender's major version.
        theirs: u32,
        /// This build's major version.
        ours: u32,
    },
}

/// Decodes a message from the bytes of wire or recording. The memory that it would take is computed
/// before it is decoded: at most [`MOST_DECODED_BYTES`], and twice that while it is read.
///
/// # Errors
/// [`DecodeError`] if the bytes are no such message, too large, or of a newer major version.
pub fn decode<M: Payload>(bytes: &[u8]) -> Result<M, DecodeError> {
    let malformed = |source| DecodeError::Malformed { schema: M::SCHEMA, source };
    let decoded = size::decoded_bytes(bytes, M::LISTS, MOST_DECODED_BYTES).map_err(malformed)?;
    if decoded > MOST_DECODED_BYTES {
        return Err(DecodeError::TooLarge { schema: M::SCHEMA, wire_bytes: bytes.len() });
    }
    let message = M::of_bytes(bytes).map_err(malformed)?;
    match message.version() {
        Some(version) if version.major > VERSION.major => Err(DecodeError::NewerMajor {
            schema: M::SCHEMA,
            theirs: version.major,
            ours: VERSION.major,
        }),
        _ => Ok(message),
    }
}

/// The compiled definitions as a `google.protobuf.FileDescriptorSet`: the schema in recordings.
pub fn file_descriptor_set() -> &'static [u8] {
    include_bytes!("generated/descriptors.bin")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{BearingTrack, Vector3};

    fn frame() -> BearingFrame {
        BearingFrame {
            camera: "a".into(),
            sequence: 3,
            capture_time_ns: -5,
            tracks: vec![BearingTrack {
                track_id: 1,
                bearing: Some(Vector3 { x: 0.0, y: 0.0, z: 1.0 }),
                ..Default::default()
            }],
            ..Default::default()
        }
    }

    #[test]
    fn a_newer_major_version_is_refused() {
        let mut message = frame();
        message.version = Some(Version { major: VERSION.major + 1, minor: 0 });
        let refused = decode::<BearingFrame>(&message.encode_unstamped());
        assert!(matches!(refused, Err(DecodeError::NewerMajor { .. })));
    }

    #[test]
    fn an_unknown_field_of_a_newer_minor_version_is_skipped() {
        let mut bytes = frame().stamped().encode_to_vec();
        // Field 2000, a varint.
        bytes.extend([0x80, 0x7d, 0x2a]);
        assert_eq!(decode::<BearingFrame>(&bytes).unwrap().sequence, 3);
    }

    #[test]
    fn json_carries_the_same_message() {
        let message = frame().stamped();
        let json = serde_json::to_string(&message).unwrap();
        assert_eq!(serde_json::from_str::<BearingFrame>(&json).unwrap(), message);
    }

    proptest! {
        #[test]
        fn any_bytes_are_a_message_or_an_error(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
            let _ = decode::<BearingFrame>(&bytes);
            let _ = decode::<TrackFrame>(&bytes);
            let _ = decode::<CameraCalibration>(&bytes);
            let _ = decode::<CueFrame>(&bytes);
        }
    }
}
