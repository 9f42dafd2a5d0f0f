use crossfix_message::Timestamp;

use super::PATIENCES;

/// For so many times the lateness a camera is waited for as one whose frames overtake each other.
const DISORDER_LASTS: f64 = 20.0;

/// So many frames of a camera one after the other far behind its newest say that its clock was
/// ahead, even where they come too late.
const MOST_FAR_BEHIND: u32 = 3;

/// What a camera says of a time so far back, s, it has not held back: its clock has gone back. With
/// half of it a host that stood still for half a minute and says the newest first is taken for a
/// clock that went back; with twice as much, cameras that outlive others whose clocks were ahead are
/// followed after a minute.
const LONGEST_BACKLOG_S: f64 = 30.0;

/// How one camera's frames come.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stream {
    pub(super) newest: Timestamp,
    /// The newest time that agreed with another camera's.
    pub(super) trusted: Timestamp,
    /// From the last but one to the newest, s, as far as that is no jump.
    pub(super) step_s: f64,
    /// How far it has gone on, by its own clock and without jumps, s.
    pub(super) gone_s: f64,
    /// How far time had gone on when it was heard last, s.
    pub(super) heard_s: f64,
    /// How far time had gone on when it fell behind by more than anybody waits, s; `None` while it
    /// keeps up.
    pub(super) behind_since_s: Option<f64>,
    /// How far it has gone on since it fell behind what the others say the time is, s: what it may
    /// have held back.
    pub(super) made_up_s: f64,
    /// Its clock has gone back, by more than it can have held back, and it has not reached since
    /// what the others say the time is.
    pub(super) went_back: bool,
    /// Frames far behind the newest, one after the other.
    far_behind: u32,
    /// How far behind the newest others came, at most, s, and the newest when one did last; from a
    /// frame on that came too late for it.
    disorder: Option<(f64, Timestamp)>,
}

impl Stream {
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

    /// Takes note of a frame that came `late_s` too late.
    pub(super) fn hear(&mut self, time: Timestamp, late_s: Option<f64>, lateness_s: f64) {
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
        } else if far_behind >= MOST_FAR_BEHIND || late_s.is_none_or(|late_s| late_s <= lateness_s)
        {
            // No network reorders so far: the clock was ahead, and now it is not.
            let trusted = self.trusted;
            let went_back = self.went_back || behind_s > LONGEST_BACKLOG_S;
            let (gone_s, made_up_s) = (self.gone_s, self.made_up_s);
            *self = Self { trusted, went_back, gone_s, made_up_s, ..Self::beginning(time) };
        }
    }

    /// Takes note of whether it keeps up with what the others say the time is, `step_s` further on than
    /// before; returns how much of that is progress.
    pub(super) fn progress(&mut self, keeps_up: bool, step_s: f64) -> f64 {
        if keeps_up {
            (self.made_up_s, self.went_back) = (0.0, false);
            return step_s;
        }
        self.made_up_s += step_s;
        // Nobody holds back so much: it is behind for good, and may be the one that is right.
        let is_slow = self.went_back || self.made_up_s > LONGEST_BACKLOG_S;
        if is_slow { step_s } else { 0.0 }
    }

    /// How far behind the newest another frame may still come, s: 0 for a camera that keeps the
    /// order.
    pub(super) fn disorder_s(&self, lateness_s: f64) -> f64 {
        let lasts_s = DISORDER_LASTS * lateness_s;
        let lately = |(_, then): &(f64, Timestamp)| self.newest.seconds_since(*then) <= lasts_s;
        self.disorder.filter(lately).map_or(0.0, |(behind_s, _)| behind_s)
    }
}
