use crate::Plane;
use crate::interpolation::PlaneSpline;

/// Weight of each pixel of a reference: the product of a weight of its column and one of its row.
/// The weights along each axis sum to 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Window {
    columns: Plane,
    rows: Plane,
    uniform: bool,
}

impl Window {
    /// Equal weights: the plain zero-mean normalised cross-correlation.
    pub fn uniform(width: usize, height: usize) -> Self {
        let columns = normalised(Plane::from_fn(width, 1, |_, _| 1.0));
        let rows = normalised(Plane::from_fn(1, height, |_, _| 1.0));
        Self { columns, rows, uniform: true }
    }

    /// A Gaussian around the middle, with a standard deviation of this share of each side: the
    /// target in the middle counts, the background at the border little.
    pub fn gaussian(width: usize, height: usize, share: f64) -> Self {
        let columns = Plane::from_fn(width, 1, |x, _| gaussian_weight(x, width, share));
        let rows = Plane::from_fn(1, height, |_, y| gaussian_weight(y, height, share));
        let (columns, rows) = (normalised(columns), normalised(rows));
        Self { columns, rows, uniform: false }
    }

    /// Number of columns.
    pub fn width(&self) -> usize {
        self.columns.width()
    }

    /// Number of rows.
    pub fn height(&self) -> usize {
        self.rows.height()
    }

    /// Whether all weights are equal.
    pub fn is_uniform(&self) -> bool {
        self.uniform
    }

    /// The number of equally weighted pixels that average noise as well as these do: the inverse of
    /// the sum of the squared weights.
    pub fn effective_pixels(&self) -> f64 {
        let squares = |plane: &Plane| plane.samples().iter().map(|w| f64::from(w * w)).sum::<f64>();
        // n = 1 / sum w^2 for weights that sum to 1; the sum of products is the product of sums.
        1.0 / (squares(&self.columns) * squares(&self.rows))
    }

    /// The weight of a pixel.
    pub fn weight(&self, column: usize, row: usize) -> f32 {
        self.columns.samples()[column] * self.rows.samples()[row]
    }

    /// The weights of the columns, a plane of one row.
    pub(crate) fn columns(&self) -> &Plane {
        &self.columns
    }

    /// The weights of the rows, a plane of one column.
    pub(crate) fn rows(&self) -> &Plane {
        &self.rows
    }
}

/// The weight of an index along a side, 1 in its middle.
fn gaussian_weight(index: usize, side: usize, share: f64) -> f32 {
    let distance = (index as f64 - (side as f64 - 1.0) / 2.0) / (share * side as f64);
    (-0.5 * distance.powi(2)).exp() as f32
}

fn normalised(mut plane: Plane) -> Plane {
    let sum: f32 = plane.samples().iter().sum();
    plane.samples_mut().iter_mut().for_each(|weight| *weight /= sum);
    plane
}

/// A reference image, prepared for correlation: with its window, and its weighted deviation from
/// its weighted mean.
///
/// ```
/// use crossfix_correlation::{Plane, Reference, Window};
/// let image = Plane::from_fn(3, 1, |x, _| x as f32);
/// let reference = Reference::new(image, Window::uniform(3, 1));
/// assert!((reference.variance() - 2.0 / 3.0).abs() < 1e-6);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Reference {
    image: Plane,
    window: Window,
    kernel: Plane,
    spline: PlaneSpline,
    variance: f32,
}

impl Reference {
    /// A reference of an image and a window of the same size.
    ///
    /// # Panics
    /// If the sizes differ.
    pub fn new(image: Plane, window: Window) -> Self {
        let same = (image.width(), image.height()) == (window.width(), window.height());
        assert!(same, "window and image differ in size");
        let kernel = image.clone();
        let mut reference =
            Self { image, window, kernel, spline: PlaneSpline::default(), variance: 0.0 };
        reference.prepare();
        reference
    }

    fn prepare(&mut self) {
        let Self { image, window, kernel, spline, variance } = self;
        spline.pass_through(image);
        let (columns, rows) = (window.columns.samples(), window.rows.samples());
        // Weighted mean m = sum w g, the weight w being a column's times a row's.
        let mut mean = 0.0;
        for (y, &across) in rows.iter().enumerate() {
            let line: f32 =
                image.row(y).iter().zip(columns).map(|(sample, along)| sample * along).sum();
            mean += across * line;
        }
        // Kernel w (g - m), and weighted variance sum w (g - m)^2.
        let mut sum = 0.0;
        for (y, &across) in rows.iter().enumerate() {
            let line = kernel.row_mut(y).iter_mut().zip(image.row(y)).zip(columns);
            for ((value, sample), along) in line {
                let deviation = sample - mean;
                *value = across * along * deviation;
                sum += *value * deviation;
            }
        }
        *variance = sum;
    }

    /// Changes the image in place and prepares it again; if its size changes, its window is uniform
    /// from then on.
    pub fn update(&mut self, change: impl FnOnce(&mut Plane)) {
        change(&mut self.image);
        let (width, height) = (self.image.width(), self.image.height());
        if (width, height) != (self.window.width(), self.window.height()) {
            self.window = Window::uniform(width, height);
        }
        self.kernel.reshape(width, height);
        self.prepare();
    }

    /// The image.
    pub fn image(&self) -> &Plane {
        &self.image
    }

    /// Its window.
    pub fn window(&self) -> &Window {
        &self.window
    }

    /// The weighted variance of the image.
    pub fn variance(&self) -> f32 {
        self.variance
    }

    /// The spline through the image.
    pub(crate) fn spline(&self) -> &PlaneSpline {
        &self.spline
    }

    /// Each sample's weighted deviation from the weighted mean; sums to 0.
    pub(crate) fn kernel(&self) -> &Plane {
        &self.kernel
    }
}
