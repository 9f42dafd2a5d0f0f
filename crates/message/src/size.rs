//! The memory that a message would take, computed from its bytes before any of it is decoded.

use prost::DecodeError;
use prost::encoding::{DecodeContext, WireType, decode_key, decode_varint, skip_field};

use crate::{
    BearingTrack, CameraHealth, CameraResidual, Counter, Cue, Expected, TakenOver, Track, TrueState,
};

/// The longest message that is accepted or recorded, bytes. The largest real ones are previews
/// (about 100 kB) and frames of a thousand tracks (about 1 MB). With half of it frames of four
/// thousand tracks are still accepted.
pub const MOST_MESSAGE_BYTES: usize = 8 << 20;

/// The most memory that a decoded message may take, bytes: 80 000 bearings. Lists double as they
/// grow, so that decoding one takes twice as much for a moment. With half of it a frame of 40 000
/// bearings is still accepted; with twice as much one hostile message takes 64 MB.
pub const MOST_DECODED_BYTES: usize = 16 << 20;

/// A list in a message that may be larger in memory than on the wire: an empty element has two
/// bytes on the wire and its whole size in memory.
#[derive(Debug)]
pub struct Repeated {
    /// Number of the list's field.
    pub(crate) tag: u32,
    /// Size of an element in memory, bytes.
    pub(crate) bytes: usize,
    /// The lists inside an element.
    pub(crate) inside: &'static [Repeated],
}

const fn list<T>(tag: u32, inside: &'static [Repeated]) -> Repeated {
    Repeated { tag, bytes: size_of::<T>(), inside }
}

/// No lists.
pub(crate) const NOTHING: &[Repeated] = &[];
/// The lists of a [`crate::BearingFrame`].
pub(crate) const BEARING_FRAME: &[Repeated] =
    &[list::<BearingTrack>(8, NOTHING), list::<TakenOver>(10, NOTHING)];
/// The lists of a [`crate::TrackFrame`].
pub(crate) const TRACK_FRAME: &[Repeated] =
    &[list::<Track>(6, &[list::<CameraResidual>(6, NOTHING)])];
/// The lists of a [`crate::CueFrame`].
pub(crate) const CUE_FRAME: &[Repeated] = &[list::<Cue>(4, &[list::<Expected>(2, NOTHING)])];
/// The lists of a [`crate::Health`].
pub(crate) const HEALTH: &[Repeated] = &[
    list::<Counter>(5, NOTHING),
    list::<CameraHealth>(7, NOTHING),
    list::<String>(10, NOTHING),
    list::<String>(12, NOTHING),
];
/// The lists of a [`crate::TruthFrame`].
pub(crate) const TRUTH_FRAME: &[Repeated] = &[list::<TrueState>(3, NOTHING)];

/// Memory that a decoded message takes, bytes; at least as many as it has on the wire. Counting
/// stops early above `limit`.
///
/// # Errors
/// If the bytes are no protobuf message.
pub(crate) fn decoded_bytes(
    wire: &[u8],
    lists: &[Repeated],
    limit: usize,
) -> Result<usize, DecodeError> {
    let mut total = wire.len();
    fields(wire, |tag, value| {
        if let (Some(list), Value::Bytes(element)) =
            (lists.iter().find(|list| list.tag == tag), value)
        {
            total += list.bytes;
            if !list.inside.is_empty() {
                // The element's own bytes have been counted with the wire.
                total += decoded_bytes(element, list.inside, limit)? - element.len();
            }
        }
        Ok(total <= limit)
    })?;
    Ok(total)
}

/// A field's value in its wire encoding.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Value<'a> {
    Varint(u64),
    SixtyFour([u8; 8]),
    Bytes(&'a [u8]),
    Other,
}

/// Goes through the fields of one message, without descending into them, for as long as `visit`
/// returns `true`.
///
/// # Errors
/// If the bytes are no protobuf message, or the error of `visit`.
pub(crate) fn fields<'a>(
    mut wire: &'a [u8],
    mut visit: impl FnMut(u32, Value<'a>) -> Result<bool, DecodeError>,
) -> Result<(), DecodeError> {
    while !wire.is_empty() {
        let (tag, kind) = decode_key(&mut wire)?;
        let from = wire;
        skip_field(kind, tag, &mut wire, DecodeContext::default())?;
        let mut field = &from[..from.len() - wire.len()];
        let value = match kind {
            WireType::SixtyFourBit => field.try_into().map_or(Value::Other, Value::SixtyFour),
            WireType::LengthDelimited => {
                decode_varint(&mut field)?;
                Value::Bytes(field)
            }
            WireType::Varint => Value::Varint(decode_varint(&mut field)?),
            WireType::ThirtyTwoBit | WireType::StartGroup | WireType::EndGroup => Value::Other,
        };
        if !visit(tag, value)? {
            break;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use prost::Message;
    use prost_types::FileDescriptorSet;
    use prost_types::field_descriptor_proto::{Label, Type};

    use super::*;
    use crate::{
        BearingFrame, CueFrame, Health, Payload, TrackFrame, TruthFrame, decode,
        file_descriptor_set,
    };

    /// The tags of a message's repeated fields that hold messages, strings or bytes, with the type
    /// name of their elements.
    fn described(set: &FileDescriptorSet, name: &str) -> Vec<(u32, String)> {
        let message =
            set.file.iter().flat_map(|f| &f.message_type).find(|m| m.name() == name).unwrap();
        let grows = |kind| matches!(kind, Type::Message | Type::String | Type::Bytes);
        message
            .field
            .iter()
            .filter(|f| f.label() == Label::Repeated && grows(f.r#type()))
            .map(|f| (f.number() as u32, f.type_name().rsplit('.').next().unwrap().to_owned()))
            .collect()
    }

    fn agrees(set: &FileDescriptorSet, name: &str, lists: &[Repeated]) {
        let described = described(set, name);
        let ours: Vec<u32> = lists.iter().map(|list| list.tag).collect();
        assert_eq!(described.iter().map(|(tag, _)| *tag).collect::<Vec<_>>(), ours, "{name}");
        for ((_, inner), list) in
            described.iter().zip(lists).filter(|((_, inner), _)| !inner.is_empty())
        {
            agrees(set, inner, list.inside);
        }
    }

    #[test]
    fn every_list_of_the_definitions_is_counted() {
        let set = FileDescriptorSet::decode(file_descriptor_set()).unwrap();
        agrees(&set, "BearingFrame", BearingFrame::LISTS);
        agrees(&set, "TrackFrame", TrackFrame::LISTS);
        agrees(&set, "Health", Health::LISTS);
        agrees(&set, "CueFrame", CueFrame::LISTS);
        agrees(&set, "TruthFrame", TruthFrame::LISTS);
        for name in ["CameraCalibration", "TrackEvent", "Preview"] {
            agrees(&set, name, NOTHING);
        }
    }

    #[test]
    fn what_says_nothing_many_times_is_refused_before_it_is_decoded() {
        let empty_bearings = [0x42, 0x00].repeat(MOST_MESSAGE_BYTES / 2);
        let refused = decode::<BearingFrame>(&empty_bearings);
        assert!(matches!(refused, Err(crate::DecodeError::TooLarge { .. })), "{refused:?}");
        // One track with very many empty residuals.
        let residuals = [0x32, 0x00].repeat(1 << 20);
        let mut track = vec![0x32];
        prost::encoding::encode_varint(residuals.len() as u64, &mut track);
        track.extend(residuals);
        assert!(matches!(decode::<TrackFrame>(&track), Err(crate::DecodeError::TooLarge { .. })));
    }

    #[test]
    fn a_thousand_tracks_seen_by_64_cameras_are_not_too_large() {
        let residual =
            CameraResidual { camera: "a-camera".into(), time_ns: 1, ..Default::default() };
        let track = Track {
            covariance: vec![1.0; 36],
            residuals: vec![residual; 64],
            ..Default::default()
        };
        let frame = TrackFrame { tracks: vec![track; 1000], ..Default::default() };
        assert_eq!(decode::<TrackFrame>(&frame.encode_to_vec()).unwrap().tracks.len(), 1000);
    }
}
