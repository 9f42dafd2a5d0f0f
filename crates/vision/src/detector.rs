//! A simple detector: difference from a slow background, threshold, connected
//! regions, seen in several frames in a row.

use crossfix_correlation::Plane;

use crate::mend::mend;
use crate::{DetectorConfig, ImagePoint, PixelBox};

/// Median absolute deviation of a normal distribution of standard deviation one.
const MAD_OF_NORMAL: f32 = 0.674_49;
/// More regions than this in a frame is not targets but a change of light.
const MAX_REGIONS: usize = 200;

/// A connected region of difference.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Region {
    centre: ImagePoint,
    width: f64,
    height: f64,
}

/// A region followed from frame to frame until it is believed.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    region: Region,
    frames: u32,
}

/// Finds what differs from the background.
#[derive(Debug)]
pub(crate) struct Detector {
    config: DetectorConfig,
    background: Option<Plane>,
    frames: u32,
    candidates: Vec<Candidate>,
}

impl Detector {
    pub(crate) fn new(config: DetectorConfig) -> Self {
        Self { config, background: None, frames: 0, candidates: Vec::new() }
    }

    /// Takes the next image and returns the boxes of new targets; regions that touch a box of
    /// `known` are somebody's already.
    pub(crate) fn step(&mut self, image: &Plane, known: &[PixelBox]) -> Vec<PixelBox> {
        let size = |plane: &Plane| (plane.width(), plane.height());
        let Some(background) = self.background.as_mut().filter(|b| size(b) == size(image)) else {
            let mut first = image.clone();
            mend(&mut first);
            self.background = Some(first);
            self.frames = 1;
            self.candidates.clear();
            return Vec::new();
        };
        let mut difference = image.clone();
        mend(&mut difference);
        for (value, old) in difference.samples_mut().iter_mut().zip(background.samples()) {
            *value -= old;
        }
        // A young background is the mean of what there was; an old one forgets slowly.
        let young = 1.0 - 1.0 / f64::from(self.frames + 1);
        let keep = young.min(self.config.background_memory) as f32;
        for (old, change) in background.samples_mut().iter_mut().zip(difference.samples()) {
            *old += (1.0 - keep) * change;
        }
        self.frames = self.frames.saturating_add(1);
        if self.frames <= self.config.warm_up_frames {
            return Vec::new();
        }
        let threshold = self.config.threshold_sigmas as f32 * noise_of(&difference).max(0.25);
        let regions = regions(&difference, threshold, self.config.area_px);
        self.believe(regions, known)
    }

    fn believe(&mut self, regions: Vec<Region>, known: &[PixelBox]) -> Vec<PixelBox> {
        let mut previous = std::mem::take(&mut self.candidates);
        let mut found = Vec::new();
        for region in regions.into_iter().filter(|region| !known.iter().any(|b| touches(b, region))) {
            let distance = |c: &Candidate| {
                (c.region.centre.x - region.centre.x).hypot(c.region.centre.y - region.centre.y)
            };
            let nearest = (0..previous.len())
                .filter(|&i| distance(&previous[i]) <= self.config.max_step_px)
                .min_by(|&a, &b| distance(&previous[a]).total_cmp(&distance(&previous[b])));
            let frames = nearest.map_or(0, |index| previous.swap_remove(index).frames) + 1;
            if frames >= self.config.confirm_frames {
                found.push(PixelBox::about(region.centre, region.width, region.height));
            } else {
                self.candidates.push(Candidate { region, frames });
            }
        }
        found
    }
}

/// Whether a region's middle lies in a box or within its sides of it.
fn touches(known: &PixelBox, region: &Region) -> bool {
    let centre = known.centre();
    (region.centre.x - centre.x).abs() <= known.width.max(region.width)
        && (region.centre.y - centre.y).abs() <= known.height.max(region.height)
}

/// The noise's standard deviation, from the median absolute difference: targets do not move it.
fn noise_of(difference: &Plane) -> f32 {
    // A few thousand samples tell it to two per cent; the step is odd, so as not to stay in columns.
    let step = (difference.samples().len() / 4096) | 1;
    let mut sizes: Vec<f32> =
        difference.samples().iter().step_by(step).map(|d| d.abs()).filter(|d| d.is_finite()).collect();
    if sizes.is_empty() {
        return 0.0;
    }
    let middle = sizes.len() / 2;
    let (_, median, _) = sizes.select_nth_unstable_by(middle, f32::total_cmp);
    *median / MAD_OF_NORMAL
}

/// The connected regions (eight neighbours) of samples beyond the threshold, either way.
fn regions(difference: &Plane, threshold: f32, [least, most]: [usize; 2]) -> Vec<Region> {
    let (width, height) = (difference.width(), difference.height());
    let mut open: Vec<bool> = difference.samples().iter().map(|d| d.abs() > threshold).collect();
    let mut regions = Vec::new();
    let mut stack = Vec::new();
    for start in 0..open.len() {
        if !std::mem::take(&mut open[start]) {
            continue;
        }
        stack.push(start);
        let mut sum = RegionSum::default();
        while let Some(index) = stack.pop() {
            let (x, y) = (index % width, index / width);
            sum.add(x, y, f64::from(difference.samples()[index].abs()));
            for ny in y.saturating_sub(1)..=(y + 1).min(height - 1) {
                for nx in x.saturating_sub(1)..=(x + 1).min(width - 1) {
                    if std::mem::take(&mut open[ny * width + nx]) {
                        stack.push(ny * width + nx);
                    }
                }
            }
        }
        if (least..=most).contains(&sum.pixels) {
            regions.push(sum.region());
        }
    }
    if regions.len() > MAX_REGIONS { Vec::new() } else { regions }
}

/// Sums over the pixels of a region.
#[derive(Debug)]
struct RegionSum {
    pixels: usize,
    weight: f64,
    x: f64,
    y: f64,
    low: [usize; 2],
    high: [usize; 2],
}

impl Default for RegionSum {
    fn default() -> Self {
        Self { pixels: 0, weight: 0.0, x: 0.0, y: 0.0, low: [usize::MAX; 2], high: [0; 2] }
    }
}

impl RegionSum {
    fn add(&mut self, x: usize, y: usize, weight: f64) {
        self.pixels += 1;
        self.weight += weight;
        self.x += weight * x as f64;
        self.y += weight * y as f64;
        for (axis, value) in [x, y].into_iter().enumerate() {
            self.low[axis] = self.low[axis].min(value);
            self.high[axis] = self.high[axis].max(value);
        }
    }

    fn region(&self) -> Region {
        // The centre of brightness, and a box about it that holds the whole region.
        let centre = ImagePoint { x: self.x / self.weight, y: self.y / self.weight };
        let side = |axis: usize, middle: f64| {
            let reach = (middle - self.low[axis] as f64).max(self.high[axis] as f64 - middle);
            (2.0 * reach + 1.0).ceil().max(4.0)
        };
        Region { centre, width: side(0, centre.x), height: side(1, centre.y) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(x: f32, noise_seed: u32) -> Plane {
        let mut state = noise_seed | 1;
        Plane::from_fn(120, 90, |column, row| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let noise = (state >> 16) as f32 / 65536.0 * 4.0;
            let (dx, dy) = (column as f32 - x, row as f32 - 40.0);
            100.0 + noise + 80.0 * (-(dx * dx + dy * dy) / 6.0).exp()
        })
    }

    #[test]
    fn a_moving_spot_is_found_once_and_noise_is_not() {
        let mut detector = Detector::new(DetectorConfig::default());
        let mut found = Vec::new();
        for frame in 0..30_u32 {
            let known = found.clone();
            // The spot appears at frame 15.
            let x = if frame < 15 { -100.0 } else { 30.0 + 3.0 * (frame - 15) as f32 };
            let boxes = detector.step(&image(x, frame), &known);
            if found.is_empty() {
                found.extend(boxes);
            } else {
                assert!(frame < 25 || boxes.len() <= 1);
            }
        }
        assert_eq!(found.len(), 1);
        assert!(
            (found[0].centre().x - 36.0).abs() < 1.5 && (found[0].centre().y - 40.0).abs() < 1.0,
            "{found:?}"
        );
    }
}
