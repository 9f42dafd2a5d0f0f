//! Parts of the tracker that can be left out, to measure what each brings.

use std::fmt;

use crate::{ReferenceStrategy, TrackerConfig};

/// A part of the tracker ([`crate::Algorithm::Posterior`]) that [`TrackerConfig::without`] leaves
/// out. What it brings is the difference: `crossfix validate tracker --ablate` prints it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum TrackerPart {
    /// The box that is given is moved onto what stands out in it, at once or in the mean of the
    /// target's images.
    Figure,
    /// The figure is looked for in the mean of the images where the first one does not show it.
    MeanFigure,
    /// The reference is learnt from the target's images.
    LearntReference,
    /// An image that matches worse than usual is hardly learnt.
    UsualMatch,
    /// The reference follows the target's size and direction.
    Shape,
    /// The contrast that is expected of the target follows the one that is measured.
    FollowedContrast,
    /// Several motion models, from constant velocity to the liveliest; without them all of the
    /// weight is on the liveliest.
    MotionModels,
    /// What stands out more than all else in the gate is hardly background.
    BackgroundEnergy,
    /// The measurement noise is matched to the innovations.
    MatchedNoise,
    /// Several places are followed while none is sure.
    SeveralPlaces,
    /// The camera's turns are found by registration, and the target may turn with the scene.
    CameraTurns,
    /// A thing that was there before the target came is not the target.
    Arrival,
    /// Where nothing stands out as the target usually does there is none.
    UsualContrast,
    /// What a search finds is believed only after a while.
    Probation,
    /// A lost target is searched for as it looked at first, too.
    FirstAppearance,
    /// A lost target is searched for in what has changed.
    SearchInChange,
    /// What the scene itself looks like to the reference is taken out of a search.
    EmptyScene,
    /// Something else that moves is shown in a lost target's place.
    StandIns,
}

impl TrackerPart {
    /// All parts.
    pub const ALL: [Self; 18] = [
        Self::Figure,
        Self::MeanFigure,
        Self::LearntReference,
        Self::UsualMatch,
        Self::Shape,
        Self::FollowedContrast,
        Self::MotionModels,
        Self::BackgroundEnergy,
        Self::MatchedNoise,
        Self::SeveralPlaces,
        Self::CameraTurns,
        Self::Arrival,
        Self::UsualContrast,
        Self::Probation,
        Self::FirstAppearance,
        Self::SearchInChange,
        Self::EmptyScene,
        Self::StandIns,
    ];
}

impl fmt::Display for TrackerPart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Figure => "the box is moved onto its figure",
            Self::MeanFigure => "the figure in the mean of images",
            Self::LearntReference => "the reference is learnt",
            Self::UsualMatch => "learning by the usual match",
            Self::Shape => "size and direction are followed",
            Self::FollowedContrast => "the contrast is followed",
            Self::MotionModels => "several motion models",
            Self::BackgroundEnergy => "the background's energy",
            Self::MatchedNoise => "noise matched to innovations",
            Self::SeveralPlaces => "several places while in doubt",
            Self::CameraTurns => "turns of the camera",
            Self::Arrival => "identity: it has come there",
            Self::UsualContrast => "identity: its usual contrast",
            Self::Probation => "probation of what is found",
            Self::FirstAppearance => "search for its first looks",
            Self::SearchInChange => "search in what has changed",
            Self::EmptyScene => "search: the empty scene",
            Self::StandIns => "stand-ins for a lost target",
        })
    }
}

impl TrackerConfig {
    /// The same tracker without one of its parts. Only one is left out at a time.
    ///
    /// ```
    /// use crossfix_vision::{TrackerConfig, TrackerPart};
    ///
    /// let config = TrackerConfig::default().without(TrackerPart::Shape);
    /// assert!(!config.follow_shape);
    /// ```
    #[must_use]
    pub fn without(self, part: TrackerPart) -> Self {
        match part {
            TrackerPart::Figure => Self { box_sd_px: 0.0, ..self },
            TrackerPart::Shape => Self { follow_shape: false, ..self },
            TrackerPart::LearntReference => Self { reference: ReferenceStrategy::Fixed, ..self },
            _ => Self { left_out: Some(part), ..self },
        }
    }

    /// Whether a part takes part.
    pub(crate) fn has(&self, part: TrackerPart) -> bool {
        match part {
            TrackerPart::Figure => self.box_sd_px > 0.0,
            TrackerPart::Shape => self.follow_shape,
            TrackerPart::LearntReference => self.reference != ReferenceStrategy::Fixed,
            _ => self.left_out != Some(part),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_out_is_out_and_all_else_is_in() {
        for part in TrackerPart::ALL {
            let config = TrackerConfig::default().without(part);
            for other in TrackerPart::ALL {
                assert_eq!(config.has(other), other != part, "without {part:?}: {other:?}");
            }
        }
    }
}
