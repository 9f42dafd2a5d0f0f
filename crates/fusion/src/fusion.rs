use std::collections::BTreeMap;

use crossfix_message::{
    BearingFrame, CalibrationError, CameraCalibration, CameraName, CameraResidual, Payload, Timestamp,
    TrackEvent, TrackFrame, TrackState,
};

use crate::event_time::{Arrival, EventBuffer};
use crate::ingress::{self, Exposure, KnownCamera, Rejection, RejectionReason};
use crate::initiation::Initiator;
use crate::motion::Motion;
use crate::track::{Track, TrackStatus};
use crate::tracker::{Happening, Step, Tracker};
use crate::{ConfigError, Counters, FusionConfig};

/// What comes out of the fusion centre.
#[derive(Clone, Debug, PartialEq)]
pub enum Output {
    /// All tracks after one exposure.
    Tracks(TrackFrame),
    /// Something happened to a track.
    Event(TrackEvent),
    /// Something was not used.
    Rejected(Rejection),
}

/// The fusion centre as a state machine: frames in, tracks out; no clock, no thread, no socket.
#[derive(Debug)]
pub struct Fusion {
    config: FusionConfig,
    cameras: BTreeMap<CameraName, KnownCamera>,
    buffer: EventBuffer,
    tracker: Tracker,
    initiator: Initiator,
    counters: Counters,
    sequence: u64,
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
            cameras: BTreeMap::new(),
            buffer: EventBuffer::new(config.event_time.clone()),
            tracker: Tracker::new(config.tracking.clone(), motion),
            initiator: Initiator::new(&config),
            counters: Counters::default(),
            sequence: 0,
            config,
        })
    }

    /// Makes a camera known, or replaces what is known of it for the frames that follow.
    ///
    /// # Errors
    /// [`CalibrationError`] if the message describes no camera; what was known stays.
    pub fn calibrate(&mut self, message: &CameraCalibration) -> Result<(), CalibrationError> {
        let calibration = message.parse()?;
        self.buffer.expect(&calibration.name);
        let known = KnownCamera { camera: calibration.camera, pose_covariance: calibration.pose_covariance };
        self.cameras.insert(calibration.name, known);
        Ok(())
    }

    /// Takes a frame in and returns all that follows from it and from what it had to wait for.
    pub fn ingest(&mut self, frame: &BearingFrame) -> Vec<Output> {
        self.counters.count("frames");
        let mut outputs = Vec::new();
        match self.read(frame) {
            Ok((exposure, left_out)) => {
                for reason in left_out {
                    outputs.push(self.reject(frame, reason));
                }
                match self.buffer.insert(exposure) {
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
        outputs
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
        let camera = self.cameras.get(&name).ok_or(RejectionReason::UnknownCamera)?;
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

    fn handle(&mut self, next: Result<Exposure, (Exposure, RejectionReason)>, outputs: &mut Vec<Output>) {
        match next {
            Ok(exposure) => self.process(&exposure, outputs),
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

    /// One exposure, in the order of capture times.
    fn process(&mut self, exposure: &Exposure, outputs: &mut Vec<Output>) {
        let Some(KnownCamera { camera, .. }) = self.cameras.get(&exposure.camera) else {
            return;
        };
        self.counters.count("exposures");
        let Step { free, claims, mut happenings } = self.tracker.step(exposure, camera);
        let rest = Exposure { sightings: free, ..exposure.clone() };
        for start in self.initiator.add(rest, &claims, &self.cameras, self.tracker.motion()) {
            happenings.extend(self.tracker.adopt(start));
        }
        for happening in happenings {
            self.counters.count(match happening.kind {
                crossfix_message::TrackEventKind::Born => "tracks_born",
                crossfix_message::TrackEventKind::Confirmed => "tracks_confirmed",
                crossfix_message::TrackEventKind::Merged => "tracks_merged",
                crossfix_message::TrackEventKind::Manoeuvre => "tracks_manoeuvred",
                _ => "tracks_lost",
            });
            outputs.push(Output::Event(event(happening, exposure)));
        }
        let tracks: Vec<crossfix_message::Track> =
            self.tracker.tracks().map(|track| self.track_message(track, exposure.time)).collect();
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

fn event(happening: Happening, exposure: &Exposure) -> TrackEvent {
    TrackEvent {
        time_ns: exposure.time.nanos(),
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
            camera: camera.to_string(),
            time_ns: residual.time.nanos(),
            angle_rad: residual.angle,
            nis: residual.nis,
        });
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
        }
    }
}
