//! Detector: finds by itself what comes into the image, or moves in it (Lytvynets 2020, chapter 2).
//!
//! The image goes down a pyramid of scales. On each scale ([`level`]) every cell is compared with
//! what it has been over the last seconds: background, noise, sway of the scene, light. Cells that
//! stand out and did not before make plots ([`plots`]); plots of successive images make candidates
//! ([`candidates`]). A candidate is found if a target explains its plots better than chance, the
//! noise and the scene's own texture do, by the odds that the configured rate of false finds asks
//! for. What has been found is followed by its image from then on; in the detector it is covered,
//! so that it hides nothing and is not learnt as background, and watched: where the background
//! shows the same, it was the scene. Where most of what moves moves alike ([`common_motion`]), it
//! is the scene too: the camera turns over one too bare to be registered.
//!
//! What comments say of other values of a constant is reasoned or follows by arithmetic, unless
//! they give shares of frames or of images, or false tracks per minute: those were measured on real
//! clips of a fixed camera, thermal and visible, each when its constant was chosen, so that only
//! those of one comment compare; a frame is right with a box within 10 px.

mod background;
mod candidates;
mod cell_update;
mod cells;
mod common_motion;
mod filter;
mod lens;
mod level;
mod outline;
mod plots;
mod straight;
mod views;
mod watched;

use crossfix_correlation::{Plane, Resampler};

use crate::crop::{paint_over, replace_invalid};
use crate::scene_turn::SceneTurn;
use crate::{DetectorConfig, ImagePoint, ImageTrackId, PixelBox};
use candidates::{Candidate, Candidates};
use cells::Cells;
use common_motion::{CommonMotion, FoundTarget};
use filter::halve;
use level::Level;
use plots::Plot;
use straight::Straightening;
use views::{Moment, Views};
use watched::Watched;

/// Sides of the cells of the scales, px: what is found is two or three cells large, 4 to 48 px.
/// With half of each, what is larger than 24 px makes plots at its edges only.
const CELLS: [usize; 4] = [2, 4, 8, 16];
/// Fewest cells per side of a scale: a cell's surroundings, and as much again. With half of it
/// hardly a cell has whole surroundings.
const LEAST_CELLS: usize = 18;
/// How long the background, and each part of it that comes into view, is learnt before anything is
/// found there, s. With half of it the background is
/// a mean of 4 images at first, at 30 per second, whose noise adds a quarter to the variance of the
/// changes.
const WARM_UP_S: f64 = 0.25;
/// Fewest images from which the background is learnt before anything is found, whatever their rate.
/// With half of it the background's own noise adds a half to the variance of the changes, in slow
/// streams.
const WARM_UP_IMAGES: u32 = 4;
/// Weight of an interval in the running mean of them: one image that is left out, or comes late,
/// hardly changes it. A second after a stream has fallen from 30 to 10 images per second, a second
/// is counted as 13 images (10 would be right); with half of this weight as 17.
const INTERVALS: f64 = 0.1;
/// A background that is still being learnt may look like another scene's for this long before it is
/// begun anew, s: in a clear sky the first image's targets are all of its texture, and as they move
/// on, that fades from the mean in 0.2 to 0.4 s (of 30 images per second; below 2 it is begun anew
/// at once). With half of it such a swarm is found up to 3 s later in a quarter of the skies;
/// with nothing at all hardly ever.
const MOST_LOST_S: f64 = 0.5;
/// Fewest plots of a candidate that is found: two always lie on a line, however far apart. With
/// half of it any two plots of noise that stand out enough are a target.
const LEAST_PLOTS: u32 = 3;
/// A candidate that is found has moved by more than this many times the scene's sway: a swing of
/// twice its root mean square is common, ...
const SWAYS: f64 = 3.0;
/// ... and this many times the error of a plot's place, which is a cell over the plot's strength.
/// With half of the first hovering drones are found sooner (91.5 % of the thermal frames instead of
/// 90.6) and no more false ones, but a mast swings as far. With half of the second the noise of a
/// plot's place counts as motion.
const PLACE_ERRORS: f64 = 2.0;
/// Margin that is asked above the odds of chance, nats: the images of a minute are not as many
/// chances as they seem, as noise, clouds and leaves of one image are those of the next. With 2
/// (half of it) there are 2.3 and 3.8 false tracks per minute (thermal, visible) instead of 1.1
/// and 3.1.
const NOT_INDEPENDENT: f64 = 4.0;
/// Least rate of chances that is reckoned with, 1/min: within the first minute nobody knows the
/// rate. With half of it twice as many chance candidates count as found where fewer are counted.
const LEAST_CHANCES: f64 = 600.0;
/// Margin of a known target that is covered with it: a share of its sides, and px. With half of it
/// rotors and shadows beyond the box are found as other targets.
const COVER: [f64; 2] = [0.25, 2.0];

/// A target that is followed already.
#[derive(Clone, Copy, Debug)]
pub(crate) struct KnownTarget {
    pub(crate) id: ImageTrackId,
    pub(crate) place: PixelBox,
    /// Whether the background at its place is known from before it came.
    pub(crate) is_watched: bool,
    /// How well its velocity is known, px/s, if the detector has found it.
    pub(crate) velocity_sd: Option<f64>,
}

/// A new target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Found {
    pub(crate) place: PixelBox,
    /// How far it had gone when it was found, px.
    pub(crate) gone_px: f64,
}

/// What the detector has found in an image.
#[derive(Debug, Default)]
pub(crate) struct Findings {
    pub(crate) found: Vec<Found>,
    /// Known targets that have turned out to be the scene itself.
    pub(crate) scene: Vec<ImageTrackId>,
}

/// Finds what differs from the background.
#[derive(Debug)]
pub(crate) struct Detector {
    config: DetectorConfig,
    sides: [usize; 2],
    levels: Vec<Level>,
    images: u32,
    /// Running mean of the time between images, s.
    usual_interval: f64,
    /// How long the background has been learnt since another scene was in view, s.
    settled_s: f64,
    /// Whether that has been long enough once since it was begun, ...
    has_warmed: bool,
    /// ... and for how long another scene was in view before, s.
    lost_s: f64,
    plots: Vec<Plot>,
    candidates: Candidates,
    views: Views,
    resampler: Resampler,
    /// How long most of what moves has moved alike, s.
    alike_s: f64,
    found_targets: Vec<FoundTarget>,
    watched: Watched,
}

impl Detector {
    pub(crate) fn new(config: DetectorConfig) -> Self {
        Self {
            config,
            sides: [0; 2],
            levels: Vec::new(),
            images: 0,
            usual_interval: 0.0,
            settled_s: 0.0,
            has_warmed: false,
            lost_s: 0.0,
            plots: Vec::new(),
            candidates: Candidates::default(),
            views: Views::new([0; 2]),
            resampler: Resampler::default(),
            alike_s: 0.0,
            found_targets: Vec::new(),
            watched: Watched::default(),
        }
    }

    /// Takes the next image, `interval` seconds after the last one. `turned` is where what is in it
    /// was in the tracker's first image.
    pub(crate) fn step(
        &mut self,
        image: &Plane,
        interval: f64,
        turned: SceneTurn,
        known: &[KnownTarget],
    ) -> Findings {
        if self.sides != [image.width(), image.height()] {
            *self = Self::new(self.config.clone());
            self.sides = [image.width(), image.height()];
            self.views = Views::new(self.sides);
            let fits = |cell: &&usize| self.sides.iter().all(|side| side / **cell >= LEAST_CELLS);
            self.levels = CELLS.iter().take_while(fits).map(|cell| Level::new(*cell)).collect();
        }
        // Before the first image there is no interval.
        let share = if self.images > 1 { INTERVALS } else { 1.0 };
        self.usual_interval += share * (interval - self.usual_interval);
        self.note_known(interval, known);
        let view = self.view(interval, turned);
        let Some(finest) = self.levels.first_mut() else { return Findings::default() };
        halve(image, &mut finest.reduced);
        replace_invalid(&mut finest.reduced);
        // How much the known targets stand out is measured before they are painted over.
        self.watched.note(known, &self.levels);
        for known in known {
            cover(&mut self.levels[0].reduced, &known.place);
        }
        self.learn(interval, view, known);
        if self.levels[0].has_lost_scene() {
            self.settled_s = 0.0;
            self.lost_s += interval;
            if self.has_warmed || self.lost_s > MOST_LOST_S {
                self.forget();
            }
            return Findings::default();
        }
        if self.images > 1 {
            self.settled_s += interval;
        }
        let scene = self.watched.take_scene(&self.levels, interval);
        let is_warm = self.settled_s >= WARM_UP_S && self.images > WARM_UP_IMAGES;
        self.has_warmed |= is_warm;
        let mut findings = Findings { found: Vec::new(), scene };
        if is_warm {
            self.plot(interval, known);
            findings.scene.extend(self.take_common_motion(interval));
            findings.found = self.find(image, known);
        }
        findings
    }

    /// Forgets the background and all candidates: the camera points elsewhere.
    fn forget(&mut self) {
        for level in &mut self.levels {
            *level = Level::new(level.cell());
        }
        (self.images, self.settled_s) = (0, 0.0);
        (self.has_warmed, self.lost_s, self.alike_s) = (false, 0.0, 0.0);
        self.candidates = Candidates::default();
        self.watched.clear();
    }

    /// How the next image lies against the one to which the background is fixed; if it is rolled or
    /// zoomed too far against it, the background is fixed to it from now on.
    fn view(&mut self, interval: f64, turned: SceneTurn) -> Straightening {
        self.views.note_turn(turned, interval);
        if self.images == 0 {
            self.views.fix();
        } else if self.views.is_bent_too_far() {
            let (view, usual_interval) = (self.views.of_last(), self.usual_interval);
            self.levels.iter_mut().for_each(|level| level.fix_to(view, usual_interval));
            // Their places are in the image to which it was fixed before.
            self.candidates.clear();
            self.views.fix();
        }
        self.views.of_last()
    }

    /// Takes the image into the background of every scale, except where known targets are.
    fn learn(&mut self, interval: f64, view: Straightening, known: &[KnownTarget]) {
        let share = (1.0 - (-interval / self.config.background_s).exp()) as f32;
        let turning_px_s = self.views.turning_px_s();
        let young = 1.0 / (self.images as f32 + 1.0);
        let is_first = self.images == 0;
        let moment = Moment { view, turning_px_s, interval, share, young, is_first };
        for index in 0..self.levels.len() {
            let (finer, rest) = self.levels.split_at_mut(index);
            let level = &mut rest[0];
            level.take(finer.last(), moment, &mut self.resampler);
            let in_image = known.iter().map(|known| cells_of(level, &known.place));
            let in_image: Vec<Cells> = in_image.collect();
            let straight = known.iter().map(|known| view.straight_box(known.place));
            let straight: Vec<Cells> = straight.map(|place| cells_of(level, &place)).collect();
            level.see(moment, &straight, &in_image);
        }
        self.images = self.images.saturating_add(1);
    }

    /// Takes the image's plots into the candidates.
    fn plot(&mut self, interval: f64, known: &[KnownTarget]) {
        plots::find(&mut self.levels, self.usual_interval, &mut self.plots);
        // What has its middle beyond the border is cut off by it, and seems to move as it comes in.
        let sides = self.sides;
        let is_inside = |plot: &Plot| {
            let within = |at: f64, side: usize| (0.0..=side as f64 - 1.0).contains(&at);
            within(plot.place.x, sides[0]) && within(plot.place.y, sides[1])
        };
        self.plots.retain(|plot| {
            is_inside(plot) && !known.iter().any(|known| touches(&known.place, plot))
        });
        self.candidates.step(&self.plots, interval, self.sides);
    }

    /// Notes how known targets that the detector has found move.
    fn note_known(&mut self, interval: f64, known: &[KnownTarget]) {
        self.found_targets.retain(|found| known.iter().any(|known| known.id == found.id));
        for known in known {
            let Some(sd) = known.velocity_sd else { continue };
            let place = known.place.centre();
            match self.found_targets.iter_mut().find(|found| found.id == known.id) {
                Some(found) => found.take(place, sd, interval),
                None => self.found_targets.push(FoundTarget::new(known.id, place)),
            }
        }
    }

    /// Where most of what moves moves alike, that is the scene: the distance of such candidates
    /// counts from here, and the targets that have turned out to be the scene are returned.
    fn take_common_motion(&mut self, interval: f64) -> Vec<ImageTrackId> {
        // What is registered of a bare scene's turn is a part of it.
        let views = &self.views;
        let candidates = self.candidates.likely().map(|candidate| candidate.moving(views));
        let all = self.found_targets.iter().map(|found| found.now).chain(candidates);
        let Some(scene) = CommonMotion::of(all, self.sides) else {
            self.alike_s = 0.0;
            return Vec::new();
        };
        self.alike_s += interval;
        self.candidates.restart_distance_if(|candidate| scene.holds(&candidate.moving(views)));
        let alike_s = self.alike_s;
        self.found_targets
            .extract_if(.., |found| found.is_scene(&scene, alike_s, interval))
            .map(|found| found.id)
            .collect()
    }

    /// The candidates that are found.
    fn find(&mut self, image: &Plane, known: &[KnownTarget]) -> Vec<Found> {
        let chances = self.candidates.chances_per_minute().max(LEAST_CHANCES);
        // The odds to beat: chances per minute over the false tracks that are allowed per minute.
        let asked = (chances / self.config.false_tracks_a_minute).ln() + NOT_INDEPENDENT;
        let sway_px = self.levels[0].sway_px();
        let found = self.candidates.take_if(|candidate| is_found(candidate, sway_px, asked));
        let found = found.iter().map(|candidate| Found {
            place: outline::outline(image, &candidate.plot),
            gone_px: candidate.gone_px,
        });
        found.filter(|found| !known.iter().any(|known| known.place.is_near(&found.place))).collect()
    }
}

/// Whether a candidate is found: it has gone farther than the scene sways, and a target is likelier
/// than chance by the log-likelihood ratio that is asked.
fn is_found(candidate: &Candidate, sway_px: f64, asked: f64) -> bool {
    // The ways in which what stays in its place seems to move: the scene sways, and a plot's place
    // is known to a cell over its strength only.
    let place_error = PLACE_ERRORS * candidate.plot.cell / f64::from(candidate.plot.strength);
    let moved = SWAYS * sway_px + place_error;
    candidate.plots >= LEAST_PLOTS
        && candidate.gone_px > moved
        // What is on the lens or written over the picture keeps its place there when the camera
        // turns.
        && candidate.gone_in_image_px > place_error
        && candidate.log_ratio() > asked
}

/// What is covered of a known target's box with its margin, px: left and top, right and bottom.
fn covered(place: &PixelBox) -> [[f64; 2]; 2] {
    let [share, more] = COVER;
    let margin = [place.width, place.height].map(|side| share * side + more);
    let (left, top) = (place.x - margin[0], place.y - margin[1]);
    [[left, top], [left + place.width + 2.0 * margin[0], top + place.height + 2.0 * margin[1]]]
}

/// The cells of a scale's background that a known target covers, by its place in the straightened
/// image.
fn cells_of(level: &Level, place: &PixelBox) -> Cells {
    level.background().cells_between(covered(place).map(|[x, y]| ImagePoint { x, y }))
}

/// Paints over a known target, so that it does not hide what is about it.
fn cover(reduced: &mut Plane, place: &PixelBox) {
    let sides = [reduced.width(), reduced.height()];
    let cell = CELLS[0] as f64;
    let [first, last] = covered(place).map(|corner| {
        [0, 1].map(|i| (corner[i] / cell).round().clamp(0.0, sides[i] as f64) as usize)
    });
    paint_over(reduced, &(first[0]..last[0]), first[1]..last[1]);
}

/// Whether a plot is within a box's sides of its middle, or within two of its own cells.
fn touches(known: &PixelBox, plot: &Plot) -> bool {
    let ImagePoint { x, y } = known.centre();
    let reach = |side: f64| side.max(2.0 * plot.cell);
    (plot.place.x - x).abs() <= reach(known.width)
        && (plot.place.y - y).abs() <= reach(known.height)
}
