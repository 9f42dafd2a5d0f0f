//! Which pictures are recorded: all, none, or those around the time of a track.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crossfix_message::{TrackFrame, TrackState};

use crate::commands::numbers;

/// Most memory for pictures that wait for a track, bytes: ten seconds of 16 cameras with five
/// pictures of 60 kB per second. With half as much such a site keeps five seconds.
const MOST_WAITING_BYTES: usize = 64 << 20;

/// Which pictures are recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Wanted {
    /// Those from some seconds before a track is confirmed until some seconds after it is lost.
    Tracks,
    /// All.
    #[default]
    All,
    /// None.
    None,
}

/// Which pictures are recorded.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct VideoArgs {
    /// Which of the cameras' pictures to record.
    #[arg(long, value_enum, default_value_t)]
    video: Wanted,
    /// With --video tracks: begin this long before a track is confirmed, seconds.
    #[arg(
        long,
        value_name = "SECONDS",
        default_value_t = 10.0,
        value_parser = numbers::seconds_of_an_hour
    )]
    video_before_s: f64,
    /// With --video tracks: end this long after a track was last seen, seconds.
    #[arg(
        long,
        value_name = "SECONDS",
        default_value_t = 5.0,
        value_parser = numbers::seconds_of_an_hour
    )]
    video_after_s: f64,
}

impl Default for VideoArgs {
    fn default() -> Self {
        Self { video: Wanted::All, video_before_s: 10.0, video_after_s: 5.0 }
    }
}

/// A picture of type `P` that waits for a track.
struct Waiting<P> {
    picture: P,
    bytes: usize,
    since: Instant,
}

/// Keeps the pictures of the last seconds, and releases them when there is a track.
pub struct Pictures<P> {
    wanted: Wanted,
    before: Duration,
    after: Duration,
    waiting: VecDeque<Waiting<P>>,
    waiting_bytes: usize,
    /// Until when pictures are recorded because of the last track.
    until: Option<Instant>,
    left_out: u64,
}

impl<P> Pictures<P> {
    pub fn new(args: VideoArgs) -> Self {
        Self {
            wanted: args.video,
            before: Duration::from_secs_f64(args.video_before_s),
            after: Duration::from_secs_f64(args.video_after_s),
            waiting: VecDeque::new(),
            waiting_bytes: 0,
            until: None,
            left_out: 0,
        }
    }

    /// Whether tracks decide on what is recorded.
    pub fn wants_tracks(&self) -> bool {
        self.wanted == Wanted::Tracks
    }

    /// Number of pictures not recorded because there was no track.
    pub fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Takes in a picture of `bytes` bytes: returns it if it is to be recorded now; otherwise it
    /// waits or is left out.
    pub fn take(&mut self, picture: P, bytes: usize, now: Instant) -> Option<P> {
        match self.wanted {
            Wanted::All => Some(picture),
            Wanted::Tracks if self.until.is_some_and(|until| now <= until) => Some(picture),
            Wanted::Tracks => {
                self.waiting_bytes += bytes;
                self.waiting.push_back(Waiting { picture, bytes, since: now });
                self.forget(now);
                None
            }
            Wanted::None => {
                self.left_out += 1;
                None
            }
        }
    }

    /// Drops pictures that have waited too long or take too much memory.
    fn forget(&mut self, now: Instant) {
        let (before, most) = (self.before, MOST_WAITING_BYTES);
        while let Some(oldest) = self.waiting.front()
            && (now.saturating_duration_since(oldest.since) > before || self.waiting_bytes > most)
        {
            self.waiting_bytes -= oldest.bytes;
            self.waiting.pop_front();
            self.left_out += 1;
        }
    }

    /// Takes tracks in: if one of them is confirmed, coasting or of one camera, returns all waiting
    /// pictures, in their order, to be recorded.
    pub fn see(&mut self, tracks: &TrackFrame, now: Instant) -> impl Iterator<Item = P> + '_ {
        let wanted = if tracks.tracks.iter().any(|track| is_sure(track.state())) {
            self.forget(now);
            self.until = Some(now + self.after);
            self.waiting_bytes = 0;
            self.waiting.len()
        } else {
            0
        };
        self.waiting.drain(..wanted).map(|waiting| waiting.picture)
    }
}

fn is_sure(state: TrackState) -> bool {
    use TrackState::{Coasting, Confirmed, OneCamera};
    matches!(state, Confirmed | Coasting | OneCamera)
}

#[cfg(test)]
mod tests {
    use crossfix_message::Track;

    use super::*;

    fn frame(state: TrackState) -> TrackFrame {
        let track = Track { state: state.into(), ..Default::default() };
        TrackFrame { tracks: vec![track], ..Default::default() }
    }

    /// Records one picture per second from 0 on, named by its time, with a confirmed track in one
    /// second.
    fn recorded(wanted: Wanted, sure_at: u64, bytes: usize) -> (Vec<u64>, u64) {
        let args = VideoArgs { video: wanted, video_before_s: 3.0, video_after_s: 2.0 };
        let (mut pictures, mut kept) = (Pictures::new(args), Vec::new());
        let begin = Instant::now();
        for second in 0..20 {
            let now = begin + Duration::from_secs(second);
            let state =
                if second == sure_at { TrackState::Confirmed } else { TrackState::Tentative };
            kept.extend(pictures.see(&frame(state), now));
            kept.extend(pictures.take(second, bytes, now));
        }
        (kept, pictures.left_out())
    }

    #[test]
    fn pictures_are_kept_round_a_track_in_their_order() {
        // 16 to 19 still wait.
        assert_eq!(recorded(Wanted::Tracks, 8, 1), ((5..=10).collect(), 10));
        assert!(recorded(Wanted::Tracks, 99, 1).0.is_empty());
        assert_eq!(recorded(Wanted::All, 99, 1), ((0..20).collect(), 0));
        assert_eq!(recorded(Wanted::None, 8, 1), (vec![], 20));
    }

    #[test]
    fn what_waits_is_bounded_by_its_bytes_too() {
        let two_fit = MOST_WAITING_BYTES / 2;
        assert_eq!(recorded(Wanted::Tracks, 8, two_fit).0, [6, 7, 8, 9, 10]);
    }
}
