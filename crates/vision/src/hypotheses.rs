//! Several places where a target may be, each with filters of its own, as long as none of them is
//! sure.
//!
//! One Gaussian cannot hold two places: their mean is neither, and in the next image both lie
//! outside of what it expects.

use crossfix_filter::AxisMeasurement;

use crate::config::GateRule;
use crate::frame::{Frame, Step};
use crate::gate::Region;
use crate::motion::Motion;
use crate::posterior::Posterior;
use crate::target::{SEEN, Scratch, Target};
use crate::{ImagePoint, TrackerConfig};

/// Certainty of the best place below which the others are kept too.
const DOUBT: f64 = 0.9;
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
/// A turn of the camera by less than this is within what is not known of a target's motion anyway,
/// px.
const LEAST_MOVE_PX: f64 = 2.0;
/// A target of which this long no place is sure counts as lost, s, ...
const LOST_S: f64 = 0.4;
/// ... and is searched for after so long, s: it is fainter than noise for a second as a cloud
/// passes. With a fifth of it 2.9 % of the frames of nine seeds' sequences are lost in place of
/// 2.3, with twice as much 2.4.
const LONGEST_S: f64 = 2.0;

/// A place where the target may be, and how it moves then.
#[derive(Clone, Debug)]
pub(crate) struct Hypothesis {
    weight: f64,
    motion: Motion,
    /// How likely it could not be seen in the image before.
    hidden: f64,
    /// Whether it has been seen there in this image, and on which placement of the map.
    peak: Option<[usize; 2]>,
}

impl Hypothesis {
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

    /// Each may have moved by so many pixels, or not.
    fn fork(&mut self, by: [f64; 2]) {
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
}

impl Target {
    /// The camera may have turned: then everything in its image has moved, the target too. Light
    /// that changes may be taken for a turn, so it may have stayed as well.
    pub(crate) fn may_move_with_scene(&mut self, frame: Frame<'_>) {
        let by = frame.scene_moved;
        let is_followed = !self.is_searching() && !self.identity.is_on_probation();
        if !is_followed
            || by[0].hypot(by[1]) < LEAST_MOVE_PX
            || !matches!(frame.config.gate, GateRule::Innovation { .. })
        {
            return;
        }
        if self.hypotheses.is_empty() {
            self.hypotheses.all.push(Hypothesis {
                weight: 1.0,
                motion: self.motion.clone(),
                hidden: self.hidden,
                peak: None,
            });
        }
        self.hypotheses.fork(by);
    }

    /// Whether a posterior leaves more than one place to be kept.
    pub(crate) fn must_doubt(&self, posterior: &Posterior, config: &TrackerConfig) -> bool {
        let in_doubt = !self.hypotheses.is_empty() || posterior.near.mass < DOUBT;
        in_doubt
            && matches!(config.gate, GateRule::Innovation { .. })
            && !self.identity.is_on_probation()
    }

    /// Follows all places where the target may be into the image whose log ratios are in the
    /// scratch's map.
    pub(crate) fn follow_hypotheses(
        &mut self,
        frame: Frame<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) -> Step {
        let config = frame.config;
        let mut before = std::mem::take(&mut self.hypotheses.all);
        if before.is_empty() {
            before.push(Hypothesis {
                weight: 1.0,
                motion: self.motion.clone(),
                hidden: self.hidden,
                peak: None,
            });
        }
        if let Some(one) = self.one_place(&before, frame, region, scratch) {
            return self.settle_on(one, frame, region, scratch);
        }
        let branches = self.branches(&before, frame, region, scratch);
        self.hypotheses.all = kept(branches);
        let Some(best) = self.hypotheses.all.first().cloned() else {
            self.hypotheses.clear();
            self.missed += 1;
            return Step { measured: None, score: 0.0, certainty: 0.0, nis: None };
        };
        let seen: f64 =
            self.hypotheses.all.iter().filter(|h| h.peak.is_some()).map(|h| h.weight).sum();
        (self.motion, self.hidden) = (best.motion.clone(), best.hidden);
        let Some([column, row]) = best.peak else {
            self.hypotheses.doubted_s += frame.interval;
            if seen < 1.0 - DOUBT || self.hypotheses.doubted_s > LONGEST_S {
                self.missed += 1;
            }
            self.settle(0.0);
            return Step { measured: None, score: 0.0, certainty: 0.0, nis: None };
        };
        let near = self.peak_half();
        let here = |h: &&Hypothesis| {
            h.peak.is_some_and(|[x, y]| x.abs_diff(column) <= near[0] && y.abs_diff(row) <= near[1])
        };
        let sure: f64 = self.hypotheses.all.iter().filter(here).map(|h| h.weight).sum();
        let look = self.look(column, row, region.origin, scratch, config);
        let is_there = self.doubt(frame, look, scratch);
        let certainty = sure * is_there;
        self.hypotheses.doubted_s += frame.interval;
        if certainty > SEEN {
            self.motion.tell_noise(look.found().map(|at| at.variance));
            self.seen(look.place);
        } else if seen < 1.0 - DOUBT || is_there < SEEN || self.hypotheses.doubted_s > LONGEST_S {
            self.missed += 1;
        }
        self.learn(frame, look.place, look, certainty, scratch);
        self.settle(best.weight);
        let measured = (certainty > SEEN).then(|| self.measurement(&look));
        Step { measured, score: look.score, certainty, nis: None }
    }

    /// One place is left, or none: the others are forgotten.
    fn settle(&mut self, weight: f64) {
        if weight > DOUBT || self.is_searching() {
            self.hypotheses.clear();
        }
    }

    /// The likeliest of the hypotheses, with the posterior that it leads to, if all of them lead to
    /// one place.
    fn one_place(
        &self,
        before: &[Hypothesis],
        frame: Frame<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) -> Option<(Motion, Posterior)> {
        let near = self.peak_half();
        let mut ways: Vec<(f64, usize, Posterior)> = Vec::with_capacity(before.len());
        let mut all = 0.0;
        for (index, hypothesis) in before.iter().enumerate() {
            let posterior = scratch.map.of(
                &scratch.ratios,
                &self.prior(&hypothesis.motion, hypothesis.hidden, region, frame),
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
        (there > DOUBT * all).then(|| (before[best].motion.clone(), posterior))
    }

    /// No doubt is left: the target has been where its likeliest hypothesis was.
    fn settle_on(
        &mut self,
        (motion, posterior): (Motion, Posterior),
        frame: Frame<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) -> Step {
        self.motion = motion;
        self.hypotheses.clear();
        let [column, row] = posterior.peak;
        let look = self.look(column, row, region.origin, scratch, frame.config);
        self.update(frame, &posterior, look, region.origin, scratch)
    }

    /// Where each hypothesis may have gone, with their weights.
    fn branches(
        &self,
        before: &[Hypothesis],
        frame: Frame<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) -> Vec<Hypothesis> {
        let config = frame.config;
        let mut branches = Vec::with_capacity(before.len() * (MOST_PEAKS + 1));
        for hypothesis in before {
            let prior = self.prior(&hypothesis.motion, hypothesis.hidden, region, frame);
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
