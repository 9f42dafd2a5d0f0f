//! H.264 as a byte stream: units, each after a start code (ITU-T H.264, annex B).

/// Unit type of a key picture, which needs no other (IDR slice).
const KEY: u8 = 5;

/// The units of an Annex B stream, without start codes.
pub(crate) fn units(stream: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut starts: Vec<(usize, usize)> = Vec::new();
    let mut at = 0;
    while at + 3 <= stream.len() {
        if stream[at..at + 3] == [0, 0, 1] {
            let begin = if at > 0 && stream[at - 1] == 0 { at - 1 } else { at };
            starts.push((begin, at + 3));
            at += 3;
        } else {
            at += 1;
        }
    }
    let ends: Vec<usize> =
        starts.iter().skip(1).map(|(begin, _)| *begin).chain([stream.len()]).collect();
    starts.into_iter().zip(ends).map(|((_, from), to)| &stream[from..to.max(from)])
}

/// Whether a stream holds a picture that can be decoded without others.
pub(crate) fn is_key(stream: &[u8]) -> bool {
    units(stream).any(|unit| unit.first().is_some_and(|head| head & 0x1f == KEY))
}
