//! How far each camera can be believed: its bearings against the tracks that the others hold.

use std::collections::BTreeMap;

use crossfix_message::CameraName;

/// Exposures that the running means look back on.
const MEMORY: f64 = 50.0;
/// Evidence that a verdict needs.
const LEAST_EVIDENCE: u32 = 30;
/// Residuals this many times what the camera reports (squared) are no accident: its noise counts more.
const DOUBT: f64 = 1.5;
/// Residuals beyond this many times (squared) say that pose or clock are wrong: it is left out.
const EXCLUSION: f64 = 16.0;
/// A camera that hits the others' tracks less often than this is looking elsewhere: it is left out.
const LEAST_HITS: f64 = 0.2;
/// A camera left out comes back when it hits the tracks at least so often, ...
const RETURN_HITS: f64 = 0.6;
/// ... with residuals below this many times what it reports (squared).
const RETURN_RATIO: f64 = 4.0;

/// How far a camera is believed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraStanding {
    /// Its residuals are what it reports.
    Good,
    /// Its residuals are larger: its bearings count less.
    Doubted,
    /// Its bearings do not fit the tracks that the others hold: pose or clock must be wrong. They
    /// are compared and not used, until they fit again.
    Excluded,
}

#[derive(Clone, Debug)]
struct Record {
    /// Running mean of the squared residuals over what is reported; 1 is honest.
    ratio: f64,
    /// Running share of expected bearings that came.
    hits: f64,
    evidence: u32,
    excluded: bool,
}

/// The standing of every camera.
#[derive(Clone, Debug, Default)]
pub(crate) struct Standings {
    records: BTreeMap<CameraName, Record>,
}

impl Record {
    fn new() -> Self {
        Self { ratio: 1.0, hits: 1.0, evidence: 0, excluded: false }
    }

    /// What all tracks of one exposure say is one piece of evidence: they share its pose and time.
    fn learn(&mut self, ratios: &[Option<f64>]) {
        if ratios.is_empty() {
            return;
        }
        self.evidence = self.evidence.saturating_add(1);
        let rate = 1.0 / MEMORY;
        let (came, sum) = ratios.iter().flatten().fold((0.0, 0.0), |(n, sum), ratio| (n + 1.0, sum + ratio));
        self.hits += rate * (came / ratios.len() as f64 - self.hits);
        if came > 0.0 {
            self.ratio += rate * (sum / came - self.ratio);
        }
    }
}

impl Standings {
    /// For each track that others hold and an exposure should show: the bearing's squared distance by
    /// the reported noise (two degrees of freedom), or `None` if none was near.
    pub(crate) fn learn(&mut self, camera: &CameraName, reported_nis: &[Option<f64>]) {
        if !self.records.contains_key(camera) {
            self.records.insert(camera.clone(), Record::new());
        }
        if let Some(record) = self.records.get_mut(camera) {
            let ratios: Vec<Option<f64>> = reported_nis.iter().map(|nis| nis.map(|nis| nis / 2.0)).collect();
            record.learn(&ratios);
        }
    }

    /// What the camera's reported covariances are to be multiplied with.
    ///
    /// What all cameras have in common is no camera's fault: a manoeuvre, or a motion model too calm.
    pub(crate) fn factor(&self, camera: &CameraName) -> f64 {
        let Some(record) = self.records.get(camera).filter(|r| r.evidence >= LEAST_EVIDENCE) else {
            return 1.0;
        };
        let mut ratios: Vec<f64> = self.records.values().filter(|r| !r.excluded).map(|r| r.ratio).collect();
        ratios.sort_unstable_by(f64::total_cmp);
        let common = ratios.get(ratios.len().saturating_sub(1) / 2).copied().unwrap_or(1.0).max(1.0);
        let own = record.ratio / common;
        if own < DOUBT { 1.0 } else { own }
    }

    /// The standing of a camera.
    pub(crate) fn of(&self, camera: &CameraName) -> CameraStanding {
        match self.records.get(camera) {
            Some(record) if record.excluded => CameraStanding::Excluded,
            Some(_) if self.factor(camera) > 1.0 => CameraStanding::Doubted,
            _ => CameraStanding::Good,
        }
    }

    /// Leaves a camera out or lets it back in; returns the new standing if that has changed.
    pub(crate) fn review(&mut self, camera: &CameraName) -> Option<CameraStanding> {
        let factor = self.factor(camera);
        let others = self.records.iter().filter(|(name, r)| *name != camera && !r.excluded).count();
        let record = self.records.get_mut(camera).filter(|r| r.evidence >= LEAST_EVIDENCE)?;
        if record.excluded {
            let fits = record.hits >= RETURN_HITS && record.ratio < RETURN_RATIO;
            if !fits {
                return None;
            }
            *record = Record { ratio: record.ratio, hits: record.hits, evidence: 0, excluded: false };
            return Some(CameraStanding::Good);
        }
        if others >= 2 && (factor > EXCLUSION || record.hits < LEAST_HITS) {
            // It comes back by new evidence only.
            *record = Record { ratio: EXCLUSION, hits: 0.0, evidence: 0, excluded: true };
            return Some(CameraStanding::Excluded);
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(text: &str) -> CameraName {
        text.parse().unwrap()
    }

    fn after(bad: Option<f64>) -> Standings {
        let mut standings = Standings::default();
        for _ in 0..200 {
            standings.learn(&name("a"), &[Some(2.0)]);
            standings.learn(&name("b"), &[Some(2.2)]);
            standings.learn(&name("c"), &[bad]);
            standings.review(&name("c"));
        }
        standings
    }

    #[test]
    fn honest_cameras_are_taken_at_their_word() {
        let standings = after(Some(1.8));
        assert!(["a", "b", "c"].iter().all(|c| standings.factor(&name(c)) == 1.0));
    }

    #[test]
    fn a_worse_camera_counts_less_and_a_wrong_one_not_at_all() {
        let standings = after(Some(12.0));
        assert_eq!(standings.of(&name("c")), CameraStanding::Doubted);
        assert!((5.0..6.1).contains(&standings.factor(&name("c"))));
        assert_eq!(after(Some(80.0)).of(&name("c")), CameraStanding::Excluded);
        assert_eq!(after(None).of(&name("c")), CameraStanding::Excluded);
    }

    #[test]
    fn one_exposure_is_one_piece_of_evidence_however_many_tracks_it_misses() {
        let mut standings = after(Some(2.0));
        standings.learn(&name("b"), &[None; 100]);
        assert_eq!(standings.review(&name("b")), None);
        assert_eq!(standings.of(&name("b")), CameraStanding::Good);
    }

    #[test]
    fn it_comes_back_by_evidence() {
        let mut standings = after(None);
        let mut changes = Vec::new();
        for _ in 0..200 {
            standings.learn(&name("c"), &[Some(2.0)]);
            changes.extend(standings.review(&name("c")));
        }
        assert_eq!(changes, [CameraStanding::Good]);
        assert_eq!(standings.of(&name("a")), CameraStanding::Good);
    }

    #[test]
    fn what_all_have_in_common_is_nobodys_fault_and_of_two_none_is_left_out() {
        let mut standings = Standings::default();
        for _ in 0..200 {
            for camera in ["a", "b", "c"] {
                standings.learn(&name(camera), &[Some(20.0)]);
            }
        }
        assert!((standings.factor(&name("b")) - 1.0).abs() < 1e-12);
        let mut two = Standings::default();
        for _ in 0..200 {
            two.learn(&name("a"), &[Some(2.0)]);
            two.learn(&name("b"), &[None]);
            assert_eq!(two.review(&name("b")), None);
        }
    }
}
