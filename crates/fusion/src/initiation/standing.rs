//! Whether lines to what stands in the cameras' views cross by chance.

use std::collections::BTreeMap;

use crossfix_message::CameraName;

use crate::Exposure;
use crate::cameras::Rooted;
use crate::evidence::ONE_IN_A_HUNDRED;

/// How many things stand in each camera's view that no track explains, in each of the last periods
/// of which lines count.
#[derive(Debug)]
pub(crate) struct StandingLines {
    /// Number of periods that count.
    span: u64,
    /// Largest number of lines in an exposure, by period.
    numbers: BTreeMap<CameraName, BTreeMap<u64, usize>>,
}

impl StandingLines {
    pub(crate) fn new(span: u64) -> Self {
        Self { span, numbers: BTreeMap::new() }
    }

    /// Takes in the exposures of a period.
    pub(crate) fn see(&mut self, period: u64, exposures: &[&Exposure]) {
        for exposure in exposures {
            let stands = exposure.sightings.iter().filter(|seen| seen.rooted == Rooted::Yes);
            let number = stands.count();
            let of_camera = self.numbers.entry(exposure.camera.clone()).or_default();
            let most = of_camera.entry(period).or_default();
            *most = number.max(*most);
        }
        for of_camera in self.numbers.values_mut() {
            of_camera.retain(|seen, _| seen + self.span > period);
        }
    }

    /// Whether some lines of all these cameras to such things may cross by chance. They stand along
    /// the horizon: a line to one passes through the place that other cameras' lines make in one
    /// case of a hundred, so that n cameras with `N_k` of them each make `N_1 ... N_n / 100^(n - 1)`
    /// such places. More than one in a hundred is too many.
    pub(crate) fn may_cross<'a>(&self, cameras: impl Iterator<Item = &'a CameraName>) -> bool {
        let number = |name| self.numbers.get(name)?.values().copied().max();
        let logs: Vec<f64> =
            cameras.map(|name| (number(name).unwrap_or(0).max(1) as f64).ln()).collect();
        logs.iter().sum::<f64>() + (logs.len() as f64 - 2.0) * ONE_IN_A_HUNDRED > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: of two cameras each may have one, as 1 / 100 is not more than one in a hundred; of
    /// three the product may be up to a hundred.
    #[test]
    fn two_cameras_may_have_one_standing_thing_each_and_three_about_five() {
        let names = ["a", "b", "c"].map(|name| name.parse::<CameraName>().unwrap());
        let crosses = |numbers: &[usize]| {
            let mut lines = StandingLines::new(2);
            for (name, number) in names.iter().zip(numbers) {
                lines.numbers.insert(name.clone(), BTreeMap::from([(1, *number)]));
            }
            lines.may_cross(names.iter().take(numbers.len()))
        };
        assert!(!crosses(&[1, 1]) && crosses(&[1, 2]) && crosses(&[2, 2]));
        assert!(!crosses(&[4, 4, 6]) && crosses(&[5, 5, 5]));
        // Of one camera alone there is nothing to cross.
        assert!(crosses(&[1]));
    }

    #[test]
    fn only_the_last_periods_count() {
        let name: CameraName = "a".parse().unwrap();
        let mut lines = StandingLines::new(2);
        lines.numbers.insert(name.clone(), BTreeMap::from([(1, 3), (2, 1)]));
        lines.see(2, &[]);
        assert_eq!(lines.numbers[&name].values().max(), Some(&3));
        lines.see(3, &[]);
        assert_eq!(lines.numbers[&name].values().max(), Some(&1));
    }
}
