//! How far each camera can be believed.
//!
//! How large a camera's errors are is found from all lines together ([`crate::pose_scale`]), and such a camera
//! counts less; here is what that cannot find: a camera whose lines miss the targets by so much that no track
//! takes them, and one whose frames come at impossible times. A target that a camera does not report accuses
//! nobody: something may stand in between. Only a line beside a target that three other cameras see does.

use std::collections::BTreeMap;

use crossfix_message::{CameraName, Timestamp};

/// What is remembered of a camera, s: long enough for a bird beside a target to pass, short enough for a
/// camera that has been put right to come back.
const MEMORY_S: f64 = 5.0;
/// Evidence that a verdict needs, s.
const LEAST_EVIDENCE_S: f64 = 3.0;
/// A camera that misses the targets, or whose frames are refused, in this share of the time is left out.
const EXCLUSION: f64 = 0.7;
/// It comes back when it does so in less than this.
const RETURN: f64 = 0.3;
/// Frames further apart than this count no longer than it, s.
const LONGEST_STEP_S: f64 = 1.0;

/// How far a camera is believed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraStanding {
    /// Its bearings are as good as it says.
    Good,
    /// Its bearings miss the targets by more than is declared of its pose: they count less.
    Doubted,
    /// Its bearings pass beside the targets that the others see, or its frames are refused: pose or clock must
    /// be wrong. They are compared and not used, until they fit again.
    Excluded,
}

/// How a camera's exposure fits the targets that three other cameras see.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Fitting {
    /// It has a bearing of such a target.
    Fits,
    /// It has one beside it, and none of it.
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
    /// Notes how a target that so many other cameras see is fitted; `None` says nothing.
    pub(crate) fn add(&mut self, others: usize, fitting: Option<Fitting>) {
        if others >= 2 {
            self.of_two.extend(fitting);
        }
        if others >= 3 {
            self.of_three.extend(fitting);
        }
    }
}

#[derive(Clone, Copy, Debug)]
struct Record {
    /// Share of the time in which it has been wrong.
    wrong: f64,
    /// Evidence so far, s.
    evidence_s: f64,
    last: Timestamp,
    excluded: bool,
}

/// The standing of every camera, by one kind of evidence.
#[derive(Clone, Debug, Default)]
pub(crate) struct Standings {
    records: BTreeMap<CameraName, Record>,
}

impl Standings {
    /// Takes in how an exposure fits, by its camera's own clock. All targets of one exposure are one piece of
    /// evidence: they share its pose and time.
    pub(crate) fn learn(&mut self, camera: &CameraName, time: Timestamp, fittings: &[Fitting]) {
        if fittings.is_empty() {
            return;
        }
        let new = Record { wrong: 0.0, evidence_s: 0.0, last: time, excluded: false };
        let record = self.records.entry(camera.clone()).or_insert(new);
        let step_s = time.seconds_since(record.last).abs().min(LONGEST_STEP_S);
        record.last = time;
        record.evidence_s = (record.evidence_s + step_s).min(MEMORY_S);
        let wrong = fittings.iter().filter(|fitting| **fitting != Fitting::Fits).count();
        let share = wrong as f64 / fittings.len() as f64;
        record.wrong += (share - record.wrong) * (step_s / record.evidence_s.max(step_s)).min(1.0);
    }

    /// A camera has been left out: what was held against the others was found beside what it said.
    pub(crate) fn acquit_others(&mut self, camera: &CameraName) {
        for (_, record) in
            self.records.iter_mut().filter(|(name, record)| *name != camera && !record.excluded)
        {
            (record.wrong, record.evidence_s) = (0.0, 0.0);
        }
    }

    /// A camera's exposure at a time says nothing for or against it. Where that goes on for long, as there is no
    /// target left to compare it with, a verdict lapses: returns whether one has.
    pub(crate) fn lapse(&mut self, camera: &CameraName, time: Timestamp) -> bool {
        let lapsed = self
            .records
            .get_mut(camera)
            .filter(|record| record.excluded && time.seconds_since(record.last).abs() > MEMORY_S);
        lapsed.is_some_and(|record| {
            *record = Record { wrong: 0.0, evidence_s: 0.0, last: time, excluded: false };
            true
        })
    }

    /// Whether a camera is left out.
    pub(crate) fn is_excluded(&self, camera: &CameraName) -> bool {
        self.records.get(camera).is_some_and(|record| record.excluded)
    }

    /// Leaves a camera out or lets it back in; returns the new standing if that has changed.
    pub(crate) fn review(&mut self, camera: &CameraName) -> Option<CameraStanding> {
        let record = self.records.get_mut(camera).filter(|r| r.evidence_s >= LEAST_EVIDENCE_S)?;
        let excluded = if record.excluded { record.wrong > RETURN } else { record.wrong > EXCLUSION };
        let changed = excluded != record.excluded;
        record.excluded = excluded;
        let standing = if excluded { CameraStanding::Excluded } else { CameraStanding::Good };
        changed.then_some(standing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> CameraName {
        text.parse().unwrap()
    }

    /// The verdicts on a camera that gives the same evidence `rate` times a second.
    fn verdicts(fittings: &[&[Fitting]], rate: f64) -> Vec<CameraStanding> {
        let (mut standings, camera) = (Standings::default(), name("a"));
        let mut verdicts = Vec::new();
        let mut time = Timestamp::EPOCH;
        for fitting in fittings {
            for _ in 0..(8.0 * rate) as usize {
                time = time.plus_seconds(rate.recip());
                standings.learn(&camera, time, fitting);
                verdicts.extend(standings.review(&camera));
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
                [CameraStanding::Excluded, CameraStanding::Good],
                "{rate} Hz"
            );
        }
    }

    #[test]
    fn a_verdict_lapses_where_nothing_is_left_to_compare_with() {
        let (mut standings, camera) = (Standings::default(), name("a"));
        let at = |seconds: f64| Timestamp::EPOCH.plus_seconds(seconds);
        for k in 0..50 {
            standings.learn(&camera, at(0.1 * f64::from(k)), &[Fitting::Beside]);
        }
        assert_eq!(standings.review(&camera), Some(CameraStanding::Excluded));
        assert!(!standings.lapse(&camera, at(9.0)));
        assert!(standings.lapse(&camera, at(10.0)));
        assert!(!standings.is_excluded(&camera) && !standings.lapse(&camera, at(20.0)));
    }

    #[test]
    fn what_was_held_against_others_beside_a_camera_that_is_left_out_is_void() {
        let (mut standings, [one, other]) = (Standings::default(), ["a", "b"].map(name));
        for k in 0..50 {
            let time = Timestamp::EPOCH.plus_seconds(0.1 * f64::from(k));
            standings.learn(&one, time, &[Fitting::Beside]);
            standings.learn(&other, time, &[Fitting::Beside]);
        }
        assert_eq!(standings.review(&one), Some(CameraStanding::Excluded));
        standings.acquit_others(&one);
        assert_eq!(standings.review(&other), None);
        assert!(standings.is_excluded(&one) && !standings.is_excluded(&other));
    }

    #[test]
    fn a_target_that_is_not_reported_accuses_nobody() {
        assert_eq!(verdicts(&[&[], &[], &[]], 25.0), []);
    }

    #[test]
    fn a_camera_whose_frames_are_refused_is_left_out() {
        assert_eq!(verdicts(&[&[Fitting::Refused]], 30.0), [CameraStanding::Excluded]);
    }

    #[test]
    fn one_target_of_three_that_is_missed_is_no_crime() {
        use Fitting::{Beside, Fits};
        assert_eq!(verdicts(&[&[Fits, Beside, Fits]], 25.0), []);
    }
}
