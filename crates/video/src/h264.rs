use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::{Duration, Instant};

use h264_reader::nal::sps::{ChromaFormat, SeqParameterSet};
use h264_reader::nal::{Nal, RefNal};
use openh264::OpenH264API;
use openh264::decoder::{DecodeOptions, DecodedYUV, Decoder, DecoderConfig, Flush};
use openh264::encoder::{
    Encoder, EncoderConfig, FrameRate, IntraFramePeriod, QpRange, RateControlMode, UsageType,
};
use openh264::formats::{YUVSlices, YUVSource};

use crate::annex_b::units;
use crate::{MOST_PIXELS, Pixels, Still};

/// Most units whose pictures are waited for: no decoder holds back more, H.264 allows 16. With half
/// of it every picture of a stream that holds back 16 would have its successor's time.
const MOST_PENDING: usize = 32;

/// The brightness of a decoded picture, row by row.
#[derive(Debug)]
pub(crate) struct DecodedPicture {
    /// When it is to be shown, in the time units of its source.
    pub(crate) shown_at: i64,
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) brightness: Vec<u8>,
}

impl DecodedPicture {
    /// It without its time.
    pub(crate) fn into_still(self) -> Still {
        let Self { width, height, brightness, .. } = self;
        Still { width, height, pixels: Pixels::Gray8(brightness) }
    }
}

/// Decodes H.264 to brightness, every picture with its own time.
///
/// A decoder may hold pictures back until it is sure that none is to be shown before them, and in
/// most profiles it is never sure. A live stream is assumed to be in display order until it says
/// otherwise or shows a picture that builds on later ones (a B slice); until then each picture
/// comes out at once, with the time of its own unit.
pub(crate) struct H264Decoder {
    decoder: Decoder,
    /// Whether pictures may come out in another order than their units.
    reorders: bool,
    /// Times of the units whose pictures have not come out yet. Pictures come out in display order,
    /// so the smallest time belongs to the next picture.
    pending: BinaryHeap<Reverse<i64>>,
    /// What kind its pictures are, if that kind cannot be decoded.
    unreadable: Option<String>,
}

impl H264Decoder {
    /// A decoder of a file, whose pictures may come late.
    pub(crate) fn of_file() -> Result<Self, String> {
        Self::new(true)
    }

    /// A decoder of a live stream.
    pub(crate) fn of_stream() -> Result<Self, String> {
        Self::new(false)
    }

    fn new(reorders: bool) -> Result<Self, String> {
        let decoder = Decoder::with_api_config(OpenH264API::from_source(), DecoderConfig::new())
            .map_err(|error| in_words(&error))?;
        Ok(Self { decoder, reorders, pending: BinaryHeap::new(), unreadable: None })
    }

    /// Decodes an access unit in Annex B; `None` if its picture comes out later.
    pub(crate) fn decode(
        &mut self,
        unit: &[u8],
        shown_at: i64,
    ) -> Result<Option<DecodedPicture>, String> {
        self.pending.push(Reverse(shown_at));
        if self.pending.len() > MOST_PENDING {
            // Some units have no picture: nothing will come out for the oldest.
            self.pending.pop();
        }
        // If holding back started in mid-stream, the pictures up to the next key picture would be
        // spoilt. So the unit's own statements are read before it is decoded.
        self.reorders |= units(unit).any(|unit| says_it_reorders(unit) || builds_on_later(unit));
        if let Some(parameters) = units(unit).filter_map(sequence_parameters).last() {
            self.unreadable = unreadable(&parameters);
        }
        let flush = if self.reorders { Flush::NoFlush } else { Flush::Flush };
        if !self.reorders {
            // An earlier unit without a picture gets none any more: its time is dropped.
            self.pending.retain(|Reverse(time)| *time == shown_at);
        }
        let options = DecodeOptions::new().flush_after_decode(flush);
        match self.decoder.decode_with_options(unit, options) {
            Ok(Some(picture)) => picture_of(&picture, self.pending.pop()).map(Some),
            Ok(None) => Ok(None),
            Err(error) => {
                self.pending.retain(|Reverse(time)| *time != shown_at);
                Err(self.unreadable.clone().unwrap_or_else(|| in_words(&error)))
            }
        }
    }

    /// The pictures that the decoder still holds back.
    pub(crate) fn finish(&mut self) -> Result<Vec<Result<DecodedPicture, String>>, String> {
        let pictures = self.decoder.flush_remaining().map_err(|error| in_words(&error))?;
        let picture = |picture| picture_of(&picture, self.pending.pop());
        Ok(pictures.into_iter().map(picture).collect())
    }
}

/// Whether a unit (without its start code) says that pictures are not in display order. Sequence
/// parameter sets may say so (H.264, E.2.1).
fn says_it_reorders(unit: &[u8]) -> bool {
    let restrictions = || sequence_parameters(unit)?.vui_parameters?.bitstream_restrictions;
    restrictions().is_some_and(|said| said.max_num_reorder_frames > 0)
}

/// The sequence parameter set in a unit (without its start code), if it is one.
fn sequence_parameters(unit: &[u8]) -> Option<SeqParameterSet> {
    unit.first().filter(|head| **head & 0x1f == 7)?;
    SeqParameterSet::from_bits(RefNal::new(unit, &[], true).rbsp_bits()).ok()
}

/// Why a sequence's pictures cannot be decoded, if so: OpenH264 reads 8 bits and colours at a
/// quarter of the pixels (4:2:0).
fn unreadable(parameters: &SeqParameterSet) -> Option<String> {
    let of = &parameters.chroma_info;
    let colours = match of.chroma_format {
        ChromaFormat::YUV420 => None,
        ChromaFormat::Monochrome => Some("without colours (4:0:0)"),
        ChromaFormat::YUV422 => Some("4:2:2"),
        ChromaFormat::YUV444 => Some("4:4:4"),
        ChromaFormat::Invalid(_) => Some("of an unknown kind"),
    };
    let bits = 8 + u32::from(of.bit_depth_luma_minus8);
    let kind = colours.map(str::to_owned).or((bits > 8).then(|| format!("of {bits} bits")))?;
    Some(format!("its pictures are {kind}: H.264 of 8 bits and 4:2:0 is read (-pix_fmt yuv420p)"))
}

/// Whether a unit (without its start code) is part of a picture that builds on later ones (a B
/// slice).
fn builds_on_later(unit: &[u8]) -> bool {
    let is_slice = unit.first().is_some_and(|head| matches!(head & 0x1f, 1 | 5));
    if !is_slice {
        return false;
    }
    let mut bits = unit.iter().skip(1).flat_map(|byte| (0..8).rev().map(move |n| byte >> n & 1));
    // Where the slice begins, and its type (H.264, 7.3.3).
    let (_, slice_type) = (exp_golomb(&mut bits), exp_golomb(&mut bits));
    slice_type % 5 == 1
}

/// The next number in Exp-Golomb code (H.264, 9.1).
fn exp_golomb(bits: &mut impl Iterator<Item = u8>) -> u64 {
    let zeros = bits.by_ref().take(32).take_while(|bit| *bit == 0).count();
    // z zeros, a 1 and z bits b: the value is 2^z + b - 1.
    bits.take(zeros).fold(1_u64, |number, bit| number << 1 | u64::from(bit)) - 1
}

/// Quantisation parameter, on H.264's scale of 0 to 51: that of a good camera. From 30 on faint
/// targets are lost in blocks; with half of it pictures are quantised four times as finely, and are
/// that much longer.
const COARSENESS: u8 = 24;

/// Encodes brightness as H.264, with a key picture once a second.
///
/// For scenes that are played as cameras play them.
pub struct H264Encoder {
    encoder: Encoder,
    /// Both colour planes of a grey picture: the middle value throughout.
    grey: Vec<u8>,
}

impl H264Encoder {
    /// An encoder for a rate in frames per second.
    ///
    /// # Errors
    /// What the encoder says.
    pub fn new(rate_hz: f64) -> Result<Self, String> {
        let config = EncoderConfig::new()
            .max_frame_rate(FrameRate::from_hz(rate_hz as f32))
            .rate_control_mode(RateControlMode::Off)
            .usage_type(UsageType::CameraVideoRealTime)
            .intra_frame_period(IntraFramePeriod::from_num_frames(rate_hz.ceil().max(1.0) as u32))
            .qp(QpRange::new(COARSENESS, COARSENESS))
            // A small target that moves slowly must not be treated as background.
            .background_detection(false)
            .adaptive_quantization(false)
            .skip_frames(false)
            .num_threads(1);
        let encoder = Encoder::with_api_config(OpenH264API::from_source(), config)
            .map_err(|error| error.to_string())?;
        Ok(Self { encoder, grey: Vec::new() })
    }

    /// Encodes a picture as an access unit in Annex B. Width and height must be even.
    ///
    /// # Errors
    /// What is wrong with the picture, or what the encoder says.
    pub fn encode(
        &mut self,
        brightness: &[u8],
        width: usize,
        height: usize,
    ) -> Result<Vec<u8>, String> {
        if !(width.is_multiple_of(2) && height.is_multiple_of(2))
            || brightness.len() != width * height
        {
            return Err(format!("{} samples are no picture of {width}x{height}", brightness.len()));
        }
        self.grey.resize(width * height / 4, 128);
        let planes = (brightness, &self.grey[..], &self.grey[..]);
        let picture = YUVSlices::new(planes, (width, height), (width, width / 2, width / 2));
        self.encoder
            .encode(&picture)
            .map(|stream| stream.to_vec())
            .map_err(|error| error.to_string())
    }
}

/// Time to decode an image of a size on this machine: the median over a moving, noisy scene.
///
/// # Errors
/// What encoder or decoder say.
pub fn decoding_time(width: usize, height: usize) -> Result<Duration, String> {
    /// Number of pictures: with half of it the median is of six, and one that the host delays
    /// counts more.
    const PICTURES: usize = 12;
    let (mut encoder, mut decoder) =
        (H264Encoder::new(PICTURES as f64)?, H264Decoder::of_stream()?);
    let mut times = Vec::new();
    // Pseudo-random noise of four levels; its kind does not matter.
    let mut noise = 1_u32;
    for number in 0..PICTURES {
        let picture: Vec<u8> = (0..width * height)
            .map(|at| {
                noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let slope = (at % width + number * 3) / 8 % 64;
                96 + slope as u8 + (noise >> 30) as u8
            })
            .collect();
        let unit = encoder.encode(&picture, width, height)?;
        let begun = Instant::now();
        decoder.decode(&unit, number as i64)?;
        times.push(begun.elapsed());
    }
    times.sort_unstable();
    Ok(times[PICTURES / 2])
}

/// A decoder error in words for people: the decoder itself only gives a number.
fn in_words(error: &openh264::Error) -> String {
    let text = error.to_string();
    let number: String = text
        .split("Native:")
        .nth(1)
        .unwrap_or("")
        .chars()
        .take_while(char::is_ascii_digit)
        .collect();
    let number = if number.is_empty() { String::new() } else { format!(" (OpenH264 {number})") };
    format!("it is damaged, or builds on one that is{number}")
}

fn picture_of(
    picture: &DecodedYUV<'_>,
    time: Option<Reverse<i64>>,
) -> Result<DecodedPicture, String> {
    let (width, height) = picture.dimensions();
    let (stride, _, _) = picture.strides();
    if width == 0 || height == 0 || (width * height) as u64 > MOST_PIXELS || stride < width {
        return Err(format!("its size is {width}x{height}"));
    }
    let mut brightness = Vec::with_capacity(width * height);
    for row in picture.y().chunks(stride).take(height) {
        brightness.extend_from_slice(&row[..width.min(row.len())]);
    }
    if brightness.len() != width * height {
        return Err("its brightness plane is cut off".to_owned());
    }
    let Reverse(shown_at) = time.ok_or("it has no time")?;
    Ok(DecodedPicture { shown_at, width, height, brightness })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_that_are_not_decoded_are_named_by_their_kind() {
        // From x264: 640x480, High 4:4:4 Predictive.
        let unit = [
            0x67, 0xf4, 0x00, 0x1e, 0x91, 0x96, 0x80, 0xa0, 0x3d, 0xb0, 0x16, 0xa0, 0xc0, 0xc0,
            0xc8, 0x00, 0x00, 0x03, 0x00, 0x08, 0x00, 0x00, 0x03, 0x01, 0xe4, 0x78, 0xb1, 0x75,
        ];
        let parameters = sequence_parameters(&unit).unwrap();
        assert!(unreadable(&parameters).unwrap().starts_with("its pictures are 4:4:4"));
        let mut decoder = H264Decoder::of_file().unwrap();
        let stream = [&[0, 0, 0, 1][..], &unit, &[0, 0, 0, 1, 0x65, 0x88, 0x84, 0x00]].concat();
        let said = decoder.decode(&stream, 0).unwrap_err();
        assert!(said.contains("4:4:4") && said.contains("yuv420p"), "{said}");

        // Pictures of our own encoder are readable.
        let pixels = vec![90; 64 * 48];
        let stream = H264Encoder::new(30.0).unwrap().encode(&pixels, 64, 48).unwrap();
        let parameters = units(&stream).find_map(sequence_parameters).unwrap();
        assert_eq!(unreadable(&parameters), None);
    }
}
