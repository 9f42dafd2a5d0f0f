//! ASTERIX category 062, encoded byte by byte (EUROCONTROL-SPEC-0149-9).

use std::collections::BTreeMap;

use crossfix_message::{Timestamp, TrackState};

use crate::{Outlet, Snapshot, Target};

/// The category: system track data.
const CATEGORY: u8 = 62;
/// Items of a record (FSPEC): 010 070 105 185, 040 080, 130, 220 500.
const ITEMS: [u8; 4] = [0x9B, 0x0D, 0x15, 0x04];
/// Bytes of a block before its records: category and length.
const HEAD_BYTES: usize = 3;
/// Bytes of one record, with the items of [`ITEMS`].
const RECORD_BYTES: usize = 42;
/// Most records of a block, so that it fits into one datagram of an ordinary network.
const MOST_RECORDS: usize = (1400 - HEAD_BYTES) / RECORD_BYTES;
/// A track number is reused only this long after its track was lost, s: displays have forgotten it
/// by then. With half of it a display that keeps a track for longer than 30 s joins two targets
/// into one.
const NUMBER_RESTS_S: f64 = 60.0;

/// Value of the last bit of latitude and longitude (item 105), degrees.
const DEGREE_LSB: f64 = 180.0 / (1 << 25) as f64;
/// Value of the last bit of the horizontal velocity (item 185), m/s.
const VELOCITY_LSB_MPS: f64 = 0.25;
/// A foot, m: ASTERIX gives heights in feet.
const FOOT_M: f64 = 0.3048;
/// Value of the last bit of the height (item 130), m.
const ALTITUDE_LSB_M: f64 = 6.25 * FOOT_M;
/// Value of the last bit of the rate of climb (item 220, feet per minute), m/s.
const CLIMB_LSB_MPS: f64 = 6.25 * FOOT_M / 60.0;
/// Value of the last bit of the time of day (item 070), s.
const TIME_LSB_S: f64 = 1.0 / 128.0;
/// Seconds of a day, after which the time of day begins at zero again.
const DAY_S: f64 = 86_400.0;
/// Metres per degree of a great circle, to a third of a percent: used for standard deviations only.
const DEGREE_M: f64 = 111_320.0;

/// ASTERIX category 062, edition 1.18 and later (EUROCONTROL-SPEC-0149-9): system tracks, for air
/// traffic displays. A block of up to 33 tracks is one datagram.
///
/// Standard deviations (item 500) are rounded up to the format's steps; that of a position is 0.6
/// m. Heights are geometric, above the WGS84 ellipsoid (item 130). Track numbers have 16 bits: a
/// track keeps its number while it lives, and the number is not reused for a minute after that.
#[derive(Clone, Debug)]
pub struct Asterix {
    /// System area code and system identification code.
    source: [u8; 2],
    numbers: TrackNumbers,
}

impl Asterix {
    /// An outlet of a data source with a system area code (a country's) and a system identification
    /// code.
    pub fn of_source(area: u8, identification: u8) -> Self {
        Self { source: [area, identification], numbers: TrackNumbers::default() }
    }

    fn record(&mut self, time: Timestamp, target: &Target) -> Vec<u8> {
        let (number, is_new) = self.numbers.of(target, time);
        let mut record = Vec::with_capacity(RECORD_BYTES);
        record.extend(ITEMS);
        record.extend(self.source);
        record.extend(&time_of_day(time).to_be_bytes()[1..]);
        record.extend(signed::<4>(target.place.latitude_deg() / DEGREE_LSB));
        record.extend(signed::<4>(target.place.longitude_deg() / DEGREE_LSB));
        record.extend(signed::<2>(target.velocity.x / VELOCITY_LSB_MPS));
        record.extend(signed::<2>(target.velocity.y / VELOCITY_LSB_MPS));
        record.extend(number.to_be_bytes());
        record.extend(status(target.state, is_new));
        record.extend(signed::<2>(target.place.height() / ALTITUDE_LSB_M));
        record.extend(signed::<2>(target.velocity.z / CLIMB_LSB_MPS));
        record.extend(accuracies(target));
        record
    }
}

/// Time since midnight, UTC, item 070.
fn time_of_day(time: Timestamp) -> u32 {
    /// Nanoseconds of a day.
    const NANOS_PER_DAY: i64 = 86_400_000_000_000;
    let seconds = time.nanos().rem_euclid(NANOS_PER_DAY) as f64 * 1e-9;
    (seconds / TIME_LSB_S).round().rem_euclid(DAY_S / TIME_LSB_S) as u32
}

/// A signed number of `BYTES` bytes, big-endian, clamped to its range.
fn signed<const BYTES: usize>(value: f64) -> [u8; BYTES] {
    let most = (1_i64 << (8 * BYTES - 1)) - 1;
    // The cast saturates beyond the range, and turns NaN into 0.
    let clamped = (value.round() as i64).clamp(-most - 1, most);
    let bytes = clamped.to_be_bytes();
    std::array::from_fn(|k| bytes[8 - BYTES + k])
}

/// A standard deviation of `BYTES` bytes, in steps: rounded up, at least one step, clamped to its
/// range.
fn deviation<const BYTES: usize>(sd: f64, step: f64) -> [u8; BYTES] {
    let most = (1_u64 << (8 * BYTES)) - 1;
    // What is no number is as bad as can be said: the cast would make it the best.
    let steps = if sd.is_nan() { f64::INFINITY } else { (sd / step).ceil() };
    let clamped = (steps as u64).clamp(1, most);
    let bytes = clamped.to_be_bytes();
    std::array::from_fn(|k| bytes[8 - BYTES + k])
}

/// Track status, item 080.
fn status(state: TrackState, is_new: bool) -> [u8; 5] {
    /// Made by one sensor (monosensor track).
    const MON: u8 = 0x80;
    /// The geometric height is the reliable one.
    const MRH: u8 = 0x20;
    /// The height's source: triangulation.
    const SRC_TRIANGULATION: u8 = 3 << 2;
    /// Tentative track.
    const CNF: u8 = 0x02;
    /// Last message of the track.
    const TSE: u8 = 0x40;
    /// First message of the track.
    const TSB: u8 = 0x20;
    /// Extrapolated, as nothing has seen it lately.
    const COASTING: u8 = 0x80;
    /// Not seen by radar of any kind.
    const NO_RADAR: u8 = 0x78;
    /// Not cooperative.
    const SDS: u8 = 2 << 6;
    /// Another octet follows.
    const FX: u8 = 0x01;
    let first = match state {
        TrackState::OneCamera => MON,
        TrackState::Tentative | TrackState::Unspecified => MRH | SRC_TRIANGULATION | CNF,
        _ => MRH | SRC_TRIANGULATION,
    };
    let last = if state == TrackState::Lost { TSE } else { 0 };
    let ends = last | if is_new { TSB } else { 0 };
    let coasts = matches!(state, TrackState::Coasting | TrackState::Lost);
    let fourth = NO_RADAR | if coasts { COASTING } else { 0 };
    [first | FX, ends | FX, FX, fourth | FX, SDS]
}

/// Estimated accuracies, item 500: position, height, velocity and rate of climb.
fn accuracies(target: &Target) -> Vec<u8> {
    /// Present: position (APW), height (AGA), velocity (ATV), and another octet.
    const FIRST: u8 = 0x35;
    /// Present: rate of climb (ARC).
    const SECOND: u8 = 0x80;
    let (place, velocity) = (target.place_sd_m(), target.velocity_sd_mps());
    // A degree of longitude is shorter by the cosine of the latitude.
    let parallel_m = DEGREE_M * target.place.latitude().cos().max(f64::EPSILON);
    let mut bytes = vec![FIRST, SECOND];
    bytes.extend(deviation::<2>(place.y / DEGREE_M, DEGREE_LSB));
    bytes.extend(deviation::<2>(place.x / parallel_m, DEGREE_LSB));
    bytes.extend(deviation::<1>(place.z, ALTITUDE_LSB_M));
    bytes.extend(deviation::<1>(velocity.x, VELOCITY_LSB_MPS));
    bytes.extend(deviation::<1>(velocity.y, VELOCITY_LSB_MPS));
    bytes.extend(deviation::<1>(velocity.z, CLIMB_LSB_MPS));
    bytes
}

impl Outlet for Asterix {
    fn tracks(&mut self, snapshot: &Snapshot) -> Vec<Vec<u8>> {
        let records: Vec<Vec<u8>> =
            snapshot.targets.iter().map(|target| self.record(snapshot.time, target)).collect();
        records.chunks(MOST_RECORDS).map(block).collect()
    }
}

/// A data block of at most [`MOST_RECORDS`] records.
fn block(records: &[Vec<u8>]) -> Vec<u8> {
    // At most 1400 bytes.
    let length = (HEAD_BYTES + RECORD_BYTES * records.len()) as u16;
    let mut block = vec![CATEGORY];
    block.extend(length.to_be_bytes());
    block.extend(records.iter().flatten());
    block
}

/// Assigns each track a number of 16 bits.
#[derive(Clone, Debug, Default)]
struct TrackNumbers {
    given: BTreeMap<u64, u16>,
    /// Numbers of lost tracks that may not be reused yet, and when each track was lost.
    resting: BTreeMap<u16, Timestamp>,
}

impl TrackNumbers {
    /// A track's number, and whether it was assigned just now.
    fn of(&mut self, target: &Target, now: Timestamp) -> (u16, bool) {
        let known = self.given.get(&target.id).copied();
        let number = known.unwrap_or_else(|| self.free(now));
        if target.state == TrackState::Lost {
            self.given.remove(&target.id);
            self.resting.insert(number, now);
        } else {
            self.given.insert(target.id, number);
        }
        (number, known.is_none())
    }

    /// The lowest number that is neither in use nor resting; if none of the 65 535 is free, the
    /// last.
    fn free(&mut self, now: Timestamp) -> u16 {
        self.resting.retain(|_, lost| now.seconds_since(*lost) < NUMBER_RESTS_S);
        let used: std::collections::BTreeSet<u16> =
            self.given.values().chain(self.resting.keys()).copied().collect();
        (1..=u16::MAX).find(|number| !used.contains(number)).unwrap_or(u16::MAX)
    }
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::Geodetic;
    use nalgebra::{Matrix6, Vector3, Vector6};

    use super::*;

    fn target(place: [f64; 3], velocity: [f64; 3], sd: [f64; 6], state: TrackState) -> Target {
        let [latitude, longitude, height] = place;
        Target {
            id: 99,
            state,
            place: Geodetic::from_degrees(latitude, longitude, height).unwrap(),
            velocity: Vector3::from(velocity),
            covariance: Matrix6::from_diagonal(&Vector6::from(sd).map(|sd| sd * sd)),
            seen: Timestamp::EPOCH,
        }
    }

    fn hex(bytes: &[u8]) -> String {
        bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn a_block_is_that_of_a_calculation_by_hand() {
        // 2026-11-26 12:34:56.789; each item's last bit is derived in docs/outlets.md.
        let time = Timestamp::from_nanos(1_795_696_496_789_000_000);
        let sure = target(
            [47.3769, 8.5417, 512.3],
            [12.5, -3.25, 1.5],
            [0.9, 1.3, 2.2, 0.6, 0.4, 0.3],
            TrackState::Confirmed,
        );
        let mut asterix = Asterix::of_source(25, 10);
        // The track was reported before, so this is not its first message.
        asterix.numbers.given.insert(99, 4711);
        let snapshot = Snapshot { site: "s".parse().unwrap(), time, targets: vec![sure] };
        let said = asterix.tracks(&snapshot);
        assert_eq!(
            hex(&said[0]),
            "3E 00 2D 9B 0D 15 04 19 0A 58 78 65 00 86 C2 CE 00 18 4B E0 00 32 FF F3 12 67 \
             2D 01 01 79 80 01 0D 00 2F 35 80 00 03 00 03 02 03 02 0A"
        );
    }

    #[test]
    fn numbers_beyond_their_range_are_held_at_its_end() {
        let far = target(
            [-90.0, 180.0, 99_000.0],
            [1e6, -1e6, f64::INFINITY],
            [1e9, 1e9, 1e9, 1e9, 1e9, 0.0],
            TrackState::Lost,
        );
        let time = Timestamp::from_nanos(1_795_737_599_999_000_000);
        let record = Asterix::of_source(0, 0).record(time, &far);
        assert_eq!(record.len(), RECORD_BYTES);
        assert_eq!(record[6..9], [0, 0, 0], "midnight");
        assert_eq!(record[17..21], [0x7F, 0xFF, 0x80, 0x00]);
        assert_eq!(record[24] & 0x60, 0x60, "its first and last message");
        assert_eq!(record[RECORD_BYTES - 8..], [0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 1]);
    }

    #[test]
    fn many_tracks_are_several_datagrams_and_have_numbers_of_their_own() {
        let mut asterix = Asterix::of_source(1, 2);
        let one = target([0.0; 3], [0.0; 3], [1.0; 6], TrackState::Confirmed);
        let targets = (0..80).map(|id| Target { id, ..one.clone() }).collect();
        let time = Timestamp::from_seconds(1e9);
        let said = asterix.tracks(&Snapshot { site: "s".parse().unwrap(), time, targets });
        assert_eq!(said.iter().map(Vec::len).collect::<Vec<_>>(), [1389, 1389, 591]);
        let numbers: std::collections::BTreeSet<u16> =
            asterix.numbers.given.values().copied().collect();
        assert_eq!((numbers.len(), numbers.first(), numbers.last()), (80, Some(&1), Some(&80)));
        // A lost track's number is not reused for a minute.
        let next = Target { id: 1000, ..one };
        let lost = Target { id: 0, state: TrackState::Lost, ..one };
        asterix.numbers.of(&lost, time);
        assert_eq!(asterix.numbers.of(&next, time.plus_seconds(59.0)), (81, true));
        let later = Target { id: 1001, ..next };
        assert_eq!(asterix.numbers.of(&later, time.plus_seconds(61.0)), (1, true));
    }
}
