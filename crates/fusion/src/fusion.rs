//! The fusion centre as a state machine: bearing frames in, track frames, events and cues out.
//!
//! The way of a frame, in the order of the calls: steps of its clock are taken off
//! (`site_time.rs`); it is read into an exposure (`ingress.rs`), put in order by the time that it
//! reports (`event_time.rs`), and once more by that less its clock's offset (`clocks/`,
//! `fusion/correcting.rs`); its bearings go to the tracks that they fit (`tracker/`), the rest to
//! new ones (`initiation/`); what the exposure shows of its camera is learnt (`cameras/`), and what
//! has changed is said (`fusion/saying.rs`).
//!
//! It has no clock, thread or file, so that a recording gives the tracks of the live run, bit for
//! bit.

mod correcting;
mod jumps;
mod saying;
mod smoothing;

use std::collections::BTreeMap;

use crossfix_message::{
    BearingFrame, CalibrationError, CameraCalibration, CameraName, CueFrame, Timestamp, TrackEvent,
    TrackFrame,
};

use crate::cameras::{Cameras, Fittings, KnownCamera, PoseFinding, ScaleSample, Standing};
use crate::clocks::{ClockEstimate, ClockEstimator};
use crate::cueing::Cueing;
use crate::event_time::{EventBuffer, ExposureArrival, ReorderQueue};
use crate::ingress::{self, Exposure, Rejection, RejectionReason};
use crate::initiation::Initiator;
use crate::motion::MotionSetup;
use crate::site_time::{FrameDecision, SiteTime, moved};
use crate::track::{Draw, FusedTrack};
use crate::tracker::{TrackChange, Tracker, UsedSighting};
use correcting::SaidTime;
use smoothing::Smoothing;

use crate::uncertainty::{CorrelatedNoise, pose_covariance_of_careful_survey};
use crate::unmet::{Unmet, WhyNothing};
use crate::{Counters, FusionConfig, FusionConfigError};

/// A result of the fusion centre.
#[derive(Clone, Debug, PartialEq)]
pub enum Output {
    /// The tracks that an exposure has changed.
    Tracks(TrackFrame),
    /// The same tracks after a lag, smoothed by the bearings since: see
    /// [`crate::Tracking::smoothing_s`].
    Smoothed(TrackFrame),
    /// Something happened to a track.
    Event(TrackEvent),
    /// Where a camera that takes cues should look.
    Cues(CueFrame),
    /// A frame, or a part of one, was not used.
    Rejected(Rejection),
    /// A camera is excluded, or used again.
    Camera(CameraName, Standing),
}

/// The fusion centre's assessment of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraReport {
    /// The camera.
    pub camera: CameraName,
    /// How far its bearings are believed.
    pub standing: Standing,
    /// Whether it sees something, but none of the targets that two others see in its view.
    pub is_alone: bool,
    /// Factor by which its reported covariances are multiplied.
    pub noise_factor: f64,
    /// Its clock; `None` until the camera has been heard.
    pub clock: Option<ClockEstimate>,
}

/// What two cameras alone show of their poses counts once their track is this old, s: before, the
/// two may see different things that pass each other, and would make room for more such tracks.
/// Without it they do; with twice as much two cameras take as much longer to show that they err.
const PAIR_BELIEVED_AFTER_S: f64 = 5.0;

/// The fusion centre as a state machine: frames in, tracks out; without clock, thread or socket of
/// its own.
#[derive(Debug)]
pub struct Fusion {
    config: FusionConfig,
    cameras: Cameras,
    buffer: EventBuffer,
    tracker: Tracker,
    initiator: Initiator,
    clocks: ClockEstimator,
    unmet: Unmet,
    site_time: SiteTime,
    /// Exposures ordered by capture time less the estimated offset of their camera's clock.
    corrected: ReorderQueue<SaidTime>,
    /// [`ClockEstimator::changes`] at the time of these corrections.
    corrected_by: u64,
    smoothing: Smoothing,
    cueing: Cueing,
    counters: Counters,
    sequence: u64,
    /// Capture time of the exposure that was handled last.
    now: Option<Timestamp>,
}

impl Fusion {
    /// A fusion centre that does not know any camera yet.
    ///
    /// # Errors
    /// [`FusionConfigError`] if a number of the configuration makes no sense.
    pub fn new(config: FusionConfig) -> Result<Self, FusionConfigError> {
        config.validate()?;
        let motion = MotionSetup::new(&config.tracking)?;
        Ok(Self {
            cameras: Cameras::new(&config),
            buffer: EventBuffer::new(config.event_time.clone()),
            tracker: Tracker::new(&config, motion),
            initiator: Initiator::new(&config),
            clocks: ClockEstimator::new(config.clocks.clone()),
            unmet: Unmet::new(&config.initiation),
            site_time: SiteTime::new(config.event_time.lateness_s),
            corrected: ReorderQueue::default(),
            corrected_by: 0,
            smoothing: Smoothing::new(config.tracking.smoothing_s),
            cueing: Cueing::default(),
            counters: Counters::default(),
            sequence: 0,
            now: None,
            config,
        })
    }

    /// Registers a camera, or replaces its calibration for the frames that it captures from the
    /// calibration's `valid_from_ns` on.
    ///
    /// # Errors
    /// [`CalibrationError`] if the message describes no camera; the old calibration then stays.
    pub fn calibrate(&mut self, message: &CameraCalibration) -> Result<(), CalibrationError> {
        let calibration = message.parse()?;
        self.buffer.expect(&calibration.name);
        let is_declared = calibration.pose_covariance.is_some();
        let declared = calibration.pose_covariance;
        let pose_covariance = declared.unwrap_or_else(pose_covariance_of_careful_survey);
        let lasting = calibration.lasting_noise.map_or(CorrelatedNoise::NONE, |noise| {
            CorrelatedNoise { sd_rad: noise.sd_rad, time_s: noise.time_s }
        });
        let known = KnownCamera {
            camera: calibration.camera,
            mount: calibration.mount,
            takes_cues: calibration.takes_cues,
            is_turning: false,
            pose_covariance,
            lasting,
            clock_walk: calibration.clock_wander_s.powi(2),
            is_declared,
        };
        self.cameras.calibrate(calibration.name, calibration.valid_from, known);
        Ok(())
    }

    /// Handles a frame, and returns all that follows from it and from the frames that were waiting
    /// for it.
    pub fn ingest(&mut self, frame: &BearingFrame) -> Vec<Output> {
        self.counters.count("frames");
        let mut outputs = Vec::new();
        let name = frame.camera.parse::<CameraName>().ok();
        let known = name.filter(|name| self.cameras.get(name).is_some());
        match known.map_or(FrameDecision::Now, |name| self.site_time.see(&name, frame)) {
            FrameDecision::Now => self.take(frame, &mut outputs),
            FrameDecision::Waits => {}
            FrameDecision::Together(frames, step_s) => {
                self.take_after(&frames, step_s, &mut outputs);
            }
            FrameDecision::Apart(frames, apart) => self.take_apart(&frames, &apart, &mut outputs),
        }
        self.drain(&mut outputs);
        outputs
    }

    fn take(&mut self, frame: &BearingFrame, outputs: &mut Vec<Output>) {
        let name = frame.camera.parse::<CameraName>().ok();
        let ahead_s = name.map_or(0.0, |name| self.site_time.ahead_s(&name));
        let settled = (ahead_s != 0.0).then(|| moved(frame, -ahead_s));
        let frame = settled.as_ref().unwrap_or(frame);
        match self.read(frame) {
            Ok((mut exposure, left_out)) => {
                for reason in left_out {
                    self.refuse(refused(frame, reason), outputs);
                }
                // A preliminary value: the final clock offset is set when the exposure's turn
                // comes.
                exposure.correction_s =
                    self.clock(&exposure.camera).map_or(0.0, |clock| clock.offset_s);
                let (camera, time) = (exposure.camera.clone(), exposure.time);
                let arrival = self.buffer.insert(exposure);
                let in_time = !matches!(
                    arrival,
                    Err(RejectionReason::Late { .. } | RejectionReason::Future { .. })
                );
                // The site's time is used here: ten seconds of frames that arrive in one burst are
                // not evidence of a clock that is wrong for ten seconds.
                let now = self.buffer.agreed_time().unwrap_or(time);
                self.note_time(&camera, now, in_time, outputs);
                if let Some(time) = self.buffer.take_rewind() {
                    self.rewind(time, outputs);
                }
                match arrival {
                    Ok(ExposureArrival::InOrder) => {}
                    Ok(ExposureArrival::OutOfOrder) => self.counters.count("frames_out_of_order"),
                    Err(reason) => self.refuse(refused(frame, reason), outputs),
                }
            }
            Err(reason) => self.refuse(refused(frame, reason), outputs),
        }
    }

    /// Notes that a camera has ended, so that nothing waits for it any longer.
    pub fn camera_ended(&mut self, camera: &CameraName) -> Vec<Output> {
        let mut outputs = Vec::new();
        self.site_time.forget(camera);
        self.site_time.end().iter().for_each(|frame| self.take(frame, &mut outputs));
        self.buffer.end(camera);
        self.drain(&mut outputs);
        outputs
    }

    /// Handles everything that still waits, at the end of a recording.
    pub fn flush(&mut self) -> Vec<Output> {
        let mut outputs = Vec::new();
        self.site_time.end().iter().for_each(|frame| self.take(frame, &mut outputs));
        self.finish(&mut outputs);
        self.smooth_all(&mut outputs);
        outputs
    }

    /// The assessment of each camera, ordered by name.
    pub fn cameras(&self) -> impl Iterator<Item = CameraReport> + '_ {
        self.cameras.iter().map(|(name, camera)| CameraReport {
            camera: name.clone(),
            standing: camera.standing(),
            is_alone: camera.is_alone(),
            noise_factor: camera.noise_factor(),
            clock: self.clocks.estimate(name).map(|clock| ClockEstimate {
                offset_s: clock.offset_s + self.site_time.ahead_s(name),
                ..clock
            }),
        })
    }

    /// Whether cameras have been moved since they were calibrated: one finding for each camera that
    /// has been compared with others. The cost grows with the third power of the number of cameras:
    /// 25 ms for 64.
    pub fn pose_findings(&self) -> BTreeMap<CameraName, PoseFinding> {
        self.cameras.pose_findings()
    }

    /// Capture time of the exposure that was handled last; `None` before the first.
    pub fn now(&self) -> Option<Timestamp> {
        self.now
    }

    /// Why no target is found although two cameras see something at the same time.
    pub fn why_nothing(&self) -> Option<&WhyNothing> {
        self.unmet.why()
    }

    /// Counts of what has been handled and refused so far.
    pub fn counters(&self) -> &Counters {
        &self.counters
    }

    /// All tracks after the newest exposure handled, ordered by id.
    pub fn tracks(&self) -> impl Iterator<Item = &FusedTrack> {
        self.tracker.tracks()
    }

    fn read(
        &mut self,
        frame: &BearingFrame,
    ) -> Result<(Exposure, Vec<RejectionReason>), RejectionReason> {
        let name: CameraName = frame.camera.parse().map_err(|_| RejectionReason::UnknownCamera)?;
        let captured = Timestamp::from_nanos(frame.capture_time_ns);
        let camera = self.cameras.at(&name, captured).ok_or(RejectionReason::UnknownCamera)?;
        ingress::read(frame, &name, camera, &self.config.bearings, &mut self.counters)
    }

    fn drain(&mut self, outputs: &mut Vec<Output>) {
        while let Some(next) = self.buffer.release() {
            self.handle(next, outputs);
        }
    }

    fn handle(&mut self, next: Result<Exposure, Rejection>, outputs: &mut Vec<Output>) {
        match next {
            Ok(exposure) => self.correct(exposure, outputs),
            Err(rejection) => self.refuse(rejection, outputs),
        }
    }

    fn refuse(&mut self, rejection: Rejection, outputs: &mut Vec<Output>) {
        self.counters.count(rejection.reason.counter());
        outputs.push(Output::Rejected(rejection));
    }

    /// The standard deviation of an exposure's time against true time, s.
    fn true_time_sd_s(&self, exposure: &Exposure) -> f64 {
        let clock = self.clock(&exposure.camera);
        clock.map_or(exposure.uncertainty.time_sd_s, |clock| clock.sd_s)
    }

    /// The estimate of a camera's clock, if there is one and clocks are in doubt at all.
    fn clock(&self, camera: &CameraName) -> Option<ClockEstimate> {
        if self.clocks.is_needed() { self.clocks.estimate(camera) } else { None }
    }

    /// Handles one exposure; they come in the order of capture times.
    fn process(&mut self, exposure: &Exposure, outputs: &mut Vec<Output>) {
        self.buffer.mark_processed(exposure.time);
        self.now = Some(exposure.time);
        self.tracker.begin(exposure.time);
        for moved in self.cameras.advance(exposure.time) {
            self.clocks
                .calibrate(&moved, self.cameras.known(&moved).map(|known| known.pose_covariance));
            self.initiator.forget(&moved);
            self.tracker.forget_pose(&moved);
        }
        // Tracks first learn what has changed of the camera: the exposure is compared by what is
        // known now.
        if let Some(change) = self.cameras.clock_change(exposure) {
            self.tracker.set_clock(&exposure.camera, change);
        }
        let Some(camera) = self.cameras.get_mut(&exposure.camera) else {
            return;
        };
        self.counters.count("exposures");
        if camera.point(exposure) {
            self.tracker.turn_camera(&exposure.camera);
        }
        let mut exposure = exposure.clone();
        camera.annotate(&mut exposure, self.config.tracking.clutter_per_sr);
        let mut changes = Vec::new();
        let (fittings, used) = if camera.is_excluded() {
            self.counters.count("exposures_of_excluded_cameras");
            self.tracker.compare(&exposure, camera.known())
        } else {
            self.follow(&exposure, &mut changes)
        };
        self.compare_poses(exposure.time);
        self.compare_clocks(&exposure, &used);
        self.assess_camera(&exposure, &fittings, outputs);
        self.emit_tracks(&exposure, changes, outputs);
        self.cue(exposure.time, outputs);
    }

    /// Updates the tracks with an exposure, and gives what they leave over to the search for new
    /// tracks; returns how the exposure fits the tracks, and which track has used which sighting.
    fn follow(
        &mut self,
        exposure: &Exposure,
        changes: &mut Vec<TrackChange>,
    ) -> (Fittings, Vec<UsedSighting>) {
        let Self { cameras, tracker, initiator, unmet, counters, .. } = self;
        let Some(known) = cameras.known(&exposure.camera) else {
            return Default::default();
        };
        let step = tracker.step(exposure, known, cameras);
        changes.extend(step.changes);
        let rest = Exposure { sightings: step.free, ..exposure.clone() };
        if tracker.has_sure() {
            unmet.found();
        } else {
            unmet.see(&rest).into_iter().for_each(|name| counters.count(name));
        }
        for start in initiator.add(rest, &step.provisional, cameras, tracker.motion()) {
            changes.extend(tracker.adopt(start, cameras));
        }
        for start in initiator.hand_over(exposure, &step.used, known, tracker.motion()) {
            changes.extend(tracker.adopt(start, cameras));
        }
        if let Some(camera) = cameras.get_mut(&exposure.camera) {
            let holding_s = tracker.motion().holding_s;
            let differences = &step.third_differences;
            camera.learn_noise(exposure.time, differences, step.unassigned, holding_s);
            camera.learn_company(exposure.time, step.company);
        }
        (step.fittings, step.used)
    }

    /// Compares what the cameras see of the tracks: learns how good their poses are, and whether
    /// one has been moved.
    fn compare_poses(&mut self, now: Timestamp) {
        for Draw { age_s, mut samples, mut beside } in self.tracker.draws() {
            // The error of a mount's angles is a new one after each turn: cameras on mounts are
            // left out.
            let is_fixed = |sample: &ScaleSample| !self.cameras.is_on_mount(&sample.camera);
            samples.retain(is_fixed);
            beside.retain(is_fixed);
            let least = if age_s < PAIR_BELIEVED_AFTER_S { 3 } else { 2 };
            let mut changed = Vec::new();
            if samples.len() >= least {
                changed = self.cameras.learn_poses(&samples);
            }
            // Where three others see the target, it is for them to accuse who sees something beside
            // it; where two do, however new their track is, any of the three may have been moved.
            if samples.len() == 2 {
                samples.append(&mut beside);
            }
            if samples.len() >= least {
                changed.extend(self.cameras.watch(&samples, now));
            }
            for (camera, ratio) in changed {
                self.tracker.rescale_pose(&camera, ratio);
            }
        }
    }

    /// Updates the estimate of the camera's clock with its bearings of tracks.
    fn compare_clocks(&mut self, exposure: &Exposure, used: &[UsedSighting]) {
        if !self.clocks.is_needed() {
            return;
        }
        self.clocks.advance(exposure.time, &self.tracker);
        for used in used {
            if let (Some(track), Some(sighting)) =
                (self.tracker.track(used.track), exposure.sightings.get(used.index))
            {
                self.clocks.update(track, exposure, &sighting.line);
            }
        }
    }

    /// Updates the standing of an exposure's camera by how the exposure fits the tracks.
    fn assess_camera(
        &mut self,
        exposure: &Exposure,
        fittings: &Fittings,
        outputs: &mut Vec<Output>,
    ) {
        let assessment = self.cameras.assess(&exposure.camera, exposure.time, fittings);
        if assessment.suspects_clock {
            // Bearings that are compared but not used can show this too.
            self.clocks.suspect(&exposure.camera);
        }
        if let Some(standing) = assessment.standing {
            self.counters.count(match standing {
                Standing::Excluded => "cameras_excluded",
                _ => "cameras_readmitted",
            });
            outputs.push(Output::Camera(exposure.camera.clone(), standing));
        }
    }

    /// Notes whether a camera's frame came in time.
    fn note_time(
        &mut self,
        camera: &CameraName,
        time: Timestamp,
        in_time: bool,
        outputs: &mut Vec<Output>,
    ) {
        let changed = self.cameras.get_mut(camera).and_then(|known| known.note_time(time, in_time));
        if let Some(standing) = changed {
            if standing == Standing::Excluded {
                self.site_time.forget_steps(camera);
            }
            self.counters.count(match standing {
                Standing::Excluded => "cameras_out_of_time",
                _ => "cameras_in_time_again",
            });
            outputs.push(Output::Camera(camera.clone(), standing));
        }
    }
}

/// The rejection of a frame, or of a part of it, with the reason.
fn refused(frame: &BearingFrame, reason: RejectionReason) -> Rejection {
    Rejection { camera: frame.camera.clone(), sequence: frame.sequence, reason }
}
