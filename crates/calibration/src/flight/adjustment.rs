//! The least-squares adjustment of a flight: cameras, clocks, lenses, the target's trajectory and
//! the log's bias, all at once.

use super::gauge::Gauge;
use super::model::{CLOCK, POSE_AND_CLOCK};
use super::noise::Tails;
use super::normal::{Covariance, NormalEquations, Solution};
use super::rows::{CostSum, ResidualRow, Sink};
use super::state::{CameraPriors, Flight, FlightState, Priors};
use crate::lens;

/// Standard deviation of a rotation of which nothing is known beforehand, rad: wide against
/// anything that a site has. With half of it the same.
const WIDE_ROTATION_RAD: f64 = 10.0;
/// The same of a place, m. With half of it the same.
const WIDE_M: f64 = 1e4;
/// The same of a clock's offset, s. With half of it the same.
const WIDE_S: f64 = 1e4;
/// Standard deviation of the clock's rate in the stated covariance, where the flight does not tell
/// the rate: nobody knows which camera is a phone. With [`RATE_SD`](super::state::RATE_SD) a
/// phone's clock is 80 ms off after a minute and a half, where 9 ms are stated.
const RATE_KNOWN_BY: f64 = 1e-3;
/// A sensor is read out within nothing to a whole frame's time: prior mean and standard deviation
/// of the read-out, as a share of that time. With half of it a whole frame's time would lie three
/// deviations off.
const READOUT_SHARE: f64 = 0.5;

struct Linear(NormalEquations);

impl Sink for Linear {
    fn take(&mut self, rows: &[ResidualRow], tails: Tails) {
        let weight =
            tails.weight(rows.iter().map(|(_, residual)| residual * residual).sum(), rows.len());
        self.0.add(rows, weight);
    }
}

/// Everything that the unknowns are weighted by.
#[derive(Clone, Copy)]
struct AdjustmentModel<'a> {
    flight: Flight<'a>,
    priors: &'a Priors,
    gauge: Option<&'a Gauge>,
}

impl FlightState {
    fn all(&self, model: &AdjustmentModel<'_>, sink: &mut impl Sink) {
        let AdjustmentModel { flight, priors, gauge } = model;
        self.jerk_rows(priors, sink);
        self.rest_rows(sink);
        // A log says which way is up; without one the cameras do.
        match flight.log {
            Some(log) => self.log_rows(log, sink),
            None => self.level_rows(flight, sink),
        }
        if let Some(gauge) = gauge {
            gauge.rows(self, sink);
        }
        self.distance_rows(flight, sink);
        self.landmark_rows(flight, sink);
        let starts = self.starts();
        for (index, camera) in flight.cameras.iter().enumerate() {
            self.label_rows(index, starts[index], camera, &priors.cameras[index], sink);
            self.prior_rows(index, starts[index], &priors.cameras[index], sink);
            if flight.known(index).is_none() {
                self.lens_rows(index, starts[index], &priors.cameras[index], sink);
            }
            self.known_rows(index, starts[index], flight, sink);
            self.place_rows(starts[index], index, flight, sink);
            self.rate_row(index, starts[index], priors.rate_sd, sink);
        }
    }

    fn cost_of_rows(&self, model: &AdjustmentModel<'_>) -> f64 {
        let mut cost = CostSum(0.0);
        self.all(model, &mut cost);
        cost.0
    }

    fn rate_row(&self, index: usize, start: usize, rate_sd: f64, sink: &mut impl Sink) {
        let rate = self.cameras[index].clock.rate;
        sink.take(&[(vec![(start + CLOCK + 1, rate_sd.recip())], rate / rate_sd)], Tails::Heavy);
    }

    /// Prior of the lens: its file's values, and how far the lens may deviate from them.
    fn lens_rows(&self, index: usize, start: usize, priors: &CameraPriors, sink: &mut impl Sink) {
        let values = lens::values(&self.cameras[index].intrinsics);
        let known = lens::values(&priors.lens);
        let deviations = priors.freedom.prior_sd(&priors.lens);
        for (k, sd) in deviations.into_iter().enumerate() {
            hold(start + POSE_AND_CLOCK + k, values[k] - known[k], sd, sink);
        }
    }

    /// Prior of a camera's pose and clock before anything is seen.
    fn prior_rows(&self, index: usize, start: usize, priors: &CameraPriors, sink: &mut impl Sink) {
        let camera = &self.cameras[index];
        for axis in 0..3 {
            // A rotation has no zero to be pulled to: only the step is.
            hold(start + axis, 0.0, WIDE_ROTATION_RAD, sink);
            hold(start + axis + 3, camera.centre[axis], WIDE_M, sink);
        }
        let clock = &camera.clock;
        hold(start + CLOCK, 0.0, WIDE_S, sink);
        let readout = READOUT_SHARE * priors.frame_s;
        hold(start + CLOCK + 2, clock.readout_s - readout, readout, sink);
        // The wander's mean and slope belong to the clock's offset and rate: the wander itself is
        // pulled to zero, with a deviation as wide as it may reach over the flight.
        let order = self.order();
        let wander = &clock.wander;
        let span = wander.step_s * (wander.values.len() - 1) as f64;
        for (k, value) in wander.values.iter().enumerate() {
            let scale = (priors.wander * span).sqrt().recip();
            let term = (order.wander(k, index), scale);
            sink.take(&[(vec![term], value * scale)], Tails::Normal);
        }
        // Random walk: each step has the variance power x step.
        let step = (priors.wander * wander.step_s).sqrt().recip();
        for (k, pair) in wander.values.windows(2).enumerate() {
            let terms = vec![(order.wander(k, index), -step), (order.wander(k + 1, index), step)];
            sink.take(&[(terms, (pair[1] - pair[0]) * step)], Tails::Normal);
        }
    }
}

/// The row of an unknown that is `value` off where its prior has it.
fn hold(unknown: usize, value: f64, sd: f64, sink: &mut impl Sink) {
    sink.take(&[(vec![(unknown, sd.recip())], value / sd)], Tails::Normal);
}

/// Steps at most; from a start within a metre and a tenth of a second, five to eight are enough.
/// With half of it a rough start may end before it has settled, and is used as it is then.
const MOST_STEPS: usize = 30;
/// A step that changes the cost (see [`CostSum`]) by less than this is the last (all unknowns
/// together move by a tenth of a deviation then; with half of it the same); ...
pub(super) const SETTLED: f64 = 0.01;
/// ... and by this while the noise is still being found: with a hundred unknowns, a tenth of a
/// deviation each. With half of it rounds take more steps to find the same noise.
pub(super) const NEARLY_SETTLED: f64 = 1.0;

/// The state of least cost, and its covariance.
pub(super) struct AdjustedFlight {
    pub(super) state: FlightState,
    pub(super) covariance: Covariance,
    pub(super) cost: f64,
}

/// Levenberg-Marquardt minimisation from a start. `None`: some unknown is tied to nothing, or a
/// value is not a number.
pub(super) fn adjust(
    flight: &Flight<'_>,
    priors: &Priors,
    start: FlightState,
    settled: f64,
) -> Option<AdjustedFlight> {
    let gauge = if flight.log.is_none() { Some(Gauge::of(&start)?) } else { None };
    let model = AdjustmentModel { flight: *flight, priors, gauge: gauge.as_ref() };
    let seen = start.seen_coefficients(flight);
    let (mut state, mut damping) = (start, FIRST_DAMPING);
    let mut of_rows = state.cost_of_rows(&model);
    let mut cost = of_rows;
    for _ in 0..MOST_STEPS {
        // The pull of the jerk's prior is computed again for each step: a rough start's is larger
        // than that of the state it becomes.
        let pull = state.pull(priors);
        let before = of_rows + state.lean(pull, &seen);
        cost = before;
        while damping < MOST_DAMPING {
            let mut linear = linearised(&model, &state);
            state.lean_against(pull, &seen, &mut linear);
            let Solution { step, .. } = linear.solve(damping)?;
            let next = state.moved(step.as_slice());
            let next_of_rows = next.cost_of_rows(&model);
            let next_cost = next_of_rows + next.lean(pull, &seen);
            if next_cost < cost {
                (state, of_rows, cost) = (next, next_of_rows, next_cost);
                damping /= DAMPING_STEP;
                break;
            }
            damping *= DAMPING_STEP;
        }
        // Also where no damping has led to a better state: the cost is then what it was.
        if before - cost < settled {
            break;
        }
    }

    // The covariance is of the undamped equations, with the wider prior of the rates.
    let known = Priors { rate_sd: RATE_KNOWN_BY, ..priors.clone() };
    let solution = linearised(&AdjustmentModel { priors: &known, ..model }, &state).solve(0.0)?;
    Some(AdjustedFlight { state, covariance: solution.covariance()?, cost })
}

/// Share of each diagonal element that it is enlarged by at first (with half of it the same), ...
const FIRST_DAMPING: f64 = 1e-6;
/// ... the factor by which that share grows where a step makes the fit worse, and shrinks where
/// better (with half of it 13 tries lead from the first value to the last, in the place of nine),
/// ...
const DAMPING_STEP: f64 = 10.0;
/// ... and its largest value. With half of it the same: steps are hundreds of times shorter than
/// the plain ones by then.
const MOST_DAMPING: f64 = 1e3;

fn linearised(model: &AdjustmentModel<'_>, state: &FlightState) -> NormalEquations {
    let order = state.order();
    let mut linear = Linear(NormalEquations::new(order.chain(), order.band(), state.others()));
    state.all(model, &mut linear);
    linear.0
}
