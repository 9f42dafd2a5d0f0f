//! The measurements of a flight, and its unknowns.

use crossfix_geometry::{Intrinsics, Pixel, turn_vector};
use crossfix_message::CameraName;
use nalgebra::{Point3, Rotation3, Vector2, Vector3};

use crate::lens::{self, LensFreedom};

/// Where the target was seen in one frame.
#[derive(Clone, Copy, Debug)]
pub struct Label {
    /// Capture time of the frame by the camera's own clock, s.
    pub time_s: f64,
    /// The target's centre in the recorded image.
    pub pixel: Pixel,
}

/// What one camera saw of the flight.
#[derive(Clone, Debug)]
pub struct CameraLabels {
    /// The camera.
    pub name: CameraName,
    /// Its lens, as its file states it.
    pub intrinsics: Intrinsics,
    /// How far the lens may deviate from its file.
    pub freedom: LensFreedom,
    /// In order of time.
    pub labels: Vec<Label>,
}

/// Where the target's log says that it was.
#[derive(Clone, Copy, Debug)]
pub struct LogSample {
    /// By the log's clock, which is the common time, s.
    pub time_s: f64,
    /// Local ENU, m.
    pub position: Point3<f64>,
}

/// The target's log, and how good it is.
#[derive(Clone, Debug)]
pub struct FlightLog {
    /// In order of time.
    pub samples: Vec<LogSample>,
    /// How far its samples may be off.
    pub errors: LogErrors,
}

/// Errors of a log: noise of each sample, and a drifting bias that all samples share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LogErrors {
    /// Standard deviation of each sample's own error per axis, m.
    pub sd_m: f64,
    /// Standard deviation of the bias per axis, m.
    pub drift_sd_m: f64,
    /// Correlation time of the bias, s.
    pub drift_time_s: f64,
}

/// A camera's clock: `common time = straight + wander(straight)` with
/// `straight = own + offset + rate (own - reference)`; a row of the image is read out
/// `read-out (row / height - 1/2)` after the frame's time.
#[derive(Clone, Debug)]
pub(crate) struct ClockModel {
    pub(super) reference_s: f64,
    pub(super) offset_s: f64,
    pub(super) rate: f64,
    pub(super) readout_s: f64,
    pub(super) wander: Knots,
}

/// A function of time that is linear between knots.
#[derive(Clone, Debug)]
pub(crate) struct Knots {
    pub(super) start_s: f64,
    pub(super) step_s: f64,
    pub(super) values: Vec<f64>,
}

impl Knots {
    /// The two knots about a time and their weights; beyond the ends only the end's knot counts.
    pub(super) fn weights(&self, time_s: f64) -> [(usize, f64); 2] {
        let last = self.values.len() - 1;
        let at = ((time_s - self.start_s) / self.step_s).clamp(0.0, last as f64);
        let before = (at as usize).min(last - 1);
        let share = at - before as f64;
        [(before, 1.0 - share), (before + 1, share)]
    }

    /// The value at a time.
    pub(super) fn at(&self, time_s: f64) -> f64 {
        self.weights(time_s).iter().map(|&(k, weight)| self.values[k] * weight).sum()
    }

    /// The function's slope at a time, per second.
    fn slope(&self, time_s: f64) -> f64 {
        let at = (time_s - self.start_s) / self.step_s;
        if !(0.0..(self.values.len() - 1) as f64).contains(&at) {
            return 0.0;
        }
        (self.values[at as usize + 1] - self.values[at as usize]) / self.step_s
    }
}

/// The unknowns of a camera.
#[derive(Clone, Debug)]
pub(crate) struct CameraUnknowns {
    /// World from camera.
    pub(super) rotation: Rotation3<f64>,
    pub(super) centre: Point3<f64>,
    pub(super) clock: ClockModel,
    pub(super) intrinsics: Intrinsics,
}

/// Number of unknowns of a camera's pose and clock, in their order: a small rotation about its own
/// axes (rad), its centre (m), the clock's offset (s), rate and read-out (s). The lens follows.
pub(super) const POSE_AND_CLOCK: usize = 9;
/// Index of the first of the clock's unknowns among these.
pub(super) const CLOCK: usize = 6;
/// Number of unknowns of pose, clock and the longest lens.
pub(super) const MOST_OWN: usize = POSE_AND_CLOCK + lens::MOST_LENS_NUMBERS;

impl CameraUnknowns {
    /// Number of unknowns without the clock's wander, which changes with time and belongs to the
    /// chain.
    pub(super) fn own(&self) -> usize {
        POSE_AND_CLOCK + lens::numbers(&self.intrinsics)
    }

    /// How long after its frame's time a pixel's row is read out, as a share of the read-out.
    pub(super) fn row_share(&self, pixel: Pixel) -> f64 {
        pixel.y() / f64::from(self.intrinsics.size.height) - 0.5
    }

    /// The common time of a label, s.
    pub(super) fn time_s(&self, label: &Label) -> f64 {
        self.clock.common_s(label.time_s) + self.clock.readout_s * self.row_share(label.pixel)
    }

    /// Where a place is seen, with the derivatives by the place and by the camera's unknowns; the
    /// clock's unknowns need the target's velocity. `None` if the place is behind the camera.
    pub(super) fn see(
        &self,
        label: &Label,
        place: Point3<f64>,
        velocity: Vector3<f64>,
    ) -> Option<LabelResidual> {
        let world_from_camera = self.rotation.matrix();
        let point = self.rotation.inverse_transform_vector(&(place - self.centre));
        let seen = lens::project(&self.intrinsics, &point)?;
        let by_place = seen.by_point * world_from_camera.transpose();
        let mut by_own = [Vector2::zeros(); MOST_OWN];
        // R <- R exp(d): the point turns by -d x point = point x d.
        let by_rotation = seen.by_point * point.cross_matrix();
        let by_time = by_place * velocity;
        for axis in 0..3 {
            by_own[axis] = by_rotation.column(axis).into_owned();
            by_own[axis + 3] = -by_place.column(axis);
        }
        // The wander is a function of the straight time: d(common) = (1 + slope) d(straight).
        let by_straight =
            by_time * (1.0 + self.clock.wander.slope(self.clock.straight_s(label.time_s)));
        by_own[CLOCK] = by_straight;
        by_own[CLOCK + 1] = by_straight * (label.time_s - self.clock.reference_s);
        // The read-out is added after the clock's wander, so its derivative has no slope in it.
        by_own[CLOCK + 2] = by_time * self.row_share(label.pixel);
        by_own[POSE_AND_CLOCK..].copy_from_slice(&seen.by_lens);
        let residual = seen.pixel - Vector2::new(label.pixel.x(), label.pixel.y());
        Some(LabelResidual { residual, by_place, by_time, by_own })
    }

    /// Moves the state by a step in the camera's own unknowns, in their order.
    pub(super) fn step(&mut self, step: &[f64]) {
        let own = self.own();
        let vector = |from: usize| Vector3::from_column_slice(&step[from..from + 3]);
        self.rotation *= Rotation3::new(vector(0));
        self.centre += vector(3);
        self.clock.offset_s += step[CLOCK];
        self.clock.rate += step[CLOCK + 1];
        self.clock.readout_s += step[CLOCK + 2];
        self.intrinsics = lens::moved(&self.intrinsics, &step[POSE_AND_CLOCK..own]);
    }
}

impl ClockModel {
    /// The common time at a time of the camera's own clock, s.
    pub(super) fn common_s(&self, own_s: f64) -> f64 {
        let straight_s = self.straight_s(own_s);
        straight_s + self.wander.at(straight_s)
    }

    /// The common time if the clock did not wander, s.
    pub(super) fn straight_s(&self, own_s: f64) -> f64 {
        own_s + self.offset_s + self.rate * (own_s - self.reference_s)
    }
}

/// A label's residual (the pixel predicted less the pixel labelled) with its derivatives.
#[derive(Clone, Copy, Debug)]
pub(super) struct LabelResidual {
    pub(super) residual: Vector2<f64>,
    /// Derivative by the target's place, pixels per metre.
    pub(super) by_place: nalgebra::Matrix2x3<f64>,
    /// Derivative by the label's time, pixels per second.
    pub(super) by_time: Vector2<f64>,
    /// Derivatives by each unknown of the camera except its wander.
    pub(super) by_own: [Vector2<f64>; MOST_OWN],
}

/// Step in a camera's own unknowns that leads from one state to another.
pub(super) fn step_between(from: &CameraUnknowns, to: &CameraUnknowns) -> Vec<f64> {
    let turn: Rotation3<f64> = from.rotation.inverse() * to.rotation;
    let mut step: Vec<f64> = turn_vector(&turn).iter().copied().collect();
    step.extend((to.centre - from.centre).iter());
    let (a, b) = (&from.clock, &to.clock);
    step.extend([b.offset_s - a.offset_s, b.rate - a.rate, b.readout_s - a.readout_s]);
    debug_assert_eq!(step.len(), POSE_AND_CLOCK);
    let lenses = lens::values(&from.intrinsics).into_iter().zip(lens::values(&to.intrinsics));
    step.extend(lenses.map(|(from, to)| to - from));
    step
}

/// Time between a camera's frames: the median between its labels, s.
pub(super) fn frame_time(camera: &CameraLabels) -> f64 {
    let mut steps: Vec<f64> =
        camera.labels.windows(2).map(|pair| pair[1].time_s - pair[0].time_s).collect();
    // Several labels may belong to one frame.
    steps.retain(|step| *step > 0.0);
    steps.sort_unstable_by(f64::total_cmp);
    steps.get(steps.len() / 2).copied().unwrap_or_default().max(1e-3)
}

/// Duration covered by times that are in order, hours.
pub(super) fn hours(mut times_s: impl DoubleEndedIterator<Item = f64>) -> f64 {
    let (first, last) = (times_s.next(), times_s.next_back());
    first.zip(last).map_or(0.0, |(first, last)| (last - first) / 3600.0)
}
