//! A tracker on one target of which the truth is known.

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_vision::{
    ImageTrack, ImageTrackId, ImageTracker, PixelBox, TrackPhase, TrackerConfig,
};

/// Distance of the centres up to which a frame counts as followed, px: the limit of the project's
/// other figures on videos. With half of it loose labels count as losses.
const NEAR_PX: f64 = 10.0;
/// Distance beyond which a track is on something else, px: it cannot overlap a small target. With
/// half of it a loose label counts as something else.
const FAR_PX: f64 = 20.0;
/// The number of the one target that is given: the tracker's first.
const GIVEN: ImageTrackId = ImageTrackId(1);

/// What became of one trial.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct TrialScore {
    labelled: u32,
    near: u32,
    /// Sum of the squared distances in those frames, px^2.
    squares: f64,
    /// Longest time for which something else was shown as the target, s.
    pub(super) longest_wrong_s: f64,
}

impl TrialScore {
    /// Share of the labelled frames in which the target was not followed.
    pub(super) fn lost(&self) -> f64 {
        1.0 - f64::from(self.near) / f64::from(self.labelled)
    }

    /// Root mean square error of the centre while the target was followed, px; not a number where
    /// it never was.
    pub(super) fn rms_px(&self) -> f64 {
        (self.squares / f64::from(self.near)).sqrt()
    }
}

/// A tracker on one target.
#[derive(Debug)]
pub(super) struct Trial {
    tracker: ImageTracker,
    score: TrialScore,
    /// Since when something else has been shown as the target.
    wrong_since: Option<Timestamp>,
}

impl Trial {
    /// A trial that begins with the next image.
    ///
    /// # Panics
    /// If the configuration is impossible: they are all this crate's own.
    pub(super) fn new(config: TrackerConfig, given: PixelBox) -> Self {
        let mut tracker = ImageTracker::new(config).unwrap_or_else(|error| panic!("{error}"));
        tracker.take_up(given);
        Self { tracker, score: TrialScore::default(), wrong_since: None }
    }

    /// Follows the target into an image in which it is in a box, if that is known.
    pub(super) fn step(&mut self, image: &Plane, time: Timestamp, label: Option<PixelBox>) {
        let tracks = self.tracker.step(image, time);
        let shown = tracks.iter().find(|track| track.id == GIVEN && is_shown(track));
        let Some(truth) = label.map(|label| label.centre()) else {
            // Nobody knows what is right here.
            self.wrong_since = None;
            return;
        };
        let off = shown.map(|track| (track.position.x - truth.x).hypot(track.position.y - truth.y));
        self.score.labelled += 1;
        if let Some(near) = off.filter(|off| *off <= NEAR_PX) {
            self.score.near += 1;
            self.score.squares += near * near;
        }
        if off.is_some_and(|off| off > FAR_PX) {
            let since = *self.wrong_since.get_or_insert(time);
            let wrong_s = time.seconds_since(since);
            self.score.longest_wrong_s = self.score.longest_wrong_s.max(wrong_s);
        } else {
            self.wrong_since = None;
        }
    }

    pub(super) fn score(self) -> TrialScore {
        self.score
    }
}

/// Whether a track is shown as on its target.
fn is_shown(track: &ImageTrack) -> bool {
    track.phase != TrackPhase::Searching
}
