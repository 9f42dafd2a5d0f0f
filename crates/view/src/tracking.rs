use crossfix_message::Timestamp;
use rerun::components::MediaType;
use rerun::{Boxes2D, Clear, Color, EncodedImage, Points2D, Radius, RecordingStream, Scalars};

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
    /// Measured in this image.
    Seen,
    /// Predicted.
    Coasting,
    /// Searched for.
    Lost,
}

/// A target that is followed in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FollowedTarget {
    /// Its box.
    pub place: ImageBox,
    /// Its centre as measured in this image, if it was.
    pub measured: Option<[f64; 2]>,
    /// Whether it was seen.
    pub sight: Sight,
    /// Correlation at the best place.
    pub score: f64,
    /// Probability of the best place.
    pub certainty: f64,
    /// Normalised innovation squared.
    pub nis: Option<f64>,
}

/// Draws a tracker's work on one video: the pictures, the box, the measurement, the label where there
/// is one, and curves of score, certainty and innovation under them.
pub struct TrackingPicture {
    stream: RecordingStream,
}

const SEEN: [u8; 3] = [80, 220, 100];
const COASTING: [u8; 3] = [250, 200, 60];
const LOST: [u8; 3] = [240, 80, 80];
const LABEL: [u8; 3] = [120, 170, 255];

fn boxes(place: ImageBox, [red, green, blue]: [u8; 3], name: &str) -> Boxes2D {
    let [x, y, width, height] = [place.x, place.y, place.width, place.height].map(|v| v as f32);
    Boxes2D::from_mins_and_sizes([(x, y)], [(width, height)])
        .with_colors([Color::from_rgb(red, green, blue)])
        .with_labels([name])
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

    /// Draws one image (JPEG) with what was followed in it, and where it was labelled.
    ///
    /// # Errors
    /// [`ViewError`] if the stream does not take it.
    pub fn show(
        &self,
        time: Timestamp,
        jpeg: Vec<u8>,
        target: Option<FollowedTarget>,
        label: Option<ImageBox>,
    ) -> Result<(), ViewError> {
        let stream = &self.stream;
        stream.set_timestamp_nanos_since_epoch(TIMELINE, time.nanos());
        stream.log("video", &EncodedImage::from_file_contents(jpeg).with_media_type(MediaType::jpeg()))?;
        match label {
            Some(label) => stream.log("video/label", &boxes(label, LABEL, "label"))?,
            None => stream.log("video/label", &Clear::flat())?,
        }
        let Some(target) = target else { return Ok(()) };
        let (colour, name) = match target.sight {
            Sight::Seen => (SEEN, "seen"),
            Sight::Coasting => (COASTING, "coasting"),
            Sight::Lost => (LOST, "lost"),
        };
        stream.log("video/target", &boxes(target.place, colour, name))?;
        match target.measured {
            Some([x, y]) => {
                let cross = Points2D::new([(x as f32, y as f32)])
                    .with_colors([Color::from_rgb(colour[0], colour[1], colour[2])]);
                stream.log("video/measured", &cross.with_radii([Radius::new_ui_points(2.0)]))?;
            }
            None => stream.log("video/measured", &Clear::flat())?,
        }
        stream.log("curves/score", &Scalars::single(target.score))?;
        stream.log("curves/certainty", &Scalars::single(target.certainty))?;
        if let Some(nis) = target.nis {
            stream.log("innovation/squared", &Scalars::single(nis.min(100.0)))?;
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
