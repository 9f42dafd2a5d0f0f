//! Comparison of a calibrated site with its survey.

use crossfix_calibration::{FlightResult, Survey, SurveyedPlace, TapedDistance};
use crossfix_message::CameraName;
use nalgebra::{Point3, Vector3};
use serde::Serialize;

use crate::output;

/// A surveyed place that deviates from the calibration by more than this many SDs is another
/// camera's, or in another datum: of good places one in ten thousand deviates so far. With half of
/// it one good place in ten would.
const BESIDE: f64 = 4.2;

/// Differences between the calibration and the survey.
#[derive(Debug, Default, Serialize)]
pub struct BesideSurvey {
    places: Vec<BesidePlace>,
    distances: Vec<BesideDistance>,
}

#[derive(Debug, Serialize)]
struct BesidePlace {
    camera: String,
    /// Position by the flight minus position by the survey, east, north, up, m.
    beside_m: [f64; 3],
    /// The largest of the three in SDs of the survey.
    deviations: f64,
}

#[derive(Debug, Serialize)]
struct BesideDistance {
    between: [String; 2],
    /// Distance by the flight minus the taped one, m.
    longer_m: f64,
    deviations: f64,
}

impl BesidePlace {
    /// `None` if the flight has not placed the camera.
    fn of(result: &FlightResult, surveyed: &SurveyedPlace) -> Option<Self> {
        let beside = centre(result, &surveyed.camera)? - surveyed.position;
        let deviations = beside.component_div(&surveyed.sd_m).amax();
        Some(Self { camera: surveyed.camera.to_string(), beside_m: beside.into(), deviations })
    }
}

impl BesideDistance {
    /// `None` if the flight has not placed both cameras.
    fn of(result: &FlightResult, taped: &TapedDistance) -> Option<Self> {
        let [first, second] = &taped.between;
        let longer_m = (centre(result, second)? - centre(result, first)?).norm() - taped.metres;
        Some(Self {
            between: taped.between.each_ref().map(ToString::to_string),
            longer_m,
            deviations: longer_m.abs() / taped.sd_m,
        })
    }
}

impl BesideSurvey {
    /// Compares the cameras that a flight has placed with a survey.
    pub fn of(result: &FlightResult, survey: &Survey) -> Self {
        let places = survey.places.iter().filter_map(|place| BesidePlace::of(result, place));
        let distances = survey.distances.iter().filter_map(|one| BesideDistance::of(result, one));
        Self { places: places.collect(), distances: distances.collect() }
    }

    fn off(&self) -> impl Iterator<Item = &BesidePlace> {
        self.places.iter().filter(|place| place.deviations > BESIDE)
    }

    /// Whether survey and flight contradict each other: more than one place deviates, and more than
    /// half of all do.
    pub fn contradicts(&self) -> bool {
        let off = self.off().count();
        off > 1 && 2 * off > self.places.len()
    }

    /// Remark on deviating places: all deviate by the same vector, or one belongs to another
    /// camera.
    pub fn remark(&self) -> Option<String> {
        let off: Vec<&BesidePlace> = self.off().collect();
        let names = || off.iter().map(|place| place.camera.as_str()).collect::<Vec<_>>().join(", ");
        let first = off.first()?;
        if !self.contradicts() {
            return Some(format!(
                "The survey has {} elsewhere than the flight, and counted for little: a place that \
                 was written down for another camera?",
                names()
            ));
        }
        let by = Vector3::from(first.beside_m);
        let distance = |place: &BesidePlace| (Vector3::from(place.beside_m) - by).norm();
        let [east, north, up] = first.beside_m;
        Some(if off.iter().all(|place| distance(place) < 0.1 * by.norm()) {
            format!(
                "The survey has {} all by the same elsewhere: the flight is {east:+.2}, \
                 {north:+.2}, {up:+.2} m from it. Log and survey count heights or places from \
                 another origin (--height, --geoid, --anchor).",
                names()
            )
        } else {
            format!(
                "The survey has {} elsewhere than the flight, each by something else: other units, \
                 axes, or names.",
                names()
            )
        })
    }

    /// The figures as a table, if there are any.
    pub fn render(&self) -> Option<String> {
        let mut rows = vec![["survey", "beside it [m]", "deviations"].map(str::to_owned).to_vec()];
        rows.extend(self.places.iter().map(|BesidePlace { camera, beside_m, deviations }| {
            let [east, north, up] = beside_m;
            let beside = format!("{east:+.3}, {north:+.3}, {up:+.3}");
            vec![camera.clone(), beside, format!("{deviations:.1}")]
        }));
        rows.extend(self.distances.iter().map(
            |BesideDistance { between, longer_m, deviations }| {
                vec![between.join(" to "), format!("{longer_m:+.3}"), format!("{deviations:.1}")]
            },
        ));
        (rows.len() > 1).then(|| output::table(&rows))
    }
}

/// Where the flight has a camera, if it has placed it.
fn centre(result: &FlightResult, name: &CameraName) -> Option<Point3<f64>> {
    let found = result.cameras.iter().find(|camera| camera.name == *name)?;
    Some(found.camera.pose().position())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn places(beside_m: &[[f64; 3]]) -> BesideSurvey {
        let place = |&beside_m: &[f64; 3]| BesidePlace {
            camera: "north".to_owned(),
            beside_m,
            deviations: Vector3::from(beside_m).amax() / 0.05,
        };
        BesideSurvey { places: beside_m.iter().map(place).collect(), distances: Vec::new() }
    }

    #[test]
    fn heights_over_another_sea_are_told_from_a_place_of_another_camera() {
        let good = places(&[[0.01, 0.0, 0.02], [0.0, 0.1, 0.0]]);
        assert!(good.remark().is_none() && !good.contradicts());
        let sea = places(&[[0.01, 0.0, -20.02], [0.0, 0.1, -19.9], [0.1, 0.0, -20.0]]);
        assert!(sea.contradicts());
        assert!(sea.remark().unwrap().contains("all by the same"), "{:?}", sea.remark());
        let one = places(&[[0.01, 0.0, 0.02], [0.0, 0.1, 0.03], [30.0, -12.0, 0.0]]);
        assert!(!one.contradicts());
        assert!(one.remark().unwrap().contains("written down for another"), "{:?}", one.remark());
        let feet = places(&[[30.0, 10.0, 4.0], [-60.0, 15.0, 5.0], [2.0, -70.0, 3.0]]);
        assert!(feet.contradicts() && feet.remark().unwrap().contains("other units"));
    }
}
