use std::time::Duration;

use crate::{FrameSource, GigeCamera, GstreamerCamera, RtspCamera, UsbCamera, VideoError};

/// A camera that is watched live, and reopened whenever it breaks off.
#[derive(Clone, Debug)]
pub enum LiveCamera {
    /// A network camera (RTSP).
    Stream(RtspCamera),
    /// A camera on a bus of this host.
    Usb(UsbCamera),
    /// An industrial camera (GigE Vision).
    Gige(GigeCamera),
    /// Anything that GStreamer can show.
    Gstreamer(GstreamerCamera),
}

impl LiveCamera {
    /// Its address, without user and password.
    pub fn address(&self) -> String {
        match self {
            Self::Stream(camera) => camera.address(),
            Self::Usb(camera) => camera.address(),
            Self::Gige(camera) => camera.address(),
            Self::Gstreamer(camera) => camera.address(),
        }
    }

    /// Opens it. `silence` is how long it may send nothing before that is an error.
    ///
    /// # Errors
    /// [`VideoError`] naming the camera and what keeps it from being watched.
    pub fn open(&self, silence: Duration) -> Result<Box<dyn FrameSource>, VideoError> {
        Ok(match self {
            Self::Stream(camera) => Box::new(camera.open(silence)?),
            Self::Usb(camera) => camera.open(silence)?,
            Self::Gige(camera) => camera.open(silence)?,
            Self::Gstreamer(camera) => camera.open(silence)?,
        })
    }
}
