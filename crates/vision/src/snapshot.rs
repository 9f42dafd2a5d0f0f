//! A picture of a moment ago in which every target but candidates was seen: it shows what a lost
//! target is not.

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;

use crate::ImagePoint;
use crate::scene_turn::SceneTurn;

/// Age at which a snapshot is replaced, s. With half of it a picture is copied twice as often; with
/// twice as much it shows clouds as they were up to a second ago.
const SNAPSHOT_AGE_S: f64 = 0.5;

/// The picture, and when it was taken.
#[derive(Debug)]
pub(crate) struct BackgroundSnapshot {
    pub(crate) picture: Plane,
    /// [`SceneMemory::turned`](crate::scene::SceneMemory::turned) then.
    pub(crate) turned: SceneTurn,
    /// Where the targets were seen in it.
    pub(crate) seen: Vec<ImagePoint>,
    time: Timestamp,
}

impl BackgroundSnapshot {
    /// A snapshot of an image in which targets are `seen`, with `SceneMemory::turned` then. The
    /// memory of a former one is used again.
    pub(crate) fn of(
        image: &Plane,
        turned: SceneTurn,
        time: Timestamp,
        seen: impl Iterator<Item = ImagePoint>,
        former: Option<Self>,
    ) -> Self {
        let (mut picture, mut places) =
            former.map(|former| (former.picture, former.seen)).unwrap_or_default();
        picture.copy_from(image);
        places.clear();
        places.extend(seen);
        Self { picture, turned, seen: places, time }
    }

    /// Whether it is time for another.
    pub(crate) fn is_old(&self, now: Timestamp) -> bool {
        now.seconds_since(self.time) >= SNAPSHOT_AGE_S
    }
}
