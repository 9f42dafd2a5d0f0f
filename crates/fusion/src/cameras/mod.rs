//! Everything that is known of the cameras: how each stands, and how far it is believed.
//!
//! | of a camera | learnt from | file |
//! |---|---|---|
//! | where it stands, from when on | its calibrations | `calibration.rs` |
//! | how good its pose is | how well its lines meet the others' | `pose_scale.rs` |
//! | whether it has been moved, so that its pose is less sure | the same, for longer | `watch.rs` |
//! | how noisy its bearings are | third differences of its own bearings | `noise.rs` |
//! | its clutter: bearings of no target | what no track takes | `clutter.rs` |
//! | what stands in its view for good | what it reports in one place | `rooted.rs` |
//! | where its mount points | its frames | `pointing.rs` |
//! | whether it is left out | lines beside what others see, frames out of time | `standing.rs` |
//!
//! Clocks are not kept here: they are known relative to each other, and what is learnt of one is
//! correlated with all (`crate::clocks`).

mod calibration;
mod clutter;
mod meeting;
mod noise;
mod pointing;
mod pose_scale;
mod rooted;
mod standing;
mod watch;

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use crossfix_message::{CameraName, Timestamp};

use crossfix_message::ClockSource;

use crate::uncertainty::CorrelatedNoise;
use crate::{Bearings, Exposure, FusionConfig, Weighting};
use calibration::Calibrations;
use clutter::ClutterRate;
use noise::BearingNoise;
use pose_scale::PoseScale;
use rooted::ReportedPlaces;
use standing::StandingRecord;
use watch::ErrorWatch;

pub(crate) use calibration::KnownCamera;
pub(crate) use clutter::view_sr;
pub(crate) use noise::{LASTING_S, RecentBearings, ThirdDifferences};
pub(crate) use pointing::ReportedPointing;
pub(crate) use pose_scale::ScaleSample;
pub(crate) use rooted::Rooted;
pub use standing::Standing;
pub(crate) use standing::{Fitting, Fittings};
pub use watch::PoseFinding;

/// A camera whose noise variance is this many times the reported one is doubted. Only its standing
/// says so, as the noise is counted anyway: with half of it every camera that is found to be
/// noisier than reported, by however little, would be doubted.
const DOUBTED_NOISE: f64 = 2.0;
/// What is known of a camera (the logarithm of a variance, or an offset in its deviations) and
/// changes by less than this changes no track: it is 5 % of a deviation. With half of it tracks are
/// told up to twice as often, and gain nothing, and as often the watch for moved cameras forgets
/// what it knows of a clock.
const NOTICED: f64 = 0.1;
/// Variance ratio that another clock has to the one before: so large that what a track has learnt
/// of the one says nothing of the other. With half of it the same.
const ANOTHER_CLOCK: f64 = 1e24;
/// A clock whose deviation is less than this is right, s: times are counted in nanoseconds, and
/// nothing must be divided by so small a deviation. With half of it the same.
const RIGHT_CLOCK_S: f64 = 1e-9;

/// The clock as the tracks were told of it: its source, its deviation and its offset, s.
#[derive(Clone, Copy, Debug)]
struct ToldClock {
    source: ClockSource,
    sd_s: f64,
    offset_s: f64,
}

/// Change of what is known of a clock.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ClockChange {
    /// By how much the clock is found to be ahead, in its deviations so far.
    pub(crate) ahead: f64,
    /// Ratio of its variance now to that before.
    pub(crate) ratio: f64,
}

/// All that is known of one camera.
#[derive(Clone, Debug)]
pub(crate) struct CameraState {
    calibrations: Calibrations,
    /// Where its mount pointed in its newest exposure, and the camera turned there.
    pointed: Option<(ReportedPointing, KnownCamera)>,
    pose_scale: PoseScale,
    noise: BearingNoise,
    /// Whether the reported variance is of the bearings' own noise alone, so that what is not white
    /// of it changes with them.
    may_divide_noise: bool,
    clutter: ClutterRate,
    view: ReportedPlaces,
    told_clock: Option<ToldClock>,
    /// By the targets that three others see.
    standing: StandingRecord,
    /// By the targets that two others see.
    misfits: StandingRecord,
    /// By the times of its frames.
    punctuality: StandingRecord,
    /// By whether what it sees is any of the targets that two others see in its view.
    company: StandingRecord,
}

impl CameraState {
    fn new(known: KnownCamera, setup: CameraSetup) -> Self {
        Self {
            pose_scale: PoseScale::new(known.is_declared),
            calibrations: Calibrations::first(known),
            pointed: None,
            noise: BearingNoise::default(),
            may_divide_noise: setup.may_divide_noise,
            clutter: ClutterRate::default(),
            view: ReportedPlaces::new(setup.rooted_s),
            told_clock: None,
            standing: StandingRecord::default(),
            misfits: StandingRecord::default(),
            punctuality: StandingRecord::default(),
            company: StandingRecord::default(),
        }
    }

    /// The camera as it stands and points at the exposure that is handled.
    pub(crate) fn known(&self) -> &KnownCamera {
        self.pointed.as_ref().map_or_else(|| self.calibrations.now(), |(_, known)| known)
    }

    /// The camera with the angles of its mount at zero.
    pub(crate) fn at_rest(&self) -> &KnownCamera {
        self.calibrations.now()
    }

    /// Takes in where the camera pointed in an exposure; returns whether its mount has turned it
    /// since the exposure before.
    pub(crate) fn point(&mut self, exposure: &Exposure) -> bool {
        let Some(now) = exposure.pointed else { return false };
        let has_turned =
            self.pointed.as_ref().is_none_or(|(before, _)| now.has_turned_from(before));
        self.pointed = Some((now, self.calibrations.now().pointed(&now)));
        if has_turned {
            self.view = self.view.emptied();
        }
        has_turned
    }

    /// How many times the covariance that it reports its bearings' noise has, at least 1.
    pub(crate) fn noise_factor(&self) -> f64 {
        self.noise.white().max(1.0)
    }

    /// How far the camera is believed.
    pub(crate) fn standing(&self) -> Standing {
        if self.is_excluded() {
            Standing::Excluded
        } else if self.pose_scale.is_doubted() || self.noise_factor() > DOUBTED_NOISE {
            Standing::Doubted
        } else {
            Standing::Good
        }
    }

    /// Whether it sees something, but none of the targets that two others see in its view. Pose or
    /// clock of one of the three may be wrong, or something may hide the targets: nobody is
    /// accused, but it is said.
    pub(crate) fn is_alone(&self) -> bool {
        self.company.is_excluded()
    }

    /// Takes in whether an exposure shows any of the targets that two others see in the camera's
    /// view, or other things alone; `None` if there are no such targets.
    pub(crate) fn learn_company(&mut self, time: Timestamp, company: Option<Fitting>) {
        self.company.learn(time, company.as_slice());
        self.company.lapse(time);
        self.company.review();
    }

    /// Whether the camera is left out.
    pub(crate) fn is_excluded(&self) -> bool {
        self.standing.is_excluded() || self.punctuality.is_excluded()
    }

    /// Writes into an exposure what is known of its camera, and takes in what it shows. Where too
    /// little has been seen to tell how many of the camera's bearings are false, `clutter_per_sr`
    /// is assumed.
    pub(crate) fn annotate(&mut self, exposure: &mut Exposure, clutter_per_sr: f64) {
        exposure.uncertainty.pose_scale = self.pose_scale.factor();
        exposure.uncertainty.factor = self.noise_factor();
        // Where somebody has divided the noise into its parts, the bearings report the white one.
        if self.may_divide_noise && exposure.uncertainty.declared_lasting == CorrelatedNoise::NONE {
            exposure.uncertainty.factor = self.noise.white();
            exposure.uncertainty.lasting = self.noise.lasting();
        }
        exposure.clutter_per_sr = self.clutter.per_sr(self.known()).unwrap_or(clutter_per_sr);
        let lines = exposure.sightings.iter().map(|sighting| &sighting.line);
        let rooted = self.view.see(exposure.time, lines);
        for (sighting, rooted) in exposure.sightings.iter_mut().zip(rooted) {
            sighting.rooted = rooted;
        }
    }

    /// Change of the clock since the tracks were told, by an exposure; `None` if it is small.
    fn clock_change(&mut self, exposure: &Exposure) -> Option<ClockChange> {
        let now = ToldClock {
            source: exposure.uncertainty.clock_source,
            sd_s: exposure.uncertainty.time_sd_s,
            offset_s: exposure.correction_s,
        };
        let told = *self.told_clock.get_or_insert(now);
        if told.source != now.source {
            // The tracks are correlated with the error of the clock before, and not with that of
            // this one.
            self.told_clock = Some(now);
            return Some(ClockChange { ahead: 0.0, ratio: ANOTHER_CLOCK });
        }
        // In units of the deviation that the tracks know: variance ratio q, and a = change of
        // offset / sd.
        let ratio = (now.sd_s / told.sd_s).powi(2);
        let ahead = (now.offset_s - told.offset_s) / told.sd_s;
        let known = told.sd_s > RIGHT_CLOCK_S && now.sd_s > RIGHT_CLOCK_S;
        if known && ratio.ln().abs() < NOTICED && ahead.abs() < NOTICED {
            return None;
        }
        self.told_clock = Some(now);
        known.then_some(ClockChange { ahead, ratio })
    }

    /// Takes in third differences of the camera's bearings of tracks, and the number of
    /// its unassigned bearings in an exposure (clutter). A bearing holds a track for `holding_s`.
    pub(crate) fn learn_noise(
        &mut self,
        time: Timestamp,
        third_differences: &[ThirdDifferences],
        unassigned: usize,
        holding_s: f64,
    ) {
        third_differences.iter().for_each(|differences| self.noise.see(differences));
        self.clutter.see(time, unassigned, holding_s);
    }

    /// Takes in whether a frame came in time (one that was refused says nothing else); returns the
    /// new standing if that has changed.
    pub(crate) fn note_time(&mut self, time: Timestamp, in_time: bool) -> Option<Standing> {
        let fitting = if in_time { Fitting::Fits } else { Fitting::Refused };
        self.punctuality.learn(time, &[fitting]);
        self.punctuality.review()
    }

    /// Forgets what was learnt of how the camera stood before it was moved.
    fn move_on(&mut self) {
        self.pointed = None;
        let known = self.known();
        self.pose_scale = PoseScale::new(known.is_declared);
        self.noise = BearingNoise::default();
        self.view = self.view.emptied();
        self.told_clock = None;
        self.company = StandingRecord::default();
    }
}

/// Verdict of an exposure on its camera.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Assessment {
    /// The camera's new standing, where it has changed.
    pub(crate) standing: Option<Standing>,
    /// The camera's bearings pass beside targets: its clock may be wrong.
    pub(crate) suspects_clock: bool,
}

/// What holds for all cameras.
#[derive(Clone, Copy, Debug)]
struct CameraSetup {
    /// What stays in one place for this long is rooted, s.
    rooted_s: f64,
    /// See [`CameraState::may_divide_noise`]: not if all bearings count alike, or if what pose and
    /// lens leave unmodelled is counted in.
    may_divide_noise: bool,
}

/// Everything that is known of the cameras, by name.
#[derive(Clone, Debug)]
pub(crate) struct Cameras {
    by_name: BTreeMap<CameraName, CameraState>,
    setup: CameraSetup,
    watch: ErrorWatch,
}

impl Cameras {
    /// No camera is known yet.
    pub(crate) fn new(config: &FusionConfig) -> Self {
        let Bearings { weighting, systematic_sd_rad, .. } = config.bearings;
        let setup = CameraSetup {
            rooted_s: config.tracking.coasting_after_s,
            may_divide_noise: weighting == Weighting::Reported && systematic_sd_rad == 0.0,
        };
        Self { by_name: BTreeMap::new(), setup, watch: ErrorWatch::default() }
    }

    /// Adds a camera, or a calibration of it that holds from a capture time on. The first
    /// calibration also holds for everything that was captured before it.
    pub(crate) fn calibrate(
        &mut self,
        name: CameraName,
        valid_from: Timestamp,
        known: KnownCamera,
    ) {
        match self.by_name.entry(name) {
            Entry::Vacant(place) => {
                place.insert(CameraState::new(known, self.setup));
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

    /// Number of cameras.
    pub(crate) fn len(&self) -> usize {
        self.by_name.len()
    }

    /// Moves on to a time; returns the cameras that stand elsewhere from now on. What was learnt of
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

    /// Change of the clock of an exposure's camera since the tracks were told; `None` if it is
    /// small.
    pub(crate) fn clock_change(&mut self, exposure: &Exposure) -> Option<ClockChange> {
        let change = self.by_name.get_mut(&exposure.camera)?.clock_change(exposure)?;
        self.watch.forget_clock(&exposure.camera);
        Some(change)
    }

    /// Learns from an exposure how far its camera can be believed.
    pub(crate) fn assess(
        &mut self,
        name: &CameraName,
        time: Timestamp,
        fittings: &Fittings,
    ) -> Assessment {
        let Some(camera) = self.by_name.get_mut(name) else {
            return Assessment::default();
        };
        camera.standing.learn(time, &fittings.of_three);
        camera.misfits.learn(time, &fittings.of_two);
        // By targets that only two others see nobody is accused, but the camera's clock may be
        // wrong.
        let misfits = camera.misfits.review() == Some(Standing::Excluded);
        // After `learn`, which renews the time of the last comparison: only an exposure that says
        // nothing lets a verdict lapse.
        let lapsed = camera.standing.lapse(time).then_some(Standing::Good);
        let standing = camera.standing.review().or(lapsed);
        let excluded = standing == Some(Standing::Excluded);
        if excluded {
            let others = self.by_name.iter_mut().filter(|(other, _)| *other != name);
            others.for_each(|(_, other)| other.standing.acquit());
        }
        Assessment { standing, suspects_clock: misfits || excluded }
    }

    /// Forgets the cameras' clutter rates, what they have seen stand in their views and since when,
    /// and beside whom: it is of another time.
    pub(crate) fn forget_views(&mut self) {
        for camera in self.by_name.values_mut() {
            (camera.clutter, camera.view) = (ClutterRate::default(), camera.view.emptied());
            camera.company = StandingRecord::default();
        }
    }
}
