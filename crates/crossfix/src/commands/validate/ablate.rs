//! What each part of the image tracker brings.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, ensure};
use crossfix_evaluation::{ClipAblation, ClipTrials, Table, ValidationOptions, ablate_drawn};
use crossfix_video::FrameClock;
use crossfix_vision::TrackerPart;

use crate::commands::labels::read_labels;
use crate::commands::track::next_frame;
use crate::eye;
use crate::repeats::Repeats;

/// How the names of video files end; beside one may lie its table and its picture.
const VIDEOS: [&str; 3] = ["mp4", "avi", "y4m"];

/// The tables of the drawn scenes and of the videos in a folder.
pub(super) fn tables(
    options: ValidationOptions,
    clips: Option<&Path>,
    mut progress: impl FnMut(usize, usize, &str),
) -> anyhow::Result<Vec<Table>> {
    // The videos first: what is wrong with one is said before the drawn scenes have taken minutes.
    let videos = clips.map_or(Ok(Vec::new()), labelled_videos)?;
    let mut ablation = ClipAblation::default();
    for (done, video) in videos.iter().enumerate() {
        progress(done, videos.len(), &video.display().to_string());
        ablation.take(follow(video)?);
    }
    let mut tables = ablate_drawn(options, &TrackerPart::ALL, &mut progress);
    if !videos.is_empty() {
        tables.extend(ablation.tables());
    }
    Ok(tables)
}

/// The videos of a folder that have a table of labels beside them, in the order of their names.
fn labelled_videos(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let context = || format!("cannot read the folder {}", folder.display());
    let mut videos = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(context)? {
        let path = entry.with_context(context)?.path();
        let extension = path.extension().and_then(|extension| extension.to_str());
        let is_video = path.is_dir() || extension.is_some_and(|name| VIDEOS.contains(&name));
        if is_video && labels_of(&path).is_file() {
            videos.push(path);
        }
    }
    videos.sort();
    ensure!(
        !videos.is_empty(),
        "no video in {} has a table of labels of its name (.csv)",
        folder.display()
    );
    Ok(videos)
}

fn labels_of(video: &Path) -> PathBuf {
    video.with_extension("csv")
}

/// Follows the target of a video from every start, with all parts of the tracker and without each.
fn follow(video: &Path) -> anyhow::Result<ClipTrials> {
    let mut trials = ClipTrials::new(read_labels(&labels_of(video))?);
    let mut source = crossfix_video::open(video, FrameClock::default())?;
    let mut repeats = Repeats::default();
    while let Some((index, read)) = next_frame(source.as_mut(), &mut repeats)? {
        if let Some(frame) = read
            && let Some(image) = eye::brightness(&frame)
        {
            trials.step(index, &image, frame.capture.time);
        }
    }
    repeats.remind(Instant::now());
    ensure!(trials.has_begun(), "no frame of {} has a label", video.display());
    Ok(trials)
}
