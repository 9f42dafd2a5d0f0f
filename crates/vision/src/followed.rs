//! The targets of a tracker: who gave them, which algorithm follows them, and their tracks.

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use nalgebra::Matrix2;

use crate::config::Algorithm;
use crate::followed_target::ImageTarget;
use crate::frame::{FrameInput, TargetStep};
use crate::paper::PaperTarget;
use crate::scene_turn::SceneTurn;
use crate::scratch::Scratch;
use crate::state::TargetBelief;
use crate::{
    ImagePoint, ImageTrack, ImageTrackId, PixelBox, TargetFeatures, TrackPhase, TrackerConfig,
};

/// Who took a target up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum TakenUpBy {
    /// A person or a configuration: it is never given up.
    Given,
    /// The detector.
    Detected {
        /// Where it was found, and where what was in that image was at the beginning.
        first: ImagePoint,
        turned: SceneTurn,
        /// Whether it has been elsewhere since or before, both in the image and in the scene, so
        /// that the background of its place is known without it: what keeps to its place in the
        /// image is on the lens, or written into the video.
        has_moved: bool,
        /// Whether it is followed only because it may be a target that is lost: a candidate has no
        /// track of its own.
        is_candidate: bool,
    },
}

/// A target as one of the algorithms follows it.
#[derive(Debug)]
pub(crate) enum Follower {
    Posterior(Box<ImageTarget>),
    Paper(Box<PaperTarget>),
}

impl Follower {
    pub(crate) fn new(
        image: &Plane,
        place: PixelBox,
        scratch: &mut Scratch,
        config: &TrackerConfig,
    ) -> Self {
        match config.algorithm {
            Algorithm::Posterior => {
                Self::Posterior(Box::new(ImageTarget::new(image, place, scratch, config)))
            }
            Algorithm::Paper => Self::Paper(Box::new(PaperTarget::new(image, place, config))),
        }
    }

    /// Begins to put a box right that somebody has given, where its image does not show how.
    pub(crate) fn begin_centring(&mut self, config: &TrackerConfig) {
        if let Self::Posterior(target) = self {
            target.state.begin_centring(config);
        }
    }

    pub(crate) fn step(
        &mut self,
        frame: FrameInput<'_>,
        cue: Option<ImagePoint>,
        scratch: &mut Scratch,
    ) -> TargetStep {
        match (self, cue) {
            (Self::Posterior(target), None) => target.step(frame, scratch),
            (Self::Posterior(target), Some(place)) => target.take_place(frame, place, scratch),
            (Self::Paper(target), None) => {
                target.step(frame.image, frame.interval, scratch, frame.config)
            }
            (Self::Paper(target), Some(place)) => {
                target.take_place(frame.image, place, frame.interval, frame.config)
            }
        }
    }

    pub(crate) fn position(&self) -> ImagePoint {
        match self {
            Self::Posterior(target) => target.state.position(),
            Self::Paper(target) => target.position(),
        }
    }

    fn velocity(&self) -> ImagePoint {
        match self {
            Self::Posterior(target) => target.state.velocity(),
            Self::Paper(target) => target.velocity(),
        }
    }

    fn covariances(&self) -> Option<[Matrix2<f64>; 2]> {
        match self {
            Self::Posterior(target) => Some(target.covariances()),
            Self::Paper(target) => target.axes().map(|[x, y]| [x.covariance(), y.covariance()]),
        }
    }

    /// Its box after this time, s, if it flies straight on.
    pub(crate) fn box_after(&self, after: f64) -> PixelBox {
        let (at, velocity) = (self.position(), self.velocity());
        let there = ImagePoint { x: at.x + after * velocity.x, y: at.y + after * velocity.y };
        let [width, height] = self.size();
        PixelBox::about(there, width, height)
    }

    /// How it looks and moves; the papers' algorithm does not say.
    fn features(&self) -> Option<TargetFeatures> {
        let Self::Posterior(target) = self else { return None };
        Some(target.state.features())
    }

    /// Width and height of the target, px.
    pub(crate) fn size(&self) -> [f64; 2] {
        match self {
            Self::Posterior(target) => target.state.appearance.sides(),
            Self::Paper(target) => target.size,
        }
    }

    pub(crate) fn is_lost(&self) -> bool {
        matches!(self, Self::Posterior(target) if target.is_lost())
    }

    pub(crate) fn is_searching(&self) -> bool {
        matches!(self, Self::Posterior(target) if target.state.is_searching())
    }

    /// What is believed of the target; `None` of the papers' algorithms.
    pub(crate) fn belief(&self) -> Option<&TargetBelief> {
        match self {
            Self::Posterior(target) => Some(&target.state),
            Self::Paper(_) => None,
        }
    }

    pub(crate) fn is_seen(&self) -> bool {
        let Self::Posterior(target) = self else { return true };
        target.state.unseen_s <= 0.0 && !target.identity.is_on_probation()
    }
}

#[derive(Debug)]
pub(crate) struct Followed {
    pub(crate) id: ImageTrackId,
    pub(crate) origin: TakenUpBy,
    pub(crate) target: Follower,
    pub(crate) measured_at: Timestamp,
    /// When it was last searched for.
    pub(crate) searched: Option<Timestamp>,
    /// Its place in the next image, if somebody has given it.
    pub(crate) cue: Option<ImagePoint>,
    /// The target on whose place it was taken up, until the two have been apart.
    pub(crate) began_on: Option<ImageTrackId>,
    /// Since when it has been followed.
    pub(crate) since: Timestamp,
    /// The candidate that is shown in its place while it is lost.
    pub(crate) stand_in: Option<ImageTrackId>,
    /// The box by which somebody has given it, if nothing stood out there.
    pub(crate) unshown: Option<PixelBox>,
}

impl Followed {
    pub(crate) fn is_candidate(&self) -> bool {
        matches!(self.origin, TakenUpBy::Detected { is_candidate: true, .. })
    }

    /// Its box after this time, s; `None` where it is not seen, or is a candidate.
    pub(crate) fn expected(&self, after: f64) -> Option<PixelBox> {
        let is_known = !self.is_candidate() && self.target.is_seen();
        is_known.then(|| self.target.box_after(after))
    }

    /// How well its velocity is known, px/s per axis, if the detector has found it.
    pub(crate) fn velocity_sd_if_found(&self) -> Option<f64> {
        let is_found = matches!(self.origin, TakenUpBy::Detected { .. });
        let [x, y] = self.target.covariances().filter(|_| is_found)?;
        Some(((x.m22 + y.m22) / 2.0).sqrt())
    }

    /// Whether it was found by the detector, and has been elsewhere since.
    pub(crate) fn has_moved(&self) -> bool {
        matches!(self.origin, TakenUpBy::Detected { has_moved: true, .. })
    }
}

/// The track of a target after a step.
pub(crate) fn describe(
    id: ImageTrackId,
    target: &Follower,
    phase: TrackPhase,
    step: TargetStep,
) -> ImageTrack {
    let [width, height] = target.size();
    ImageTrack {
        id,
        phase,
        position: target.position(),
        velocity: target.velocity(),
        covariances: target.covariances(),
        measured: step.measured,
        width,
        height,
        score: step.score,
        certainty: step.certainty,
        nis: step.nis,
        features: target.features(),
    }
}
