//! A camera on a bus of this host: USB, or a ribbon cable.

#[cfg(target_os = "linux")]
mod linux;

use std::path::PathBuf;
use std::time::Duration;

use crate::{FrameSource, VideoError};

/// Options for watching a camera of this host.
#[derive(Clone, Debug, PartialEq)]
pub struct UsbOptions {
    /// Its device, such as `/dev/video0`.
    pub device: PathBuf,
    /// Columns and rows; if `None`, the size that it is set to.
    pub size: Option<[u32; 2]>,
    /// Frames per second; if `None`, the most that it has.
    pub rate_hz: Option<f64>,
    /// Time from the middle of the exposure to the driver's time stamp, s. If `None`: zero for
    /// drivers that stamp the start of the exposure, and half a frame's interval for the others, as
    /// a picture takes about an interval to read out.
    pub latency_s: Option<f64>,
    /// Standard deviation of its frames' times, s.
    pub sd_s: f64,
}

/// A camera of this host that can be opened again and again.
#[derive(Clone, Debug)]
pub struct UsbCamera {
    options: UsbOptions,
}

impl UsbCamera {
    /// A camera that is watched with these options.
    pub fn new(options: UsbOptions) -> Self {
        Self { options }
    }

    /// The device.
    pub fn address(&self) -> String {
        self.options.device.display().to_string()
    }

    /// Opens it. `silence` is how long it may send nothing before that is an error.
    ///
    /// # Errors
    /// [`VideoError::Stream`] if it is not there, may not be opened, or does not have the size.
    #[cfg(target_os = "linux")]
    pub fn open(&self, silence: Duration) -> Result<Box<dyn FrameSource>, VideoError> {
        Ok(Box::new(linux::UsbSource::open(&self.options, silence)?))
    }

    /// Without Linux nothing can be opened.
    ///
    /// # Errors
    /// [`VideoError::Stream`], always.
    #[cfg(not(target_os = "linux"))]
    pub fn open(&self, _: Duration) -> Result<Box<dyn FrameSource>, VideoError> {
        let what = "cameras of this host are watched on Linux alone".to_owned();
        Err(VideoError::Stream { url: self.address(), what })
    }
}

/// The cameras of this host: their devices and the names that they report.
#[cfg(target_os = "linux")]
pub fn usb_cameras() -> Vec<(PathBuf, String)> {
    linux::cameras()
}

/// Without Linux none is found.
#[cfg(not(target_os = "linux"))]
pub fn usb_cameras() -> Vec<(PathBuf, String)> {
    Vec::new()
}
