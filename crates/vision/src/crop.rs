//! Crops of an image that can be correlated: without broken samples, and continued beyond the
//! image's border.

use std::ops::Range;

use crossfix_correlation::Plane;

/// Largest brightness of a sample: no camera is brighter, and sums of larger squares would lose the
/// rest. With half of it the same: 16 bits end at 65535.
pub(crate) const BRIGHTEST: f32 = 1e6;

/// Makes broken samples (not finite, or brighter than `BRIGHTEST`) black: one of them must not
/// spoil a whole gate.
pub(crate) fn replace_invalid(plane: &mut Plane) {
    let broken = |sample: &f32| u32::from(!matches!(sample.abs(), level if level <= BRIGHTEST));
    // Counting is quicker than stopping at the first.
    if plane.samples().iter().map(broken).sum::<u32>() == 0 {
        return;
    }
    for sample in plane.samples_mut().iter_mut().filter(|sample| broken(sample) > 0) {
        *sample = 0.0;
    }
}

/// Beyond its border an image is continued by the mean of this many pixels inwards, and of this
/// many on either side along the border. Single pixels drawn out are stripes of noise, and a
/// reference with stripes of its own finds itself there; with twice as many the border of a cloud
/// becomes an edge.
const INWARDS: usize = 4;

/// The columns (or rows) of a part of an image that lie inside it, of `all` columns.
fn inside(corner: isize, side: usize, all: usize) -> Range<usize> {
    let [first, end] = [0, all as isize].map(|edge| (edge - corner).clamp(0, side as isize));
    first as usize..end as usize
}

/// The part of an image with its upper left corner at a place, which may lie outside the image.
pub(crate) fn crop(image: &Plane, corner: [isize; 2], sides: [usize; 2], part: &mut Plane) {
    image.crop_into(corner[0], corner[1], sides[0], sides[1], part);
    replace_invalid(part);
    let columns = inside(corner[0], sides[0], image.width());
    let rows = inside(corner[1], sides[1], image.height());
    if columns.is_empty()
        || rows.is_empty()
        || (columns.len() == sides[0] && rows.len() == sides[1])
    {
        return;
    }
    // Left and right first, along the rows that are inside; above and below then continue the whole
    // width, so that the corners are filled too.
    let (left, right) = borders(&columns);
    for border in
        [left, right].into_iter().filter(|border| !border.beyond(sides[0], &columns).is_empty())
    {
        let means = rows.clone().map(|y| mean(part.row(y)[border.inwards.clone()].iter().copied()));
        let means = smoothed(&means.collect::<Vec<f32>>());
        for (y, mean) in rows.clone().zip(means) {
            part.row_mut(y)[border.beyond(sides[0], &columns)].fill(mean);
        }
    }
    let (upper, lower) = borders(&rows);
    for border in
        [upper, lower].into_iter().filter(|border| !border.beyond(sides[1], &rows).is_empty())
    {
        let means = (0..sides[0]).map(|x| mean(border.inwards.clone().map(|y| part.row(y)[x])));
        let means = smoothed(&means.collect::<Vec<f32>>());
        for y in border.beyond(sides[1], &rows) {
            part.row_mut(y).copy_from_slice(&means);
        }
    }
}

/// Paints over the given columns and rows of a part, row by row from the pixel left of them to that
/// right of them: a flat patch would have edges, which stand out. At the part's edge there is one
/// side alone; what reaches from edge to edge is left, as nothing beside it says what it hides.
pub(crate) fn paint_over(part: &mut Plane, columns: &Range<usize>, rows: Range<usize>) {
    if columns.is_empty() {
        return;
    }
    for y in rows {
        let row = part.row_mut(y);
        let left = columns.start.checked_sub(1).map(|x| row[x]);
        let Some(left) = left.or(row.get(columns.end).copied()) else { continue };
        let right = row.get(columns.end).copied().unwrap_or(left);
        for (x, sample) in row[columns.clone()].iter_mut().enumerate() {
            *sample = left + (right - left) * (x as f32 + 0.5) / columns.len() as f32;
        }
    }
}

/// One border of the part that is inside an image.
struct Border {
    is_first: bool,
    /// The columns or rows next to it, inside.
    inwards: Range<usize>,
}

impl Border {
    /// The columns or rows beyond it, of `all` in the crop.
    fn beyond(&self, all: usize, inside: &Range<usize>) -> Range<usize> {
        if self.is_first { 0..inside.start } else { inside.end..all }
    }
}

fn borders(inside: &Range<usize>) -> (Border, Border) {
    let (start, end) = (inside.start, inside.end);
    (
        Border { is_first: true, inwards: start..(start + INWARDS).min(end) },
        Border { is_first: false, inwards: end.saturating_sub(INWARDS).max(start)..end },
    )
}

fn mean(samples: impl ExactSizeIterator<Item = f32>) -> f32 {
    let count = samples.len() as f32;
    samples.sum::<f32>() / count
}

/// Running means of values and their neighbours, `INWARDS` on either side.
fn smoothed(values: &[f32]) -> Vec<f32> {
    let near = |i: usize| i.saturating_sub(INWARDS)..(i + INWARDS + 1).min(values.len());
    (0..values.len()).map(|i| mean(values[near(i)].iter().copied())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn beyond_the_border_the_image_goes_on_without_its_noise() {
        let image =
            Plane::from_fn(40, 30, |x, y| 100.0 + if (x + y) % 2 == 0 { 9.0 } else { -9.0 });
        let mut part = Plane::default();
        crop(&image, [-10, 20], [30, 30], &mut part);
        for y in 0..30 {
            for x in 0..30 {
                let (is_inside, off) = (x >= 10 && y < 10, (part.row(y)[x] - 100.0).abs());
                assert!(if is_inside { off == 9.0 } else { off < 1.0 }, "{x}, {y}: {off}");
            }
        }
        let whole = part.clone();
        crop(&image, [100, 100], [30, 30], &mut part);
        assert_ne!(part.samples(), whole.samples());
        assert!(part.samples().iter().all(|sample| (sample - 100.0).abs() == 9.0));
    }

    #[test]
    fn broken_samples_become_black_and_others_stay() {
        let mut plane =
            Plane::from_fn(3, 2, |x, y| [[1.0, f32::NAN, 2.0], [1e30, 3.0, -1e30]][y][x]);
        replace_invalid(&mut plane);
        assert_eq!(plane.samples(), [1.0, 0.0, 2.0, 0.0, 3.0, 0.0]);
    }
}
