//! Survey of a site: camera positions, taped distances, and landmarks in the cameras' pictures.

use std::path::Path;
use std::str::FromStr;

use anyhow::{Context, ensure};
use crossfix_calibration::{Survey, SurveyedLandmark, SurveyedPlace, TapedDistance};
use crossfix_message::CameraName;
use nalgebra::{Point3, Vector3};
use serde::Deserialize;

/// A taped distance, as `north,east,79.3`.
#[derive(Clone, Debug)]
pub struct Distance(TapedDistance);

/// Standard deviation of a taped distance between two marks on tripods, m. With half of it a tape
/// that was held 10 cm beside the lenses would lie four SDs off, and stretch the site.
const TAPE_SD_M: f64 = 0.05;

impl FromStr for Distance {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || "two cameras and metres are wanted, as in north,east,79.3".to_owned();
        let parts: Vec<&str> = text.split(',').map(str::trim).collect();
        let [first, second, metres] = parts.as_slice() else { return Err(wrong()) };
        let name = |name: &str| name.parse::<CameraName>().map_err(|error| error.to_string());
        let metres = metres.parse::<f64>().map_err(|_| wrong())?;
        if !(metres.is_finite() && metres > 0.0) {
            return Err("a distance is more than nothing".to_owned());
        }
        let between = [name(first)?, name(second)?];
        if between[0] == between[1] {
            return Err("a distance is between two cameras".to_owned());
        }
        Ok(Self(TapedDistance { between, metres, sd_m: TAPE_SD_M }))
    }
}

/// A row of the survey.
#[derive(Debug, Deserialize)]
struct SurveyRow {
    camera: CameraName,
    east_m: f64,
    north_m: f64,
    up_m: f64,
    /// The SD of each axis, ...
    sd_m: Option<f64>,
    /// ... or a separate one per axis.
    sd_east_m: Option<f64>,
    sd_north_m: Option<f64>,
    sd_up_m: Option<f64>,
}

impl SurveyRow {
    fn place(&self) -> Option<SurveyedPlace> {
        let sd = [self.sd_east_m, self.sd_north_m, self.sd_up_m].map(|sd| sd.or(self.sd_m));
        let [Some(east), Some(north), Some(up)] = sd else { return None };
        let place = SurveyedPlace {
            camera: self.camera.clone(),
            position: Point3::new(self.east_m, self.north_m, self.up_m),
            sd_m: Vector3::new(east, north, up),
        };
        let is_place = place.position.iter().all(|metres| metres.abs() < 1e6);
        let is_sd = place.sd_m.iter().all(|sd| (1e-4..1e4).contains(sd));
        (is_place && is_sd).then_some(place)
    }
}

/// Reads a survey; the cameras that it names must be those of the recording or site.
pub fn read(
    positions: Option<&Path>,
    distances: &[Distance],
    landmarks: Vec<SurveyedLandmark>,
    cameras: &[CameraName],
    of: &str,
) -> anyhow::Result<Survey> {
    let places = positions.map(read_places).transpose()?.unwrap_or_default();
    let distances: Vec<TapedDistance> =
        distances.iter().map(|distance| distance.0.clone()).collect();
    let named = places.iter().map(|place| &place.camera);
    let clicked = landmarks.iter().flat_map(|landmark| &landmark.clicks).map(|click| &click.camera);
    let taped = distances.iter().flat_map(|distance| &distance.between);
    for name in named.chain(taped).chain(clicked) {
        let known: Vec<&str> = cameras.iter().map(CameraName::as_str).collect();
        ensure!(
            cameras.contains(name),
            "the survey names camera `{name}`, which {of} has not: it has {}",
            known.join(", ")
        );
    }
    Ok(Survey { places, distances, landmarks, known: None })
}

fn read_places(path: &Path) -> anyhow::Result<Vec<SurveyedPlace>> {
    let wrong = || format!("cannot read the survey {}", path.display());
    let mut reader =
        csv::ReaderBuilder::new().trim(csv::Trim::All).from_path(path).with_context(wrong)?;
    let mut places: Vec<SurveyedPlace> = Vec::new();
    for (index, record) in reader.deserialize::<SurveyRow>().enumerate() {
        let row = record.with_context(wrong)?;
        let place = row.place().with_context(|| columns_wanted(path, index + 2))?;
        ensure!(
            places.iter().all(|known| known.camera != place.camera),
            "the survey {} has camera `{}` twice",
            path.display(),
            place.camera
        );
        places.push(place);
    }
    ensure!(!places.is_empty(), "the survey {} has no rows", path.display());
    Ok(places)
}

/// What a line of the survey must hold, where it does not.
fn columns_wanted(path: &Path, line: usize) -> String {
    format!(
        "the survey {}, row {line}: camera, east_m, north_m, up_m and sd_m (or sd_east_m, \
         sd_north_m and sd_up_m, from 0.0001) are wanted, in metres",
        path.display(),
    )
}
