//! Filters an MP4 index down to the boxes that are read.
//!
//! `mp4-atom` reads every box that it knows wherever it meets it, nested without a limit, and
//! allocates for some of them what they state and not what their length allows. It is given only
//! the boxes that are listed here, each where it belongs.

use std::ops::Range;

use self::Holds::{Boxes, Counted, Picture, Values};

/// A kind of box that is read, and its contents.
#[derive(Clone, Copy)]
pub(super) struct KnownBox([u8; 4], Holds);

#[derive(Clone, Copy)]
enum Holds {
    /// Values, which are kept as they are.
    Values,
    /// Boxes.
    Boxes(&'static [KnownBox]),
    /// A version, the number of boxes, and the boxes.
    Counted(&'static [KnownBox]),
    /// A picture's description, and boxes.
    Picture(&'static [KnownBox]),
}

/// The boxes of a whole file's index.
pub(super) const MOOV: &[KnownBox] = &[
    KnownBox(*b"mvhd", Values),
    KnownBox(*b"mvex", Boxes(&[KnownBox(*b"trex", Values)])),
    KnownBox(*b"trak", Boxes(&[KnownBox(*b"tkhd", Values), KnownBox(*b"mdia", Boxes(MDIA))])),
];

/// The boxes of a track's media.
const MDIA: &[KnownBox] =
    &[KnownBox(*b"mdhd", Values), KnownBox(*b"hdlr", Values), KnownBox(*b"minf", Boxes(MINF))];

/// The boxes of a track's media information. They must contain where its data are (`dinf`), though
/// that is always this file.
const MINF: &[KnownBox] = &[
    KnownBox(*b"dinf", Boxes(&[KnownBox(*b"dref", Counted(&[]))])),
    KnownBox(*b"stbl", Boxes(STBL)),
];

/// The boxes of the tables of a track's frames.
const STBL: &[KnownBox] = &[
    KnownBox(*b"stsd", Counted(&[KnownBox(*b"avc1", Picture(&[KnownBox(*b"avcC", Values)]))])),
    KnownBox(*b"stts", Values),
    KnownBox(*b"ctts", Values),
    KnownBox(*b"stsc", Values),
    KnownBox(*b"stsz", Values),
    KnownBox(*b"stco", Values),
    KnownBox(*b"co64", Values),
    KnownBox(*b"stss", Values),
];

/// The boxes of a fragment's index.
pub(super) const MOOF: &[KnownBox] = &[
    KnownBox(*b"mfhd", Values),
    KnownBox(
        *b"traf",
        Boxes(&[
            KnownBox(*b"tfhd", Values),
            KnownBox(*b"tfdt", Values),
            KnownBox(*b"trun", Values),
        ]),
    ),
];

/// The length of a picture's description before its boxes, bytes (ISO/IEC 14496-12, 12.1.3).
const PICTURE_BYTES: usize = 78;

/// A box with only those parts that are read.
///
/// # Errors
/// What is wrong with it, in words, if a box within it is cut off.
pub(super) fn known(whole: &[u8], within: &'static [KnownBox]) -> Result<Vec<u8>, String> {
    let First { kind, body, .. } = first(whole)?;
    let mut kept = Vec::with_capacity(whole.len());
    append(KnownBox(kind, Boxes(within)), body, &mut kept)?;
    Ok(kept)
}

/// Appends a box with only those parts that are read; its size is set to what was kept.
fn append(KnownBox(kind, holds): KnownBox, body: &[u8], kept: &mut Vec<u8>) -> Result<(), String> {
    /// Place of the number of boxes, bytes: after the version (ISO/IEC 14496-12, 8.5.2).
    const COUNT: Range<usize> = 4..8;
    let begins = kept.len();
    kept.extend([0; 4]);
    kept.extend(kind);
    let head = |length| body.split_at_checked(length).ok_or_else(cut_off);
    match holds {
        Values => kept.extend(body),
        Boxes(within) => _ = append_within(within, body, kept)?,
        Picture(within) => {
            let (head, rest) = head(PICTURE_BYTES)?;
            kept.extend(head);
            append_within(within, rest, kept)?;
        }
        Counted(within) => {
            let (head, rest) = head(COUNT.end)?;
            let at = kept.len();
            kept.extend(head);
            let count = append_within(within, rest, kept)?;
            kept[at..][COUNT].copy_from_slice(&count.to_be_bytes());
        }
    }
    let size = u32::try_from(kept.len() - begins).map_err(|error| error.to_string())?;
    kept[begins..][..4].copy_from_slice(&size.to_be_bytes());
    Ok(())
}

/// Appends those inner boxes that are read, and returns their number.
fn append_within(
    within: &'static [KnownBox],
    mut bytes: &[u8],
    kept: &mut Vec<u8>,
) -> Result<u32, String> {
    /// Length of a box's head, bytes: fewer are padding. With half of it padding of four bytes
    /// would be read as a box that is cut off.
    const LEAST: usize = 8;
    let mut count = 0;
    while bytes.len() >= LEAST {
        let First { kind, body, rest } = first(bytes)?;
        if let Some(&known) = within.iter().find(|KnownBox(known, _)| *known == kind) {
            append(known, body, kept)?;
            count += 1;
        }
        bytes = rest;
    }
    Ok(count)
}

/// The first of several boxes.
struct First<'a> {
    kind: [u8; 4],
    body: &'a [u8],
    /// What comes after it.
    rest: &'a [u8],
}

fn first(bytes: &[u8]) -> Result<First<'_>, String> {
    let (head, rest) = bytes.split_first_chunk::<8>().ok_or_else(cut_off)?;
    let [s0, s1, s2, s3, kind @ ..] = *head;
    let (size, head) = match u32::from_be_bytes([s0, s1, s2, s3]) {
        // Size 0: the box reaches to the end.
        0 => (bytes.len(), 8),
        1 => {
            let long = rest.first_chunk::<8>().ok_or_else(cut_off)?;
            (usize::try_from(u64::from_be_bytes(*long)).map_err(|_| cut_off())?, 16)
        }
        size => (usize::try_from(size).map_err(|_| cut_off())?, 8),
    };
    let (whole, rest) = bytes.split_at_checked(size).ok_or_else(cut_off)?;
    Ok(First { kind, body: whole.get(head..).ok_or_else(cut_off)?, rest })
}

fn cut_off() -> String {
    "its index is damaged: a part of it is cut off".to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn a_box(kind: &[u8; 4], parts: &[&[u8]]) -> Vec<u8> {
        let body = parts.concat();
        let size = u32::try_from(body.len() + 8).unwrap();
        [&size.to_be_bytes(), &kind[..], &body].concat()
    }

    #[test]
    fn what_is_not_read_is_left_out_wherever_it_is() {
        let times = a_box(b"stts", &[&[7; 16]]);
        let groups = a_box(b"sgpd", &[&[0xff; 16]]);
        let header = a_box(b"mvhd", &[&[1; 20]]);
        let index = |inner: &[&[u8]], outer: &[&[u8]]| {
            let table = a_box(b"stbl", inner);
            let media = a_box(b"mdia", &[&a_box(b"minf", &[&table])]);
            a_box(b"moov", &[outer, &[&a_box(b"trak", &[&media])]].concat())
        };
        // A box in the wrong place is not read either, and what is shorter than a box's head is
        // padding.
        let full = index(&[&groups, &times, &[0; 4]], &[&groups, &header, &times]);
        assert_eq!(known(&full, MOOV).unwrap(), index(&[&times], &[&header]));
    }

    #[test]
    fn what_is_left_out_is_not_counted() {
        let sound = a_box(b"mp4a", &[&[0; 30]]);
        let numbers = a_box(b"avcC", &[&[1, 2, 3]]);
        let video =
            |with: &[&[u8]]| a_box(b"avc1", &[&[[5; PICTURE_BYTES].as_slice()], with].concat());
        let table = |count: u8, parts: &[&[u8]]| {
            a_box(b"stsd", &[&[&[0, 0, 0, 0, 0, 0, 0, count][..]], parts].concat())
        };
        let mut kept = Vec::new();
        let full = table(2, &[&sound, &video(&[&numbers, &a_box(b"pasp", &[&[0; 8]])])]);
        append_within(STBL, &full, &mut kept).unwrap();
        assert_eq!(kept, table(1, &[&video(&[&numbers])]));
    }

    #[test]
    fn a_box_that_is_cut_off_is_named() {
        let whole = a_box(b"moov", &[&a_box(b"mvhd", &[&[1; 20]])]);
        let mut torn = whole.clone();
        torn[11] += 1;
        assert!(known(&torn, MOOV).unwrap_err().contains("cut off"));
        assert!(known(&whole[..whole.len() - 1], MOOV).is_err());
    }
}
