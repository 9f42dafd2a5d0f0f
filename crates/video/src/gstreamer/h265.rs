use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use gstreamer::prelude::*;
use gstreamer::{Buffer, ClockTime, Pipeline, State};
use gstreamer_app::{AppSink, AppSrc};

use super::pipeline::{Brightness, brightness, built, trouble};
use crate::h264::DecodedPicture;

/// Access units in, pictures out. One thread, as each further thread holds back another picture.
const DECODER: &str = "appsrc name=units format=time is-live=true \
                       caps=video/x-h265,stream-format=byte-stream,alignment=au ! h265parse ! \
                       avdec_h265 max-threads=1 max-errors=-1";
/// A picture that has not come out after this time counts as held back by the decoder: several
/// times what decoding 4K takes. With half of it pictures of a busy host count as held back, and
/// come a frame late; with twice as much a picture that is held back delays the first frames by
/// twice as long.
const DECODED_WITHIN: Duration = Duration::from_millis(100);
/// Most units whose pictures are waited for: H.265 allows 16 to be held back. With half of it every
/// picture of a stream that holds back 16 would be dropped as it comes out.
const MOST_PENDING: usize = 32;
/// Time that the decoder is given for the first unit: later units may be shown before it. With half
/// of it the same.
const FIRST: ClockTime = ClockTime::from_seconds(3600);
/// Nanoseconds that the decoder is given for a tick of the source; it only needs the order. With
/// half of it the same.
const TICK_NS: i64 = 1000;

/// Decodes H.265 to brightness; GStreamer carries each picture's time through.
pub(crate) struct H265Decoder {
    pipeline: Pipeline,
    units: AppSrc,
    pictures: AppSink,
    /// The source's time of the first unit, ticks.
    first: Option<i64>,
    /// Times of the units whose pictures have not come out yet: the decoder's time to the source's.
    pending: BTreeMap<ClockTime, i64>,
    /// Number of pending pictures that the decoder holds back until it is sure that none is to be
    /// shown before them.
    held_back: usize,
}

impl H265Decoder {
    pub(crate) fn new() -> Result<Self, String> {
        let (pipeline, pictures) = built(DECODER)?;
        let units = pipeline.by_name("units").and_then(|units| units.downcast::<AppSrc>().ok());
        let units = units.ok_or("GStreamer has no appsrc")?;
        pipeline.set_state(State::Playing).map_err(|error| error.to_string())?;
        Ok(Self { pipeline, units, pictures, first: None, pending: BTreeMap::new(), held_back: 0 })
    }

    /// Decodes an access unit in Annex B; returns the pictures that have come out, of earlier units
    /// too.
    pub(crate) fn decode(
        &mut self,
        unit: &[u8],
        shown_at: i64,
    ) -> Result<Vec<DecodedPicture>, String> {
        let since_first = shown_at.wrapping_sub(*self.first.get_or_insert(shown_at));
        let known = FIRST.nseconds().saturating_add_signed(since_first.saturating_mul(TICK_NS));
        let known = ClockTime::from_nseconds(known);
        let mut buffer = Buffer::from_slice(unit.to_vec());
        if let Some(buffer) = buffer.get_mut() {
            buffer.set_pts(known);
        }
        self.pending.insert(known, shown_at);
        while self.pending.len() > MOST_PENDING {
            // Some units have no picture: nothing will come out for the oldest.
            self.pending.pop_first();
        }
        self.units.push_buffer(buffer).map_err(|error| error.to_string())?;
        let pictures = self.come_out()?;
        if let Some(what) = trouble(&self.pipeline) {
            return Err(what);
        }
        Ok(pictures)
    }

    /// All pictures that have come out. Waits for one if more units are pending than the decoder
    /// holds back; if none comes in time, all pending ones count as held back.
    fn come_out(&mut self) -> Result<Vec<DecodedPicture>, String> {
        let begun = Instant::now();
        let mut pictures = Vec::new();
        loop {
            let is_due = self.pending.len() > self.held_back;
            let left = DECODED_WITHIN.saturating_sub(begun.elapsed());
            let patience = if is_due { left } else { Duration::ZERO };
            let patience = ClockTime::try_from(patience).unwrap_or(ClockTime::ZERO);
            let Some(sample) = self.pictures.try_pull_sample(patience) else {
                if is_due {
                    self.held_back = self.pending.len();
                }
                return Ok(pictures);
            };
            let known = sample.buffer().and_then(|buffer| buffer.pts());
            let Some(shown_at) = known.and_then(|known| self.pending.remove(&known)) else {
                continue;
            };
            self.held_back = self.held_back.min(self.pending.len());
            let Brightness { width, height, samples } = brightness(&sample)?;
            pictures.push(DecodedPicture { shown_at, width, height, brightness: samples });
        }
    }
}

impl Drop for H265Decoder {
    fn drop(&mut self) {
        // If it does not stop it is left: there is nobody to report that to.
        let _ = self.pipeline.set_state(State::Null);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PICTURES: u64 = 60;

    /// A flying ball as a running pipeline; `encoded_by` stands between the test pattern and the
    /// brightness.
    fn ball(encoded_by: &str) -> (Pipeline, AppSink) {
        let description = format!(
            "videotestsrc pattern=ball num-buffers={PICTURES} ! \
             video/x-raw,format=I420,width=322,height=242,framerate=30/1 {encoded_by}"
        );
        let (pipeline, sink) = built(&description).unwrap();
        pipeline.set_state(State::Playing).unwrap();
        (pipeline, sink)
    }

    /// Centroid of the bright pixels.
    fn middle(width: usize, pixels: &[u8]) -> [f64; 2] {
        let bright = pixels.iter().enumerate().filter(|(_, pixel)| **pixel > 128);
        let places: Vec<[usize; 2]> = bright.map(|(at, _)| [at % width, at / width]).collect();
        [0, 1].map(|axis| {
            places.iter().map(|place| place[axis] as f64).sum::<f64>() / places.len() as f64
        })
    }

    /// The ball as H.265 access units, each with the number of its picture.
    fn units(encoder: &str) -> Vec<(usize, Vec<u8>)> {
        gstreamer::init().unwrap();
        let description = format!(
            "videotestsrc pattern=ball num-buffers={PICTURES} ! \
             video/x-raw,format=I420,width=322,height=242,framerate=30/1 ! {encoder} ! h265parse ! \
             video/x-h265,stream-format=byte-stream,alignment=au ! \
             appsink name=units sync=false max-buffers=1000"
        );
        let pipeline = gstreamer::parse::launch(&description).unwrap();
        let pipeline = pipeline.downcast::<Pipeline>().unwrap();
        pipeline.set_state(State::Playing).unwrap();
        let sink = pipeline.by_name("units").unwrap().downcast::<AppSink>().unwrap();
        let mut units = Vec::new();
        let mut first = None;
        while let Ok(sample) = sink.pull_sample() {
            let buffer = sample.buffer().unwrap();
            let shown = buffer.pts().unwrap();
            let since_first = shown - *first.get_or_insert(shown);
            let number = (since_first.nseconds() as f64 * 30e-9).round() as usize;
            units.push((number, buffer.map_readable().unwrap().to_vec()));
        }
        pipeline.set_state(State::Null).unwrap();
        units
    }

    fn truth() -> Vec<[f64; 2]> {
        let (pipeline, sink) = ball("");
        let mut places = Vec::new();
        while let Ok(sample) = sink.pull_sample() {
            let Brightness { width, samples, .. } = brightness(&sample).unwrap();
            places.push(middle(width, &samples));
        }
        pipeline.set_state(State::Null).unwrap();
        places
    }

    /// Checks that a picture shows the ball where it was at the picture's time.
    fn check(encoder: &str, picture: &DecodedPicture, truth: &[[f64; 2]]) {
        assert_eq!((picture.width, picture.height), (322, 242));
        let number = (picture.shown_at / 3000) as usize;
        let place = middle(picture.width, &picture.brightness);
        let off = [0, 1].map(|axis| (place[axis] - truth[number][axis]).abs());
        // Pictures that build on the spoilt unit are spoilt themselves.
        let is_whole = !(30..42).contains(&number);
        assert!(!is_whole || off.iter().all(|off| *off < 0.5), "{encoder} {number}: {off:?}");
    }

    #[test]
    fn every_picture_comes_out_with_its_own_time() {
        let truth = truth();
        for (encoder, held_back) in [
            ("x265enc tune=zerolatency key-int-max=10", 1),
            // With B frames: pictures that build on later ones.
            ("x265enc key-int-max=10 option-string=bframes=3", 8),
        ] {
            let mut decoder = H265Decoder::new().unwrap();
            let mut seen = 0;
            for (sent, (number, unit)) in units(encoder).iter().enumerate() {
                // A spoilt unit gives no picture, and no later picture gets another's time.
                let unit = if sent == 35 { &unit[..unit.len() / 2] } else { &unit[..] };
                for picture in decoder.decode(unit, *number as i64 * 3000).unwrap_or_default() {
                    check(encoder, &picture, &truth);
                    seen += 1;
                }
            }
            assert!(seen >= PICTURES - 12, "{encoder}: {seen}");
            assert!(decoder.held_back <= held_back, "{encoder}: {}", decoder.held_back);
        }
    }
}
