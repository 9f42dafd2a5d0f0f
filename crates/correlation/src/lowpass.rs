use crate::Plane;

/// Half the length of the longest filter, in taps. Deviations up to 1.6 px are whole; with half of
/// it only those up to 0.6 px.
const MOST_REACH: usize = 5;

/// A Gaussian low-pass over both axes; beyond the border the border samples are repeated. A noisy
/// reference needs it before it is interpolated: interpolation averages noise, so it is lower
/// between the samples than at them, and a fit would be drawn there.
#[derive(Clone, Debug, PartialEq)]
pub struct LowPass {
    deviation: f32,
    taps: Vec<f32>,
    noise_gain: f32,
    own_weight: f32,
    cross_gradient_gain: f32,
}

/// Buffers of the filter.
#[derive(Clone, Debug, Default)]
pub struct LowPassMemory {
    padded: Plane,
    lines: Plane,
}

impl LowPass {
    /// A filter with this standard deviation in pixels; 0 changes nothing.
    pub fn new(deviation: f32) -> Self {
        // Three deviations of the Gaussian.
        let reach = ((3.0 * deviation).ceil() as usize).min(MOST_REACH);
        let mut taps: Vec<f32> = (0..=2 * reach)
            .map(|k| {
                let distance = k.abs_diff(reach) as f32;
                if distance == 0.0 { 1.0 } else { (-0.5 * (distance / deviation).powi(2)).exp() }
            })
            .collect();
        // Normalised to sum to 1: constant brightness is kept.
        let sum: f32 = taps.iter().sum();
        taps.iter_mut().for_each(|tap| *tap /= sum);
        let at =
            |k: isize| usize::try_from(k).ok().and_then(|k| taps.get(k)).copied().unwrap_or(0.0);
        // White noise's variance is multiplied by sum h^2 per axis.
        let squares: f32 = taps.iter().map(|tap| tap * tap).sum();
        let own = taps[reach];
        // Covariance of (f(1) - f(-1)) / 2 after the filter with the same before it: along the axis
        // (h(0) - h(2)) / 2, and h(0) across it.
        let cross = 0.5 * (own - at(reach as isize + 2)) * own;
        Self {
            deviation,
            noise_gain: squares * squares,
            own_weight: own * own,
            cross_gradient_gain: cross,
            taps,
        }
    }

    /// Its standard deviation, px.
    pub fn deviation(&self) -> f32 {
        self.deviation
    }

    /// Variance of white noise after the filter over that before it.
    pub fn noise_gain(&self) -> f32 {
        self.noise_gain
    }

    /// The weight of a sample in its own filtered value.
    pub fn own_weight(&self) -> f32 {
        self.own_weight
    }

    /// Covariance of white noise's central difference along an axis before the filter with that
    /// after it, over the noise's variance.
    pub fn cross_gradient_gain(&self) -> f32 {
        self.cross_gradient_gain
    }

    /// Filters a plane.
    pub fn apply(&self, from: &Plane, memory: &mut LowPassMemory, to: &mut Plane) {
        let LowPassMemory { padded, lines } = memory;
        if self.taps.len() == 1 {
            to.copy_from(from);
            return;
        }
        let reach = (self.taps.len() / 2) as isize;
        let (width, height) = (from.width(), from.height());
        from.crop_into(
            -reach,
            -reach,
            width + 2 * reach as usize,
            height + 2 * reach as usize,
            padded,
        );
        lines.reshape(width, padded.height());
        to.reshape(width, height);
        // The Gaussian is a product of one along x and one along y: along the rows first, then
        // along the columns.
        for y in 0..padded.height() {
            let out = lines.row_mut(y);
            out.fill(0.0);
            for (k, tap) in self.taps.iter().enumerate() {
                add_scaled(out, *tap, &padded.row(y)[k..]);
            }
        }
        for y in 0..height {
            let out = to.row_mut(y);
            out.fill(0.0);
            for (k, tap) in self.taps.iter().enumerate() {
                add_scaled(out, *tap, lines.row(y + k));
            }
        }
    }
}

fn add_scaled(out: &mut [f32], tap: f32, row: &[f32]) {
    for (out, sample) in out.iter_mut().zip(row) {
        *out += tap * sample;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_impulse_shows_the_gains() {
        for deviation in [0.0, 0.6, 1.2] {
            let filter = LowPass::new(deviation);
            let impulse = Plane::from_fn(21, 21, |x, y| f32::from(u8::from((x, y) == (10, 10))));
            let mut out = Plane::default();
            filter.apply(&impulse, &mut LowPassMemory::default(), &mut out);
            let squares: f32 = out.samples().iter().map(|v| v * v).sum();
            assert!((squares - filter.noise_gain).abs() < 1e-5);
            assert!((out.row(10)[10] - filter.own_weight).abs() < 1e-6);
            let row = out.row(10);
            // The impulse weighs +1/2 in the difference of the sample before it, and -1/2 in that
            // of the sample after it.
            let cross = 0.5 * (row[10] - row[8]) / 2.0 - 0.5 * (row[12] - row[10]) / 2.0;
            assert!((cross - filter.cross_gradient_gain).abs() < 1e-5, "{cross} {filter:?}");
        }
    }
}
