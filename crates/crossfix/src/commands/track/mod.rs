//! Following targets in a video, without a network.

#[cfg_attr(not(feature = "viewer"), path = "no_picture.rs")]
mod picture;
mod table;

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Instant;

use anyhow::{bail, ensure};
use crossfix_correlation::Plane;
use crossfix_video::{Frame, FrameClock, FrameSource, VideoError};
use crossfix_vision::{DetectorConfig, ImageTracker, PixelBox, TrackerConfig};

use crate::commands::examples;
use crate::commands::numbers;
use crate::output::{self, Draft};
use crate::repeats::Repeats;
use crate::shutdown::Shutdown;
use crate::{config, eye};
use picture::TrackPicture;
use table::FollowedTable;

/// Follow targets in a video, without a network.
///
/// The table has a row for each target and frame, and an empty one for a frame without targets:
/// frame,x,y,w,h,ok,us,id,certainty,sd_x,sd_y,vx,vy,contrast,flicker,straightness. Frames count
/// from 0; x, y, w, h are the top left corner and the size of the box in pixels; ok is 1 while the
/// target is measured or shortly predicted; us the microseconds that all targets of the frame took;
/// id the target; certainty the probability that it is there; sd_x, sd_y the standard deviations of
/// its place in pixels; vx, vy its velocity in pixels per second; contrast the standard deviation
/// of the brightness that it makes in its box and the margin about it, in those of the noise;
/// flicker the standard deviation of the contrast as a share of it; straightness the share of the
/// last two seconds' way that lies between its ends.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix track clip.mp4 --box 100,80,20,14 --csv clip.csv",
    "crossfix track clip.mp4 --detect --csv clip.csv --save clip.rrd",
    "crossfix track clip.mp4 --from 120 --box 100,80,20,14 --box 310,95,12,9 --csv clip.csv",
]))]
pub struct Args {
    /// The video: .mp4 (H.264), .avi (Motion JPEG), .y4m, or a folder of PNG or JPEG images.
    video: PathBuf,
    /// A target in the first frame that is followed (see --from): left,top,width,height in pixels.
    /// May be given several times: the targets have the numbers 1, 2, ... in that order.
    #[arg(long = "box", value_name = "X,Y,W,H", allow_hyphen_values = true)]
    places: Vec<BoxArg>,
    /// Find targets, beside those of the boxes. Without a box that is done anyway.
    #[arg(long)]
    detect: bool,
    /// The frame to begin with.
    #[arg(long, value_name = "FRAME", default_value_t = 0)]
    from: u64,
    /// The table to write (CSV); stdout without.
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Write a picture of the tracker's work for Rerun: the video, boxes, measurements, scores,
    /// certainties and innovations of every frame.
    #[arg(long, value_name = "FILE.rrd")]
    save: Option<PathBuf>,
    /// Where the target truly is (CSV with the columns frame,x,y,w,h), for that picture; in a row
    /// without a box there is no target.
    #[arg(long, value_name = "FILE", requires = "save")]
    labels: Option<PathBuf>,
    /// The tracker's configuration (TOML, the keys of a camera file's section `tracker`); its
    /// defaults without.
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration, e.g. margin_px=3.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Frame rate of image folders, frames per second.
    #[arg(long, default_value_t = 30.0, value_name = "HZ", value_parser = numbers::rate)]
    rate_hz: f64,
}

/// A box as written on the command line.
#[derive(Clone, Copy, Debug)]
pub struct BoxArg(PixelBox);

impl FromStr for BoxArg {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let misread = || format!("`{text}` is not left,top,width,height");
        let numbers = text.split(',').map(|part| part.trim().parse());
        let numbers: Vec<f64> = numbers.collect::<Result<_, _>>().map_err(|_| misread())?;
        let [x, y, width, height] = numbers[..] else { return Err(misread()) };
        let place = PixelBox { x, y, width, height };
        if place.is_possible() {
            Ok(Self(place))
        } else {
            Err("a box has sides of 1 to 1000 pixels, and a corner in or near the image".to_owned())
        }
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let mut tracker = tracker(args)?;
    let clock = FrameClock { fallback_rate_hz: args.rate_hz, ..FrameClock::default() };
    let mut source = crossfix_video::open(&args.video, clock)?;
    let inputs: Vec<&Path> =
        std::iter::once(&args.video).chain(&args.labels).map(PathBuf::as_path).collect();
    let draft =
        |path: &Option<PathBuf>| path.as_deref().map(|path| Draft::new(path, &inputs)).transpose();
    let (written, drawn) = (draft(&args.csv)?, draft(&args.save)?);
    let mut table = FollowedTable::new(written.as_ref().map(Draft::path))?;
    let picture = drawn
        .as_ref()
        .map(|draft| TrackPicture::new(draft.path(), args.labels.as_deref()))
        .transpose()?;

    let counted = follow(args, source.as_mut(), &mut tracker, &mut table, picture.as_ref())?;
    counted.ensure_usable(args)?;
    if tracker.refused() > 0 {
        tracing::warn!(
            "{} frames were refused: another size, or not after the one before",
            tracker.refused()
        );
    }
    table.finish()?;
    written.map_or(Ok(()), Draft::keep)?;
    if let (Some(picture), Some(draft), Some(path)) = (picture, drawn, &args.save) {
        picture.finish()?;
        draft.keep()?;
        output::line(format!(
            "picture written to {0}: `rerun --bind 127.0.0.1 {0}` shows it",
            path.display()
        ));
    }
    if let Some(path) = &args.csv {
        output::line(format!(
            "{} frames tracked, {} of them with a target, boxes written to {}",
            counted.tracked,
            counted.with_target,
            path.display()
        ));
    }
    if counted.is_stopped {
        tracing::warn!("stopped after {} frames: what is written ends there", counted.length);
    }
    ensure!(
        counted.with_target > 0 || counted.is_stopped,
        "no target was found in the {} frames of {}",
        counted.tracked,
        args.video.display()
    );
    Ok(())
}

/// What a video contained.
#[derive(Default)]
struct FrameCounts {
    /// Number of its frames, also of those that were skipped.
    length: u64,
    tracked: u64,
    /// Those of the tracked ones with a target.
    with_target: u64,
    /// Whether the program was asked to stop before the end.
    is_stopped: bool,
    /// Frames that could not be decoded.
    bad: u64,
}

impl FrameCounts {
    fn ensure_usable(&self, args: &Args) -> anyhow::Result<()> {
        let &Self { length, tracked, bad, .. } = self;
        let video = args.video.display();
        ensure!(
            length > args.from,
            "{video} has {length} frames, counted from 0: there is no frame {}",
            args.from
        );
        let all = tracked + bad;
        ensure!(bad <= tracked, "{video}: {bad} of {all} frames could not be decoded");
        Ok(())
    }
}

/// Follows the targets through a video, to its end or until the program is asked to stop.
fn follow(
    args: &Args,
    source: &mut dyn FrameSource,
    tracker: &mut ImageTracker,
    table: &mut FollowedTable,
    picture: Option<&TrackPicture>,
) -> anyhow::Result<FrameCounts> {
    let mut repeats = Repeats::default();
    let mut counted = FrameCounts::default();
    let shutdown = Shutdown::listen();
    while !shutdown.requested()
        && let Some((index, read)) = next_frame(source, &mut repeats)?
    {
        counted.length = index + 1;
        if index < args.from {
            continue;
        }
        let image = read.as_ref().and_then(eye::brightness);
        let (Some(frame), Some(image)) = (&read, &image) else {
            if read.is_some() {
                repeats.warn("no pixels", Instant::now(), || {
                    format!("frame {index} has no pixels; going on")
                });
            }
            counted.bad += 1;
            table.write(index, &[], 0.0)?;
            continue;
        };
        if counted.tracked == 0 {
            ensure_inside(&args.places, image)?;
        }
        let begun = Instant::now();
        let tracks = tracker.step(image, frame.capture.time);
        let microseconds = begun.elapsed().as_secs_f64() * 1e6;
        counted.tracked += 1;
        counted.with_target += u64::from(!tracks.is_empty());
        table.write(index, tracks, microseconds)?;
        if let Some(picture) = picture {
            picture.show(frame, image, tracks)?;
        }
    }
    repeats.remind(Instant::now());
    counted.is_stopped = shutdown.requested();
    Ok(counted)
}

/// Refuses boxes of which no part lies in the image.
fn ensure_inside(places: &[BoxArg], image: &Plane) -> anyhow::Result<()> {
    let (width, height) = (image.width(), image.height());
    for BoxArg(PixelBox { x, y, width: wide, height: high }) in places {
        ensure!(
            x + wide > 0.0 && *x < width as f64 && y + high > 0.0 && *y < height as f64,
            "the box {x},{y},{wide},{high} lies outside the image of {width}x{height} pixels"
        );
    }
    Ok(())
}

/// The tracker that the arguments ask for, with the targets to follow from the first frame on.
fn tracker(args: &Args) -> anyhow::Result<ImageTracker> {
    let mut config: TrackerConfig = match &args.config {
        Some(path) => config::load(path, &args.sets, config::FileKind::Tracker)?,
        None => config::parse("", &args.sets)?,
    };
    if (args.detect || args.places.is_empty()) && config.detector.is_none() {
        config.detector = Some(DetectorConfig::default());
    }
    let mut tracker = ImageTracker::new(config)?;
    for BoxArg(place) in &args.places {
        tracker.take_up(*place);
    }
    Ok(tracker)
}

/// The next frame and its number, without the frame if it cannot be decoded; `None` at the end.
pub(crate) fn next_frame(
    source: &mut dyn FrameSource,
    repeats: &mut Repeats,
) -> anyhow::Result<Option<(u64, Option<Frame>)>> {
    match source.next_frame() {
        Ok(frame) => Ok(frame.map(|frame| (frame.index, Some(frame)))),
        Err(error @ VideoError::Frame { index, .. }) => {
            repeats.warn("bad frame", Instant::now(), || format!("{error}; going on"));
            Ok(Some((index, None)))
        }
        Err(error) => bail!(error),
    }
}
