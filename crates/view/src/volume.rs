use std::collections::BTreeMap;

use crossfix_geometry::Camera;
use nalgebra::Point3;
use rerun::RecordingStream;
use rerun_types::archetypes::{Boxes3D, Image, Points2D, Points3D, TextDocument, ViewCoordinates};
use rerun_types::components::{Color, FillMode, MediaType, Radius};

use crate::{ViewError, blueprint, colour, draw};

/// Side of a drawn cube as a share of the cell's side, so that one sees between the cubes. With
/// half of it cubes are dots; with twice as much the nearer ones hide those behind.
const DRAWN_SHARE: f64 = 0.3;
/// Opacity of the cubes, of 255. With half of it colours mix with those behind; opaque cubes hide
/// them.
const OPACITY: u8 = 150;
/// Width and height of the colour scale's picture, pixels: high enough for its labels. With half of
/// it they would touch.
const SCALE_PX: [u32; 2] = [40, 400];
/// Number of labelled values beside the scale. With half of it values between them are hard to
/// guess, as the scale is logarithmic.
const TICKS: u32 = 6;

/// A cube of air and the standard deviation that a target's position would have in it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VolumeCell {
    /// Its centre, world, m.
    pub centre: Point3<f64>,
    /// The standard deviation, m.
    pub sd_m: f64,
}

/// A place with a standard deviation, which is coloured by the same scale.
#[derive(Clone, Debug, PartialEq)]
pub struct DrawnPlace {
    /// The place, world, m.
    pub place: Point3<f64>,
    /// The standard deviation, m.
    pub sd_m: f64,
    /// Text beside it; a place with a text is drawn larger.
    pub label: Option<String>,
}

/// A site's cameras and how accurately they measure positions in the air between them.
pub struct VolumePicture<'a> {
    /// The cameras by name.
    pub cameras: Vec<(String, &'a Camera)>,
    /// The cubes; each height is a layer that can be switched on and off.
    pub cells: Vec<VolumeCell>,
    /// Side of a cube, m.
    pub side_m: f64,
    /// Other places of interest.
    pub landmarks: Vec<DrawnPlace>,
    /// Description of what is shown (Markdown).
    pub legend: String,
}

/// Logarithmic colour scale from the best to the worst standard deviation, without the best and the
/// worst twentieth of the cells.
struct ColourScale {
    best: f64,
    worst: f64,
}

impl ColourScale {
    fn of(cells: &[VolumeCell]) -> Self {
        let mut deviations: Vec<f64> =
            cells.iter().map(|cell| cell.sd_m).filter(|sd| *sd > 0.0).collect();
        deviations.sort_by(f64::total_cmp);
        let best = quantile(&deviations, 0.05).unwrap_or(1.0);
        Self { best, worst: quantile(&deviations, 0.95).unwrap_or(1.0).max(1.01 * best) }
    }

    fn colour(&self, sd_m: f64) -> [u8; 3] {
        // share of the scale = 1 - ln(sd / best) / ln(worst / best): the best is 1, the worst 0
        colour::scale(1.0 - (sd_m / self.best).ln() / (self.worst / self.best).ln())
    }

    /// The standard deviation at a share of the scale, 0 for the best and 1 for the worst.
    fn at(&self, share: f64) -> f64 {
        self.best * (self.worst / self.best).powf(share)
    }
}

/// The number that a share of sorted numbers lies below; `None` of none.
fn quantile(sorted: &[f64], share: f64) -> Option<f64> {
    let index = share * sorted.len().saturating_sub(1) as f64;
    sorted.get(index.round() as usize).copied()
}

fn f32s(point: Point3<f64>) -> [f32; 3] {
    [point.x as f32, point.y as f32, point.z as f32]
}

impl VolumePicture<'_> {
    /// Draws all of it on a stream of [`crate::save`], and waits until it is drawn.
    ///
    /// # Errors
    /// [`ViewError`] if the stream does not take it.
    pub fn draw(&self, stream: &RecordingStream) -> Result<(), ViewError> {
        stream.set_log_time_enabled(false);
        stream.log_static("world", &ViewCoordinates::RIGHT_HAND_Z_UP())?;
        for (index, (name, camera)) in self.cameras.iter().enumerate() {
            draw::camera(stream, name, index as u64, camera, 1.0)?;
        }
        let scale = ColourScale::of(&self.cells);
        self.cubes(stream, &scale)?;
        self.landmarks(stream, &scale)?;
        draw_scale(stream, &scale)?;
        let words = TextDocument::new(self.legend.clone()).with_media_type(MediaType::markdown());
        stream.log_static("legend", &words)?;
        let cameras = self.cameras.iter().map(|(_, camera)| camera.pose().position());
        let places: Vec<Point3<f64>> =
            cameras.chain(self.landmarks.iter().map(|landmark| landmark.place)).collect();
        blueprint::send_volume(stream, &places)?;
        stream.flush_blocking().map_err(|error| ViewError::Flush(error.to_string()))
    }

    fn cubes(&self, stream: &RecordingStream, scale: &ColourScale) -> Result<(), ViewError> {
        // A layer per height, to the centimetre.
        let mut layers: BTreeMap<i64, Vec<&VolumeCell>> = BTreeMap::new();
        for cell in &self.cells {
            layers.entry((100.0 * cell.centre.z).round() as i64).or_default().push(cell);
        }
        let half = (0.5 * DRAWN_SHARE * self.side_m) as f32;
        for (height, cells) in layers {
            let colours = cells.iter().map(|cell| {
                let [red, green, blue] = scale.colour(cell.sd_m);
                Color::from_unmultiplied_rgba(red, green, blue, OPACITY)
            });
            let centres = cells.iter().map(|cell| f32s(cell.centre));
            stream.log_static(
                format!("world/volume/{:.1}_m", height as f64 / 100.0),
                &Boxes3D::from_centers_and_half_sizes(centres, cells.iter().map(|_| [half; 3]))
                    .with_fill_mode(FillMode::Solid)
                    .with_colors(colours)
                    .with_labels(cells.iter().map(|cell| format!("{:.3} m", cell.sd_m)))
                    .with_show_labels(false),
            )?;
        }
        Ok(())
    }

    fn landmarks(&self, stream: &RecordingStream, scale: &ColourScale) -> Result<(), ViewError> {
        let (named, plain): (Vec<&DrawnPlace>, Vec<&DrawnPlace>) =
            self.landmarks.iter().partition(|landmark| landmark.label.is_some());
        for (path, landmarks, radius) in
            [("world/candidates/named", named, 8.0), ("world/candidates/others", plain, 3.0)]
        {
            let colours = landmarks.iter().map(|landmark| {
                let [red, green, blue] = scale.colour(landmark.sd_m);
                Color::from_rgb(red, green, blue)
            });
            let mut points = Points3D::new(landmarks.iter().map(|landmark| f32s(landmark.place)))
                .with_colors(colours)
                .with_radii([Radius::new_ui_points(radius)]);
            let labels: Vec<&str> = landmarks.iter().filter_map(|l| l.label.as_deref()).collect();
            if !labels.is_empty() {
                points = points.with_labels(labels).with_show_labels(true);
            }
            stream.log_static(path, &points)?;
        }
        Ok(())
    }
}

/// Draws the colour scale, with the best at the top and values beside it.
fn draw_scale(stream: &RecordingStream, scale: &ColourScale) -> Result<(), ViewError> {
    let [width, height] = SCALE_PX;
    let share = |row: u32| f64::from(row) / f64::from(height - 1);
    let pixels: Vec<u8> = (0..height)
        .flat_map(|row| {
            let colour = scale.colour(scale.at(share(row)));
            (0..width).flat_map(move |_| colour)
        })
        .collect();
    stream.log_static("scale/colours", &Image::from_rgb24(pixels, SCALE_PX))?;
    let shares = || (0..TICKS).map(|tick| f64::from(tick) / f64::from(TICKS - 1));
    let places = shares().map(|share| [width as f32 + 25.0, (share * f64::from(height)) as f32]);
    stream.log_static(
        "scale/figures",
        &Points2D::new(places)
            .with_labels(shares().map(|share| format!("{:.3}", scale.at(share))))
            .with_show_labels(true)
            .with_colors([Color::from_rgb(220, 220, 220)])
            .with_radii([Radius::new_ui_points(1.0)]),
    )?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_is_of_equal_factors() {
        let cell = |sd_m| VolumeCell { centre: Point3::origin(), sd_m };
        let scale = ColourScale::of(&[cell(0.1), cell(10.0)]);
        assert_eq!(scale.colour(0.1), colour::scale(1.0));
        assert_eq!(scale.colour(1.0), colour::scale(0.5));
        assert_eq!(scale.colour(10.0), colour::scale(0.0));
        assert!((scale.at(0.5) - 1.0).abs() < 1e-12);
    }
}
