//! Update of the belief about the clocks by a window: how credible it is, and whether a clock has
//! jumped.

use crossfix_message::{CameraName, Timestamp};
use nalgebra::DMatrix;

use super::WINDOW_S;
use super::adjustment::{AdjustedCameras, Adjustment, ClockAndPosePrior, MAX_SCALE, Unknowns};
use super::belief::{Belief, MAX_OFFSET_S};
use super::curve::Curve;
use super::window::TrackWindow;

/// Least span of a window, and least time for which a camera whose clock has jumped sees the target
/// together with another, s: bearings of less say nothing that can be checked. With half of it
/// there is a single piece of the curve to check the clocks by.
const LEAST_WINDOW_S: f64 = 1.0;
/// A camera of which more than this share of bearings are outliers, of other objects, does not fit
/// itself. With half of it a bird that is taken for the target in one bearing of six spoils a
/// window.
const MAX_OUTLIERS: f64 = 0.3;
/// Residuals larger than this (squared, over what was expected) may be due to a clock that has
/// jumped. With half of it every window is searched for jumps, in up to fifteen fits more.
const SUSPICIOUS_SCALE: f64 = 1.5;
/// So may clocks farther than this from their prior (squared, over what was expected). With half of
/// it a jump that only the prior shows is searched for at 0.7 times the size.
const SUSPICIOUS_PULL: f64 = 6.0;
/// By how much (twice the logarithm) a jump must make a window likelier: clocks jump once a day.
/// With half of it a jump would be accepted as if they did every twelve minutes.
const JUMP: f64 = 18.0;
/// Cameras that are tried for a jump, the least fitting first. With half of it a jump of the third
/// is not found; each more costs three fits.
const MAX_SUSPECTS: usize = 4;
/// Bearings of a camera that fit better than all of its bearings by this factor (squared) are taken
/// after a jump. With half of it they need not even fit as well, and any poor fit may pass for a
/// jump.
const BETTER: f64 = 1.5;
/// Longest margin of a curve beyond its bearings, s: the margin is as far as the clocks may move.
/// With half of it the bearings of a clock that is off by a second lie beyond the curve, where its
/// end pieces are only continued.
const MAX_MARGIN_S: f64 = 1.0;
/// Jerk density that is tried first, m^2/s^5, as a power of ten: a small drone's. Each power
/// between it and the best one costs a descent; with half of the density the best one is the same.
const FIRST_DENSITY: i32 = 0;

/// Difference of evidence (twice the logarithm) that is as good as none. With half of it more jumps
/// of clocks of which little was known are overlooked by chance.
const EVEN: f64 = 1.0;

/// Result of a window.
pub(super) enum WindowUpdate {
    /// The belief with the window taken in.
    Accepted(Box<Belief>),
    /// The window is too short, sees no clock that could be learnt, or is not of one target.
    Uninformative,
    /// The window fits only if all that was learnt before is forgotten: the belief it gives then.
    Contradicts(Box<Belief>),
}

/// Test of a window for jumps: the belief before it, and the state components that it observes.
struct JumpTest<'a> {
    belief: Belief,
    /// The time of the window's last bearing.
    now: Timestamp,
    components: Vec<usize>,
    window: &'a TrackWindow,
    /// Factors by which the bearings of its cameras have repeated one another in earlier windows.
    known: Vec<Option<f64>>,
}

/// The belief after a window. If the window does not fit it well, a camera's clock may have jumped.
pub(super) fn window_update(belief: &Belief, window: &TrackWindow) -> WindowUpdate {
    let window = window.checked();
    let Some(span) = window.span().filter(|span| span.end - span.start >= LEAST_WINDOW_S) else {
        return WindowUpdate::Uninformative;
    };
    let mut belief = belief.clone();
    let now = window.start.plus_seconds(span.end);
    belief.advance(now);
    let clocks = window.cameras.iter().filter(|camera| belief.index(camera).is_some()).count();
    if clocks == 0 || window.cameras.len() < 2 {
        return WindowUpdate::Uninformative;
    }
    let components = components(&belief, &window);
    let known = window.cameras.iter().map(|camera| belief.inflation(camera)).collect();
    JumpTest { belief, now, components, window: &window, known }.learn()
}

/// A window fitted after a jump of a clock.
struct Jump {
    /// The belief before the window, with the clock in doubt.
    belief: Belief,
    adjusted: AdjustedCameras,
    /// By how much more likely (twice the logarithm) the window is than without the jump; infinite
    /// if that explains too few bearings to be compared, ...
    gain: f64,
    /// ... and whether it fits without it.
    fitted: bool,
}

impl JumpTest<'_> {
    fn learn(mut self) -> WindowUpdate {
        let plain = self.fit(&self.belief);
        let fitting = plain.as_ref().filter(|adjusted| fits(adjusted));
        let unmoved = fitting.map(|adjusted| self.learnt(self.belief.clone(), adjusted));
        let is_strange = fitting.is_none_or(is_suspicious);
        if let Some(belief) = unmoved.clone().filter(|_| !is_strange) {
            return WindowUpdate::Accepted(Box::new(belief));
        }
        // Try a jump within the window first, then for each suspect a jump before it, at a price.
        let suspects = self.suspects(plain.as_ref());
        if let Some(belief) =
            suspects.first().and_then(|camera| self.jumped_within(camera, plain.as_ref()))
        {
            return WindowUpdate::Accepted(Box::new(belief));
        }
        // The prior probability of a jump, as a price on the evidence.
        let mut best = (JUMP, unmoved);
        for camera in suspects {
            let Some(jump) = self.jump(camera, self.window, plain.as_ref()) else { continue };
            let jumped = self.learnt(jump.belief, &jump.adjusted);
            if jump.gain > best.0 && self.shows_jump(camera, self.window, &jumped) {
                best = (jump.gain, Some(jumped));
            }
        }
        if let (_, Some(belief)) = best {
            return WindowUpdate::Accepted(Box::new(belief));
        }
        // Nothing fits: try without anything learnt of clocks and poses before.
        self.belief.reset_all();
        self.components = components(&self.belief, self.window);
        let after_reset = self.fit(&self.belief).filter(fits);
        after_reset.map_or(WindowUpdate::Uninformative, |adjusted| {
            WindowUpdate::Contradicts(Box::new(self.learnt(self.belief.clone(), &adjusted)))
        })
    }

    /// Fits the window, and again once the first fit has shown how large its residuals are.
    fn fit(&self, belief: &Belief) -> Option<AdjustedCameras> {
        let first = self.fit_once(belief, self.window, &[])?;
        if self.repetitions(self.window, &[&first]) == self.repetitions(self.window, &[]) {
            return Some(first);
        }
        self.fit_once(belief, self.window, &[&first])
    }

    /// One fit of a window, where others have shown how large the residuals are.
    fn fit_once(
        &self,
        belief: &Belief,
        window: &TrackWindow,
        shown: &[&AdjustedCameras],
    ) -> Option<AdjustedCameras> {
        adjust(belief, window, &self.components, &self.repetitions(window, shown))
    }

    /// Factors by which the bearings of a window's cameras repeat one another: as in earlier
    /// windows, or, where a camera is new, as fits have shown. What is larger of the last one's
    /// residuals than both the reported noise and the white one is of errors that last.
    ///
    /// The trajectory follows the errors of the camera that counts for most, which then shows none
    /// and counts for all the more. So no camera's factor is below what is typical of the window's
    /// cameras, their geometric mean.
    fn repetitions(&self, window: &TrackWindow, shown: &[&AdjustedCameras]) -> Vec<f64> {
        let found = |index: usize| shown.iter().map(move |fit| fit.inflations[index]);
        let most_found = |index: usize| found(index).fold(1.0, f64::max);
        let known = self.known.iter().enumerate();
        let factors: Vec<f64> =
            known.map(|(index, known)| known.unwrap_or_else(|| most_found(index))).collect();
        let logarithms = factors.iter().map(|factor| factor.ln());
        let typical = (logarithms.sum::<f64>() / factors.len() as f64).exp();
        let at_least = factors.iter().enumerate().map(|(index, factor)| {
            let last = shown.last();
            let left = last.map_or(1.0, |fit| window.repetition(index, fit.scales[index]));
            factor.max(typical).max(left)
        });
        at_least.collect()
    }

    fn learnt(&self, mut belief: Belief, adjusted: &AdjustedCameras) -> Belief {
        belief.learn(&self.components, &adjusted.cameras, &adjusted.covariance);
        belief.see_inflations(&self.window.cameras, &adjusted.inflations);
        belief
    }

    /// The belief if a camera's clock has jumped in the first half of the window: its bearings of
    /// the second half then fit much better than all of them, and the clock as it was explains them
    /// no better.
    fn jumped_within(
        &self,
        camera: &CameraName,
        plain: Option<&AdjustedCameras>,
    ) -> Option<Belief> {
        let index = self.window.cameras.iter().position(|known| known == camera)?;
        let strange = |adjusted: &AdjustedCameras| adjusted.scales[index];
        if plain.is_some_and(|plain| fits(plain) && strange(plain) < SUSPICIOUS_SCALE) {
            return None;
        }
        let span = self.window.span()?;
        let later = self.window.without_early((span.start + span.end) / 2.0, camera);
        if !later.checked_cameras().contains(camera) {
            return None;
        }
        let jump = self.jump(camera, &later, plain)?;
        // Both must hold: the later half fits better without the earlier one, and it does not fit
        // as well with the clock as it was.
        let much_better =
            plain.is_none_or(|plain| strange(&jump.adjusted) * BETTER < strange(plain));
        // Where nothing was known of the clock yet, the evidences are even: nothing favours the old
        // clock. Where the old one fits badly, the new one must explain more.
        let jumped = jump.gain > if jump.fitted { -EVEN } else { JUMP };
        let learnt = self.learnt(jump.belief, &jump.adjusted);
        (much_better && jumped && self.shows_jump(camera, &later, &learnt)).then_some(learnt)
    }

    /// The fit of a window after a jump of a camera's clock; `None` if it does not fit then either.
    ///
    /// The evidences are compared with the noise that the jump leaves: one that explains a few of
    /// the errors that last, by chance, gains little, and nothing is deducted from one that
    /// explains them all.
    fn jump(
        &self,
        camera: &CameraName,
        window: &TrackWindow,
        plain: Option<&AdjustedCameras>,
    ) -> Option<Jump> {
        let mut belief = self.belief.clone();
        belief.widen_jumped(camera);
        let mut shown: Vec<&AdjustedCameras> = plain.into_iter().collect();
        let first = self.fit_once(&belief, window, &shown).filter(fits)?;
        // What counts as lasting only makes a jump less sure: one that does not show yet never
        // will.
        if !self.shows_jump(camera, window, &self.learnt(belief.clone(), &first)) {
            return None;
        }
        shown.push(&first);
        let adjusted = self.fit_once(&belief, window, &shown).filter(fits)?;
        let before = self.fit_once(&self.belief, window, &shown);
        // Without a jump even a bad fit sets the evidence to beat, unless it is none at all: of
        // bearings that it leaves out it says nothing.
        let gain = before
            .as_ref()
            .filter(|before| !leaves_out(before))
            .map_or(f64::INFINITY, |before| adjusted.evidence - before.evidence);
        Some(Jump { belief, adjusted, gain, fitted: before.as_ref().is_some_and(fits) })
    }

    /// Whether the belief after a jump of a clock, from the bearings of a window, says by how much
    /// it has jumped. Where the bearings of a camera are moved to a time at which no other camera
    /// sees the target, they fit whatever they are, and tell nothing of their clock.
    fn shows_jump(&self, camera: &CameraName, window: &TrackWindow, jumped: &Belief) -> bool {
        let of = |belief: &Belief, camera| belief.estimate(camera, self.now);
        let (Some(before), Some(after)) = (of(&self.belief, camera), of(jumped, camera)) else {
            return false;
        };
        // Wald's test, d^2 / var > 18: for one normal parameter it is the ratio of likelihoods that
        // a jump must reach anyway. Of a clock that was known no better before, a window that
        // determines it says enough.
        let change_s = after.offset_s - before.offset_s;
        let differs = change_s.powi(2) > JUMP * after.relative_sd_s.powi(2);
        let ahead_s =
            |index: usize| of(jumped, &window.cameras[index]).map_or(0.0, |clock| clock.offset_s);
        let index = window.cameras.iter().position(|known| known == camera);
        let meets = index.is_some_and(|index| window.together_s(index, ahead_s) >= LEAST_WINDOW_S);
        jumped.is_possible() && meets && (differs || after.relative_sd_s < before.relative_sd_s)
    }

    /// The cameras of the window whose clocks may have jumped, the least fitting first.
    fn suspects(&self, adjusted: Option<&AdjustedCameras>) -> Vec<&CameraName> {
        let cameras = self.window.cameras.iter().enumerate();
        let mut suspects: Vec<(f64, &CameraName)> = cameras
            .filter(|(_, camera)| self.belief.is_uncertain(camera))
            .map(|(index, camera)| (adjusted.map_or(0.0, |fit| misfit(fit, index)), camera))
            .collect();
        suspects.sort_by(|a, b| b.0.total_cmp(&a.0));
        suspects.into_iter().take(MAX_SUSPECTS).map(|(_, camera)| camera).collect()
    }
}

/// State components of a window's cameras: for each those of its clock, then those of its pose.
fn components(belief: &Belief, window: &TrackWindow) -> Vec<usize> {
    let components = window.cameras.iter().flat_map(|camera| {
        let clock = belief.index(camera).map(|index| index..index + 2);
        let pose = belief.pose(camera).map(|index| index..index + 6);
        clock.into_iter().chain(pose).flatten()
    });
    components.collect()
}

/// Where among these [`components`] the unknowns of each camera of a window are.
fn unknowns(belief: &Belief, window: &TrackWindow) -> Vec<Unknowns> {
    let mut next = 0;
    let unknowns = window.cameras.iter().map(|camera| Unknowns {
        clock: belief.index(camera).map(|_| take_places(&mut next, 2)),
        pose: belief.pose(camera).map(|_| take_places(&mut next, 6)),
    });
    unknowns.collect()
}

/// Takes `count` places from the next free one on; returns the first of them.
fn take_places(next: &mut usize, count: usize) -> usize {
    let first = *next;
    *next += count;
    first
}

/// How badly a camera's bearings fit.
fn misfit(adjusted: &AdjustedCameras, index: usize) -> f64 {
    adjusted.scales[index] + MAX_SCALE * adjusted.outlier_shares[index]
}

fn fits(adjusted: &AdjustedCameras) -> bool {
    adjusted.scales.iter().all(|scale| *scale < MAX_SCALE) && !leaves_out(adjusted)
}

/// Whether too many bearings of a camera are farther off than noise can be.
fn leaves_out(adjusted: &AdjustedCameras) -> bool {
    adjusted.outlier_shares.iter().any(|share| *share >= MAX_OUTLIERS)
}

fn is_suspicious(adjusted: &AdjustedCameras) -> bool {
    adjusted.scales.iter().any(|scale| *scale > SUSPICIOUS_SCALE)
        // In the mean a right prior is pulled by one per unknown at most.
        || adjusted.pulled > SUSPICIOUS_PULL * adjusted.cameras.len() as f64
}

/// Fits a window with the belief as the prior of clocks and poses.
fn adjust(
    belief: &Belief,
    window: &TrackWindow,
    components: &[usize],
    inflations: &[f64],
) -> Option<AdjustedCameras> {
    let (mean, covariance) = belief.marginal(components);
    let cameras = unknowns(belief, window);
    let sd = |place: usize| covariance[(place, place)].max(0.0).sqrt();
    // The curve covers the bearings' times with every clock off by two deviations.
    let widest = cameras.iter().filter_map(|unknowns| unknowns.clock).map(sd).fold(0.0, f64::max);
    let margin = (2.0 * widest).min(MAX_MARGIN_S);
    let offset = |unknowns: &Unknowns| unknowns.clock.map_or(0.0, |place| mean[place]);
    let offsets: Vec<f64> = cameras.iter().map(offset).collect();
    let times = || window.sights.iter().map(|sight| sight.time_s - offsets[sight.camera]);
    let first = times().fold(f64::INFINITY, f64::min) - margin;
    let last = times().fold(f64::NEG_INFINITY, f64::max) + margin;
    let precision: DMatrix<f64> = covariance.cholesky()?.inverse();
    let epoch_s = belief.epoch()?.seconds_since(window.start);
    let prior = ClockAndPosePrior { mean, precision, epoch_s, cameras };
    // No clock is farther off than `MAX_OFFSET_S`, either way.
    let reach = WINDOW_S + 2.0 * (MAX_OFFSET_S + MAX_MARGIN_S);
    let curve = Curve::over(first, last.min(first + reach));
    Adjustment::new(&window.sights, curve, &prior, inflations).solve(FIRST_DENSITY)
}

#[cfg(test)]
mod tests;
