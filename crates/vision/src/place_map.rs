//! Where a lost target may be: one probability of every place of the image, carried through all the
//! images of a search (track before detect by a Bayesian filter on a grid).
//!
//! A small target in noise stands out of no single image, and the likeliest of a hundred thousand
//! places is another one. But it is in the next image too, about where it was, and chance is not.

use crossfix_correlation::Plane;
use pulp::Arch;

use crate::lanes;

/// Mean time for which a target that is lost cannot be seen, s, and for which it then can. With
/// half of either the noise of a longer search passes for a target, with twice as much one that
/// comes out of a cloud is found a few images later.
const HIDDEN_S: f64 = 1.0;
const VISIBLE_S: f64 = 2.0;
/// Most that one image says for a place, nats: what looks like the target by its noise has a
/// likelihood that no model of noise foresees, but it is elsewhere in the next image.
const MOST_OF_IMAGE: f32 = 6.0;

/// The distribution over the places of a coarse picture, and its buffers.
#[derive(Clone, Debug)]
pub(crate) struct PlaceMap {
    /// Side of a place, px.
    coarseness: usize,
    /// Probability of each place.
    places: Plane,
    /// Probability that the target cannot be seen anywhere.
    nowhere: f32,
    /// What the scene has moved by since the last image and no whole place makes up, px.
    left_over: [f64; 2],
    between: Plane,
}

/// The likeliest place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LikeliestPlace {
    pub(crate) column: usize,
    pub(crate) row: usize,
    /// Probability that the target is there or next to it.
    pub(crate) probability: f32,
}

impl PlaceMap {
    /// A map of a coarse picture with places of `coarseness` px on which nothing is known yet but a
    /// `prior`, up to a factor, of each place: whether the target can be seen is as likely as not.
    pub(crate) fn new(
        coarseness: usize,
        [width, height]: [usize; 2],
        prior: impl FnMut(usize, usize) -> f32,
    ) -> Self {
        let mut places = Plane::from_fn(width, height, prior);
        let sum: f32 = places.samples().iter().sum();
        let share = 0.5 / sum.max(f32::MIN_POSITIVE);
        places.samples_mut().iter_mut().for_each(|place| *place *= share);
        Self { coarseness, places, nowhere: 0.5, left_over: [0.0; 2], between: Plane::default() }
    }

    /// Whether it is one of pictures of these sides and coarseness.
    pub(crate) fn fits(&self, coarseness: usize, sides: [usize; 2]) -> bool {
        self.coarseness == coarseness && [self.places.width(), self.places.height()] == sides
    }

    /// Moves on to an image that is taken `interval` s later: the target has moved by up to `reach`
    /// px on either axis, and the scene by `moved` px.
    pub(crate) fn predict(&mut self, interval: f64, reach: f64, moved: [f64; 2]) {
        let side = self.coarseness as f64;
        let by = [0, 1].map(|i| {
            let moved = self.left_over[i] + moved[i];
            let whole = (moved / side).round();
            self.left_over[i] = moved - whole * side;
            whole as isize
        });
        let half = (reach / side).ceil().max(1.0) as usize;
        spread(&self.places, half, by, &mut self.between);
        // A chain of two states: of what can be seen a share is hidden by now, and the other way
        // round; what appears may be anywhere.
        let hides = -(-interval / VISIBLE_S).exp_m1() as f32;
        let appears = -(-interval / HIDDEN_S).exp_m1() as f32;
        let seen: f32 = self.between.samples().iter().sum();
        let anywhere = appears * self.nowhere / self.places.samples().len() as f32;
        for (place, spread) in self.places.samples_mut().iter_mut().zip(self.between.samples()) {
            *place = (1.0 - hides) * spread + anywhere;
        }
        self.nowhere = (1.0 - appears) * self.nowhere + hides * seen;
    }

    /// Takes in the log likelihood ratios of an image, of the target being at each place against
    /// being nowhere.
    pub(crate) fn update(&mut self, ratios: &Plane) {
        let places = self.places.samples_mut();
        let mut sum = self.nowhere;
        Arch::new().dispatch(|| {
            for (place, ratio) in places.iter_mut().zip(ratios.samples()) {
                *place *= lanes::exp(ratio.min(MOST_OF_IMAGE));
            }
        });
        sum += places.iter().sum::<f32>();
        let share = sum.max(f32::MIN_POSITIVE).recip();
        places.iter_mut().for_each(|place| *place *= share);
        self.nowhere *= share;
    }

    /// The likeliest place, with what is within `near` places of it.
    pub(crate) fn likeliest(&self, near: [usize; 2]) -> LikeliestPlace {
        let peak = self.places.peak();
        let rows = peak.row.saturating_sub(near[1])..(peak.row + near[1] + 1);
        let of_row = |y: usize| {
            let columns = peak.column.saturating_sub(near[0])
                ..(peak.column + near[0] + 1).min(self.places.width());
            self.places.row(y)[columns].iter().sum::<f32>()
        };
        let probability = rows.take_while(|y| *y < self.places.height()).map(of_row).sum();
        LikeliestPlace { column: peak.column, row: peak.row, probability }
    }
}

/// The means of squares of `2 half + 1` places, moved by whole places; nothing comes from beyond the
/// border.
fn spread(from: &Plane, half: usize, [right, down]: [isize; 2], to: &mut Plane) {
    let (width, height) = (from.width() as isize, from.height() as isize);
    to.reshape(from.width(), from.height());
    let share = ((2 * half + 1) as f32).powi(-2);
    let half = half as isize;
    let mut sums = vec![0.0_f32; from.width()];
    for y in 0..height {
        let rows = (y - down - half).max(0)..(y - down + half + 1).min(height);
        sums.fill(0.0);
        for row in rows {
            sums.iter_mut().zip(from.row(row as usize)).for_each(|(sum, place)| *sum += place);
        }
        let out = to.row_mut(y as usize);
        for x in 0..width {
            let first = (x - right - half).clamp(0, width);
            let end = (x - right + half + 1).clamp(first, width);
            out[x as usize] = share * sums[first as usize..end as usize].iter().sum::<f32>();
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const SIDES: [usize; 2] = [160, 120];
    /// Contrast of a target over the noise, as a matched filter finds it in one image: the largest
    /// of 19 200 places of noise alone is 4.1.
    const STANDS_OUT: f32 = 3.0;

    /// Log likelihood ratios of an image of noise, with a target at a place: `c s - s^2 / 2`, where
    /// the filter finds c.
    fn image(rng: &mut ChaCha8Rng, target: Option<[usize; 2]>) -> Plane {
        let mut found = Plane::from_fn(SIDES[0], SIDES[1], |_, _| StandardNormal.sample(&mut *rng));
        if let Some([column, row]) = target {
            found.row_mut(row)[column] += STANDS_OUT;
        }
        found
            .samples_mut()
            .iter_mut()
            .for_each(|c| *c = *c * STANDS_OUT - STANDS_OUT.powi(2) / 2.0);
        found
    }

    fn map() -> PlaceMap {
        PlaceMap::new(2, SIDES, |_, _| 1.0)
    }

    fn total(map: &PlaceMap) -> f32 {
        map.nowhere + map.places.samples().iter().sum::<f32>()
    }

    #[test]
    fn a_target_that_stands_out_of_no_image_is_found_in_a_few() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut images = Vec::new();
        for _ in 0..50 {
            let mut map = map();
            let mut found = None;
            for k in 0..40 {
                // It flies along a row of the map by a place in two images.
                let at = [40 + k / 2, 60];
                map.predict(0.04, 0.0, [0.0; 2]);
                map.update(&image(&mut rng, Some(at)));
                let likeliest = map.likeliest([2, 2]);
                if likeliest.probability > 0.99 {
                    assert!(
                        likeliest.column.abs_diff(at[0]) <= 2 && likeliest.row.abs_diff(60) <= 2
                    );
                    found = Some(k);
                    break;
                }
            }
            images.push(found.unwrap_or(40));
        }
        // An image tells 4.5 nats, less the 2.2 by which nine places are chosen from, and 9.9 + 4.6
        // are needed: about seven images.
        images.sort_unstable();
        assert!((4..=9).contains(&images[25]) && images[45] < 20, "{images:?}");
    }

    #[test]
    fn in_noise_alone_nothing_is_found() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut map = map();
        let found = (0..1500).filter(|_| {
            map.predict(0.04, 0.0, [0.0; 2]);
            map.update(&image(&mut rng, None));
            map.likeliest([2, 2]).probability > 0.99
        });
        assert_eq!(found.count(), 0);
        assert!(map.nowhere > 0.5, "{}", map.nowhere);
    }

    #[test]
    fn what_is_known_moves_with_the_scene() {
        let mut map = map();
        let mut flat = Plane::from_fn(SIDES[0], SIDES[1], |_, _| 0.0);
        flat.row_mut(60)[40] = 6.0;
        for _ in 0..3 {
            map.predict(0.04, 0.0, [0.0; 2]);
            map.update(&flat);
        }
        // Ten images that have turned by 1.4 px to the right and 0.6 up: by seven places and three.
        for _ in 0..10 {
            map.predict(0.001, 0.0, [1.4, -0.6]);
        }
        let likeliest = map.likeliest([2, 2]);
        assert!(
            likeliest.column.abs_diff(47) <= 1 && likeliest.row.abs_diff(57) <= 1,
            "{likeliest:?}"
        );
    }

    proptest! {
        #[test]
        fn whatever_it_is_told_its_probabilities_add_up(
            seed in 0_u64..1000,
            interval in 1e-4..1.0_f64,
            reach in 0.0..500.0_f64,
            moved in prop::array::uniform2(-400.0..400.0_f64),
            scale in 0.0..100.0_f32,
        ) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut map = map();
            for _ in 0..3 {
                map.predict(interval, reach, moved);
                let mut ratios = image(&mut rng, None);
                ratios.samples_mut().iter_mut().for_each(|ratio| *ratio *= scale);
                map.update(&ratios);
                prop_assert!((total(&map) - 1.0).abs() < 1e-3, "{}", total(&map));
            }
        }
    }
}
