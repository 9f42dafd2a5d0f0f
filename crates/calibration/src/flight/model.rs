//! What is measured of a flight, and what is unknown of it.

use crossfix_geometry::{Intrinsics, Pixel, turn_vector};
use crossfix_message::CameraName;
use nalgebra::{Point3, Rotation3, Vector2, Vector3};

use crate::lens::{self, LensFreedom};

/// Where the target was seen in one frame.
#[derive(Clone, Copy, Debug)]
pub struct Label {
    /// Capture time of the frame by the camera's own clock, s.
    pub time_s: f64,
    /// The target's middle in the recorded image.
    pub pixel: Pixel,
}

/// What one camera saw of the flight.
#[derive(Clone, Debug)]
pub struct CameraLabels {
    /// The camera.
    pub name: CameraName,
    /// Its lens, by its file.
    pub intrinsics: Intrinsics,
    /// What of that may be otherwise.
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
    /// What is wrong of it.
    pub errors: LogErrors,
}

/// What is wrong of a log: each sample by noise of its own, and all by a bias that drifts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LogErrors {
    /// Standard deviation of each sample's own error per axis, m.
    pub sd_m: f64,
    /// Of the bias, m.
    pub drift_sd_m: f64,
    /// Time over which the bias forgets itself, s.
    pub drift_time_s: f64,
}

/// A camera's clock: `common time = straight + wander(straight)` with `straight = own + offset + rate
/// (own - reference)`, and a row of the image is read out `read-out (row / height - 1/2)` after the
/// frame's time.
#[derive(Clone, Debug)]
pub(crate) struct Clock {
    pub(super) reference_s: f64,
    pub(super) offset_s: f64,
    pub(super) rate: f64,
    pub(super) readout_s: f64,
    pub(super) wander: Knots,
}

/// A function of time that is straight between knots.
#[derive(Clone, Debug)]
pub(crate) struct Knots {
    pub(super) start_s: f64,
    pub(super) step_s: f64,
    pub(super) values: Vec<f64>,
}

impl Knots {
    /// The two knots about a time and their weights; before and behind the ends, the end's alone.
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

    /// By how much the value grows per second about a time.
    fn slope(&self, time_s: f64) -> f64 {
        let at = (time_s - self.start_s) / self.step_s;
        if !(0.0..(self.values.len() - 1) as f64).contains(&at) {
            return 0.0;
        }
        (self.values[at as usize + 1] - self.values[at as usize]) / self.step_s
    }
}

/// What is unknown of a camera.
#[derive(Clone, Debug)]
pub(crate) struct CameraState {
    /// World from camera.
    pub(super) rotation: Rotation3<f64>,
    pub(super) centre: Point3<f64>,
    pub(super) clock: Clock,
    pub(super) intrinsics: Intrinsics,
}

/// The unknowns of a camera's pose and clock, in their order: a small rotation about its own axes
/// (rad), its centre (m), the clock's offset (s), rate and read-out (s). The lens follows.
pub(super) const POSE_AND_CLOCK: usize = 9;
/// Where the clock begins among them.
pub(super) const CLOCK: usize = 6;
/// Pose, clock and the longest lens.
pub(super) const MOST_OWN: usize = POSE_AND_CLOCK + lens::MOST_LENS_NUMBERS;

impl CameraState {
    /// Unknowns beside its clock's wander, which is of the time.
    pub(super) fn own(&self) -> usize {
        POSE_AND_CLOCK + lens::numbers(&self.intrinsics)
    }

    /// How far after its frame's time a pixel's row is read out, as a share of the read-out.
    pub(super) fn row_share(&self, pixel: Pixel) -> f64 {
        pixel.y() / f64::from(self.intrinsics.size.height) - 0.5
    }

    /// The common time of a label, s.
    pub(super) fn time_s(&self, label: &Label) -> f64 {
        self.clock.common_s(label.time_s) + self.clock.readout_s * self.row_share(label.pixel)
    }

    /// Where a place is seen, with the derivatives by it and by what is unknown of the camera; the
    /// clock's unknowns need the target's velocity. `None` behind the camera.
    pub(super) fn see(
        &self,
        label: &Label,
        place: Point3<f64>,
        velocity: Vector3<f64>,
    ) -> Option<Seen> {
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
        // The wander is one of the straight time.
        let by_straight =
            by_time * (1.0 + self.clock.wander.slope(self.clock.straight_s(label.time_s)));
        by_own[CLOCK] = by_straight;
        by_own[CLOCK + 1] = by_straight * (label.time_s - self.clock.reference_s);
        by_own[CLOCK + 2] = by_time * self.row_share(label.pixel);
        by_own[POSE_AND_CLOCK..].copy_from_slice(&seen.by_lens);
        let residual = seen.pixel - Vector2::new(label.pixel.x(), label.pixel.y());
        Some(Seen { residual, by_place, by_time, by_own })
    }

    /// Moves it by a step in its own unknowns, in their order.
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

impl Clock {
    /// The common time of a time of its own, s.
    pub(super) fn common_s(&self, own_s: f64) -> f64 {
        let straight_s = self.straight_s(own_s);
        straight_s + self.wander.at(straight_s)
    }

    /// The common time if the clock did not wander, s.
    pub(super) fn straight_s(&self, own_s: f64) -> f64 {
        own_s + self.offset_s + self.rate * (own_s - self.reference_s)
    }
}

/// What a label differs from where its target should be seen, pixels, with derivatives.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seen {
    pub(super) residual: Vector2<f64>,
    /// Per metre of the target's place.
    pub(super) by_place: nalgebra::Matrix2x3<f64>,
    /// Per second of the label's time.
    pub(super) by_time: Vector2<f64>,
    /// By each unknown of the camera but its wander.
    pub(super) by_own: [Vector2<f64>; MOST_OWN],
}

/// The step in a camera's own unknowns that leads from one state to another.
pub(super) fn step_between(from: &CameraState, to: &CameraState) -> Vec<f64> {
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

/// The time between a camera's frames: the median between its labels, s.
pub(super) fn frame_time(camera: &CameraLabels) -> f64 {
    let mut steps: Vec<f64> =
        camera.labels.windows(2).map(|pair| pair[1].time_s - pair[0].time_s).collect();
    // Several labels may be of one frame.
    steps.retain(|step| *step > 0.0);
    steps.sort_unstable_by(f64::total_cmp);
    steps.get(steps.len() / 2).copied().unwrap_or_default().max(1e-3)
}

/// How long times last that are in order.
pub(super) fn hours(mut times_s: impl DoubleEndedIterator<Item = f64>) -> f64 {
    let (first, last) = (times_s.next(), times_s.next_back());
    first.zip(last).map_or(0.0, |(first, last)| (last - first) / 3600.0)
}
