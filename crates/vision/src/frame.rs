//! What goes into a step of a target, and what comes out.

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use nalgebra::Matrix2;

use crate::scene::SceneMemory;
use crate::scene_turn::SceneTurn;
use crate::snapshot::BackgroundSnapshot;
use crate::{ImagePoint, ImageTrackId, PixelBox, TrackerConfig};

/// The next image, and what goes with it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FrameInput<'a> {
    pub(crate) image: &'a Plane,
    /// Time since the image before, s.
    pub(crate) interval: f64,
    /// A picture of a moment ago, in which every target but candidates was seen.
    pub(crate) snapshot: Option<&'a BackgroundSnapshot>,
    /// What the scene looked like lately.
    pub(crate) scene: &'a SceneMemory,
    /// Where what was in the image registered before, up to 0.1 s ago, is now, as the camera has
    /// turned; nothing has moved if this image is not registered.
    pub(crate) scene_moved: SceneTurn,
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

/// A target as the others know it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OtherTarget {
    pub(crate) id: ImageTrackId,
    /// Since when it has been followed.
    pub(crate) since: Timestamp,
    /// When it was last measured.
    pub(crate) measured_at: Timestamp,
    /// The target on whose place it was taken up, until the two have been apart.
    pub(crate) began_on: Option<ImageTrackId>,
    /// Its box: in this image, if it has been followed into it, or as predicted. `None` for one
    /// that is not seen, on probation or a candidate, and for a prediction where the camera was
    /// jerked.
    pub(crate) place: Option<PixelBox>,
}

/// Where the other targets are: what is there is theirs.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Others<'a> {
    /// All targets.
    pub(crate) all: &'a [OtherTarget],
    /// Index of the target itself.
    pub(crate) own: usize,
}

impl Others<'_> {
    /// The boxes of the others, without those that may be the target itself: two that were taken up
    /// on one place, and what was taken up after the target was seen last.
    pub(crate) fn iter(self) -> impl Iterator<Item = PixelBox> {
        let own = self.all.get(self.own);
        self.all.iter().filter_map(move |other| {
            let own = own.filter(|own| own.id != other.id)?;
            let are_one = own.began_on == Some(other.id)
                || other.began_on == Some(own.id)
                || (own.began_on.is_some() && own.began_on == other.began_on);
            other.place.filter(|_| !are_one && other.since < own.measured_at)
        })
    }

    /// Whether a box has pixels in common with another's.
    pub(crate) fn any_overlaps(self, place: &PixelBox) -> bool {
        self.iter().any(|other| other.overlaps(place))
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
