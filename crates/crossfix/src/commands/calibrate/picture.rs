//! A picture of a calibration's flight.

use std::path::Path;

use anyhow::Context;
use crossfix_calibration::{CameraResult, FittedLabel, FlightResult};
use crossfix_geometry::Pixel;
use crossfix_message::Timestamp;
use crossfix_view::{FlightCamera, FlightPicture, LoggedPlace, SeenTarget};

/// Writes the picture to a file.
pub fn draw(result: &FlightResult, path: &Path) -> anyhow::Result<()> {
    let logged = result
        .samples
        .iter()
        .map(|sample| LoggedPlace { logged: sample.logged, place: sample.place });
    let picture = FlightPicture {
        cameras: result.cameras.iter().map(camera).collect(),
        log: logged.collect(),
    };
    picture.draw(&crossfix_view::save(path)?).context("the picture is not complete")
}

fn camera(result: &CameraResult) -> FlightCamera<'_> {
    FlightCamera {
        name: result.name.to_string(),
        camera: &result.camera,
        centre_covariance: result.pose_covariance.fixed_view::<3, 3>(3, 3).into_owned(),
        seen: result.fitted.iter().map(seen).collect(),
    }
}

fn seen(label: &FittedLabel) -> SeenTarget {
    SeenTarget {
        time: Timestamp::from_seconds(label.time_s),
        label: label.pixel,
        expected: Pixel::new(
            label.pixel.x() - label.beside_px.x,
            label.pixel.y() - label.beside_px.y,
        ),
        place: label.place,
    }
}
