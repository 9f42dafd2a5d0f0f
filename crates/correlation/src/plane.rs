/// A plane of samples, row by row: an image's brightness, a reference, a map of scores.
#[derive(Clone, Debug, PartialEq)]
pub struct Plane {
    width: usize,
    height: usize,
    samples: Vec<f32>,
}

impl Plane {
    /// A plane from its samples; `None` if there are not `width * height`, or none.
    pub fn new(width: usize, height: usize, samples: Vec<f32>) -> Option<Self> {
        let fits = width > 0 && height > 0 && width.checked_mul(height) == Some(samples.len());
        fits.then_some(Self { width, height, samples })
    }

    /// A plane of what a function says of column and row. Sides of zero are taken as one.
    pub fn from_fn(width: usize, height: usize, mut sample: impl FnMut(usize, usize) -> f32) -> Self {
        let (width, height) = (width.max(1), height.max(1));
        let samples = (0..width * height).map(|i| sample(i % width, i / width)).collect();
        Self { width, height, samples }
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All samples, row by row.
    pub fn samples(&self) -> &[f32] {
        &self.samples
    }

    /// All samples, to be changed.
    pub fn samples_mut(&mut self) -> &mut [f32] {
        &mut self.samples
    }

    /// One row.
    pub fn row(&self, row: usize) -> &[f32] {
        &self.samples[row * self.width..(row + 1) * self.width]
    }

    /// The sample at a place; outside the plane, the nearest one inside.
    pub fn clamped(&self, column: isize, row: isize) -> f32 {
        let column = column.clamp(0, self.width as isize - 1) as usize;
        let row = row.clamp(0, self.height as isize - 1) as usize;
        self.samples[row * self.width + column]
    }

    /// The part whose top left sample is at (`left`, `top`); beyond the border, the border goes on.
    pub fn crop(&self, left: isize, top: isize, width: usize, height: usize) -> Self {
        Self::from_fn(width, height, |x, y| self.clamped(left + x as isize, top + y as isize))
    }

    /// The part centred on a sub-pixel place, interpolated bilinearly.
    pub fn crop_centred(&self, x: f64, y: f64, width: usize, height: usize) -> Self {
        let left = x - (width as f64 - 1.0) / 2.0;
        let top = y - (height as f64 - 1.0) / 2.0;
        let (fx, fy) = ((left - left.floor()) as f32, (top - top.floor()) as f32);
        let whole = self.crop(left.floor() as isize, top.floor() as isize, width + 1, height + 1);
        Self::from_fn(width, height, |column, row| {
            let (above, below) = (whole.row(row), whole.row(row + 1));
            let upper = above[column] * (1.0 - fx) + above[column + 1] * fx;
            let lower = below[column] * (1.0 - fx) + below[column + 1] * fx;
            upper * (1.0 - fy) + lower * fy
        })
    }

    /// The mean of all samples.
    pub fn mean(&self) -> f32 {
        (self.samples.iter().map(|&s| f64::from(s)).sum::<f64>() / self.samples.len() as f64) as f32
    }
}
