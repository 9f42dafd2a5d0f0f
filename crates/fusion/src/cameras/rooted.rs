//! What stands in a camera's view for good (is rooted): trees, horizons, lights, cloud edges.
//! Detectors report such objects again and again in the same place, and the lines of two cameras to
//! two of them cross as a target's do.

use std::cmp::Ordering;

use crossfix_geometry::SightLine;
use crossfix_message::Timestamp;
use nalgebra::{Unit, Vector3};

/// How far a rooted object sways about its middle, rad: a tree of 2 m in the wind at 150 m. With
/// half of it such a tree leaves its place at each sway and passes for something new; with twice as
/// much a target that crosses there at 3 m/s may count as rooted.
const REACH_RAD: f64 = 0.015;
/// Time constant with which the middle follows the swaying object, in units of the time after which
/// an object is rooted: a few periods of a tree. With half of it the middle takes up twice as much
/// of each sway, and more trees pass for something that flies.
const MIDDLE: f64 = 2.0;
/// Least share of the exposures in which a rooted object is reported. With half of it what falls
/// into one place in every sixth exposure by chance is taken for a tree; with twice as much a tree
/// seen in every second one is not.
const LEAST_SHARE: f64 = 0.3;
/// It may fall short of that by this many standard deviations of its number. With half of it a
/// tree that is detected with just that probability passes for something new in one of six
/// exposures; with twice as much what falls into one place by chance is taken for a tree for four
/// times as long.
const SCATTER: f64 = 2.0;
/// Least number of its reports. With half of it two false alarms in one place make a tree; with
/// twice as many a tree before a camera of 2 Hz passes for something new for two seconds longer.
const LEAST_REPORTS: f64 = 3.0;
/// A place that has not been reported for this many times that time is forgotten. With half of it a
/// light that goes out for six seconds, where that time is 1.5 s, comes back as something new.
const FORGOTTEN: f64 = 7.0;
/// A place reported in a smaller share of the exposures since its first report is clutter and not
/// remembered: of clutter there is no end. With half of it twice as many places are searched for
/// each bearing; ten times as much would forget what is seldom detected.
const CLUTTER_SHARE: f64 = 0.03;
/// An object first reported within this share of that time after a camera's first exposure may have
/// been there before. An object seen in three exposures of ten, at 30 a second, appears later than
/// that (0.3 s of 1.5) in one case of 25; with half of it in one of six.
const BEGINNING: f64 = 0.2;
/// Most places that are remembered of a camera, those that are reported most often: clutter cannot
/// fill the memory. With half of it a view of more than 500 leaves and lights takes some of them
/// for new ones.
const MAX_PLACES: usize = 1_000;

/// Whether a bearing is of something that stands in its camera's view for good.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Rooted {
    /// It was there when the camera began to look, which is not long ago.
    #[default]
    Unknown,
    /// It has come or moved.
    No,
    /// It has been there for long.
    Yes,
}

#[derive(Clone, Copy, Debug)]
struct ReportedPlace {
    middle: Unit<Vector3<f64>>,
    /// Where the middle was at [`Self::first`].
    start: Unit<Vector3<f64>>,
    first: Timestamp,
    last: Timestamp,
    reports: f64,
    /// [`ReportedPlaces::exposures`] before its first report.
    before: f64,
}

impl ReportedPlace {
    /// Order in which places are forgotten.
    fn by_reports(&self, other: &Self) -> Ordering {
        self.reports.total_cmp(&other.reports).then(other.first.cmp(&self.first))
    }

    /// Square of the chord from its middle to a direction: at these angles, the angle itself.
    fn chord_squared(&self, direction: Unit<Vector3<f64>>) -> f64 {
        (self.middle.into_inner() - direction.into_inner()).norm_squared()
    }
}

/// The places in a camera's view from which it has reported something lately.
#[derive(Clone, Debug)]
pub(crate) struct ReportedPlaces {
    /// An object that has stayed within reach of one direction for this long is rooted, s: a target
    /// that flies leaves it sooner, and one that hovers has been seen to come.
    rooted_s: f64,
    places: Vec<ReportedPlace>,
    began: Option<Timestamp>,
    exposures: f64,
}

impl ReportedPlaces {
    /// The view of a camera that has not looked yet.
    pub(crate) fn new(rooted_s: f64) -> Self {
        Self { rooted_s, places: Vec::new(), began: None, exposures: 0.0 }
    }

    /// The view of a camera that begins to look again.
    pub(super) fn emptied(&self) -> Self {
        Self::new(self.rooted_s)
    }

    /// Takes in the lines of an exposure; returns for each whether it is of something rooted.
    pub(crate) fn see<'a>(
        &mut self,
        time: Timestamp,
        lines: impl Iterator<Item = &'a SightLine>,
    ) -> Vec<Rooted> {
        let began = *self.began.get_or_insert(time);
        let before = self.exposures;
        self.exposures += 1.0;
        self.places.retain(|place| {
            let is_recent = time.seconds_since(place.last) <= FORGOTTEN * self.rooted_s;
            is_recent && place.reports >= CLUTTER_SHARE * (before - place.before)
        });
        lines.map(|line| self.report(time, began, before, line)).collect()
    }

    /// Forgets the place that has been reported least often; of several, the newest one.
    fn forget_one(&mut self) {
        let places = self.places.iter().enumerate();
        if let Some((index, _)) = places.min_by(|(_, one), (_, other)| one.by_reports(other)) {
            self.places.swap_remove(index);
        }
    }

    fn report(
        &mut self,
        time: Timestamp,
        began: Timestamp,
        before: f64,
        line: &SightLine,
    ) -> Rooted {
        let rooted_s = self.rooted_s;
        // What is there when a camera begins to look may have been there for long.
        let may_be_old = |first: Timestamp| first.seconds_since(began) < BEGINNING * rooted_s;
        let near = self.places.iter_mut().map(|place| (place.chord_squared(line.direction), place));
        let nearest =
            near.filter(|(away, _)| *away <= REACH_RAD.powi(2)).min_by(|a, b| a.0.total_cmp(&b.0));
        let Some((_, place)) = nearest else {
            if self.places.len() >= MAX_PLACES {
                self.forget_one();
            }
            let (middle, start) = (line.direction, line.direction);
            self.places.push(ReportedPlace {
                middle,
                start,
                first: time,
                last: time,
                reports: 1.0,
                before,
            });
            return if may_be_old(time) { Rooted::Unknown } else { Rooted::No };
        };
        // Exponential mean in time, by its first-order share T / tau: many reports in a moment move
        // the middle no faster.
        let share = (time.seconds_since(place.last).max(0.0) / (MIDDLE * rooted_s)).min(1.0);
        let moved = (line.direction.into_inner() - place.middle.into_inner()) * share;
        place.middle = Unit::new_normalize(place.middle.into_inner() + moved);
        place.last = place.last.max(time);
        place.reports += 1.0;
        // A swaying object comes back; a middle that moves on is that of something that flies
        // slowly.
        if (place.middle.into_inner() - place.start.into_inner()).norm() > REACH_RAD {
            (place.start, place.first) = (place.middle, time);
            return Rooted::No;
        }
        let exposures = before + 1.0 - place.before;
        if time.seconds_since(place.first) < rooted_s {
            return if may_be_old(place.first) { Rooted::Unknown } else { Rooted::No };
        }
        // The number of reports of what is detected with a probability of p scatters by
        // sqrt(n p (1 - p)).
        let scatter = (exposures * LEAST_SHARE * (1.0 - LEAST_SHARE)).sqrt();
        let least = (LEAST_SHARE * exposures - SCATTER * scatter).max(LEAST_REPORTS);
        if place.reports >= least { Rooted::Yes } else { Rooted::No }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::spatial::tests_support::line_at;

    #[test]
    fn a_flood_of_bearings_pushes_no_tree_out_of_the_memory() {
        let line = |k: u32| {
            let (x, z) = (f64::from(k % 50) - 25.0, f64::from(k / 50) - 25.0);
            line_at(Point3::origin(), Point3::new(4.0 * x, 100.0, 4.0 * z), 0.0).line
        };
        let mut places = ReportedPlaces::new(1.5);
        let (tree, mut seconds) = (line(0), 0.0);
        let mut at = |lines: &[SightLine], places: &mut ReportedPlaces| {
            seconds += 0.1;
            places.see(Timestamp::from_seconds(seconds), lines.iter())[0]
        };
        for _ in 0..30 {
            at(&[tree], &mut places);
        }
        assert_eq!(at(&[tree], &mut places), Rooted::Yes);
        let flood: Vec<SightLine> = (1..2500).map(line).chain(std::iter::once(tree)).collect();
        at(&flood, &mut places);
        assert_eq!(at(&[tree], &mut places), Rooted::Yes);
    }
}
