use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Instant;

use anyhow::{Context, bail};
use crossfix_correlation::Plane;
use crossfix_video::{Frame, FrameClock, VideoError};
use crossfix_view::{FollowedTarget, ImageBox, Sight, TrackingPicture};
use crossfix_vision::{DetectorConfig, ImageTrack, ImageTracker, PixelBox, TrackPhase, TrackerConfig};

use crate::commands::numbers;
use crate::output::{self, Draft};
use crate::{config, eye};

/// Follow a target in a video, without a network.
///
/// The table has the columns frame,x,y,w,h,ok,us: frames from 0, top left corner and size of the
/// box in pixels, ok 1 while the target is measured or shortly predicted, microseconds of tracking.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  crossfix track clip.mp4 --box 100,80,20,14 --csv clip.csv\n  crossfix track clip.mp4 --box 100,80,20,14 --csv clip.csv --labels labels.csv --save clip.rrd"
)]
pub struct Args {
    /// The video: .mp4 (H.264), .y4m, or a folder of PNG or JPEG images.
    video: PathBuf,
    /// The target in the first frame: left,top,width,height in pixels. Without, the detector finds it.
    #[arg(long = "box", value_name = "X,Y,W,H")]
    place: Option<BoxArg>,
    /// The table to write (CSV); stdout without.
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Write a picture of the tracker's work for Rerun: the video, box, measurement, score, certainty
    /// and innovation of every frame.
    #[arg(long, value_name = "FILE.rrd")]
    save: Option<PathBuf>,
    /// Where the target truly is (CSV with the columns frame,x,y,w,h), for that picture.
    #[arg(long, value_name = "FILE", requires = "save")]
    labels: Option<PathBuf>,
    /// The tracker's configuration (TOML, the keys of a camera file's section `tracker`); its defaults without.
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration, e.g. margin_px=3.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Frame rate of image folders, frames a second.
    #[arg(long, default_value_t = 30.0, value_name = "HZ", value_parser = numbers::rate)]
    rate_hz: f64,
}

/// A box as an operator writes it.
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
            Err("a box has sides of 1 to 1000 pixels".to_owned())
        }
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let mut tracker_config: TrackerConfig = match &args.config {
        Some(path) => config::load(path, &args.sets, config::Kind::Tracker)?,
        None => config::parse("", &args.sets)?,
    };
    if args.place.is_none() && tracker_config.detector.is_none() {
        tracker_config.detector = Some(DetectorConfig::default());
    }
    let mut tracker = ImageTracker::new(tracker_config)?;
    if let Some(BoxArg(place)) = args.place {
        tracker.take_up(place);
    }
    let clock = FrameClock { fallback_rate_hz: args.rate_hz, ..FrameClock::default() };
    let mut source = crossfix_video::open(&args.video, clock)?;
    let inputs: Vec<&Path> = std::iter::once(&args.video).chain(&args.labels).map(PathBuf::as_path).collect();
    let draft = |path: &Option<PathBuf>| path.as_deref().map(|path| Draft::new(path, &inputs)).transpose();
    let (table, drawn) = (draft(&args.csv)?, draft(&args.save)?);
    let sink: Box<dyn std::io::Write> = match &table {
        Some(draft) => Box::new(
            std::fs::File::create(draft.path())
                .with_context(|| format!("cannot write {}", draft.path().display()))?,
        ),
        None => Box::new(std::io::stdout().lock()),
    };
    let mut writer = csv::Writer::from_writer(sink);
    writer.write_record(["frame", "x", "y", "w", "h", "ok", "us"])?;
    let picture =
        drawn.as_ref().map(|draft| Picture::new(draft.path(), args.labels.as_deref())).transpose()?;
    let mut frames = 0_u64;
    loop {
        let frame = match source.next_frame() {
            Ok(Some(frame)) => frame,
            Ok(None) => break,
            Err(error @ VideoError::Frame { index, .. }) => {
                tracing::warn!("{error}; going on");
                writer.write_record([&index.to_string(), "", "", "", "", "0", "0"])?;
                continue;
            }
            Err(error) => bail!(error),
        };
        let Some(image) = eye::brightness(&frame) else {
            continue;
        };
        let begun = Instant::now();
        let tracks = tracker.step(&image, frame.capture.time);
        let microseconds = begun.elapsed().as_secs_f64() * 1e6;
        frames += 1;
        writer.write_record(row(frame.index, tracks.first(), microseconds))?;
        if let Some(picture) = &picture {
            picture.show(&frame, &image, tracks.first())?;
        }
    }
    if tracker.refused() > 0 {
        tracing::warn!(
            "{} frames were refused: another size, or not after the one before",
            tracker.refused()
        );
    }
    writer.flush().context("cannot write the table")?;
    drop(writer);
    table.map_or(Ok(()), Draft::keep)?;
    if let (Some(picture), Some(draft), Some(path)) = (picture, drawn, &args.save) {
        picture.picture.finish()?;
        draft.keep()?;
        output::line(format!(
            "picture written to {0}: `rerun --bind 127.0.0.1 {0}` shows it",
            path.display()
        ));
    }
    if let Some(path) = &args.csv {
        output::line(format!("{frames} frames tracked, boxes written to {}", path.display()));
    }
    Ok(())
}

/// One line of the table.
fn row(frame: u64, track: Option<&ImageTrack>, microseconds: f64) -> Vec<String> {
    let Some(track) = track else {
        let empty = String::new;
        return vec![
            frame.to_string(),
            empty(),
            empty(),
            empty(),
            empty(),
            "0".to_owned(),
            format!("{microseconds:.1}"),
        ];
    };
    let place = PixelBox::about(track.position, track.width, track.height);
    let ok = u8::from(track.phase != TrackPhase::Searching);
    let mut row = vec![frame.to_string()];
    row.extend([place.x, place.y, place.width, place.height].map(|value| format!("{value:.3}")));
    row.extend([ok.to_string(), format!("{microseconds:.1}")]);
    row
}

/// The picture of the tracker's work.
struct Picture {
    picture: TrackingPicture,
    labels: BTreeMap<u64, ImageBox>,
}

impl Picture {
    fn new(path: &Path, labels: Option<&Path>) -> anyhow::Result<Self> {
        let labels = labels.map(read_labels).transpose()?.unwrap_or_default();
        Ok(Self { picture: TrackingPicture::new(crossfix_view::save(path)?)?, labels })
    }

    fn show(&self, frame: &Frame, image: &Plane, track: Option<&ImageTrack>) -> anyhow::Result<()> {
        let bytes: Vec<u8> = image.samples().iter().map(|v| v.clamp(0.0, 255.0) as u8).collect();
        let jpeg = eye::jpeg(&bytes, image.width(), image.height()).context("cannot encode a picture")?;
        let target = track.map(|track| {
            let PixelBox { x, y, width, height } = PixelBox::about(track.position, track.width, track.height);
            FollowedTarget {
                place: ImageBox { x, y, width, height },
                // Rerun's pixels have their upper left corner at whole numbers.
                measured: track.measured.map(|m| [m.place.x + 0.5, m.place.y + 0.5]),
                sight: match track.phase {
                    TrackPhase::Tentative | TrackPhase::Tracking => Sight::Seen,
                    TrackPhase::Coasting => Sight::Coasting,
                    TrackPhase::Searching => Sight::Lost,
                },
                score: track.score,
                certainty: track.certainty,
                nis: track.nis,
            }
        });
        let label = self.labels.get(&frame.index).copied();
        self.picture.show(frame.capture.time, jpeg, target, label).context("cannot draw a frame")
    }
}

/// The boxes of a table of labels; a row without one is a frame without a target.
fn read_labels(path: &Path) -> anyhow::Result<BTreeMap<u64, ImageBox>> {
    let context = || format!("cannot read the labels in {}", path.display());
    let mut reader = csv::Reader::from_path(path).with_context(context)?;
    let columns: Vec<String> = reader.headers().with_context(context)?.iter().map(str::to_owned).collect();
    for name in ["frame", "x", "y", "w", "h"] {
        if !columns.iter().any(|column| column.trim() == name) {
            bail!("{} has no column `{name}`; it needs frame,x,y,w,h", path.display());
        }
    }
    let mut labels = BTreeMap::new();
    for record in reader.records() {
        let record = record.with_context(context)?;
        let value = |name: &str| -> Option<f64> {
            let index = columns.iter().position(|column| column.trim() == name)?;
            record.get(index)?.trim().parse().ok()
        };
        let place = (value("frame"), value("x"), value("y"), value("w"), value("h"));
        if let (Some(frame), Some(x), Some(y), Some(width), Some(height)) = place {
            labels.insert(frame as u64, ImageBox { x, y, width, height });
        }
    }
    Ok(labels)
}
