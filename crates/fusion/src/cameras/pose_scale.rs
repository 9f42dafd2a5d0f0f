//! How good the cameras' poses are, against what is declared of them, by how well their sight lines
//! meet.
//!
//! Each camera's bearings of a target are off by what its pose is off by; where the target is
//! nobody knows beforehand. What is left of the lines when the best place is taken out tells how
//! large the cameras' errors are, and whose: their variances are found by minorising and maximising
//! their likelihood (REML of variance components), a step a draw. Where nobody has declared a
//! pose's deviation, a careful survey's is where it begins. A clock that is off by more than its
//! camera says looks like a pose that is.

use crossfix_message::CameraName;
use nalgebra::{Matrix2, Matrix2x3, Matrix2x6, Matrix3, Vector2, Vector3};

use super::Cameras;

/// The share of a draw in the running means, once there are enough. A draw lasts a third of a
/// second: they remember some three seconds of one target. With half of it a site would be a minute
/// in learning what it is worth.
const DRAW_SHARE: f64 = 0.1;
/// Cameras of one site have been surveyed alike: each step takes their variances closer to the
/// median by this share, as if one of ten draws were of an average camera. A camera whose lines
/// happen to meet the others' is so not taken for perfect, while one that is far off loses a tenth
/// of its error at most. Without it two of four cameras would be taken to be perfect, and the
/// others for worse than they are: the lines tell of fewer errors than there are; with twice as
/// much one that is off by 0.2 degrees draws the others with it.
const ALIKE: f64 = 0.1;
/// A step changes a factor (variance) by no more than this, so that a camera that is knocked is
/// known in two seconds. With half of it that takes five, with twice as much one wrong start doubts
/// a good camera.
const LARGEST_STEP: f64 = 2.5;
/// A draw counts as no more than this many times what was expected: a target whose bearings were
/// mixed up with another's for a moment must not be remembered for ten draws.
const MOST_OF_A_DRAW: f64 = 30.0;
/// Fewer cameras cannot tell whose error it is: two lines that miss each other accuse nobody.
const LEAST_ACCUSERS: usize = 3;
/// No pose is known better than this share (variance) of a careful survey: a microradian, which
/// keeps covariances regular. With ten microradians tracks seen from kilometres away said that they
/// knew half of what they did.
const LEAST: f64 = 1e-6;
/// No pose is worse than this many times (variance) what is said of it and still a pose.
const MOST: f64 = 1e6;
/// Nor is one that is declared.
const DECLARED_MOST: f64 = 4.0;
/// A camera whose errors are this many times (variance) what is declared of them is doubted.
const DOUBTED: f64 = 9.0;
/// Estimates that move by less than this (logarithm) change no track.
const NOTICED: f64 = 0.1;

/// What a camera has seen of a target within a draw.
#[derive(Clone, Debug)]
pub(crate) struct Sample {
    pub(crate) camera: CameraName,
    /// Mean offset of its bearings from the track, rad.
    pub(crate) offset: Vector2<f64>,
    /// How the offset changes with the place, rad/m.
    pub(crate) by_position: Matrix2x3<f64>,
    /// Covariance of the mean offset for noise alone, rad^2.
    pub(crate) noise: Matrix2<f64>,
    /// What the pose shifts it by as declared: the root of its covariance, rad.
    pub(crate) pose: Matrix2<f64>,
    /// How it changes with rotation (rad/rad) and place (rad/m) of the camera, ...
    pub(crate) by_pose: Matrix2x6<f64>,
    /// ... and what a deviation of its clock shifts it by, rad.
    pub(crate) clock: Vector2<f64>,
    /// Covariance of white noise of draws that averages out as slowly, rad^2: some of it lasts from
    /// one to the next, and `clock` is as sure as the velocity.
    pub(crate) slow_noise: Matrix2<f64>,
}

/// What a camera's pose covariance is to be multiplied with.
#[derive(Clone, Copy, Debug)]
pub(super) struct PoseScale {
    value: f64,
    /// What the tracks know of it.
    told: f64,
    /// Not less: a declared pose is not made better than it says.
    least: f64,
    greatest: f64,
    draws: f64,
    /// Running means of what the camera's errors are, and of what they should be.
    found: f64,
    expected: f64,
}

impl PoseScale {
    /// Of a camera whose pose's deviation somebody has declared, or not, and of which nothing is
    /// learnt yet.
    pub(super) fn new(is_declared: bool) -> Self {
        let (least, greatest) = if is_declared { (1.0, DECLARED_MOST) } else { (LEAST, MOST) };
        Self { value: 1.0, told: 1.0, least, greatest, draws: 0.0, found: 0.0, expected: 0.0 }
    }

    /// The factor on the pose's covariance, as the tracks know it.
    pub(super) fn factor(&self) -> f64 {
        self.told
    }

    /// Whether the camera's lines miss the others' by far more than is declared of it.
    pub(super) fn is_doubted(&self) -> bool {
        self.told > DOUBTED
    }

    /// Takes in what the camera's errors are by a draw of so many cameras, and what they should be,
    /// where the site's cameras have a typical factor; returns by how much the tracks' factor
    /// changes, if it does.
    fn learn(
        &mut self,
        (found, expected): (f64, f64),
        accusers: usize,
        typical: f64,
    ) -> Option<f64> {
        if !(found.is_finite() && expected.is_finite() && expected > 0.0) {
            return None;
        }
        self.draws += 1.0;
        let share = self.draws.recip().max(DRAW_SHARE);
        // No one draw says that a camera is far worse than it was.
        let found = found.min(expected * MOST_OF_A_DRAW);
        self.found += (found - self.found) * share;
        self.expected += (expected - self.expected) * share;
        let step = (self.found / self.expected).sqrt().clamp(LARGEST_STEP.recip(), LARGEST_STEP);
        let most = if accusers < LEAST_ACCUSERS { 1.0 } else { LARGEST_STEP };
        let own = self.value * step.min(most);
        let next = own + (typical - own) * ALIKE;
        let next = next.clamp(self.value / LARGEST_STEP, self.value * LARGEST_STEP);
        let next = next.clamp(self.least, self.greatest);
        // What has been found so far is less by the new factor: not at all where noise hides the
        // pose, and inversely to it where the pose is all. Held against the old one, an error would
        // count ten times; a declared pose's factor is bounded, and real flights are better for
        // counting it so.
        if self.greatest > DECLARED_MOST {
            self.found /= (next / self.value).max(1.0).sqrt();
        }
        self.value = next;
        let ratio = self.value / self.told;
        (ratio.ln().abs() > NOTICED).then(|| {
            self.told = self.value;
            ratio
        })
    }
}

impl Cameras {
    /// Takes in what cameras have seen of a target; returns those whose pose's factor has changed,
    /// each with the ratio.
    pub(crate) fn learn_poses(&mut self, samples: &[Sample]) -> Vec<(CameraName, f64)> {
        let Some(found) = self.found_and_expected(samples) else {
            return Vec::new();
        };
        let typical = self.typical_scale(samples);
        let drawn = samples.iter().zip(found);
        let changed = drawn.filter_map(|(sample, found)| {
            let scale = &mut self.get_mut(&sample.camera)?.pose_scale;
            Some((sample.camera.clone(), scale.learn(found, samples.len(), typical)?))
        });
        changed.collect()
    }

    /// The median of the factors, in their logarithms.
    fn typical_scale(&self, samples: &[Sample]) -> f64 {
        let logarithm = |sample: &Sample| Some(self.get(&sample.camera)?.pose_scale.value.ln());
        let mut logarithms: Vec<f64> = samples.iter().filter_map(logarithm).collect();
        logarithms.sort_unstable_by(f64::total_cmp);
        let middle = |k: usize| logarithms.get(k).copied().unwrap_or(0.0);
        ((middle(logarithms.len() / 2) + middle(logarithms.len().saturating_sub(1) / 2)) / 2.0)
            .exp()
    }

    /// By each camera's factor: what of a draw its pose error explains, and what it should explain.
    fn found_and_expected(&self, samples: &[Sample]) -> Option<Vec<(f64, f64)>> {
        let scale = |sample: &Sample| {
            self.get(&sample.camera).map_or(1.0, |camera| camera.pose_scale.value)
        };
        let weight = |s: &Sample| (s.noise + s.pose * s.pose.transpose() * scale(s)).try_inverse();
        let weights: Vec<Matrix2<f64>> = samples.iter().map(weight).collect::<Option<_>>()?;
        let (mut information, mut pull) = (Matrix3::zeros(), Vector3::zeros());
        for (sample, weight) in samples.iter().zip(&weights) {
            let weighed = sample.by_position.transpose() * weight;
            information += weighed * sample.by_position;
            pull += weighed * sample.offset;
        }
        // The weighted least-squares place, and P = W - W A (A' W A)^-1 A' W, which takes from a
        // residual what the place has explained: REML.
        let spread = information.try_inverse()?;
        let place = spread * pull;
        let of_camera = |(sample, weight): (&Sample, &Matrix2<f64>)| {
            let Sample { offset, by_position, pose, .. } = sample;
            let error = pose.transpose() * weight * (offset - by_position * place);
            let told = weight - weight * by_position * spread * by_position.transpose() * weight;
            (
                error.norm_squared() * scale(sample),
                (pose.transpose() * told * pose).trace() * scale(sample),
            )
        };
        Some(samples.iter().zip(&weights).map(of_camera).collect())
    }
}
