//! Rows of what is known of cameras apart from their labels: where they stand, how far apart, that
//! they are level.

use nalgebra::{Rotation3, Vector3};

use super::model::CameraLabels;
use super::noise::Tails;
use super::rows::{ResidualRow, Sink};
use super::state::{Flight, FlightState};
use crate::survey::ENOUGH_PLACES;

/// Standard deviation of the tilt of a camera's image rows, as people set cameras up, rad. It makes
/// a site upright where three surveyed places do not; with half of it a tripod on a slope would be
/// believed.
const LEVEL_RAD: f64 = 0.1;

impl FlightState {
    /// A camera's surveyed place.
    pub(super) fn place_rows(
        &self,
        start: usize,
        index: usize,
        flight: &Flight<'_>,
        sink: &mut impl Sink,
    ) {
        let Some(place) = flight.survey.place(&flight.cameras[index].name) else { return };
        // An earlier calibration's pose is weighted as a whole in `known_rows`; its place in the
        // survey only serves the start.
        if flight.known(index).is_some() {
            return;
        }
        let rows = [0, 1, 2].map(|axis| -> ResidualRow {
            let scale = place.sd_m[axis].recip();
            let aside = self.cameras[index].centre[axis] - place.position[axis];
            (vec![(start + 3 + axis, scale)], aside * scale)
        });
        // A place may have been written down for another camera.
        sink.take(&rows, Tails::Heavy);
    }

    /// Taped distances.
    pub(super) fn distance_rows(&self, flight: &Flight<'_>, sink: &mut impl Sink) {
        let starts = self.starts();
        for distance in &flight.survey.distances {
            let found = distance
                .between
                .each_ref()
                .map(|name| flight.cameras.iter().position(|camera| camera.name == *name));
            let [Some(a), Some(b)] = found else { continue };
            let apart = self.cameras[b].centre - self.cameras[a].centre;
            let scale = distance.sd_m.recip();
            // d|b - a| / db = (b - a) / |b - a|, and the opposite by a.
            let along = apart.normalize() * scale;
            let mut terms = Vec::new();
            for (start, sign) in [(starts[a], -1.0), (starts[b], 1.0)] {
                terms.extend([0, 1, 2].map(|axis| (start + 3 + axis, sign * along[axis])));
            }
            sink.take(&[(terms, (apart.norm() - distance.metres) * scale)], Tails::Heavy);
        }
    }

    /// Cameras are level to [`LEVEL_RAD`], where neither a log nor enough places say which way is
    /// up.
    pub(super) fn level_rows(&self, flight: &Flight<'_>, sink: &mut impl Sink) {
        let named = |camera: &&CameraLabels| flight.survey.place(&camera.name).is_some();
        let places = flight.cameras.iter().filter(named).count();
        let names: Vec<_> = flight.cameras.iter().map(|camera| &camera.name).collect();
        if places + flight.survey.placing_landmarks(&names) >= ENOUGH_PLACES {
            return;
        }
        for (camera, start) in self.cameras.iter().zip(self.starts()) {
            let (tilt, by_rotation) = tilt(&camera.rotation);
            let terms = (0..3).map(|axis| (start + axis, by_rotation[axis] / LEVEL_RAD)).collect();
            sink.take(&[(terms, tilt / LEVEL_RAD)], Tails::Heavy);
        }
    }
}

/// How far an image's rows are from level (the sine), and its derivative by a small rotation about
/// the camera's axes.
fn tilt(world_from_camera: &Rotation3<f64>) -> (f64, Vector3<f64>) {
    let up = world_from_camera.inverse_transform_vector(&Vector3::z());
    (up.x, Vector3::x().cross(&up))
}
