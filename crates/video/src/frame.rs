use std::time::Instant;

use crossfix_message::Timestamp;

/// Weights of red, green and blue in brightness (BT.601). They sum to 1: with half of them colour
/// video would be half as bright as grey.
const LUMA: [f32; 3] = [0.299, 0.587, 0.114];
/// Converts 16-bit levels to 8-bit levels: 65535 becomes 255. With half of it white would be grey.
const SIXTEEN_TO_EIGHT: f32 = 1.0 / 257.0;

/// When a frame was captured: mid-exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CaptureTime {
    /// The instant.
    pub time: Timestamp,
    /// Its standard deviation, s.
    pub sd_s: f64,
}

/// How a frame of a live source arrived.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Arrival {
    /// When its last byte arrived.
    pub at: Instant,
    /// Its time by the stream's own count, s, from an unknown instant. The count is even, whatever
    /// becomes of the clocks. After the stream was reopened it counts from another instant.
    pub stream_s: f64,
    /// Whose clock its capture time is by.
    pub timed_by: TimedBy,
}

/// Whose clock a live frame's capture time is by.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TimedBy {
    /// The camera's own, as the camera itself reports it.
    Camera,
    /// The camera's own, by its offset known from before the stream broke off and by the frame's
    /// arrival: since then the camera has not reported what its clock shows.
    Remembered,
    /// This host's, by the driver of an attached camera, or by an industrial camera's own stamps
    /// where its answers relate them to this host's clock.
    Driver,
    /// This host's: the frame's arrival less its delay. The camera has not reported yet what its
    /// clock shows, or its reports are not to be used.
    Arrival,
    /// This host's, as the camera's clock shows a very different time.
    ArrivalAgainstCamera {
        /// How far the camera's clock is ahead of this host's, s.
        camera_ahead_s: f64,
    },
}

/// The samples of an image, row by row, colours interleaved.
#[derive(Clone, Debug, PartialEq)]
pub enum Pixels {
    /// One sample of 8 bits per pixel.
    Gray8(Vec<u8>),
    /// One sample of 16 bits per pixel.
    Gray16(Vec<u16>),
    /// Red, green, blue of 8 bits.
    Rgb8(Vec<u8>),
    /// Red, green, blue of 16 bits.
    Rgb16(Vec<u16>),
}

/// One image with its number and capture time.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Number of the frame in its source, from 0.
    pub index: u64,
    /// When it was captured.
    pub capture: CaptureTime,
    /// How it arrived, if the source is live.
    pub live: Option<Arrival>,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` pixels.
    pub pixels: Pixels,
}

fn weighted<T: Copy>(samples: &[T], scale: f32, as_f32: impl Fn(T) -> f32) -> Vec<f32> {
    let luma = |[r, g, b]: [f32; 3]| LUMA[0] * r + LUMA[1] * g + LUMA[2] * b;
    let pixels = samples.chunks_exact(3).map(|p| [as_f32(p[0]), as_f32(p[1]), as_f32(p[2])]);
    pixels.map(|pixel| luma(pixel) * scale).collect()
}

impl Frame {
    /// Brightness of every pixel in 8-bit levels (0 to 255, with fractions), row by row.
    pub fn brightness(&self) -> Vec<f32> {
        match &self.pixels {
            Pixels::Gray8(samples) => samples.iter().map(|&s| f32::from(s)).collect(),
            Pixels::Gray16(samples) => {
                samples.iter().map(|&s| f32::from(s) * SIXTEEN_TO_EIGHT).collect()
            }
            Pixels::Rgb8(samples) => weighted(samples, 1.0, f32::from),
            Pixels::Rgb16(samples) => weighted(samples, SIXTEEN_TO_EIGHT, f32::from),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn white_is_255_in_every_format() {
        let of = |pixels| Frame {
            index: 0,
            capture: CaptureTime { time: Timestamp::EPOCH, sd_s: 0.0 },
            live: None,
            width: 1,
            height: 1,
            pixels,
        };
        for pixels in [
            Pixels::Gray8(vec![255]),
            Pixels::Gray16(vec![65535]),
            Pixels::Rgb8(vec![255; 3]),
            Pixels::Rgb16(vec![65535; 3]),
        ] {
            assert!((of(pixels).brightness()[0] - 255.0).abs() < 1e-3);
        }
    }
}
