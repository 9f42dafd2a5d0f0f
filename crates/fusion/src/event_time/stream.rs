use crossfix_message::Timestamp;

use super::PATIENCES;

/// A camera whose frames overtake each other is waited for as such for this many times the
/// lateness. With half of it, five seconds by default, one whose frames do so every eight seconds
/// loses a frame each time.
const DISORDER_LASTS: f64 = 20.0;

/// After this many frames in a row far behind its newest, a camera's clock is taken to have been
/// ahead, even where these frames come too late. With one, a single stray frame sets its time back.
const MAX_FAR_BEHIND: u32 = 3;

/// What a camera says of a time further back than this, s, it has not held back: its clock has gone
/// back. With half of it a host that stood still for half a minute and says the newest first is
/// taken for a clock that went back; with twice as much, cameras that outlive others whose clocks
/// were ahead are followed only after a minute.
const LONGEST_BACKLOG_S: f64 = 30.0;

/// Timing of one camera's frames.
#[derive(Clone, Copy, Debug)]
pub(super) struct FrameStream {
    pub(super) newest: Timestamp,
    /// The newest time that agreed with another camera's.
    pub(super) trusted: Timestamp,
    /// From the last time but one to the newest, s, at most [`PATIENCES`] times the lateness.
    pub(super) step_s: f64,
    /// How far the camera has gone on, by its own clock and without jumps, s.
    pub(super) gone_s: f64,
    /// How far time had gone on when the camera was heard last, s.
    pub(super) heard_s: f64,
    /// How far time had gone on when the camera fell behind by more than anybody waits, s; `None`
    /// while it keeps up.
    pub(super) behind_since_s: Option<f64>,
    /// How far the camera has gone on since it fell behind the common time of the others, s: what
    /// it may have held back.
    pub(super) made_up_s: f64,
    /// Whether its clock has gone back by more than the camera can have held back, and has not
    /// reached the common time of the others since.
    pub(super) went_back: bool,
    /// Number of frames in a row far behind the newest.
    far_behind: u32,
    /// How far behind the newest other frames came, at most, s, and the newest time when one last
    /// did; from the first frame on that came too late for it.
    disorder: Option<(f64, Timestamp)>,
}

impl FrameStream {
    pub(super) fn beginning(newest: Timestamp) -> Self {
        Self {
            newest,
            trusted: Timestamp::MIN,
            step_s: 0.0,
            gone_s: 0.0,
            heard_s: 0.0,
            behind_since_s: None,
            made_up_s: 0.0,
            went_back: false,
            far_behind: 0,
            disorder: None,
        }
    }

    /// Notes the time of a frame; `late_s` is by how much the frame came too late, if it did.
    pub(super) fn observe(&mut self, time: Timestamp, late_s: Option<f64>, lateness_s: f64) {
        let behind_s = self.newest.seconds_since(time);
        let known_s = self.disorder_s(lateness_s);
        let far_behind = if behind_s > lateness_s { self.far_behind + 1 } else { 0 };
        self.far_behind = far_behind;
        if behind_s <= 0.0 {
            self.newest = time;
            self.step_s = (-behind_s).min(PATIENCES * lateness_s);
        } else if behind_s <= lateness_s {
            if late_s.is_some() || known_s > 0.0 {
                self.disorder = Some((behind_s.max(known_s), self.newest));
            }
        } else if far_behind >= MAX_FAR_BEHIND || late_s.is_none_or(|late_s| late_s <= lateness_s) {
            // No network reorders so far: the clock was ahead, and now it is not.
            let trusted = self.trusted;
            let went_back = self.went_back || behind_s > LONGEST_BACKLOG_S;
            let (gone_s, made_up_s) = (self.gone_s, self.made_up_s);
            *self = Self { trusted, went_back, gone_s, made_up_s, ..Self::beginning(time) };
        }
    }

    /// Notes whether the camera keeps up with the common time of the others, after going on by
    /// `step_s`; returns how much of that is progress.
    pub(super) fn progress(&mut self, keeps_up: bool, step_s: f64) -> f64 {
        if keeps_up {
            (self.made_up_s, self.went_back) = (0.0, false);
            return step_s;
        }
        self.made_up_s += step_s;
        // Nobody holds back so much: the camera is behind for good, and may be the one that is
        // right.
        let is_slow = self.went_back || self.made_up_s > LONGEST_BACKLOG_S;
        if is_slow { step_s } else { 0.0 }
    }

    /// Whether the camera has been behind for no longer than `bearable_s`, at `run_s`.
    pub(super) fn keeps_up(&self, run_s: f64, bearable_s: f64) -> bool {
        self.behind_since_s.is_none_or(|since_s| run_s - since_s <= bearable_s)
    }

    /// How far behind the newest another frame may still come, s: 0 for a camera that keeps the
    /// order.
    pub(super) fn disorder_s(&self, lateness_s: f64) -> f64 {
        let lasts_s = DISORDER_LASTS * lateness_s;
        let lately = |(_, then): &(f64, Timestamp)| self.newest.seconds_since(*then) <= lasts_s;
        self.disorder.filter(lately).map_or(0.0, |(behind_s, _)| behind_s)
    }
}
