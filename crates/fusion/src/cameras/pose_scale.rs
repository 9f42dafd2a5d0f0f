//! Size of the cameras' pose errors relative to what is declared, from how well their sight lines
//! meet.
//!
//! Each camera's pose error shifts its bearings of a target, whose place is not known beforehand.
//! The residuals of the lines, with the best place taken out, tell how large the cameras' errors
//! are, and whose: the variances are found by minorisation and maximisation of their likelihood
//! (REML of variance components), one step per draw, with a weak prior that cameras of one site are
//! about equally good. Where nobody has declared a pose's deviation, the estimate starts from that
//! of a careful survey. A clock that is off by more than its camera says looks like a pose that is.

use crossfix_message::CameraName;
use nalgebra::{Matrix2, Matrix2x3, Matrix2x6, Vector2};

use super::meeting::Meeting;
use super::{Cameras, NOTICED};

/// Share of a draw in the running means, once there are enough. A draw lasts a third of a second:
/// the means remember some three seconds of one target. With half of it a site would take a minute
/// to learn how good its poses are.
const DRAW_SHARE: f64 = 0.1;
/// Weight of the site's typical factor in the estimate of a camera's own, in degrees of freedom: a
/// draw has two, less what the target's place takes of them, and a pose errs once, however many
/// draws show it. Cameras of one site have been surveyed alike. Without it two of four cameras
/// would be taken to be perfect, and the others to be worse than they are: the lines tell of fewer
/// errors than there are. With 0.2 tracks of four cameras a metre off have a median NEES of 10 in
/// place of 9 (of the position); with 0.5 a camera that is off by 0.2 degrees draws the others with
/// it.
const TYPICAL_WEIGHT: f64 = 0.3;
/// Largest change of a factor (variance) in one step, so that a camera that is knocked is
/// recognised in two seconds. With half of it that takes five, with twice as much one wrong start
/// doubts a good camera.
const LARGEST_STEP: f64 = 2.5;
/// A draw counts as no more than this many times its expectation: a target whose bearings were
/// mixed up with another's for a moment must not be remembered for ten draws. With half of it the
/// first draw after a knock raises the factor to 1.5 times at most, and not to twice.
const MAX_DRAW_RATIO: f64 = 30.0;
/// Least factor (variance) on a careful survey's pose covariance: a microradian, which keeps
/// covariances regular. With ten microradians tracks seen from kilometres away claimed to know half
/// of what they did.
pub(super) const LEAST_SCALE: f64 = 1e-6;
/// Largest factor (variance): a pose that is worse is no pose. On a careful survey's milliradian it
/// is a radian. With half of it the same.
const MAX_SCALE: f64 = 1e6;
/// Largest factor (variance) on a pose that is declared. With half of it a camera that errs by
/// twice what it declares is taken to err by 1.4 times that, and draws targets towards its lines.
const MAX_DECLARED_SCALE: f64 = 4.0;
/// A camera whose pose's errors are more than this many times (variance) the declared ones, or
/// those of a careful survey where nobody has declared any, is doubted. With half of it one that
/// errs by more than 2.1 deviations is, and not only by more than 3.
const DOUBTED: f64 = 9.0;

/// What a camera has seen of a target during one draw.
#[derive(Clone, Debug)]
pub(crate) struct ScaleSample {
    pub(crate) camera: CameraName,
    /// Residual of its bearings from a straight course, in the middle of the draw, rad.
    pub(crate) residual: Vector2<f64>,
    /// Derivative of the residual by the target's place, rad/m.
    pub(crate) by_position: Matrix2x3<f64>,
    /// Covariance of the residual by noise alone, rad^2.
    pub(crate) noise: Matrix2<f64>,
    /// Shift of the residual by the declared pose error: a root of its covariance, rad.
    pub(crate) pose: Matrix2<f64>,
    /// Derivative of the residual by the camera's rotation (rad/rad) and place (rad/m).
    pub(crate) by_pose: Matrix2x6<f64>,
    /// Derivative of the residual by the camera's clock, rad/s.
    pub(crate) by_time: Vector2<f64>,
    /// Standard deviation of that clock, s.
    pub(crate) clock_sd_s: f64,
    /// Covariance of white noise per draw that averages out as slowly, rad^2: part of the noise
    /// lasts from one draw to the next, and `by_time` is only as sure as the velocity.
    pub(crate) slow_noise: Matrix2<f64>,
    /// Whether part of the noise was known to last.
    pub(crate) noise_lasts: bool,
}

/// The squared pose error of a camera by one draw, in units of the declared deviation.
#[derive(Clone, Copy, Debug)]
struct SquaredPoseError {
    /// What explains the camera's part of the draw.
    found: f64,
    /// Its expectation.
    expected: f64,
}

/// The chance that a camera has been moved.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Moved {
    /// Its probability.
    pub(super) probability: f64,
    /// The factor on the covariance of its pose, if it has been moved.
    pub(super) factor: f64,
}

/// What all lines of a site together say of a pose whose deviation nobody has declared.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Surveyed {
    /// The least factor on its covariance, at most 1.
    pub(super) least: f64,
    /// By how much (variance) all poses are worse than a careful survey's, in the mean over the
    /// explanations, of which those without count as 0.
    pub(super) all_worse_by: f64,
}

/// Factor on a camera's pose covariance, and what it is learnt from.
#[derive(Clone, Copy, Debug)]
pub(super) struct PoseScale {
    value: f64,
    /// The chance that the camera has been moved ([`super::watch`]).
    moved: Moved,
    /// The factor as the tracks know it.
    told: f64,
    /// Least factor: a declared pose is not made better than it says. For another one it is what
    /// all lines together say ([`super::watch`]).
    least: f64,
    /// By how much all poses of the site are worse than a careful survey's: the typical factor is
    /// this at least.
    all_worse_by: f64,
    /// Whether somebody has declared the pose's deviation.
    is_declared: bool,
    draws: f64,
    /// Running means of the camera's squared pose error by the draws, and of its expectation.
    found: f64,
    expected: f64,
}

impl PoseScale {
    /// For a camera whose pose's deviation somebody has declared, or not, and of which nothing is
    /// learnt yet.
    pub(super) fn new(is_declared: bool) -> Self {
        Self {
            value: 1.0,
            moved: Moved::default(),
            told: 1.0,
            least: 1.0,
            all_worse_by: 0.0,
            is_declared,
            draws: 0.0,
            found: 0.0,
            expected: 0.0,
        }
    }

    /// Whether somebody has declared the pose's deviation.
    pub(super) fn is_declared(&self) -> bool {
        self.is_declared
    }

    /// The factor on the pose's covariance, as the tracks know it.
    pub(super) fn factor(&self) -> f64 {
        self.told
    }

    /// Whether the camera's lines miss the others' by far more than its pose explains, or it is
    /// likelier to have been moved than not.
    pub(super) fn is_doubted(&self) -> bool {
        self.value > DOUBTED || self.moved.probability > 0.5
    }

    /// The step that the camera's own draws alone would take: its factor's ratio to that before.
    fn own_step(&self) -> Option<f64> {
        let step = (self.found / self.expected).sqrt().clamp(LARGEST_STEP.recip(), LARGEST_STEP);
        (self.expected > 0.0).then_some(step)
    }

    /// Takes in the squared pose error of a draw, with the typical factor of the site's cameras;
    /// returns by how much the tracks' factor changes, if it does.
    fn learn(&mut self, error: SquaredPoseError, typical: f64) -> Option<f64> {
        let SquaredPoseError { found, expected } = error;
        if !(found.is_finite() && expected.is_finite() && expected > 0.0) {
            return None;
        }
        self.draws += 1.0;
        let share = self.draws.recip().max(DRAW_SHARE);
        // No one draw says that a camera is far worse than it was.
        let found = found.min(expected * MAX_DRAW_RATIO);
        self.found += (found - self.found) * share;
        self.expected += (expected - self.expected) * share;
        // Minorisation-maximisation step of a variance (the mode of its logarithm) with an inverse
        // gamma prior of n degrees of freedom about the typical factor t:
        // factor * sqrt((found + n t / factor) / (expected + n)).
        let typical = typical.max(self.all_worse_by);
        let found = self.found + TYPICAL_WEIGHT * typical / self.value;
        let step = (found / (self.expected + TYPICAL_WEIGHT)).sqrt();
        let step = step.clamp(LARGEST_STEP.recip(), LARGEST_STEP);
        let greatest = if self.is_declared { MAX_DECLARED_SCALE } else { MAX_SCALE };
        let next = (self.value * step).clamp(self.least, greatest);
        // Under the new factor the errors found so far come out smaller: not at all where noise
        // hides the pose error, inversely to the factor where the pose error is all. The root is
        // between the two. Compared under the old factor one error would count ten times; the
        // factor of a declared pose is bounded, and real flights are better for counting it so.
        if !self.is_declared {
            self.found /= (next / self.value).max(1.0).sqrt();
        }
        self.value = next;
        self.tell()
    }

    /// Takes in the chance that the camera has been moved, and what all lines say of a pose that
    /// nobody has declared; returns by how much the tracks' factor changes, if it does.
    pub(super) fn judge(&mut self, moved: Moved, surveyed: Option<Surveyed>) -> Option<f64> {
        self.moved = moved;
        if let Some(Surveyed { least, all_worse_by }) = surveyed {
            (self.least, self.all_worse_by) = (least, all_worse_by);
            self.value = self.value.max(least);
        }
        self.tell()
    }

    /// The ratio by which the tracks' factor changes, if it does.
    fn tell(&mut self) -> Option<f64> {
        // Second moment of a mixture, (1 - P) s + P m; where m is no larger than s, the errors are
        // no news.
        let Moved { probability, factor } = self.moved;
        let factor = self.value + probability * (factor - self.value).max(0.0);
        let ratio = factor / self.told;
        (ratio.ln().abs() > NOTICED).then(|| {
            self.told = factor;
            ratio
        })
    }
}

impl Cameras {
    /// Takes in what cameras have seen of a target; returns those whose pose's factor has changed,
    /// each with the ratio.
    pub(crate) fn learn_poses(&mut self, samples: &[ScaleSample]) -> Vec<(CameraName, f64)> {
        let Some(errors) = self.squared_errors(samples) else {
            return Vec::new();
        };
        let typical = self.typical_scale(samples);
        let drawn = samples.iter().zip(errors);
        let changed = drawn.filter_map(|(sample, error)| {
            let scale = &mut self.get_mut(&sample.camera)?.pose_scale;
            Some((sample.camera.clone(), scale.learn(error, typical)?))
        });
        changed.collect()
    }

    /// The typical factor of the cameras: the median of their factors times the median of the steps
    /// that their own draws would take, both in logarithms.
    fn typical_scale(&self, samples: &[ScaleSample]) -> f64 {
        let scales: Vec<&PoseScale> = samples
            .iter()
            .filter_map(|sample| Some(&self.get(&sample.camera)?.pose_scale))
            .collect();
        let value = median(scales.iter().map(|scale| scale.value.ln()).collect());
        let steps = scales.iter().filter_map(|scale| Some(scale.own_step()?.ln()));
        (value + median(steps.collect())).exp()
    }

    fn pose_scale_of(&self, camera: &CameraName) -> f64 {
        self.get(camera).map_or(1.0, |camera| camera.pose_scale.value)
    }

    /// The squared pose error of each camera, by its factor.
    fn squared_errors(&self, samples: &[ScaleSample]) -> Option<Vec<SquaredPoseError>> {
        let scale = |sample: &ScaleSample| self.pose_scale_of(&sample.camera);
        let weight =
            |s: &ScaleSample| (s.noise + s.pose * s.pose.transpose() * scale(s)).try_inverse();
        let weights: Vec<Matrix2<f64>> = samples.iter().map(weight).collect::<Option<_>>()?;
        let meeting = Meeting::of(samples, &weights)?;
        let of_cameras = samples.iter().zip(&weights).map(|(sample, weight)| {
            let SquaredPoseError { found, expected } = sample.squared_error(weight, &meeting);
            let scale = scale(sample);
            SquaredPoseError { found: found * scale, expected: expected * scale }
        });
        Some(of_cameras.collect())
    }
}

/// The median; of an even number of values, the mean of the middle two, and 0 of none.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    let middle = |k: usize| values.get(k).copied().unwrap_or(0.0);
    (middle(values.len() / 2) + middle(values.len().saturating_sub(1) / 2)) / 2.0
}

impl ScaleSample {
    /// As [`Cameras::squared_errors`], for one camera with a factor of 1, given where the lines
    /// meet.
    fn squared_error(&self, weight: &Matrix2<f64>, meeting: &Meeting) -> SquaredPoseError {
        let Meeting { place, spread, .. } = meeting;
        let Self { residual, by_position, pose, .. } = self;
        // With pose root L and factor s: found s |L' W (z - A x)|^2, expected s tr(L' P L), where
        // P = W - W A (A' W A)^-1 A' W takes from a residual what the place has explained: REML.
        let error = pose.transpose() * weight * (residual - by_position * place);
        let told = weight - weight * by_position * spread * by_position.transpose() * weight;
        SquaredPoseError {
            found: error.norm_squared(),
            expected: (pose.transpose() * told * pose).trace(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: a camera's own lines say 1; with a weight of 0.3 of 100, and of 1 of its own, the
    /// factor v fulfils v = (1 + 0.3 x 100) / 1.3.
    #[test]
    fn a_factor_is_drawn_to_what_all_poses_of_the_site_are_worse_by() {
        let [alone, drawn] = [0.0, 100.0].map(|all_worse_by| {
            let mut scale = PoseScale::new(false);
            scale.judge(Moved::default(), Some(Surveyed { least: LEAST_SCALE, all_worse_by }));
            for _ in 0..300 {
                let error = SquaredPoseError { found: 1.0 / scale.value, expected: 1.0 };
                scale.learn(error, 1.0);
            }
            scale.value
        });
        assert!((alone - 1.0).abs() < 0.01, "{alone}");
        assert!((drawn - 31.0 / 1.3).abs() < 0.5, "{drawn}");
    }
}
