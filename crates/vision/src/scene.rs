//! What the scene looks like without the targets: a few pictures of the last seconds, and by how
//! much the camera has turned since each.
//!
//! What a target hides shows in a picture in which the target was elsewhere. Where the image is the
//! same as in such a picture it shows the scene and no target, however well a reference correlates.

use crossfix_correlation::Plane;

use crate::ImagePoint;
use crate::coarse_picture::{COARSENESS, coarsened, smooth};
use crate::crop::replace_invalid;
use crate::jerk::RowGlance;
use crate::registration::{LEAST_COMMON, PicturePair, STRIDE, overlap};

/// Number of pictures that are kept, the latest: they reach back for 3 to 3.6 s. With half of it a
/// slow target hides the same part of the scene in all of them; with more, light and clouds are
/// different by then.
const PICTURES: usize = 6;
/// Time between these pictures, s. With half of it they reach back half as far, as with half as
/// many.
const SPACING_S: f64 = 0.6;
/// Preferred age of the picture from which a change is computed, s: a target has moved by its own
/// size by then. With half of it a target that has moved by half its size cancels by half.
const CHANGED_S: f64 = 1.0;
/// A camera stands still that has turned by less than this since it was last registered, px: twice
/// what noise makes of it ...
const STILL_PX: f64 = 0.1;
/// ... and is registered again after this long, s, unless it is jerked: with half of it an image
/// costs 10 us more, one of 640x480 30 us. With half of the first noise alone has images
/// registered.
const STILL_S: f64 = 0.1;

/// Least turn from one image to the next that is believed, px: with half of it a sea is registered
/// along the way of its waves, ...
const LEAST_TURN_PX: f64 = 2.0;
/// ... and least speed of a turn since the image that was registered before, px/s: in slow streams
/// waves and clouds move by more than [`LEAST_TURN_PX`] from one image to the next. With half of it
/// theirs counts as the camera's turn at 5 images per second (reasoned, not measured).
const LEAST_TURN_PX_S: f64 = 20.0;

/// A picture of the scene.
#[derive(Clone, Debug, Default)]
pub(crate) struct ScenePicture {
    image: Plane,
    coarse: Plane,
    age_s: f64,
    number: u64,
    /// Shift from now to then: what is at (x, y) now was at (x, y) plus this, px.
    shift: [f64; 2],
}

impl ScenePicture {
    /// How long ago it was taken, s.
    pub(crate) fn age_s(&self) -> f64 {
        self.age_s
    }

    pub(crate) fn image(&self) -> &Plane {
        &self.image
    }

    /// Number of the picture, counted from the first one taken.
    pub(crate) fn number(&self) -> u64 {
        self.number
    }

    /// Where what is at `place` now was in this picture.
    pub(crate) fn then(&self, place: ImagePoint) -> ImagePoint {
        ImagePoint { x: place.x + self.shift[0], y: place.y + self.shift[1] }
    }

    /// Whether a place in this picture's own coordinates lies inside it.
    pub(crate) fn holds(&self, then: ImagePoint) -> bool {
        let inside = |at: f64, side: usize| (0.0..=side as f64 - 1.0).contains(&at);
        inside(then.x, self.image.width()) && inside(then.y, self.image.height())
    }
}

/// The last seconds' pictures.
#[derive(Debug, Default)]
pub(crate) struct SceneMemory {
    /// The newest first.
    pictures: Vec<ScenePicture>,
    /// The coarse picture of the image that was registered last, ...
    coarse: Plane,
    /// ... what it was before it was smoothed, and the same of the image registered before that;
    /// empty if there was none.
    sharp: Plane,
    sharp_before: Plane,
    between: Plane,
    sums: Vec<f32>,
    /// Number of pictures kept since the beginning.
    count: u64,
    /// Whether the camera had not turned when it was registered last, and the time since then, s.
    is_still: bool,
    unregistered_s: f64,
    glance: RowGlance,
    /// Shift of the scene since the beginning, when the newest picture was taken, px.
    turned: [f64; 2],
    /// Whether no picture is registered, as if the camera never turned.
    is_unregistered: bool,
}

impl SceneMemory {
    /// A memory that registers no picture.
    pub(crate) fn unregistered() -> Self {
        Self { is_unregistered: true, ..Self::default() }
    }

    /// The pictures, the newest first.
    pub(crate) fn pictures(&self) -> impl Iterator<Item = &ScenePicture> {
        self.pictures.iter()
    }

    /// The number of the newest picture; 0 before the first.
    pub(crate) fn newest(&self) -> u64 {
        self.count
    }

    /// Shift of the scene since the beginning: what is at (x, y) was at (x, y) plus this, px.
    pub(crate) fn turned(&self) -> [f64; 2] {
        // Shift until the newest picture, plus the shift since then.
        let since = self.pictures.first().map_or([0.0; 2], |newest| newest.shift);
        [0, 1].map(|i| self.turned[i] + since[i])
    }

    /// Forgets all pictures.
    pub(crate) fn clear(&mut self) {
        self.turned = self.turned();
        self.pictures.clear();
        (self.glance, self.is_still) = (RowGlance::default(), false);
        // The next image is registered with none before it.
        self.sharp = Plane::default();
    }

    /// Finds how the camera has turned by registering the image with the newest picture; against
    /// that one the other pictures are shifted as when it was taken. Where the camera may have
    /// turned far, or the picture shows nothing, the image registered before says where to begin.
    /// A camera that stood still lately is registered only now and then.
    pub(crate) fn register(&mut self, image: &Plane, interval: f64) {
        self.unregistered_s += interval;
        for picture in &mut self.pictures {
            picture.age_s += interval;
        }
        let is_jerked = self.glance.is_another(image, interval);
        // Half an interval is added so that the image nearest to the time is used.
        let is_time =
            is_jerked || !self.is_still || self.unregistered_s + interval / 2.0 >= STILL_S;
        // A picture that will be kept needs its coarse version and its shift, whatever the camera
        // does.
        let is_kept = self.pictures.first().is_none_or(|newest| newest.age_s >= SPACING_S);
        if !is_time && !is_kept {
            return;
        }
        let since_s = std::mem::take(&mut self.unregistered_s);
        coarsened(image, &mut self.coarse, &mut self.sums);
        replace_invalid(&mut self.coarse);
        std::mem::swap(&mut self.sharp_before, &mut self.sharp);
        self.sharp.copy_from(&self.coarse);
        smooth(&mut self.coarse, &mut self.between);
        let Some(before) = self.pictures.first().map(|newest| newest.shift) else { return };
        let shift = if self.is_unregistered {
            before
        } else {
            let may_have_turned = is_jerked || !self.is_still;
            self.shift_from(before, may_have_turned, since_s)
        };
        let Some((newest, others)) = self.pictures.split_first_mut() else { return };
        newest.shift = shift;
        self.is_still =
            newest.shift.iter().zip(before).all(|(now, before)| (now - before).abs() < STILL_PX);
        for picture in others {
            for (shift, (now, before)) in
                picture.shift.iter_mut().zip(newest.shift.iter().zip(before))
            {
                // The older pictures turn by as much as the newest one has since the image before.
                *shift += now - before;
            }
        }
    }

    /// Shift of the image against the newest picture, px, which was `before` in the image
    /// registered `since_s` seconds before. What neither of the two shows has not turned.
    fn shift_from(&mut self, before: [f64; 2], may_have_turned: bool, since_s: f64) -> [f64; 2] {
        let seen = self.seen_near(before);
        // The picture shows a large turn only near a first guess, and that of a scene which is fine
        // or changes quickly not at all.
        let turn = (may_have_turned || seen.is_none()).then(|| self.turn_since(since_s)).flatten();
        let Some(turn) = turn else { return seen.unwrap_or(before) };
        let guess = [0, 1].map(|i| before[i] + turn[i]);
        self.seen_near(guess).unwrap_or(guess)
    }

    /// The shift against the newest picture, px, if it determines one near a first guess.
    fn seen_near(&self, guess: [f64; 2]) -> Option<[f64; 2]> {
        shift_between(&self.coarse, &self.pictures.first()?.coarse, guess)
    }

    /// By how much the camera has turned since the image registered `since_s` seconds before, px.
    fn turn_since(&mut self, since_s: f64) -> Option<[f64; 2]> {
        let pair = PicturePair::successive(&self.sharp, &self.sharp_before, &mut self.sums)?;
        let turn = pair.turn()?.map(|turn| f64::from(turn) * COARSENESS as f64);
        (turn[0].hypot(turn[1]) > LEAST_TURN_PX.max(LEAST_TURN_PX_S * since_s)).then_some(turn)
    }

    /// Keeps a picture if it is time to, and returns its number.
    pub(crate) fn keep(&mut self, image: &Plane) -> Option<u64> {
        let is_new = self.pictures.first().is_some_and(|newest| newest.age_s < SPACING_S);
        let used = (self.coarse.width() / STRIDE) * (self.coarse.height() / STRIDE);
        if is_new || (used as f32) < LEAST_COMMON {
            return None;
        }
        // Each picture is registered itself, so that errors do not add up from picture to picture.
        if !self.is_unregistered {
            for picture in &mut self.pictures {
                picture.shift = shift_between(&self.coarse, &picture.coarse, picture.shift)
                    .unwrap_or(picture.shift);
            }
        }
        self.turned = self.turned();
        let mut kept = if self.pictures.len() < PICTURES {
            ScenePicture::default()
        } else {
            self.pictures.remove(self.pictures.len() - 1)
        };
        self.count += 1;
        kept.image.copy_from(image);
        replace_invalid(&mut kept.image);
        kept.coarse.copy_from(&self.coarse);
        (kept.age_s, kept.shift, kept.number) = (0.0, [0.0; 2], self.count);
        self.pictures.insert(0, kept);
        Some(self.count)
    }

    /// Fills `change` with what has changed since about a second ago: the image less what was there
    /// then, 0 where that is unknown. False without a picture of about that age.
    pub(crate) fn change(&self, image: &Plane, change: &mut Plane) -> bool {
        let of_age =
            |picture: &&ScenePicture| (CHANGED_S / 2.0..=CHANGED_S * 2.0).contains(&picture.age_s);
        let off = |picture: &ScenePicture| (picture.age_s - CHANGED_S).abs();
        let nearest = self
            .pictures
            .iter()
            .filter(of_age)
            .min_by(|one, other| off(one).total_cmp(&off(other)));
        let Some(ScenePicture { image: before, shift, .. }) = nearest else { return false };
        let (width, height) = (image.width(), image.height());
        // The older picture is interpolated linearly between four pixels.
        let whole = shift.map(f64::floor);
        let [right, down] = [0, 1].map(|i| (shift[i] - whole[i]) as f32);
        let [left, top] = whole.map(|s| s as isize);
        change.reshape(width, height);
        let known = overlap(width, left);
        for y in 0..height {
            let out = change.row_mut(y);
            out.fill(0.0);
            if !overlap(height, top).contains(&y) {
                continue;
            }
            let [above, below] = [0, 1].map(|k| before.row((y as isize + top) as usize + k));
            for (x, out) in out.iter_mut().enumerate().take(known.end).skip(known.start) {
                let i = (x as isize + left) as usize;
                let along = |row: &[f32]| row[i] + right * (row[i + 1] - row[i]);
                // I(x) - I_then(x + shift).
                *out = image.row(y)[x] - along(above) - down * (along(below) - along(above));
            }
        }
        true
    }
}

/// Shift of a coarse picture against an older one, px of the image, if they determine one near a
/// first guess.
fn shift_between(now: &Plane, then: &Plane, guess: [f64; 2]) -> Option<[f64; 2]> {
    let coarseness = COARSENESS as f64;
    let guess = guess.map(|shift| (shift / coarseness) as f32);
    let found = PicturePair::new(now, then)?.shift_near(guess)?;
    Some(found.map(|shift| f64::from(shift) * coarseness))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};

    use super::*;

    /// Clouds seen by a camera that has turned by so many pixels, with noise of a standard
    /// deviation.
    fn clouds([right, down]: [f64; 2], noise: f32, seed: u64) -> Plane {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let normal = Normal::new(0.0, noise).unwrap();
        Plane::from_fn(320, 240, |x, y| {
            let (x, y) = (x as f64 + right, y as f64 + down);
            let waves = (x / 37.0).sin() * (y / 29.0).cos() + 0.6 * ((x + 0.7 * y) / 19.0).sin();
            130.0 + 25.0 * waves as f32 + normal.sample(&mut rng)
        })
    }

    #[test]
    fn a_turn_of_the_camera_is_found_in_noise_and_adds_up() {
        // In the noise of a tenth of all levels a turn has to be a pixel or two before it is found.
        for (noise, most) in [(0.5, 0.6), (25.0, 2.0)] {
            let mut scene = SceneMemory::default();
            let turned = |frame: u32| [0.8 * f64::from(frame), -0.5 * f64::from(frame)];
            for frame in 0..60 {
                let image = clouds(turned(frame), noise, u64::from(frame));
                scene.register(&image, 1.0 / 30.0);
                scene.keep(&image);
            }
            let oldest = scene.pictures().last().unwrap();
            let frames = (oldest.age_s * 30.0).round();
            assert!(frames > 20.0, "{frames}");
            let off = [oldest.shift[0] - 0.8 * frames, oldest.shift[1] + 0.5 * frames];
            assert!(
                off.iter().all(|off| off.abs() < most),
                "{off:?} of {frames} frames, noise {noise}"
            );
        }
    }

    #[test]
    fn a_clear_sky_tells_no_turn() {
        let mut scene = SceneMemory::default();
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let normal = Normal::new(0.0, 40.0).unwrap();
        for _ in 0..90 {
            let image = Plane::from_fn(640, 480, |_, _| 128.0 + normal.sample(&mut rng));
            scene.register(&image, 1.0 / 30.0);
            assert!(
                scene.pictures().flat_map(|picture| picture.shift).all(|shift| shift.abs() < 2.0)
            );
            scene.keep(&image);
        }
    }

    #[test]
    fn a_target_that_moves_over_a_still_sky_is_no_turn() {
        let mut scene = SceneMemory::default();
        let mut rng = ChaCha8Rng::seed_from_u64(10);
        let normal = Normal::new(0.0, 2.0).unwrap();
        for frame in 0..60 {
            let (x, y) = (40.0 + 4.0 * frame as f32, 120.0 + frame as f32);
            let image = Plane::from_fn(320, 240, |column, row| {
                let (u, v) = ((column as f32 - x) / 8.0, (row as f32 - y) / 6.0);
                120.0 + normal.sample(&mut rng) + 100.0 * (-0.5 * (u * u + v * v)).exp()
            });
            scene.register(&image, 1.0 / 30.0);
            assert!(
                scene.turned().iter().all(|turned| turned.abs() < 1.0),
                "{frame}: {:?}",
                scene.turned()
            );
            scene.keep(&image);
        }
    }

    fn with_blob(mut image: Plane, column: usize) -> Plane {
        for y in 100..106 {
            image.row_mut(y)[column..column + 8].fill(250.0);
        }
        image
    }

    #[test]
    fn what_has_changed_is_what_has_come_and_what_has_gone() {
        let mut scene = SceneMemory::default();

        let mut change = Plane::default();
        assert!(!scene.change(&clouds([0.0; 2], 0.5, 1), &mut change));
        for frame in 0..40_usize {
            let image =
                with_blob(clouds([0.4 * frame as f64, 0.0], 0.5, frame as u64), 60 + 3 * frame);
            scene.register(&image, 1.0 / 30.0);
            let is_known = scene.change(&image, &mut change);
            assert!(is_known || frame < 20, "frame {frame}");
            scene.keep(&image);
        }
        let column = 60 + 3 * 39 + 4;
        assert!(change.row(103)[column] > 60.0);
        let elsewhere = (20..220).filter(|y| !(95..112).contains(y));
        let worst = elsewhere
            .flat_map(|y| &change.row(y)[20..290])
            .fold(0.0, |most: f32, c| most.max(c.abs()));
        assert!(worst < 8.0, "{worst}");
    }

    /// Waves of 12 to 40 px, which are others after a quarter of a second, and signs written over
    /// the picture.
    fn waves(right: f64, time_s: f64) -> Plane {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let waves: Vec<[f64; 4]> = (0..16)
            .map(|_| {
                let [length, way] = [rng.random_range(12.0..40.0), rng.random_range(0.0..TAU)];
                let number = TAU / length;
                let speed = rng.random_range(-6.0..6.0);
                [number * f64::cos(way), number * f64::sin(way), speed, rng.random_range(0.0..TAU)]
            })
            .collect();
        let mut image = Plane::from_fn(640, 480, |x, y| {
            let height = |[along, down, speed, phase]: &[f64; 4]| {
                (along * (x as f64 + right) + down * y as f64 + speed * time_s + phase).sin()
            };
            120.0 + 5.0 * waves.iter().map(height).sum::<f64>() as f32
        });
        for y in 12..28 {
            let row = image.row_mut(y);
            (20..600).filter(|x| x % 16 < 8).for_each(|x| row[x] = 250.0);
        }
        image
    }

    #[test]
    fn a_turn_over_waves_is_found_from_image_to_image_and_the_waves_are_no_turn() {
        let mut scene = SceneMemory::default();
        let mut image = |seconds: f64, right: f64| {
            let image = waves(right, seconds);
            scene.register(&image, 1.0 / 30.0);
            scene.keep(&image);
            scene.turned()
        };
        let mut before = [0.0; 2];
        for frame in 0..15 {
            before = image(f64::from(frame) / 30.0, 0.0);
        }
        assert!(
            before[0].hypot(before[1]) < 12.0,
            "what the waves themselves have moved: {before:?}"
        );
        for frame in 15..35 {
            let right = 20.0 * f64::from((frame - 14).min(10));
            let turned = image(f64::from(frame) / 30.0, right);
            // The pictures alone show 21 of the 200 px.
            let off = [turned[0] - before[0] - right, turned[1] - before[1]];
            assert!(off[0].hypot(off[1]) < 20.0, "image {frame}: {turned:?}");
        }
    }

    #[test]
    fn pictures_reach_back_for_seconds_and_are_few() {
        let mut scene = SceneMemory::default();
        for frame in 0..600 {
            let image = clouds([0.0; 2], 1.0, frame);
            scene.register(&image, 1.0 / 30.0);
            scene.keep(&image);
            let mut ages = scene.pictures().map(|picture| picture.age_s);
            let tells = ages.any(|age_s| (CHANGED_S / 2.0..=CHANGED_S * 2.0).contains(&age_s));
            assert!(tells || frame < 20, "frame {frame}");
        }
        let ages: Vec<f64> = scene.pictures().map(|picture| picture.age_s).collect();
        assert_eq!(ages.len(), PICTURES);
        assert!(
            ages.is_sorted() && (5.0 * SPACING_S..7.0 * SPACING_S).contains(&ages[PICTURES - 1]),
            "{ages:?}"
        );
    }
}
