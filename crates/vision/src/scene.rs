//! What the scene looks like without the targets: a few pictures of the last seconds, and by how
//! much the camera has turned since each.
//!
//! What a target hides shows in a picture in which the target was elsewhere. Where the image is the
//! same as in such a picture it shows the scene and no target, however well a reference correlates.

use crossfix_correlation::Plane;

use crate::ImagePoint;
use crate::coarse_picture::{COARSENESS, CoarsePictures, CoarseScratch};
use crate::coarse_turn::{FoundTurn, fits_better, turn_between};
use crate::crop::replace_invalid;
use crate::jerk::RowGlance;
use crate::registration::{LEAST_COMMON, PicturePair, STRIDE};
use crate::scene_turn::SceneTurn;

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
/// A camera stands still that has turned no place of the image by more than this since it was last
/// registered, px ...
const STILL_PX: f64 = 0.25;
/// ... and is registered again after this long, s, unless it is jerked: with half of it an image of
/// 640x512 costs 0.1 ms more. With half of the first what noise moves, 0.1 px, keeps more images
/// registered.
const STILL_S: f64 = 0.1;

/// For this long after a turn that shows by itself the camera counts as turning, s: a few images,
/// of which one may show nothing. With half of it a shaken camera counts as still between its
/// turns; with twice as much the same.
const TURNS_ON_S: f64 = 0.2;
/// Roll and zoom of an older picture may have drifted by as much as they change in this time, s:
/// its turn is the sum of many. With half of it they are put right half as fast where little shows
/// them.
const DRIFTS_S: f64 = 0.1;
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
    coarse: CoarsePictures,
    age_s: f64,
    number: u64,
    /// Where what is in the image now was in this picture.
    turn: SceneTurn,
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

    /// Where what is in the image now was in this picture.
    pub(crate) fn turn(&self) -> SceneTurn {
        self.turn
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
    /// The coarse pictures of the image that was registered last, ...
    coarse: CoarsePictures,
    /// ... what it was before it was smoothed, and the same of the image registered before that;
    /// empty if there was none.
    sharp: Plane,
    sharp_before: Plane,
    scratch: CoarseScratch,
    sums: Vec<f32>,
    /// Number of pictures kept since the beginning.
    count: u64,
    /// For how long the camera still counts as turning, and the time since it was registered last,
    /// s.
    turning_s: f64,
    unregistered_s: f64,
    glance: RowGlance,
    /// Where what was in the newest picture was at the beginning.
    turned: SceneTurn,
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

    /// Where what is in the image now was at the beginning.
    pub(crate) fn turned(&self) -> SceneTurn {
        let newest = self.pictures.first().map_or(SceneTurn::none(), |newest| newest.turn);
        newest.and_then(self.turned)
    }

    /// Forgets all pictures.
    pub(crate) fn clear(&mut self) {
        self.turned = self.turned();
        self.pictures.clear();
        (self.glance, self.turning_s) = (RowGlance::default(), 0.0);
        // The next image is registered with none before it.
        self.sharp = Plane::default();
    }

    /// Finds how the camera has turned by registering the image with the newest picture; against
    /// that one the other pictures are shifted as when it was taken. Where the camera may have
    /// turned far, or the picture shows nothing, the image registered before says where to begin.
    /// A camera that stood still lately is registered only now and then.
    ///
    /// Returns where what was in the image registered before is now.
    pub(crate) fn register(&mut self, image: &Plane, interval: f64) -> SceneTurn {
        self.unregistered_s += interval;
        for picture in &mut self.pictures {
            picture.age_s += interval;
        }
        let is_jerked = self.glance.is_another(image, interval);
        // Half an interval is added so that the image nearest to the time is used.
        let is_time =
            is_jerked || self.is_turning() || self.unregistered_s + interval / 2.0 >= STILL_S;
        // A picture that will be kept needs its coarse version and its shift, whatever the camera
        // does.
        let is_kept = self.pictures.first().is_none_or(|newest| newest.age_s >= SPACING_S);
        if !is_time && !is_kept {
            return SceneTurn::none();
        }
        let since_s = std::mem::take(&mut self.unregistered_s);
        std::mem::swap(&mut self.sharp_before, &mut self.sharp);
        self.coarse.take(image, &mut self.sharp, &mut self.scratch);
        self.turning_s = (self.turning_s - since_s).max(0.0);
        let Some(before) = self.pictures.first().map(|newest| newest.turn) else {
            return SceneTurn::none();
        };
        let found = if self.is_unregistered {
            FoundTurn { turn: before, is_significant: false }
        } else {
            self.turn_from(before, is_jerked, since_s)
        };
        // Where what is in the image now was in the image before.
        let step = found.turn.and_then(before.inverse());
        for picture in &mut self.pictures {
            picture.turn = step.and_then(picture.turn);
        }
        if found.is_significant && farthest_moved(step, image) >= STILL_PX {
            self.turning_s = TURNS_ON_S;
        }
        step.inverse()
    }

    /// Where what is in the image was in the newest picture, which was `before` for the image
    /// registered `since_s` seconds before. What neither of the two shows has not turned.
    fn turn_from(&mut self, before: SceneTurn, is_jerked: bool, since_s: f64) -> FoundTurn {
        let unknown = |turn: SceneTurn| FoundTurn { turn, is_significant: false };
        let seen = self.seen_near(before, since_s);
        let near = seen.unwrap_or(unknown(before));
        // The picture shows a large turn only near a first guess, and that of a scene which is fine
        // or changes quickly not at all.
        if !is_jerked && (seen.is_some() || !self.is_turning()) {
            return near;
        }
        let step = near.turn.and_then(before.inverse());
        let Some(shift) = self.shift_since(since_s, step) else { return near };
        let guess = SceneTurn::shift(shift).and_then(before);
        let far = self.seen_near(guess, since_s).unwrap_or(unknown(guess));
        // The far turn was found from image to image: the picture, which may show nothing, only
        // refuses it.
        if self.shows_rather(near.turn, far.turn) {
            return near;
        }
        FoundTurn { is_significant: true, ..far }
    }

    /// The turn against the newest picture, if it determines one near a first guess.
    fn seen_near(&self, guess: SceneTurn, since_s: f64) -> Option<FoundTurn> {
        let then = &self.pictures.first()?.coarse;
        turn_between(&self.coarse, then, guess, since_s, self.is_turning())
    }

    /// Whether the newest picture shows one turn rather than another.
    fn shows_rather(&self, turn: SceneTurn, than: SceneTurn) -> bool {
        let newest = self.pictures.first();
        newest.is_some_and(|then| fits_better(&self.coarse, &then.coarse, turn, than))
    }

    /// Whether the camera has turned a moment ago.
    fn is_turning(&self) -> bool {
        self.turning_s > 0.0
    }

    /// By how much the camera has turned since the image registered `since_s` seconds before, px:
    /// by another shift than near a first guess only if that fits better.
    fn shift_since(&mut self, since_s: f64, guess: SceneTurn) -> Option<[f64; 2]> {
        let pair = PicturePair::successive(&self.sharp, &self.sharp_before, &mut self.sums)?;
        let side = COARSENESS as f64;
        let [x, y] =
            [self.sharp.width(), self.sharp.height()].map(|n| (n as f64 * side - 1.0) / 2.0);
        let near = guess.moves(ImagePoint { x, y }).map(|px| (px / side) as f32);
        let turn = pair.shift(near)?.map(|turn| f64::from(turn) * side);
        (turn[0].hypot(turn[1]) > LEAST_TURN_PX.max(LEAST_TURN_PX_S * since_s)).then_some(turn)
    }

    /// Keeps a picture if it is time to, and returns its number.
    pub(crate) fn keep(&mut self, image: &Plane) -> Option<u64> {
        let is_new = self.pictures.first().is_some_and(|newest| newest.age_s < SPACING_S);
        let coarse = &self.coarse.coarse;
        let used = (coarse.width() / STRIDE) * (coarse.height() / STRIDE);
        if is_new || (used as f32) < LEAST_COMMON {
            return None;
        }
        // Each picture is registered itself, so that errors do not add up from picture to picture.
        if !self.is_unregistered {
            let is_turning = self.is_turning();
            // The newest one has just been.
            for picture in self.pictures.iter_mut().skip(1) {
                let (now, then) = (&self.coarse, &picture.coarse);
                let found = turn_between(now, then, picture.turn, DRIFTS_S, is_turning);
                picture.turn = found.map_or(picture.turn, |found| found.turn);
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
        (kept.age_s, kept.turn, kept.number) = (0.0, SceneTurn::none(), self.count);
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
        let Some(ScenePicture { image: before, turn, .. }) = nearest else { return false };
        change.reshape(image.width(), image.height());
        for y in 0..image.height() {
            let from = turn.place(ImagePoint { x: 0.0, y: y as f64 });
            let to = turn.place(ImagePoint { x: 1.0, y: y as f64 });
            let step = [(to.x - from.x) as f32, (to.y - from.y) as f32];
            let [first_x, first_y] = [from.x as f32, from.y as f32];
            let row = change.row_mut(y).iter_mut().zip(image.row(y));
            for (x, (out, now)) in row.enumerate() {
                let then = [first_x + x as f32 * step[0], first_y + x as f32 * step[1]];
                // I(x) - I_then(where x was).
                *out = between_four(before, then).map_or(0.0, |then| now - then);
            }
        }
        true
    }
}

/// A picture between four pixels, by linear interpolation; `None` beyond the border.
#[inline(always)]
fn between_four(picture: &Plane, [x, y]: [f32; 2]) -> Option<f32> {
    let last = [picture.width(), picture.height()].map(|side| side as f32 - 1.0);
    if !(x >= 0.0 && y >= 0.0 && x < last[0] && y < last[1]) {
        return None;
    }
    let (column, row) = (x as usize, y as usize);
    let [right, down] = [x - column as f32, y - row as f32];
    let along = |row: &[f32]| row[column] + right * (row[column + 1] - row[column]);
    let [above, below] = [row, row + 1].map(|row| along(picture.row(row)));
    Some(above + down * (below - above))
}

/// How far a turn moves the middle of an image or a corner, px: the farthest of them.
fn farthest_moved(turn: SceneTurn, image: &Plane) -> f64 {
    let [right, down] = [image.width(), image.height()].map(|side| side as f64 - 1.0);
    let places = [[0.0, 0.0], [right, 0.0], [0.0, down], [right, down], [right / 2.0, down / 2.0]];
    let moved = places.map(|[x, y]| turn.moves(ImagePoint { x, y }));
    moved.iter().map(|[right, down]| right.hypot(*down)).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};

    use super::*;

    /// The middle of a picture of 320x240.
    const MIDDLE: ImagePoint = ImagePoint { x: 159.5, y: 119.5 };

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
            let [right, down] = oldest.turn.moves(MIDDLE);
            let off = [right - 0.8 * frames, down + 0.5 * frames];
            assert!(
                off.iter().all(|off| off.abs() < most),
                "{off:?} of {frames} frames, noise {noise}"
            );
        }
    }

    /// A camera that pans and looks up rolls, and one that is zoomed makes all larger: what is at
    /// the edge of the image is known where it was, too.
    #[test]
    fn a_roll_and_a_zoom_of_the_camera_are_found() {
        for (rolls, zooms) in [(0.2, 0.0), (0.0, 0.3), (-0.1, 0.1)] {
            let mut scene = SceneMemory::default();
            // Over a second and a half to the end.
            let turn = |frame: u32| {
                let share = f64::from(frame) / 45.0;
                SceneTurn::about(MIDDLE, [20.0 * share, 0.0], zooms * share, rolls * share)
            };
            for frame in 0..=45 {
                let at =
                    |x: usize, y: usize| turn(frame).place(ImagePoint { x: x as f64, y: y as f64 });
                let image = Plane::from_fn(320, 240, |x, y| {
                    let ImagePoint { x, y } = at(x, y);
                    let waves = (x / 17.0).sin() * (y / 13.0).cos() + ((x + 0.7 * y) / 29.0).sin();
                    130.0 + 25.0 * waves as f32
                });
                scene.register(&image, 1.0 / 30.0);
                scene.keep(&image);
            }
            let newest = scene.pictures().next().unwrap();
            let taken = 45 - (newest.age_s * 30.0).round() as u32;
            for place in
                [MIDDLE, ImagePoint { x: 20.0, y: 20.0 }, ImagePoint { x: 300.0, y: 120.0 }]
            {
                let since = turn(45).and_then(turn(taken).inverse());
                for (found, truth) in [(newest.turn, since), (scene.turned(), turn(45))] {
                    let (found, truth) = (found.place(place), truth.place(place));
                    let off = (found.x - truth.x).hypot(found.y - truth.y);
                    assert!(off < 1.0, "roll {rolls}, zoom {zooms}, {place:?}: {off}");
                }
            }
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
            let shifts = scene.pictures().flat_map(|picture| picture.turn.moves(MIDDLE));
            assert!(shifts.into_iter().all(|shift| shift.abs() < 2.0));
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
            let turned = scene.turned().moves(MIDDLE);
            assert!(turned.iter().all(|turned| turned.abs() < 1.0), "{frame}: {turned:?}");
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
            scene.turned().moves(MIDDLE)
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
