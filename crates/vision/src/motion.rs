//! Motion of a target in the image, with the offset at which its reference is found.
//!
//! Each axis has three states: position, velocity, and the reference's offset: the reference is
//! found at the target's position plus that offset. Two errors are common to all measurements: the
//! noise of the images that the reference was made of, and, for an image that is learned at an
//! estimated place, the error of that estimate. Averaging over images removes neither; a filter
//! without the offset state believes that it does, and becomes overconfident.
//!
//! How strongly a target accelerates is not known beforehand. So there is one filter per motion
//! model ("way of moving"), from constant velocity to the acceleration of the liveliest flying
//! target, weighted by how well each has predicted (interacting multiple models, Solonar 2023, eqs.
//! 10-17; there of a pixel's brightness).

mod axis;

use crossfix_filter::{AxisMeasurement, normal_score};
use nalgebra::{Matrix2, Matrix3, Vector3};

use self::axis::{AxisMotion, OFFSET, POSITION, VELOCITY};
use crate::ImagePoint;

/// Number of motion models: each costs a filter per axis. With half of it the lively and the still
/// one are left, and a target of a motion between has a filter that is five times off.
const WAYS: usize = 4;
/// Standard deviation of each motion model's white acceleration, as a share of the largest. With a
/// factor of five between neighbours the nearest model predicts not much worse than the exact one
/// would; the last is constant velocity. With half of each the liveliest turns exceed every model.
const LIVELINESS: [f64; WAYS] = [1.0, 0.2, 0.04, 0.0];
/// Rate at which a target changes its motion model, 1/s; the new model is drawn from all models
/// with equal probability. With a tenth of it the first images of a turn come as surprises, and
/// when it was chosen 2.3 % of the frames of ten seeds' sequences were lost instead of 1.7; with
/// ten times as much 2.1.
const CHANGES_PER_S: f64 = 0.5;
/// Model weights of a target that is taken up or found again: nobody knows whether it flies evenly,
/// so all weight is on the largest acceleration until the images show otherwise. With half of it on
/// an even model a target that turns as it is taken up is predicted beside it.
const AT_FIRST: [f64; WAYS] = [1.0, 0.0, 0.0, 0.0];

/// Averaging time of the match of the measurement noise to the innovations, s: some hundred
/// innovations, so that chance changes the noise by a few hundredths. Reasoned: with half of it
/// chance changes it by half as much again; with twice as much a target that comes before another
/// sky keeps for seconds the noise that it had before the old one.
const MATCHED_S: f64 = 3.0;
/// Weight of the expected noise, as a time of innovations, s: it counts as much as the first dozen
/// innovations, which show the noise to a third. With half of it the first innovation alone may
/// change the variance by 42 % instead of 23, at 30 per second.
const AT_LEAST_S: f64 = 0.5;
/// How strongly the noise factor is pulled back to the expected noise, per unit of its logarithm.
/// Where the target's own motion makes up most of the innovations they say little of the noise,
/// and nothing else keeps the factor in place. With three times as much the noise found for even
/// and for lively targets changes by less than 4 %.
const AS_EXPECTED: f64 = 0.01;
/// Squared normalised innovation of both axes that one image in a hundred exceeds: the noise is
/// matched to no more than this. With half of it one in ten would be cut, and the noise found a
/// tenth too small.
const OUTLIER: f64 = 9.21;
/// The matched noise variance is at most this many times larger or smaller than the expected one: a
/// factor of a hundred in the standard deviation, from a hundredth of a pixel to a pixel. With half
/// of it the same but for a factor of 71.
const MOST_MATCHED: f64 = 1e4;

/// Interacting multiple model filter of a target's motion in the image.
#[derive(Clone, Debug)]
pub(crate) struct ImageMotion {
    /// State of both axes under each motion model.
    ways: [[AxisMotion; 2]; WAYS],
    weights: [f64; WAYS],
    /// Variance of the measurement noise over the expected one, as matched to the innovations.
    noise_factor: f64,
    /// Time over which it has been matched, s; at most `MATCHED_S`.
    matched_s: f64,
    /// Interval of the last prediction, s.
    interval: f64,
    /// Mean and covariance of the mixture of all models.
    all: [AxisMotion; 2],
    /// Kalman gain of the update since the last prediction, per model and axis: change of the
    /// states per pixel between measured and predicted. And the variances of that measurement.
    gains: [[Vector3<f64>; 2]; WAYS],
    measured: [f64; 2],
    /// Share of the measurement noise in the variance of that measurement's innovation, averaged
    /// over the models by their weights.
    noise_share: f64,
    /// Acceleration variance of each model, px^2/s^4.
    accelerations: [f64; WAYS],
    /// Variance in the offset from the noise of the learned images that is not yet in the
    /// covariances, in units of one measurement's variance, which is unknown before the first one.
    offset_noise: f64,
}

/// Measurement of where the reference is found in one image, as parts of a mixture.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlaceEvidence {
    /// Probability that the reference is at the measured place, and that measurement.
    pub(crate) near: f64,
    pub(crate) at: [AxisMeasurement; 2],
    /// Probability that it is anywhere else, with mean and variance over those places.
    pub(crate) elsewhere: f64,
    pub(crate) elsewhere_at: [AxisMeasurement; 2],
}

impl ImageMotion {
    /// Motion of a target at rest, whose given place, on both axes, has become the middle of its
    /// reference. The error of the given place is in the position and with the opposite sign in the
    /// offset, so that it cancels in where the reference is found.
    pub(crate) fn at_rest(
        given: [AxisMeasurement; 2],
        velocity_sd: f64,
        acceleration_sd: f64,
    ) -> Self {
        let all = given.map(|given| AxisMotion::at_rest(given, velocity_sd));
        Self {
            ways: [all; WAYS],
            weights: AT_FIRST,
            noise_factor: 1.0,
            matched_s: 0.0,
            interval: 0.0,
            all,
            gains: [[Vector3::zeros(); 2]; WAYS],
            measured: [0.0; 2],
            noise_share: 0.0,
            accelerations: LIVELINESS.map(|share| (share * acceleration_sd).powi(2)),
            offset_noise: 1.0,
        }
    }

    /// The same motion, all of whose models are the liveliest one.
    pub(crate) fn of_the_liveliest(self) -> Self {
        Self { accelerations: [self.accelerations[0]; WAYS], ..self }
    }

    /// Restarts at rest where the reference is found; what is known of its offset is kept.
    pub(crate) fn restart(&mut self, found: [AxisMeasurement; 2], velocity_sd: f64) {
        for (axis, AxisMeasurement { position, variance }) in self.all.iter_mut().zip(found) {
            let (offset, known) = (axis.mean[OFFSET], axis.covariance[(OFFSET, OFFSET)]);
            // position = found - offset, so the offset's error is in it with the opposite sign.
            axis.mean = Vector3::new(position - offset, 0.0, offset);
            axis.covariance =
                Matrix3::from_diagonal(&Vector3::new(known + variance, velocity_sd.powi(2), known));
            (axis.covariance[(POSITION, OFFSET)], axis.covariance[(OFFSET, POSITION)]) =
                (-known, -known);
        }
        self.ways = [self.all; WAYS];
        self.weights = AT_FIRST;
        // The place is the measurement itself: a gain of 1 in the position, 0 in the other states.
        (self.gains, self.measured) = ([[Vector3::x(); 2]; WAYS], found.map(|at| at.variance));
    }

    /// Starts position and velocity from a second place that somebody knows, `interval` seconds
    /// after the first one (Herasymenko 2021, eqs. 13-14).
    pub(crate) fn start(&mut self, second: [AxisMeasurement; 2], interval: f64) {
        for i in 0..2 {
            let first = self.all[i];
            // The first place's error is the offset's, with the opposite sign (`at_rest`).
            let first_variance = first.covariance[(OFFSET, OFFSET)];
            let (at, variance) = (second[i].position, second[i].variance);
            for (way, acceleration) in self.ways.iter_mut().zip(self.accelerations) {
                let axis = &mut way[i];
                axis.mean[POSITION] = at;
                axis.mean[VELOCITY] = (at - first.mean[POSITION]) / interval;
                // How the error of each place enters position, velocity and offset.
                let of_first = Vector3::new(0.0, -1.0 / interval, -1.0);
                let of_second = Vector3::new(1.0, 1.0 / interval, 0.0);
                axis.covariance = of_first * of_first.transpose() * first_variance
                    + of_second * of_second.transpose() * variance;
                // The last term of eq. 14: sigma_a^2 T^2 / 4.
                axis.covariance[(VELOCITY, VELOCITY)] += acceleration * interval * interval / 4.0;
            }
        }
        self.combine();
    }

    /// Restarts at rest at a place that somebody knows; what is known of the reference's offset is
    /// kept.
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

    /// Kalman update with the target's own place, which somebody knows: H = [1 0 0], without the
    /// offset.
    pub(crate) fn take_place(&mut self, given: [AxisMeasurement; 2]) {
        for way in &mut self.ways {
            for (axis, given) in way.iter_mut().zip(given) {
                // S = P11 + R, K = P e1 / S, P -= K S K'.
                let variance = axis.covariance[(POSITION, POSITION)] + given.variance;
                let gain = axis.covariance.column(POSITION) / variance;
                axis.mean += gain * (given.position - axis.mean[POSITION]);
                axis.covariance -= gain * gain.transpose() * variance;
            }
        }
        self.gains = Default::default();
        self.combine();
    }

    /// Predicts to the next image. A target that leaves the picture, of given sides, is kept at its
    /// border with velocity zero.
    pub(crate) fn predict(&mut self, interval: f64, sides: [usize; 2]) {
        // IMM mixing: w = stays w + (1 - stays) / WAYS, the second part drawn from the mixture of
        // all.
        let stays = (-CHANGES_PER_S * interval).exp();
        let drawn = (1.0 - stays) / WAYS as f64;
        for ((way, weight), acceleration) in
            self.ways.iter_mut().zip(&mut self.weights).zip(self.accelerations)
        {
            let stayed = stays * *weight;
            *weight = stayed + drawn;
            for (axis, all) in way.iter_mut().zip(&self.all) {
                // Given that the model holds now, it held before with probability stayed / w;
                // otherwise the state is drawn from the mixture.
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
                // Every model is put at the border, so that the mixture is there too.
                let at_border = self.all[i].mean[POSITION].clamp(0.0, edge);
                for axis in self.ways.iter_mut().map(|way| &mut way[i]).chain([&mut self.all[i]]) {
                    (axis.mean[POSITION], axis.mean[VELOCITY]) = (at_border, 0.0);
                }
            }
        }
    }

    fn combine(&mut self) {
        // Moments of a mixture: x = sum w_i x_i, P = sum w_i (P_i + d_i d_i'), d_i = x_i - x.
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
            self.all[i] = AxisMotion { mean, covariance };
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

    /// Where the reference is expected to be found, with the variance of that.
    pub(crate) fn found(&self) -> [AxisMeasurement; 2] {
        self.all.map(|axis| axis.found())
    }

    /// Offset of where the reference is found from where the target is.
    pub(crate) fn offset(&self) -> [AxisMeasurement; 2] {
        self.all.map(|axis| AxisMeasurement {
            position: axis.mean[OFFSET],
            variance: axis.covariance[(OFFSET, OFFSET)],
        })
    }

    /// Squared normalised innovation of a measurement, summed over both axes, under the mixture of
    /// all models: chi-square with two degrees of freedom if the filters are consistent.
    pub(crate) fn nis(&self, at: [AxisMeasurement; 2]) -> f64 {
        self.score_on(0, at[0]).powi(2) + self.score_on(1, at[1]).powi(2)
    }

    /// The normal deviate of the tail probability of a measurement on one axis, under the mixture
    /// of all models: standard normal also where the mixture is not normal.
    fn score_on(&self, i: usize, at: AxisMeasurement) -> f64 {
        let mut parts = [(0.0, at); WAYS];
        for ((part, way), weight) in parts.iter_mut().zip(&self.ways).zip(self.weights) {
            let AxisMeasurement { position, variance } = way[i].found();
            *part = (weight, AxisMeasurement { position, variance: variance + at.variance });
        }
        normal_score(at.position, parts)
    }

    /// The logarithm of `N(z; H x_w, H P_w H' + R)`, the likelihood of a measurement under one
    /// model, but for a constant.
    fn log_likelihood(&self, way: usize, at: [AxisMeasurement; 2]) -> f64 {
        let mut sum = 0.0;
        for (axis, at) in self.ways[way].iter().zip(at) {
            let prior = axis.found();
            let variance = prior.variance + at.variance;
            sum += -0.5 * ((at.position - prior.position).powi(2) / variance + variance.ln());
        }
        sum
    }

    /// Variance of the measurement noise over the expected one.
    pub(crate) fn noise_factor(&self) -> f64 {
        self.noise_factor
    }

    /// Matches the noise to the innovation of the last update, given its normalised square over
    /// both axes (`nis`), as far as the innovation consists of noise and not of motion.
    pub(crate) fn match_noise(&mut self, nis: f64) {
        self.matched_s = (self.matched_s + self.interval).min(MATCHED_S);
        // A running mean at first, with `AT_LEAST_S` of expected noise in it; exponential later.
        let share = (self.interval / (self.matched_s + AT_LEAST_S)).min(1.0);
        // Relative step: the noise's share times (nis / 2 - 1), whose mean is 0 if the noise is
        // right, and the pull back.
        let more = self.noise_share * (nis.min(OUTLIER) / 2.0 - 1.0)
            - AS_EXPECTED * self.noise_factor.ln();
        let factor = self.noise_factor * (1.0 + share * more);
        self.noise_factor = factor.clamp(1.0 / MOST_MATCHED, MOST_MATCHED);
    }

    /// Adds to the offset's variance what the noise of the images learned so far has in it: the
    /// first measurement's variances stand for the noise of each.
    pub(crate) fn add_noise_of_learned(&mut self, variances: [f64; 2]) {
        if self.offset_noise <= 0.0 {
            return;
        }
        let offset_noise = std::mem::take(&mut self.offset_noise);
        for axes in self.ways.iter_mut().chain([&mut self.all]) {
            for (axis, variance) in axes.iter_mut().zip(variances) {
                axis.covariance[(OFFSET, OFFSET)] += offset_noise * variance;
            }
        }
    }

    /// Updates with what an image says of where the reference is found: on each axis that becomes
    /// the mixture of near, elsewhere and not seen, replaced by its mean and variance.
    pub(crate) fn update(&mut self, evidence: &PlaceEvidence) {
        let PlaceEvidence { near, at, elsewhere, elsewhere_at } = *evidence;
        self.measured = at.map(|at| at.variance);
        // As logarithms, so that none underflows.
        let likelihoods = [0, 1, 2, 3].map(|way: usize| self.log_likelihood(way, at));
        let largest = likelihoods.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let likelihoods = likelihoods.map(|logarithm| (logarithm - largest).exp());
        let mean: f64 = likelihoods.iter().zip(self.weights).map(|(l, w)| l * w).sum();
        let mut noise_shares = [0.0; WAYS];
        for (way, weight) in self.weights.iter_mut().enumerate() {
            // Bayes' rule for the models' weights; the share of the posterior without a measurement
            // leaves them as they are.
            if mean > f64::MIN_POSITIVE {
                *weight *= near * likelihoods[way] / mean + (1.0 - near);
            }
            for i in 0..2 {
                let axis = &mut self.ways[way][i];
                let prior = axis.found();
                // The Kalman update K = P / (P + R) of where the reference is found ...
                let gain = prior.variance / (prior.variance + at[i].variance);
                // 1 - K = R / (P + R) is the noise's share of the innovation's variance; halved for
                // the mean over both axes.
                noise_shares[way] += (1.0 - gain) / 2.0;
                let here = AxisMeasurement {
                    position: prior.position + gain * (at[i].position - prior.position),
                    variance: (1.0 - gain) * prior.variance,
                };
                // ... is one of three parts of a mixture, which is replaced by its mean and
                // variance.
                let parts =
                    [(near, here), (elsewhere, elsewhere_at[i]), (1.0 - near - elsewhere, prior)];
                let position: f64 = parts.iter().map(|(mass, part)| mass * part.position).sum();
                let spread: f64 =
                    parts.iter().map(|(mass, part)| mass * squared_about(position, part)).sum();
                // However far off the other places are, one image widens the prediction to twice
                // its standard deviation at most.
                let variance = spread.min(4.0 * prior.variance);
                // The regression splits the gain over the states: part to the position, the rest to
                // the offset.
                self.gains[way][i] = axis.slope() * (near * gain);
                axis.condition(AxisMeasurement { position, variance });
            }
        }
        let total: f64 = self.weights.iter().sum();
        self.weights.iter_mut().for_each(|weight| *weight /= total);
        self.noise_share =
            noise_shares.iter().zip(self.weights).map(|(share, weight)| share * weight).sum();
        self.combine();
    }

    /// Sets mean and variance of where the reference is found, on both axes.
    pub(crate) fn condition(&mut self, found: [AxisMeasurement; 2]) {
        for (way, gains) in self.ways.iter_mut().zip(&mut self.gains) {
            for i in 0..2 {
                // The gain of an update that takes the variance from v0 to v: K = 1 - v / v0.
                let gain = (1.0 - found[i].variance / way[i].found().variance).max(0.0);
                gains[i] = way[i].slope() * gain;
                way[i].condition(found[i]);
            }
        }
        self.measured = found.map(|at| at.variance);
        self.combine();
    }

    /// Updates the offset for an image that has been learned at `place` with a `share` of the
    /// reference. `variances` are those of the measurement there, `None` where the place was given.
    ///
    /// With x the target's position, b the offset and v the image's noise, the image shows the
    /// target at `x + v - place` from its middle, so that the offset becomes `(1 - share) b + share
    /// (place - x - v)`. The estimate of x has taken in the same v by its gain: both errors are
    /// correlated.
    pub(crate) fn learn(&mut self, place: ImagePoint, share: f64, variances: Option<[f64; 2]>) {
        let shifted = Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, -share, 0.0, 1.0 - share);
        // Where a variance is given the image's noise goes into the covariances below instead.
        let new = if variances.is_none() { share * share } else { 0.0 };
        // Noise of a mean: (1 - s)^2 of the old variance, s^2 of the new one.
        self.offset_noise = (1.0 - share).powi(2) * self.offset_noise + new;
        let place = [place.x, place.y];
        for (way, gains) in self.ways.iter_mut().zip(&self.gains) {
            for i in 0..2 {
                let axis = &mut way[i];
                // b += s (place - x - b): the mean of the line above, without v.
                let off = place[i] - axis.mean[POSITION];
                axis.mean[OFFSET] += share * (off - axis.mean[OFFSET]);
                let new = Vector3::new(0.0, 0.0, share);
                // P = F P F' + (F K n' + n K' F') R + n n' R, n = [0, 0, share]': the same noise v
                // in both; in the cross term R is at most the variance that the gain was made with.
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

    /// Takes the reference for one that was cut out again, `by` px beside its middle before: of the
    /// target itself, whose place is then known to `variance`, px^2. That error is in the position
    /// and with the opposite sign in the offset, as at first.
    pub(crate) fn recentre(&mut self, by: [f64; 2], variance: f64) {
        self.move_by(by);
        let off = Vector3::new(1.0, 0.0, -1.0);
        for axis in self.ways.iter_mut().flatten() {
            axis.covariance += off * off.transpose() * variance;
        }
        self.combine();
    }

    /// Moves the origin of both axes: positions grow by `by`, px, and all else stays.
    pub(crate) fn move_by(&mut self, by: [f64; 2]) {
        for axes in self.ways.iter_mut().chain([&mut self.all]) {
            for (axis, by) in axes.iter_mut().zip(by) {
                axis.mean[POSITION] += by;
            }
        }
    }
}

/// Mean square of a normal distribution about a place.
fn squared_about(place: f64, part: &AxisMeasurement) -> f64 {
    part.variance + (part.position - place).powi(2)
}

#[cfg(test)]
mod tests;
