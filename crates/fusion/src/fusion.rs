use std::collections::BTreeMap;

use crossfix_message::{
    BearingFrame, CalibrationError, CameraCalibration, CameraName, CameraResidual, Payload, Timestamp,
    TrackEvent, TrackFrame, TrackState,
};

use crate::calibrations::KnownCameras;
use crate::clocks::{ClockEstimate, ClockEstimator};
use crate::event_time::{Arrival, EventBuffer};
use crate::ingress::{self, Exposure, KnownCamera, Load, Rejection, RejectionReason};
use crate::initiation::Initiator;
use crate::motion::Motion;
use crate::spatial::Quantity;
use crate::standing::CameraStanding;
use crate::standing::Standings;
use crate::track::{Track, TrackId, TrackStatus};
use crate::tracker::{Happening, Tracker};
use crate::{ConfigError, Counters, FusionConfig};

/// What comes out of the fusion centre.
#[derive(Clone, Debug, PartialEq)]
pub enum Output {
    /// The tracks that an exposure has changed.
    Tracks(TrackFrame),
    /// Something happened to a track.
    Event(TrackEvent),
    /// Something was not used.
    Rejected(Rejection),
    /// A camera is left out, or used again.
    Camera(CameraName, CameraStanding),
}

/// What the fusion centre thinks of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraReport {
    /// The camera.
    pub camera: CameraName,
    /// Whether it is believed.
    pub standing: CameraStanding,
    /// How many times its reported covariances count.
    pub noise_factor: f64,
    /// Its clock; `None` as long as it has not been heard.
    pub clock: Option<ClockEstimate>,
}

/// The fusion centre as a state machine: frames in, tracks out; no clock, no thread, no socket.
#[derive(Debug)]
pub struct Fusion {
    config: FusionConfig,
    cameras: KnownCameras,
    buffer: EventBuffer,
    tracker: Tracker,
    initiator: Initiator,
    clocks: ClockEstimator,
    standings: Standings,
    /// Exposures in the order of their corrected times, until nothing can come before them. Two of a
    /// camera may be corrected to the same time: their reported times tell them apart.
    corrected: BTreeMap<(Timestamp, CameraName, Timestamp), Exposure>,
    corrected_load: Load,
    counters: Counters,
    sequence: u64,
    now: Option<Timestamp>,
}

impl Fusion {
    /// A fusion centre that knows no camera yet.
    ///
    /// # Errors
    /// [`ConfigError`] if a number of the configuration makes no sense.
    pub fn new(config: FusionConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let motion = Motion::new(&config.tracking)?;
        Ok(Self {
            cameras: KnownCameras::default(),
            buffer: EventBuffer::new(config.event_time.clone()),
            tracker: Tracker::new(config.tracking.clone(), config.initiation.max_range_m, motion),
            initiator: Initiator::new(&config),
            clocks: ClockEstimator::new(config.clocks.clone()),
            standings: Standings::default(),
            corrected: BTreeMap::new(),
            corrected_load: Load::default(),
            counters: Counters::default(),
            sequence: 0,
            now: None,
            config,
        })
    }

    /// Makes a camera known, or replaces what is known of it for the frames that it captures from the
    /// calibration's `valid_from_ns` on.
    ///
    /// # Errors
    /// [`CalibrationError`] if the message describes no camera; what was known stays.
    pub fn calibrate(&mut self, message: &CameraCalibration) -> Result<(), CalibrationError> {
        let calibration = message.parse()?;
        self.buffer.expect(&calibration.name);
        let known = KnownCamera { camera: calibration.camera, pose_covariance: calibration.pose_covariance };
        self.cameras.insert(calibration.name, calibration.valid_from, known);
        Ok(())
    }

    /// Takes a frame in and returns all that follows from it and from what it had to wait for.
    pub fn ingest(&mut self, frame: &BearingFrame) -> Vec<Output> {
        self.counters.count("frames");
        let mut outputs = Vec::new();
        match self.read(frame) {
            Ok((mut exposure, left_out)) => {
                for reason in left_out {
                    outputs.push(self.reject(frame, reason));
                }
                // As far as is known by now: it is settled when the exposure's turn comes.
                exposure.correction_s = self.clock(&exposure.camera).map_or(0.0, |clock| clock.offset_s);
                let arrival = self.buffer.insert(exposure);
                if let Some(time) = self.buffer.take_restart() {
                    self.restart(time, &mut outputs);
                }
                match arrival {
                    Ok(Arrival::InOrder) => {}
                    Ok(Arrival::OutOfOrder) => self.counters.count("frames_out_of_order"),
                    Err(reason) => outputs.push(self.reject(frame, reason)),
                }
            }
            Err(reason) => outputs.push(self.reject(frame, reason)),
        }
        self.drain(&mut outputs);
        outputs
    }

    /// Says that a camera has come to its end, so that nothing waits for it.
    pub fn camera_ended(&mut self, camera: &CameraName) -> Vec<Output> {
        self.buffer.end(camera);
        let mut outputs = Vec::new();
        self.drain(&mut outputs);
        outputs
    }

    /// Handles everything that still waits: the end of a recording.
    pub fn flush(&mut self) -> Vec<Output> {
        let mut outputs = Vec::new();
        while let Some(next) = self.buffer.pop() {
            self.handle(next, &mut outputs);
        }
        while let Some(exposure) = self.next_corrected(Timestamp::from_nanos(i64::MAX)) {
            self.process(&exposure, &mut outputs);
        }
        outputs
    }

    /// What is thought of each camera, ordered by name.
    pub fn cameras(&self) -> impl Iterator<Item = CameraReport> + '_ {
        self.cameras.now().keys().map(|camera| CameraReport {
            camera: camera.clone(),
            standing: self.standings.of(camera),
            noise_factor: self.standings.factor(camera),
            clock: self.clocks.estimate(camera),
        })
    }

    /// Capture time of the exposure that was handled last; `None` before the first.
    pub fn now(&self) -> Option<Timestamp> {
        self.now
    }

    /// What has been handled and refused so far.
    pub fn counters(&self) -> &Counters {
        &self.counters
    }

    /// All tracks as of the newest exposure handled, ordered by id.
    pub fn tracks(&self) -> impl Iterator<Item = &Track> {
        self.tracker.tracks()
    }

    fn read(&mut self, frame: &BearingFrame) -> Result<(Exposure, Vec<RejectionReason>), RejectionReason> {
        let name: CameraName = frame.camera.parse().map_err(|_| RejectionReason::UnknownCamera)?;
        let captured = Timestamp::from_nanos(frame.capture_time_ns);
        let camera = self.cameras.at(&name, captured).ok_or(RejectionReason::UnknownCamera)?;
        ingress::read(frame, &name, camera, &self.config.bearings, &mut self.counters)
    }

    fn reject(&mut self, frame: &BearingFrame, reason: RejectionReason) -> Output {
        self.counters.count(reason.counter());
        Output::Rejected(Rejection { camera: frame.camera.clone(), sequence: frame.sequence, reason })
    }

    fn drain(&mut self, outputs: &mut Vec<Output>) {
        while let Some(next) = self.buffer.release() {
            self.handle(next, outputs);
        }
    }

    /// Takes the order of time up anew from a time long passed: what was made of a time that never was
    /// is forgotten.
    fn restart(&mut self, time: Timestamp, outputs: &mut Vec<Output>) {
        self.counters.count("event_time_restarts");
        while let Some(exposure) = self.next_corrected(Timestamp::from_nanos(i64::MAX)) {
            let by_s = exposure.time.seconds_since(time);
            self.handle(Err((exposure, RejectionReason::Future { by_s })), outputs);
        }
        let happenings = self.tracker.restart(time);
        self.tell(happenings, time, outputs);
        self.initiator = Initiator::new(&self.config);
        self.clocks = ClockEstimator::new(self.config.clocks.clone());
    }

    fn handle(&mut self, next: Result<Exposure, (Exposure, RejectionReason)>, outputs: &mut Vec<Output>) {
        match next {
            Ok(exposure) => self.correct(exposure, outputs),
            Err((exposure, reason)) => {
                self.counters.count(reason.counter());
                outputs.push(Output::Rejected(Rejection {
                    camera: exposure.camera.to_string(),
                    sequence: exposure.sequence,
                    reason,
                }));
            }
        }
    }

    /// Takes the clock's offset off an exposure's time. Corrected times may be in another order, so
    /// an exposure waits until no camera's clock can be far enough ahead for an earlier one to come.
    fn correct(&mut self, mut exposure: Exposure, outputs: &mut Vec<Output>) {
        self.clocks.see(&exposure.camera, &exposure.uncertainty);
        let Some(clock) = self.clock(&exposure.camera) else {
            return self.process(&exposure, outputs);
        };
        let reported = exposure.time;
        exposure.correction_s = clock.offset_s;
        exposure.time = reported.plus_seconds(-clock.offset_s);
        let said = exposure.uncertainty.time_sd_s;
        exposure.uncertainty.time_sd_s = self.clocks.time_sd_s(&exposure.camera, &clock, said);
        if let Some(by_s) = self.buffer.passed_by_s(exposure.time) {
            return self.handle(Err((exposure, RejectionReason::Late { by_s })), outputs);
        }
        let order = (exposure.time, exposure.camera.clone(), reported);
        if self.corrected.contains_key(&order) {
            return self.handle(Err((exposure, RejectionReason::Duplicate)), outputs);
        }
        self.corrected_load.add(&exposure);
        self.corrected.insert(order, exposure);
        let settled = reported.plus_seconds(-self.clocks.largest_offset());
        while let Some(next) = self.next_corrected(settled) {
            self.process(&next, outputs);
        }
    }

    /// The next of the corrected exposures up to a time, or if more wait than may.
    fn next_corrected(&mut self, settled: Timestamp) -> Option<Exposure> {
        let crowded = self.corrected_load.is_too_much();
        let entry = self.corrected.first_entry().filter(|entry| crowded || entry.key().0 <= settled)?;
        let exposure = entry.remove();
        self.corrected_load.remove(&exposure);
        Some(exposure)
    }

    /// What is known of a camera's clock, if clocks are in doubt.
    fn clock(&self, camera: &CameraName) -> Option<ClockEstimate> {
        if self.clocks.is_needed() { self.clocks.estimate(camera) } else { None }
    }

    /// One exposure, in the order of capture times.
    fn process(&mut self, exposure: &Exposure, outputs: &mut Vec<Output>) {
        self.buffer.pass(exposure.time);
        self.now = Some(exposure.time);
        self.tracker.begin(exposure.time);
        for moved in self.cameras.advance(exposure.time) {
            let pose_covariance = self.cameras.now().get(&moved).and_then(|known| known.pose_covariance);
            self.clocks.calibrate(&moved, pose_covariance);
        }
        let Some(known) = self.cameras.at(&exposure.camera, exposure.time) else {
            return;
        };
        self.counters.count("exposures");
        let mut exposure = exposure.clone();
        exposure.uncertainty.factor = self.standings.factor(&exposure.camera);
        let excluded = self.standings.of(&exposure.camera) == CameraStanding::Excluded;
        let mut happenings = Vec::new();
        let (evidence, used) = if excluded {
            self.counters.count("exposures_of_excluded_cameras");
            self.tracker.compare(&exposure, known)
        } else {
            let step = self.tracker.step(&exposure, known);
            happenings = step.happenings;
            let rest = Exposure { sightings: step.free, ..exposure.clone() };
            for start in self.initiator.add(rest, &step.claims, self.cameras.now(), self.tracker.motion()) {
                happenings.extend(self.tracker.adopt(start));
            }
            (step.evidence, step.used)
        };
        self.compare_clocks(&exposure, &used);
        self.judge(&exposure, &evidence, &used, outputs);
        self.say(&exposure, happenings, outputs);
    }

    /// Learns from the bearings of tracks what they say of the camera's clock.
    fn compare_clocks(&mut self, exposure: &Exposure, used: &[(usize, TrackId)]) {
        if !self.clocks.is_needed() {
            return;
        }
        self.clocks.advance(exposure.time, &self.tracker);
        for (index, id) in used {
            if let (Some(track), Some(sighting)) = (self.tracker.track(*id), exposure.sightings.get(*index)) {
                self.clocks.update(track, exposure, &sighting.line);
            }
        }
    }

    /// Learns from an exposure how far its camera can be believed.
    fn judge(
        &mut self,
        exposure: &Exposure,
        evidence: &[Option<f64>],
        used: &[(usize, TrackId)],
        outputs: &mut Vec<Output>,
    ) {
        // One that is turned away sees the targets elsewhere. Where all its bearings are known targets',
        // those that it misses are hidden from it; and one that sees nothing says nothing.
        let strangers = exposure.sightings.len() > used.len();
        let telling: Vec<Option<f64>> =
            evidence.iter().copied().filter(|nis| nis.is_some() || strangers).collect();
        self.standings.learn(&exposure.camera, &telling);
        if let Some(standing) = self.standings.review(&exposure.camera) {
            self.counters.count(match standing {
                CameraStanding::Excluded => "cameras_excluded",
                _ => "cameras_readmitted",
            });
            if standing == CameraStanding::Excluded {
                // It may be its clock that is wrong: bearings compared and not used can tell.
                self.clocks.suspect(&exposure.camera);
            }
            outputs.push(Output::Camera(exposure.camera.clone(), standing));
        }
    }

    /// Tells what has happened.
    fn tell(&mut self, happenings: Vec<Happening>, time: Timestamp, outputs: &mut Vec<Output>) {
        for happening in happenings {
            self.counters.count(match happening.kind {
                crossfix_message::TrackEventKind::Born => "tracks_born",
                crossfix_message::TrackEventKind::Confirmed => "tracks_confirmed",
                crossfix_message::TrackEventKind::Merged => "tracks_merged",
                crossfix_message::TrackEventKind::Manoeuvre => "tracks_manoeuvred",
                _ => "tracks_lost",
            });
            outputs.push(Output::Event(event(happening, time)));
        }
    }

    /// Tells what has happened, and where all tracks are now.
    fn say(&mut self, exposure: &Exposure, happenings: Vec<Happening>, outputs: &mut Vec<Output>) {
        self.tell(happenings, exposure.time, outputs);
        let due = self.tracker.due(exposure.time);
        let tracks: Vec<crossfix_message::Track> = due
            .iter()
            .filter_map(|id| self.tracker.track(*id))
            .map(|t| self.track_message(t, exposure.time))
            .collect();
        if !tracks.is_empty() {
            let frame = TrackFrame {
                sequence: self.sequence,
                time_ns: exposure.time.nanos(),
                camera: exposure.camera.to_string(),
                camera_sequence: exposure.sequence,
                tracks,
                ..Default::default()
            };
            self.sequence += 1;
            outputs.push(Output::Tracks(frame.stamped()));
        }
    }
}

fn event(happening: Happening, time: Timestamp) -> TrackEvent {
    TrackEvent {
        time_ns: time.nanos(),
        kind: happening.kind.into(),
        track_id: happening.track.0,
        other_id: happening.other.map_or(0, |id| id.0),
        ..Default::default()
    }
    .stamped()
}

impl Fusion {
    /// A track as of `time`.
    fn track_message(&self, track: &Track, time: Timestamp) -> crossfix_message::Track {
        let now = track.honest(time, self.tracker.motion());
        let state = match track.status {
            TrackStatus::Tentative => TrackState::Tentative,
            TrackStatus::Confirmed => TrackState::Confirmed,
            TrackStatus::Coasting => TrackState::Coasting,
            TrackStatus::Lost => TrackState::Lost,
        };
        let residuals = track.residuals.iter().map(|(camera, residual)| CameraResidual {
            camera: camera.as_str().to_owned(),
            time_ns: residual.time.nanos(),
            angle_rad: residual.angle,
            nis: residual.nis,
        });
        let weak = |quantity: Quantity| {
            let axis = track.observability.weak_axis.filter(|axis| axis.quantity == quantity)?;
            Some(axis.direction.into_inner().into())
        };
        crossfix_message::Track {
            id: track.id.0,
            state: state.into(),
            position: Some(now.position().into()),
            velocity: Some(now.velocity().into()),
            // Symmetric, so columns are rows.
            covariance: now.covariance.as_slice().to_vec(),
            residuals: residuals.collect(),
            solver: track.solver.into(),
            rank: track.observability.rank as u32,
            condition_number: track.observability.condition_number,
            updated_ns: track.updated.nanos(),
            weak_position_axis: weak(Quantity::Position),
            weak_velocity_axis: weak(Quantity::Velocity),
        }
    }
}
