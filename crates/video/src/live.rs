use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::{Frame, FrameSource, Losses, VideoError};

/// A camera that sends nothing for this long is reopened. Half of it would reopen a camera that is
/// only busy; with twice as much, a target at 30 m/s flies on for 120 m unseen.
pub(crate) const SILENCE: Duration = Duration::from_secs(2);
/// Upper limit of the allowed silence: cameras that send a frame in half a minute are of no use
/// here. With half of it those that send one in 16 s or more are reopened for ever.
const LONGEST_SILENCE: Duration = Duration::from_secs(32);
/// Pause before a camera is reopened for the first time; each pause is twice the one before, up to
/// the longest. With half of it one that is restarting is asked once more.
const FIRST_PAUSE: Duration = Duration::from_millis(500);
/// Longest pause before a camera is reopened: one that restarts takes half a minute, and should not
/// be asked all the time. With twice as much a camera that is back stays unseen for up to 16 s;
/// with half of it one that is gone is asked twice as often.
const LONGEST_PAUSE: Duration = Duration::from_secs(8);
/// A camera that broke off after less than this is not steady: its pauses go on growing as if it
/// had never been there. With half of it one that breaks off every three seconds is asked again
/// after half a second each time.
const STEADY: Duration = Duration::from_secs(5);
/// Pause before a camera that refused is asked again: many makes lock out a client that tries a
/// wrong password too often. With half of it tries are twice as many; with twice as much a
/// corrected password takes up to two minutes to be believed.
const REFUSED_PAUSE: Duration = Duration::from_secs(60);
/// How long dropping a [`Live`] waits for the session with the camera to be closed: an interval
/// between two frames, and the farewell. With half of it a farewell that takes its full 200 ms
/// leaves no time for the frame, and a session may stay open in the camera.
const LEAVE: Duration = Duration::from_millis(400);
/// Frames that may wait to be fetched; if there are more, the oldest is discarded. One that has
/// waited longer is of no use for where something is now. With half of it a program that stops for
/// three frames loses one; with twice as much frames may be a quarter of a second old at 30 Hz.
const WAITING: usize = 4;
/// Troubles that may wait to be fetched. With half of it the same: bad frames beyond it are not
/// said, and the first ones say why.
const TROUBLES: usize = 64;

/// What a live camera shows at the moment.
#[derive(Debug)]
pub enum LiveEvent {
    /// The next frame.
    Frame(Frame),
    /// One frame cannot be decoded, or the camera is lost; it is reopened automatically.
    Trouble(VideoError),
    /// Nothing yet.
    Nothing,
}

/// Counts of a live camera's frames and packets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LiveCounts {
    /// How often the camera was opened successfully.
    pub opened: u64,
    /// Frames that arrived but were discarded, as newer ones had come.
    pub left_out: u64,
    /// Packets that never came, where that is known.
    pub packets_lost: u64,
    /// Packets that came when they were requested again.
    pub packets_recovered: u64,
}

impl LiveCounts {
    /// Adds the increase of a source's losses since they were read before.
    fn add(&mut self, now: Losses, before: Losses) {
        self.left_out += now.frames_left_out - before.frames_left_out;
        self.packets_lost += now.packets_lost - before.packets_lost;
        self.packets_recovered += now.packets_recovered - before.packets_recovered;
    }
}

/// A live camera that is reopened whenever it breaks off or falls silent, on a thread of its own,
/// until this is dropped.
///
/// Frames are numbered consecutively over all openings; one number is left out at each reopening.
///
/// ```
/// use std::time::Duration;
/// use crossfix_video::{Live, LiveEvent, VideoError};
///
/// // A camera that nobody has switched on.
/// let live = Live::start(|_silence| {
///     Err(VideoError::Stream { url: "rtsp://nowhere/".into(), what: "nobody answers".into() })
/// });
/// assert!(matches!(live.next(Duration::from_secs(5)), LiveEvent::Trouble(_)));
/// assert!(matches!(live.next(Duration::ZERO), LiveEvent::Nothing));
/// ```
#[derive(Debug)]
pub struct Live {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// Frames and troubles that wait to be fetched, in the order in which they came.
    waiting: VecDeque<LiveEvent>,
    counts: LiveCounts,
    /// Set when this is dropped: no more frames are wanted, ...
    ended: bool,
    /// ... and set by the camera's thread once it has closed the session.
    left: bool,
}

impl State {
    /// Number of frames that wait.
    fn frames_waiting(&self) -> usize {
        self.waiting.iter().filter(|event| matches!(event, LiveEvent::Frame(_))).count()
    }

    /// Discards the oldest frame.
    fn leave_one_out(&mut self) {
        let oldest = self.waiting.iter().position(|event| matches!(event, LiveEvent::Frame(_)));
        if oldest.and_then(|oldest| self.waiting.remove(oldest)).is_some() {
            self.counts.left_out += 1;
        }
    }
}

impl Shared {
    fn locked(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether no more frames are wanted.
    fn ended(&self) -> bool {
        self.locked().ended
    }

    fn give(&self, frame: Frame) {
        let mut state = self.locked();
        state.waiting.push_back(LiveEvent::Frame(frame));
        if state.frames_waiting() > WAITING {
            state.leave_one_out();
        }
        drop(state);
        self.changed.notify_all();
    }

    fn complain(&self, trouble: VideoError) {
        let mut state = self.locked();
        if state.waiting.len() - state.frames_waiting() < TROUBLES {
            state.waiting.push_back(LiveEvent::Trouble(trouble));
        } else if !trouble.is_one_frame()
            && let Some(newest) = state.waiting.iter().rposition(is_bad_frame)
        {
            // That the camera is lost is said in place of one more bad frame.
            state.waiting.remove(newest);
            state.waiting.push_back(LiveEvent::Trouble(trouble));
        }
        drop(state);
        self.changed.notify_all();
    }

    /// Waits that long, or until no more frames are wanted.
    fn pause(&self, length: Duration) {
        let until = Instant::now() + length;
        let mut state = self.locked();
        while !state.ended {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            let waited = self.changed.wait_timeout(state, left);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

fn is_bad_frame(event: &LiveEvent) -> bool {
    matches!(event, LiveEvent::Trouble(trouble) if trouble.is_one_frame())
}

impl Live {
    /// Runs a camera; `open` opens it, given how long it may be silent.
    pub fn start(
        mut open: impl FnMut(Duration) -> Result<Box<dyn FrameSource>, VideoError> + Send + 'static,
    ) -> Self {
        let shared = Arc::new(Shared::default());
        let kept = Arc::clone(&shared);
        std::thread::spawn(move || keep(&kept, &mut open));
        Self { shared }
    }

    /// The next trouble or frame, in the order in which they came; waits for `patience` at most.
    pub fn next(&self, patience: Duration) -> LiveEvent {
        let until = Instant::now() + patience;
        let mut state = self.shared.locked();
        loop {
            if let Some(event) = state.waiting.pop_front() {
                return event;
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return LiveEvent::Nothing;
            }
            let waited = self.shared.changed.wait_timeout(state, left);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Counts so far.
    pub fn counts(&self) -> LiveCounts {
        self.shared.locked().counts
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        let mut state = self.shared.locked();
        state.ended = true;
        self.shared.changed.notify_all();
        // If the session is not closed, the camera may have no room for the next client.
        let until = Instant::now() + LEAVE;
        while !state.left {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            let waited = self.shared.changed.wait_timeout(state, left);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// Opens a camera again and again until no more frames are wanted.
fn keep(
    shared: &Shared,
    open: &mut dyn FnMut(Duration) -> Result<Box<dyn FrameSource>, VideoError>,
) {
    let (mut pause, mut silence) = (FIRST_PAUSE, SILENCE);
    let mut number = 0;
    while !shared.ended() {
        let (begun, mut frames) = (Instant::now(), 0);
        // What a camera sends may be malicious: a panic in what reads it only leads to a reopening.
        let watched = catch_unwind(AssertUnwindSafe(|| -> Result<(), VideoError> {
            let mut source = open(silence)?;
            shared.locked().counts.opened += 1;
            watch(shared, source.as_mut(), number, &mut frames)
        }));
        let trouble = watched.unwrap_or(Ok(())).err().unwrap_or(VideoError::Ended);
        // A stream that was there but showed no more than one frame may just be slow: it gets more
        // time.
        let may_be_slow = matches!(trouble, VideoError::Silent { .. }) && frames < 2;
        silence = if may_be_slow { (silence * 2).min(LONGEST_SILENCE) } else { SILENCE };
        if frames > 0 {
            // One number is left out, so that the gap is visible.
            number += frames + 1;
        }
        if frames > 0 && begun.elapsed() >= STEADY {
            pause = FIRST_PAUSE;
        }
        if matches!(trouble, VideoError::Refused { .. }) {
            pause = REFUSED_PAUSE;
        }
        shared.complain(trouble);
        shared.pause(pause);
        pause = (pause * 2).min(LONGEST_PAUSE);
    }
    shared.locked().left = true;
    shared.changed.notify_all();
}

/// Hands on a source's frames, numbered from `first`, until it ends or no more are wanted; counts
/// them in `frames`.
fn watch(
    shared: &Shared,
    source: &mut dyn FrameSource,
    first: u64,
    frames: &mut u64,
) -> Result<(), VideoError> {
    let mut counted = Losses::default();
    while !shared.ended() {
        let next = source.next_frame();
        let losses = source.losses();
        shared.locked().counts.add(losses, counted);
        counted = losses;
        match next {
            Ok(Some(frame)) => {
                *frames = frame.index + 1;
                shared.give(Frame { index: first + frame.index, ..frame });
            }
            Ok(None) => return Ok(()),
            Err(trouble) if trouble.is_one_frame() => shared.complain(trouble),
            Err(trouble) => return Err(trouble),
        }
    }
    Ok(())
}
