/// Number of samples behind the last one that may be read and written without meaning: whole
/// vectors of columns can then be used at the end of a row. The widest vectors have sixteen lanes:
/// with half of it their last one ends outside.
pub(crate) const PADDING: usize = 16;

/// A two-dimensional array of samples, row by row: an image's brightness, a reference, a map of
/// scores.
#[derive(Clone, Debug)]
pub struct Plane {
    width: usize,
    height: usize,
    /// `width * height` samples, then [`PADDING`] more.
    samples: Vec<f32>,
}

impl PartialEq for Plane {
    fn eq(&self, other: &Self) -> bool {
        (self.width, self.height) == (other.width, other.height)
            && self.samples() == other.samples()
    }
}

impl Default for Plane {
    /// No samples, and no memory: a plane to be written to.
    fn default() -> Self {
        Self { width: 0, height: 0, samples: Vec::new() }
    }
}

impl Plane {
    /// A plane from its samples; `None` if there are not `width * height`, or none.
    pub fn new(width: usize, height: usize, mut samples: Vec<f32>) -> Option<Self> {
        let fits = width > 0 && height > 0 && width.checked_mul(height) == Some(samples.len());
        samples.resize(samples.len() + PADDING, 0.0);
        fits.then_some(Self { width, height, samples })
    }

    /// A plane whose samples are a function of column and row. Sides of zero are taken as one.
    pub fn from_fn(
        width: usize,
        height: usize,
        mut sample: impl FnMut(usize, usize) -> f32,
    ) -> Self {
        let (width, height) = (width.max(1), height.max(1));
        let mut plane = Self { width, height, samples: vec![0.0; width * height + PADDING] };
        for (i, value) in plane.samples_mut().iter_mut().enumerate() {
            *value = sample(i % width, i / width);
        }
        plane
    }

    /// Changes the size, keeping its memory; the samples are unspecified afterwards.
    pub fn reshape(&mut self, width: usize, height: usize) {
        (self.width, self.height) = (width.max(1), height.max(1));
        self.samples.resize(self.width * self.height + PADDING, 0.0);
    }

    /// Becomes a copy of another plane, keeping its memory.
    pub fn copy_from(&mut self, other: &Self) {
        self.reshape(other.width, other.height);
        self.samples_mut().copy_from_slice(other.samples());
    }

    /// Number of columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Number of rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All samples, row by row.
    pub fn samples(&self) -> &[f32] {
        &self.samples[..self.width * self.height]
    }

    /// All samples, mutable.
    pub fn samples_mut(&mut self) -> &mut [f32] {
        &mut self.samples[..self.width * self.height]
    }

    /// The samples from a place to the end, with the padding.
    pub(crate) fn padded_from(&self, column: usize, row: usize) -> &[f32] {
        &self.samples[row * self.width + column..]
    }

    /// The samples from a place to the end, with the padding, mutable.
    pub(crate) fn padded_from_mut(&mut self, column: usize, row: usize) -> &mut [f32] {
        &mut self.samples[row * self.width + column..]
    }

    /// One row.
    pub fn row(&self, row: usize) -> &[f32] {
        &self.samples[row * self.width..(row + 1) * self.width]
    }

    /// One row, mutable.
    pub fn row_mut(&mut self, row: usize) -> &mut [f32] {
        &mut self.samples[row * self.width..(row + 1) * self.width]
    }

    /// The sample at a place; outside the plane, the nearest one inside.
    pub fn clamped(&self, column: isize, row: isize) -> f32 {
        let column = column.clamp(0, self.width as isize - 1) as usize;
        let row = row.clamp(0, self.height as isize - 1) as usize;
        self.samples[row * self.width + column]
    }

    /// The part whose top left sample is at (`left`, `top`); beyond the border the border samples
    /// are repeated.
    pub fn crop(&self, left: isize, top: isize, width: usize, height: usize) -> Self {
        let mut part = Self::default();
        self.crop_into(left, top, width, height, &mut part);
        part
    }

    /// As [`crop`](Self::crop), into an existing plane.
    pub fn crop_into(&self, left: isize, top: isize, width: usize, height: usize, part: &mut Self) {
        part.reshape(width, height);
        let inside = left >= 0 && left as usize + part.width <= self.width;
        for y in 0..part.height {
            let row = (top + y as isize).clamp(0, self.height as isize - 1) as usize;
            let (from, width) = (self.row(row), part.width);
            let to = &mut part.samples[y * width..(y + 1) * width];
            if inside {
                to.copy_from_slice(&from[left as usize..left as usize + width]);
            } else {
                for (x, sample) in to.iter_mut().enumerate() {
                    *sample = from[(left + x as isize).clamp(0, from.len() as isize - 1) as usize];
                }
            }
        }
    }

    /// The mean of all samples.
    pub fn mean(&self) -> f32 {
        // Single-precision lanes within a row, double precision over the rows.
        let mut sum = 0.0_f64;
        for row in self.samples().chunks(self.width.max(1)) {
            let mut lanes = [0.0_f32; 8];
            let (whole, rest) = row.as_chunks::<8>();
            for samples in whole {
                for (lane, sample) in lanes.iter_mut().zip(samples) {
                    *lane += sample;
                }
            }
            sum += f64::from(lanes.iter().sum::<f32>() + rest.iter().sum::<f32>());
        }
        (sum / self.samples().len().max(1) as f64) as f32
    }
}
