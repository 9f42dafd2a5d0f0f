//! Multiple hypotheses of where a target is, each with filters of its own, as long as no place is
//! sure.
//!
//! One Gaussian cannot represent two places: its mean is neither of them, and in the next image
//! both lie outside of what it predicts.

use crossfix_filter::AxisMeasurement;

use crate::ImagePoint;
use crate::frame::FrameInput;
use crate::gate::Region;
use crate::motion::ImageMotion;
use crate::posterior::Posterior;
use crate::scratch::Scratch;
use crate::state::TargetBelief;

/// Certainty of the best place below which the other places are kept too. With 0.8 another place is
/// dropped that is right up to once in five times; with 0.95 more images cost several posteriors.
/// With half of it the other places are never kept, as the best one mostly has more.
pub(crate) const ONE_PLACE: f64 = 0.9;
/// Most hypotheses that are kept. With half of it the right one of several like places is dropped
/// sooner; each that is kept costs a posterior per image.
const MOST: usize = 12;
/// Most places in an image that each hypothesis may go to. With half of it the third of several
/// like places, which may be the right one, is dropped at once.
const MOST_PEAKS: usize = 4;
/// A place with less than this share of its hypothesis is dropped, and a hypothesis of less weight
/// than this. With half of it more are kept, at the cost of a posterior each; with twice as much
/// one is dropped that is right once in fifty times.
const LEAST: f64 = 0.01;
/// Hypotheses are merged if their places and velocities differ by less than this many standard
/// deviations. With half of it hypotheses of one place stay apart, and fill the list.
const SAME: f64 = 2.0;
/// Squared normalised innovation beyond which a place does not fit a hypothesis' motion: its
/// filters are restarted there. With half of it one right place in 55 loses its velocity, instead
/// of one in 3000.
const UNEXPECTED: f64 = 16.0;
/// A target counts as lost when no place has been sure for this long, s. With half of it doubts of
/// a fifth of a second are shown as losses.
const LOST_S: f64 = 0.4;
/// A target is searched for when no place has been sure for this long, s: as a cloud passes it is
/// fainter than noise for a second. With a fifth of it 2.9 % of the frames of nine seeds' sequences
/// are lost instead of 2.3, with twice as much 2.4.
const LONGEST_S: f64 = 2.0;

/// A place where the target may be, with the filters of its motion.
#[derive(Clone, Debug)]
pub(crate) struct PlaceHypothesis {
    pub(crate) weight: f64,
    pub(crate) motion: ImageMotion,
    /// Probability that the target was hidden in the image before.
    pub(crate) hidden: f64,
    /// The placement of the map on which it has been seen in this image; `None` if it was not seen.
    pub(crate) peak: Option<[usize; 2]>,
}

impl PlaceHypothesis {
    /// The hypothesis of a target that has had only one place so far.
    fn of(state: &TargetBelief) -> Self {
        Self { weight: 1.0, motion: state.motion.clone(), hidden: state.hidden, peak: None }
    }

    fn at(&self) -> [f64; 2] {
        let ImagePoint { x, y } = self.motion.position();
        [x, y]
    }

    /// Whether it has been seen in this image near a placement.
    fn is_seen_near(&self, [column, row]: [usize; 2], near: [usize; 2]) -> bool {
        self.peak.is_some_and(|[x, y]| x.abs_diff(column) <= near[0] && y.abs_diff(row) <= near[1])
    }

    /// Whether two hypotheses agree in place and velocity. One that has been seen and one that has
    /// only been predicted do not.
    fn is_like(&self, other: &Self) -> bool {
        let (here, there) = (self.motion.found(), other.motion.found());
        let (one, two) = (self.motion.velocity(), other.motion.velocity());
        let (a, b) = (self.motion.covariances(), other.motion.covariances());
        let near = |off: f64, variance: f64| off.abs() < SAME * variance.sqrt();
        // |x1 - x2| < 2 max(s1, s2) on both axes, in place and in velocity.
        let faster = [one.x - two.x, one.y - two.y];
        let agree = (0..2).all(|i| {
            near(here[i].position - there[i].position, here[i].variance.max(there[i].variance))
                && near(faster[i], a[i].m22.max(b[i].m22))
        });
        agree && self.peak.is_some() == other.peak.is_some()
    }
}

/// The hypotheses of a target; empty while its place is sure.
#[derive(Clone, Debug, Default)]
pub(crate) struct PlaceHypotheses {
    all: Vec<PlaceHypothesis>,
    /// How long no place has been sure, s.
    unsure_s: f64,
}

impl PlaceHypotheses {
    pub(crate) fn clear(&mut self) {
        self.all.clear();
        self.unsure_s = 0.0;
    }

    /// Counts one more image in which no place was sure.
    pub(crate) fn note_unsure(&mut self, interval: f64) {
        self.unsure_s += interval;
    }

    /// Whether no place has been sure for too long, so that the target must be searched for.
    pub(crate) fn are_hopeless(&self) -> bool {
        self.unsure_s > LONGEST_S
    }

    /// Whether no place has been sure for long enough that the target counts as lost.
    pub(crate) fn are_lost(&self) -> bool {
        self.unsure_s > LOST_S
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    pub(crate) fn predict(&mut self, frame: FrameInput<'_>) {
        for hypothesis in &mut self.all {
            hypothesis.motion.predict(frame.interval, frame.sides());
        }
    }

    /// Starts with the target's present state as the only hypothesis, unless there are some
    /// already.
    pub(crate) fn begin(&mut self, state: &TargetBelief) {
        if self.all.is_empty() {
            self.all.push(PlaceHypothesis::of(state));
        }
    }

    /// Splits each hypothesis into two of half its weight: moved by `by`, px per axis, and not
    /// moved.
    pub(crate) fn fork(&mut self, by: [f64; 2]) {
        self.all.iter_mut().for_each(|hypothesis| hypothesis.weight *= 0.5);
        let mut moved = self.all.clone();
        moved.iter_mut().for_each(|hypothesis| hypothesis.motion.move_by(by));
        self.all.extend(moved);
    }

    /// Mean squared distance of the hypotheses from a place, px^2 per axis: what the likeliest
    /// one's own variance lacks.
    pub(crate) fn spread(&self, place: ImagePoint) -> [f64; 2] {
        let at = [place.x, place.y];
        [0, 1].map(|i| {
            let off = |h: &PlaceHypothesis| h.weight * (h.at()[i] - at[i]).powi(2);
            self.all.iter().map(off).sum()
        })
    }

    /// Largest distance of a hypothesis from a place, px per axis.
    pub(crate) fn reach(&self, place: ImagePoint) -> [f64; 2] {
        let at = [place.x, place.y];
        [0, 1].map(|i| {
            let far = |hypothesis: &PlaceHypothesis| (hypothesis.at()[i] - at[i]).abs();
            self.all.iter().map(far).fold(0.0, f64::max)
        })
    }

    /// The likeliest hypothesis.
    pub(crate) fn best(&self) -> Option<&PlaceHypothesis> {
        self.all.first()
    }

    /// Total weight of the hypotheses that have been seen in this image.
    pub(crate) fn seen_share(&self) -> f64 {
        self.all.iter().filter(|h| h.peak.is_some()).map(|h| h.weight).sum()
    }

    /// Total weight of the hypotheses that have been seen near a placement in this image.
    pub(crate) fn share_near(&self, placement: [usize; 2], near: [usize; 2]) -> f64 {
        self.all.iter().filter(|h| h.is_seen_near(placement, near)).map(|h| h.weight).sum()
    }

    /// Advances every hypothesis into the image whose log likelihood ratios are in
    /// `scratch.ratios`.
    pub(crate) fn advance(
        &mut self,
        state: &TargetBelief,
        frame: FrameInput<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) {
        self.all = kept(self.branches(state, frame, region, scratch));
    }

    /// Motion of the likeliest hypothesis and the posterior that it leads to, if nearly all of the
    /// weight leads to that one place.
    pub(crate) fn one_place(
        &self,
        state: &TargetBelief,
        frame: FrameInput<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) -> Option<(ImageMotion, Posterior)> {
        // Joint posterior of hypothesis and place: w_h times the evidence times the mass near the
        // peak.
        let near = state.peak_half();
        let mut ways: Vec<(f64, usize, Posterior)> = Vec::with_capacity(self.all.len());
        let mut all = 0.0;
        for (index, hypothesis) in self.all.iter().enumerate() {
            let posterior = scratch.map.of(
                &scratch.ratios,
                &state.prior(&hypothesis.motion, hypothesis.hidden, region, frame),
            );
            all += hypothesis.weight * posterior.evidence;
            ways.push((
                hypothesis.weight * posterior.evidence * posterior.near.mass,
                index,
                posterior,
            ));
        }
        let (_, best, posterior) = *ways.iter().max_by(|one, other| one.0.total_cmp(&other.0))?;
        let here =
            |peak: [usize; 2]| (0..2).all(|i| peak[i].abs_diff(posterior.peak[i]) <= near[i]);
        let there: f64 =
            ways.iter().filter(|(.., way)| here(way.peak)).map(|(mass, ..)| mass).sum();
        // Several hypotheses may lead to one place: their masses there count together.
        (there > ONE_PLACE * all).then(|| (self.all[best].motion.clone(), posterior))
    }

    /// The successors of all hypotheses, with their weights: for each hypothesis one that is not
    /// seen, and one per peak of its posterior.
    fn branches(
        &self,
        state: &TargetBelief,
        frame: FrameInput<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) -> Vec<PlaceHypothesis> {
        let config = frame.config;
        let mut branches = Vec::with_capacity(self.all.len() * (MOST_PEAKS + 1));
        for hypothesis in &self.all {
            let prior = state.prior(&hypothesis.motion, hypothesis.hidden, region, frame);
            let posterior = scratch.map.of(&scratch.ratios, &prior);
            // Bayes' rule: the prior weight times the likelihood of the image.
            let weight = hypothesis.weight * posterior.evidence;
            branches.push(PlaceHypothesis {
                weight: weight * posterior.unseen,
                // Not seen: the prediction stays as it is.
                motion: hypothesis.motion.clone(),
                hidden: 1.0,
                peak: None,
            });
            for _ in 0..MOST_PEAKS {
                let (peak, part) = scratch.map.take_peak(prior.near);
                let share = part.mass / posterior.evidence;
                if share.is_nan() || share < LEAST {
                    break;
                }
                let mut motion = hypothesis.motion.clone();
                let expected = motion.found();
                let at = part.in_image(region.origin);
                if motion.nis(at) < UNEXPECTED {
                    // The peak's moments have the prior in them already, so they replace the
                    // prediction.
                    motion.condition([0, 1].map(|i| AxisMeasurement {
                        variance: at[i].variance.min(expected[i].variance),
                        ..at[i]
                    }));
                } else {
                    motion.restart(at, config.search_velocity_sd_px);
                }
                branches.push(PlaceHypothesis {
                    weight: weight * share,
                    motion,
                    hidden: 0.0,
                    peak: Some(peak),
                });
            }
        }
        branches
    }
}

/// Merges and prunes hypotheses: the heaviest first, with weights that sum to 1 before those below
/// `LEAST` are dropped.
fn kept(mut all: Vec<PlaceHypothesis>) -> Vec<PlaceHypothesis> {
    all.sort_by(|one, other| other.weight.total_cmp(&one.weight));
    let mut kept: Vec<PlaceHypothesis> = Vec::with_capacity(MOST);
    for hypothesis in all {
        let known = kept.iter().position(|known| known.is_like(&hypothesis));
        match known {
            Some(known) => kept[known].weight += hypothesis.weight,
            None if kept.len() < MOST => kept.push(hypothesis),
            None => {}
        }
    }
    // All weights zero, or one not a number: no hypothesis is left to be believed.
    let total: f64 = kept.iter().map(|hypothesis| hypothesis.weight).sum();
    if total.is_nan() || total <= 0.0 {
        return Vec::new();
    }
    kept.iter_mut().for_each(|hypothesis| hypothesis.weight /= total);
    kept.retain(|hypothesis| hypothesis.weight >= LEAST);
    kept.sort_by(|one, other| other.weight.total_cmp(&one.weight));
    kept
}
