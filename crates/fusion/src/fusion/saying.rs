//! Output of the fusion: events of tracks, their states, their smoothed states, and cues for
//! cameras.

use crossfix_message::{CameraName, Payload, Timestamp, TrackFrame};

use super::{Fusion, Output};
use crate::cameras::KnownCamera;
use crate::cueing::{self, OwnClock};
use crate::ingress::Exposure;
use crate::messages;
use crate::track::{TrackId, TrackStatus};
use crate::tracker::TrackChange;

impl Fusion {
    /// Outputs the events of tracks.
    pub(super) fn emit_events(
        &mut self,
        changes: Vec<TrackChange>,
        time: Timestamp,
        outputs: &mut Vec<Output>,
    ) {
        for change in changes {
            self.counters.count(match change.kind {
                crossfix_message::TrackEventKind::Born => "tracks_born",
                crossfix_message::TrackEventKind::Confirmed => "tracks_confirmed",
                crossfix_message::TrackEventKind::Merged => "tracks_merged",
                crossfix_message::TrackEventKind::Manoeuvre => "tracks_manoeuvred",
                _ => "tracks_lost",
            });
            outputs.push(Output::Event(messages::event(change, time)));
        }
    }

    /// Outputs the events of tracks, and the states of the tracks that are due.
    pub(super) fn emit_tracks(
        &mut self,
        exposure: &Exposure,
        changes: Vec<TrackChange>,
        outputs: &mut Vec<Output>,
    ) {
        self.emit_events(changes, exposure.time, outputs);
        let due = self.tracker.due(exposure.time);
        let tracks: Vec<crossfix_message::Track> = due
            .iter()
            .filter_map(|id| self.tracker.track(*id))
            .map(|t| messages::track(t, exposure.time, self.tracker.motion()))
            .collect();
        if !tracks.is_empty() {
            let frame = TrackFrame {
                sequence: self.sequence,
                time_ns: exposure.time.nanos(),
                camera: exposure.camera.to_string(),
                camera_sequence: exposure.sequence,
                tracks,
                time_sd_s: self.true_time_sd_s(exposure),
                ..Default::default()
            };
            self.sequence += 1;
            let frame = frame.stamped();
            if self.smoothing.is_wanted() {
                self.smoothing.wait(frame.clone());
            }
            outputs.push(Output::Tracks(frame));
        }
        if self.smoothing.is_wanted() {
            self.smooth(exposure.time, &due, outputs);
        }
    }

    /// Sends each camera that takes cues its next cues.
    pub(super) fn cue(&mut self, now: Timestamp, outputs: &mut Vec<Output>) {
        let Self { cameras, tracker, initiator, cueing, clocks, config, site_time, .. } = self;
        let due: Vec<(&CameraName, &KnownCamera)> = cameras
            .iter()
            .filter(|(_, camera)| !camera.is_excluded() && camera.at_rest().takes_cues)
            .filter(|(name, _)| cueing.is_due(name, now))
            .map(|(name, camera)| (name, camera.at_rest()))
            .collect();
        if due.is_empty() {
            return;
        }
        let mut targets = tracker.known(now);
        targets.extend(initiator.known(now));
        for (name, known) in due {
            let [ahead_s, sd_s] = clocks
                .estimate(name)
                .map_or([0.0; 2], |clock| [clock.offset_s, clock.relative_sd_s]);
            let clock = OwnClock { ahead_s: ahead_s + site_time.ahead_s(name), sd_s };
            let max_range_m = config.initiation.max_range_m;
            let cues = cueing::cues(name, known, now, clock, &targets, max_range_m);
            outputs.push(Output::Cues(cues));
        }
    }

    /// Stores the tracks' present states for smoothing, and outputs the smoothed states that are
    /// due.
    fn smooth(&mut self, now: Timestamp, due: &[TrackId], outputs: &mut Vec<Output>) {
        let Self { smoothing, tracker, .. } = self;
        tracker.remember(due, now);
        for ended in tracker.tracks().filter(|track| track.status == TrackStatus::Lost) {
            smoothing.settle(ended);
        }
        outputs.extend(smoothing.due(now, tracker).into_iter().map(Output::Smoothed));
    }

    /// Outputs all waiting frames as smoothed so far: no later bearings will tell of them.
    pub(super) fn smooth_all(&mut self, outputs: &mut Vec<Output>) {
        outputs.extend(self.smoothing.all(&mut self.tracker).into_iter().map(Output::Smoothed));
    }
}
