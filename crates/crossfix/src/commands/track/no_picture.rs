//! Stands in for the picture in a build without the viewer.

use std::path::Path;

use crossfix_correlation::Plane;
use crossfix_video::Frame;
use crossfix_vision::ImageTrack;

use crate::parts;

/// A picture cannot exist in this build.
pub(super) enum TrackPicture {}

impl TrackPicture {
    pub(super) fn new(_: &Path, _: Option<&Path>) -> anyhow::Result<Self> {
        Err(parts::no_pictures())
    }

    pub(super) fn finish(self) -> anyhow::Result<()> {
        match self {}
    }

    pub(super) fn show(&self, _: &Frame, _: &Plane, _: &[ImageTrack]) -> anyhow::Result<()> {
        match *self {}
    }
}
