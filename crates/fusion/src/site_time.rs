//! A step of all clocks at once: the source of time that the cameras share was off and has been set right.
//!
//! A camera's frames are numbered and come in a rhythm. Where the numbers go on by one and the time does not, its
//! clock has stepped, or it has stood still; where most cameras do so by as much, it is the site's time. Until
//! that is clear the frames of those that have stepped wait.

use std::collections::BTreeMap;

use crossfix_message::{BearingFrame, CameraName, Timestamp};

/// A frame that is off its camera's rhythm by less than this has only been late, s. With half of it the frames of
/// phones, which have no rate, are held up; a step of less moves targets by no more than they are gated by.
const LEAST_STEP_S: f64 = 0.25;
/// The same in its periods: frames in between may have been numbered otherwise.
const LEAST_STEP_PERIODS: f64 = 4.0;
/// Frames after which a camera's rhythm is known.
const KNOWN_RHYTHM: u32 = 5;
/// The share of a frame in the running mean of its camera's period.
const PERIOD_SHARE: f64 = 0.1;
/// Cameras that were silent for longer than this are not asked, s.
const LIVE_S: f64 = 2.0;
/// No decision takes longer than this by any camera's frames, s, ...
const LONGEST_S: f64 = 1.0;
/// ... or more frames than this: where all are silent but one that is quick.
const MOST_WAITING: usize = 200;

/// A frame by a clock that is ahead of its camera's.
pub(crate) fn moved(frame: &BearingFrame, ahead_s: f64) -> BearingFrame {
    let time = Timestamp::from_nanos(frame.capture_time_ns).plus_seconds(ahead_s);
    BearingFrame { capture_time_ns: time.nanos(), ..frame.clone() }
}

/// One camera's frames so far.
#[derive(Clone, Copy, Debug)]
struct Rhythm {
    sequence: u64,
    time: Timestamp,
    period_s: f64,
    frames: u32,
    /// How far it has gone on by its own clock, s, steps left out, ...
    gone_s: f64,
    /// ... and all cameras together, when it was heard last.
    heard_s: f64,
}

impl Rhythm {
    fn beginning(sequence: u64, time: Timestamp) -> Self {
        Self { sequence, time, period_s: 0.0, frames: 0, gone_s: 0.0, heard_s: 0.0 }
    }

    /// By how much the next frame's time is off the rhythm, s, where that is no matter of frames that were late.
    fn step(&self, sequence: u64, time: Timestamp) -> Option<f64> {
        let numbers =
            sequence.checked_sub(self.sequence).filter(|n| *n > 0 && self.frames >= KNOWN_RHYTHM)?;
        let step = time.seconds_since(self.time) - numbers as f64 * self.period_s;
        (step.abs() > LEAST_STEP_S.max(LEAST_STEP_PERIODS * self.period_s)).then_some(step)
    }

    /// Takes the next frame in; returns how far the camera has gone on with it, s.
    fn go_on(&mut self, sequence: u64, time: Timestamp, step: Option<f64>) -> f64 {
        let numbers = sequence.saturating_sub(self.sequence);
        let since_s = time.seconds_since(self.time) - step.unwrap_or(0.0);
        if numbers == 0 {
            // Numbered anew, or out of order: what went before says nothing of what comes.
            (self.period_s, self.frames) = (0.0, 0);
        } else if step.is_none() && since_s > 0.0 {
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

/// Cameras that have stepped, until it is clear whether all have.
#[derive(Debug)]
struct Pending {
    /// When the first would have been exposed, by its clock as it was.
    since: Timestamp,
    frames: Vec<BearingFrame>,
    steps: BTreeMap<CameraName, f64>,
    /// How far the cameras had gone on then, s.
    gone_s: BTreeMap<CameraName, f64>,
}

/// What becomes of a frame.
#[derive(Debug, PartialEq)]
pub(crate) enum Turn {
    /// It is taken at once; its clock has yet to step as the others have, by so much, s.
    Now(f64),
    /// It waits.
    Waits,
    /// It and those that waited are taken: all clocks seem to have stepped, or each for itself.
    Together(Vec<BearingFrame>, Option<Step>),
}

/// What looks like a step of all clocks.
#[derive(Debug, PartialEq)]
pub(crate) struct Step {
    /// By so much, s.
    pub(crate) by_s: f64,
    /// Cameras that have not come so far yet.
    behind: Vec<CameraName>,
}

/// Watches the cameras' times for steps that all make.
#[derive(Debug, Default)]
pub(crate) struct SiteTime {
    rhythms: BTreeMap<CameraName, Rhythm>,
    /// How far all cameras together have gone on, s: there is no other clock here.
    gone_s: f64,
    pending: Option<Pending>,
    /// Cameras that have not stepped with the others yet, and by how much they are behind, s.
    behind: BTreeMap<CameraName, f64>,
}

impl SiteTime {
    /// Takes a known camera's frame.
    pub(crate) fn see(&mut self, camera: &CameraName, frame: &BearingFrame) -> Turn {
        let (sequence, time) = (frame.sequence, Timestamp::from_nanos(frame.capture_time_ns));
        let rhythm = self.rhythms.entry(camera.clone()).or_insert(Rhythm::beginning(sequence, time));
        let (before, step) = (*rhythm, rhythm.step(sequence, time));
        self.gone_s += rhythm.go_on(sequence, time, step);
        rhythm.heard_s = self.gone_s;
        let is_alike = |behind: f64| step.is_some_and(|step| (behind - step).abs() < LEAST_STEP_S);
        if self.behind.get(camera).copied().is_some_and(is_alike) {
            // It comes after the others, as was expected.
            self.behind.remove(camera);
            return Turn::Now(0.0);
        }
        // A clock that was none of the site's steps for itself.
        let was = before.time.plus_seconds(self.behind_s(camera));
        if let Some(step) = step.filter(|_| self.is_of_site(camera, was)) {
            let pending = self.pending.get_or_insert_with(|| Pending {
                since: before.time.plus_seconds(before.period_s),
                frames: Vec::new(),
                steps: BTreeMap::new(),
                gone_s: self.rhythms.iter().map(|(name, rhythm)| (name.clone(), rhythm.gone_s)).collect(),
            });
            pending.steps.insert(camera.clone(), step);
        }
        match &mut self.pending {
            Some(pending) if pending.steps.contains_key(camera) => {
                pending.frames.push(frame.clone());
                self.decide().unwrap_or(Turn::Waits)
            }
            Some(_) => match self.decide() {
                Some(Turn::Together(mut frames, step)) => {
                    frames.push(frame.clone());
                    Turn::Together(frames, step)
                }
                _ => Turn::Now(0.0),
            },
            None => Turn::Now(self.behind_s(camera)),
        }
    }

    /// Whether a camera's time is what most others have that have not stepped.
    fn is_of_site(&self, camera: &CameraName, time: Timestamp) -> bool {
        let has_stepped =
            |name| self.pending.as_ref().is_some_and(|pending| pending.steps.contains_key(name));
        let others = self.rhythms.iter().filter(|(name, _)| *name != camera && !has_stepped(name));
        let mut times: Vec<Timestamp> = others.map(|(_, rhythm)| rhythm.time).collect();
        times.sort_unstable();
        times.get(times.len() / 2).is_none_or(|others| time.seconds_since(*others).abs() < LIVE_S)
    }

    /// All clocks have stepped indeed: those that are behind are expected to.
    pub(crate) fn confirm(&mut self, step: &Step) {
        self.behind = step.behind.iter().map(|camera| (camera.clone(), step.by_s)).collect();
    }

    /// How far a camera's clock has yet to step to where the others are, s.
    pub(crate) fn behind_s(&self, camera: &CameraName) -> f64 {
        self.behind.get(camera).copied().unwrap_or(0.0)
    }

    /// Gives out what waits: no more frames come.
    pub(crate) fn end(&mut self) -> Vec<BearingFrame> {
        self.pending.take().map_or_else(Vec::new, |pending| pending.frames)
    }

    /// Whether all clocks have stepped, or each for itself, if that is clear.
    fn decide(&mut self) -> Option<Turn> {
        let pending = self.pending.as_ref()?;
        let mut steps: Vec<f64> = pending.steps.values().copied().collect();
        steps.sort_unstable_by(f64::total_cmp);
        let step = steps[steps.len() / 2];
        let alike = steps.iter().filter(|other| (**other - step).abs() < LEAST_STEP_S).count();
        let is_live = |rhythm: &Rhythm| self.gone_s - rhythm.heard_s <= LIVE_S * self.rhythms.len() as f64;
        let gone_s = |name: &CameraName, rhythm: &Rhythm| {
            rhythm.gone_s - pending.gone_s.get(name).copied().unwrap_or(0.0)
        };
        // Exposed since then by a clock that has not stepped, unless its frames have been long on their way.
        let is_steady = |name: &CameraName, rhythm: &Rhythm| {
            let old = -LIVE_S..LEAST_STEP_S / 2.0;
            gone_s(name, rhythm) > LEAST_STEP_S / 2.0
                && !old.contains(&rhythm.time.seconds_since(pending.since))
        };
        let live = || self.rhythms.iter().filter(|(_, rhythm)| is_live(rhythm));
        let others = || live().filter(|(name, _)| !pending.steps.contains_key(*name));
        let steady = others().filter(|(name, rhythm)| is_steady(name, rhythm)).count();
        let half = (others().count() + steps.len()) / 2;
        let is_sites = alike >= 2 && alike > half;
        let longest_s = live().map(|(name, rhythm)| gone_s(name, rhythm)).fold(0.0, f64::max);
        let is_alone = others().next().is_none();
        let too_long = longest_s > LONGEST_S || pending.frames.len() >= MOST_WAITING;
        if !(is_sites || steady >= half.max(1) || is_alone || too_long) {
            return None;
        }
        let step =
            is_sites.then(|| Step { by_s: step, behind: others().map(|(name, _)| name.clone()).collect() });
        Some(Turn::Together(self.end(), step))
    }
}
