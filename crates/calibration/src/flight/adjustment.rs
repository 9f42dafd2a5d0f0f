//! The least-squares adjustment of a flight: cameras, clocks, lenses, the target's way and the
//! log's bias, all at once.

use crossfix_geometry::Intrinsics;
use nalgebra::{Vector2, Vector3};

use super::gauge::Gauge;
use super::model::{CLOCK, CameraLabels, CameraState, FlightLog, Knots, POSE_AND_CLOCK, Seen};
use super::noise::{Tails, Whitening};
use super::normal::{Covariance, NormalEquations, Solution, Term};
use super::spline::{KNOT_S, SPAN, Spline, THIRD_DIFFERENCE};
use super::unknowns::{Order, Touched};
use crate::label_noise::LabelNoise;
use crate::lens::{self, LensFreedom};
use crate::survey::Survey;

/// Labels farther apart in time than this have errors of their own, s. No more than the distance of
/// the spline's knots: a row holds five coefficients.
pub(super) const LONGEST_PAIR_S: f64 = KNOT_S;
/// Unknowns of the target's way that two labels in a row touch: five coefficients.
const OF_A_PAIR: usize = 3 * (SPAN + 1);
/// Prior of what is not known at all: wide against anything that a site has.
const WIDE_ROTATION_RAD: f64 = 10.0;
const WIDE_M: f64 = 1e4;
const WIDE_S: f64 = 1e4;
/// A step of the adjustment moves the way by this where nothing else holds it, m: near enough for ten
/// minutes without a label. With a tenth of it a way that swings out by kilometres in a gap would say
/// which way round the site is, to 30 mrad.
const REST_M: f64 = 1e5;
/// How much too fast or slow a camera's clock runs against the log's: two quartzes, and recorders
/// that count. Phones state frame rates that are 2e-3 off, so the prior has heavy tails. With a wide
/// one all clocks of a site may be off alike, as a log of metres does not tell: at 2e-4 they were by
/// 50 ms five minutes later.
pub(super) const RATE_SD: f64 = 1e-4;
/// What it is known by where the flight does not tell: nobody knows which camera is a phone. With
/// the deviation above a phone's clock is 80 ms beside what it is said to be to 9 ms, after a minute
/// and a half.
const RATE_KNOWN_BY: f64 = 1e-3;
/// A sensor is read out in between nothing and a frame's time: so much of it, and give or take.
const READOUT_SHARE: f64 = 0.5;

/// What a label counts, in deviations, that the way does not reach or that lies behind its camera.
pub(super) const UNSEEN: f64 = 1e3;

/// What all residuals are held against.
#[derive(Clone, Debug)]
pub(super) struct Priors {
    /// Power of the target's jerk, m^2/s^5.
    pub(super) jerk: f64,
    /// What a clock's rate may be off by.
    pub(super) rate_sd: f64,
    /// Of each camera.
    pub(super) cameras: Vec<CameraPriors>,
}

#[derive(Clone, Debug)]
pub(super) struct CameraPriors {
    pub(super) noise: LabelNoise,
    /// Of the lens's file.
    pub(super) lens: Intrinsics,
    /// What of it may be otherwise.
    pub(super) freedom: LensFreedom,
    /// Time between frames, s.
    pub(super) frame_s: f64,
    /// Power of the clock's random walk, s^2/s.
    pub(super) wander: f64,
}

/// The unknowns.
#[derive(Clone, Debug)]
pub(super) struct State {
    pub(super) way: Spline,
    pub(super) cameras: Vec<CameraState>,
    /// The log's bias, an axis each; empty without a log.
    pub(super) bias: Vec<Knots>,
}

pub(super) use super::normal::Row;

/// Takes rows in that have their tails in common.
pub(super) trait Sink {
    /// Whether it makes anything of what rows hang on.
    const TAKES_TERMS: bool = true;

    fn take(&mut self, rows: &[Row], tails: Tails);
}

struct Linear(NormalEquations);

impl Sink for Linear {
    fn take(&mut self, rows: &[Row], tails: Tails) {
        let weight =
            tails.weight(rows.iter().map(|(_, residual)| residual * residual).sum(), rows.len());
        self.0.add(rows, weight);
    }
}

pub(super) struct Cost(pub(super) f64);

impl Sink for Cost {
    const TAKES_TERMS: bool = false;

    fn take(&mut self, rows: &[Row], tails: Tails) {
        self.0 +=
            tails.loss(rows.iter().map(|(_, residual)| residual * residual).sum(), rows.len());
    }
}

/// A flight to be adjusted.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flight<'a> {
    pub(super) cameras: &'a [CameraLabels],
    pub(super) log: Option<&'a FlightLog>,
    pub(super) survey: &'a Survey,
}

/// All that the unknowns are held against.
#[derive(Clone, Copy)]
struct Model<'a> {
    flight: Flight<'a>,
    priors: &'a Priors,
    gauge: Option<&'a Gauge>,
}

impl State {
    /// In what order its unknowns stand.
    pub(super) fn order(&self) -> Order {
        Order::of(&self.way, self.cameras.len(), self.bias.len())
    }

    /// Where each camera's own unknowns begin, and at last where they end.
    pub(super) fn starts(&self) -> Vec<usize> {
        let mut next = self.order().chain();
        let mut starts = vec![next];
        for camera in &self.cameras {
            next += camera.own();
            starts.push(next);
        }
        starts
    }

    fn others(&self) -> usize {
        self.cameras.iter().map(CameraState::own).sum()
    }

    fn moved(&self, step: &[f64]) -> Self {
        let mut next = self.clone();
        let order = self.order();
        for (k, coefficient) in next.way.coefficients.iter_mut().enumerate() {
            let first = order.way(k, 0);
            *coefficient += Vector3::from_column_slice(&step[first..first + 3]);
        }
        let mut rest = &step[order.chain()..];
        for (index, camera) in next.cameras.iter_mut().enumerate() {
            let (own, after) = rest.split_at(camera.own());
            camera.step(own);
            rest = after;
            let wander = camera.clock.wander.values.iter_mut().enumerate();
            wander.for_each(|(knot, value)| *value += step[order.wander(knot, index)]);
        }
        for (axis, bias) in next.bias.iter_mut().enumerate() {
            let values = bias.values.iter_mut().enumerate();
            values.for_each(|(knot, value)| *value += step[order.bias(knot, axis)]);
        }
        next
    }

    /// What a camera's label differs by, where the way reaches it.
    pub(super) fn see(
        &self,
        camera: usize,
        label: &super::Label,
    ) -> Option<(usize, [f64; SPAN], Seen)> {
        let camera = &self.cameras[camera];
        let weights = self.way.weights(camera.time_s(label))?;
        let seen = camera.see(label, self.way.place(&weights), self.way.velocity(&weights))?;
        Some((weights.first, weights.place, seen))
    }

    fn all(&self, model: &Model<'_>, sink: &mut impl Sink) {
        let Model { flight, priors, gauge } = model;
        self.jerk_rows(priors, sink);
        self.rest_rows(sink);
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

    /// White jerk: over an interval its mean has the variance power / interval, so that the third
    /// difference has power x interval^5.
    pub(super) fn jerk_rows(&self, priors: &Priors, sink: &mut impl Sink) {
        let scale = (priors.jerk * KNOT_S.powi(5)).sqrt().recip();
        let order = self.order();
        for first in 0..self.way.intervals() {
            let difference = self.way.third_difference(first);
            for axis in 0..3 {
                let term = |k: usize| (order.way(first + k, axis), THIRD_DIFFERENCE[k] * scale);
                let terms = (0..SPAN).map(term).collect();
                sink.take(&[(terms, difference[axis] * scale)], Tails::Normal);
            }
        }
    }

    /// Where nothing holds the way it stays about where it is: in a gap of minutes white jerk alone
    /// leaves it to rounding.
    fn rest_rows(&self, sink: &mut impl Sink) {
        let order = self.order();
        for k in 0..self.way.coefficients.len() {
            for axis in 0..3 {
                sink.take(&[(vec![(order.way(k, axis), 1.0 / REST_M)], 0.0)], Tails::Normal);
            }
        }
    }

    fn log_rows(&self, log: &FlightLog, sink: &mut impl Sink) {
        let order = self.order();
        let scale = log.errors.sd_m.recip();
        for sample in &log.samples {
            let Some(weights) = self.way.weights(sample.time_s) else { continue };
            let place = self.way.place(&weights);
            let rows = [0, 1, 2].map(|axis| {
                let of_bias = self.bias[axis].weights(sample.time_s);
                let chain = (0..SPAN)
                    .map(|k| (order.way(weights.first + k, axis), weights.place[k] * scale));
                let bias = of_bias.map(|(k, weight)| (order.bias(k, axis), weight * scale));
                let stated = place[axis] + self.bias[axis].at(sample.time_s);
                (chain.chain(bias).collect(), (stated - sample.position[axis]) * scale)
            });
            sink.take(&rows, Tails::Heavy);
        }
        self.bias_rows(log, sink);
    }

    /// A bias that forgets itself: `b' = f b + noise`, of the same deviation at all times.
    fn bias_rows(&self, log: &FlightLog, sink: &mut impl Sink) {
        let order = self.order();
        let errors = &log.errors;
        let kept = (-self.bias[0].step_s / errors.drift_time_s).exp();
        let first = errors.drift_sd_m.max(1e-9).recip();
        let next = first / (1.0 - kept * kept).sqrt();
        for (axis, bias) in self.bias.iter().enumerate() {
            let begin = (vec![(order.bias(0, axis), first)], bias.values[0] * first);
            sink.take(&[begin], Tails::Normal);
            for (k, pair) in bias.values.windows(2).enumerate() {
                let terms =
                    vec![(order.bias(k, axis), -kept * next), (order.bias(k + 1, axis), next)];
                sink.take(&[(terms, (pair[1] - kept * pair[0]) * next)], Tails::Normal);
            }
        }
    }

    fn label_rows<S: Sink>(
        &self,
        index: usize,
        start: usize,
        camera: &CameraLabels,
        priors: &CameraPriors,
        sink: &mut S,
    ) {
        let mut before: Option<(f64, Placed)> = None;
        for label in &camera.labels {
            let placed = self.placed(index, label);
            let Some(placed) = placed else {
                // As far off as can be: or it would pay to have it out of sight.
                sink.take(&[(Vec::new(), UNSEEN), (Vec::new(), UNSEEN)], Tails::Heavy);
                before = None;
                continue;
            };
            let earlier = before.filter(|(time_s, earlier)| {
                // Rows and a clock that wanders may have put the later label first.
                let ahead = placed.first.checked_sub(earlier.first);
                label.time_s - time_s < LONGEST_PAIR_S
                    && ahead.is_some_and(|ahead| ahead <= 1)
                    && placed.touched().and(earlier.touched()).fit()
            });
            let whitening = priors
                .noise
                .after(earlier.map(|(time_s, _)| label.time_s - time_s), priors.frame_s);
            let earlier = earlier.as_ref().map(|(_, earlier)| earlier);
            let rows = if S::TAKES_TERMS {
                self.whitened(index, start, &placed, earlier, whitening)
            } else {
                whitened_residual(&placed, earlier, whitening)
                    .map(|residual| (Vec::new(), residual))
            };
            sink.take(&rows, Tails::Heavy);
            before = Some((label.time_s, placed));
        }
    }

    /// How both axes of a label, in pixels, follow what is unknown; `None` where it is not seen.
    pub(super) fn told_by(&self, index: usize, label: &super::Label) -> Option<[Vec<Term>; 2]> {
        let placed = self.placed(index, label)?;
        let alone = Whitening { kept: 0.0, sd_px: 1.0 };
        let rows = self.whitened(index, self.starts()[index], &placed, None, alone);
        Some(rows.map(|(terms, _)| terms))
    }

    fn placed(&self, index: usize, label: &super::Label) -> Option<Placed> {
        let (first, weights, seen) = self.see(index, label)?;
        let clock = &self.cameras[index].clock;
        let wander = clock.wander.weights(clock.straight_s(label.time_s));
        let placed = Placed { first, weights, seen, wander };
        placed.touched().fit().then_some(placed)
    }

    /// See [`whitened_residual`], with what it hangs on.
    fn whitened(
        &self,
        index: usize,
        start: usize,
        now: &Placed,
        before: Option<&Placed>,
        whitening: Whitening,
    ) -> [Row; 2] {
        let Whitening { kept, sd_px } = whitening;
        let residuals = whitened_residual(now, before, whitening);
        let (order, own) = (self.order(), self.cameras[index].own());
        let first = before.map_or(now.first, |before| before.first);
        [0, 1].map(|axis| {
            let mut chain = [0.0; OF_A_PAIR];
            let mut terms: Vec<Term> = Vec::with_capacity(OF_A_PAIR + own + 4);
            let mut own_terms = [0.0; super::model::MOST_OWN];
            let parts = [Some((now, 1.0)), before.map(|before| (before, -kept))];
            for (part, share) in parts.into_iter().flatten() {
                let share = share / sd_px;
                for (k, weight) in part.weights.iter().enumerate() {
                    for dimension in 0..3 {
                        chain[3 * (part.first - first + k) + dimension] +=
                            part.seen.by_place[(axis, dimension)] * weight * share;
                    }
                }
                for (term, by_own) in own_terms.iter_mut().zip(&part.seen.by_own) {
                    *term += by_own[axis] * share;
                }
                for (knot, weight) in part.wander {
                    let by_knot = part.seen.by_time[axis] * weight * share;
                    terms.push((order.wander(knot, index), by_knot));
                }
            }
            let used = 3 * (now.first - first + SPAN);
            let of_way = chain[..used].iter().enumerate();
            terms.extend(of_way.map(|(k, value)| (order.way(first + k / 3, k % 3), *value)));
            terms.extend(own_terms[..own].iter().enumerate().map(|(k, value)| (start + k, *value)));
            (terms, residuals[axis])
        })
    }

    fn rate_row(&self, index: usize, start: usize, rate_sd: f64, sink: &mut impl Sink) {
        let rate = self.cameras[index].clock.rate;
        sink.take(&[(vec![(start + CLOCK + 1, rate_sd.recip())], rate / rate_sd)], Tails::Heavy);
    }

    /// What a lens's file says, and how far the lens may be otherwise.
    fn lens_rows(&self, index: usize, start: usize, priors: &CameraPriors, sink: &mut impl Sink) {
        let values = lens::values(&self.cameras[index].intrinsics);
        let known = lens::values(&priors.lens);
        let deviations = priors.freedom.prior_sd(&priors.lens);
        for (k, sd) in deviations.into_iter().enumerate() {
            let term = (start + POSE_AND_CLOCK + k, sd.recip());
            sink.take(&[(vec![term], (values[k] - known[k]) / sd)], Tails::Normal);
        }
    }

    /// What is known of a camera's pose and clock before anything is seen.
    fn prior_rows(&self, index: usize, start: usize, priors: &CameraPriors, sink: &mut impl Sink) {
        let camera = &self.cameras[index];
        let mut hold = |unknown: usize, value: f64, sd: f64| {
            sink.take(&[(vec![(start + unknown, sd.recip())], value / sd)], Tails::Normal);
        };
        for axis in 0..3 {
            hold(axis, 0.0, WIDE_ROTATION_RAD);
            hold(axis + 3, camera.centre[axis], WIDE_M);
        }
        let clock = &camera.clock;
        hold(CLOCK, 0.0, WIDE_S);
        let readout = READOUT_SHARE * priors.frame_s;
        hold(CLOCK + 2, clock.readout_s - readout, readout);
        // The wander's mean and slope are the clock's: the wander itself is held to nought as wide
        // as it may go.
        let order = self.order();
        let wander = &clock.wander;
        let span = wander.step_s * (wander.values.len() - 1) as f64;
        for (k, value) in wander.values.iter().enumerate() {
            let scale = (priors.wander * span).sqrt().recip();
            let term = (order.wander(k, index), scale);
            sink.take(&[(vec![term], value * scale)], Tails::Normal);
        }
        let step = (priors.wander * wander.step_s).sqrt().recip();
        for (k, pair) in wander.values.windows(2).enumerate() {
            let terms = vec![(order.wander(k, index), -step), (order.wander(k + 1, index), step)];
            sink.take(&[(terms, (pair[1] - pair[0]) * step)], Tails::Normal);
        }
    }
}

/// A label's residual and what of the way it hangs on.
#[derive(Clone, Copy, Debug)]
struct Placed {
    first: usize,
    weights: [f64; SPAN],
    seen: Seen,
    wander: [(usize, f64); 2],
}

/// A label's residual less what of it is the one's before, by the deviation of what is new.
fn whitened_residual(
    now: &Placed,
    before: Option<&Placed>,
    Whitening { kept, sd_px }: Whitening,
) -> [f64; 2] {
    let carried = before.map_or(Vector2::zeros(), |before| before.seen.residual * kept);
    ((now.seen.residual - carried) / sd_px).into()
}

impl Placed {
    fn touched(&self) -> Touched {
        Touched::by(self.first, self.wander[0].0)
    }
}

/// Steps at most; from a start within a metre and a tenth of a second five to eight are enough.
const MOST_STEPS: usize = 30;
/// A step that changes the cost by less than this is the last, in units of log likelihood; ...
pub(super) const SETTLED: f64 = 0.01;
/// ... and by this while the noise is still being found: with a hundred unknowns, a tenth of a
/// deviation each.
pub(super) const NEARLY_SETTLED: f64 = 1.0;

/// A state that no step makes likelier, and how well it is known.
pub(super) struct Adjusted {
    pub(super) state: State,
    pub(super) covariance: Covariance,
    pub(super) cost: f64,
}

/// Levenberg and Marquardt's way down from a start. `None`: something is tied to nothing, or is not
/// a number.
pub(super) fn adjust(
    flight: &Flight<'_>,
    priors: &Priors,
    start: State,
    settled: f64,
) -> Option<Adjusted> {
    let gauge = if flight.log.is_none() { Some(Gauge::of(&start)?) } else { None };
    let model = Model { flight: *flight, priors, gauge: gauge.as_ref() };
    let seen = start.seen_coefficients(flight);
    let cost_of_rows = |state: &State| {
        let mut cost = Cost(0.0);
        state.all(&model, &mut cost);
        cost.0
    };
    let (mut state, mut damping) = (start, FIRST_DAMPING);
    let mut of_rows = cost_of_rows(&state);
    let mut cost = of_rows;
    for _ in 0..MOST_STEPS {
        // A rough start pulls more than what it becomes.
        let pull = state.pull(priors);
        let before = of_rows + state.lean(pull, &seen);
        cost = before;
        while damping < MOST_DAMPING {
            let mut linear = linearised(&model, &state);
            state.lean_against(pull, &seen, &mut linear);
            let Solution { step, .. } = linear.solve(damping)?;
            let next = state.moved(step.as_slice());
            let next_of_rows = cost_of_rows(&next);
            let next_cost = next_of_rows + next.lean(pull, &seen);
            if next_cost < cost {
                (state, of_rows, cost) = (next, next_of_rows, next_cost);
                damping /= DAMPING_STEP;
                break;
            }
            damping *= DAMPING_STEP;
        }
        if before - cost < settled {
            break;
        }
    }

    let known = Priors { rate_sd: RATE_KNOWN_BY, ..priors.clone() };
    let solution = linearised(&Model { priors: &known, ..model }, &state).solve(0.0)?;
    Some(Adjusted { state, covariance: solution.covariance()?, cost })
}

/// A step is damped by this share of each diagonal element at first, ...
const FIRST_DAMPING: f64 = 1e-6;
/// ... by so many times more where it makes the fit worse, or less where better, ...
const DAMPING_STEP: f64 = 10.0;
/// ... and by this at most.
const MOST_DAMPING: f64 = 1e3;

fn linearised(model: &Model<'_>, state: &State) -> NormalEquations {
    let order = state.order();
    let mut linear = Linear(NormalEquations::new(order.chain(), order.band(), state.others()));
    state.all(model, &mut linear);
    linear.0
}

/// Half the square of a residual: the mean of both axes, pixels^2.
pub(super) fn square(residual: Vector2<f64>) -> f64 {
    residual.norm_squared() / 2.0
}
