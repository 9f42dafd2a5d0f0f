//! What goes into a step of a target, and what comes out.

use crossfix_correlation::Plane;
use nalgebra::Matrix2;

use crate::scene::SceneMemory;
use crate::{ImagePoint, PixelBox, TrackerConfig};

/// The next image, and what goes with it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FrameInput<'a> {
    pub(crate) image: &'a Plane,
    /// Time since the image before, s.
    pub(crate) interval: f64,
    /// A picture of a moment ago, in which every target was seen.
    pub(crate) snapshot: Option<&'a Plane>,
    /// What the scene looked like lately.
    pub(crate) scene: &'a SceneMemory,
    /// Shift of everything in the image since the scene was looked at last, as the camera turned,
    /// px.
    pub(crate) scene_moved: [f64; 2],
    /// Whether it is this target's turn to be searched for, if it is lost: one per frame, as a
    /// search costs as much as many targets that are followed.
    pub(crate) may_search: bool,
    pub(crate) others: Others<'a>,
    pub(crate) config: &'a TrackerConfig,
}

impl FrameInput<'_> {
    /// Columns and rows of the image.
    pub(crate) fn sides(&self) -> [usize; 2] {
        [self.image.width(), self.image.height()]
    }
}

/// Where the other targets are: what is there is theirs.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Others<'a> {
    /// The boxes of all targets that are seen, in the order of the targets: in this image those
    /// before the target itself, as predicted those after it. `None` for one that is not seen.
    pub(crate) boxes: &'a [Option<PixelBox>],
    /// Index of the target itself.
    pub(crate) own: usize,
}

impl Others<'_> {
    /// The others' boxes.
    pub(crate) fn iter(self) -> impl Iterator<Item = PixelBox> {
        let others = self.boxes.iter().enumerate().filter(move |(index, _)| *index != self.own);
        others.filter_map(|(_, place)| *place)
    }
}

/// A place measured in one image, without the prediction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measurement {
    /// The target's centre.
    pub place: ImagePoint,
    /// Its covariance, x and y, px^2.
    pub covariance: Matrix2<f64>,
}

/// Result of one step of one target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TargetStep {
    /// The measured place, if the target was seen.
    pub(crate) measured: Option<Measurement>,
    /// The correlation at the best place.
    pub(crate) score: f64,
    /// Probability that the target is at the best place.
    pub(crate) certainty: f64,
    /// Normalised innovation squared of both axes.
    pub(crate) nis: Option<f64>,
}

impl TargetStep {
    /// Result if the target was not seen.
    pub(crate) const UNSEEN: Self = Self { measured: None, score: 0.0, certainty: 0.0, nis: None };
}
