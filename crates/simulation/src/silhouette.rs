//! Drone silhouettes with the sizes, contrasts and energies of Lytvynets 2020, table 1, drawn at
//! any place, size and angle.

use std::ops::Range;

/// Number of sub-samples per pixel and axis. With half of it the arm of the smallest silhouette,
/// 0.9 px thick, has fewer than four samples across.
const SUPERSAMPLING: usize = 8;
/// Standard deviation of the blur, px. With half of it edges are much finer than a pixel, and fits
/// are pulled towards whole pixels.
const BLUR: f64 = 0.35;
/// Margin around the box, pixels, into which blur and turn reach. The blurred pixel reaches 1.9 px,
/// so half of it just suffices.
const MARGIN: f64 = 4.0;
/// Half side of the silhouette as a share of the box' full side. At a half the silhouette touches
/// the box; with half of it, it has a quarter of the area, and needs a far higher contrast for the
/// table's deviation.
const FILL: f64 = 0.47;

/// The sizes of Herasymenko 2021, Fig. 3 and Lytvynets 2020, Fig. 6.1, px: they are the papers'.
pub const TEMPLATE_SIZES: [[usize; 2]; 4] = [[50, 30], [25, 15], [18, 12], [10, 6]];

/// A silhouette as brightness above the background, from 0 to about 1.
///
/// It is drawn once on a grid of an eighth of a pixel, blurred, and averaged over a pixel around
/// every sub-sample; a pixel at any place is then interpolated.
///
/// ```
/// use crossfix_simulation::Silhouette;
/// let silhouette = Silhouette::new(10, 6);
/// let mut image = vec![0.0; 40 * 30];
/// silhouette.draw(&mut image, 40, [20.3, 14.8], 1.0);
/// assert!(image[15 * 40 + 20] > 0.5);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Silhouette {
    sides: [usize; 2],
    contrast: f64,
    /// Brightness of a pixel centred at each sub-sample, row by row, and the number of sub-samples
    /// in a row.
    fine: Vec<f32>,
    fine_width: usize,
    /// Half sides of the drawn grid, px.
    reach: [f64; 2],
}

/// The standard deviation of brightness inside the box, by its width (Lytvynets 2020, table 1; that
/// of 18x12 is not in it).
fn table_deviation(width: usize) -> f64 {
    match width {
        ..=12 => 0.2943,
        13..=21 => 0.3000,
        22..=35 => 0.3132,
        _ => 0.3018,
    }
}

/// Brightness at (`u`, `v`), in units of the silhouette's own half sides, for a box of `width`
/// columns.
fn brightness(width: usize, u: f64, v: f64) -> f64 {
    let ellipse = |x: f64, rx: f64, y: f64, ry: f64| (x / rx).powi(2) + (y / ry).powi(2) < 1.0;
    let layers: &[(f64, bool)] = if width > 12 {
        &[
            (0.95, ellipse(u, 0.36, v - 0.05, 0.42)),
            (0.85, (v + 0.12).abs() < 0.14 && u.abs() < 0.88),
            (0.9, (u.abs() - 0.80).abs() < 0.10 && -0.66 < v && v < 0.05),
            (0.7, ellipse(u.abs() - 0.66, 0.34, v + 0.74, 0.2)),
            (0.8, (u.abs() - 0.45).abs() < 0.07 && 0.2 < v && v < 0.95),
            (0.8, (v - 0.90).abs() < 0.09 && 0.22 < u.abs() && u.abs() < 0.72),
            (1.0, ellipse(u, 0.16, v - 0.55, 0.25)),
        ]
    } else {
        &[
            (1.0, ellipse(u, 0.40, v - 0.25, 0.62)),
            (0.9, (v + 0.30).abs() < 0.16 && u.abs() < 0.9),
            (1.0, (v + 0.72).abs() < 0.22 && 0.48 < u.abs() && u.abs() < 1.0),
        ]
    };
    layers.iter().rev().find(|(_, inside)| *inside).map_or(0.0, |(level, _)| *level)
}

impl Silhouette {
    /// The silhouette of a box of `width` by `height` pixels.
    pub fn new(width: usize, height: usize) -> Self {
        let plain = Self::drawn([width, height], 1.0, 1.0, 0.0);
        let canvas = plain.canvas(MARGIN as usize);
        let wide = width + 2 * MARGIN as usize;
        let inside: Vec<f64> = (0..height)
            .flat_map(|y| {
                (0..width).map(move |x| (y + MARGIN as usize) * wide + x + MARGIN as usize)
            })
            .map(|i| f64::from(canvas[i]))
            .collect();
        let mean = inside.iter().sum::<f64>() / inside.len() as f64;
        let variance = inside.iter().map(|b| (b - mean).powi(2)).sum::<f64>() / inside.len() as f64;
        // Drawn again with the contrast that gives the table's deviation inside the box.
        Self::drawn([width, height], table_deviation(width) / variance.sqrt(), 1.0, 0.0)
    }

    /// The same silhouette `scale` times as large and turned, x towards y.
    #[must_use]
    pub fn turned(&self, scale: f64, angle_rad: f64) -> Self {
        Self::drawn(self.sides, self.contrast, scale, angle_rad)
    }

    fn drawn(sides: [usize; 2], contrast: f64, scale: f64, angle_rad: f64) -> Self {
        let step = 1.0 / SUPERSAMPLING as f64;
        let (cos, sin) = (angle_rad.cos(), angle_rad.sin());
        let half = sides.map(|side| scale * side as f64 / 2.0);
        // Half sides of the bounding box of the turned box.
        let spans =
            [half[0] * cos.abs() + half[1] * sin.abs(), half[0] * sin.abs() + half[1] * cos.abs()];
        let reach = spans.map(|span| (span + MARGIN).ceil());
        let [columns, rows] = reach.map(|r| 2 * r as usize * SUPERSAMPLING);
        let units = [0, 1].map(|i| scale * FILL * sides[i] as f64);
        let at = |index: usize, reach: f64| (index as f64 + 0.5) * step - reach;
        let mut fine: Vec<f32> = (0..rows * columns)
            .map(|i| {
                let (x, y) = (at(i % columns, reach[0]), at(i / columns, reach[1]));
                // Turned back into the silhouette's own axes.
                let (u, v) = ((cos * x + sin * y) / units[0], (cos * y - sin * x) / units[1]);
                (contrast * brightness(sides[0], u, v)) as f32
            })
            .collect();
        let sigma = BLUR * SUPERSAMPLING as f64;
        let span = (4.0 * sigma).ceil() as isize;
        let gaussian: Vec<f64> =
            (-span..=span).map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp()).collect();
        // The mean over a pixel centred at the upper left corner of a sub-sample.
        let pixel = vec![1.0; SUPERSAMPLING];
        for kernel in [gaussian, pixel] {
            fine = filtered(&fine, columns, &kernel);
        }
        Self { sides, contrast, fine, fine_width: columns, reach }
    }

    /// Columns and rows of the silhouette's box at scale 1.
    pub fn sides(&self) -> [usize; 2] {
        self.sides
    }

    /// Brightness of the pixel centred at (x, y) relative to the silhouette's middle, px.
    pub fn pixel(&self, x: f64, y: f64) -> f32 {
        let place = |at: f64, reach: f64| (at + reach) * SUPERSAMPLING as f64;
        let (column, row) = (place(x, self.reach[0]), place(y, self.reach[1]));
        let rows = self.fine.len() / self.fine_width;
        if column < 0.0
            || row < 0.0
            || column >= (self.fine_width - 1) as f64
            || row >= (rows - 1) as f64
        {
            return 0.0;
        }
        let (i, j) = (column as usize, row as usize);
        let (fx, fy) = ((column - i as f64) as f32, (row - j as f64) as f32);
        let at = |i: usize, j: usize| self.fine[j * self.fine_width + i];
        // Bilinear between the four sub-samples around the place.
        let upper = at(i, j) * (1.0 - fx) + at(i + 1, j) * fx;
        let lower = at(i, j + 1) * (1.0 - fx) + at(i + 1, j + 1) * fx;
        upper * (1.0 - fy) + lower * fy
    }

    /// Adds the silhouette, times `strength`, to an image of `width` columns, with its middle at
    /// `centre`.
    pub fn draw(&self, image: &mut [f32], width: usize, centre: [f64; 2], strength: f32) {
        let height = image.len() / width;
        for y in pixels_within(centre[1], self.reach[1], height) {
            for x in pixels_within(centre[0], self.reach[0], width) {
                image[y * width + x] +=
                    strength * self.pixel(x as f64 - centre[0], y as f64 - centre[1]);
            }
        }
    }

    /// The silhouette alone, in the middle of a canvas of its sides plus a margin on each side, row
    /// by row.
    pub fn canvas(&self, margin: usize) -> Vec<f32> {
        let [width, height] = self.sides.map(|side| side + 2 * margin);
        let mut image = vec![0.0; width * height];
        let centre = [width, height].map(|side| (side as f64 - 1.0) / 2.0);
        self.draw(&mut image, width, centre, 1.0);
        image
    }
}

/// The columns (or rows) of an image of `side` of them that lie within `reach` of a place.
fn pixels_within(place: f64, reach: f64, side: usize) -> Range<usize> {
    let first = (place - reach).max(0.0) as usize;
    let end = ((place + reach).max(0.0) as usize + 1).min(side);
    first..end.max(first)
}

/// Filters along the rows and the columns with a kernel normalised to sum to 1; samples outside
/// count as 0.
fn filtered(samples: &[f32], columns: usize, kernel: &[f64]) -> Vec<f32> {
    let along = filtered_along(samples, 1, columns, kernel);
    filtered_along(&along, columns, samples.len() / columns, kernel)
}

/// Filters along lines of `count` samples that lie `stride` apart.
fn filtered_along(samples: &[f32], stride: usize, count: usize, kernel: &[f64]) -> Vec<f32> {
    let sum: f64 = kernel.iter().sum();
    let filtered = |i| (filtered_sample(samples, i, stride, count, kernel) / sum) as f32;
    (0..samples.len()).map(filtered).collect()
}

/// The sum of a sample and its neighbours in the same line, weighted by the kernel.
fn filtered_sample(samples: &[f32], i: usize, stride: usize, count: usize, kernel: &[f64]) -> f64 {
    let half = kernel.len() / 2;
    let at = i / stride % count;
    let first = i - at * stride;
    let mut value = 0.0;
    for (k, tap) in kernel.iter().enumerate() {
        // Tap k takes the sample k - half steps on, if that is in the same line.
        let there = at + k;
        if there >= half && there - half < count {
            value += tap * f64::from(samples[first + (there - half) * stride]);
        }
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn energies_are_those_of_the_table() {
        // Lytvynets 2020, table 1: 136.6, 36.8 and 5.2; 19.4 follows from the assumed deviation.
        for ([width, height], wanted) in TEMPLATE_SIZES.into_iter().zip([136.6, 36.8, 19.4, 5.2]) {
            let silhouette = Silhouette::new(width, height);
            let canvas = silhouette.canvas(0);
            let mean = canvas.iter().sum::<f32>() / canvas.len() as f32;
            let energy: f32 = canvas.iter().map(|b| (b - mean).powi(2)).sum();
            assert!((energy / wanted - 1.0).abs() < 0.01, "{width}x{height}: {energy}");
        }
    }

    /// The middle of the brightness of what is drawn at a place.
    fn middle_of_drawn(silhouette: &Silhouette, place: [f64; 2]) -> [f64; 2] {
        let mut image = vec![0.0_f32; 60 * 50];
        silhouette.draw(&mut image, 60, place, 1.0);
        let (mut sum, mut moments) = (0.0, [0.0; 2]);
        for (i, brightness) in image.into_iter().map(f64::from).enumerate() {
            sum += brightness;
            moments[0] += (i % 60) as f64 * brightness;
            moments[1] += (i / 60) as f64 * brightness;
        }
        moments.map(|moment| moment / sum)
    }

    #[test]
    fn what_is_drawn_lies_where_it_is_drawn() {
        let silhouette = Silhouette::new(25, 15);
        let [x0, y0] = middle_of_drawn(&silhouette, [30.0, 25.0]);
        let [x1, y1] = middle_of_drawn(&silhouette, [30.37, 24.2]);
        assert!((x1 - x0 - 0.37).abs() < 1e-3 && (y1 - y0 + 0.8).abs() < 1e-3);
        // The silhouette is symmetric from left to right.
        assert!((x0 - 30.0).abs() < 1e-3);
    }

    #[test]
    fn a_quarter_turn_changes_the_sides() {
        let turned = Silhouette::new(25, 15).turned(1.0, std::f64::consts::FRAC_PI_2);
        assert!(turned.pixel(0.0, 11.0) > 0.1 && turned.pixel(11.0, 0.0) == 0.0);
    }
}
