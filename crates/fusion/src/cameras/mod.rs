//! All that is known of the cameras: how each stands, and how far it is believed.
//!
//! | of a camera | learnt from | file |
//! |---|---|---|
//! | where it stands, from when on | its calibrations | `calibration.rs` |
//! | how good its pose is | how well its lines meet the others' | `pose_scale.rs` |
//! | whether it has been moved | the same, over a minute | `watch.rs` |
//! | how noisy its bearings are | third differences of its own bearings | `noise.rs` |
//! | how much it reports that is nobody's | what no track takes | `strangers.rs` |
//! | what stands in its view for good | what it reports in one place | `rooted.rs` |
//! | where its mount points | its frames | `pointing.rs` |
//! | whether it is left out | lines beside what others see, frames out of time | `standing.rs` |
//!
//! Its clock is not here: clocks are known against each other, and what is learnt of one is tied to
//! all (`crate::clocks`).

mod calibration;
mod noise;
mod pointing;
mod pose_scale;
mod rooted;
mod standing;
mod strangers;
mod watch;

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use crossfix_message::{CameraName, Timestamp};

use crossfix_message::ClockSource;

use crate::Exposure;
use calibration::Calibrations;
use noise::WhiteNoise;
use pose_scale::PoseScale;
use rooted::View;
use standing::Standing;
use strangers::Strangers;
use watch::Watch;

pub(crate) use calibration::KnownCamera;
pub(crate) use noise::LastThree;
pub(crate) use pointing::Pointed;
pub(crate) use pose_scale::Sample;
pub(crate) use rooted::Rooted;
pub use standing::CameraStanding;
pub(crate) use standing::{Fitting, Fittings};
pub(crate) use strangers::view_sr;
pub use watch::PoseFinding;

/// A camera whose noise is so many times (variance) what it reports is doubted.
const DOUBTED_NOISE: f64 = 2.0;
/// A clock whose variance (logarithm) and offset (in its deviations) change by less than this
/// changes no track.
const NOTICED_CLOCK: f64 = 0.1;
/// By how much larger in variance another clock is taken to be than the one before: so much that
/// what a track holds of the one says nothing of the other.
const ANOTHER_CLOCK: f64 = 1e24;
/// A clock whose deviation is less than this is right, s: times are counted in nanoseconds, and
/// what is known of a clock must not be divided by next to nothing.
const RIGHT_CLOCK_S: f64 = 1e-9;

/// The clock that the tracks know of: what sets it, its deviation and its offset, s.
#[derive(Clone, Copy, Debug)]
struct ToldClock {
    source: ClockSource,
    sd_s: f64,
    offset_s: f64,
}

/// A clock that is known otherwise than it was.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ClockChange {
    /// By how much it is found to be ahead, in its deviations so far.
    pub(crate) ahead: f64,
    /// By how much its variance has changed.
    pub(crate) ratio: f64,
}

/// All that is known of one camera.
#[derive(Clone, Debug)]
pub(crate) struct CameraState {
    calibrations: Calibrations,
    /// Where its mount pointed in its newest exposure, and the camera as that turned it.
    pointed: Option<(Pointed, KnownCamera)>,
    pose_scale: PoseScale,
    noise: WhiteNoise,
    strangers: Strangers,
    view: View,
    told_clock: Option<ToldClock>,
    /// Beside targets that three others see, ...
    standing: Standing,
    /// ... that two others see, ...
    misfits: Standing,
    /// ... and how its frames' times fit.
    punctuality: Standing,
}

impl CameraState {
    fn new(known: KnownCamera, rooted_s: f64) -> Self {
        Self {
            pose_scale: PoseScale::new(known.is_declared),
            calibrations: Calibrations::first(known),
            pointed: None,
            noise: WhiteNoise::default(),
            strangers: Strangers::default(),
            view: View::new(rooted_s),
            told_clock: None,
            standing: Standing::default(),
            misfits: Standing::default(),
            punctuality: Standing::default(),
        }
    }

    /// As it stands and points at the exposure that is handled.
    pub(crate) fn known(&self) -> &KnownCamera {
        self.pointed.as_ref().map_or_else(|| self.calibrations.now(), |(_, known)| known)
    }

    /// As it stands, with the angles of a mount at zero.
    pub(crate) fn at_rest(&self) -> &KnownCamera {
        self.calibrations.now()
    }

    /// Takes in where it pointed in an exposure; returns whether its mount has turned it since the
    /// one before.
    pub(crate) fn point(&mut self, exposure: &Exposure) -> bool {
        let Some(now) = exposure.pointed else { return false };
        let has_turned =
            self.pointed.as_ref().is_none_or(|(before, _)| now.has_turned_from(before));
        self.pointed = Some((now, self.calibrations.now().pointed(&now)));
        if has_turned {
            self.view = self.view.anew();
        }
        has_turned
    }

    /// How many times its reported covariances count.
    pub(crate) fn noise_factor(&self) -> f64 {
        self.noise.factor()
    }

    /// How far it is believed.
    pub(crate) fn standing(&self) -> CameraStanding {
        if self.is_excluded() {
            CameraStanding::Excluded
        } else if self.pose_scale.is_doubted() || self.noise_factor() > DOUBTED_NOISE {
            CameraStanding::Doubted
        } else {
            CameraStanding::Good
        }
    }

    /// Whether it is left out.
    pub(crate) fn is_excluded(&self) -> bool {
        self.standing.is_excluded() || self.punctuality.is_excluded()
    }

    /// Puts into an exposure what is known of the camera, and takes what it shows in. Where too
    /// little has been seen to tell how many of its bearings are false, there are `clutter_per_sr`.
    pub(crate) fn tell(&mut self, exposure: &mut Exposure, clutter_per_sr: f64) {
        exposure.uncertainty.pose_scale = self.pose_scale.factor();
        exposure.uncertainty.factor = self.noise.factor();
        exposure.clutter_per_sr = self.strangers.per_sr(self.known()).unwrap_or(clutter_per_sr);
        let lines = exposure.sightings.iter().map(|sighting| &sighting.line);
        let rooted = self.view.see(exposure.time, lines);
        for (sighting, rooted) in exposure.sightings.iter_mut().zip(rooted) {
            sighting.rooted = rooted;
        }
    }

    /// How its clock has changed since the tracks were told, by an exposure; `None` if little.
    fn clock_change(&mut self, exposure: &Exposure) -> Option<ClockChange> {
        let now = ToldClock {
            source: exposure.uncertainty.clock_source,
            sd_s: exposure.uncertainty.time_sd_s,
            offset_s: exposure.correction_s,
        };
        let told = *self.told_clock.get_or_insert(now);
        if told.source != now.source {
            // Tracks hold the error of the clock before, and nothing of this one's.
            self.told_clock = Some(now);
            return Some(ClockChange { ahead: 0.0, ratio: ANOTHER_CLOCK });
        }
        let ratio = (now.sd_s / told.sd_s).powi(2);
        let ahead = (now.offset_s - told.offset_s) / told.sd_s;
        let known = told.sd_s > RIGHT_CLOCK_S && now.sd_s > RIGHT_CLOCK_S;
        if known && ratio.ln().abs() < NOTICED_CLOCK && ahead.abs() < NOTICED_CLOCK {
            return None;
        }
        self.told_clock = Some(now);
        known.then_some(ClockChange { ahead, ratio })
    }

    /// Takes in squared third differences of its bearings of tracks, and how many of an exposure
    /// are nobody's; a bearing holds a track for `holding_s`.
    pub(crate) fn learn_noise(
        &mut self,
        time: Timestamp,
        (third_differences, strangers): (&[f64], usize),
        holding_s: f64,
    ) {
        third_differences.iter().for_each(|squared| self.noise.see(*squared));
        self.strangers.see(time, strangers, holding_s);
    }

    /// Takes in whether a frame came in time, one that was refused says nothing else; returns the
    /// new standing if that has changed.
    pub(crate) fn note_time(&mut self, time: Timestamp, in_time: bool) -> Option<CameraStanding> {
        let fitting = if in_time { Fitting::Fits } else { Fitting::Refused };
        self.punctuality.learn(time, &[fitting]);
        self.punctuality.review()
    }

    /// It has been moved: what was learnt of it was of how it stood before.
    fn move_on(&mut self) {
        self.pointed = None;
        let known = self.known();
        self.pose_scale = PoseScale::new(known.is_declared);
        self.noise = WhiteNoise::default();
        self.view = self.view.anew();
        self.told_clock = None;
    }
}

/// What an exposure says of its camera.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Judgement {
    /// The camera's new standing, where it has changed.
    pub(crate) standing: Option<CameraStanding>,
    /// It passes beside targets: its clock may be wrong.
    pub(crate) suspects_clock: bool,
}

/// All that is known of the cameras, by name.
#[derive(Clone, Debug)]
pub(crate) struct Cameras {
    by_name: BTreeMap<CameraName, CameraState>,
    /// What stays in one place for this long is rooted, s.
    rooted_s: f64,
    watch: Watch,
}

impl Cameras {
    /// None is known yet. What stays in one place for `rooted_s` is rooted.
    pub(crate) fn new(rooted_s: f64) -> Self {
        Self { by_name: BTreeMap::new(), rooted_s, watch: Watch::default() }
    }

    /// Makes a camera known, or how it will stand from a capture time on. The first calibration
    /// holds for all that was captured before it, too.
    pub(crate) fn calibrate(
        &mut self,
        name: CameraName,
        valid_from: Timestamp,
        known: KnownCamera,
    ) {
        match self.by_name.entry(name) {
            Entry::Vacant(place) => {
                place.insert(CameraState::new(known, self.rooted_s));
            }
            Entry::Occupied(mut place) => place.get_mut().calibrations.expect(valid_from, known),
        }
    }

    /// A camera as it stood at a capture time.
    pub(crate) fn at(&self, name: &CameraName, time: Timestamp) -> Option<&KnownCamera> {
        Some(self.by_name.get(name)?.calibrations.at(time))
    }

    /// A camera as it stands at the exposure that is handled.
    pub(crate) fn known(&self, name: &CameraName) -> Option<&KnownCamera> {
        Some(self.by_name.get(name)?.known())
    }

    /// Whether a mount turns it.
    pub(crate) fn is_on_mount(&self, name: &CameraName) -> bool {
        self.known(name).is_some_and(|known| known.mount.is_some())
    }

    pub(crate) fn get(&self, name: &CameraName) -> Option<&CameraState> {
        self.by_name.get(name)
    }

    pub(crate) fn get_mut(&mut self, name: &CameraName) -> Option<&mut CameraState> {
        self.by_name.get_mut(name)
    }

    /// All cameras, ordered by name.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&CameraName, &CameraState)> {
        self.by_name.iter()
    }

    /// How many there are.
    pub(crate) fn len(&self) -> usize {
        self.by_name.len()
    }

    /// Goes on to a time; returns the cameras that stand elsewhere from now on. What was learnt of
    /// how they stood is forgotten.
    pub(crate) fn advance(&mut self, time: Timestamp) -> Vec<CameraName> {
        let mut moved = Vec::new();
        for (name, camera) in &mut self.by_name {
            if camera.calibrations.advance(time) {
                camera.move_on();
                self.watch.forget(name);
                moved.push(name.clone());
            }
        }
        moved
    }

    /// How the clock of an exposure's camera has changed since the tracks were told; `None` if
    /// little.
    pub(crate) fn clock_change(&mut self, exposure: &Exposure) -> Option<ClockChange> {
        let change = self.by_name.get_mut(&exposure.camera)?.clock_change(exposure)?;
        self.watch.forget_clock(&exposure.camera);
        Some(change)
    }

    /// Learns from an exposure how far its camera can be believed.
    pub(crate) fn judge(
        &mut self,
        name: &CameraName,
        time: Timestamp,
        fittings: &Fittings,
    ) -> Judgement {
        let Some(camera) = self.by_name.get_mut(name) else {
            return Judgement::default();
        };
        camera.standing.learn(time, &fittings.of_three);
        camera.misfits.learn(time, &fittings.of_two);
        // Beside the targets that two others see: they accuse nobody, but its clock may be wrong.
        let misfits = camera.misfits.review() == Some(CameraStanding::Excluded);
        let lapsed = camera.standing.lapse(time).then_some(CameraStanding::Good);
        let standing = camera.standing.review().or(lapsed);
        let excluded = standing == Some(CameraStanding::Excluded);
        if excluded {
            let others = self.by_name.iter_mut().filter(|(other, _)| *other != name);
            others.for_each(|(_, other)| other.standing.acquit());
        }
        Judgement { standing, suspects_clock: misfits || excluded }
    }

    /// Forgets what the cameras reported beside the targets: it was of another time.
    pub(crate) fn forget_strangers(&mut self) {
        self.by_name.values_mut().for_each(|camera| camera.strangers = Strangers::default());
    }

    /// Forgets when they have seen what.
    pub(crate) fn look_anew(&mut self) {
        self.by_name.values_mut().for_each(|camera| camera.view = camera.view.anew());
    }
}
