//! Whether calibrations from the flight's two halves agree as well as both state.
//!
//! A covariance is only as good as its model. Label errors of a kind that the noise model does not
//! know, or a lens that bends otherwise than its formula, become visible when the same cameras are
//! calibrated from either half alone.

use nalgebra::{DMatrix, DVector, Matrix2xX, Point3, Vector3};

use super::adjustment::{self, AdjustedFlight, NEARLY_SETTLED};
use super::datum::Followers;
use super::error::LEAST_LABELS;
use super::model::{CameraLabels, CameraUnknowns, Label, MOST_OWN, step_between};
use super::state::{Flight, FlightState, Priors};
use crate::label_noise::LabelNoise;

/// Of a camera's labels one in this many is compared: they are many, and neighbours tell the same.
/// With half of it the same, in twice the time.
const STRIDE: usize = 20;
/// A half whose own stated deviation in the image is more than this many times the deviation of its
/// labels has seen too little to be compared: from a drone that stands on the ground anything may
/// come out. With half of it more cameras get the others' mean ratio in the place of their own.
const MOST_STATED: f64 = 10.0;

/// For each camera the distance between its two halves' results in the image, divided by the
/// distance that both state.
pub(super) struct HalvesRatios {
    /// `None` where one half saw too little.
    pub(super) of_cameras: Vec<Option<f64>>,
    /// Mean of those that are known; zero for none.
    mean: f64,
}

impl HalvesRatios {
    pub(super) fn of(flight: &Flight<'_>, priors: &Priors, adjusted: &AdjustedFlight) -> Self {
        let count = flight.cameras.len();
        let of_cameras =
            compared(flight, priors, &adjusted.state).unwrap_or_else(|| vec![None; count]);
        let known: Vec<f64> = of_cameras.iter().copied().flatten().collect();
        let mean = known.iter().sum::<f64>() / known.len().max(1) as f64;
        Self { of_cameras, mean }
    }

    /// Factor by which a camera's covariance is to be enlarged.
    pub(super) fn variance_factor(&self, index: usize) -> f64 {
        // A camera of which one half saw too little is taken to be as far off as the others on
        // average.
        self.of_cameras[index].unwrap_or(self.mean).max(1.0).powi(2)
    }
}

fn compared(flight: &Flight<'_>, priors: &Priors, state: &FlightState) -> Option<Vec<Option<f64>>> {
    let middle_s = middle(flight, state)?;
    let halves = [false, true].map(|is_late| half(flight, state, middle_s, is_late));
    let [first, second] = [0, 1].map(|k| {
        let flight = Flight { cameras: &halves[k], ..*flight };
        // Both start from the whole flight's state and keep its noise: only the labels differ.
        adjustment::adjust(&flight, priors, state.clone(), NEARLY_SETTLED)
    });
    let (first, second) = (first?, second?);
    let saw_both =
        |index: usize| halves.iter().all(|cameras| cameras[index].labels.len() >= LEAST_LABELS);
    let shown: Vec<usize> = (0..state.cameras.len()).filter(|&index| saw_both(index)).collect();
    let apart = DifferenceOfHalves::of(state, [&first, &second], &shown)?;
    let mut ratios = vec![None; state.cameras.len()];
    for (start, &index) in apart.starts.iter().zip(&shown) {
        let noise = &priors.cameras[index].noise;
        ratios[index] = apart.ratio(flight, state, index, *start, noise);
    }
    Some(ratios)
}

/// The time that splits all labels in half.
fn middle(flight: &Flight<'_>, state: &FlightState) -> Option<f64> {
    let mut times = Vec::new();
    for (camera, state) in flight.cameras.iter().zip(&state.cameras) {
        times.extend(camera.labels.iter().map(|label| state.time_s(label)));
    }
    times.sort_unstable_by(f64::total_cmp);
    times.get(times.len() / 2).copied()
}

fn half(
    flight: &Flight<'_>,
    state: &FlightState,
    middle_s: f64,
    is_late: bool,
) -> Vec<CameraLabels> {
    let cameras = flight.cameras.iter().zip(&state.cameras);
    cameras.map(|(camera, state)| half_of(camera, state, middle_s, is_late)).collect()
}

fn half_of(
    camera: &CameraLabels,
    state: &CameraUnknowns,
    middle_s: f64,
    is_late: bool,
) -> CameraLabels {
    let is_in = |label: &&Label| (state.time_s(label) >= middle_s) == is_late;
    let labels = camera.labels.iter().filter(is_in).copied().collect();
    CameraLabels { labels, ..camera.clone() }
}

/// Difference between the halves of the cameras' own unknowns, without the datum, and the
/// covariance that this difference should have.
struct DifferenceOfHalves {
    difference: DVector<f64>,
    covariance: DMatrix<f64>,
    /// Index of each camera's first unknown.
    starts: Vec<usize>,
}

impl DifferenceOfHalves {
    fn of(state: &FlightState, halves: [&AdjustedFlight; 2], shown: &[usize]) -> Option<Self> {
        let (first, all) = (state.order().chain(), state.starts());
        let own = |index: &usize| all[*index] - first..all[*index + 1] - first;
        let rows: Vec<usize> = shown.iter().flat_map(own).collect();
        let mut starts = Vec::new();
        let mut next = 0;
        for index in shown {
            starts.push(next);
            next += own(index).len();
        }
        let [a, b] =
            halves.map(|half| half.covariance.others().select_rows(&rows).select_columns(&rows));
        // The halves' errors are taken to be independent, so their covariances add.
        let covariance = a + b;
        let pairs =
            shown.iter().map(|&k| (&halves[0].state.cameras[k], &halves[1].state.cameras[k]));
        let difference: Vec<f64> = pairs.flat_map(|(a, b)| step_between(a, b)).collect();
        let difference = DVector::from_vec(difference);
        // The log's bias differs between the halves: what all cameras have in common is the log's.
        let followers = Followers::of(state).rows(&rows);
        let datum = followers.estimator(&covariance.clone().cholesky()?.inverse())?;
        Some(Self {
            difference: followers.without_datum(&datum, &difference),
            covariance: covariance - datum.of_cameras(),
            starts,
        })
    }

    fn ratio(
        &self,
        flight: &Flight<'_>,
        state: &FlightState,
        index: usize,
        start: usize,
        noise: &LabelNoise,
    ) -> Option<f64> {
        let camera = &state.cameras[index];
        let own = camera.own();
        let difference = self.difference.rows(start, own);
        let covariance = self.covariance.view((start, start), (own, own));
        let (mut found, mut stated, mut count) = (0.0, 0.0, 0.0);
        for label in flight.cameras[index].labels.iter().step_by(STRIDE) {
            let place = state.way.place_at(camera.time_s(label));
            let Some(by_own) = place.and_then(|place| in_image(camera, label, place)) else {
                continue;
            };
            // |J d|^2 against trace(J P J'): what was found against what is stated, summed over
            // both axes.
            found += (&by_own * difference).norm_squared();
            stated += (&by_own * covariance * by_own.transpose()).trace();
            count += 1.0;
        }
        let most_px = MOST_STATED * noise.sd_px();
        // Mean stated variance per axis below most_px^2.
        let is_told = stated > 0.0 && stated < 2.0 * count * most_px * most_px;
        is_told.then(|| (found / stated).sqrt())
    }
}

/// Derivatives of a fixed place's image by the camera's own unknowns.
fn in_image(camera: &CameraUnknowns, label: &Label, place: Point3<f64>) -> Option<Matrix2xX<f64>> {
    let by_own: [_; MOST_OWN] = camera.see(label, place, Vector3::zeros())?.by_own;
    Some(Matrix2xX::from_columns(&by_own[..camera.own()]))
}
