//! Candidates: which plots of successive images belong together. This is detection after tracking
//! over a second or two, so that what does not exceed the noise in one image is found in ten.

use crossfix_filter::{AxisFilter, AxisMeasurement, Gate};

use super::LEAST_PLOTS;
use super::common_motion::MovingThing;
use super::plots::Plot;
use super::views::Views;
use crate::ImagePoint;

/// What is expected of a target and its plots.
struct TargetModel {
    /// Probability that a target makes a plot in an image. With 0.9 what blinks in noise is
    /// dropped, with 0.6 chains of noise live long.
    makes_plot: f64,
    /// Probability that a candidate's plot lies in its gate. With 0.99 one plot in a hundred misses
    /// its candidate, and begins another.
    in_gate: f64,
    /// Standard deviation of a target's velocity beforehand, px/s: one of 400 px/s is not lost by
    /// it. With half of it the gate of the second plot ends at about 220 px/s and the plots' own
    /// errors.
    velocity_sd_px: f64,
    /// Standard deviation of its white acceleration, px/s^2: a turn of 2 g at 100 m, with a lens of
    /// 1000 px per radian, and half as much again. With half of it such a turn, of 196 px/s^2,
    /// exceeds one standard deviation, and its plots count for less.
    acceleration_sd_px: f64,
    /// Largest ratio between the scales of one thing's plots: as its parts and its shadow come and
    /// go, the next scale on either side stands out more. With 5 the plots of a bird and of its
    /// flock count as one thing's.
    most_scale_ratio: f64,
}

/// The model in use; what half of each number does is said at its field.
const TARGET: TargetModel = TargetModel {
    makes_plot: 0.8,
    in_gate: 0.999,
    velocity_sd_px: 120.0,
    acceleration_sd_px: 300.0,
    most_scale_ratio: 2.5,
};

/// How much the places of a candidate's plots may count, as log likelihood ratios.
struct MotionEvidence {
    /// Most that one plot counts: an empty corner of the clutter map is not known to be empty. With
    /// half of it a target in an empty sky needs up to twice as many plots.
    most_of_plot: f64,
    /// Most that the plots of a candidate that keeps to its place count together: what comes and
    /// goes in one place, as a branch in the wind, makes as many plots as a target. With half of it
    /// there are 0.4 and 1.5 false tracks per minute (thermal, visible) instead of 1.1 and 3.1, but
    /// what a shaken camera sees in noise is found in 76 % of the images instead of 89; with twice
    /// as much there are 13 and 49.
    most_in_place: f64,
    /// This much more where noise does not last: there, what lasts is less likely to be noise. With
    /// half of it a target that keeps to its place in a sensor's noise must stand out by 2 nats
    /// more.
    more_in_noise: f64,
    /// This many of its cells further a candidate is in another place, over another part of the
    /// scene. With half of it a swing of three cells is another part already.
    cells_of_place: f64,
    /// Most such places that are counted: what jumps from branch to branch has gone far too. With
    /// half of it what goes far gains by its first 30 cells only.
    most_places: f64,
}

/// The limits in use; what half of each number does is said at its field.
const MOTION: MotionEvidence = MotionEvidence {
    most_of_plot: 4.0,
    most_in_place: 8.0,
    more_in_noise: 4.0,
    cells_of_place: 6.0,
    most_places: 10.0,
};

/// How much the strength of a candidate's plots counts.
struct StrengthEvidence {
    /// Decay length of the scene's own changes, which fall off exponentially with their size, in
    /// units of the texture: compressed video has more large ones than a normal distribution. With
    /// twice as much 89.0 % of the thermal frames have their target instead of 90.6, and there are
    /// 0.4 and 1.9 false tracks per minute.
    tail: f64,
    /// Constant of the density of a target's strength, nats: strengths from one to two hundred,
    /// uniform in their logarithm, give `ln ln 200` = 1.7; the rest is a margin, chosen on scenes
    /// without targets. With half of it chance passes for a target up to 3.5 times (`e^1.25`) as
    /// often.
    density_constant: f64,
    /// Most that the strength counts, nats. With half of it the strongest target needs two plots
    /// more, of [`MotionEvidence::most_of_plot`] each.
    most: f64,
    /// Least variance of the noise in a mean over many images, spreads^2: plots are the part of the
    /// noise that stands out. With half of it chance plots in a clear sky stand 1.4 times as high.
    least_noise: f64,
}

/// The numbers in use; what half of each does is said at its field.
const STRENGTH: StrengthEvidence =
    StrengthEvidence { tail: 1.5, density_constant: 2.5, most: 10.0, least_noise: 0.5 };

/// Which candidates are kept.
struct Kept {
    /// Log likelihood ratio by motion below which one is dropped. With half of it a new candidate
    /// is dropped at its first image without a plot (`ln 0.2` = -1.6).
    least_log_ratio: f64,
    /// One without a plot for this long, s, is dropped too. With half of it any is after 6 such
    /// images at 30 per second.
    unseen_s: f64,
    /// Most candidates, those with the greatest log likelihood ratios: as many as two images'
    /// plots. With half of it one image's chance plots fill the list, and faint targets fall off
    /// its end.
    most: usize,
}

/// The limits in use; what half of each does is said at its field.
const KEPT: Kept = Kept { least_log_ratio: -2.0, unseen_s: 0.4, most: 400 };

/// How clutter is counted, in cells of the image.
struct ClutterModel {
    /// Side of a cell, px. With half of it a cell has a quarter of the plots, and its clutter is
    /// known half as well.
    cell_px: f64,
    /// Averaging time, s: with 1 a target's own first plots make it improbable, with 10 the leaves
    /// of a gust are taken for targets.
    mean_s: f64,
    /// Least clutter of a cell, plots per image: one in ten thousand. With less, whatever comes
    /// into an empty sky is found with its second plot.
    least: f64,
}

/// The map in use; what half of each number does is said at its field.
const CLUTTER: ClutterModel = ClutterModel { cell_px: 32.0, mean_s: 3.0, least: 1e-4 };

/// A track of plots that may be a target.
///
/// Its places are in the scene: as in the image to which the background is fixed, whatever the
/// camera has turned since.
#[derive(Clone, Debug)]
pub(super) struct Candidate {
    axes: [AxisFilter; 2],
    /// The latest plot.
    pub(super) plot: Plot,
    /// Log-likelihood ratio of the places of its plots, a target's against chance.
    motion_log_ratio: f64,
    /// Mean excess of its plots, in spreads.
    mean_excess: f64,
    pub(super) plots: u32,
    unseen_s: f64,
    first: [f64; 2],
    /// Its first place in the image.
    first_in_image: ImagePoint,
    /// Largest distance that it has been from its first place, px: in the scene, ...
    pub(super) gone_px: f64,
    /// ... and in the image.
    pub(super) gone_in_image_px: f64,
}

impl Candidate {
    fn new(plot: Plot) -> Self {
        let place = plot.in_scene;
        let first = place.map(|position| AxisMeasurement { position, variance: plot.variance() });
        let TargetModel { velocity_sd_px, acceleration_sd_px, .. } = TARGET;
        Self {
            axes: first
                .map(|first| AxisFilter::start_at_rest(first, velocity_sd_px, acceleration_sd_px)),
            plot,
            motion_log_ratio: 0.0,
            mean_excess: f64::from(plot.excess),
            plots: 1,
            unseen_s: 0.0,
            first: place,
            first_in_image: plot.place,
            gone_px: 0.0,
            gone_in_image_px: 0.0,
        }
    }

    /// How it moves in the image.
    pub(super) fn moving(&self, views: &Views) -> MovingThing {
        let variance = self.axes.iter().map(|axis| axis.covariance().m22).sum::<f64>() / 2.0;
        MovingThing {
            place: self.plot.place,
            velocity: views.velocity_in_image([0, 1].map(|i| self.axes[i].velocity())),
            sd: variance.sqrt(),
        }
    }

    /// Number of parts of the scene that it has been over.
    fn parts(&self) -> f64 {
        // n = 1 + distance gone / size of a part, the second term bounded.
        1.0 + (self.gone_px / (MOTION.cells_of_place * self.plot.cell)).min(MOTION.most_places)
    }

    /// Log-likelihood ratio of a target against what the scene and the noise make.
    ///
    /// The scene's texture is independent in each of its parts; the noise is independent in each
    /// image, as far as it does not last.
    pub(super) fn log_ratio(&self) -> f64 {
        let persistence = f64::from(self.plot.persistence);
        // n images of noise with persistence p are worth n (1 - p) / (1 + p) independent ones.
        let independent = f64::from(self.plots) * (1.0 - persistence) / (1.0 + persistence);
        // Variance of the mean excess, in spreads^2: noise averages out over the independent
        // images, texture over the parts of the scene.
        let noise = (1.0 / independent.max(1.0)).max(STRENGTH.least_noise);
        let texture = f64::from(self.plot.texture).powi(2) / self.parts();
        // s / tail - ln s is least at s = tail, and would rise again below it.
        let standing = (self.mean_excess / (texture + noise).sqrt()).max(STRENGTH.tail);
        // Strength s: a density uniform in ln s against the exponential tail of the scene's
        // changes.
        self.motion_log_ratio
            + (standing / STRENGTH.tail - standing.ln() - STRENGTH.density_constant)
                .min(STRENGTH.most)
    }

    fn innovation(&self, plot: &Plot) -> PlotInnovation {
        let variance = plot.variance();
        let mut both = PlotInnovation { squared: 0.0, determinant: 1.0 };
        for (axis, position) in self.axes.iter().zip(plot.in_scene) {
            let innovation = axis.innovation(AxisMeasurement { position, variance });
            both.squared += innovation.normalised_squared();
            both.determinant *= axis.position_variance() + variance;
        }
        both
    }

    fn may_make(&self, plot: &Plot) -> bool {
        let scales = self.plot.cell.max(plot.cell) / self.plot.cell.min(plot.cell);
        self.plot.is_brighter == plot.is_brighter && scales <= TARGET.most_scale_ratio
    }

    /// Updates with a plot; `clutter` is the density of clutter there, 1/px^2.
    fn take(&mut self, plot: Plot, innovation: PlotInnovation, clutter: f64) {
        for (axis, position) in self.axes.iter_mut().zip(plot.in_scene) {
            axis.measurement_update(AxisMeasurement { position, variance: plot.variance() });
        }
        let off = [0, 1].map(|i| self.axes[i].position() - self.first[i]);
        self.gone_px = self.gone_px.max(off[0].hypot(off[1]));
        let ImagePoint { x, y } = self.first_in_image;
        let in_image = [plot.place.x - x, plot.place.y - y];
        self.gone_in_image_px = self.gone_in_image_px.max(in_image[0].hypot(in_image[1]));
        // ln (P_D N(innovation; 0, S) / clutter), with P_D the probability of a plot.
        let PlotInnovation { squared, determinant } = innovation;
        let there = -0.5 * squared - (std::f64::consts::TAU * determinant.sqrt()).ln();
        let log_ratio = (TARGET.makes_plot.ln() + there - clutter.ln()).min(MOTION.most_of_plot);
        // The bound grows by 1 with each further part of the scene, and is higher where noise does
        // not last.
        self.motion_log_ratio = (self.motion_log_ratio + log_ratio).min(
            MOTION.most_in_place
                + MOTION.more_in_noise * (1.0 - f64::from(plot.persistence))
                + self.parts()
                - 1.0,
        );
        self.plots += 1;
        // Running mean: m_n = m_(n-1) + (e - m_(n-1)) / n.
        self.mean_excess += (f64::from(plot.excess) - self.mean_excess) / f64::from(self.plots);
        self.plot = plot;
        self.unseen_s = 0.0;
    }
}

/// Innovation of a plot's place on both axes.
#[derive(Clone, Copy, Debug)]
struct PlotInnovation {
    /// Squared Mahalanobis distance.
    squared: f64,
    /// Determinant of the innovation's covariance, px^4.
    determinant: f64,
}

/// Map of clutter: plots that no candidate explains.
#[derive(Debug, Default)]
struct Clutter {
    columns: usize,
    /// Mean number of such plots per image, in each cell of the map.
    means: Vec<f64>,
    counts: Vec<f64>,
    /// Rate of such plots, 1/min.
    per_minute: f64,
}

impl Clutter {
    fn cell(&self, place: ImagePoint) -> usize {
        let [x, y] = [place.x, place.y].map(|at| (at / CLUTTER.cell_px).max(0.0) as usize);
        (x.min(self.columns - 1) + y * self.columns).min(self.means.len() - 1)
    }

    /// Density of clutter at a place, 1/px^2.
    fn density(&self, place: ImagePoint) -> f64 {
        self.means[self.cell(place)] / (CLUTTER.cell_px * CLUTTER.cell_px)
    }

    fn fit(&mut self, [width, height]: [usize; 2]) {
        let [columns, rows] =
            [width, height].map(|side| (side as f64 / CLUTTER.cell_px).ceil() as usize);
        if (self.columns, self.means.len()) != (columns, columns * rows) {
            // As long as nothing is known, one plot per image over the whole map.
            let mean = 1.0 / (columns * rows) as f64;
            *self = Self {
                columns,
                means: vec![mean; columns * rows],
                counts: Vec::new(),
                per_minute: 0.0,
            };
        }
        self.counts.clear();
        self.counts.resize(columns * rows, 0.0);
    }

    fn learn(&mut self, interval: f64) {
        let share = 1.0 - (-interval / CLUTTER.mean_s).exp();
        for (mean, count) in self.means.iter_mut().zip(&self.counts) {
            *mean = (*mean + share * (count - *mean)).max(CLUTTER.least);
        }
        let per_minute = self.counts.iter().sum::<f64>() * 60.0 / interval;
        self.per_minute += share * (per_minute - self.per_minute);
    }
}

/// All candidates, and the clutter.
#[derive(Debug, Default)]
pub(super) struct Candidates {
    /// The most likely first.
    list: Vec<Candidate>,
    clutter: Clutter,
}

impl Candidates {
    /// Rate of plots that no candidate explained, 1/min: how often chance may begin a candidate.
    pub(super) fn chances_per_minute(&self) -> f64 {
        self.clutter.per_minute
    }

    /// Associates the plots of the next image: each candidate takes the nearest free plot in its
    /// gate, and the plots that are left begin candidates and count as clutter.
    pub(super) fn step(&mut self, plots: &[Plot], interval: f64, sides: [usize; 2]) {
        self.clutter.fit(sides);
        let gate = Gate::with_probability(TARGET.in_gate);
        let mut is_free = vec![true; plots.len()];
        // The likeliest candidates choose first: the list is sorted.
        for candidate in &mut self.list {
            candidate.axes.iter_mut().for_each(|axis| axis.time_update(interval));
            let near = plots
                .iter()
                .enumerate()
                .filter(|(index, plot)| is_free[*index] && candidate.may_make(plot));
            let innovations = near.map(|(index, plot)| (index, candidate.innovation(plot)));
            let in_gate = innovations.filter(|(_, innovation)| gate.holds(innovation.squared));
            match in_gate.min_by(|(_, one), (_, other)| one.squared.total_cmp(&other.squared)) {
                Some((index, innovation)) => {
                    is_free[index] = false;
                    let plot = plots[index];
                    let clutter = self.clutter.density(plot.place);
                    candidate.take(plot, innovation, clutter);
                }
                None => {
                    // ln (1 - P_D).
                    candidate.motion_log_ratio += (1.0 - TARGET.makes_plot).ln();
                    candidate.unseen_s += interval;
                }
            }
        }
        self.list.retain(|candidate| {
            candidate.motion_log_ratio > KEPT.least_log_ratio && candidate.unseen_s < KEPT.unseen_s
        });
        for (plot, _) in plots.iter().zip(is_free).filter(|(_, is_free)| *is_free) {
            let cell = self.clutter.cell(plot.place);
            self.clutter.counts[cell] += 1.0;
            self.list.push(Candidate::new(*plot));
        }
        self.clutter.learn(interval);
        self.list.sort_by(|one, other| other.log_ratio().total_cmp(&one.log_ratio()));
        self.list.truncate(KEPT.most);
    }

    /// Those that are likelier targets than chance, and have plots enough to be found.
    pub(super) fn likely(&self) -> impl Iterator<Item = &Candidate> {
        self.list
            .iter()
            .filter(|candidate| candidate.plots >= LEAST_PLOTS && candidate.log_ratio() > 0.0)
    }

    /// Lets the distance of those of which a condition is true count from where they are.
    pub(super) fn restart_distance_if(&mut self, is_meant: impl Fn(&Candidate) -> bool) {
        for candidate in self.list.iter_mut().filter(|candidate| is_meant(candidate)) {
            candidate.first = [0, 1].map(|i| candidate.axes[i].position());
            candidate.first_in_image = candidate.plot.place;
            (candidate.gone_px, candidate.gone_in_image_px) = (0.0, 0.0);
        }
    }

    /// Forgets all candidates, and keeps what is known of chance.
    pub(super) fn clear(&mut self) {
        self.list.clear();
    }

    /// Removes the candidates of which a condition is true, and returns them.
    pub(super) fn take_if(&mut self, is_wanted: impl Fn(&Candidate) -> bool) -> Vec<Candidate> {
        self.list.extract_if(.., |candidate| is_wanted(candidate)).collect()
    }
}
