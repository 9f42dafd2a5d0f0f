//! The unknowns of a flight, and what is known of them before its labels are used.

use crossfix_geometry::Intrinsics;
use nalgebra::{Vector2, Vector3};

use super::model::{CameraLabels, CameraUnknowns, FlightLog, Knots, Label, LabelResidual};
use super::spline::{TrajectorySpline, Weights};
use super::unknowns::UnknownOrder;
use crate::label_noise::LabelNoise;
use crate::lens::LensFreedom;
use crate::survey::Survey;

/// Standard deviation of a camera clock's rate error against the log's clock: two quartzes, and
/// recorders that count. Phones state frame rates that are 2e-3 off, so the prior has heavy tails.
/// With a wide prior all clocks of a site may be off alike, which a log good to metres does not
/// show: at 2e-4 they were off by 50 ms five minutes later.
pub(super) const RATE_SD: f64 = 1e-4;

/// A flight to be adjusted.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flight<'a> {
    pub(super) cameras: &'a [CameraLabels],
    pub(super) log: Option<&'a FlightLog>,
    pub(super) survey: &'a Survey,
}

/// Priors and noise models that all residuals are weighted by.
#[derive(Clone, Debug)]
pub(super) struct Priors {
    /// Power of the target's jerk, m^2/s^5.
    pub(super) jerk: f64,
    /// Standard deviation of a clock's rate error.
    pub(super) rate_sd: f64,
    /// Those of each camera.
    pub(super) cameras: Vec<CameraPriors>,
}

#[derive(Clone, Debug)]
pub(super) struct CameraPriors {
    pub(super) noise: LabelNoise,
    /// The lens as its file states it.
    pub(super) lens: Intrinsics,
    /// How far the lens may deviate from its file.
    pub(super) freedom: LensFreedom,
    /// Time between frames, s.
    pub(super) frame_s: f64,
    /// Power of the clock's random walk, s^2/s.
    pub(super) wander: f64,
}

/// The unknowns.
#[derive(Clone, Debug)]
pub(super) struct FlightState {
    pub(super) way: TrajectorySpline,
    pub(super) cameras: Vec<CameraUnknowns>,
    /// The log's bias, one per axis; empty without a log.
    pub(super) bias: Vec<Knots>,
}

impl FlightState {
    /// The order in which the unknowns stand.
    pub(super) fn order(&self) -> UnknownOrder {
        UnknownOrder::of(&self.way, self.cameras.len(), self.bias.len())
    }

    /// Index of each camera's first own unknown; the last entry is the end of the last camera's.
    pub(super) fn starts(&self) -> Vec<usize> {
        let mut next = self.order().chain();
        let mut starts = vec![next];
        for camera in &self.cameras {
            next += camera.own();
            starts.push(next);
        }
        starts
    }

    pub(super) fn others(&self) -> usize {
        self.cameras.iter().map(CameraUnknowns::own).sum()
    }

    pub(super) fn moved(&self, step: &[f64]) -> Self {
        let mut next = self.clone();
        let order = self.order();
        for (k, coefficient) in next.way.coefficients.iter_mut().enumerate() {
            let first = order.way(k, 0);
            *coefficient += Vector3::from_column_slice(&step[first..first + 3]);
        }
        let mut rest = &step[order.chain()..];
        for (index, camera) in next.cameras.iter_mut().enumerate() {
            // After the chain: each camera's own unknowns, as many as its lens has.
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

    /// A label's residual with its derivatives, and the spline's weights at its time; `None` where
    /// the trajectory does not reach that time or the target lies behind the camera.
    pub(super) fn see(&self, camera: usize, label: &Label) -> Option<(Weights, LabelResidual)> {
        let camera = &self.cameras[camera];
        let weights = self.way.weights(camera.time_s(label))?;
        let seen = camera.see(label, self.way.place(&weights), self.way.velocity(&weights))?;
        Some((weights, seen))
    }
}

/// Half the squared length of a residual: the mean square of both axes, pixels^2.
pub(super) fn square(residual: Vector2<f64>) -> f64 {
    residual.norm_squared() / 2.0
}
