//! Landmarks clicked by hand in pictures.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use crossfix_calibration::{Click, Landmark, LandmarkPlace, SurveyedLandmark};
use crossfix_geometry::{Geodetic, ImageSize, LocalFrame, Pixel};
use crossfix_message::CameraName;
use nalgebra::{Point3, Unit, Vector3};
use serde::Deserialize;

/// Standard deviation of a point clicked with the mouse, pixels. With half of it a click that is
/// two pixels off would lie four SDs off, and its landmark be suspected.
const CLICK_SD_PX: f64 = 1.0;
/// Standard deviation of a direction, degrees: tables of the sun and stars are better than this,
/// but refraction and a clock that is a second wrong amount to more. With half of it a time that is
/// four seconds wrong, in which the sky turns by 0.017 degrees, would contradict the other
/// landmarks.
const DIRECTION_SD_DEG: f64 = 0.01;

/// A row of the landmarks file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct LandmarkRow {
    camera: Option<CameraName>,
    landmark: String,
    x_px: f64,
    y_px: f64,
    sd_px: Option<f64>,
    east_m: Option<f64>,
    north_m: Option<f64>,
    up_m: Option<f64>,
    latitude_deg: Option<f64>,
    longitude_deg: Option<f64>,
    height_m: Option<f64>,
    sd_m: Option<f64>,
    sd_east_m: Option<f64>,
    sd_north_m: Option<f64>,
    sd_up_m: Option<f64>,
    /// Azimuth from north, clockwise, ...
    azimuth_deg: Option<f64>,
    /// ... and elevation above the horizon, degrees.
    elevation_deg: Option<f64>,
    sd_deg: Option<f64>,
}

/// The landmarks of each camera; rows that name no camera belong to `camera`.
pub fn read(
    path: &Path,
    camera: Option<&CameraName>,
    anchor: Option<Geodetic>,
) -> anyhow::Result<BTreeMap<CameraName, Vec<Landmark>>> {
    let wrong = || format!("cannot read the landmarks {}", path.display());
    let mut reader =
        csv::ReaderBuilder::new().trim(csv::Trim::All).from_path(path).with_context(wrong)?;
    let frame = anchor.map(LocalFrame::at);
    let mut cameras: BTreeMap<CameraName, Vec<Landmark>> = BTreeMap::new();
    for (index, record) in reader.deserialize::<LandmarkRow>().enumerate() {
        let place = || format!("the landmarks {}, row {}", path.display(), index + 2);
        let row = record.with_context(wrong)?;
        let own = row.camera.clone().or_else(|| camera.cloned()).with_context(|| {
            format!("{}: whose picture it is (column `camera`) is not said", place())
        })?;
        if camera.is_some_and(|wanted| *wanted != own) {
            continue;
        }
        let landmark = row.landmark(frame.as_ref()).with_context(place)?;
        let known = cameras.entry(own.clone()).or_default();
        ensure!(
            known.iter().all(|other| other.name != landmark.name),
            "{}: camera `{own}` has landmark `{}` twice",
            place(),
            landmark.name
        );
        known.push(landmark);
    }
    let of = camera.map_or_else(String::new, |camera| format!(" of camera `{camera}`"));
    ensure!(!cameras.is_empty(), "the landmarks {} have no rows{of}", path.display());
    Ok(cameras)
}

/// Merges the landmarks of several cameras: places of the same name are one landmark. Directions
/// (the sun) stay separate, as the sun moves from one picture to the next.
pub fn together(
    cameras: BTreeMap<CameraName, Vec<Landmark>>,
) -> anyhow::Result<Vec<SurveyedLandmark>> {
    let mut together: Vec<SurveyedLandmark> = Vec::new();
    for (camera, landmarks) in cameras {
        for Landmark { name, pixel, click_sd_px, at } in landmarks {
            let click = Click { camera: camera.clone(), pixel, sd_px: click_sd_px };
            let known = together.iter_mut().find(|known| known.name == name);
            match (known, at) {
                (Some(known), at)
                    if [known.at, at]
                        .iter()
                        .any(|at| matches!(at, LandmarkPlace::Place { .. })) =>
                {
                    ensure!(
                        known.at == at,
                        "landmark `{name}` of camera `{camera}` has another place, or deviation \
                         of it, than that of camera `{}`: call it otherwise",
                        known.clicks[0].camera
                    );
                    known.clicks.push(click);
                }
                _ => together.push(SurveyedLandmark { name, at, clicks: vec![click] }),
            }
        }
    }
    Ok(together)
}

/// Checks that all landmarks were clicked within the image.
pub fn check(landmarks: &[Landmark], size: ImageSize) -> anyhow::Result<()> {
    for Landmark { name, pixel, .. } in landmarks {
        ensure!(
            (0.0..=f64::from(size.width)).contains(&pixel.x())
                && (0.0..=f64::from(size.height)).contains(&pixel.y()),
            "landmark `{name}` was clicked at {:.0}, {:.0}, outside of the image of {} x {}",
            pixel.x(),
            pixel.y(),
            size.width,
            size.height
        );
    }
    Ok(())
}

impl LandmarkRow {
    fn landmark(&self, frame: Option<&LocalFrame>) -> anyhow::Result<Landmark> {
        let click_sd_px = self.sd_px.unwrap_or(CLICK_SD_PX);
        ensure!(
            self.x_px.is_finite() && self.y_px.is_finite() && (0.01..1e3).contains(&click_sd_px),
            "x_px, y_px and sd_px (0.01 to 1000) are no click"
        );
        Ok(Landmark {
            name: self.landmark.clone(),
            pixel: Pixel::new(self.x_px, self.y_px),
            click_sd_px,
            at: self.at(frame)?,
        })
    }

    fn at(&self, frame: Option<&LocalFrame>) -> anyhow::Result<LandmarkPlace> {
        let position = match (
            [self.east_m, self.north_m, self.up_m],
            [self.latitude_deg, self.longitude_deg, self.height_m],
            [self.azimuth_deg, self.elevation_deg],
        ) {
            ([Some(east), Some(north), Some(up)], ..) => Point3::new(east, north, up),
            (_, [Some(latitude), Some(longitude), Some(height)], _) => {
                let frame =
                    frame.context("a place in degrees needs --anchor, the site's origin")?;
                frame.local(Geodetic::from_degrees(latitude, longitude, height)?)
            }
            (_, _, [Some(azimuth), Some(elevation)]) => return self.towards(azimuth, elevation),
            _ => bail!(
                "east_m, north_m, up_m are wanted, or latitude_deg, longitude_deg, height_m, or \
                 azimuth_deg, elevation_deg"
            ),
        };
        let sd = [self.sd_east_m, self.sd_north_m, self.sd_up_m].map(|sd| sd.or(self.sd_m));
        let [Some(east), Some(north), Some(up)] = sd else {
            bail!("how well its place is known: sd_m, or sd_east_m, sd_north_m and sd_up_m")
        };
        let sd_m = Vector3::new(east, north, up);
        ensure!(
            position.iter().all(|metres| metres.abs() < 1e6)
                && sd_m.iter().all(|sd| (1e-4..1e4).contains(sd)),
            "a place is at most 1000 km away and known to 0.1 mm to 10 km"
        );
        Ok(LandmarkPlace::Place { position, sd_m })
    }

    fn towards(&self, azimuth_deg: f64, elevation_deg: f64) -> anyhow::Result<LandmarkPlace> {
        let sd_deg = self.sd_deg.unwrap_or(DIRECTION_SD_DEG);
        ensure!(
            azimuth_deg.abs() <= 360.0
                && elevation_deg.abs() <= 90.0
                && (1e-6..=10.0).contains(&sd_deg),
            "azimuth_deg, elevation_deg and sd_deg (a millionth to 10) are no direction"
        );
        // East, north, up = (sin a cos e, cos a cos e, sin e), the azimuth a counted from north.
        let (sin, cos) = azimuth_deg.to_radians().sin_cos();
        let (up, across) = elevation_deg.to_radians().sin_cos();
        let direction = Unit::new_normalize(Vector3::new(sin * across, cos * across, up));
        Ok(LandmarkPlace::Direction { direction, sd_rad: sd_deg.to_radians() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clicks(
        text: &str,
        camera: Option<&str>,
    ) -> anyhow::Result<BTreeMap<CameraName, Vec<Landmark>>> {
        let file = tempfile::NamedTempFile::new()?;
        std::fs::write(file.path(), text)?;
        let camera = camera.map(str::parse).transpose()?;
        let anchor = Geodetic::from_degrees(48.0, 11.0, 500.0)?;
        read(file.path(), camera.as_ref(), Some(anchor))
    }

    #[test]
    fn each_form_of_a_landmark_is_read() {
        let text = "camera,landmark,x_px,y_px,east_m,north_m,up_m,latitude_deg,longitude_deg,height_m,sd_m,azimuth_deg,elevation_deg\n\
            north,mast,10,20,1,2,3,,,,0.1,,\n\
            north,tower,30,40,,,,48.0,11.0,503.5,0.5,,\n\
            south,sun,50,60,,,,,,,,90,30\n";
        let cameras = clicks(text, None).unwrap();
        let [mast, tower] = &cameras[&"north".parse().unwrap()][..] else { panic!("{cameras:?}") };
        assert!(matches!(mast.at, LandmarkPlace::Place { position, .. } if position.z == 3.0));
        let LandmarkPlace::Place { position, sd_m } = tower.at else { panic!("{tower:?}") };
        assert!((position - Point3::new(0.0, 0.0, 3.5)).norm() < 1e-6 && sd_m.x == 0.5);
        let [sun] = &cameras[&"south".parse().unwrap()][..] else { panic!("{cameras:?}") };
        let LandmarkPlace::Direction { direction, .. } = sun.at else { panic!("{sun:?}") };
        assert!((direction.x - 0.75f64.sqrt()).abs() < 1e-12 && (direction.z - 0.5).abs() < 1e-12);
        assert_eq!(clicks(text, Some("south")).unwrap().len(), 1);
    }

    #[test]
    fn what_two_cameras_see_is_one_landmark_and_has_one_place() {
        let head = "camera,landmark,x_px,y_px,east_m,north_m,up_m,sd_m,azimuth_deg,elevation_deg\n";
        let rows = "north,mast,10,20,1,2,3,0.1,,\nsouth,mast,30,40,1,2,3,0.1,,\n\
            north,sun,50,60,,,,,90,30\nsouth,sun,50,60,,,,,91,31\n";
        let landmarks = together(clicks(&format!("{head}{rows}"), None).unwrap()).unwrap();
        let pictures: Vec<(&str, usize)> =
            landmarks.iter().map(|l| (l.name.as_str(), l.clicks.len())).collect();
        assert_eq!(pictures, [("mast", 2), ("sun", 1), ("sun", 1)]);
        for other in ["30,40,1,2,4,0.1", "30,40,1,2,3,0.2"] {
            let otherwise = format!("{head}{}", rows.replace("30,40,1,2,3,0.1", other));
            let error = together(clicks(&otherwise, None).unwrap()).unwrap_err().to_string();
            assert!(error.contains("`mast`") && error.contains("another place"), "{error}");
        }
    }

    #[test]
    fn what_is_wrong_is_said_with_its_row() {
        let head = "landmark,x_px,y_px,east_m,north_m,up_m,sd_m\n";
        let wrong = |rows: &str, camera: Option<&str>| {
            format!("{:#}", clicks(&format!("{head}{rows}"), camera).unwrap_err())
        };
        assert!(wrong("mast,1,2,3,4,5,0.1\n", None).contains("`camera`"));
        let twice = wrong("mast,1,2,3,4,5,0.1\nmast,1,2,3,4,5,0.1\n", Some("north"));
        assert!(twice.contains("row 3") && twice.contains("twice"), "{twice}");
        let no_sd = wrong("mast,1,2,3,4,5,\n", Some("north"));
        assert!(no_sd.contains("row 2") && no_sd.contains("sd_m"), "{no_sd}");
        let no_place = wrong("mast,1,2,3,,5,0.1\n", Some("north"));
        assert!(no_place.contains("azimuth_deg"), "{no_place}");
    }
}
