//! Industrial cameras: GigE Vision.

use std::net::Ipv4Addr;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crossfix_message::Timestamp;
use viva_genicam::genapi::RegisterIo;
use viva_genicam::gige::{DeviceInfo, Iface};
use viva_genicam::pfnc::PixelFormat;
use viva_genicam::{
    Access, Camera, ControlState, Frame as Block, FrameStream, GenicamError, GigeRegisterIo,
    StreamOptions, blocking,
};

use crate::rtsp::{HostClock, SET_S, StreamClock};
use crate::{
    Arrival, CaptureTime, Frame, FrameSource, Latency, MAX_PIXELS, Packets, Pixels, TimedBy,
    VideoError,
};

/// How long a camera may take to answer: a question that is lost is asked again, and one that nobody
/// answers is given up after four times as long.
const ANSWERED_WITHIN: Duration = Duration::from_millis(100);
/// How long one may take that is asked whether it is there.
const FOUND_WITHIN: Duration = Duration::from_millis(500);
/// How often the camera is asked what its clock shows. Quartzes part by 50 us in a second: with ten times
/// as long the line through the answers would follow a clock that warms up too late.
const ASKED_EVERY: Duration = Duration::from_secs(1);
/// An answer that took less is good enough; else the quickest of so many is.
const QUICK: Duration = Duration::from_millis(1);
const TRIES: usize = 5;
/// A camera's clock that is within this of the host's counts the same time as that; one that counts
/// from when it was switched on is years off.
const SAME_TIME_S: f64 = 2.0;
/// A frame is here within this after the time that the camera's answers make of its stamp, or they are not of
/// the clock that stamps frames, s: the one is half an answer's way, the other a long exposure's.
const POSSIBLE_S: std::ops::Range<f64> = -0.02..1.0;
/// What it takes from the exposure to the arrival where nothing better is known: an image is read out and
/// sent in a frame's interval.
const LATENCY: Latency = Latency { mean_s: 0.04, sd_s: 0.04 };
/// Registers that every camera has, some in name only: how many ticks a second has, the command that notes
/// the time, and what was noted (GigE Vision 2.0, 28).
const TICKS_AT: u64 = 0x93c;
const LATCH_AT: u64 = 0x944;
const LATCHED_AT: u64 = 0x948;
const LATCH: [u8; 4] = 2_u32.to_be_bytes();
/// Names under which cameras have the same where the registers are empty (SFNC, and as it was before 2.3).
const LATCHES: [&str; 3] = ["TimestampLatch", "GevTimestampControlLatch", "TimestampControlLatch"];
const LATCHED: [&str; 3] = ["TimestampLatchValue", "GevTimestampValue", "TimestampValue"];
/// Ticks a second of clocks that do not say.
const NANOSECONDS: f64 = 1e9;
/// The exposure, us; what is longer than a second is none with which anything is followed.
const EXPOSURES: [&str; 2] = ["ExposureTime", "ExposureTimeAbs"];
const LONGEST_US: f64 = 1e6;

/// How a GigE Vision camera is watched.
#[derive(Clone, Debug, PartialEq)]
pub struct GigeOptions {
    /// Where it is.
    pub address: Ipv4Addr,
    /// Columns and rows; as it is set where it is not said.
    pub size: Option<[u32; 2]>,
    /// Frames a second; as it is set where it is not said.
    pub rate_hz: Option<f64>,
    /// From the middle of the exposure to the camera's time, s. Where it is not said, the time is that of
    /// the exposure's start, as in the standard (SFNC, `Timestamp`), and half the exposure is added.
    pub latency_s: Option<f64>,
    /// Standard deviation of its frames' times, s.
    pub sd_s: f64,
}

/// A GigE Vision camera that is opened again and again.
#[derive(Clone, Debug)]
pub struct GigeCamera {
    options: GigeOptions,
}

impl GigeCamera {
    /// A camera that is watched so.
    pub fn new(options: GigeOptions) -> Self {
        Self { options }
    }

    /// Where it is.
    pub fn address(&self) -> String {
        format!("gige://{}", self.options.address)
    }

    /// Takes control of it and asks for its images. `silence` is how long it may send nothing.
    ///
    /// # Errors
    /// [`VideoError::Stream`] if nobody answers, somebody else has control, or it has neither the size nor
    /// images of brightness.
    pub fn open(&self, silence: Duration) -> Result<Box<dyn FrameSource>, VideoError> {
        let source = GigeSource::open(&self.options, &self.address(), silence)?;
        Ok(Box::new(source))
    }
}

/// The GigE Vision cameras that answer a broadcast on this host's networks within a time: their addresses
/// and what they call themselves.
///
/// # Errors
/// What the system says where nothing can be sent.
pub fn gige_cameras(patience: Duration) -> Result<Vec<(Ipv4Addr, String)>, String> {
    let found = blocking::discover(patience).map_err(|error| error.to_string())?;
    let described = |device: &DeviceInfo| {
        let words = [&device.manufacturer, &device.model, &device.serial];
        let words = words.into_iter().flatten().filter(|word| !word.is_empty());
        words.cloned().collect::<Vec<String>>().join(" ")
    };
    Ok(found.iter().map(|device| (device.ip, described(device))).collect())
}

/// Whose time the camera's stamps are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stamps {
    /// Nobody knows yet.
    Unknown,
    /// UTC's: by PTP, or set by somebody.
    Utc,
    /// Its own, that counts from anywhere; this host's by what it answers.
    Own,
    /// Of no clock that it answers for.
    Nobodys,
}

/// A camera's images until it falls silent or is lost.
struct GigeSource {
    /// Dropped before the camera, which sends as long as it is there.
    frames: FrameStream,
    camera: Camera<GigeRegisterIo>,
    options: GigeOptions,
    address: String,
    ticks_hz: f64,
    stamps: Stamps,
    clock: StreamClock,
    host: HostClock,
    asked: Option<Instant>,
    exposure_s: f64,
    silence: Duration,
    is_silent: bool,
    /// The camera's number of the block before, and the number of its frame.
    before: Option<(u64, u64)>,
    /// Frames that were not whole, as far as they were told, ...
    torn: u64,
    /// ... and the one that came after those that were not.
    held: Option<Block>,
}

impl GigeSource {
    fn open(options: &GigeOptions, address: &str, silence: Duration) -> Result<Self, VideoError> {
        let said = |what: String| VideoError::Stream { url: address.to_owned(), what };
        let wrong = |error: GenicamError| said(in_words(&error));
        // Whoever asks for control waits five seconds where nobody is.
        blocking::discover_ip(options.address, FOUND_WITHIN)
            .map_err(wrong)?
            .ok_or_else(|| said("no GigE Vision camera answers there".to_owned()))?;
        let info = DeviceInfo::from_ip(options.address);
        let (mut camera, _) = blocking::connect_as(&info, Access::Control).map_err(wrong)?;
        if let Ok(mut device) = camera.transport().lock_device() {
            device.set_control_timeout(ANSWERED_WITHIN);
        }
        set_up(&mut camera, options).map_err(wrong)?;
        let route = Iface::from_remote_ipv4(options.address);
        let stream = route.map_or_else(|_| StreamOptions::new(), |i| StreamOptions::new().iface(i));
        let frames = camera.open_stream(stream).map_err(wrong)?;
        let ticks_hz = eight_bytes(&camera, TICKS_AT).filter(|hz| *hz > 0);
        let host = HostClock::read();
        camera.acquisition_start().map_err(wrong)?;
        Ok(Self {
            frames,
            camera,
            address: address.to_owned(),
            ticks_hz: ticks_hz.map_or(NANOSECONDS, |hz| hz as f64),
            stamps: Stamps::Unknown,
            clock: stream_clock(host, options.sd_s),
            options: options.clone(),
            host,
            asked: None,
            exposure_s: 0.0,
            silence,
            is_silent: false,
            before: None,
            torn: 0,
            held: None,
        })
    }

    /// Asks, where it is time, what the camera's clock shows and how long it exposes.
    fn ask(&mut self, stamp_s: f64, arrived: Timestamp) {
        let own = Timestamp::from_seconds(stamp_s);
        if self.stamps == Stamps::Unknown {
            let is_utc = own.seconds_since(arrived).abs() < SAME_TIME_S;
            self.stamps = if is_utc { Stamps::Utc } else { Stamps::Own };
        }
        if self.asked.is_some_and(|asked| asked.elapsed() < ASKED_EVERY) {
            return;
        }
        self.asked = Some(Instant::now());
        let mut said_us = EXPOSURES.iter().filter_map(|name| {
            self.camera.invalidate(name);
            self.camera.get_float(name).ok()
        });
        if let Some(exposure_us) = said_us.find(|us| (0.0..LONGEST_US).contains(us)) {
            self.exposure_s = exposure_us * 1e-6;
        }
        match self.stamps {
            Stamps::Utc => self.clock.report(stamp_s, own),
            Stamps::Own => {
                if let Some((ticks, host)) = latched(&mut self.camera) {
                    self.clock.report(ticks as f64 / self.ticks_hz, host);
                }
            }
            Stamps::Unknown | Stamps::Nobodys => {}
        }
    }

    /// When a frame was captured that came then.
    fn timed(&mut self, stamp_s: f64, arrived_s: f64) -> (CaptureTime, TimedBy) {
        let arrived = self.host.at(arrived_s);
        self.ask(stamp_s, arrived);
        let (capture, timed_by) = self.clock.time(stamp_s, arrived_s);
        let age_s = arrived.seconds_since(capture.time);
        match (timed_by, self.stamps) {
            (TimedBy::Camera | TimedBy::ArrivalAgainstCamera { .. }, Stamps::Own)
                if !POSSIBLE_S.contains(&age_s) || timed_by != TimedBy::Camera =>
            {
                self.stamps = Stamps::Nobodys;
                self.clock = stream_clock(self.host, self.options.sd_s);
                self.timed(stamp_s, arrived_s)
            }
            (TimedBy::Camera, Stamps::Own) => (capture, TimedBy::Driver),
            (TimedBy::Arrival, _) => {
                let late = CaptureTime {
                    time: capture.time.plus_seconds(-LATENCY.mean_s),
                    sd_s: LATENCY.sd_s,
                };
                (late, timed_by)
            }
            _ => (capture, timed_by),
        }
    }

    fn frame(&mut self, block: &Block) -> Result<Frame, VideoError> {
        let at = Instant::now();
        let index = self.numbered(block.block_id);
        let pixels = brightness(block).map_err(|what| self.bad(index, what))?;
        let arrived_s = self.host.since_s(at);
        let set_by_s = self.host.set_by_s(&HostClock::read());
        if self.stamps != Stamps::Utc && set_by_s.abs() > SET_S {
            return Err(VideoError::HostClockSet { by_s: set_by_s });
        }
        let stream_s = block.ts_dev.map_or(arrived_s, |ticks| ticks as f64 / self.ticks_hz);
        let (capture, timed_by) = self.timed(stream_s, arrived_s);
        let is_stamped = matches!(timed_by, TimedBy::Camera | TimedBy::Driver);
        let late_s = self.options.latency_s.unwrap_or(-self.exposure_s / 2.0);
        let late_s = if is_stamped { late_s } else { 0.0 };
        let capture = CaptureTime { time: capture.time.plus_seconds(-late_s), ..capture };
        let live = Some(Arrival { at, stream_s, timed_by });
        let (width, height) = (block.width as usize, block.height as usize);
        Ok(Frame { index, capture, live, width, height, pixels: Pixels::Gray8(pixels) })
    }

    fn bad(&self, index: u64, what: String) -> VideoError {
        VideoError::StreamFrame { url: self.address.clone(), index, what }
    }

    /// The number of a block's frame: those that the camera has counted and that never came are left out.
    fn numbered(&mut self, block: u64) -> u64 {
        /// The count of cameras of the first version goes to 65535 and begins again with 1.
        const ROUND: u64 = 0xffff;
        let index = self.before.map_or(0, |(before, index)| {
            let missed = match block.checked_sub(before) {
                Some(steps) => steps,
                None if before <= ROUND => block + ROUND - before,
                None => 1,
            };
            index + missed.clamp(1, ROUND)
        });
        self.before = Some((block, index));
        index
    }
}

impl FrameSource for GigeSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        let next = match self.held.take() {
            Some(block) => Ok(Some(block)),
            None => self.frames.next_frame_blocking(self.silence),
        };
        self.is_silent = matches!(next, Err(GenicamError::Timeout(_)));
        let torn = self.frames.stats().frames_incomplete;
        if torn > self.torn && matches!(next, Ok(Some(_))) {
            // Of those that were not whole, one after the other is told before the next that is.
            self.torn += 1;
            self.held = next.ok().flatten();
            let index = self.before.map_or(0, |(_, index)| index + 1);
            return Err(self.bad(index, "packets were lost on the way".to_owned()));
        }
        let wrong = |what: String| VideoError::Stream { url: self.address.clone(), what };
        match next {
            Ok(Some(_)) if self.camera.transport().control_state() != ControlState::Held => {
                Err(wrong("another program has taken control of it".to_owned()))
            }
            Ok(Some(block)) => self.frame(&block).map(Some),
            Ok(None) => Ok(None),
            Err(GenicamError::Timeout(_)) => Err(VideoError::Silent {
                url: self.address.clone(),
                seconds: self.silence.as_secs_f64(),
            }),
            Err(error) => Err(wrong(in_words(&error))),
        }
    }

    fn packets(&self) -> Packets {
        let stats = self.frames.stats();
        Packets { lost: stats.packets_missing, recovered: stats.resend_recovered }
    }
}

impl Drop for GigeSource {
    fn drop(&mut self) {
        // Control is given back when the camera is dropped; one that is gone is not waited for.
        if !self.is_silent && self.camera.transport().control_state() == ControlState::Held {
            let _ = self.camera.acquisition_stop();
        }
    }
}

/// The clock of stamps; what they are late by is known better than that.
fn stream_clock(host: HostClock, sd_s: f64) -> StreamClock {
    StreamClock::of_asked(host, Latency { mean_s: 0.0, sd_s })
}

/// Images of brightness, one after another, of the size and at the rate.
fn set_up(camera: &mut Camera<GigeRegisterIo>, options: &GigeOptions) -> Result<(), GenicamError> {
    // Whoever watched before may have left it in any state; what a camera has not, it cannot be left in.
    let _ = camera.acquisition_stop();
    let _ = camera.set_acquisition_mode("Continuous");
    let _ = camera.disable_trigger("FrameStart");
    camera.set_enum("PixelFormat", "Mono8")?;
    if let Some([width, height]) = options.size {
        for offset in ["OffsetX", "OffsetY"] {
            let _ = camera.set_integer(offset, 0);
        }
        for (name, side) in [("Width", width), ("Height", height)] {
            if camera.get_integer(name)? != i64::from(side) {
                camera.set_integer(name, i64::from(side))?;
            }
        }
    }
    if let Some(rate_hz) = options.rate_hz {
        camera.set_frame_rate(rate_hz)?;
    }
    Ok(())
}

/// A number of eight bytes among the registers.
fn eight_bytes(camera: &Camera<GigeRegisterIo>, at: u64) -> Option<u64> {
    let bytes = camera.transport().read(at, 8).ok()?;
    Some(u64::from_be_bytes(bytes.try_into().ok()?))
}

/// What the camera's clock shows, in ticks, and this host's at the same time: in the middle of a question
/// and its answer, which is off by half of what they took at most. The quickest of some.
fn latched(camera: &mut Camera<GigeRegisterIo>) -> Option<(u64, Timestamp)> {
    let mut quickest: Option<(Duration, u64, Timestamp)> = None;
    for _ in 0..TRIES {
        let (took, ticks, asked) = latch(camera)?;
        if quickest.is_none_or(|(before, ..)| took < before) {
            let asked = Timestamp::from_nanos(i64::try_from(asked.as_nanos()).ok()?);
            quickest = Some((took, ticks, asked));
        }
        if took < QUICK {
            break;
        }
    }
    quickest.map(|(_, ticks, asked)| (ticks, asked))
}

/// One question: what it took, the ticks, and the time since the Unix epoch.
fn latch(camera: &mut Camera<GigeRegisterIo>) -> Option<(Duration, u64, Duration)> {
    let (before, sent) = (SystemTime::now().duration_since(UNIX_EPOCH).ok()?, Instant::now());
    let noted = camera.transport().write(LATCH_AT, &LATCH).ok().map(|()| sent.elapsed());
    let by_register = noted.and_then(|took| {
        let ticks = eight_bytes(camera, LATCHED_AT).filter(|ticks| *ticks != 0);
        Some((took, ticks?, before + took / 2))
    });
    by_register.or_else(|| latch_by_name(camera))
}

/// The same of cameras that have it under a name alone.
fn latch_by_name(camera: &mut Camera<GigeRegisterIo>) -> Option<(Duration, u64, Duration)> {
    let there = |name: &&&str| camera.nodemap().node(name).is_some();
    let (command, value) = (LATCHES.iter().find(there)?, LATCHED.iter().find(there)?);
    let (before, sent) = (SystemTime::now().duration_since(UNIX_EPOCH).ok()?, Instant::now());
    camera.execute_command(command).ok()?;
    let took = sent.elapsed();
    camera.invalidate(value);
    Some((took, u64::try_from(camera.get_integer(value).ok()?).ok()?, before + took / 2))
}

/// A block's pixels without what its rows are filled up with.
fn brightness(block: &Block) -> Result<Vec<u8>, String> {
    let (width, height) = (block.width as usize, block.height as usize);
    if block.pixel_format != PixelFormat::Mono8 {
        return Err(format!("its pixels are {} and not Mono8", block.pixel_format));
    }
    if width == 0 || (width as u64) * (height as u64) > MAX_PIXELS {
        return Err(format!("{width}x{height} is no size of an image"));
    }
    let stride = width + usize::from(block.padding_x);
    let rows = block.payload.chunks(stride).filter(|row| row.len() >= width).take(height);
    let pixels: Vec<u8> = rows.flat_map(|row| &row[..width]).copied().collect();
    if pixels.len() != width * height {
        return Err(format!("{} bytes for {width}x{height}", block.payload.len()));
    }
    Ok(pixels)
}

/// An error as people read it, with what caused it.
fn in_words(error: &GenicamError) -> String {
    let mut words = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(error) = cause {
        let text = error.to_string();
        if !words.contains(&text) {
            words = format!("{words}: {text}");
        }
        cause = error.source();
    }
    words
}
