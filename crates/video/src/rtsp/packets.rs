//! H.264 and clock reports as RTP packets (RFC 3550, RFC 6184), for the server.

use crossfix_message::Timestamp;

use crate::annex_b::units;
use crate::stream_clock::NTP_TO_UNIX_S;

/// The longest payload of a packet, bytes: that of an Ethernet frame. With half of it packets are
/// twice as many.
const LONGEST_PAYLOAD: usize = 1400;
/// RTP payload type, as the session's description names it: the first that is free to use (RFC
/// 3551, 6).
pub(super) const PAYLOAD_TYPE: u8 = 96;
/// The clock of video streams, Hz (RFC 6184, 8.2.1).
pub(super) const CLOCK_HZ: u32 = 90_000;
/// Unit type of a fragment of a unit (FU-A; RFC 6184, 5.8).
const FRAGMENT: u8 = 28;

/// Makes numbered packets of one stream.
#[derive(Debug)]
pub(super) struct Packetiser {
    source: u32,
    sequence: u16,
    packets: u32,
    bytes: u32,
}

impl Packetiser {
    pub(super) fn new(source: u32) -> Self {
        Self { source, sequence: 0, packets: 0, bytes: 0 }
    }

    /// An access unit as packets within the RTSP connection, on channel 0.
    pub(super) fn access_unit(&mut self, stream: &[u8], ticks: u32) -> Vec<u8> {
        let payloads: Vec<Vec<u8>> = units(stream).flat_map(payloads).collect();
        let mut out = Vec::new();
        let last = payloads.len().saturating_sub(1);
        for (n, payload) in payloads.iter().enumerate() {
            let marker = if n == last { 0x80 } else { 0 };
            let mut packet = vec![0x80, marker | PAYLOAD_TYPE];
            packet.extend(self.sequence.to_be_bytes());
            packet.extend(ticks.to_be_bytes());
            packet.extend(self.source.to_be_bytes());
            packet.extend(payload);
            self.sequence = self.sequence.wrapping_add(1);
            self.packets = self.packets.wrapping_add(1);
            self.bytes = self.bytes.wrapping_add(payload.len() as u32);
            out.extend(interleaved(0, &packet));
        }
        out
    }

    /// A report of what the camera's clock shows when the stream's count is at `ticks`, on channel
    /// 1.
    pub(super) fn report(&self, shown: Timestamp, ticks: u32) -> Vec<u8> {
        let nanos = shown.nanos().max(0) as u64;
        let seconds = nanos / 1_000_000_000 + NTP_TO_UNIX_S;
        // NTP counts fractions of a second in steps of 2^-32 s.
        let fraction = (((nanos % 1_000_000_000) as u128) << 32) / 1_000_000_000;
        // A sender report: version 2, type 200, six words after this one (RFC 3550, 6.4.1).
        let mut report = vec![0x80, 200, 0, 6];
        report.extend(self.source.to_be_bytes());
        report.extend((seconds as u32).to_be_bytes());
        report.extend((fraction as u32).to_be_bytes());
        report.extend(ticks.to_be_bytes());
        report.extend(self.packets.to_be_bytes());
        report.extend(self.bytes.to_be_bytes());
        interleaved(1, &report)
    }
}

/// A unit in one payload, or fragmented if it is too long for one.
fn payloads(unit: &[u8]) -> Vec<Vec<u8>> {
    let Some((&head, body)) = unit.split_first() else {
        return Vec::new();
    };
    if unit.len() <= LONGEST_PAYLOAD {
        return vec![unit.to_vec()];
    }
    let chunks: Vec<&[u8]> = body.chunks(LONGEST_PAYLOAD - 2).collect();
    let last = chunks.len() - 1;
    let fragments = chunks.iter().enumerate().map(|(n, chunk)| {
        let start = if n == 0 { 0x80 } else { 0 };
        let end = if n == last { 0x40 } else { 0 };
        let heads = [head & 0xe0 | FRAGMENT, start | end | head & 0x1f];
        [&heads, *chunk].concat()
    });
    fragments.collect()
}

/// A packet framed for the RTSP connection (RFC 2326, 10.12).
fn interleaved(channel: u8, packet: &[u8]) -> Vec<u8> {
    let mut framed = vec![b'$', channel];
    framed.extend((packet.len() as u16).to_be_bytes());
    framed.extend(packet);
    framed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::annex_b::is_key;

    #[test]
    fn a_long_unit_goes_in_parts_that_make_it_again() {
        let long: Vec<u8> = std::iter::once(0x65).chain((0..4000).map(|n| n as u8 | 1)).collect();
        let stream = [&[0, 0, 0, 1, 0x67, 9, 9][..], &[0, 0, 1], &long].concat();
        let found: Vec<&[u8]> = units(&stream).collect();
        assert_eq!(found, [&[0x67, 9, 9][..], &long[..]]);
        assert!(is_key(&stream));
        let parts = payloads(&long);
        let again: Vec<u8> =
            std::iter::once(0x65).chain(parts.iter().flat_map(|part| part[2..].to_vec())).collect();
        assert_eq!(again, long);
        assert!(parts.iter().all(|part| part.len() <= LONGEST_PAYLOAD));
    }
}
