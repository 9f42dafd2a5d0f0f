//! What is right and wrong about the tracks of a site.

use std::fmt;

use crossfix_fusion::{FusedTrack, Fusion};
use crossfix_message::Timestamp;
use nalgebra::Point3;

use super::site::DrawnSite;

/// Looks begin so long after the first frame, s, ...
const SKIP_S: f64 = 5.0;
/// ... and are this far apart, s.
const EVERY_S: f64 = 0.25;
/// A track is on a target that is nearer than this, m, or than four of its stated deviations.
const NEAR_M: f64 = 5.0;
/// As many of its stated deviations may a track be off.
const MOST_DEVIATIONS: f64 = 4.0;

/// Counts of looks, targets and answers.
#[derive(Default)]
pub struct Tally {
    begun: Option<Timestamp>,
    next: Option<Timestamp>,
    sites: usize,
    /// Targets that two cameras have in view, over all looks, and those of them with a track.
    targets: usize,
    found: usize,
    /// Answers: confirmed tracks, over all looks; those beyond four stated deviations of the
    /// nearest target, and those near none.
    answers: usize,
    beyond: usize,
    elsewhere: usize,
    /// Squared error of the position in each answer by its covariance (NEES). Half of them are
    /// above 2.37 where the covariance is right.
    squares: Vec<f64>,
    /// Errors of those on a target, m.
    errors: Vec<f64>,
}

impl Tally {
    /// Names of the columns.
    pub const HEADING: &str = "sites   found  beyond   elsewhere     NEES  error, m";

    /// Looks at the tracks, where it is time to.
    pub fn look(&mut self, fusion: &Fusion, site: &DrawnSite) {
        let Some(now) = fusion.now() else { return };
        self.sites = 1;
        let begun = *self.begun.get_or_insert(now);
        let next = *self.next.get_or_insert(begun.plus_seconds(SKIP_S));
        if now < next {
            return;
        }
        self.next = Some(now.plus_seconds(EVERY_S));
        let mut found = Vec::new();
        for track in fusion.tracks().filter(|track| track.is_confirmed()) {
            found.extend(self.answer(track, &site.targets_at(track.updated_at)));
        }
        for (index, place) in site.targets_at(now).into_iter().enumerate() {
            if site.seen_by(place, now) >= 2 {
                self.targets += 1;
                self.found += usize::from(found.contains(&index));
            }
        }
    }

    /// Counts an answer; the target that it is on.
    fn answer(&mut self, track: &FusedTrack, targets: &[Point3<f64>]) -> Option<usize> {
        let place = track.state().position();
        let distance = |target: &Point3<f64>| (place - target).norm();
        let (index, error) = targets
            .iter()
            .map(distance)
            .enumerate()
            .min_by(|(_, one), (_, other)| one.total_cmp(other))?;
        let covariance = track.state().position_covariance();
        let off = place - targets[index];
        self.answers += 1;
        self.squares.extend(covariance.cholesky().map(|root| off.dot(&root.solve(&off))));
        let is_beyond = error > MOST_DEVIATIONS * covariance.trace().sqrt();
        self.beyond += usize::from(is_beyond);
        if is_beyond && error > NEAR_M {
            self.elsewhere += 1;
            return None;
        }
        self.errors.push(error);
        Some(index)
    }

    /// Adds those of another site.
    pub fn add(&mut self, other: Self) {
        self.sites += other.sites;
        self.targets += other.targets;
        self.found += other.found;
        self.answers += other.answers;
        self.beyond += other.beyond;
        self.elsewhere += other.elsewhere;
        self.squares.extend(other.squares);
        self.errors.extend(other.errors);
    }
}

/// The middle one of some numbers.
fn median(numbers: &[f64]) -> f64 {
    let mut sorted = numbers.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

impl fmt::Display for Tally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let share = |count: usize, of: usize| count as f64 / of.max(1) as f64;
        write!(
            f,
            "{:>5}  {:.4} {:>6.2} % {:>8.2} %  {:>7.2}  {:>8.3}",
            self.sites,
            share(self.found, self.targets),
            100.0 * share(self.beyond, self.answers),
            100.0 * share(self.elsewhere, self.answers),
            median(&self.squares),
            median(&self.errors),
        )
    }
}
