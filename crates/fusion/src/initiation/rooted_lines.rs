//! Whether lines to what stands in the cameras' views for good (is rooted) cross by chance.

use std::collections::BTreeMap;

use crossfix_message::{CameraName, Timestamp};

use crate::Exposure;
use crate::cameras::Rooted;

/// For how long the largest number of lines counts, s: what is seldom detected stands there in
/// between, too. With half of it a tree that the detector misses for six seconds is forgotten.
const MEMORY_S: i64 = 10;
/// Things stand along the horizon, and a line to one of them passes through the place that other
/// cameras' lines make in one case of so many (a milliradian in a band of a few degrees); one site
/// in so many may have a crossing by chance. With half of it the lines of three cameras may make
/// fifty sets and not a hundred.
const CASES: f64 = 100.0;

/// How many things have lately stood in each camera's view that no track explains.
#[derive(Debug, Default)]
pub(crate) struct RootedLines {
    /// Largest number of lines in an exposure, by second.
    numbers: BTreeMap<CameraName, BTreeMap<i64, usize>>,
}

impl RootedLines {
    /// Takes in the exposures of a period.
    pub(super) fn see(&mut self, exposures: &[&Exposure]) {
        for exposure in exposures {
            let rooted = exposure.sightings.iter().filter(|seen| seen.rooted == Rooted::Yes);
            self.note(&exposure.camera, exposure.time, rooted.count());
        }
    }

    fn note(&mut self, camera: &CameraName, time: Timestamp, number: usize) {
        let second = time.seconds().floor() as i64;
        let lately = second - MEMORY_S..=second;
        for of_camera in self.numbers.values_mut() {
            of_camera.retain(|then, _| lately.contains(then));
        }
        self.numbers.retain(|_, of_camera| !of_camera.is_empty());
        let of_camera = self.numbers.entry(camera.clone()).or_default();
        let most = of_camera.entry(second).or_default();
        *most = number.max(*most);
    }

    fn number(&self, camera: &CameraName) -> usize {
        self.numbers.get(camera).and_then(|own| own.values().copied().max()).unwrap_or(0)
    }

    /// Whether some lines of as many cameras as these to such things may cross by chance. n cameras
    /// with `N_k` of them each make `N_1 ... N_n / 100^(n - 1)` crossings, and of K cameras that
    /// see such things there are `K! / (n! (K - n)!)` sets of n. More than one in a hundred of all
    /// is too many.
    pub(super) fn may_cross<'a>(&self, cameras: impl Iterator<Item = &'a CameraName>) -> bool {
        let numbers: Vec<f64> = cameras.map(|name| self.number(name).max(1) as f64).collect();
        let size = numbers.len();
        let seeing = self.numbers.keys().filter(|name| self.number(name) > 0).count();
        let sets: f64 =
            (0..size).map(|k| seeing.max(size).saturating_sub(k) as f64 / (k + 1) as f64).product();
        let crossings = numbers.iter().product::<f64>() * sets / CASES.powi(size as i32 - 1);
        // Rounding makes no difference of one that is exactly as many.
        crossings * CASES > 1.0 + 1e-9
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(count: usize) -> Vec<CameraName> {
        (0..count).map(|k| format!("camera{k}").parse().unwrap()).collect()
    }

    /// Whether lines of the first `of` cameras may cross, where these numbers of things stand in
    /// the views.
    fn crosses(numbers: &[usize], of: usize) -> bool {
        let mut lines = RootedLines::default();
        let names = names(numbers.len());
        for (name, number) in names.iter().zip(numbers) {
            lines.note(name, Timestamp::from_seconds(1.0), *number);
        }
        lines.may_cross(names.iter().take(of))
    }

    /// By hand: of two cameras each may have one, 1 / 100; of three the product may be 100, as 100
    /// / 100^2 is one in a hundred.
    #[test]
    fn two_cameras_may_have_one_standing_thing_each_and_three_a_hundred_sets() {
        assert!(!crosses(&[1, 1], 2) && crosses(&[1, 2], 2) && crosses(&[2, 2], 2));
        assert!(!crosses(&[4, 4, 6], 3) && !crosses(&[4, 5, 5], 3) && crosses(&[5, 5, 5], 3));
        // Of one camera alone there is nothing to cross.
        assert!(crosses(&[1], 1));
    }

    /// By hand: six cameras make fifteen pairs and twenty sets of three.
    #[test]
    fn the_more_cameras_see_such_things_the_more_sets_may_cross() {
        assert!(crosses(&[1; 6], 2) && !crosses(&[1, 1, 0, 0, 0, 0], 2));
        assert!(!crosses(&[1; 6], 3) && crosses(&[2; 6], 3));
    }

    #[test]
    fn what_is_seldom_detected_counts_for_ten_seconds() {
        let mut lines = RootedLines::default();
        let name = &names(1)[0];
        lines.note(name, Timestamp::from_seconds(1.0), 3);
        lines.note(name, Timestamp::from_seconds(10.9), 1);
        assert_eq!(lines.number(name), 3);
        // Another camera's line: of one that is silent nothing is left, either.
        let other = &names(2)[1];
        lines.note(other, Timestamp::from_seconds(12.0), 1);
        assert_eq!(lines.number(name), 1);
        lines.note(other, Timestamp::from_seconds(30.0), 1);
        assert_eq!(lines.numbers.len(), 1);
    }
}
