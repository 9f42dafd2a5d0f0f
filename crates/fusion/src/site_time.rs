//! Steps of the cameras' clocks.
//!
//! A camera's frames are numbered and come in a rhythm. Where the numbers go on and the time does
//! not go on with them, the camera's clock has stepped, or the camera has stood still. If all
//! cameras that are heard step by the same amount, within the time for which late frames are waited
//! for anyway, it is the site's time that has stepped: agents of one host, or hosts that follow one
//! source. Until that is clear the frames of the cameras that have stepped wait. If it does not
//! become clear, each clock has stepped for itself: its step is taken off its times from then on,
//! so that it goes on as if nothing had been. The site's time is what most clocks say: once most
//! have made the same step, the site's time has made it, and the clocks that have not are taken to
//! be off.
//!
//! A clock that goes back while the frames go on has stepped. Where a clock goes forward its camera
//! may have stood still: then the other cameras have gone on meanwhile.

use std::collections::BTreeMap;

use crossfix_message::{BearingFrame, CameraName, Timestamp};

/// A frame that is off its camera's rhythm by less than this is only late, s. With half of it the
/// frames of phones, which have no rate, are held up.
const LEAST_STEP_S: f64 = 0.25;
/// The same in periods of the camera. With half of it a frame or two that were numbered and not
/// sent count as a step.
const LEAST_STEP_PERIODS: f64 = 4.0;
/// Frames after which a camera's rhythm is known. With half of it two frames close together make a
/// rhythm.
const KNOWN_RHYTHM: u32 = 5;
/// The share of a frame in the running mean of its camera's period. With half of it a new rate is
/// learnt in a second.
const PERIOD_SHARE: f64 = 0.1;
/// Cameras that have been silent for longer than this are not asked, and after a longer gap a
/// rhythm says nothing, s. With half of it cameras of 1 Hz are asked by chance.
const LIVE_S: f64 = 2.0;
/// Share of the lateness (the time for which late frames are waited for) that a decision may take.
/// With half of it hosts whose frames are a tenth of a second apart on their way do not step
/// together; with all of it the frames that wait are late.
const SHARE_OF_LATENESS: f64 = 0.5;
/// A camera whose clock has gone forward has stood still if the others have gone on by this share
/// of the step. Any share between none and all of the step serves.
const SHARE_OF_STEP: f64 = 0.5;
/// Bounds on what waits. Beyond them each clock is taken to have stepped for itself: with half of
/// them thirty cameras of 30 Hz have 0.1 s to show that all have stepped, and not 0.2 s.
struct WaitingBounds {
    /// Frames of all cameras.
    frames: usize,
    /// Bearings in all of them.
    bearings: usize,
}

/// The numbers in use; what half of each does is said at its field.
const BOUNDS: WaitingBounds = WaitingBounds { frames: 200, bearings: 20_000 };

/// A frame as stamped by a clock that is `ahead_s` ahead of its camera's.
pub(crate) fn moved(frame: &BearingFrame, ahead_s: f64) -> BearingFrame {
    let time = Timestamp::from_nanos(frame.capture_time_ns).plus_seconds(ahead_s);
    BearingFrame { capture_time_ns: time.nanos(), ..frame.clone() }
}

/// Rhythm of one camera's frames so far.
#[derive(Clone, Copy, Debug)]
struct Rhythm {
    sequence: u64,
    time: Timestamp,
    period_s: f64,
    frames: u32,
    /// How far the camera has gone on by its own clock, s, steps left out.
    gone_s: f64,
    /// How far all cameras together had gone on when this one was heard last, s.
    heard_s: f64,
    /// Sum of the steps that its clock has made for itself, s.
    ahead_s: f64,
    /// Whether the newest frame was off the rhythm.
    has_stepped: bool,
    /// The newest time of another camera when this one was heard last.
    others: Option<Timestamp>,
}

impl Rhythm {
    fn beginning(sequence: u64, time: Timestamp) -> Self {
        Self {
            sequence,
            time,
            period_s: 0.0,
            frames: 0,
            gone_s: 0.0,
            heard_s: 0.0,
            ahead_s: 0.0,
            has_stepped: false,
            others: None,
        }
    }

    /// The newest time with the clock's own steps taken off.
    fn settled(&self) -> Timestamp {
        self.time.plus_seconds(-self.ahead_s)
    }

    /// By how much the next frame's time is off the rhythm, s; `None` where late frames may explain
    /// it.
    fn step(&self, sequence: u64, time: Timestamp) -> Option<f64> {
        let numbers = sequence
            .checked_sub(self.sequence)
            .filter(|n| *n > 0 && self.frames >= KNOWN_RHYTHM)?;
        let due_s = numbers as f64 * self.period_s;
        let since_s = time.seconds_since(self.time);
        let step = since_s - due_s;
        // Where numbers are missing for long, the rhythm does not say when the next was due.
        // A frame that only comes early may follow one that was late; a clock that has stepped back
        // shows a time before the last one.
        let is_known = due_s <= LIVE_S && (step > 0.0 || since_s < 0.0);
        (is_known && step.abs() > LEAST_STEP_S.max(LEAST_STEP_PERIODS * self.period_s))
            .then_some(step)
    }

    /// Takes the next frame in; returns how far the camera has gone on with that frame, s.
    fn go_on(&mut self, sequence: u64, time: Timestamp, step: Option<f64>) -> f64 {
        let numbers = sequence.saturating_sub(self.sequence);
        let since_s = time.seconds_since(self.time) - step.unwrap_or(0.0);
        let is_another_rate = step.is_some() && self.has_stepped;
        self.has_stepped = step.is_some();
        if numbers == 0 || is_another_rate || since_s <= 0.0 && step.is_none() {
            // Numbered from the start, out of order, or at another rate from now on: the rhythm has
            // to show again.
            (self.period_s, self.frames) = (0.0, 0);
        } else if step.is_none() {
            // A plain mean at first, exponential later.
            let share = PERIOD_SHARE.max(f64::from(self.frames + 1).recip());
            self.period_s += (since_s / numbers as f64 - self.period_s) * share;
            self.frames = self.frames.saturating_add(1);
        }
        (self.sequence, self.time) = (sequence, time);
        let gone_s = since_s.clamp(0.0, LIVE_S);
        self.gone_s += gone_s;
        gone_s
    }
}

/// The step of a clock.
#[derive(Clone, Copy, Debug)]
struct ClockStep {
    step_s: f64,
    /// The camera's rhythm before the step.
    before: Rhythm,
    /// How far the others have gone on meanwhile, s.
    others_s: f64,
}

impl ClockStep {
    /// Whether the clock has stepped, by its camera's rhythm now: it is neither a camera that stood
    /// still, nor a single frame with a wrong time.
    fn is_of_clock(&self, now: &Rhythm) -> bool {
        let numbers = now.sequence.saturating_sub(self.before.sequence);
        let off_s =
            now.time.seconds_since(self.before.time) - numbers as f64 * self.before.period_s;
        // If the others have gone on as well, time has really passed.
        let stood_still = self.step_s > 0.0 && self.others_s > SHARE_OF_STEP * self.step_s;
        numbers >= 2 && (off_s - self.step_s).abs() < LEAST_STEP_S && !stood_still
    }
}

/// Frames that wait, and steps, until it is clear whether all cameras have stepped.
#[derive(Debug, Default)]
struct Pending {
    frames: Vec<BearingFrame>,
    steps: BTreeMap<CameraName, ClockStep>,
    /// How far each camera had gone on at the first of these steps, s.
    gone_s: BTreeMap<CameraName, f64>,
}

impl Pending {
    fn beginning(rhythms: &BTreeMap<CameraName, Rhythm>) -> Self {
        let gone_s = rhythms.iter().map(|(name, rhythm)| (name.clone(), rhythm.gone_s)).collect();
        Self { gone_s, ..Self::default() }
    }

    /// How far a camera has gone on since the first of these steps, s.
    fn waited_s(&self, camera: &CameraName, rhythm: &Rhythm) -> f64 {
        rhythm.gone_s - self.gone_s.get(camera).copied().unwrap_or(0.0)
    }
}

/// Decision on a frame.
#[derive(Debug, PartialEq)]
pub(crate) enum FrameDecision {
    /// The frame is taken at once.
    Now,
    /// The frame waits.
    Waits,
    /// The waiting frames are taken, and then this one: all clocks have stepped by this much, s.
    Together(Vec<BearingFrame>, f64),
    /// The same, where each clock has stepped for itself.
    Apart(Vec<BearingFrame>, Apart),
}

/// Clocks that have stepped for themselves.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Apart {
    /// Cameras whose steps are taken off.
    pub(crate) cameras: Vec<CameraName>,
    /// By how much most clocks have stepped by now, s: so has the site's time.
    pub(crate) site_s: Option<f64>,
}

/// Watches the cameras' times for steps that all of them make.
#[derive(Debug)]
pub(crate) struct SiteTime {
    longest_s: f64,
    rhythms: BTreeMap<CameraName, Rhythm>,
    /// How far all cameras together have gone on, s: there is no other clock here.
    gone_s: f64,
    pending: Option<Pending>,
}

impl SiteTime {
    /// For a site where late frames are waited for by `lateness_s`.
    pub(crate) fn new(lateness_s: f64) -> Self {
        let longest_s = SHARE_OF_LATENESS * lateness_s;
        Self { longest_s, rhythms: BTreeMap::new(), gone_s: 0.0, pending: None }
    }

    /// Takes a known camera's frame.
    pub(crate) fn see(&mut self, camera: &CameraName, frame: &BearingFrame) -> FrameDecision {
        let (sequence, time) = (frame.sequence, Timestamp::from_nanos(frame.capture_time_ns));
        let others = self.newest_of_others(camera);
        let rhythm =
            self.rhythms.entry(camera.clone()).or_insert(Rhythm::beginning(sequence, time));
        if sequence < rhythm.sequence
            && let Some(others) = others
        {
            // The camera's agent has been started again, perhaps with another clock.
            let off_s = |ahead_s: f64| time.plus_seconds(-ahead_s).seconds_since(others).abs();
            if off_s(0.0) < off_s(rhythm.ahead_s) {
                rhythm.ahead_s = 0.0;
            }
        }
        let (before, step) = (*rhythm, rhythm.step(sequence, time));
        rhythm.others = others;
        let others_s = match (before.others, others) {
            (Some(before), Some(now)) => now.seconds_since(before),
            _ => 0.0,
        };
        self.gone_s += rhythm.go_on(sequence, time, step);
        rhythm.heard_s = self.gone_s;
        // A clock that was not on the site's time steps for itself.
        if let Some(step_s) = step.filter(|_| self.is_of_site(camera, before.settled())) {
            let pending = self.pending.get_or_insert_with(|| Pending::beginning(&self.rhythms));
            pending.steps.entry(camera.clone()).or_insert(ClockStep { step_s, before, others_s });
        }
        let Some(pending) = &mut self.pending else {
            return FrameDecision::Now;
        };
        let waits = pending.steps.contains_key(camera);
        if waits {
            pending.frames.push(frame.clone());
        }
        let Some(step) = self.decide() else {
            return if waits { FrameDecision::Waits } else { FrameDecision::Now };
        };
        let apart = step.is_none().then(|| self.part());
        let mut frames = self.end();
        if !waits {
            frames.push(frame.clone());
        }
        match (step, apart) {
            (Some(step_s), _) => FrameDecision::Together(frames, step_s),
            (None, apart) => FrameDecision::Apart(frames, apart.unwrap_or_default()),
        }
    }

    /// Sum of the steps that a camera's clock has made for itself, s.
    pub(crate) fn ahead_s(&self, camera: &CameraName) -> f64 {
        self.rhythms.get(camera).map_or(0.0, |rhythm| rhythm.ahead_s)
    }

    /// Handles a camera that does not keep the site's time with its clock's steps taken off: they
    /// were none.
    pub(crate) fn forget_steps(&mut self, camera: &CameraName) {
        if let Some(rhythm) = self.rhythms.get_mut(camera) {
            rhythm.ahead_s = 0.0;
        }
    }

    /// Takes each clock's own step off its times from now on.
    fn part(&mut self) -> Apart {
        let steps = self.pending.as_ref().map(|pending| pending.steps.clone()).unwrap_or_default();
        let mut apart = Apart::default();
        if self.live().count() < 2 {
            return apart;
        }
        for (camera, step) in steps {
            let Some(rhythm) = self.rhythms.get_mut(&camera) else { continue };
            if step.is_of_clock(rhythm) {
                rhythm.ahead_s += step.step_s;
                apart.cameras.push(camera);
            }
        }
        let mut ahead: Vec<f64> = self.live().map(|(_, rhythm)| rhythm.ahead_s).collect();
        ahead.sort_unstable_by(f64::total_cmp);
        // The median; where as many have stepped as have not, that of the clocks that have not.
        let middle = [ahead[(ahead.len() - 1) / 2], ahead[ahead.len() / 2]];
        let of_most = if middle[0].abs() < middle[1].abs() { middle[0] } else { middle[1] };
        if of_most.abs() > LEAST_STEP_S {
            self.rhythms.values_mut().for_each(|rhythm| rhythm.ahead_s -= of_most);
            apart.site_s = Some(of_most);
        }
        apart
    }

    /// Notes that a camera has come to its end: nobody asks it any more.
    pub(crate) fn forget(&mut self, camera: &CameraName) {
        self.rhythms.remove(camera);
    }

    /// Gives out the frames that wait: no more come.
    pub(crate) fn end(&mut self) -> Vec<BearingFrame> {
        self.pending.take().map_or_else(Vec::new, |pending| pending.frames)
    }

    fn live(&self) -> impl Iterator<Item = (&CameraName, &Rhythm)> {
        // `gone_s` sums over all cameras, so it grows by their number in each second.
        let longest_s = LIVE_S * self.rhythms.len() as f64;
        self.rhythms.iter().filter(move |(_, rhythm)| self.gone_s - rhythm.heard_s <= longest_s)
    }

    /// Whether a camera's time agrees with that of most others that have not stepped.
    fn is_of_site(&self, camera: &CameraName, time: Timestamp) -> bool {
        let has_stepped =
            |name| self.pending.as_ref().is_some_and(|pending| pending.steps.contains_key(name));
        let others = self.live().filter(|(name, _)| *name != camera && !has_stepped(name));
        let mut times: Vec<Timestamp> = others.map(|(_, rhythm)| rhythm.settled()).collect();
        times.sort_unstable();
        times.get(times.len() / 2).is_none_or(|others| time.seconds_since(*others).abs() < LIVE_S)
    }

    /// The newest time of the other cameras: one of them that goes on is enough to show that time
    /// does.
    fn newest_of_others(&self, camera: &CameraName) -> Option<Timestamp> {
        let others = self.live().filter(|(name, _)| *name != camera);
        others.map(|(_, rhythm)| rhythm.settled()).max()
    }

    /// By how much all clocks have stepped, s, or `Some(None)` if each has for itself; `None` while
    /// neither is clear.
    fn decide(&self) -> Option<Option<f64>> {
        let pending = self.pending.as_ref()?;
        let mut steps: Vec<f64> = pending.steps.values().map(|step| step.step_s).collect();
        steps.sort_unstable_by(f64::total_cmp);
        let step = steps[steps.len() / 2];
        let is_common = steps.iter().all(|other| (other - step).abs() < LEAST_STEP_S);
        if is_common
            && steps.len() >= 2
            && self.live().all(|(name, _)| pending.steps.contains_key(name))
        {
            return Some(Some(step));
        }
        let bearings: usize = pending.frames.iter().map(|frame| frame.tracks.len()).sum();
        let is_full = pending.frames.len() >= BOUNDS.frames || bearings > BOUNDS.bearings;
        let waited_s = self.live().map(|(name, rhythm)| pending.waited_s(name, rhythm));
        let is_late = waited_s.fold(0.0, f64::max) > self.longest_s;
        (is_full || is_late || self.live().count() < 2).then_some(None)
    }
}
