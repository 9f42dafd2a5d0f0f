//! How far each camera can be believed.
//!
//! The size of a camera's errors is estimated from all lines together ([`super::pose_scale`]), and
//! a camera with large ones counts less. This file finds what that estimate cannot: a camera whose
//! lines miss the targets by so much that no track takes them, and one whose frames come at
//! impossible times. That a camera does not report a target is no evidence against it: something
//! may stand in between. Only a line beside a target that three other cameras see is.

use crossfix_message::Timestamp;

/// Memory of the evidence on a camera, s: long enough for a bird beside a target to pass, short
/// enough for a camera that has been put right to come back. With half of it the evidence never
/// reaches [`LEAST_EVIDENCE_S`], and no camera is ever left out.
const MEMORY_S: f64 = 5.0;
/// Least evidence for a verdict, s. With half of it a bird that is taken for the target for a
/// second and a half has a camera left out.
const LEAST_EVIDENCE_S: f64 = 3.0;
/// A camera is left out when it misses the targets, or its frames are refused, in more than this
/// share of the time. With half of it, next to [`RETURN`], a camera that misses in every third
/// exposure comes and goes.
const EXCLUSION: f64 = 0.7;
/// It comes back when that share falls below this. With half of it a camera that was always wrong
/// and has been put right comes back after nine seconds, and not after six.
const RETURN: f64 = 0.3;
/// Longest time that the step from one frame to the next counts, s. With half of it a camera of one
/// frame a second gathers its evidence in twice the time; with twice as much, two frames after
/// pauses would be a verdict.
const LONGEST_STEP_S: f64 = 1.0;

/// How far a camera is believed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Its bearings are as good as it says.
    Good,
    /// Its bearings miss the targets by more than is declared of its pose: they count less.
    Doubted,
    /// Its bearings pass beside the targets that the others see, or its frames are refused: pose or
    /// clock must be wrong. They are compared and not used, until they fit again.
    Excluded,
}

/// How a camera's exposure fits the targets that three other cameras see.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Fitting {
    /// The exposure has a bearing of such a target.
    Fits,
    /// It has a bearing beside the target, and none of it.
    Beside,
    /// Its frame was refused for its time.
    Refused,
}

/// How an exposure fits all the sure targets that others see.
#[derive(Clone, Debug, Default)]
pub(crate) struct Fittings {
    /// Those that two others see: enough to suspect a clock.
    pub(crate) of_two: Vec<Fitting>,
    /// Those that three others see: enough to accuse a camera.
    pub(crate) of_three: Vec<Fitting>,
}

impl Fittings {
    /// Notes how the exposure fits a target that `others` other cameras see; `None` says nothing.
    pub(crate) fn add(&mut self, others: usize, fitting: Option<Fitting>) {
        if others >= 2 {
            self.of_two.extend(fitting);
        }
        if others >= 3 {
            self.of_three.extend(fitting);
        }
    }
}

/// Evidence for a verdict on a camera.
#[derive(Clone, Copy, Debug)]
struct StandingEvidence {
    /// Share of the time in which the camera has been wrong.
    wrong: f64,
    /// How long the camera has been compared, s.
    compared_s: f64,
    last: Timestamp,
    excluded: bool,
}

impl StandingEvidence {
    fn beginning(time: Timestamp) -> Self {
        Self { wrong: 0.0, compared_s: 0.0, last: time, excluded: false }
    }
}

/// The record of a camera by one kind of evidence; `None` as long as there was nothing to
/// compare it with.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct StandingRecord(Option<StandingEvidence>);

impl StandingRecord {
    /// Takes in how an exposure fits, at a time by its camera's own clock. All targets of one
    /// exposure are one piece of evidence: they share its pose and time.
    pub(super) fn learn(&mut self, time: Timestamp, fittings: &[Fitting]) {
        if fittings.is_empty() {
            return;
        }
        let evidence = self.0.get_or_insert(StandingEvidence::beginning(time));
        let step_s = time.seconds_since(evidence.last).abs().min(LONGEST_STEP_S);
        evidence.last = time;
        evidence.compared_s = (evidence.compared_s + step_s).min(MEMORY_S);
        let wrong = fittings.iter().filter(|fitting| **fitting != Fitting::Fits).count();
        let share = wrong as f64 / fittings.len() as f64;
        // Running mean over the time compared, of at most MEMORY_S.
        evidence.wrong +=
            (share - evidence.wrong) * (step_s / evidence.compared_s.max(step_s)).min(1.0);
    }

    /// Voids the evidence against this camera, as another one has been left out: this one was
    /// compared with what that one said.
    pub(super) fn acquit(&mut self) {
        if let Some(evidence) = self.0.as_mut().filter(|evidence| !evidence.excluded) {
            (evidence.wrong, evidence.compared_s) = (0.0, 0.0);
        }
    }

    /// Handles an exposure that says nothing for or against the camera. Where that goes on for
    /// long, as there is no target left to compare it with, an exclusion lapses: returns whether it
    /// has.
    pub(super) fn lapse(&mut self, time: Timestamp) -> bool {
        let is_old =
            |evidence: &&mut StandingEvidence| time.seconds_since(evidence.last).abs() > MEMORY_S;
        let lapsed = self.0.as_mut().filter(|evidence| evidence.excluded).filter(is_old);
        lapsed.is_some_and(|evidence| {
            *evidence = StandingEvidence::beginning(time);
            true
        })
    }

    /// Whether the camera is left out.
    pub(super) fn is_excluded(&self) -> bool {
        self.0.is_some_and(|evidence| evidence.excluded)
    }

    /// Leaves the camera out or lets it back in; returns the new standing if that has changed.
    pub(super) fn review(&mut self) -> Option<Standing> {
        let evidence =
            self.0.as_mut().filter(|evidence| evidence.compared_s >= LEAST_EVIDENCE_S)?;
        // Hysteresis: two limits, so that a camera between them does not come and go.
        let limit = if evidence.excluded { RETURN } else { EXCLUSION };
        let excluded = evidence.wrong > limit;
        let changed = excluded != evidence.excluded;
        evidence.excluded = excluded;
        let standing = if excluded { Standing::Excluded } else { Standing::Good };
        changed.then_some(standing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The verdicts on a camera that gives the same evidence `rate` times per second.
    fn verdicts(fittings: &[&[Fitting]], rate: f64) -> Vec<Standing> {
        let mut standing = StandingRecord::default();
        let mut verdicts = Vec::new();
        let mut time = Timestamp::EPOCH;
        for fitting in fittings {
            for _ in 0..(8.0 * rate) as usize {
                time = time.plus_seconds(rate.recip());
                standing.learn(time, fitting);
                verdicts.extend(standing.review());
            }
        }
        verdicts
    }

    #[test]
    fn a_camera_whose_lines_pass_beside_the_targets_is_left_out_and_comes_back_when_they_fit() {
        use Fitting::{Beside, Fits};
        for rate in [2.0, 25.0, 240.0] {
            assert_eq!(verdicts(&[&[Fits], &[Fits]], rate), []);
            assert_eq!(
                verdicts(&[&[Fits], &[Beside], &[Fits]], rate),
                [Standing::Excluded, Standing::Good],
                "{rate} Hz"
            );
        }
    }

    #[test]
    fn a_verdict_lapses_where_nothing_is_left_to_compare_with() {
        let mut standing = StandingRecord::default();
        let at = |seconds: f64| Timestamp::EPOCH.plus_seconds(seconds);
        for k in 0..50 {
            standing.learn(at(0.1 * f64::from(k)), &[Fitting::Beside]);
        }
        assert_eq!(standing.review(), Some(Standing::Excluded));
        assert!(!standing.lapse(at(9.0)));
        assert!(standing.lapse(at(10.0)));
        assert!(!standing.is_excluded() && !standing.lapse(at(20.0)));
    }

    #[test]
    fn what_was_held_against_others_beside_a_camera_that_is_left_out_is_void() {
        let mut both = [StandingRecord::default(); 2];
        for k in 0..50 {
            let time = Timestamp::EPOCH.plus_seconds(0.1 * f64::from(k));
            both.iter_mut().for_each(|standing| standing.learn(time, &[Fitting::Beside]));
        }
        let [mut one, mut other] = both;
        assert_eq!(one.review(), Some(Standing::Excluded));
        one.acquit();
        other.acquit();
        assert_eq!(other.review(), None);
        assert!(one.is_excluded() && !other.is_excluded());
    }

    #[test]
    fn a_target_that_is_not_reported_accuses_nobody() {
        assert_eq!(verdicts(&[&[], &[], &[]], 25.0), []);
    }

    #[test]
    fn a_camera_whose_frames_are_refused_is_left_out() {
        assert_eq!(verdicts(&[&[Fitting::Refused]], 30.0), [Standing::Excluded]);
    }

    #[test]
    fn one_target_of_three_that_is_missed_is_no_crime() {
        use Fitting::{Beside, Fits};
        assert_eq!(verdicts(&[&[Fits, Beside, Fits]], 25.0), []);
    }
}
