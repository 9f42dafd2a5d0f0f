use std::fmt;

use crossfix_correlation::{Correlator, Plane};
use crossfix_message::Timestamp;

use crate::detector::Detector;
use crate::target::Target;
use crate::{ConfigError, ImagePoint, PixelBox, TrackerConfig};

/// Steps longer than this are taken as this: after a pause nothing is known of a target anyway.
const LONGEST_INTERVAL: f64 = 1.0;

/// Number of a 2D track, unique within its image stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ImageTrackId(pub u64);

impl fmt::Display for ImageTrackId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// The life of a 2D track.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrackPhase {
    /// Taken up in this image.
    Tentative,
    /// Measured in this image.
    Tracking,
    /// Not measured in this image: a prediction.
    Coasting,
    /// Not measured for several images: it is searched for, and the prediction is a guess.
    Searching,
}

/// One target in one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageTrack {
    /// The track.
    pub id: ImageTrackId,
    /// Its life.
    pub phase: TrackPhase,
    /// The filters' estimate of the centre, px.
    pub position: ImagePoint,
    /// Its velocity, px/s.
    pub velocity: ImagePoint,
    /// The centre as measured in this image alone, with its variance (px^2, either axis).
    pub measured: Option<(ImagePoint, f64)>,
    /// Sides of the box, px.
    pub width: f64,
    /// Sides of the box, px.
    pub height: f64,
    /// Correlation at the best place, -1 to 1.
    pub score: f64,
}

/// Who took a target up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Origin {
    /// A person or a configuration: it is never given up.
    Given,
    /// The detector.
    Detected,
}

#[derive(Debug)]
struct Followed {
    id: ImageTrackId,
    origin: Origin,
    target: Target,
    measured_at: Timestamp,
}

/// Finds and follows targets in one image stream.
///
/// Images must come in the order of their times; one whose time is not after the last one's, or
/// whose size differs from the first one's, is answered with no tracks and counted.
#[derive(Debug)]
pub struct ImageTracker {
    config: TrackerConfig,
    correlator: Correlator,
    detector: Option<Detector>,
    waiting: Vec<PixelBox>,
    followed: Vec<Followed>,
    next_id: u64,
    last: Option<(Timestamp, usize, usize)>,
    refused: u64,
}

impl ImageTracker {
    /// A tracker that follows nothing yet.
    ///
    /// # Errors
    /// [`ConfigError`] if a number of the configuration makes no sense.
    pub fn new(config: TrackerConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let detector = config.detector.clone().map(Detector::new);
        Ok(Self {
            config,
            correlator: Correlator::default(),
            detector,
            waiting: Vec::new(),
            followed: Vec::new(),
            next_id: 1,
            last: None,
            refused: 0,
        })
    }

    /// Takes a target up in the next image. A box that no target can have is left out.
    pub fn take_up(&mut self, place: PixelBox) {
        if place.is_possible() {
            self.waiting.push(place);
        }
    }

    /// Images that were refused.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Follows all targets into the next image and returns its tracks, ordered by id.
    pub fn step(&mut self, image: &Plane, time: Timestamp) -> Vec<ImageTrack> {
        let size = (image.width(), image.height());
        let fits = self.last.is_none_or(|(last, w, h)| time > last && (w, h) == size);
        if !fits {
            self.refused += 1;
            return Vec::new();
        }
        let interval = self.last.map_or(0.0, |(last, ..)| time.seconds_since(last).min(LONGEST_INTERVAL));
        self.last = Some((time, size.0, size.1));

        let image = &finite(image);
        let mut tracks: Vec<ImageTrack> = Vec::new();
        for followed in &mut self.followed {
            let step = followed.target.step(image, interval, &mut self.correlator, &self.config);
            if step.measured.is_some() {
                followed.measured_at = time;
            }
            let phase = match step.measured {
                Some(_) => TrackPhase::Tracking,
                None if followed.target.is_searching(&self.config) => TrackPhase::Searching,
                None => TrackPhase::Coasting,
            };
            tracks.push(describe(followed, phase, step.measured, step.score));
        }
        self.give_up(time);
        tracks.retain(|track| self.followed.iter().any(|followed| followed.id == track.id));
        self.take_up_new(image, time, &mut tracks);
        tracks
    }

    /// Drops what the detector found and nobody has measured for long, and the younger of two
    /// tracks of one target.
    fn give_up(&mut self, now: Timestamp) {
        let patience = self.config.give_up_after_s;
        self.followed.retain(|f| f.origin == Origin::Given || now.seconds_since(f.measured_at) <= patience);
        let mut index = 0;
        while index < self.followed.len() {
            let (older, rest) = self.followed.split_at(index);
            let doubled =
                rest[0].origin == Origin::Detected && older.iter().any(|o| same(&o.target, &rest[0].target));
            if doubled {
                self.followed.remove(index);
            } else {
                index += 1;
            }
        }
    }

    fn take_up_new(&mut self, image: &Plane, time: Timestamp, tracks: &mut Vec<ImageTrack>) {
        let given = std::mem::take(&mut self.waiting).into_iter().map(|place| (place, Origin::Given));
        let mut new: Vec<(PixelBox, Origin)> = given.collect();
        if let Some(detector) = &mut self.detector {
            let mut known: Vec<PixelBox> = self.followed.iter().map(|f| box_of(&f.target)).collect();
            known.extend(new.iter().map(|(place, _)| *place));
            let room = self.config.detector.as_ref().map_or(0, |d| d.max_targets.saturating_sub(known.len()));
            let found = detector.step(image, &known).into_iter().take(room);
            new.extend(found.map(|place| (place, Origin::Detected)));
        }
        for (place, origin) in new {
            let id = ImageTrackId(self.next_id);
            self.next_id += 1;
            let target = Target::new(image, place, &self.config);
            let followed = Followed { id, origin, target, measured_at: time };
            tracks.push(describe(&followed, TrackPhase::Tentative, None, 1.0));
            self.followed.push(followed);
        }
    }
}

/// The image with its NaNs and infinities made black: a broken pixel must not spoil a whole gate.
fn finite(image: &Plane) -> Plane {
    let mut image = image.clone();
    for sample in image.samples_mut().iter_mut().filter(|sample| !sample.is_finite()) {
        *sample = 0.0;
    }
    image
}

fn box_of(target: &Target) -> PixelBox {
    PixelBox::about(target.position(), target.width, target.height)
}

/// Whether two targets lie on each other: their centres within half a box.
fn same(one: &Target, other: &Target) -> bool {
    let (a, b) = (one.position(), other.position());
    (a.x - b.x).abs() < one.width.max(other.width) / 2.0
        && (a.y - b.y).abs() < one.height.max(other.height) / 2.0
}

fn describe(
    followed: &Followed,
    phase: TrackPhase,
    measured: Option<(ImagePoint, f64)>,
    score: f64,
) -> ImageTrack {
    let target = &followed.target;
    ImageTrack {
        id: followed.id,
        phase,
        position: target.position(),
        velocity: target.velocity(),
        measured,
        width: target.width,
        height: target.height,
        score,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::DetectorConfig;

    fn spots(places: &[(f32, f32)]) -> Plane {
        Plane::from_fn(160, 120, |column, row| {
            let spot = |&(x, y): &(f32, f32)| {
                let (dx, dy) = (column as f32 - x, row as f32 - y);
                120.0 * (-(dx * dx + dy * dy) / 8.0).exp()
            };
            50.0 + places.iter().map(spot).sum::<f32>()
        })
    }

    fn at(frame: u32) -> Timestamp {
        Timestamp::from_seconds(f64::from(frame) / 30.0)
    }

    #[test]
    fn two_targets_are_found_followed_and_kept_apart() {
        let config = TrackerConfig { detector: Some(DetectorConfig::default()), ..TrackerConfig::default() };
        let mut tracker = ImageTracker::new(config).unwrap();
        let mut last = Vec::new();
        for frame in 0..60 {
            let t = frame as f32;
            let image =
                if frame < 12 { spots(&[]) } else { spots(&[(20.0 + t, 30.0), (140.0 - 1.5 * t, 90.0)]) };
            last = tracker.step(&image, at(frame));
        }
        assert_eq!(last.len(), 2, "{last:?}");
        let mut x: Vec<f64> = last.iter().map(|track| track.measured.unwrap().0.x).collect();
        x.sort_by(f64::total_cmp);
        assert!((x[0] - 51.5).abs() < 1.0 && (x[1] - 79.0).abs() < 1.0, "{x:?}");
    }

    #[test]
    fn an_occluded_target_coasts_and_is_taken_back() {
        let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
        tracker.take_up(PixelBox { x: 16.0, y: 56.0, width: 9.0, height: 9.0 });
        let mut phases = Vec::new();
        for frame in 0..60 {
            let x = 20.0 + 2.0 * frame as f32;
            let hidden = (25..33).contains(&frame);
            let tracks = tracker.step(&if hidden { spots(&[]) } else { spots(&[(x, 60.0)]) }, at(frame));
            phases.push(tracks[0].phase);
            if frame == 59 {
                assert!((tracks[0].position.x - f64::from(x)).abs() < 1.0, "{tracks:?}");
            }
        }
        assert_eq!(phases[0], TrackPhase::Tentative);
        assert_eq!(phases[26], TrackPhase::Coasting);
        assert_eq!(phases[31], TrackPhase::Searching);
        assert_eq!(phases[45], TrackPhase::Tracking);
    }

    #[test]
    fn images_of_another_size_or_out_of_order_are_refused() {
        let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
        tracker.take_up(PixelBox { x: 16.0, y: 56.0, width: 9.0, height: 9.0 });
        assert_eq!(tracker.step(&spots(&[]), at(5)).len(), 1);
        assert_eq!(tracker.step(&spots(&[]), at(5)).len(), 0);
        assert_eq!(tracker.step(&Plane::from_fn(10, 10, |_, _| 0.0), at(6)).len(), 0);
        assert_eq!(tracker.refused(), 2);
    }

    proptest! {
        #[test]
        fn any_box_on_any_image_is_survived(
            x in -200.0..400.0, y in -200.0..400.0, width in 0.0..300.0, height in 0.0..300.0,
            level in prop_oneof![Just(0.0f32), Just(255.0), Just(f32::NAN), Just(f32::INFINITY)],
        ) {
            let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
            tracker.take_up(PixelBox { x, y, width, height });
            for frame in 0..6 {
                let image = Plane::from_fn(64, 48, |column, _| if column % 7 == 0 { level } else { 10.0 });
                for track in tracker.step(&image, at(frame)) {
                    prop_assert!(track.position.x.is_finite() && track.position.y.is_finite());
                }
            }
        }
    }
}
