//! The gate: the part of an image in which a target is looked for, and the posterior over the
//! placements of its reference there.

use std::ops::Range;

use crossfix_correlation::Plane;
use crossfix_filter::Gate;

use crate::background_energy::BackgroundEnergy;
use crate::config::GateRule;
use crate::crop::{crop, paint_over};
use crate::frame::FrameInput;
use crate::lanes;
use crate::likelihood::log_ratios;
use crate::motion::ImageMotion;
use crate::posterior::{PlacePrior, Posterior};
use crate::scratch::Scratch;
use crate::state::TargetBelief;
use crate::tracker_part::TrackerPart;
use crate::{PixelBox, TrackerConfig};

/// Correlation time of being hidden, s: about how long a target stays hidden once it is. A blur is
/// shorter, a cloud longer. When it was chosen, of ten seeds' sequences 3.8 % of the frames were
/// lost with half of it instead of 1.7, and with twice as much, a version earlier, 2.7 instead of
/// 2.2.
const HIDDEN_S: f64 = 0.05;
/// Log likelihood ratio of a placement outside the image. With half of it the same: `e^-25` of a
/// weight is none.
const IMPOSSIBLE: f32 = -50.0;

/// Placements of a reference about the prediction, and the part of the image that they cover.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Region {
    /// Number of placements on either side of the middle one.
    pub(crate) half: [usize; 2],
    /// Place of the first placement's middle in the image, px.
    pub(crate) origin: [f64; 2],
    /// First column and row of the part, and its sides, px.
    pub(crate) corner: [isize; 2],
    pub(crate) sides: [usize; 2],
}

impl Region {
    pub(crate) fn about(state: &TargetBelief, half: [usize; 2]) -> Self {
        let expected = state.motion.found();
        let reference = state.appearance.working.image();
        let reference = [reference.width(), reference.height()];
        // The reference's sides are odd: the middle of a placement is (side - 1) / 2 from its
        // corner.
        let origin = [0, 1].map(|i| expected[i].position.round() - half[i] as f64);
        let corner = [0, 1].map(|i| origin[i] as isize - (reference[i] as isize - 1) / 2);
        Self { half, origin, corner, sides: [0, 1].map(|i| 2 * half[i] + reference[i]) }
    }

    /// The part of the image in which another target's box or its blurred edge changes what is
    /// covered.
    fn affected(&self) -> PixelBox {
        let [x, y] = self.corner.map(|at| at as f64 - EDGE_PX);
        let [width, height] = self.sides.map(|side| side as f64 + 2.0 * EDGE_PX);
        PixelBox { x, y, width, height }
    }
}

impl GateRule {
    /// Standard deviations of the innovation that a gate must reach beyond its middle.
    fn sigmas(self) -> f64 {
        match self {
            Self::ThreeSided => 0.0,
            Self::Innovation { sigmas } => sigmas,
            Self::Ellipsoid { probability } => {
                Gate::with_probability(probability).threshold().sqrt()
            }
        }
    }
}

impl TargetBelief {
    /// Half sides of the gate (Herasymenko 2021, section 1; Lytvynets 2020, eq. 5.12): how far from
    /// the prediction the reference is placed.
    pub(crate) fn half_gate(&self, image: &Plane, config: &TrackerConfig) -> [usize; 2] {
        let reference = self.appearance.working.image();
        let expected = self.motion.found();
        let sides = [(reference.width(), image.width()), (reference.height(), image.height())];
        let sigmas = config.gate.sigmas();
        [0, 1].map(|i| {
            let (side, most) = sides[i];
            let spread = (sigmas * expected[i].variance.sqrt()).ceil();
            (side as f64).max(spread).min(most as f64) as usize
        })
    }

    /// Share of the prior that is uniform over the gate: it doubles with every image without the
    /// target, to a half at most.
    pub(crate) fn anywhere(&self, config: &TrackerConfig) -> f64 {
        (config.anywhere_share * f64::from(2_u32.saturating_pow(self.missed))).min(0.5)
    }

    /// Half sides of the neighbourhood that counts as one peak of the map of placements.
    pub(crate) fn peak_half(&self) -> [usize; 2] {
        let reference = self.appearance.working.image();
        [reference.width(), reference.height()].map(|side| (side / 8).max(2))
    }

    /// Half sides of the middle part of a gate: the prediction's spread, a peak about it, and as
    /// much again that is no peak. `None` where that is not much smaller than the gate, or the
    /// papers' gate is asked for.
    pub(crate) fn middle_of_gate(
        &self,
        whole: [usize; 2],
        config: &TrackerConfig,
    ) -> Option<[usize; 2]> {
        let GateRule::Innovation { sigmas } = config.gate else { return None };
        let (peak, expected) = (self.peak_half(), self.motion.found());
        let half = [0, 1].map(|i| {
            let spread = (sigmas * expected[i].variance.sqrt()).ceil() as usize;
            // What lies beyond twice the peak's half side is the posterior's background: some of it
            // must be left about a peak at the edge of the spread.
            (spread + 3 * peak[i]).min(whole[i])
        });
        // A middle of more than two thirds of the gate would spare too little if the rest is needed
        // too.
        (3 * half[0] * half[1] < 2 * whole[0] * whole[1]).then_some(half)
    }

    /// Prior of the place by the given filters, on the placements of a region; `hidden` is the
    /// probability that the target was hidden in the image before.
    pub(crate) fn prior(
        &self,
        motion: &ImageMotion,
        hidden: f64,
        region: Region,
        frame: FrameInput<'_>,
    ) -> PlacePrior {
        let config = frame.config;
        let expected = motion.found();
        let stays_hidden = (-frame.interval / HIDDEN_S).exp();
        // A chain of two states, whose share of visible images in the long run is the configured
        // one.
        let often = config.visible_probability;
        // v+ = v_inf + (v - v_inf) exp(-T / tau), with v = 1 - hidden.
        let visible = often + (1.0 - hidden - often) * stays_hidden;
        PlacePrior {
            centre: [0, 1].map(|i| expected[i].position - region.origin[i]),
            variance: [0, 1].map(|i| expected[i].variance + config.prediction_floor_px.powi(2)),
            anywhere: self.anywhere(config),
            visible,
            near: self.peak_half(),
        }
    }

    /// The posterior over the placements in a region. Leaves the region's image in `scratch.gate`
    /// and the log likelihood ratios in `scratch.ratios`.
    pub(crate) fn posterior(
        &self,
        frame: FrameInput<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) -> Posterior {
        let FrameInput { image, config, .. } = frame;
        let Region { origin, corner, sides, .. } = region;
        crop(image, corner, sides, &mut scratch.gate);
        for other in frame.others.iter() {
            hide(&mut scratch.gate, corner, &other);
        }
        scratch.correlator.statistics(
            &scratch.gate,
            &self.appearance.working,
            &mut scratch.statistics,
        );
        let expected = self.expectation(
            self.noise,
            self.appearance.energy(),
            self.appearance.pixels(),
            config,
        );
        log_ratios(&scratch.statistics, expected, &mut scratch.ratios);
        mask_outside(&mut scratch.ratios, origin, image);
        let prior = self.prior(&self.motion, self.hidden, region, frame);
        scratch.map.of(&scratch.ratios, &prior)
    }

    /// The posterior over the whole gate, whose log likelihood ratios are left in `scratch.ratios`.
    /// Where the likeness to the reference leaves it unsure, the background's energy counts too.
    pub(crate) fn posterior_of_gate(
        &self,
        frame: FrameInput<'_>,
        gate: Region,
        scratch: &mut Scratch,
    ) -> Posterior {
        let posterior = self.posterior(frame, gate, scratch);
        // Not where another target is in the gate: its blurred edge beside what is painted over is
        // neither background nor this target. In dense swarms it cost 55 numbers of 244 crossings
        // instead of 50.
        let is_alone = !frame.others.any_overlaps(&gate.affected());
        if posterior.is_sure() || !is_alone || !frame.config.has(TrackerPart::BackgroundEnergy) {
            return posterior;
        }
        self.weigh_background(frame, gate, scratch);
        let prior = self.prior(&self.motion, self.hidden, gate, frame);
        scratch.map.of(&scratch.ratios, &prior)
    }

    /// Takes from the log likelihood ratios the logarithm of the probability that background has
    /// the energy there; what lies beside the likeliest placement shows how much it has.
    fn weigh_background(&self, frame: FrameInput<'_>, gate: Region, scratch: &mut Scratch) {
        let Scratch { statistics, ratios, .. } = scratch;
        let greatest = lanes::greatest(ratios.samples());
        let Some(best) = ratios.samples().iter().position(|ratio| *ratio == greatest) else {
            return;
        };
        let best = [best % ratios.width(), best / ratios.width()];
        let reference = self.appearance.working.image();
        let sides = [reference.width(), reference.height()];
        let image = frame.sides();
        let is_inside =
            |at: [usize; 2]| (0..2).all(|i| is_inside(gate.origin[i] + at[i] as f64, image[i]));
        let variances = &statistics.variance;
        if let Some(background) =
            BackgroundEnergy::beside(best, sides, self.noise, variances, is_inside)
        {
            background.weigh(statistics, ratios);
        }
    }
}

/// How far another target's blurred edge reaches beyond its box, px. With half of it that edge is
/// left about what is painted over, and may be taken for a target.
const EDGE_PX: f64 = 1.0;

/// Paints over another target's box in a part of an image that begins at `corner`: what is there is
/// not this target's. Of two that cross the first is not seen, and coasts on its velocity until
/// they are apart; the other goes on.
fn hide(part: &mut Plane, corner: [isize; 2], other: &PixelBox) {
    let columns = covered(other.x, other.width, corner[0], part.width());
    let rows = covered(other.y, other.height, corner[1], part.height());
    paint_over(part, &columns, rows);
}

/// The columns (or rows) of a part of an image that a box from `at` covers with its blurred edge;
/// the part begins at `corner` and has `all` of them.
fn covered(at: f64, side: f64, corner: isize, all: usize) -> Range<usize> {
    let [first, end] = [at - EDGE_PX, at + side + EDGE_PX]
        .map(|edge| (edge.round() as isize).saturating_sub(corner).clamp(0, all as isize) as usize);
    first..end
}

/// Whether a place along an axis lies inside an image with this side.
fn is_inside(at: f64, side: usize) -> bool {
    (0.0..=side as f64 - 1.0).contains(&at)
}

/// Makes placements impossible whose middle lies outside the image.
fn mask_outside(ratios: &mut Plane, origin: [f64; 2], image: &Plane) {
    let (width, height) = (ratios.width(), ratios.height());
    let whole = is_inside(origin[0], image.width())
        && is_inside(origin[1], image.height())
        && is_inside(origin[0] + width as f64 - 1.0, image.width())
        && is_inside(origin[1] + height as f64 - 1.0, image.height());
    if whole {
        return;
    }
    for row in 0..height {
        let row_inside = is_inside(origin[1] + row as f64, image.height());
        for (column, ratio) in ratios.row_mut(row).iter_mut().enumerate() {
            if !row_inside || !is_inside(origin[0] + column as f64, image.width()) {
                *ratio = IMPOSSIBLE;
            }
        }
    }
}
