//! What a GigE Vision camera's clock shows: questions and answers.

use std::time::{Duration, Instant};

use viva_genicam::genapi::RegisterIo;
use viva_genicam::{Camera, GigeRegisterIo};

/// An answer that took less than this is good enough: it may be off by half of it. With half of it
/// the camera is asked three times where it answers in 0.7 ms.
const QUICK: Duration = Duration::from_millis(1);
/// An answer that took more than this is discarded: it may be off by half of it. With half of it a
/// camera that answers in 15 ms is timed by its arrivals.
const SLOW: Duration = Duration::from_millis(20);
/// Number of questions of whose answers the quickest is used, where none is quick. With half of it
/// one delayed answer is used as it is.
const TRIES: usize = 3;
/// Names of the feature that says whether the camera's clock follows another by PTP.
const PTP: [&str; 2] = ["PtpStatus", "GevIEEE1588Status"];
/// Value of that feature if it does.
const FOLLOWS: &str = "Slave";
/// Register of the clock's ticks per second, which every camera has, some in name only (GigE Vision
/// 2.0, 28).
pub(super) const TICKS_AT: u64 = 0x93c;
/// Register of the command that latches the time.
const LATCH_AT: u64 = 0x944;
/// Register of the latched time.
const LATCHED_AT: u64 = 0x948;
/// The command that latches the time.
const LATCH: [u8; 4] = 2_u32.to_be_bytes();
/// Names of that command for cameras whose registers are empty (SFNC, and its names before 2.3).
const LATCHES: [&str; 3] = ["TimestampLatch", "GevTimestampControlLatch", "TimestampControlLatch"];
/// Names of the latched time for such cameras.
const LATCHED: [&str; 3] = ["TimestampLatchValue", "GevTimestampValue", "TimestampValue"];

/// The eight-byte number in the registers at an address.
pub(super) fn eight_bytes(camera: &Camera<GigeRegisterIo>, at: u64) -> Option<u64> {
    let bytes = camera.transport().read(at, 8).ok()?;
    Some(u64::from_be_bytes(bytes.try_into().ok()?))
}

/// The camera's clock when it was asked.
pub(super) struct ClockAnswer {
    pub(super) ticks: u64,
    /// Midway between the question and its answer: off by half of their distance at most.
    pub(super) at: Instant,
    pub(super) took: Duration,
}

/// The quickest of several answers; `None` if the camera gives none, or none that is quick enough.
pub(super) fn latched(camera: &mut Camera<GigeRegisterIo>) -> Option<ClockAnswer> {
    let mut quickest: Option<ClockAnswer> = None;
    for _ in 0..TRIES {
        let answer = latch(camera)?;
        let took = answer.took;
        if quickest.as_ref().is_none_or(|before| took < before.took) {
            quickest = Some(answer);
        }
        if took < QUICK {
            break;
        }
    }
    quickest.filter(|answer| answer.took < SLOW)
}

/// Asks once, by the registers.
fn latch(camera: &mut Camera<GigeRegisterIo>) -> Option<ClockAnswer> {
    let sent = Instant::now();
    let noted = camera.transport().write(LATCH_AT, &LATCH).ok().map(|()| sent.elapsed());
    let by_register = noted.and_then(|took| {
        let ticks = eight_bytes(camera, LATCHED_AT).filter(|ticks| *ticks != 0)?;
        Some(ClockAnswer { ticks, at: sent + took / 2, took })
    });
    by_register.or_else(|| latch_by_name(camera))
}

/// The same for cameras that have the command under a name only.
fn latch_by_name(camera: &mut Camera<GigeRegisterIo>) -> Option<ClockAnswer> {
    let there = |name: &&&str| camera.nodemap().node(name).is_some();
    let (command, value) = (LATCHES.iter().find(there)?, LATCHED.iter().find(there)?);
    let sent = Instant::now();
    camera.execute_command(command).ok()?;
    let took = sent.elapsed();
    camera.invalidate(value);
    let ticks = u64::try_from(camera.get_integer(value).ok()?).ok()?;
    Some(ClockAnswer { ticks, at: sent + took / 2, took })
}

/// Whether the camera's clock follows another by PTP.
pub(super) fn follows_another(camera: &mut Camera<GigeRegisterIo>) -> bool {
    PTP.iter().any(|name| {
        camera.invalidate(name);
        camera.get_enum(name).is_ok_and(|status| status == FOLLOWS)
    })
}
