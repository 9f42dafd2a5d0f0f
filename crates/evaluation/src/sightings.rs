use std::collections::BTreeMap;

use crossfix_message::{BearingFrame, ImageTrackState, Timestamp};

/// Two frames this many times farther apart than usual for their camera have missing frames between
/// them. With half of it no frame would follow another; above 2 a single missing frame goes
/// unnoticed.
const GAP_INTERVALS: f64 = 1.7;

/// Records which cameras saw something when. A track cannot be better than what was seen: real data
/// are compared with the truth at instants when enough cameras saw the target.
#[derive(Clone, Debug, Default)]
pub struct Sightings {
    /// Whether each frame of a camera has a measured bearing.
    cameras: BTreeMap<String, BTreeMap<Timestamp, bool>>,
}

impl Sightings {
    /// Adds a frame, in any order.
    pub fn add(&mut self, frame: &BearingFrame) {
        let seen = frame.tracks.iter().any(|track| track.state() == ImageTrackState::Tracking);
        let time = Timestamp::from_nanos(frame.capture_time_ns);
        self.cameras.entry(frame.camera.clone()).or_default().insert(time, seen);
    }

    /// Number of cameras that saw something, whatever it was, at each of some times: in the frame
    /// just before and in the one just after, with none missing between.
    pub fn cameras_at(&self, times: &[Timestamp]) -> Vec<usize> {
        let mut counts = vec![0; times.len()];
        for frames in self.cameras.values() {
            let Some(longest_s) = usual_interval_s(frames).map(|usual| GAP_INTERVALS * usual)
            else {
                continue;
            };
            for (count, &time) in counts.iter_mut().zip(times) {
                let before = frames.range(..time).next_back();
                let after = frames.range(time..).next();
                if let (Some((from, true)), Some((to, true))) = (before, after)
                    && to.seconds_since(*from) < longest_s
                {
                    *count += 1;
                }
            }
        }
        counts
    }
}

/// The median time between a camera's frames, s; `None` for a single frame.
fn usual_interval_s(frames: &BTreeMap<Timestamp, bool>) -> Option<f64> {
    let mut intervals: Vec<f64> = frames
        .keys()
        .zip(frames.keys().skip(1))
        .map(|(from, to)| to.seconds_since(*from))
        .collect();
    intervals.sort_by(f64::total_cmp);
    intervals.get(intervals.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use crossfix_message::BearingTrack;

    use super::*;

    fn frame(camera: &str, tenths: i64, state: Option<ImageTrackState>) -> BearingFrame {
        let track = state.map(|state| BearingTrack { state: state.into(), ..Default::default() });
        BearingFrame {
            camera: camera.to_owned(),
            capture_time_ns: tenths * 100_000_000,
            tracks: track.into_iter().collect(),
            ..Default::default()
        }
    }

    #[test]
    fn a_camera_counts_between_two_frames_that_saw_something_and_follow_each_other() {
        let mut sightings = Sightings::default();
        let measured = Some(ImageTrackState::Tracking);
        for tenths in 0..10 {
            sightings.add(&frame("a", tenths, measured));
            // `b` sees nothing in its frame of 0.3 s and guesses in that of 0.6 s; 0.8 s is
            // missing.
            let said = match tenths {
                3 => None,
                6 => Some(ImageTrackState::Coasting),
                _ => measured,
            };
            if tenths != 8 {
                sightings.add(&frame("b", tenths, said));
            }
        }
        sightings.add(&frame("one frame", 2, measured));
        let times: Vec<Timestamp> =
            (0..11).map(|k| Timestamp::from_seconds(f64::from(k) / 10.0 - 0.05)).collect();
        assert_eq!(sightings.cameras_at(&times), [0, 2, 2, 1, 1, 2, 1, 1, 1, 1, 0]);
    }
}
