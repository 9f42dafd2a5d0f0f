use std::time::Duration;

use crate::{FrameSource, GigeCamera, GstreamerCamera, RtspCamera, UsbCamera, VideoError};

/// A camera that is watched live, and opened again whenever it breaks off.
#[derive(Clone, Debug)]
pub enum LiveCamera {
    /// On the network.
    Stream(RtspCamera),
    /// On a bus of this host.
    Usb(UsbCamera),
    /// An industrial one.
    Gige(GigeCamera),
    /// What GStreamer can show.
    Gstreamer(GstreamerCamera),
}

impl LiveCamera {
    /// Where it is, without who asks.
    pub fn address(&self) -> String {
        match self {
            Self::Stream(camera) => camera.address(),
            Self::Usb(camera) => camera.address(),
            Self::Gige(camera) => camera.address(),
            Self::Gstreamer(camera) => camera.address(),
        }
    }

    /// Opens it. `silence` is how long it may send nothing.
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
