//! Cameras of this host on Linux: Video4Linux, version 2.

use std::os::fd::AsRawFd;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crossfix_message::Timestamp;
use linux_video::types::{
    BufferType, CapabilityFlag, CaptureParm, ContentType, FourCc, In, Mmap, PixFormat,
};
use linux_video::{Device, Stream};
use nix::errno::Errno;
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::poll::{PollFd, PollFlags, poll};
use nix::time::{ClockId, clock_gettime};

use super::UsbOptions;
use crate::{
    Arrival, CaptureTime, Frame, FrameSource, Pixels, Still, TimedBy, VideoError, decode_still,
};

/// Number of buffers that the driver fills in turn: with one it could not fill the next while this
/// one is read. With half of it a program that is late by one interval loses a frame.
const BUFFERS: usize = 4;
/// Pixel formats that are read, in order of preference: those without loss first. A camera that has
/// none of them is refused.
const FORMATS: [FourCc; 3] = [FourCc::Grey, FourCc::Yuyv, FourCc::Mjpeg];
/// Frame rate that is requested to get all frames, Hz: drivers take the nearest that they have.
/// With half of it the same for cameras below 500 Hz.
const FASTEST_HZ: f64 = 1000.0;
/// Least share of the requested rate that counts as that rate: 29.97 is 30. With half of it a
/// format with 15 frames per second would be chosen where 30 are requested.
const LEAST_RATE: f64 = 0.97;

/// Some of the flags of a buffer (videodev2.h), and what they are if a condition is true.
#[derive(Clone, Copy)]
struct FlagField {
    mask: u32,
    value: u32,
}

/// Flag of a buffer that is damaged (videodev2.h: `V4L2_BUF_FLAG_ERROR`).
const DAMAGED: u32 = 0x40;
/// The buffer's time is by `CLOCK_MONOTONIC`.
const MONOTONIC: FlagField = FlagField { mask: 0xe000, value: 0x2000 };
/// The buffer's time is that of the start of the exposure, and not of the frame's end.
const START_OF_EXPOSURE: FlagField = FlagField { mask: 0x7_0000, value: 0x1_0000 };

/// The frames of a camera of this host, until it is unplugged or falls silent.
///
/// Their times are the driver's, by this host's clock.
pub(super) struct UsbSource {
    options: UsbOptions,
    device: Device,
    stream: Stream<In, Mmap>,
    format: PixFormat,
    interval_s: f64,
    silence: Duration,
    last: Instant,
    /// The driver's sequence number of the first frame.
    first: Option<u32>,
}

impl UsbSource {
    pub(super) fn open(options: &UsbOptions, silence: Duration) -> Result<Self, VideoError> {
        let failed =
            |what: String| VideoError::Stream { url: options.device.display().to_string(), what };
        let device = Device::open(&options.device).map_err(|error| failed(opening(&error)))?;
        let (format, interval_s) = choose(&device, options).map_err(failed)?;
        // A read must not block, so that silence can be reported.
        fcntl(device.as_raw_fd(), FcntlArg::F_SETFL(OFlag::O_NONBLOCK))
            .map_err(|error| failed(error.to_string()))?;
        let stream = device
            .stream::<In, Mmap>(ContentType::Video, BUFFERS)
            .map_err(|error| failed(opening(&error)))?;
        let (options, last) = (options.clone(), Instant::now());
        Ok(Self { options, device, stream, format, interval_s, silence, last, first: None })
    }

    fn failed(&self, what: String) -> VideoError {
        VideoError::Stream { url: self.options.device.display().to_string(), what }
    }

    /// Waits until a frame may be there.
    fn wait(&self) -> Result<(), VideoError> {
        let left = self.silence.saturating_sub(self.last.elapsed());
        if left.is_zero() {
            return Err(VideoError::Silent {
                url: self.options.device.display().to_string(),
                seconds: self.last.elapsed().as_secs_f64(),
            });
        }
        let mut waited = [PollFd::new(self.device.as_raw_fd(), PollFlags::POLLIN)];
        let milliseconds = i32::try_from(left.as_millis()).unwrap_or(i32::MAX).max(1);
        match poll(&mut waited, milliseconds) {
            Ok(_) | Err(Errno::EINTR) => {}
            Err(error) => return Err(self.failed(error.to_string())),
        }
        let gone = PollFlags::POLLERR | PollFlags::POLLHUP | PollFlags::POLLNVAL;
        match waited[0].revents() {
            Some(happened) if happened.intersects(gone) => {
                Err(self.failed("it was unplugged, or has stopped".to_owned()))
            }
            _ => Ok(()),
        }
    }

    /// The frame in a filled buffer.
    fn take(&mut self, filled: &Filled<'_>) -> Result<Frame, VideoError> {
        self.last = Instant::now();
        let index =
            u64::from(filled.sequence.wrapping_sub(*self.first.get_or_insert(filled.sequence)));
        let bad =
            |what: String| VideoError::Frame { path: self.options.device.clone(), index, what };
        if filled.flags & DAMAGED != 0 {
            return Err(bad("the driver says that it is damaged".to_owned()));
        }
        let [width, height] = [self.format.width(), self.format.height()].map(|side| side as usize);
        let pixels = pixels(&self.format, filled.bytes).map_err(bad)?;
        let (capture, stream_s) = self.capture(filled);
        Ok(Frame {
            index,
            capture,
            live: Some(Arrival { at: self.last, stream_s, timed_by: TimedBy::Driver }),
            width,
            height,
            pixels,
        })
    }

    /// When a frame was captured, and the driver's time of it, s.
    fn capture(&self, filled: &Filled<'_>) -> (CaptureTime, f64) {
        let is = |field: FlagField| filled.flags & field.mask == field.value;
        let wall_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
        let now_s = clock_gettime(ClockId::CLOCK_MONOTONIC)
            .map_or(0.0, |now| Duration::from(now).as_secs_f64());
        // If the driver stamps by an unknown clock, the frame counts as stamped now, on its
        // arrival.
        let stamped_s = if is(MONOTONIC) { filled.time.as_secs_f64() } else { now_s };
        let usual_s = if is(START_OF_EXPOSURE) { 0.0 } else { self.interval_s / 2.0 };
        let before_s = now_s - stamped_s + self.options.latency_s.unwrap_or(usual_s);
        // capture time = now - (now - stamp) - latency, with `now` by both clocks
        let time = Timestamp::from_seconds(wall_s).plus_seconds(-before_s);
        (CaptureTime { time, sd_s: self.options.sd_s }, stamped_s)
    }
}

impl FrameSource for UsbSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        loop {
            match self.stream.next() {
                Ok(buffer) => {
                    let data = buffer.lock();
                    let header: &linux_video::types::Buffer = &data;
                    let filled = Filled {
                        sequence: header.sequence(),
                        flags: header.flags().bits(),
                        time: header.timestamp(),
                        bytes: data.as_ref(),
                    };
                    return self.take(&filled).map(Some);
                }
                Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => self.wait()?,
                Err(error) => return Err(self.failed(opening(&error))),
            }
        }
    }
}

/// What the driver says of a buffer, and its contents.
struct Filled<'a> {
    sequence: u32,
    flags: u32,
    time: Duration,
    bytes: &'a [u8],
}

/// Why a device cannot be opened, with a remedy.
fn opening(error: &std::io::Error) -> String {
    match error.kind() {
        std::io::ErrorKind::NotFound => "there is no such device: is the camera plugged in?".into(),
        std::io::ErrorKind::PermissionDenied => {
            "this user may not watch it: `sudo usermod -aG video $USER`, and log in again".into()
        }
        std::io::ErrorKind::ResourceBusy => "another program is watching it".into(),
        _ if error.raw_os_error() == Some(Errno::ENODEV as i32) => "it was unplugged".into(),
        _ => error.to_string(),
    }
}

/// Sets the camera to the requested size, in the first format that has the requested rate. If no
/// rate is requested, the format with the highest rate is chosen. Returns the format and the
/// interval between frames, s.
fn choose(device: &Device, options: &UsbOptions) -> Result<(PixFormat, f64), String> {
    let size = match options.size {
        Some(size) => size,
        None => size_of(device).map_err(|error| opening(&error))?,
    };
    let mut best: Option<(FourCc, f64)> = None;
    let mut others = Vec::new();
    for wanted in FORMATS {
        let Some((format, interval_s)) =
            set(device, size, options.rate_hz, wanted).map_err(|error| opening(&error))?
        else {
            continue;
        };
        if [format.width(), format.height()] != size {
            others.push(format!("{}x{}", format.width(), format.height()));
            continue;
        }
        let has_rate =
            options.rate_hz.is_some_and(|rate_hz| rate_hz * LEAST_RATE * interval_s <= 1.0);
        if has_rate {
            return Ok((format, interval_s));
        }
        if best.is_none_or(|(_, least_s)| interval_s < least_s) {
            best = Some((wanted, interval_s));
        }
    }
    let [width, height] = size;
    let (wanted, interval_s) = best.ok_or_else(|| match others.first() {
        Some(other) => format!("it has no images of {width}x{height}; next to that it has {other}"),
        None => "it has no images in a format that is read: GREY, YUYV or MJPG".to_owned(),
    })?;
    if let Some(rate_hz) = options.rate_hz {
        return Err(format!(
            "it has {:.1} images of {width}x{height} a second at most, and not {rate_hz}",
            1.0 / interval_s
        ));
    }
    let set = set(device, size, options.rate_hz, wanted).map_err(|error| opening(&error))?;
    set.ok_or_else(|| "it does not keep to a format".to_owned())
}

/// The size that the camera is set to at present.
fn size_of(device: &Device) -> std::io::Result<[u32; 2]> {
    let format = device.format(BufferType::VideoCapture)?;
    Ok(format.try_ref::<PixFormat>().map_or([0, 0], |now| [now.width(), now.height()]))
}

/// Devices that capture, sorted by path, each with the name that it reports.
pub(super) fn cameras() -> Vec<(PathBuf, String)> {
    let devices = Device::list().into_iter().flatten().filter_map(Result::ok);
    let named = devices.filter_map(|path| name_of(&path).map(|name| (path, name)));
    let mut cameras: Vec<(PathBuf, String)> = named.collect();
    cameras.sort();
    cameras
}

/// The name that a device reports; `None` if it does not capture.
fn name_of(path: &Path) -> Option<String> {
    let capability = Device::open(path).ok()?.capabilities().ok()?;
    let can = capability.device_capabilities();
    let captures =
        can.contains(CapabilityFlag::VideoCapture) && can.contains(CapabilityFlag::Streaming);
    captures.then(|| capability.card().to_owned())
}

/// Sets the camera to a format; returns the format that the driver chose, and the interval between
/// frames, s. `None` if the camera does not have the wanted pixel format.
fn set(
    device: &Device,
    size: [u32; 2],
    rate_hz: Option<f64>,
    wanted: FourCc,
) -> std::io::Result<Option<(PixFormat, f64)>> {
    let mut format = device.format(BufferType::VideoCapture)?;
    if let Some(pixels) = format.try_mut::<PixFormat>() {
        pixels.set_width(size[0]);
        pixels.set_height(size[1]);
        pixels.set_pixel_format(wanted);
        // The driver sets strides and sizes.
        pixels.set_bytes_per_line(0);
        pixels.set_size_image(0);
    }
    device.set_format(&mut format)?;
    let now = device.format(BufferType::VideoCapture)?;
    let Some(now) = now.try_ref::<PixFormat>().copied().filter(|now| now.pixel_format() == wanted)
    else {
        return Ok(None);
    };
    let mut parameters = device.param(BufferType::VideoCapture)?;
    if let Some(capture) = parameters.try_mut::<CaptureParm>() {
        let mut interval = capture.time_per_frame();
        interval.set_numerator(1000);
        interval.set_denominator((rate_hz.unwrap_or(FASTEST_HZ) * 1000.0) as u32);
        capture.set_time_per_frame(interval);
    }
    // Some cameras have one rate only, and refuse this call.
    let _ = device.set_param(&mut parameters);
    let parameters = device.param(BufferType::VideoCapture)?;
    let interval_s = parameters.try_ref::<CaptureParm>().map_or(0.0, |capture| {
        let interval = capture.time_per_frame();
        f64::from(interval.numerator()) / f64::from(interval.denominator().max(1))
    });
    // If the camera does not say, the usual 30 Hz are assumed.
    Ok(Some((now, if interval_s > 0.0 { interval_s } else { 1.0 / 30.0 })))
}

/// The pixels of a frame in a driver's format.
fn pixels(format: &PixFormat, bytes: &[u8]) -> Result<Pixels, String> {
    let [width, height] = [format.width(), format.height()].map(|side| side as usize);
    let stride = format.bytes_per_line() as usize;
    match format.pixel_format() {
        FourCc::Grey => rows(bytes, [width, height], stride, 1).map(Pixels::Gray8),
        // YUYV: every other byte is brightness.
        FourCc::Yuyv => rows(bytes, [width, height], stride, 2).map(Pixels::Gray8),
        _ => match decode_still(bytes)? {
            image if (image.width, image.height) == (width, height) => Ok(image.pixels),
            Still { width, height, .. } => Err(format!("its size is {width}x{height}")),
        },
    }
}

/// The first byte of each pixel, from rows that are `stride` bytes apart.
fn rows(
    bytes: &[u8],
    [width, height]: [usize; 2],
    stride: usize,
    pixel: usize,
) -> Result<Vec<u8>, String> {
    let stride = stride.max(width * pixel);
    if height == 0 || bytes.len() < stride * (height - 1) + width * pixel {
        return Err(format!("it holds {} bytes only", bytes.len()));
    }
    let row = |row: usize| bytes[row * stride..][..width * pixel].iter().step_by(pixel).copied();
    Ok((0..height).flat_map(row).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::UsbCamera;

    #[test]
    fn brightness_is_every_other_byte_of_rows_that_may_be_padded() {
        let padded = [1, 9, 2, 9, 0, 0, 3, 9, 4, 9];
        assert_eq!(rows(&padded, [2, 2], 6, 2), Ok(vec![1, 2, 3, 4]));
        assert_eq!(rows(&padded, [3, 2], 6, 1), Ok(vec![1, 9, 2, 3, 9, 4]));
        assert!(rows(&padded, [2, 3], 6, 2).is_err());
    }

    #[test]
    fn what_is_not_there_or_no_camera_is_said() {
        let options = |device: &str| UsbOptions {
            device: device.into(),
            size: Some([640, 480]),
            rate_hz: None,
            latency_s: None,
            sd_s: 0.02,
        };
        let open = |device: &str| {
            let opened = UsbCamera::new(options(device)).open(Duration::from_secs(1));
            opened.err().map(|error| error.to_string()).unwrap_or_default()
        };
        assert!(open("/dev/video999").contains("plugged in"), "{}", open("/dev/video999"));
        assert!(!open("/dev/null").is_empty());
    }
}
