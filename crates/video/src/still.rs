use std::io::Cursor;

use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use crate::{MOST_PIXELS, Pixels};

/// A still image.
#[derive(Clone, Debug, PartialEq)]
pub struct Still {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` pixels.
    pub pixels: Pixels,
}

/// Decodes a PNG or JPEG image from its bytes; transparency is dropped.
///
/// # Errors
/// What is wrong, in words: neither format, damaged, or too large.
pub fn decode_still(bytes: &[u8]) -> Result<Still, String> {
    match bytes {
        [0x89, b'P', b'N', b'G', ..] => decode_png(bytes),
        [0xff, 0xd8, ..] => decode_jpeg(bytes),
        _ => Err("it is neither PNG nor JPEG".to_owned()),
    }
}

fn check_size(width: u64, height: u64) -> Result<(), String> {
    let fits = width > 0 && height > 0 && width.saturating_mul(height) <= MOST_PIXELS;
    if fits { Ok(()) } else { Err(format!("its size is {width}x{height}")) }
}

/// Keeps the first `kept` samples of every `channels`.
fn drop_alpha<T: Copy>(samples: &[T], channels: usize, kept: usize) -> Vec<T> {
    samples.chunks_exact(channels).flat_map(|pixel| &pixel[..kept]).copied().collect()
}

fn decode_png(bytes: &[u8]) -> Result<Still, String> {
    let text = |error: png::DecodingError| error.to_string();
    let mut decoder =
        png::Decoder::new_with_limits(Cursor::new(bytes), png::Limits { bytes: 64 << 20 });
    let (width, height) = decoder.read_header_info().map_err(text)?.size();
    check_size(u64::from(width), u64::from(height))?;
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(text)?;
    let size = reader.output_buffer_size().ok_or("it is too large")?;
    let mut buffer = vec![0; size];
    let info = reader.next_frame(&mut buffer).map_err(text)?;
    buffer.truncate(info.buffer_size());
    let (channels, kept) = match info.color_type {
        png::ColorType::Grayscale => (1, 1),
        png::ColorType::GrayscaleAlpha => (2, 1),
        png::ColorType::Rgb => (3, 3),
        png::ColorType::Rgba => (4, 3),
        png::ColorType::Indexed => return Err("its palette was not resolved".to_owned()),
    };
    let pixels = if info.bit_depth == png::BitDepth::Sixteen {
        let samples: Vec<u16> =
            buffer.chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect();
        let samples = drop_alpha(&samples, channels, kept);
        if kept == 1 { Pixels::Gray16(samples) } else { Pixels::Rgb16(samples) }
    } else {
        let samples = drop_alpha(&buffer, channels, kept);
        if kept == 1 { Pixels::Gray8(samples) } else { Pixels::Rgb8(samples) }
    };
    Ok(Still { width: width as usize, height: height as usize, pixels })
}

fn decode_jpeg(bytes: &[u8]) -> Result<Still, String> {
    let options = DecoderOptions::default().set_strict_mode(true);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(|error| error.to_string())?;
    let info = decoder.info().ok_or("it has no header")?;
    check_size(u64::from(info.width), u64::from(info.height))?;
    let gray = info.components == 1;
    let wanted = if gray { ColorSpace::Luma } else { ColorSpace::RGB };
    decoder.set_options(options.jpeg_set_out_colorspace(wanted));
    let samples = decoder.decode().map_err(|error| error.to_string())?;
    let pixels = if gray { Pixels::Gray8(samples) } else { Pixels::Rgb8(samples) };
    Ok(Still { width: usize::from(info.width), height: usize::from(info.height), pixels })
}
