use crossfix_message::Timestamp;
use rerun::RecordingStream;
use rerun_types::archetypes::{Boxes2D, Clear, EncodedImage, Points2D, Scalars};
use rerun_types::components::{Color, MediaType, Radius};

use crate::paths::TIMELINE;
use crate::{ViewError, blueprint};

/// A rectangle in an image: left, top, width, height, pixels; (0, 0) is the upper left corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageBox {
    /// Left edge.
    pub x: f64,
    /// Upper edge.
    pub y: f64,
    /// Columns.
    pub width: f64,
    /// Rows.
    pub height: f64,
}

/// Whether a followed target was seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sight {
    /// It was measured in this image.
    Seen,
    /// Its place is predicted.
    Coasting,
    /// It is being searched for.
    Lost,
}

/// A target that is followed in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FollowedTarget {
    /// Its number.
    pub number: u64,
    /// Its box.
    pub place: ImageBox,
    /// Its centre as measured in this image, `None` if it was not measured.
    pub measured: Option<[f64; 2]>,
    /// Whether it was seen.
    pub sight: Sight,
    /// Correlation at the best place of this image.
    pub score: f64,
    /// Probability that the best place is the target.
    pub certainty: f64,
    /// Normalised innovation squared.
    pub nis: Option<f64>,
}

/// Draws an image tracker's work on a video: the images, boxes, measurements and labels, if there
/// are any, and beside them curves of each target's score, certainty and innovation.
pub struct TrackingPicture {
    stream: RecordingStream,
}

/// Colour of a target that was measured, red, green and blue: green, as of a light that is on. Like
/// those below it is bright enough for any video; with half of its levels it is lost on dark ones.
const SEEN: [u8; 3] = [80, 220, 100];
/// Colour of a target whose place is predicted: amber, between the two others.
const COASTING: [u8; 3] = [250, 200, 60];
/// Colour of a target that is searched for: red.
const LOST: [u8; 3] = [240, 80, 80];
/// Colour of a label: blue, as no target's.
const LABEL: [u8; 3] = [120, 170, 255];

fn colour(sight: Sight) -> Color {
    let [red, green, blue] = match sight {
        Sight::Seen => SEEN,
        Sight::Coasting => COASTING,
        Sight::Lost => LOST,
    };
    Color::from_rgb(red, green, blue)
}

fn name(target: &FollowedTarget) -> String {
    let sight = match target.sight {
        Sight::Seen => "seen",
        Sight::Coasting => "coasting",
        Sight::Lost => "lost",
    };
    format!("{} {sight}", target.number)
}

/// A box with its colour and name.
struct NamedBox {
    place: ImageBox,
    colour: Color,
    name: String,
}

fn boxes(drawn: impl Iterator<Item = NamedBox>) -> Boxes2D {
    let (mut corners, mut sides, mut colours, mut names) =
        (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for NamedBox { place: ImageBox { x, y, width, height }, colour, name } in drawn {
        corners.push((x as f32, y as f32));
        sides.push((width as f32, height as f32));
        colours.push(colour);
        names.push(name);
    }
    Boxes2D::from_mins_and_sizes(corners, sides)
        .with_colors(colours)
        .with_labels(names)
        .with_show_labels(false)
        .with_radii([Radius::new_ui_points(1.0)])
}

impl TrackingPicture {
    /// An empty picture on a stream of [`crate::save`].
    ///
    /// # Errors
    /// [`ViewError`] if the stream does not take it.
    pub fn new(stream: RecordingStream) -> Result<Self, ViewError> {
        stream.set_log_time_enabled(false);
        blueprint::send_tracking(&stream)?;
        Ok(Self { stream })
    }

    /// Draws one image (JPEG) with all targets that were followed in it, and its label.
    ///
    /// # Errors
    /// [`ViewError`] if the stream does not take it.
    pub fn show(
        &self,
        time: Timestamp,
        jpeg: Vec<u8>,
        targets: &[FollowedTarget],
        label: Option<ImageBox>,
    ) -> Result<(), ViewError> {
        let stream = &self.stream;
        stream.set_timestamp_nanos_since_epoch(TIMELINE, time.nanos());
        stream.log(
            "video",
            &EncodedImage::from_file_contents(jpeg).with_media_type(MediaType::jpeg()),
        )?;
        match label {
            Some(label) => {
                let [red, green, blue] = LABEL;
                let colour = Color::from_rgb(red, green, blue);
                let label = NamedBox { place: label, colour, name: "label".to_owned() };
                stream.log("video/label", &boxes(std::iter::once(label)))?;
            }
            None => stream.log("video/label", &Clear::flat())?,
        }
        let named = targets.iter().map(|target| NamedBox {
            place: target.place,
            colour: colour(target.sight),
            name: name(target),
        });
        stream.log("video/targets", &boxes(named))?;
        let measured =
            targets.iter().filter_map(|target| Some((target.measured?, colour(target.sight))));
        let (places, colours): (Vec<_>, Vec<_>) =
            measured.map(|([x, y], colour)| ((x as f32, y as f32), colour)).unzip();
        let crosses =
            Points2D::new(places).with_colors(colours).with_radii([Radius::new_ui_points(2.0)]);
        stream.log("video/measured", &crosses)?;
        for target in targets {
            let number = target.number;
            stream.log(format!("curves/{number}/score"), &Scalars::single(target.score))?;
            stream.log(format!("curves/{number}/certainty"), &Scalars::single(target.certainty))?;
            if let Some(nis) = target.nis {
                stream.log(format!("innovation/{number}"), &Scalars::single(nis.min(100.0)))?;
            }
        }
        Ok(())
    }

    /// Waits until everything is drawn.
    ///
    /// # Errors
    /// [`ViewError::Flush`].
    pub fn finish(self) -> Result<(), ViewError> {
        self.stream.flush_blocking().map_err(|error| ViewError::Flush(error.to_string()))
    }
}
