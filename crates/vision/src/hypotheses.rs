//! Several places where a target may be, each with filters of its own, as long as none of them is
//! sure.
//!
//! One Gaussian cannot hold two places: their mean is neither, and in the next image both lie
//! outside of what it expects.

use crossfix_filter::AxisMeasurement;

use crate::ImagePoint;
use crate::frame::Frame;
use crate::gate::Region;
use crate::motion::Motion;
use crate::posterior::Posterior;
use crate::scratch::Scratch;
use crate::state::State;

/// Certainty of the best place below which the others are kept too.
pub(crate) const DOUBT: f64 = 0.9;
/// Hypotheses that are kept, and places in an image that each of them may go to.
const MOST: usize = 12;
const MOST_PEAKS: usize = 4;
/// A place with less of a hypothesis, and a hypothesis with less of the target, is dropped.
const LEAST: f64 = 0.01;
/// Hypotheses are one if their places and velocities differ by less than so many standard
/// deviations.
const SAME: f64 = 2.0;
/// Squared Mahalanobis distance beyond which a place does not belong to a hypothesis' motion: the
/// target has been elsewhere.
const UNEXPECTED: f64 = 16.0;
/// A target of which this long no place is sure counts as lost, s, ...
const LOST_S: f64 = 0.4;
/// ... and is searched for after so long, s: it is fainter than noise for a second as a cloud
/// passes. With a fifth of it 2.9 % of the frames of nine seeds' sequences are lost in place of
/// 2.3, with twice as much 2.4.
const LONGEST_S: f64 = 2.0;

/// A place where the target may be, and how it moves then.
#[derive(Clone, Debug)]
pub(crate) struct Hypothesis {
    pub(crate) weight: f64,
    pub(crate) motion: Motion,
    /// How likely it could not be seen in the image before.
    pub(crate) hidden: f64,
    /// Whether it has been seen there in this image, and on which placement of the map.
    pub(crate) peak: Option<[usize; 2]>,
}

impl Hypothesis {
    /// Where it is believed to be, as long as that is one place.
    fn of(state: &State) -> Self {
        Self { weight: 1.0, motion: state.motion.clone(), hidden: state.hidden, peak: None }
    }

    fn at(&self) -> [f64; 2] {
        let ImagePoint { x, y } = self.motion.position();
        [x, y]
    }

    /// Whether two say the same; where it has been seen and where it has been waited for are not
    /// the same.
    fn is_like(&self, other: &Self) -> bool {
        let (here, there) = (self.motion.found(), other.motion.found());
        let (one, two) = (self.motion.velocity(), other.motion.velocity());
        let (a, b) = (self.motion.covariances(), other.motion.covariances());
        let near = |off: f64, variance: f64| off.abs() < SAME * variance.sqrt();
        let faster = [one.x - two.x, one.y - two.y];
        let alike = (0..2).all(|i| {
            near(here[i].position - there[i].position, here[i].variance.max(there[i].variance))
                && near(faster[i], a[i].m22.max(b[i].m22))
        });
        alike && self.peak.is_some() == other.peak.is_some()
    }
}

/// The hypotheses of a target; none while it is sure.
#[derive(Clone, Debug, Default)]
pub(crate) struct Hypotheses {
    all: Vec<Hypothesis>,
    /// For how long none has been sure, s.
    doubted_s: f64,
}

impl Hypotheses {
    pub(crate) fn clear(&mut self) {
        self.all.clear();
        self.doubted_s = 0.0;
    }

    /// None has been sure in one more image.
    pub(crate) fn note_doubt(&mut self, interval: f64) {
        self.doubted_s += interval;
    }

    /// Whether no place has been sure for so long that it must be searched for.
    pub(crate) fn are_hopeless(&self) -> bool {
        self.doubted_s > LONGEST_S
    }

    /// Whether for long no place has been sure.
    pub(crate) fn are_doubted(&self) -> bool {
        self.doubted_s > LOST_S
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    pub(crate) fn predict(&mut self, frame: Frame<'_>) {
        for hypothesis in &mut self.all {
            hypothesis.motion.predict(frame.interval, frame.sides());
        }
    }

    /// They begin with what is believed, unless there are some.
    pub(crate) fn begin(&mut self, state: &State) {
        if self.all.is_empty() {
            self.all.push(Hypothesis::of(state));
        }
    }

    /// Each may have moved by so many pixels, or not.
    pub(crate) fn fork(&mut self, by: [f64; 2]) {
        self.all.iter_mut().for_each(|hypothesis| hypothesis.weight *= 0.5);
        let mut moved = self.all.clone();
        moved.iter_mut().for_each(|hypothesis| hypothesis.motion.move_by(by));
        self.all.extend(moved);
    }

    /// How far they are from a place, mean squares of either axis, px^2: what its variance does not
    /// hold.
    pub(crate) fn spread(&self, place: ImagePoint) -> [f64; 2] {
        let at = [place.x, place.y];
        [0, 1].map(|i| {
            let off = |h: &Hypothesis| h.weight * (h.at()[i] - at[i]).powi(2);
            self.all.iter().map(off).sum()
        })
    }

    /// The furthest of them from a place, px per axis.
    pub(crate) fn reach(&self, place: ImagePoint) -> [f64; 2] {
        let at = [place.x, place.y];
        [0, 1].map(|i| {
            let far = |hypothesis: &Hypothesis| (hypothesis.at()[i] - at[i]).abs();
            self.all.iter().map(far).fold(0.0, f64::max)
        })
    }

    /// The likeliest.
    pub(crate) fn best(&self) -> Option<&Hypothesis> {
        self.all.first()
    }

    /// The share of those that have been seen in this image.
    pub(crate) fn seen_share(&self) -> f64 {
        self.all.iter().filter(|h| h.peak.is_some()).map(|h| h.weight).sum()
    }

    /// The share of those that have been seen about a placement.
    pub(crate) fn share_near(&self, [column, row]: [usize; 2], near: [usize; 2]) -> f64 {
        let here = |h: &&Hypothesis| {
            h.peak.is_some_and(|[x, y]| x.abs_diff(column) <= near[0] && y.abs_diff(row) <= near[1])
        };
        self.all.iter().filter(here).map(|h| h.weight).sum()
    }

    /// Follows each into the image whose log ratios are in the scratch's map.
    pub(crate) fn advance(
        &mut self,
        state: &State,
        frame: Frame<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) {
        self.all = kept(self.branches(state, frame, region, scratch));
    }

    /// The likeliest of the hypotheses, with the posterior that it leads to, if all of them lead to
    /// one place.
    pub(crate) fn one_place(
        &self,
        state: &State,
        frame: Frame<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) -> Option<(Motion, Posterior)> {
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
        (there > DOUBT * all).then(|| (self.all[best].motion.clone(), posterior))
    }

    /// Where each hypothesis may have gone, with their weights.
    fn branches(
        &self,
        state: &State,
        frame: Frame<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) -> Vec<Hypothesis> {
        let config = frame.config;
        let mut branches = Vec::with_capacity(self.all.len() * (MOST_PEAKS + 1));
        for hypothesis in &self.all {
            let prior = state.prior(&hypothesis.motion, hypothesis.hidden, region, frame);
            let posterior = scratch.map.of(&scratch.ratios, &prior);
            let weight = hypothesis.weight * posterior.evidence;
            branches.push(Hypothesis {
                weight: weight * posterior.unseen,
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
                let at = [0, 1].map(|i| AxisMeasurement {
                    position: region.origin[i] + part.mean[i],
                    variance: part.variance[i],
                });
                if motion.surprise(at) < UNEXPECTED {
                    motion.condition([0, 1].map(|i| AxisMeasurement {
                        variance: at[i].variance.min(expected[i].variance),
                        ..at[i]
                    }));
                } else {
                    motion.restart(at, config.search_velocity_sd_px);
                }
                branches.push(Hypothesis {
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

/// The hypotheses that are kept of all, the heaviest first, of which the weights sum to 1.
fn kept(mut all: Vec<Hypothesis>) -> Vec<Hypothesis> {
    all.sort_by(|one, other| other.weight.total_cmp(&one.weight));
    let mut kept: Vec<Hypothesis> = Vec::with_capacity(MOST);
    for hypothesis in all {
        let known = kept.iter().position(|known| known.is_like(&hypothesis));
        match known {
            Some(known) => kept[known].weight += hypothesis.weight,
            None if kept.len() < MOST => kept.push(hypothesis),
            None => {}
        }
    }
    let total: f64 = kept.iter().map(|hypothesis| hypothesis.weight).sum();
    if total.is_nan() || total <= 0.0 {
        return Vec::new();
    }
    kept.iter_mut().for_each(|hypothesis| hypothesis.weight /= total);
    kept.retain(|hypothesis| hypothesis.weight >= LEAST);
    kept.sort_by(|one, other| other.weight.total_cmp(&one.weight));
    kept
}
