//! How a target moves in the image, and how far beside it its reference is found.
//!
//! An axis has three states: position, velocity, and the reference's offset: the reference is found
//! at the target's place and that offset. The noise of the images that the reference was made of is
//! in all measurements alike, and an image that is learned at an estimated place takes that
//! estimate's error along: no mean over images takes these out, and a filter without the offset
//! believes that it does.
//!
//! How lively a target is nobody knows beforehand. So there is a filter for each of some ways of
//! moving, from evenly to as lively as anything flies, weighted by how well each has predicted
//! (interacting multiple models, Solonar 2023, eqs. 10-17; there of a pixel's brightness).

use crossfix_filter::{AxisMeasurement, normal_score};
use nalgebra::{Matrix2, Matrix3, RowVector3, Vector3};

use crate::ImagePoint;

const WAYS: usize = 4;
/// The ways of moving: white acceleration's standard deviation as a share of the liveliest. With a
/// factor of five between neighbours none predicts much worse than the right one would; the last
/// flies evenly.
const LIVELINESS: [f64; WAYS] = [1.0, 0.2, 0.04, 0.0];
/// How often a target goes over to another way, drawn from all alike, 1/s. With a tenth of it the
/// first images of a turn come as surprises, and when it was chosen 2.3 % of the frames of ten
/// seeds' sequences were lost with it in place of 1.7; with ten times as much 2.1.
const CHANGES_PER_S: f64 = 0.5;
/// Of a target that is taken up or found again nobody knows whether it flies evenly: it is lively
/// until it has shown that it is not.
const AT_FIRST: [f64; WAYS] = [1.0, 0.0, 0.0, 0.0];

/// Over how long the measurements' noise is matched to the innovations, s: some hundred of them, so
/// that chance changes it by a few hundredths. Reasoned: with half of it by half as much again,
/// with twice as much a target that comes before another sky is believed for seconds as it was
/// before this one.
const MATCHED_S: f64 = 3.0;
/// What was expected counts like innovations of so long, s: the first dozen of them, which tell a
/// third.
const AT_LEAST_S: f64 = 0.5;
/// How strongly it is drawn to what was expected, of e times which it is off: where innovations
/// tell little of the noise, as the target's own motion is most of them, nothing else keeps it.
/// With three times as much the noise that is found of even and of lively targets changes by less
/// than 4 %.
const AS_EXPECTED: f64 = 0.01;
/// The squared normalised innovation of both axes that one in a hundred exceeds: one image counts
/// for no more.
const OUTLIER: f64 = 9.21;
/// The noise as it is matched is at most so many times more or less than was expected, variances: a
/// hundred times in its deviation, from a pixel's hundredth to a pixel.
const MOST_MATCHED: f64 = 1e4;

/// The states of an axis, by their places.
const POSITION: usize = 0;
const VELOCITY: usize = 1;
const OFFSET: usize = 2;
/// Where the reference is found: position plus offset.
const FOUND_AT: RowVector3<f64> = RowVector3::new(1.0, 0.0, 1.0);

/// Position, velocity and offset on one axis.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Axis {
    mean: Vector3<f64>,
    covariance: Matrix3<f64>,
}

/// What the filters of a target believe of its motion.
#[derive(Clone, Debug)]
pub(crate) struct Motion {
    /// The axes of each way of moving.
    ways: [[Axis; 2]; WAYS],
    weights: [f64; WAYS],
    /// Variance of the measurements' noise over what it was expected to be, as the innovations have
    /// it.
    noise_factor: f64,
    /// Over how long it has been matched, s.
    matched_s: f64,
    /// Time over which was predicted last, s.
    interval: f64,
    /// Mean and covariance over the ways.
    all: [Axis; 2],
    /// What a pixel of difference between measured and predicted has changed since the last
    /// prediction, a way and an axis, and that measurement's variances.
    gains: [[Vector3<f64>; 2]; WAYS],
    measured: [f64; 2],
    /// The noise's share in that measurement's innovations, by the ways that are likely now.
    told: f64,
    /// Acceleration variances of the ways, px^2/s^4.
    accelerations: [f64; WAYS],
    /// Variance that the noise of the learned images has in the offset and that is not in the
    /// covariances yet, in units of one measurement's, which is not known before the first one.
    untold: f64,
}

/// What one image says of where the reference is found.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Evidence {
    /// The probability that it is at the place that was measured, with that measurement.
    pub(crate) near: f64,
    pub(crate) at: [AxisMeasurement; 2],
    /// The same of anywhere else.
    pub(crate) elsewhere: f64,
    pub(crate) elsewhere_at: [AxisMeasurement; 2],
}

impl Evidence {
    /// A measurement that is not doubted.
    pub(crate) fn of(at: [AxisMeasurement; 2]) -> Self {
        Self { near: 1.0, at, elsewhere: 0.0, elsewhere_at: at }
    }
}

impl Axis {
    fn found(&self) -> AxisMeasurement {
        let position = self.mean[POSITION] + self.mean[OFFSET];
        AxisMeasurement {
            position,
            variance: (FOUND_AT * self.covariance * FOUND_AT.transpose()).x,
        }
    }

    /// Moments of a mixture of two.
    fn mixed(&self, share: f64, other: &Self) -> Self {
        let rest = 1.0 - share;
        let apart = self.mean - other.mean;
        let covariance = self.covariance * share
            + other.covariance * rest
            + apart * apart.transpose() * (share * rest);
        Self { mean: self.mean * share + other.mean * rest, covariance }
    }

    /// Constant velocity with white acceleration that is constant over the interval (Herasymenko
    /// 2021, eqs. 8 and 10; erratum: its variance).
    fn predict(&mut self, interval: f64, acceleration: f64) {
        self.mean[POSITION] += interval * self.mean[VELOCITY];
        let p = &mut self.covariance;
        let along = p.column(VELOCITY) * interval;
        p.set_column(POSITION, &(p.column(POSITION) + along));
        let across = p.row(VELOCITY) * interval;
        p.set_row(POSITION, &(p.row(POSITION) + across));
        let driven = Vector3::new(interval * interval / 2.0, interval, 0.0);
        *p += driven * driven.transpose() * acceleration;
    }

    /// What a change of where the reference is found says of the states.
    fn slope(&self) -> Vector3<f64> {
        let with_found = self.covariance * FOUND_AT.transpose();
        with_found / (FOUND_AT * with_found).x.max(f64::MIN_POSITIVE)
    }

    /// Replaces what is known of where the reference is found; the states follow by regression.
    fn condition(&mut self, found: AxisMeasurement) {
        let (slope, before) = (self.slope(), self.found());
        self.mean += slope * (found.position - before.position);
        self.covariance += slope * slope.transpose() * (found.variance - before.variance);
        self.covariance = (self.covariance + self.covariance.transpose()) / 2.0;
    }
}

impl Motion {
    /// Of a target whose place, given for both axes, has become its reference's middle: how far it
    /// is off, the reference is off the other way, so that the reference is found where the target
    /// is.
    pub(crate) fn at_rest(
        given: [AxisMeasurement; 2],
        velocity_sd: f64,
        acceleration_sd: f64,
    ) -> Self {
        let all = given.map(|AxisMeasurement { position, variance }| {
            let off = Vector3::new(1.0, 0.0, -1.0);
            let mut covariance = off * off.transpose() * variance;
            covariance[(VELOCITY, VELOCITY)] = velocity_sd.powi(2);
            Axis { mean: Vector3::new(position, 0.0, 0.0), covariance }
        });
        Self {
            ways: [all; WAYS],
            weights: AT_FIRST,
            noise_factor: 1.0,
            matched_s: 0.0,
            interval: 0.0,
            all,
            gains: [[Vector3::zeros(); 2]; WAYS],
            measured: [0.0; 2],
            told: 0.0,
            accelerations: LIVELINESS.map(|share| (share * acceleration_sd).powi(2)),
            untold: 1.0,
        }
    }

    /// Starts anew where the reference is found; its offset stays known as it was.
    pub(crate) fn restart(&mut self, found: [AxisMeasurement; 2], velocity_sd: f64) {
        for (axis, AxisMeasurement { position, variance }) in self.all.iter_mut().zip(found) {
            let (offset, known) = (axis.mean[OFFSET], axis.covariance[(OFFSET, OFFSET)]);
            axis.mean = Vector3::new(position - offset, 0.0, offset);
            axis.covariance =
                Matrix3::from_diagonal(&Vector3::new(known + variance, velocity_sd.powi(2), known));
            (axis.covariance[(POSITION, OFFSET)], axis.covariance[(OFFSET, POSITION)]) =
                (-known, -known);
        }
        self.ways = [self.all; WAYS];
        self.weights = AT_FIRST;
        (self.gains, self.measured) = ([[Vector3::x(); 2]; WAYS], found.map(|at| at.variance));
    }

    /// Starts from a second place that somebody knows, `interval` seconds after the first one
    /// (Herasymenko 2021, eqs. 13-14).
    pub(crate) fn start(&mut self, second: [AxisMeasurement; 2], interval: f64) {
        for i in 0..2 {
            let first = self.all[i];
            let first_variance = first.covariance[(OFFSET, OFFSET)];
            let (at, variance) = (second[i].position, second[i].variance);
            for (way, acceleration) in self.ways.iter_mut().zip(self.accelerations) {
                let axis = &mut way[i];
                axis.mean[POSITION] = at;
                axis.mean[VELOCITY] = (at - first.mean[POSITION]) / interval;
                // The errors of both places, by what they become.
                let of_first = Vector3::new(0.0, -1.0 / interval, -1.0);
                let of_second = Vector3::new(1.0, 1.0 / interval, 0.0);
                axis.covariance = of_first * of_first.transpose() * first_variance
                    + of_second * of_second.transpose() * variance;
                axis.covariance[(VELOCITY, VELOCITY)] += acceleration * interval * interval / 4.0;
            }
        }
        self.combine();
    }

    /// Starts anew at a place that somebody knows; the reference's offset stays known as it was.
    pub(crate) fn restart_at(&mut self, given: [AxisMeasurement; 2], velocity_sd: f64) {
        for (axis, AxisMeasurement { position, variance }) in self.all.iter_mut().zip(given) {
            axis.mean = Vector3::new(position, 0.0, axis.mean[OFFSET]);
            let offset = axis.covariance[(OFFSET, OFFSET)];
            axis.covariance =
                Matrix3::from_diagonal(&Vector3::new(variance, velocity_sd.powi(2), offset));
        }
        self.ways = [self.all; WAYS];
        self.weights = AT_FIRST;
        self.gains = Default::default();
    }

    /// Takes in where the target is, which somebody knows.
    pub(crate) fn take_place(&mut self, given: [AxisMeasurement; 2]) {
        for way in &mut self.ways {
            for (axis, given) in way.iter_mut().zip(given) {
                let variance = axis.covariance[(POSITION, POSITION)] + given.variance;
                let gain = axis.covariance.column(POSITION) / variance;
                axis.mean += gain * (given.position - axis.mean[POSITION]);
                axis.covariance -= gain * gain.transpose() * variance;
            }
        }
        self.gains = Default::default();
        self.combine();
    }

    /// Moves on; a target that leaves the picture, of given sides, is waited for at its border.
    pub(crate) fn predict(&mut self, interval: f64, sides: [usize; 2]) {
        let stays = (-CHANGES_PER_S * interval).exp();
        let drawn = (1.0 - stays) / WAYS as f64;
        for ((way, weight), acceleration) in
            self.ways.iter_mut().zip(&mut self.weights).zip(self.accelerations)
        {
            let stayed = stays * *weight;
            *weight = stayed + drawn;
            for (axis, all) in way.iter_mut().zip(&self.all) {
                *axis = axis.mixed(stayed / *weight, all);
                axis.predict(interval, acceleration);
            }
        }
        self.gains = Default::default();
        self.interval = interval;
        self.combine();
        for (i, side) in sides.into_iter().enumerate() {
            let edge = side as f64 - 1.0;
            if !(0.0..=edge).contains(&self.all[i].mean[POSITION]) {
                let held = self.all[i].mean[POSITION].clamp(0.0, edge);
                for axis in self.ways.iter_mut().map(|way| &mut way[i]).chain([&mut self.all[i]]) {
                    (axis.mean[POSITION], axis.mean[VELOCITY]) = (held, 0.0);
                }
            }
        }
    }

    fn combine(&mut self) {
        for i in 0..2 {
            let mut mean = Vector3::zeros();
            for (way, weight) in self.ways.iter().zip(self.weights) {
                mean += way[i].mean * weight;
            }
            let mut covariance = Matrix3::zeros();
            for (way, weight) in self.ways.iter().zip(self.weights) {
                let apart = way[i].mean - mean;
                covariance += (way[i].covariance + apart * apart.transpose()) * weight;
            }
            self.all[i] = Axis { mean, covariance };
        }
    }

    /// Where the target is believed to be.
    pub(crate) fn position(&self) -> ImagePoint {
        let [x, y] = self.all.map(|axis| axis.mean[POSITION]);
        ImagePoint { x, y }
    }

    /// How fast it is believed to move, px/s.
    pub(crate) fn velocity(&self) -> ImagePoint {
        let [x, y] = self.all.map(|axis| axis.mean[VELOCITY]);
        ImagePoint { x, y }
    }

    /// Covariance of position and velocity on either axis.
    pub(crate) fn covariances(&self) -> [Matrix2<f64>; 2] {
        self.all.map(|axis| axis.covariance.fixed_view::<2, 2>(POSITION, POSITION).into_owned())
    }

    /// Where the reference is expected to be found.
    pub(crate) fn found(&self) -> [AxisMeasurement; 2] {
        self.all.map(|axis| axis.found())
    }

    /// How far the reference is found beside the target.
    pub(crate) fn offset(&self) -> [AxisMeasurement; 2] {
        self.all.map(|axis| AxisMeasurement {
            position: axis.mean[OFFSET],
            variance: axis.covariance[(OFFSET, OFFSET)],
        })
    }

    /// Squared normalised innovation of a measurement, of both axes: chi-square with two degrees of
    /// freedom if all is well.
    pub(crate) fn surprise(&self, at: [AxisMeasurement; 2]) -> f64 {
        let axis = |i: usize| {
            let mut parts = [(0.0, at[i]); WAYS];
            for ((part, way), weight) in parts.iter_mut().zip(&self.ways).zip(self.weights) {
                let AxisMeasurement { position, variance } = way[i].found();
                *part = (weight, AxisMeasurement { position, variance: variance + at[i].variance });
            }
            normal_score(at[i].position, parts).powi(2)
        };
        axis(0) + axis(1)
    }

    /// Variance of the measurements' noise over what it was expected to be.
    pub(crate) fn noise_factor(&self) -> f64 {
        self.noise_factor
    }

    /// Matches the noise to the innovation of the last update, whose square of both axes is given:
    /// as far as it tells the noise.
    pub(crate) fn match_noise(&mut self, surprise: f64) {
        self.matched_s = (self.matched_s + self.interval).min(MATCHED_S);
        let share = (self.interval / (self.matched_s + AT_LEAST_S)).min(1.0);
        let more =
            self.told * (surprise.min(OUTLIER) / 2.0 - 1.0) - AS_EXPECTED * self.noise_factor.ln();
        let factor = self.noise_factor * (1.0 + share * more);
        self.noise_factor = factor.clamp(1.0 / MOST_MATCHED, MOST_MATCHED);
    }

    /// Takes the first measurement's variance for what the noise of each learned image has in the
    /// offset.
    pub(crate) fn tell_noise(&mut self, variances: [f64; 2]) {
        if self.untold <= 0.0 {
            return;
        }
        let untold = std::mem::take(&mut self.untold);
        for axes in self.ways.iter_mut().chain([&mut self.all]) {
            for (axis, variance) in axes.iter_mut().zip(variances) {
                axis.covariance[(OFFSET, OFFSET)] += untold * variance;
            }
        }
    }

    /// Takes in what an image says of where the reference is found: each axis becomes the mixture
    /// of near, elsewhere and not seen, by its mean and variance.
    pub(crate) fn update(&mut self, evidence: &Evidence) {
        let Evidence { near, at, elsewhere, elsewhere_at } = *evidence;
        self.measured = at.map(|at| at.variance);
        // L_w = N(z; H x_w, H P_w H' + R): how well each way of moving has predicted what is
        // measured, by its logarithm so that none underflows.
        let likelihoods = [0, 1, 2, 3].map(|way: usize| {
            let axis = |i: usize| {
                let prior = self.ways[way][i].found();
                let variance = prior.variance + at[i].variance;
                -0.5 * ((at[i].position - prior.position).powi(2) / variance + variance.ln())
            };
            axis(0) + axis(1)
        });
        let largest = likelihoods.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let likelihoods = likelihoods.map(|logarithm| (logarithm - largest).exp());
        let mean: f64 = likelihoods.iter().zip(self.weights).map(|(l, w)| l * w).sum();
        let mut told = [0.0; WAYS];
        for (way, weight) in self.weights.iter_mut().enumerate() {
            // Bayes' rule for the ways' weights, for as much of the posterior as measured anything.
            if mean > f64::MIN_POSITIVE {
                *weight *= near * likelihoods[way] / mean + (1.0 - near);
            }
            for i in 0..2 {
                let axis = &mut self.ways[way][i];
                let prior = axis.found();
                // The Kalman update K = P / (P + R) of where the reference is found ...
                let gain = prior.variance / (prior.variance + at[i].variance);
                told[way] += (1.0 - gain) / 2.0;
                let here = AxisMeasurement {
                    position: prior.position + gain * (at[i].position - prior.position),
                    variance: (1.0 - gain) * prior.variance,
                };
                // ... is one of three parts of a mixture, which is replaced by its mean and variance.
                let parts =
                    [(near, here), (elsewhere, elsewhere_at[i]), (1.0 - near - elsewhere, prior)];
                let position: f64 = parts.iter().map(|(mass, part)| mass * part.position).sum();
                let spread = |(mass, part): &(f64, AxisMeasurement)| {
                    mass * (part.variance + (part.position - position).powi(2))
                };
                let variance = parts.iter().map(spread).sum::<f64>().min(4.0 * prior.variance);
                // What of the measurement comes into the position itself: the rest is the offset's.
                self.gains[way][i] = axis.slope() * (near * gain);
                axis.condition(AxisMeasurement { position, variance });
            }
        }
        let total: f64 = self.weights.iter().sum();
        self.weights.iter_mut().for_each(|weight| *weight /= total);
        self.told = told.iter().zip(self.weights).map(|(told, weight)| told * weight).sum();
        self.combine();
    }

    /// Replaces what is known of where the reference is found, on both axes.
    pub(crate) fn condition(&mut self, found: [AxisMeasurement; 2]) {
        for (way, gains) in self.ways.iter_mut().zip(&mut self.gains) {
            for i in 0..2 {
                let gain = (1.0 - found[i].variance / way[i].found().variance).max(0.0);
                gains[i] = way[i].slope() * gain;
                way[i].condition(found[i]);
            }
        }
        self.measured = found.map(|at| at.variance);
        self.combine();
    }

    /// An image has been learned at a place with a share of the reference; it was measured there
    /// with some variances.
    ///
    /// It shows the target where its noise v puts it, `x + v - place` beside its middle, so that
    /// the offset becomes `(1 - share) b + share (place - x - v)`. The estimate of x has taken in
    /// the same v by its gain.
    pub(crate) fn learn(&mut self, place: ImagePoint, share: f64, variances: Option<[f64; 2]>) {
        let shifted = Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, -share, 0.0, 1.0 - share);
        // What is learned with a variance is told with it.
        let new = if variances.is_none() { share * share } else { 0.0 };
        self.untold = (1.0 - share).powi(2) * self.untold + new;
        let place = [place.x, place.y];
        for (way, gains) in self.ways.iter_mut().zip(&self.gains) {
            for i in 0..2 {
                let axis = &mut way[i];
                let off = place[i] - axis.mean[POSITION];
                axis.mean[OFFSET] += share * (off - axis.mean[OFFSET]);
                let new = Vector3::new(0.0, 0.0, share);
                let known = shifted * gains[i] * new.transpose();
                axis.covariance = shifted * axis.covariance * shifted.transpose();
                if let Some(variances) = variances {
                    axis.covariance += (known + known.transpose())
                        * variances[i].min(self.measured[i])
                        + new * new.transpose() * variances[i];
                }
            }
        }
        self.combine();
    }

    /// Less is known of position and velocity than the filters believe.
    pub(crate) fn inflate(&mut self, factor: f64) {
        let root = factor.sqrt();
        let wider = Matrix3::from_diagonal(&Vector3::new(root, root, 1.0));
        for axis in self.ways.iter_mut().flatten() {
            axis.covariance = wider * axis.covariance * wider;
        }
        self.combine();
    }

    /// Moves the origin of both axes: what was at a place is at that plus `by`, and all else stays.
    pub(crate) fn move_by(&mut self, by: [f64; 2]) {
        for axes in self.ways.iter_mut().chain([&mut self.all]) {
            for (axis, by) in axes.iter_mut().zip(by) {
                axis.mean[POSITION] += by;
            }
        }
    }
}

#[cfg(test)]
mod tests;
