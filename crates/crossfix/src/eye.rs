//! From a camera's frame to the message that says what it saw: the agent's
//! pure part, shared by `agent` and `track`.

use crossfix_correlation::Plane;
use crossfix_geometry::{Camera, GeometryError, Pixel, PixelCovariance};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraName, ClockSource, ImageTrackState, Payload, Preview,
};
use crossfix_video::{CaptureTime, Frame};
use crossfix_vision::{ImageTrack, Measurement, TrackPhase};
use nalgebra::Matrix2;

/// Quality of preview pictures, 1 to 100.
const JPEG_QUALITY: u8 = 60;

/// The brightness of a frame as the tracker takes it; `None` for a frame without pixels.
pub fn brightness(frame: &Frame) -> Option<Plane> {
    Plane::new(frame.width, frame.height, frame.brightness())
}

/// What a camera says of itself in each message.
pub struct CameraIdentity {
    pub name: CameraName,
    pub camera: Camera,
    pub clock_source: ClockSource,
}

impl CameraIdentity {
    /// The message of one exposure, and how many tracks are not in it, as the lens shows no direction at
    /// their pixels.
    pub fn bearing_frame(
        &self,
        sequence: u64,
        capture: CaptureTime,
        tracks: &[ImageTrack],
    ) -> (BearingFrame, u64) {
        let seen: Vec<BearingTrack> =
            tracks.iter().filter_map(|track| self.bearing_track(track).ok()).collect();
        let unseen = (tracks.len() - seen.len()) as u64;
        let frame = BearingFrame {
            camera: self.name.to_string(),
            sequence,
            capture_time_ns: capture.time.nanos(),
            capture_time_sd_s: capture.sd_s,
            clock_source: self.clock_source.into(),
            tracks: seen,
            ..Default::default()
        };
        (frame, unseen)
    }

    /// A track as it goes over the wire: the measurement where there is one, else the prediction,
    /// marked as such. The fusion wants measurements that are independent of each other, so it gets
    /// the place in this image and not the image filter's estimate.
    fn bearing_track(&self, track: &ImageTrack) -> Result<BearingTrack, GeometryError> {
        let predicted = Measurement { place: track.position, covariance: Matrix2::identity() };
        let Measurement { place, covariance } = track.measured.unwrap_or(predicted);
        let pixel = Pixel::new(place.x, place.y);
        let covariance = PixelCovariance(covariance);
        let bearing = self.camera.model().bearing(pixel, covariance)?;
        let state = match track.phase {
            TrackPhase::Tentative => ImageTrackState::Tentative,
            TrackPhase::Tracking => ImageTrackState::Tracking,
            TrackPhase::Coasting | TrackPhase::Searching => ImageTrackState::Coasting,
        };
        Ok(BearingTrack {
            track_id: track.id.0,
            bearing: Some(bearing.direction().into_inner().into()),
            covariance_xx: bearing.covariance().m11,
            covariance_xy: bearing.covariance().m12,
            covariance_yy: bearing.covariance().m22,
            pixel_x: place.x,
            pixel_y: place.y,
            velocity_x: track.velocity.x,
            velocity_y: track.velocity.y,
            width: track.width,
            height: track.height,
            score: track.score,
            state: state.into(),
        })
    }

    /// A small picture of a frame, as JPEG; `None` if it cannot be encoded.
    pub fn preview(&self, image: &Plane, capture: CaptureTime, divisor: usize) -> Option<Preview> {
        let (width, height) = (image.width() / divisor, image.height() / divisor);
        let small: Vec<u8> = (0..width * height)
            .map(|index| {
                let (x, y) = (index % width * divisor, index / width * divisor);
                // The mean of the block, so that a target of a few pixels does not vanish.
                let block = (0..divisor * divisor).map(|i| image.row(y + i / divisor)[x + i % divisor]);
                (block.sum::<f32>() / (divisor * divisor) as f32).round().clamp(0.0, 255.0) as u8
            })
            .collect();
        let data = jpeg(&small, width, height)?;
        let preview = Preview {
            camera: self.name.to_string(),
            capture_time_ns: capture.time.nanos(),
            media_type: "image/jpeg".to_owned(),
            data,
            scale: 1.0 / divisor as f64,
            ..Default::default()
        };
        Some(preview.stamped())
    }
}

/// 8-bit brightness as JPEG; `None` if it cannot be encoded.
pub fn jpeg(brightness: &[u8], width: usize, height: usize) -> Option<Vec<u8>> {
    let mut data = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut data, JPEG_QUALITY)
        .encode(brightness, width as u32, height as u32, image::ExtendedColorType::L8)
        .ok()?;
    Some(data)
}
