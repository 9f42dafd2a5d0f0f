//! Labels and log samples beside the adjusted trajectory, one by one: for plots and pictures.

use crossfix_geometry::Pixel;
use nalgebra::{Point3, Vector2, Vector3};

use super::model::{FlightLog, Label, LogSample};
use super::state::{Flight, FlightState};

/// A label, compared with where its target should have been seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FittedLabel {
    /// Capture time of its frame by the camera's own clock, s.
    pub own_time_s: f64,
    /// When its row was read out, by the common time, s.
    pub time_s: f64,
    /// Where it is in the image.
    pub pixel: Pixel,
    /// The label less where the target should be seen, pixels.
    pub beside_px: Vector2<f64>,
    /// How fast the target crosses the image there, pixels/s.
    pub motion_px_per_s: Vector2<f64>,
    /// Where the target was, local ENU, m.
    pub place: Point3<f64>,
}

impl FittedLabel {
    /// How far the label lies ahead along the target's motion in the image, as a time, s: what a
    /// clock that is behind would cause. `None` where the target moves by `least_px_per_s` or less.
    pub fn ahead_s(&self, least_px_per_s: f64) -> Option<f64> {
        let speed = self.motion_px_per_s.norm();
        (speed > least_px_per_s).then(|| self.beside_px.dot(&self.motion_px_per_s) / speed.powi(2))
    }

    /// How far the label lies to the right of the target's motion in the image, as the time that
    /// the target needs for that distance, s: no clock causes that. `None` as for
    /// [`FittedLabel::ahead_s`].
    pub fn across_s(&self, least_px_per_s: f64) -> Option<f64> {
        let speed = self.motion_px_per_s.norm();
        let right = Vector2::new(-self.motion_px_per_s.y, self.motion_px_per_s.x);
        (speed > least_px_per_s).then(|| self.beside_px.dot(&right) / speed.powi(2))
    }
}

/// A sample of the log, compared with the trajectory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FittedSample {
    /// By the log's clock, s.
    pub time_s: f64,
    /// Where the log has the target, local ENU, m.
    pub logged: Point3<f64>,
    /// Where the trajectory has the target, m.
    pub place: Point3<f64>,
    /// The log's drifting bias at that time, m.
    pub bias: Vector3<f64>,
}

impl FittedSample {
    /// The sample's own error: the difference less the bias, m.
    pub fn residual(&self) -> Vector3<f64> {
        self.place + self.bias - self.logged
    }
}

/// A camera's labels where the trajectory reaches them, in the order of its own time.
pub(super) fn labels(flight: &Flight<'_>, state: &FlightState, index: usize) -> Vec<FittedLabel> {
    let labels = flight.cameras[index].labels.iter();
    labels.filter_map(|label| fitted_label(state, index, label)).collect()
}

fn fitted_label(state: &FlightState, index: usize, label: &Label) -> Option<FittedLabel> {
    let time_s = state.cameras[index].time_s(label);
    let (weights, seen) = state.see(index, label)?;
    Some(FittedLabel {
        own_time_s: label.time_s,
        time_s,
        pixel: label.pixel,
        // A residual is the prediction less the label.
        beside_px: -seen.residual,
        motion_px_per_s: seen.by_time,
        place: state.way.place(&weights),
    })
}

/// A log's samples at times of the trajectory.
pub(super) fn samples(log: &FlightLog, state: &FlightState) -> Vec<FittedSample> {
    log.samples.iter().filter_map(|sample| fitted_sample(state, sample)).collect()
}

fn fitted_sample(state: &FlightState, sample: &LogSample) -> Option<FittedSample> {
    let weights = state.way.weights(sample.time_s)?;
    Some(FittedSample {
        time_s: sample.time_s,
        logged: sample.position,
        place: state.way.place(&weights),
        bias: Vector3::from_fn(|axis, _| state.bias[axis].at(sample.time_s)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_label_ahead_along_its_motion_is_so_much_too_late() {
        let label = FittedLabel {
            own_time_s: 0.0,
            time_s: 0.0,
            pixel: Pixel::new(0.0, 0.0),
            beside_px: Vector2::new(3.0, 1.0),
            motion_px_per_s: Vector2::new(100.0, 0.0),
            place: Point3::origin(),
        };
        assert_eq!(label.ahead_s(50.0), Some(0.03));
        // Rows count downwards: to the right of motion to the right is below.
        assert_eq!(label.across_s(50.0), Some(0.01));
        assert_eq!(label.ahead_s(150.0), None);
    }
}
