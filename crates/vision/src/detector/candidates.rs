//! What plots of one image after the other belong to: detection after tracking over a second or
//! two, so that what is no more than the noise in one image is found in ten.

use crossfix_filter::{AxisFilter, AxisMeasurement, Gate};

use super::plots::Plot;
use crate::ImagePoint;

/// Probability that a candidate's plot is in its gate.
const IN_GATE: f64 = 0.999;
/// Probability that what is there makes a plot in an image. With 0.9 what blinks in noise is
/// dropped, with 0.6 chains of noise live long.
const MAKES_PLOT: f64 = 0.8;
/// Standard deviation of the velocity of what is found, px/s: 400 px/s is not lost by it.
const VELOCITY_SD_PX: f64 = 120.0;
/// Standard deviation of its white acceleration, px/s^2: a turn of 2 g at 100 m in a lens of 1000
/// px a radian, half over.
const ACCELERATION_SD_PX: f64 = 300.0;
/// Scales of one thing's plots differ by at most so many times: as its parts and its shadow come
/// and go, the next scale on either side stands out more. With 5 a bird's plots and its flock's are
/// one thing's.
const SCALES: f64 = 2.5;
/// A plot tells at most so much (logarithm of a likelihood ratio): an empty corner of the map is
/// not known to be empty.
const MOST_OF_PLOT: f64 = 4.0;
/// Plots of something that keeps to its place tell at most so much together: what comes and goes in
/// the same place, as a branch in the wind, makes as many as a target. With half of it false tracks
/// are 0.4 and 1.5 per minute (thermal, visible) in place of 1.1 and 3.1, but what a shaken camera
/// sees in noise is found in 76 % of the images in place of 89; with twice as much they are 13 and
/// 49.
const MOST_IN_PLACE: f64 = 8.0;
/// ... and so much more where noise does not last: then what lasts is less likely to be nothing.
const MOST_IN_NOISE: f64 = 4.0;
/// So many of its cells further it is in another place, over another part of the scene, ...
const PLACE_CELLS: f64 = 6.0;
/// ... of which so many are counted: what jumps from branch to branch has gone far too.
const MOST_PLACES: f64 = 10.0;
/// The scene's own changes fall off with size as the exponential of so many of its textures:
/// compressed video has more large ones than a normal distribution. With twice as much 89.0 % of
/// the thermal frames have their target in place of 90.6, and false tracks are 0.4 and 1.9 a
/// minute.
const TAIL: f64 = 1.5;
/// What it takes to stand out for a target, nats. Strengths from one to two hundred, uniform in
/// their logarithm, give `ln ln 200` = 1.7; the rest is a margin, chosen on scenes without targets.
const STANDING: f64 = 2.5;
/// What stands out tells at most so much.
const MOST_OF_STANDING: f64 = 10.0;
/// Variance of the noise that a mean over many images keeps, spreads^2: plots are those of the
/// noise that stand out.
const LEAST_NOISE: f64 = 0.5;
/// A candidate with less than this is dropped, ...
const LEAST_LOG_RATIO: f64 = -2.0;
/// ... and one without a plot for so long, s.
const UNSEEN_S: f64 = 0.4;
/// Most candidates, those with the greatest log ratios: two images' plots.
const MOST: usize = 400;
/// Side of a cell of the map of clutter, px.
const MAP_CELL_PX: f64 = 32.0;
/// Over how long the clutter is a mean, s: with 1 a target's own first plots make it improbable,
/// with 10 the leaves of a gust are targets.
const CLUTTER_S: f64 = 3.0;
/// Least clutter of a cell of the map, plots an image: one in ten thousand. With less, whatever
/// comes into an empty sky is found with its second plot.
const LEAST_CLUTTER: f64 = 1e-4;

/// Something that may be a target.
///
/// Its places are in the scene: what a place is in the first image.
#[derive(Clone, Debug)]
pub(super) struct Candidate {
    axes: [AxisFilter; 2],
    /// The latest plot.
    pub(super) plot: Plot,
    /// Log-likelihood ratio of where its plots were against chance.
    motion_log_ratio: f64,
    /// Mean of the plots' excess, in spreads.
    mean_excess: f64,
    pub(super) plots: u32,
    unseen_s: f64,
    first: [f64; 2],
    /// How far it has been from its first place, px.
    pub(super) gone_px: f64,
}

impl Candidate {
    fn new(plot: Plot, place: [f64; 2]) -> Self {
        let start = |position| {
            let first = AxisMeasurement { position, variance: plot.variance() };
            AxisFilter::start_at_rest(first, VELOCITY_SD_PX, ACCELERATION_SD_PX)
        };
        Self {
            axes: place.map(start),
            plot,
            motion_log_ratio: 0.0,
            mean_excess: f64::from(plot.excess),
            plots: 1,
            unseen_s: 0.0,
            first: place,
            gone_px: 0.0,
        }
    }

    /// How many parts of the scene it has been over.
    fn parts(&self) -> f64 {
        1.0 + (self.gone_px / (PLACE_CELLS * self.plot.cell)).min(MOST_PLACES)
    }

    /// Log-likelihood ratio of a target against what the scene and the noise make.
    ///
    /// The scene's texture is another in every part of it; noise is another in every image, as far
    /// as it does not last.
    pub(super) fn log_ratio(&self) -> f64 {
        let persistence = f64::from(self.plot.persistence);
        let looks = f64::from(self.plots) * (1.0 - persistence) / (1.0 + persistence);
        let noise = (1.0 / looks.max(1.0)).max(LEAST_NOISE);
        let texture = f64::from(self.plot.texture).powi(2) / self.parts();
        let standing = (self.mean_excess / (texture + noise).sqrt()).max(TAIL);
        self.motion_log_ratio + (standing / TAIL - standing.ln() - STANDING).min(MOST_OF_STANDING)
    }

    /// Squared Mahalanobis distance of a plot's place, and the determinant of its covariance.
    fn distance(&self, plot: &Plot, place: [f64; 2]) -> (f64, f64) {
        let variance = plot.variance();
        let axes = self.axes.iter().zip(place);
        axes.fold((0.0, 1.0), |(distance, determinant), (axis, position)| {
            let innovation = axis.innovation(AxisMeasurement { position, variance });
            (
                distance + innovation.normalised_squared(),
                determinant * (axis.position_variance() + variance),
            )
        })
    }

    fn may_make(&self, plot: &Plot) -> bool {
        let scales = self.plot.cell.max(plot.cell) / self.plot.cell.min(plot.cell);
        self.plot.is_brighter == plot.is_brighter && scales <= SCALES
    }

    /// Takes a plot in; `chance` is the density of plots of nothing, 1/px^2.
    fn take(
        &mut self,
        plot: Plot,
        place: [f64; 2],
        (distance, determinant): (f64, f64),
        chance: f64,
    ) {
        for (axis, position) in self.axes.iter_mut().zip(place) {
            axis.measurement_update(AxisMeasurement { position, variance: plot.variance() });
        }
        let off = [0, 1].map(|i| self.axes[i].position() - self.first[i]);
        self.gone_px = self.gone_px.max(off[0].hypot(off[1]));
        // ln N(off; 0, S) of the place against the density of plots of nothing there.
        let there = -0.5 * distance - (std::f64::consts::TAU * determinant.sqrt()).ln();
        let told = (MAKES_PLOT.ln() + there - chance.ln()).min(MOST_OF_PLOT);
        self.motion_log_ratio = (self.motion_log_ratio + told).min(
            MOST_IN_PLACE + MOST_IN_NOISE * (1.0 - f64::from(plot.persistence)) + self.parts()
                - 1.0,
        );
        self.plots += 1;
        self.mean_excess += (f64::from(plot.excess) - self.mean_excess) / f64::from(self.plots);
        self.plot = plot;
        self.unseen_s = 0.0;
    }
}

/// How many plots of nothing there are, by place.
#[derive(Debug, Default)]
struct Clutter {
    columns: usize,
    /// Plots an image, in each cell of the map.
    means: Vec<f64>,
    counts: Vec<f64>,
    /// Plots a minute that no candidate explains.
    a_minute: f64,
}

impl Clutter {
    fn cell(&self, place: ImagePoint) -> usize {
        let [x, y] = [place.x, place.y].map(|at| (at / MAP_CELL_PX).max(0.0) as usize);
        (x.min(self.columns - 1) + y * self.columns).min(self.means.len() - 1)
    }

    /// Plots of nothing at a place, 1/px^2.
    fn density(&self, place: ImagePoint) -> f64 {
        self.means[self.cell(place)] / (MAP_CELL_PX * MAP_CELL_PX)
    }

    fn fit(&mut self, [width, height]: [usize; 2]) {
        let [columns, rows] =
            [width, height].map(|side| (side as f64 / MAP_CELL_PX).ceil() as usize);
        if (self.columns, self.means.len()) != (columns, columns * rows) {
            // As long as nothing is known, one plot in an image.
            let mean = 1.0 / (columns * rows) as f64;
            *self = Self {
                columns,
                means: vec![mean; columns * rows],
                counts: Vec::new(),
                a_minute: 0.0,
            };
        }
        self.counts.clear();
        self.counts.resize(columns * rows, 0.0);
    }

    fn learn(&mut self, interval: f64) {
        let share = 1.0 - (-interval / CLUTTER_S).exp();
        for (mean, count) in self.means.iter_mut().zip(&self.counts) {
            *mean = (*mean + share * (count - *mean)).max(LEAST_CLUTTER);
        }
        let a_minute = self.counts.iter().sum::<f64>() * 60.0 / interval;
        self.a_minute += share * (a_minute - self.a_minute);
    }
}

/// All that may be targets.
#[derive(Debug, Default)]
pub(super) struct Candidates {
    /// The most likely first.
    list: Vec<Candidate>,
    clutter: Clutter,
}

impl Candidates {
    /// Plots a minute that no candidate explained: so often chance may begin a candidate.
    pub(super) fn chances_a_minute(&self) -> f64 {
        self.clutter.a_minute
    }

    /// Takes the plots of the next image. `turned` is by how much the scene has moved since the
    /// first image, px.
    pub(super) fn step(
        &mut self,
        plots: &[Plot],
        turned: [f64; 2],
        interval: f64,
        sides: [usize; 2],
    ) {
        self.clutter.fit(sides);
        let in_scene = |plot: &Plot| [plot.place.x + turned[0], plot.place.y + turned[1]];
        let gate = Gate::with_probability(IN_GATE);
        let mut is_free = vec![true; plots.len()];
        for candidate in &mut self.list {
            candidate.axes.iter_mut().for_each(|axis| axis.time_update(interval));
            let near = plots
                .iter()
                .enumerate()
                .filter(|(index, plot)| is_free[*index] && candidate.may_make(plot));
            let distances =
                near.map(|(index, plot)| (index, candidate.distance(plot, in_scene(plot))));
            let held = distances.filter(|(_, (distance, _))| gate.holds(*distance));
            match held.min_by(|(_, (one, _)), (_, (other, _))| one.total_cmp(other)) {
                Some((index, distance)) => {
                    is_free[index] = false;
                    let plot = plots[index];
                    candidate.take(
                        plot,
                        in_scene(&plot),
                        distance,
                        self.clutter.density(plot.place),
                    );
                }
                None => {
                    candidate.motion_log_ratio += (1.0 - MAKES_PLOT).ln();
                    candidate.unseen_s += interval;
                }
            }
        }
        self.list.retain(|candidate| {
            candidate.motion_log_ratio > LEAST_LOG_RATIO && candidate.unseen_s < UNSEEN_S
        });
        for (plot, _) in plots.iter().zip(is_free).filter(|(_, is_free)| *is_free) {
            let cell = self.clutter.cell(plot.place);
            self.clutter.counts[cell] += 1.0;
            self.list.push(Candidate::new(*plot, in_scene(plot)));
        }
        self.clutter.learn(interval);
        self.list.sort_by(|one, other| other.log_ratio().total_cmp(&one.log_ratio()));
        self.list.truncate(MOST);
    }

    /// Takes out what passes.
    pub(super) fn take_if(&mut self, passes: impl Fn(&Candidate) -> bool) -> Vec<Candidate> {
        self.list.extract_if(.., |candidate| passes(candidate)).collect()
    }
}
