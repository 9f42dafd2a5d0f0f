//! Splits a camera's labels into pieces that each follow one thing through the image.
//!
//! A bird that flies by is seen for a moment, the target for most of the time.

use nalgebra::Vector2;

use super::model::{CameraLabels, Label};

/// From frame to frame nothing moves farther than this share of the image's width: with half of it
/// fast targets near by fall into pieces, with twice as much a bird continues where the target was.
const STEP: f64 = 0.03;
/// A piece ends after this many frames without a label. With half of it a target that is hidden for
/// a fifth of a second, at 30 frames per second, is cut in two.
const FRAMES: f64 = 10.0;
/// The longest pieces that together have this share of all labels are taken: a third may be of
/// other things. With half of it a start may have only one straight piece of the flight to go by.
const SHARE: f64 = 0.67;
/// A piece of fewer labels does not tell by itself whether it is of the target. With half of it
/// pieces too short to tell are judged; with twice as much the labels of a bird that is followed
/// for two seconds are kept unjudged.
const LEAST: usize = 30;

/// A piece under construction: indices of its labels among all.
struct LabelPiece {
    labels: Vec<usize>,
}

impl LabelPiece {
    /// Distance of a label from the piece's last one, as a share of the distance allowed; `None` if
    /// that is exceeded.
    fn away(&self, labels: &[Label], next: &Label, step_px: f64, frame_s: f64) -> Option<f64> {
        let last = &labels[*self.labels.last()?];
        // The distance allowed grows with the frames since the last label.
        let frames = ((next.time_s - last.time_s) / frame_s).round();
        let [x, y] = [next.pixel.x() - last.pixel.x(), next.pixel.y() - last.pixel.y()];
        let share = x.hypot(y) / (step_px * frames);
        ((1.0..=FRAMES).contains(&frames) && share <= 1.0).then_some(share)
    }

    /// Whether no label from this time on can continue it.
    fn is_over(&self, labels: &[Label], time_s: f64, frame_s: f64) -> bool {
        let last_s = self.labels.last().map_or(f64::NEG_INFINITY, |last| labels[*last].time_s);
        time_s - last_s > (FRAMES + 0.5) * frame_s
    }
}

/// The labels of the longest pieces, in the order of their times.
pub(super) fn longest(camera: &CameraLabels, frame_s: f64) -> Vec<Label> {
    let labels = &camera.labels;
    let mut pieces = cut(labels, STEP * f64::from(camera.intrinsics.size.width), frame_s);
    pieces.sort_by_key(|piece| std::cmp::Reverse(piece.labels.len()));
    let enough = (SHARE * labels.len() as f64).ceil() as usize;
    let mut taken: Vec<usize> = Vec::new();
    for piece in pieces {
        if taken.len() >= enough {
            break;
        }
        taken.extend(piece.labels);
    }
    taken.sort_unstable();
    taken.into_iter().map(|index| labels[index]).collect()
}

/// Labels in pieces of one thing each, the longest first, and the labels of pieces that are too
/// short to tell.
pub(super) fn of_one_thing(camera: &CameraLabels, frame_s: f64) -> (Vec<Vec<Label>>, Vec<Label>) {
    let step_px = STEP * f64::from(camera.intrinsics.size.width);
    let mut pieces: Vec<Vec<Label>> = cut(&camera.labels, step_px, frame_s)
        .into_iter()
        .map(|piece| piece.labels.into_iter().map(|index| camera.labels[index]).collect())
        .collect();
    pieces.sort_by_key(|piece: &Vec<Label>| std::cmp::Reverse(piece.len()));
    let short = pieces.split_off(pieces.partition_point(|piece| piece.len() >= LEAST));
    (pieces, short.concat())
}

/// A lost thing is taken to be the one that next appears where it was going, within this time, s
/// (with half of it a target that is hidden for three seconds counts as two things), ...
const LOST_S: f64 = 5.0;
/// ... and within this share of the image's width, plus as much again for each second: what turns
/// at arm's length is missed, and things are few. With half of it so is a target that turned a
/// little while it was lost.
const ASTRAY: f64 = 0.05;
/// The speed of a thing in the image is taken from its first and last labels, this many of each.
/// With half of it the same: at 30 frames per second half a pixel in each then grows to 20 pixels
/// over five seconds, where hundreds are allowed.
const PACE: usize = 10;

/// Pieces (by index) that continue one another, as far as one camera can tell: a thing that was
/// lost for seconds and found again.
pub(super) fn chains(pieces: &[Vec<Label>], width_px: f64) -> Vec<Vec<usize>> {
    let mut links: Vec<(f64, usize, usize)> = Vec::new();
    for (before, piece) in pieces.iter().enumerate() {
        for (after, next) in pieces.iter().enumerate() {
            let astray = astray(piece, next, width_px);
            links.extend(astray.map(|astray| (astray, before, after)));
        }
    }
    // Greedy: the best links first, each piece with one before it and one after it at most.
    links.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut next_of: Vec<Option<usize>> = vec![None; pieces.len()];
    let mut has_before = vec![false; pieces.len()];
    for (_, before, after) in links {
        if next_of[before].is_none() && !has_before[after] {
            next_of[before] = Some(after);
            has_before[after] = true;
        }
    }
    let first = (0..pieces.len()).filter(|piece| !has_before[*piece]);
    let chain =
        |piece: usize| std::iter::successors(Some(piece), |piece| next_of[*piece]).collect();
    first.map(chain).collect()
}

/// Distance of a piece's beginning from where another piece was going, as a share of the distance
/// allowed; `None` if they are of different things.
fn astray(piece: &[Label], next: &[Label], width_px: f64) -> Option<f64> {
    let (end, start) = (piece.last()?, next.first()?);
    let gap_s = start.time_s - end.time_s;
    let from = pace(&piece[piece.len().saturating_sub(PACE)..])?;
    let to = pace(&next[..PACE.min(next.len())])?;
    // Predicted with the speed before for half of the gap and the speed after for the other half.
    let expected = in_image(end) + (from + to) * (gap_s / 2.0);
    let beside = (in_image(start) - expected).norm() / (width_px * ASTRAY * (1.0 + gap_s));
    ((0.0..LOST_S).contains(&gap_s) && beside < 1.0).then_some(beside)
}

fn in_image(label: &Label) -> Vector2<f64> {
    Vector2::new(label.pixel.x(), label.pixel.y())
}

/// Speed in the image from the first of some labels to the last, pixels per second.
fn pace(labels: &[Label]) -> Option<Vector2<f64>> {
    let (from, to) = (labels.first()?, labels.last()?);
    Some((in_image(to) - in_image(from)) / (to.time_s - from.time_s))
}

fn cut(labels: &[Label], step_px: f64, frame_s: f64) -> Vec<LabelPiece> {
    let (mut open, mut ended): (Vec<LabelPiece>, Vec<LabelPiece>) = (Vec::new(), Vec::new());
    for (index, label) in labels.iter().enumerate() {
        ended.extend(open.extract_if(.., |piece| piece.is_over(labels, label.time_s, frame_s)));
        let nearest = open
            .iter_mut()
            .filter_map(|piece| Some((piece.away(labels, label, step_px, frame_s)?, piece)))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        match nearest {
            Some((_, piece)) => piece.labels.push(index),
            // Near no piece's last label: a new thing.
            None => open.push(LabelPiece { labels: vec![index] }),
        }
    }
    ended.extend(open);
    ended
}
