//! From a camera's frame to the message with its bearings: the agent's pure part, shared by `agent`
//! and `track`.

use crossfix_correlation::Plane;
use crossfix_geometry::{Camera, GeometryError, Pixel, PixelCovariance};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraName, ClockSource, ImageTrackState, Payload, Preview,
};
use crossfix_video::{CaptureTime, Frame};
use crossfix_vision::{ImageTrack, Measurement, TargetFeatures, TrackPhase};
use jpeg_encoder::{ColorType, Encoder};
use nalgebra::{Matrix2, Vector2};

/// Quality of preview pictures, 1 to 100. With half of it a target of a few pixels is lost among
/// the edges of JPEG's blocks; with more, pictures take more of the network and the disk.
const JPEG_QUALITY: u8 = 60;

/// Brightness of a frame as the tracker takes it; `None` for a frame without pixels.
pub fn brightness(frame: &Frame) -> Option<Plane> {
    Plane::new(frame.width, frame.height, frame.brightness())
}

/// What a camera states about itself in each message.
pub struct CameraIdentity {
    pub name: CameraName,
    pub camera: Camera,
    pub clock_source: ClockSource,
}

impl CameraIdentity {
    /// The message of one exposure, and the number of tracks left out of it because the lens has no
    /// direction at their pixels.
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

    /// A track as a wire message: the measured place if there is one, else the predicted place with
    /// its own covariance, marked as predicted. The fusion needs independent measurements, so it
    /// gets the place in this image, not the image filter's estimate.
    fn bearing_track(&self, track: &ImageTrack) -> Result<BearingTrack, GeometryError> {
        let Measurement { place, covariance } = track.measured.unwrap_or_else(|| predicted(track));
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
            certainty: track.certainty,
            features: track.features.map(features),
        })
    }

    /// A small picture of a frame, as JPEG; `None` if it cannot be encoded.
    pub fn preview(&self, image: &Plane, capture: CaptureTime, divisor: usize) -> Option<Preview> {
        let (width, height) = (image.width() / divisor, image.height() / divisor);
        let small: Vec<u8> = (0..width * height)
            .map(|index| {
                let (x, y) = (index % width * divisor, index / width * divisor);
                // The mean of the block, so that a target of a few pixels does not vanish.
                let block =
                    (0..divisor * divisor).map(|i| image.row(y + i / divisor)[x + i % divisor]);
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

fn features(features: TargetFeatures) -> crossfix_message::TargetFeatures {
    let TargetFeatures { contrast, flicker, straightness } = features;
    crossfix_message::TargetFeatures { contrast, flicker, straightness }
}

/// Predicted place of a track that was not measured in this image, with its covariance: one pixel
/// of SD per axis where the tracker states none.
fn predicted(track: &ImageTrack) -> Measurement {
    let covariance = track.covariances.map_or_else(Matrix2::identity, |[x, y]| {
        Matrix2::from_diagonal(&Vector2::new(x.m11, y.m11))
    });
    Measurement { place: track.position, covariance }
}

/// 8-bit brightness as JPEG; `None` if it cannot be encoded.
pub fn jpeg(brightness: &[u8], width: usize, height: usize) -> Option<Vec<u8>> {
    let mut data = Vec::new();
    let (width, height) = (u16::try_from(width).ok()?, u16::try_from(height).ok()?);
    Encoder::new(&mut data, JPEG_QUALITY)
        .encode(brightness, width, height, ColorType::Luma)
        .ok()?;
    Some(data)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

    use crossfix_geometry::{Distortion, ImageSize, Intrinsics, Pose};
    use crossfix_vision::{ImagePoint, ImageTrackId};
    use nalgebra::Point3;

    use super::*;

    #[test]
    fn a_target_that_is_lost_goes_out_with_what_is_known_of_its_place() {
        let intrinsics = Intrinsics {
            size: ImageSize { width: 640, height: 480 },
            fx: 1000.0,
            fy: 1000.0,
            cx: 319.5,
            cy: 239.5,
            distortion: Distortion::None,
        };
        let pose =
            Pose::looking_at(Point3::new(100.0, 0.0, 2.0), Point3::new(0.0, 0.0, 50.0)).unwrap();
        let identity = CameraIdentity {
            name: "north".parse().unwrap(),
            camera: Camera::new(intrinsics, pose).unwrap(),
            clock_source: ClockSource::Ntp,
        };
        let lost = ImageTrack {
            id: ImageTrackId(7),
            phase: TrackPhase::Searching,
            position: ImagePoint { x: 319.5, y: 239.5 },
            velocity: ImagePoint { x: 0.0, y: 0.0 },
            covariances: Some([400.0, 100.0].map(|variance| Matrix2::new(variance, 0.0, 0.0, 9.0))),
            measured: None,
            width: 10.0,
            height: 6.0,
            score: 0.2,
            certainty: 0.1,
            nis: None,
            features: None,
        };
        let sent = identity.bearing_track(&lost).unwrap();
        assert_eq!(sent.state(), ImageTrackState::Coasting);
        assert_eq!(sent.certainty, 0.1);
        // At the middle of the picture a pixel is a milliradian.
        assert!((sent.covariance_xx / 400e-6 - 1.0).abs() < 1e-3, "{sent:?}");
        assert!((sent.covariance_yy / 100e-6 - 1.0).abs() < 1e-3, "{sent:?}");
    }
}
