//! Bearings of one track over a few seconds, stamped by the cameras' own clocks.

use std::ops::Range;

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{Matrix2, Vector3};

use crate::cameras::LASTING_S;
use crate::track::TrackId;
use crate::uncertainty::CorrelatedNoise;

/// Bounds on a window, as the time that an adjustment takes grows with it.
struct WindowBounds {
    /// Bearings. When it is full, every other one of each camera is dropped, and from then on every
    /// other new one too. With half of it six cameras of 30 Hz are thinned to 15 Hz, and their
    /// clocks are known 1.4 times less well.
    bearings: usize,
    /// Cameras, with eight unknowns each. The others have their turn with another window. With half
    /// of it the anchors alone may fill a window.
    cameras: usize,
    /// Anchors ([`ClockRole::Anchor`]) among them in the first [`ADMISSION_S`]. With twice as much
    /// they may take all places before a camera to be estimated is heard.
    anchors: usize,
    /// Time of a bearing from the window's beginning, s. With half of it the same: a window is
    /// closed after eight seconds, and no clock is off by more than two.
    span_s: f64,
}

/// The numbers in use; what half of each does is said at its field.
const BOUNDS: WindowBounds = WindowBounds { bearings: 1500, cameras: 8, anchors: 4, span_s: 30.0 };
/// After this all cameras to be estimated that see the target have been heard, s. With half of it
/// an anchor may take the place of one of two frames per second.
const ADMISSION_S: f64 = 0.5;
/// Least bearings of a camera: with fewer, what it says of its clock cannot be checked. With half
/// of it two bearings, four numbers, are fitted by the eight unknowns of clock and pose.
const LEAST_SIGHTS: usize = 5;

/// A bearing of a target.
#[derive(Clone, Debug)]
pub(super) struct WindowBearing {
    /// When it was taken by the camera's own clock, s after the window's beginning.
    pub(super) time_s: f64,
    /// Index of its camera in the window.
    pub(super) camera: usize,
    /// With the covariance that was reported, and the noise that lasts counted in as white.
    pub(super) line: SightLine,
    /// Factor by which that is more than the variance of this bearing alone.
    pub(super) allowance: f64,
    /// Where the track had the target at that time.
    pub(super) place: Vector3<f64>,
}

/// A line of sight as it comes to a window.
#[derive(Clone, Copy, Debug)]
pub(super) struct StampedLine {
    /// By the camera's own clock.
    pub(super) time: Timestamp,
    pub(super) line: SightLine,
    /// The part of its errors that is declared to last.
    pub(super) lasting: CorrelatedNoise,
    /// Factor on its reported variance that differences of successive bearings show to be white.
    pub(super) white: f64,
}

/// Role of a camera in a window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ClockRole {
    /// Its clock is to be learnt.
    Estimated,
    /// Its clock is known, or another window's task: the others are learnt relative to it.
    Anchor,
}

/// The bearings of a track.
#[derive(Clone, Debug)]
pub(super) struct TrackWindow {
    pub(super) track: TrackId,
    pub(super) start: Timestamp,
    pub(super) cameras: Vec<CameraName>,
    pub(super) sights: Vec<WindowBearing>,
    /// One in this many bearings of each camera is taken.
    thinned: usize,
    /// Number of its cameras that are anchors.
    anchors: usize,
    /// Number of bearings that each camera has offered.
    offered: Vec<usize>,
    /// White part of each camera's noise, as a factor on the reported variance, by its newest
    /// bearing.
    white: Vec<f64>,
}

impl TrackWindow {
    pub(super) fn new(track: TrackId, start: Timestamp) -> Self {
        Self {
            track,
            start,
            cameras: Vec::new(),
            sights: Vec::new(),
            thinned: 1,
            anchors: 0,
            offered: Vec::new(),
            white: Vec::new(),
        }
    }

    /// Takes in a bearing, with where the track has the target.
    pub(super) fn add(
        &mut self,
        camera: &CameraName,
        role: ClockRole,
        StampedLine { time, mut line, lasting, white }: StampedLine,
        place: Vector3<f64>,
    ) {
        let time_s = time.seconds_since(self.start);
        if time_s.abs() > BOUNDS.span_s {
            return;
        }
        let known = self.cameras.iter().position(|known| known == camera);
        let no_anchor = self.anchors >= BOUNDS.anchors && time_s < ADMISSION_S;
        if known.is_none()
            && (self.cameras.len() >= BOUNDS.cameras || (role == ClockRole::Anchor && no_anchor))
        {
            return;
        }
        let index = known.unwrap_or_else(|| {
            self.anchors += usize::from(role == ClockRole::Anchor);
            self.cameras.push(camera.clone());
            self.offered.push(0);
            self.white.push(white);
            self.cameras.len() - 1
        });
        self.white[index] = white;
        let number = self.offered[index];
        self.offered[index] += 1;
        if number.is_multiple_of(self.thinned) {
            // The part of the noise that lasts counts as white noise that averages out as slowly.
            let alone = line.covariance.trace() + 2.0 * lasting.variance();
            let as_white = lasting.as_white(self.since_last(index, time_s));
            line.covariance += Matrix2::identity() * as_white;
            let allowance = line.covariance.trace() / alone;
            self.sights.push(WindowBearing { time_s, camera: index, line, allowance, place });
        }
        if self.sights.len() >= BOUNDS.bearings {
            self.thin();
        }
    }

    /// Time since a camera's last bearing in the window, s; infinite if there is none.
    fn since_last(&self, camera: usize, time_s: f64) -> f64 {
        let last = self.sights.iter().rev().find(|sight| sight.camera == camera);
        last.map_or(f64::INFINITY, |last| time_s - last.time_s)
    }

    /// Drops every other bearing of each camera.
    fn thin(&mut self) {
        self.thinned *= 2;
        let mut seen = vec![0_usize; self.cameras.len()];
        self.sights.retain(|sight| {
            seen[sight.camera] += 1;
            seen[sight.camera] % 2 == 1
        });
    }

    /// Earliest and latest time of its bearings, s.
    pub(super) fn span(&self) -> Option<Range<f64>> {
        let times = || self.sights.iter().map(|sight| sight.time_s);
        let (first, last) =
            (times().fold(f64::INFINITY, f64::min), times().fold(f64::NEG_INFINITY, f64::max));
        (!self.sights.is_empty()).then_some(first..last)
    }

    /// The longest time for which a camera and another see the target together, s, where the clock
    /// of each (by index in the window) is ahead by so much.
    pub(super) fn together_s(&self, camera: usize, ahead_s: impl Fn(usize) -> f64) -> f64 {
        let span = |index: usize| {
            let Range { start, end } = self.span_of(index);
            start - ahead_s(index)..end - ahead_s(index)
        };
        let own = span(camera);
        let others = (0..self.cameras.len()).filter(|index| *index != camera).map(span);
        others.map(|other| own.end.min(other.end) - own.start.max(other.start)).fold(0.0, f64::max)
    }

    /// Earliest and latest time of a camera's bearings, s; infinite, the later one first, if it has
    /// none.
    fn span_of(&self, camera: usize) -> Range<f64> {
        let own = self.sights.iter().filter(|sight| sight.camera == camera);
        own.fold(f64::INFINITY..f64::NEG_INFINITY, |span, sight| {
            span.start.min(sight.time_s)..span.end.max(sight.time_s)
        })
    }

    /// Factor by which a camera's bearings repeat one another whose residuals have `scale` times
    /// the variance that is reckoned with: what of that is neither reported nor shown to be white
    /// by differences of successive bearings lasts.
    pub(super) fn repetition(&self, camera: usize, scale: f64) -> f64 {
        let own = || self.sights.iter().filter(|sight| sight.camera == camera);
        let count = own().count() as f64;
        let allowance = own().map(|sight| sight.allowance).sum::<f64>() / count;
        let excess = 1.0 - (self.white[camera] / allowance).max(1.0) / scale;
        if count < 2.0 || excess <= 0.0 {
            return 1.0;
        }
        let Range { start, end } = self.span_of(camera);
        let lasting = CorrelatedNoise { sd_rad: excess.sqrt(), time_s: LASTING_S };
        1.0 - excess + lasting.as_white((end - start) / (count - 1.0))
    }

    /// Indices of the cameras that have given enough bearings to be checked.
    fn checked_indices(&self) -> Vec<usize> {
        let count = |index: usize| self.sights.iter().filter(|sight| sight.camera == index).count();
        (0..self.cameras.len()).filter(|index| count(*index) >= LEAST_SIGHTS).collect()
    }

    /// Cameras that have given enough bearings to be checked.
    pub(super) fn checked_cameras(&self) -> Vec<CameraName> {
        self.checked_indices().into_iter().map(|index| self.cameras[index].clone()).collect()
    }

    /// The window without a camera's bearings before a time, s.
    pub(super) fn without_early(&self, time_s: f64, camera: &CameraName) -> Self {
        let mut later = self.clone();
        let index = self.cameras.iter().position(|known| known == camera);
        later.sights.retain(|sight| Some(sight.camera) != index || sight.time_s >= time_s);
        later
    }

    /// The window without the cameras that have given too few bearings to be checked.
    pub(super) fn checked(&self) -> Self {
        let kept = self.checked_indices();
        let sights = self.sights.iter().filter_map(|sight| {
            let camera = kept.iter().position(|index| *index == sight.camera)?;
            Some(WindowBearing { camera, ..sight.clone() })
        });
        Self {
            cameras: self.checked_cameras(),
            sights: sights.collect(),
            offered: kept.iter().map(|index| self.offered[*index]).collect(),
            white: kept.iter().map(|index| self.white[*index]).collect(),
            ..*self
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::spatial::tests_support::line_at;

    #[test]
    fn a_window_stays_bounded_and_spans_all_its_time() {
        let mut window = TrackWindow::new(TrackId(1), Timestamp::EPOCH);
        let line = line_at(Point3::origin(), Point3::new(0.0, 100.0, 0.0), 0.0).line;
        for k in 0..9000_u32 {
            let camera = ["a", "b", "c"][k as usize % 3].parse().unwrap();
            let time = Timestamp::from_seconds(f64::from(k) * 1e-3);
            window.add(
                &camera,
                ClockRole::Estimated,
                StampedLine { time, line, lasting: CorrelatedNoise::NONE, white: 1.0 },
                Vector3::zeros(),
            );
        }
        assert!(
            (BOUNDS.bearings / 2..=BOUNDS.bearings).contains(&window.sights.len()),
            "{}",
            window.sights.len()
        );
        let Range { start: first, end: last } = window.span().unwrap();
        assert!(first < 0.01 && last > 8.9, "{first} {last}");
        let of_b = window.sights.iter().filter(|sight| sight.camera == 1).count();
        assert!(of_b.abs_diff(window.sights.len() / 3) <= 2, "{of_b}");
    }

    #[test]
    fn clocks_that_are_to_be_learnt_go_before_anchors() {
        let mut window = TrackWindow::new(TrackId(1), Timestamp::EPOCH);
        let line = line_at(Point3::origin(), Point3::new(0.0, 100.0, 0.0), 0.0).line;
        // Sixteen cameras, of which the last two are to be learnt, three times in half a second.
        for k in 0..60_u32 {
            let camera = format!("{:02}", k % 16).parse().unwrap();
            let role = if k % 16 < 14 { ClockRole::Anchor } else { ClockRole::Estimated };
            window.add(
                &camera,
                role,
                StampedLine {
                    time: Timestamp::from_seconds(f64::from(k) / 60.0),
                    line,
                    lasting: CorrelatedNoise::NONE,
                    white: 1.0,
                },
                Vector3::zeros(),
            );
        }
        let names: Vec<&str> = window.cameras.iter().map(CameraName::as_str).collect();
        assert_eq!(names[..6], ["00", "01", "02", "03", "14", "15"]);
        assert_eq!(names.len(), BOUNDS.cameras, "then the others");
    }
}
