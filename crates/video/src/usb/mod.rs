//! A camera on a bus of this host: USB, or a ribbon's.

#[cfg(target_os = "linux")]
mod linux;

use std::path::PathBuf;
use std::time::Duration;

use crate::{FrameSource, VideoError};

/// How a camera of this host is watched.
#[derive(Clone, Debug, PartialEq)]
pub struct UsbOptions {
    /// Its device, `/dev/video0`.
    pub device: PathBuf,
    /// Columns and rows; as it is set where it is not said.
    pub size: Option<[u32; 2]>,
    /// Frames a second; the most that it has where it is not said.
    pub rate_hz: Option<f64>,
    /// From the middle of the exposure to the driver's time, s. Where it is not said, nothing for
    /// drivers that give the exposure's start, and half of a frame's interval for the others: a
    /// picture is read out in about an interval.
    pub latency_s: Option<f64>,
    /// Standard deviation of its frames' times, s.
    pub sd_s: f64,
}

/// A camera of this host that is opened again and again.
#[derive(Clone, Debug)]
pub struct UsbCamera {
    options: UsbOptions,
}

impl UsbCamera {
    /// A camera that is watched so.
    pub fn new(options: UsbOptions) -> Self {
        Self { options }
    }

    /// The device.
    pub fn address(&self) -> String {
        self.options.device.display().to_string()
    }

    /// Opens it. `silence` is how long it may send nothing.
    ///
    /// # Errors
    /// [`VideoError::Stream`] if it is not there, may not be opened, or does not have the size.
    #[cfg(target_os = "linux")]
    pub fn open(&self, silence: Duration) -> Result<Box<dyn FrameSource>, VideoError> {
        Ok(Box::new(linux::UsbSource::open(&self.options, silence)?))
    }

    /// As on Linux, but that nothing can be opened here.
    ///
    /// # Errors
    /// [`VideoError::Stream`], always.
    #[cfg(not(target_os = "linux"))]
    pub fn open(&self, _: Duration) -> Result<Box<dyn FrameSource>, VideoError> {
        let what = "cameras of this host are watched on Linux alone".to_owned();
        Err(VideoError::Stream { url: self.address(), what })
    }
}

/// The cameras of this host: their devices, and what they call themselves.
#[cfg(target_os = "linux")]
pub fn usb_cameras() -> Vec<(PathBuf, String)> {
    linux::cameras()
}

/// As on Linux, but that none is known here.
#[cfg(not(target_os = "linux"))]
pub fn usb_cameras() -> Vec<(PathBuf, String)> {
    Vec::new()
}
