use crossfix_geometry::{Camera, Pixel};
use crossfix_message::Timestamp;
use nalgebra::{Matrix3, Point3};
use rerun::RecordingStream;
use rerun_types::archetypes::{
    Ellipsoids3D, LineStrips2D, LineStrips3D, Points2D, Points3D, Scalars, TextDocument,
    ViewCoordinates,
};
use rerun_types::components::{Color, FillMode, MediaType, Radius};

use crate::draw::{ENLARGED, ENLARGED_UP_TO_M, SIGMAS, f32s};
use crate::extent::BoundingBox;
use crate::paths::{TIMELINE, image_path};
use crate::{ViewError, blueprint, colour, draw, ground};

/// Most labels of a camera that are drawn, each at its time: a picture of ten minutes opens at
/// once with so few. With half of it such a picture has a label every 0.4 s and not every 0.2.
const MOST_SHOWN: usize = 3000;
/// Colour of the target's trajectory and of what belongs to no camera: white, as no camera's.
const WAY: Color = Color(rerun_types::datatypes::Rgba32::from_rgb(240, 240, 240));
/// Colour of the log: pink, as no camera's.
const LOG: Color = Color(rerun_types::datatypes::Rgba32::from_rgb(240, 90, 200));

/// A label of a camera's target, and where the camera should see it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeenTarget {
    /// Common time.
    pub time: Timestamp,
    /// Where the target was labelled.
    pub label: Pixel,
    /// Where the target should be seen by the adjusted trajectory.
    pub expected: Pixel,
    /// Where the target was, world, m.
    pub place: Point3<f64>,
}

/// A calibrated camera and its labels.
pub struct FlightCamera<'a> {
    /// Its name.
    pub name: String,
    /// Its lens and pose.
    pub camera: &'a Camera,
    /// Covariance of its centre, m^2.
    pub centre_covariance: Matrix3<f64>,
    /// Its labels, in the order of time.
    pub seen: Vec<SeenTarget>,
}

/// A place of the log, and the adjusted one at the same time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoggedPlace {
    /// The target's place by the log, world, m.
    pub logged: Point3<f64>,
    /// The target's place by the adjusted trajectory, world, m.
    pub place: Point3<f64>,
}

/// A flight that calibrates cameras: the cameras with the accuracy of their positions, the target's
/// trajectory, the log beside it, and in each image the labels beside where the target should be
/// seen.
pub struct FlightPicture<'a> {
    /// The cameras.
    pub cameras: Vec<FlightCamera<'a>>,
    /// The log, if there was one, in the order of time.
    pub log: Vec<LoggedPlace>,
}

impl FlightPicture<'_> {
    /// Draws all of it on a stream of [`crate::save`], and waits until it is drawn.
    ///
    /// # Errors
    /// [`ViewError`] if the stream does not take it.
    pub fn draw(&self, stream: &RecordingStream) -> Result<(), ViewError> {
        stream.set_log_time_enabled(false);
        stream.log_static("world", &ViewCoordinates::RIGHT_HAND_Z_UP())?;
        for (index, camera) in self.cameras.iter().enumerate() {
            camera.draw(stream, index as u64)?;
        }
        let way = self.way();
        self.draw_log(stream)?;
        let strip: Vec<[f32; 3]> = way.iter().map(|(_, place)| f32s(&place.coords)).collect();
        stream.log_static(
            "world/way",
            &LineStrips3D::new([strip]).with_colors([WAY]).with_radii([Radius::new_ui_points(0.8)]),
        )?;
        for (time, place) in thinned(&way) {
            stream.set_timestamp_nanos_since_epoch(TIMELINE, time.nanos());
            stream.log(
                "world/target",
                &Points3D::new([f32s(&place.coords)])
                    .with_colors([WAY])
                    .with_radii([Radius::new_ui_points(4.0)]),
            )?;
        }
        let centres = self.cameras.iter().map(|camera| camera.camera.pose().position());
        let extent = BoundingBox::of(centres.chain(way.iter().map(|(_, place)| *place)));
        ground::draw(stream, &extent)?;
        self.draw_legend(stream)?;
        let names: Vec<String> = self.cameras.iter().map(|camera| camera.name.clone()).collect();
        blueprint::send_flight(stream, &names, &extent)?;
        stream.flush_blocking().map_err(|error| ViewError::Flush(error.to_string()))
    }

    /// The target's place at each time it was seen by any camera, in the order of time.
    fn way(&self) -> Vec<(Timestamp, Point3<f64>)> {
        let seen = self.cameras.iter().flat_map(|camera| &camera.seen);
        let mut way: Vec<_> = seen.map(|seen| (seen.time, seen.place)).collect();
        way.sort_by_key(|(time, _)| *time);
        way
    }

    fn draw_log(&self, stream: &RecordingStream) -> Result<(), ViewError> {
        let places: Vec<[f32; 3]> =
            self.log.iter().map(|place| f32s(&place.logged.coords)).collect();
        let beside = self.log.iter().map(|at| [f32s(&at.logged.coords), f32s(&at.place.coords)]);
        stream.log_static(
            "world/log/places",
            &Points3D::new(places).with_colors([LOG]).with_radii([Radius::new_ui_points(1.2)]),
        )?;
        stream.log_static(
            "world/log/beside",
            &LineStrips3D::new(beside).with_colors([LOG]).with_radii([Radius::new_ui_points(0.6)]),
        )?;
        Ok(())
    }

    fn draw_legend(&self, stream: &RecordingStream) -> Result<(), ViewError> {
        let log = if self.log.is_empty() {
            ""
        } else {
            "**Pink**: the log, and lines from it to where the way has the target at its times.\n\n"
        };
        let text = format!(
            "**White**: the way of the target that all cameras have made.\n\n{log}\
             **In the images**: a camera's labels in its colour; at the time shown, the label and \
             a white point where the target should be seen.\n\n\
             **Ellipsoid** about a camera: {SIGMAS} standard deviations of its centre, drawn \
             {ENLARGED} times too large where they are below {ENLARGED_UP_TO_M} m."
        );
        let words = TextDocument::new(text).with_media_type(MediaType::markdown());
        stream.log_static("legend", &words)?;
        Ok(())
    }
}

impl FlightCamera<'_> {
    fn draw(&self, stream: &RecordingStream, index: u64) -> Result<(), ViewError> {
        draw::camera(stream, &self.name, index, self.camera, 1.0)?;
        draw::residual_plot(stream, &self.name, index)?;
        let (half_axes, turn): (Vec<_>, Vec<_>) =
            draw::ellipsoid_of(&self.centre_covariance).into_iter().unzip();
        let centre = f32s(&self.camera.pose().position().coords);
        stream.log_static(
            format!("world/covariance/{}", self.name),
            &Ellipsoids3D::from_centers_and_half_sizes(
                half_axes.iter().map(|_| centre),
                half_axes.clone(),
            )
            .with_quaternions(turn)
            .with_fill_mode(FillMode::TransparentFillMajorWireframe)
            .with_colors([colour::of(index)]),
        )?;
        let all = thinned(&self.seen).map(|seen| f32s_of(seen.label));
        stream.log_static(
            format!("{}/labels", image_path(&self.name)),
            &Points2D::new(all)
                .with_colors([colour::faint(index, 110)])
                .with_radii([Radius::new_ui_points(1.0)]),
        )?;
        for seen in thinned(&self.seen) {
            self.draw_at(stream, index, &seen)?;
        }
        Ok(())
    }

    /// Draws a label at its time, where the target should be seen, and the residual between them,
    /// px.
    fn draw_at(
        &self,
        stream: &RecordingStream,
        index: u64,
        seen: &SeenTarget,
    ) -> Result<(), ViewError> {
        stream.set_timestamp_nanos_since_epoch(TIMELINE, seen.time.nanos());
        let ends = [f32s_of(seen.label), f32s_of(seen.expected)];
        let path = image_path(&self.name);
        stream.log(
            format!("{path}/now"),
            &Points2D::new(ends)
                .with_colors([colour::of(index), WAY])
                .with_radii([Radius::new_ui_points(4.0), Radius::new_ui_points(2.0)]),
        )?;
        stream.log(
            format!("{path}/beside"),
            &LineStrips2D::new([ends]).with_colors([WAY]).with_radii([Radius::new_ui_points(1.0)]),
        )?;
        let origin = f32s(&self.camera.pose().position().coords);
        stream.log(
            format!("world/sight_lines/{}", self.name),
            &LineStrips3D::new([[origin, f32s(&seen.place.coords)]])
                .with_colors([colour::faint(index, 150)])
                .with_radii([Radius::new_ui_points(0.8)]),
        )?;
        let [dx, dy] = [seen.label.x() - seen.expected.x(), seen.label.y() - seen.expected.y()];
        stream.log(format!("plots/residual/{}", self.name), &Scalars::single(dx.hypot(dy)))?;
        Ok(())
    }
}

fn f32s_of(pixel: Pixel) -> [f32; 2] {
    [pixel.x() as f32, pixel.y() as f32]
}

/// Every n-th element, at most [`MOST_SHOWN`] in all.
fn thinned<T: Copy>(all: &[T]) -> impl Iterator<Item = T> + '_ {
    all.iter().copied().step_by(all.len().div_ceil(MOST_SHOWN).max(1))
}
