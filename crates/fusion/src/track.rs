use std::collections::BTreeMap;
use std::fmt;

use crossfix_filter::{Imm, KinematicState};
use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Solver, Timestamp, TrackNumber};
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Matrix3x2, Matrix6x3, Vector2};

use crate::motion::{Detector, Motion, REINITIALISED_POSITION_SD, REINITIALISED_VELOCITY_SD};
use crate::prediction::BearingPrediction;
use crate::spatial::{Fix, Observability, TimedLine, VAGUE_VELOCITY_SD};
use crate::uncertainty::{CameraUncertainty, View};
use crate::watch::independent_share;

/// Two cameras alone must place a target at least this well (m, root of the sum over the axes):
/// nearly parallel lines of two targets cross too.
pub(crate) const MAX_PAIR_SD_M: f64 = 3.0;
/// Rounds of the iterated update; the linearisation mostly holds from the first.
const MAX_ITERATIONS: usize = 5;
/// The linearisation has settled when what a round leaves out, the square of the angle of its step, is
/// less than this share of the bearing's noise.
const SETTLED: f64 = 0.01;
/// Clocks less sure than this shift tracks by more than their bearings' noise, s.
const UNSURE_CLOCK_S: f64 = 2e-3;
/// What a track can be told apart by is looked at this often, s: eigenvalues cost more than an update.
const OBSERVABILITY_INTERVAL_S: f64 = 1.0;
/// A position is observable if it is known better than this, m.
const POSITION_SCALE_M: f64 = 20.0;

/// Identity of a 3D track, unique over restarts: see [`crossfix_message::track_id`]. Shown as its number
/// within its run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TrackId(pub u64);

impl fmt::Display for TrackId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        TrackNumber(self.0).fmt(f)
    }
}

/// The life of a track.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrackStatus {
    /// Begun, and not yet sure.
    Tentative,
    /// Sure.
    Confirmed,
    /// Sure, but not seen of late.
    Coasting,
    /// Given up.
    Lost,
}

/// How well a bearing fitted the track before it was used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasurementResidual {
    /// Capture time of the bearing.
    pub time: Timestamp,
    /// Angle between bearing and prediction, rad.
    pub angle: f64,
    /// Squared Mahalanobis distance, two degrees of freedom.
    pub nis: f64,
    contribution: Contribution,
}

/// What a bearing says of the position, and what is common to it and to its camera's others.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Contribution {
    jacobian: Matrix2x3<f64>,
    /// The bearing's own noise, rad^2.
    own: Matrix2<f64>,
    /// Pose and clock of its camera, rad^2.
    common: Matrix2<f64>,
    /// Standard deviation of its camera's clock, s.
    time_sd_s: f64,
}

/// A bearing that a track has taken in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Taken {
    /// Whether a detector has seen the target begin to manoeuvre.
    pub(crate) manoeuvre: bool,
    /// Squared Mahalanobis distance by the noise that the camera itself has reported.
    pub(crate) reported_nis: f64,
}

/// A target in space, kept up from single bearings of single cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// Its number.
    pub id: TrackId,
    /// The life it leads.
    pub status: TrackStatus,
    /// Capture time of the newest bearing used: the time of [`Self::state`].
    pub updated: Timestamp,
    /// Log-likelihood ratio of being a target against being clutter.
    pub score: f64,
    /// Newest contribution of each camera.
    pub residuals: BTreeMap<CameraName, MeasurementResidual>,
    /// What made the newest update.
    pub solver: Solver,
    /// What the state's covariance says is known; renewed about once a second.
    pub observability: Observability,
    observed: Timestamp,
    held: bool,
    /// When evidence for or against it came last.
    judged: Option<Timestamp>,
    /// What unsure clocks may shift the position by, m^2; `None` where all are sure.
    shift: Option<Matrix3<f64>>,
    /// When its state went out, and as what.
    pub(crate) published: Option<(Timestamp, TrackStatus)>,
    imm: Imm,
    detector: Option<Detector>,
}

/// A bearing against a state: `h(x)`, its derivative by the position, and the noise.
struct Linearised {
    /// Direction to the state's position as an offset from the sight line, rad.
    offset: Vector2<f64>,
    jacobian: Matrix2x3<f64>,
    noise: Matrix2<f64>,
    view: View,
}

impl Linearised {
    /// `None` if the position lies behind the camera.
    fn at(state: &KinematicState, line: &SightLine, camera: &CameraUncertainty) -> Option<Self> {
        let position = state.position();
        let offset = line.tangent_offset(position)?;
        let away = position - line.origin;
        let range = away.norm();
        let direction = away / range;
        let across = (Matrix3::identity() - direction * direction.transpose()) / range;
        let jacobian = line.basis.transpose() * across;
        let view =
            View { direction: line.direction, basis: line.basis, range, rate: jacobian * state.velocity() };
        Some(Self { offset, jacobian, noise: camera.noise(&line.covariance, &view), view })
    }
}

impl Linearised {
    /// Squared Mahalanobis distance of the offset.
    fn distance(&self, spread: Matrix2<f64>) -> Option<f64> {
        Some(self.offset.dot(&spread.cholesky()?.solve(&self.offset)))
    }

    /// The note of this bearing in the track.
    fn residual(
        &self,
        time: Timestamp,
        nis: f64,
        line: &SightLine,
        camera: &CameraUncertainty,
    ) -> MeasurementResidual {
        let contribution = Contribution {
            jacobian: self.jacobian,
            own: line.covariance * camera.factor,
            common: camera.common(&self.view),
            time_sd_s: camera.time_sd_s,
        };
        MeasurementResidual { time, angle: self.offset.norm(), nis, contribution }
    }
}

/// The state after a bearing of its time, with the logarithm of the bearing's likelihood: an
/// iterated extended Kalman update (Gauss-Newton on the posterior density). `None` if the position
/// lies behind the camera or the numbers fail.
pub(crate) fn updated(
    prior: &KinematicState,
    line: &SightLine,
    camera: &CameraUncertainty,
) -> Option<(KinematicState, f64)> {
    let mut mean = prior.mean;
    let mut log_likelihood = None;
    let ties: Matrix6x3<f64> = prior.covariance.fixed_columns::<3>(0).into_owned();
    let mut covariance = prior.covariance;
    for _ in 0..MAX_ITERATIONS {
        let here = KinematicState { mean, covariance: prior.covariance };
        let Linearised { offset, jacobian, noise, view } = Linearised::at(&here, line, camera)?;
        let across = ties * jacobian.transpose();
        let spread = jacobian * across.fixed_rows::<3>(0) + noise;
        let determinant = spread.determinant();
        let inverse = spread.try_inverse()?;
        if determinant.is_nan() || determinant <= 0.0 {
            return None;
        }
        if log_likelihood.is_none() {
            let normaliser = (4.0 * std::f64::consts::PI.powi(2) * determinant).ln();
            log_likelihood = Some(-(offset.dot(&(inverse * offset)) + normaliser) / 2.0);
        }
        let gain = across * inverse;
        let already = (prior.mean - mean).fixed_rows::<3>(0).into_owned();
        let next = prior.mean + gain * (-offset - jacobian * already);
        let moved = (next - mean).fixed_rows::<3>(0).norm();
        mean = next;
        covariance = prior.covariance - gain * across.transpose();
        if (moved / view.range).powi(2) < SETTLED * (noise.trace() / 2.0).sqrt() {
            break;
        }
    }
    let covariance = (covariance + covariance.transpose()) / 2.0;
    let positive = covariance.diagonal().iter().all(|variance| *variance > 0.0);
    positive.then_some((KinematicState { mean, covariance }, log_likelihood?))
}

impl Track {
    /// A tentative track at a fix of these lines.
    pub(crate) fn start<'a>(
        fix: &Fix,
        lines: impl IntoIterator<Item = (&'a CameraName, &'a TimedLine)>,
        motion: &Motion,
    ) -> Self {
        let residual = |(camera, TimedLine { line, time, time_sd_s, .. }): (&CameraName, &TimedLine)| {
            let here = fix.state.predicted(time.seconds_since(fix.time), 0.0);
            let uncertainty = CameraUncertainty::of_time(*time_sd_s);
            let seen = Linearised::at(&here, line, &uncertainty)?;
            let nis = seen.offset.dot(&seen.noise.cholesky()?.solve(&seen.offset));
            Some((camera.clone(), seen.residual(*time, nis, line, &uncertainty)))
        };
        let mut track = Self {
            id: TrackId(0),
            status: TrackStatus::Tentative,
            updated: fix.time,
            score: 0.0,
            residuals: lines.into_iter().filter_map(residual).collect(),
            solver: fix.solver,
            observability: fix.observability,
            observed: fix.time,
            held: true,
            judged: None,
            shift: None,
            published: None,
            imm: Imm::new(fix.state.clone(), motion.models(true)),
            detector: motion.detector(),
        };
        track.shift = track.clock_shift(motion);
        track
    }

    /// Position and velocity at [`Self::updated`].
    pub fn state(&self) -> &KinematicState {
        self.imm.combined()
    }

    /// Root of the sum of the position's variances, m: not less than the deviation along any axis.
    pub(crate) fn position_sd(&self) -> f64 {
        self.state().covariance.diagonal().fixed_rows::<3>(0).sum().sqrt()
    }

    /// Position and velocity expected at another time.
    pub(crate) fn predicted(&self, time: Timestamp, motion: &Motion) -> KinematicState {
        self.imm.predicted(time.seconds_since(self.updated), motion.models(self.held))
    }

    /// Where the target is expected at another time: the mean alone.
    pub(crate) fn position_at(&self, time: Timestamp) -> nalgebra::Point3<f64> {
        let state = self.imm.combined();
        state.position() + state.velocity() * time.seconds_since(self.updated)
    }

    /// The probability of each motion model.
    pub fn model_probabilities(&self) -> &[f64] {
        self.imm.probabilities()
    }

    /// Whether two other cameras than this one have lately seen the target.
    pub(crate) fn is_held_without(&self, camera: &CameraName, motion: &Motion) -> bool {
        let lately = |r: &MeasurementResidual| self.updated.seconds_since(r.time) <= motion.holding_s;
        self.residuals.iter().filter(|(name, r)| *name != camera && lately(r)).count() >= 2
    }

    /// Whether the track is too uncertain for a camera that has not been following it: any line that
    /// crosses another camera's sight line would pass for its target.
    pub(crate) fn is_lost_sight_of_by(&self, camera: &CameraName, motion: &Motion) -> bool {
        let follows = |r: &MeasurementResidual| self.updated.seconds_since(r.time) <= motion.holding_s;
        !self.held && !self.residuals.get(camera).is_some_and(follows) && self.position_sd() > MAX_PAIR_SD_M
    }

    /// What a camera at `origin` should see at a time.
    pub(crate) fn bearing_prediction(
        &self,
        time: Timestamp,
        origin: nalgebra::Point3<f64>,
        camera: &CameraUncertainty,
        motion: &Motion,
    ) -> Option<BearingPrediction> {
        let prediction = BearingPrediction::new(
            &self.imm,
            time.seconds_since(self.updated),
            motion.models(self.held),
            origin,
            camera,
        )?;
        Some(self.shift.iter().fold(prediction, |prediction, shift| prediction.widened(shift)))
    }

    /// A bearing against what is expected at its time, with the covariance of that, rad^2.
    fn innovation(
        &self,
        time: Timestamp,
        line: &SightLine,
        uncertainty: &CameraUncertainty,
        motion: &Motion,
    ) -> Option<(Linearised, Matrix2<f64>)> {
        let before = self.predicted(time, motion);
        let seen = Linearised::at(&before, line, uncertainty)?;
        let known = before.position_covariance() + self.shift.unwrap_or_else(Matrix3::zeros);
        let known = seen.jacobian * known * seen.jacobian.transpose();
        Some((seen, known))
    }

    /// Squared Mahalanobis distance of a bearing by the noise that its camera reports.
    pub(crate) fn reported_nis(
        &self,
        time: Timestamp,
        line: &SightLine,
        uncertainty: &CameraUncertainty,
        motion: &Motion,
    ) -> Option<f64> {
        let (seen, known) = self.innovation(time, line, uncertainty, motion)?;
        seen.distance(known + line.covariance + uncertainty.common(&seen.view))
    }

    /// Takes evidence (a log-likelihood ratio) for or against the track in. Of a sure track it counts
    /// for the time since the evidence before; its score is at most `most`.
    pub(crate) fn judge(&mut self, now: Timestamp, change: f64, most: f64) {
        let share = self.judged.map_or(1.0, |before| independent_share(now.seconds_since(before)));
        self.judged = Some(now);
        let share = if self.is_confirmed() { share } else { 1.0 };
        self.score = (self.score + change * share).min(most);
    }

    /// Takes a bearing in, and tells whether the target has begun to manoeuvre. `None` if the numbers
    /// fail: then no bearing is taken in, though a detector may have widened the covariance.
    pub(crate) fn measurement_update(
        &mut self,
        camera: &CameraName,
        line: &SightLine,
        (time, uncertainty): (Timestamp, &CameraUncertainty),
        motion: &Motion,
    ) -> Option<Taken> {
        let interval = time.seconds_since(self.updated);
        let (seen, known) = self.innovation(time, line, uncertainty, motion)?;
        let nis = seen.distance(known + seen.noise)?;
        let reported_nis = seen.distance(known + line.covariance + uncertainty.common(&seen.view))?;
        let manoeuvre = self.detector.as_mut().is_some_and(|detector| match detector {
            Detector::Residual(detector) => {
                let in_deviations = line.basis * -seen.offset / line.standard_deviation();
                detector.see(in_deviations)
            }
            Detector::Innovation(detector) => detector.see(nis, 2),
        });
        if manoeuvre {
            self.imm.reinitialise(REINITIALISED_POSITION_SD, REINITIALISED_VELOCITY_SD);
        }
        self.imm.update(interval, motion.models(self.held), |state| updated(state, line, uncertainty))?;
        self.updated = time;
        self.solver = Solver::Kalman;
        let residual = seen.residual(time, nis, line, uncertainty);
        if let Some(newest) = self.residuals.get_mut(camera) {
            *newest = residual;
        } else {
            self.residuals.insert(camera.clone(), residual);
        }
        self.held = self.cameras_lately(motion.holding_s) >= 2;
        if self.shift.is_some() || uncertainty.time_sd_s >= UNSURE_CLOCK_S {
            self.shift = self.clock_shift(motion);
        }
        Some(Taken { manoeuvre, reported_nis })
    }

    /// Position and velocity expected at a time, with all that is uncertain: what the cameras' poses
    /// and clocks shift all bearings by is not averaged away by more of them.
    pub(crate) fn honest(&self, time: Timestamp, motion: &Motion) -> KinematicState {
        let mut state = self.predicted(time, motion);
        let recent = |r: &&MeasurementResidual| self.updated.seconds_since(r.time) <= motion.holding_s;
        let parts: Vec<&Contribution> =
            self.residuals.values().filter(recent).map(|r| &r.contribution).collect();
        if parts.iter().all(|part| part.common.amax() <= 0.0) {
            return state;
        }
        // The position that one bearing of each camera gives, and how each camera's shift moves it.
        let weighed = |part: &&Contribution| Some(part.jacobian.transpose() * part.own.try_inverse()?);
        let weights: Vec<Matrix3x2<f64>> = parts.iter().filter_map(weighed).collect();
        let information: Matrix3<f64> =
            weights.iter().zip(&parts).map(|(weight, part)| weight * part.jacobian).sum();
        if let Some(spread) = information.try_inverse().filter(|_| weights.len() == parts.len()) {
            let mut shifted = Matrix3::zeros();
            for (weight, part) in weights.iter().zip(&parts) {
                let moves = spread * weight;
                shifted += moves * part.common * moves.transpose();
            }
            // Covariances that no camera has make weights that are no numbers.
            if shifted.iter().all(|v| v.is_finite()) {
                let mut position = state.covariance.fixed_view_mut::<3, 3>(0, 0);
                position += shifted;
            }
        }
        state
    }

    /// What the clocks that are not sure may shift the position by, m^2. The filter takes such a shift
    /// for noise of each bearing and averages it away; a camera that joins would find the target
    /// outside its gate.
    fn clock_shift(&self, motion: &Motion) -> Option<Matrix3<f64>> {
        let recent = |r: &&MeasurementResidual| self.updated.seconds_since(r.time) <= motion.holding_s;
        let parts = || self.residuals.values().filter(recent).map(|r| &r.contribution);
        if parts().all(|part| part.time_sd_s < UNSURE_CLOCK_S) {
            return None;
        }
        let mut information = Matrix3::zeros();
        let mut shifted = Matrix3::zeros();
        for Contribution { jacobian, own, common, .. } in parts() {
            let weight = jacobian.transpose() * (own + common).try_inverse()?;
            information += weight * jacobian;
            shifted += weight * common * weight.transpose();
        }
        let spread = information.try_inverse()?;
        Some(spread * shifted * spread).filter(|shift| shift.iter().all(|value| value.is_finite()))
    }

    /// Cameras that have given a bearing within the last seconds before [`Self::updated`].
    fn cameras_lately(&self, seconds: f64) -> usize {
        let lately = |r: &&MeasurementResidual| self.updated.seconds_since(r.time) <= seconds;
        self.residuals.values().filter(lately).count()
    }

    /// Whether two cameras have lately seen the target. One alone tells nothing of the range, and
    /// the track may run along its sight lines.
    pub fn is_held(&self) -> bool {
        self.held
    }

    /// Looks at what the covariance tells apart if that was a second ago.
    pub(crate) fn observe_again(&mut self) {
        if self.updated.seconds_since(self.observed) >= OBSERVABILITY_INTERVAL_S {
            self.observe();
        }
    }

    /// Looks at what the covariance tells apart.
    pub(crate) fn observe(&mut self) {
        self.observed = self.updated;
        if let Some(information) = self.state().covariance.try_inverse() {
            self.observability =
                Observability::of_information(&information, POSITION_SCALE_M, VAGUE_VELOCITY_SD);
        }
    }

    /// Whether it was confirmed once and is not lost.
    pub fn is_confirmed(&self) -> bool {
        matches!(self.status, TrackStatus::Confirmed | TrackStatus::Coasting)
    }
}

#[cfg(test)]
mod tests;
