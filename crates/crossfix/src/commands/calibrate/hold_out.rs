//! Validation of a calibration: fuses a part of the flight that was held out, to show what the
//! calibration is worth on another flight.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;

use crossfix_calibration::{
    CalibratedCamera, CameraLabels, ClockCorrection, FlightLog, FlightResult, SiteCalibration,
};
use crossfix_evaluation::{Estimate, Sightings, TrackHistory};
use crossfix_fusion::{FusionConfig, Output};
use crossfix_message::{BearingFrame, CameraName, Channel, Timestamp, TrackFrame, decode};
use crossfix_recording::Entry;
use nalgebra::Matrix3;
use serde::Serialize;

use crate::centre::Centre;
use crate::output;
use crate::recalibration::{Recalibration, Reordered};
use crate::recorded::{self, Lacks};

/// Which part of a recording is held out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum HoldOut {
    /// The second half.
    Half,
    /// Every other ten seconds.
    Blocks,
}

/// Length of a block, s. Tracks start again in each: with half of it they would be missing for
/// twice as large a share of the time.
const BLOCK_S: f64 = 10.0;
/// Log positions count where at least this many cameras see the target. With two, places near the
/// line through both would count, where no calibration helps.
const LEAST_CAMERAS: usize = 3;
/// A track farther than this from the log belongs to something else, m. With half of it a track
/// that a bad calibration puts three metres aside would count as missing, not as wrong.
const CUTOFF_M: f64 = 5.0;

/// The held-out part of a recording.
#[derive(Debug)]
pub struct HeldOut {
    which: HoldOut,
    /// Clocks as calibrated by the whole flight; they only decide which labels belong to the part.
    /// The clock errors in it must be predicted by the calibration of the other part.
    clocks: BTreeMap<CameraName, ClockCorrection>,
    from_s: f64,
    to_s: f64,
}

impl HeldOut {
    /// Removes the part from the cameras' labels; common times are by the clocks of the whole
    /// flight.
    pub fn take_out(which: HoldOut, whole: &FlightResult, cameras: &mut [CameraLabels]) -> Self {
        let clocks: BTreeMap<_, _> = whole
            .cameras
            .iter()
            .map(|camera| (camera.name.clone(), CalibratedCamera::from(camera).clock))
            .collect();
        let mut held_out = Self { which, clocks, from_s: f64::INFINITY, to_s: f64::NEG_INFINITY };
        for camera in &*cameras {
            for label in &camera.labels {
                if let Some(time_s) = held_out.common_s(&camera.name, label.time_s) {
                    held_out.from_s = held_out.from_s.min(time_s);
                    held_out.to_s = held_out.to_s.max(time_s);
                }
            }
        }
        for CameraLabels { name, labels, .. } in cameras {
            labels.retain(|label| !held_out.holds(name, label.time_s));
        }
        held_out
    }

    fn common_s(&self, camera: &CameraName, own_s: f64) -> Option<f64> {
        Some(own_s + self.clocks.get(camera)?.at(own_s).ahead_s)
    }

    fn holds(&self, camera: &CameraName, own_s: f64) -> bool {
        self.common_s(camera, own_s).is_some_and(|time_s| match self.which {
            HoldOut::Half => time_s >= f64::midpoint(self.from_s, self.to_s),
            HoldOut::Blocks => ((time_s - self.from_s) / BLOCK_S).rem_euclid(2.0) >= 1.0,
        })
    }

    /// Whether an entry of a recording belongs to this part, or has no time.
    fn has(&self, entry: &Entry) -> bool {
        let Channel::Bearings(name) = &entry.key.channel else { return true };
        decode::<BearingFrame>(&entry.data).is_ok_and(|frame| {
            self.holds(name, Timestamp::from_nanos(frame.capture_time_ns).seconds())
        })
    }

    /// Fuses the part with a calibration made without it.
    pub fn fused(
        &self,
        recording: &Path,
        site: SiteCalibration,
        log: Option<&FlightLog>,
    ) -> anyhow::Result<Worth> {
        let mut run = HeldOutRun::empty()?;
        let mut calibrations = BTreeMap::new();
        let mut lacks = Lacks::default();
        recorded::for_each(recording, &mut lacks, |_, entry| {
            if let Channel::Calibration(name) = &entry.key.channel {
                calibrations.entry(name.clone()).or_insert(entry);
            }
            Ok(())
        })?;
        // A camera that is not in the calibration has no usable pose.
        let known: BTreeSet<CameraName> =
            site.cameras().iter().map(|camera| camera.name.clone()).collect();
        let recalibration = Recalibration::of(site);
        for entry in
            calibrations.into_iter().filter(|(name, _)| known.contains(name)).map(|(_, e)| e)
        {
            run.take(&recalibration.applied(entry));
        }
        let mut reordered = Reordered::new(recalibration);
        recorded::for_each(recording, &mut lacks, |_, entry| {
            let is_known =
                matches!(&entry.key.channel, Channel::Bearings(name) if known.contains(name));
            if is_known && self.has(&entry) {
                reordered.take(entry).for_each(|entry| run.take(&entry));
            }
            Ok(())
        })?;
        reordered.finish().for_each(|entry| run.take(&entry));
        let outputs = run.centre.flush();
        run.note(outputs);
        Ok(run.worth(log))
    }
}

/// State and results of the fusion.
struct HeldOutRun {
    centre: Centre,
    history: TrackHistory,
    sightings: Sightings,
    /// Sum and number of each camera's squared normalised innovations (NIS).
    innovations: BTreeMap<String, (f64, u32)>,
}

impl HeldOutRun {
    fn empty() -> anyhow::Result<Self> {
        Ok(Self {
            centre: Centre::new(FusionConfig::default(), None)?,
            history: TrackHistory::default(),
            sightings: Sightings::default(),
            innovations: BTreeMap::new(),
        })
    }

    fn take(&mut self, entry: &Entry) {
        if let Ok(frame) = decode::<BearingFrame>(&entry.data)
            && matches!(entry.key.channel, Channel::Bearings(_))
        {
            self.sightings.add(&frame);
        }
        let outputs = self.centre.take(&entry.key.channel, &entry.data, "");
        self.note(outputs);
    }

    fn note(&mut self, outputs: Vec<Output>) {
        for output in outputs {
            let Output::Tracks(frame) = output else { continue };
            self.history.add(&frame);
            self.note_innovations(&frame);
        }
    }

    /// Adds the innovations of the exposure that made the frame.
    fn note_innovations(&mut self, frame: &TrackFrame) {
        let residuals = frame.tracks.iter().flat_map(|track| &track.residuals);
        for residual in residuals.filter(|residual| residual.camera == frame.camera) {
            let (sum, count) = self.innovations.entry(residual.camera.clone()).or_default();
            *sum += residual.nis;
            *count += 1;
        }
    }

    fn worth(&self, log: Option<&FlightLog>) -> Worth {
        let sums = self.innovations.iter();
        let mean_nis = sums.map(|(camera, (sum, n))| (camera.clone(), sum / f64::from(*n)));
        Worth { against_log: log.map(|log| self.against(log)), mean_nis: mean_nis.collect() }
    }

    /// The tracks compared with the log, whose own variance is added to the tracks' covariances.
    fn against(&self, log: &FlightLog) -> AgainstLog {
        let variance = log.errors.sd_m.powi(2) + log.errors.drift_sd_m.powi(2);
        let cutoff_m = CUTOFF_M + 3.0 * variance.sqrt();
        let times: Vec<Timestamp> =
            log.samples.iter().map(|sample| Timestamp::from_seconds(sample.time_s)).collect();
        let cameras = self.sightings.cameras_at(&times);
        let seen = log.samples.iter().zip(&times).zip(cameras);
        let (mut places, mut distances_m, mut nees) = (0, Vec::new(), Vec::new());
        for ((sample, &time), _) in seen.filter(|(_, cameras)| *cameras >= LEAST_CAMERAS) {
            places += 1;
            let beside = |estimate: &Estimate| estimate.state.position() - sample.position;
            let tracks = self.history.at(time);
            let nearest =
                tracks.iter().min_by(|a, b| beside(a).norm().total_cmp(&beside(b).norm()));
            let Some(track) = nearest.filter(|track| beside(track).norm() < cutoff_m) else {
                continue;
            };
            // NEES = e' (P + R)^-1 e, with the track's covariance P and the log's R.
            let stated = track.state.position_covariance() + Matrix3::identity() * variance;
            distances_m.push(beside(track).norm());
            nees.extend(
                stated.cholesky().map(|root| beside(track).dot(&root.solve(&beside(track)))),
            );
        }
        AgainstLog {
            places,
            found: distances_m.len() as f64 / f64::from(places.max(1)),
            median_m: quantile(&mut distances_m, 0.5),
            worst_twentieth_m: quantile(&mut distances_m, 0.95),
            median_nees: quantile(&mut nees, 0.5),
        }
    }
}

/// The quantile of some values at `share`.
fn quantile(values: &mut [f64], share: f64) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    values.get((share * last as f64).round() as usize).copied()
}

/// The accuracy of a calibration on data that it was not made from.
#[derive(Debug, Serialize)]
pub struct Worth {
    against_log: Option<AgainstLog>,
    /// Each camera's mean NIS; two is consistent.
    mean_nis: BTreeMap<String, f64>,
}

/// Statistics as quantiles, as logs have outliers of their own.
#[derive(Debug, Serialize)]
struct AgainstLog {
    /// Number of log positions at which at least three cameras see the target.
    places: u32,
    /// Share of them with a track.
    found: f64,
    /// Median distance of the tracks from the log, m, ...
    median_m: Option<f64>,
    /// ... and their 95 % quantile.
    worst_twentieth_m: Option<f64>,
    /// Median NEES with the covariances of tracks and log together; 2.37 if they are consistent.
    median_nees: Option<f64>,
}

impl fmt::Display for Worth {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("what was held out, fused by it:")?;
        match &self.against_log {
            Some(AgainstLog { places: 0, .. }) => {
                f.write_str(" at no place of the log do three cameras see the target;")?;
            }
            Some(log) => write!(
                f,
                " tracks at {:.1} % of {} places of the log, half of them within {} m and 95 % \
                 within {} m of it, NEES {} in the median (2.4 is honest);",
                100.0 * log.found,
                log.places,
                output::number(log.median_m, 3),
                output::number(log.worst_twentieth_m, 3),
                output::number(log.median_nees, 1),
            )?,
            None => {}
        }
        let cameras: Vec<String> =
            self.mean_nis.iter().map(|(camera, nis)| format!("{camera} {nis:.1}")).collect();
        write!(f, " innovations squared by what is said of them (2): {}", cameras.join(", "))
    }
}
