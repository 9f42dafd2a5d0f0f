//! Industrial cameras (GigE Vision).

mod clock;
mod connection;
mod description;

use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

use crossfix_message::Timestamp;
use tokio::runtime::Runtime;
use viva_genicam::gige::{DeviceInfo, Iface};
use viva_genicam::pfnc::PixelFormat;
use viva_genicam::{
    Camera, ControlState, Frame as Block, FrameStream, GenicamError, GigeRegisterIo, StreamOptions,
    blocking,
};

use self::clock::{ClockAnswer, TICKS_AT, eight_bytes, follows_another, latched};
use self::connection::{ControlledCamera, in_words};
use crate::stream_clock::{HostClock, StreamClock};
use crate::{
    Arrival, CaptureTime, Frame, FrameSource, Losses, MOST_PIXELS, Pixels, StreamLatency, TimedBy,
    VideoError,
};

/// How long a camera may take to answer: a lost question is asked again, and one without an answer
/// is given up after four times as long. With half of it a camera that is busy for 60 ms is asked
/// twice.
const ANSWERED_WITHIN: Duration = Duration::from_millis(100);
/// How long a camera may take to say that it is there. With half of it one that takes 0.3 s would
/// seem absent.
const FOUND_WITHIN: Duration = Duration::from_millis(500);
/// How often the camera is asked what its clock shows. Quartz clocks drift apart by 50 us in a
/// second: with ten times as long between questions, the line through the answers would follow a
/// clock that warms up too late. With half of it frames wait twice as often for an answer.
const ASKED_EVERY: Duration = Duration::from_secs(1);
/// Interval for a camera that does not answer: with half of it frames wait twice as often in vain.
const ASKED_AGAIN: Duration = Duration::from_secs(10);
/// This host's clock was set if it moved by more than answers err by, s: earlier answers are then
/// invalid. With half of it a step as small as an answer's error would reopen the camera.
const HOST_SET_S: f64 = 0.02;
/// A camera's clock within this of the host's is assumed to show the same time, s; one that counts
/// from when the camera was switched on is years off. With half of it the same.
const SAME_TIME_S: f64 = 2.0;
/// Possible times from a frame's stamp to its arrival, s: outside, the answers are of another
/// clock. The lower end allows for half an answer's duration, the upper for a long exposure. With
/// half of both, frames of slow answers or long exposures count as impossible.
const POSSIBLE_S: std::ops::Range<f64> = -0.02..1.0;
/// After this many impossible frames in a row the stamps are not believed: a stall holds back only
/// sixteen. With half of it a stall would end the use of good stamps.
const IMPOSSIBLE: u32 = 20;
/// Latency from the exposure to the arrival where nothing better is known: an image is read out and
/// sent within a frame's interval. With half of it times by arrival are 20 ms later.
const LATENCY: StreamLatency = StreamLatency { mean_s: 0.04, sd_s: 0.04 };
/// Ticks per second of clocks that do not say: they count nanoseconds (GigE Vision 2.0). With half
/// of it times would advance twice as fast.
const NANOSECONDS: f64 = 1e9;
/// Names of the exposure time, us.
const EXPOSURES: [&str; 2] = ["ExposureTime", "ExposureTimeAbs"];
/// Longest exposure, us; a longer one is ignored: nothing is followed with it. With half of it the
/// same for exposures at two frames per second and more.
const LONGEST_US: f64 = 1e6;

/// Options for watching a GigE Vision camera.
#[derive(Clone, Debug, PartialEq)]
pub struct GigeOptions {
    /// Its address.
    pub address: Ipv4Addr,
    /// Columns and rows; if `None`, the size that it is set to.
    pub size: Option<[u32; 2]>,
    /// Frames per second; if `None`, the rate that it is set to.
    pub rate_hz: Option<f64>,
    /// Time from the middle of the exposure to the camera's time stamp, s. If `None`, the stamp is
    /// used as the start of the exposure, as in the standard (SFNC, `Timestamp`), and half the
    /// exposure is added.
    pub latency_s: Option<f64>,
    /// Standard deviation of its frames' times, s.
    pub sd_s: f64,
    /// Whether its stamps are believed; otherwise frames are timed by their arrival.
    pub heeds_stamps: bool,
}

/// A GigE Vision camera that can be opened again and again.
#[derive(Clone, Debug)]
pub struct GigeCamera {
    options: GigeOptions,
}

impl GigeCamera {
    /// A camera that is watched with these options.
    pub fn new(options: GigeOptions) -> Self {
        Self { options }
    }

    /// Its address.
    pub fn address(&self) -> String {
        format!("gige://{}", self.options.address)
    }

    /// Takes control of it and asks for its images. `silence` is how long it may send nothing
    /// before that is an error.
    ///
    /// # Errors
    /// [`VideoError::Stream`] if nobody answers, another program has control, or it does not have
    /// the size or images of brightness.
    pub fn open(&self, silence: Duration) -> Result<Box<dyn FrameSource>, VideoError> {
        let source = GigeSource::open(&self.options, &self.address(), silence)?;
        Ok(Box::new(source))
    }
}

/// The GigE Vision cameras that answer a broadcast on this host's networks within a time: their
/// addresses and the names that they report.
///
/// # Errors
/// What the system says where nothing can be sent.
pub fn gige_cameras(patience: Duration) -> Result<Vec<(Ipv4Addr, String)>, String> {
    let found = blocking::discover(patience).map_err(|error| error.to_string())?;
    Ok(found.iter().map(|device| (device.ip, name_of(device))).collect())
}

fn name_of(device: &DeviceInfo) -> String {
    let words = [&device.manufacturer, &device.model, &device.serial];
    let words = words.into_iter().flatten().filter(|word| !word.is_empty());
    words.cloned().collect::<Vec<String>>().join(" ")
}

/// Which time the camera's stamps are in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stamps {
    /// UTC: its clock follows another by PTP, or it cannot be asked and shows this host's time.
    Utc,
    /// The camera's own clock with any origin; its answers relate it to this host's time.
    Own,
    /// A clock that it does not answer for, or one that is not to be believed.
    Nobodys,
}

/// A camera's images until it falls silent or is lost.
struct GigeSource {
    /// Must be dropped before the camera, which sends as long as it is there.
    frames: FrameStream,
    camera: Camera<GigeRegisterIo>,
    /// Serves the camera's socket: must be dropped after the camera.
    _runtime: Runtime,
    options: GigeOptions,
    address: String,
    ticks_hz: f64,
    /// `None` until the first frame of a camera that cannot be asked.
    stamps: Option<Stamps>,
    clock: StreamClock,
    host: HostClock,
    ask_at: Instant,
    /// Bound on the last answer's error, s; used as its standard deviation.
    answer_sd_s: f64,
    /// Whether any frame was possible by its stamp, and how many impossible ones came since.
    is_proven: bool,
    impossible: u32,
    exposure_s: f64,
    silence: Duration,
    is_silent: bool,
    before: Option<NumberedBlock>,
    /// Number of incomplete frames reported so far, ...
    torn: u64,
    /// ... and the complete frame that came after them, until they are reported.
    postponed: Option<Block>,
}

/// A block of the stream, by its numbers.
#[derive(Clone, Copy, Debug)]
struct NumberedBlock {
    /// The camera's number of it.
    block: u64,
    /// The number of its frame.
    index: u64,
}

impl GigeSource {
    fn open(options: &GigeOptions, address: &str, silence: Duration) -> Result<Self, VideoError> {
        let said = |what: String| VideoError::Stream { url: address.to_owned(), what };
        let wrong = |error: GenicamError| said(in_words(&error));
        // Asking for control waits five seconds if nobody is there, so presence is checked first.
        blocking::discover_ip(options.address, FOUND_WITHIN)
            .map_err(wrong)?
            .ok_or_else(|| said("no GigE Vision camera answers there".to_owned()))?;
        // Where something is wrong, they are dropped from the last to the first.
        let ControlledCamera { runtime, mut camera } =
            ControlledCamera::open(options.address).map_err(said)?;
        if let Ok(mut device) = camera.transport().lock_device() {
            device.set_control_timeout(ANSWERED_WITHIN);
        }
        set_up(&mut camera, options).map_err(wrong)?;
        let route = Iface::from_remote_ipv4(options.address);
        let stream = route.map_or_else(|_| StreamOptions::new(), |i| StreamOptions::new().iface(i));
        let frames = camera.open_stream(stream).map_err(wrong)?;
        let ticks_hz = eight_bytes(&camera, TICKS_AT).filter(|hz| *hz > 0);
        let host = HostClock::read();
        let mut source = Self {
            frames,
            camera,
            _runtime: runtime,
            address: address.to_owned(),
            ticks_hz: ticks_hz.map_or(NANOSECONDS, |hz| hz as f64),
            stamps: (!options.heeds_stamps).then_some(Stamps::Nobodys),
            clock: StreamClock::of_asked(host, LATENCY),
            options: options.clone(),
            host,
            ask_at: Instant::now(),
            answer_sd_s: 0.0,
            is_proven: false,
            impossible: 0,
            exposure_s: 0.0,
            silence,
            is_silent: false,
            before: None,
            torn: 0,
            postponed: None,
        };
        source.ask();
        source.camera.acquisition_start().map_err(wrong)?;
        Ok(source)
    }

    /// Asks for the camera's clock and exposure. This waits for the answer: only between frames.
    fn ask(&mut self) {
        let mut said_us = EXPOSURES.iter().filter_map(|name| {
            self.camera.invalidate(name);
            self.camera.get_float(name).ok()
        });
        if let Some(exposure_us) = said_us.find(|us| (0.0..LONGEST_US).contains(us)) {
            self.exposure_s = exposure_us * 1e-6;
        }
        self.ask_at = Instant::now() + ASKED_EVERY;
        if self.stamps.is_none() && follows_another(&mut self.camera) {
            self.stamps = Some(Stamps::Utc);
        }
        if !matches!(self.stamps, None | Some(Stamps::Own)) {
            return;
        }
        match latched(&mut self.camera) {
            Some(ClockAnswer { ticks, at, took }) => {
                self.stamps = Some(Stamps::Own);
                self.answer_sd_s = took.as_secs_f64() / 2.0;
                let shown = self.host.at(self.host.since_s(at));
                self.clock.report(ticks as f64 / self.ticks_hz, shown);
            }
            None => self.ask_at = Instant::now() + ASKED_AGAIN,
        }
    }

    /// When a frame with a stamp and an arrival was captured, and by whose clock; both times in s.
    fn timed(&mut self, stamp_s: f64, arrived_s: f64) -> (CaptureTime, TimedBy) {
        let arrived = self.host.at(arrived_s);
        let own = Timestamp::from_seconds(stamp_s);
        let stamps = *self.stamps.get_or_insert_with(|| {
            let shows_ours = own.seconds_since(arrived).abs() < SAME_TIME_S;
            if shows_ours { Stamps::Utc } else { Stamps::Nobodys }
        });
        if stamps == Stamps::Utc {
            self.clock.report(stamp_s, own);
        }
        let (capture, timed_by) = self.clock.time(stamp_s, arrived_s);
        let by_arrival =
            CaptureTime { time: arrived.plus_seconds(-LATENCY.mean_s), sd_s: LATENCY.sd_s };
        if timed_by != TimedBy::Camera {
            return (by_arrival, timed_by);
        }
        let stamped = CaptureTime {
            // time = stamp + exposure / 2, or stamp - latency if that is given; variances add
            time: capture.time.plus_seconds(self.exposure_s / 2.0),
            sd_s: self.options.sd_s.hypot(self.answer_sd_s),
        };
        let stamped = match self.options.latency_s {
            Some(late_s) => CaptureTime { time: capture.time.plus_seconds(-late_s), ..stamped },
            None => stamped,
        };
        if stamps == Stamps::Utc {
            return (stamped, TimedBy::Camera);
        }
        let age_s = arrived.seconds_since(capture.time);
        if POSSIBLE_S.contains(&age_s) {
            (self.is_proven, self.impossible) = (true, 0);
            return (stamped, TimedBy::Driver);
        }
        self.impossible += 1;
        if self.impossible >= IMPOSSIBLE {
            self.stamps = Some(Stamps::Nobodys);
            self.clock = StreamClock::of_asked(self.host, LATENCY);
        }
        // A frame that a stall held back is late, but its stamp is as good as ever.
        let is_late = self.is_proven && age_s > 0.0;
        if is_late { (stamped, TimedBy::Driver) } else { (by_arrival, TimedBy::Arrival) }
    }

    fn frame(&mut self, block: &Block) -> Result<Frame, VideoError> {
        let at = Instant::now();
        let index = self.numbered(block.block_id);
        let pixels = brightness(block).map_err(|what| self.bad(index, what))?;
        let set_by_s = self.host.set_by_s(&HostClock::read());
        if self.stamps != Some(Stamps::Utc) && set_by_s.abs() > HOST_SET_S {
            return Err(VideoError::HostClockSet { by_s: set_by_s });
        }
        let arrived_s = self.host.since_s(at);
        let stream_s = block.ts_dev.map_or(arrived_s, |ticks| ticks as f64 / self.ticks_hz);
        let (capture, timed_by) = self.timed(stream_s, arrived_s);
        let live = Some(Arrival { at, stream_s, timed_by });
        let (width, height) = (block.width as usize, block.height as usize);
        Ok(Frame { index, capture, live, width, height, pixels: Pixels::Gray8(pixels) })
    }

    fn bad(&self, index: u64, what: String) -> VideoError {
        VideoError::StreamFrame { url: self.address.clone(), index, what }
    }

    /// The number of a block's frame; those of frames that never came are left out.
    fn numbered(&mut self, block: u64) -> u64 {
        /// Cameras of the first version count to 65535 and then start again from 1. With half of it
        /// frames that are lost where the count starts again would not be counted.
        const ROUND: u64 = 0xffff;
        let index = self.before.map_or(0, |before| {
            let is_round = block < ROUND / 2 && (ROUND / 2..=ROUND).contains(&before.block);
            let steps = match block.checked_sub(before.block) {
                Some(steps) => steps,
                None if is_round => block + ROUND - before.block,
                // The camera's count has started again from elsewhere.
                None => 1,
            };
            before.index + steps.clamp(1, ROUND)
        });
        self.before = Some(NumberedBlock { block, index });
        index
    }

    /// Reports each incomplete frame once.
    fn torn(&mut self) -> Option<VideoError> {
        let torn = self.frames.stats().frames_incomplete;
        (torn > self.torn).then(|| {
            self.torn += 1;
            let index = self.before.map_or(0, |before| before.index + 1);
            self.bad(index, "packets were lost on the way".to_owned())
        })
    }
}

impl FrameSource for GigeSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        if Instant::now() >= self.ask_at {
            self.ask();
        }
        let next = match self.postponed.take() {
            Some(block) => Ok(Some(block)),
            None => self.frames.next_frame_blocking(self.silence),
        };
        self.is_silent = matches!(next, Err(GenicamError::Timeout(_)));
        if let Some(torn) = self.torn() {
            // Incomplete frames are reported one by one before the next complete one is handed on.
            self.postponed = next.ok().flatten();
            return Err(torn);
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

    fn losses(&self) -> Losses {
        let stats = self.frames.stats();
        Losses {
            packets_lost: stats.packets_missing,
            packets_recovered: stats.resend_recovered,
            frames_left_out: stats.frames_backpressure,
        }
    }
}

impl Drop for GigeSource {
    fn drop(&mut self) {
        // Dropping the camera gives control back; one that is gone is not waited for.
        if !self.is_silent && self.camera.transport().control_state() == ControlState::Held {
            let _ = self.camera.acquisition_stop();
        }
    }
}

/// Sets the camera to continuous images of brightness, of the requested size and rate.
fn set_up(camera: &mut Camera<GigeRegisterIo>, options: &GigeOptions) -> Result<(), GenicamError> {
    // An earlier user may have left it in any state. Errors are ignored: a feature that the camera
    // lacks cannot be in a wrong state.
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

/// A block's pixels without the padding of its rows.
fn brightness(block: &Block) -> Result<Vec<u8>, String> {
    let (width, height) = (block.width as usize, block.height as usize);
    if block.pixel_format != PixelFormat::Mono8 {
        return Err(format!("its pixels are {} and not Mono8", block.pixel_format));
    }
    if width == 0 || (width as u64) * (height as u64) > MOST_PIXELS {
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
