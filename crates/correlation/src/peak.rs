use crate::Plane;

/// The largest sample of a plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Peak {
    /// Column.
    pub column: usize,
    /// Row.
    pub row: usize,
    /// The sample.
    pub score: f32,
}

/// A peak between the samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SubPixelPeak {
    /// Column, with its fraction.
    pub x: f64,
    /// Row, with its fraction.
    pub y: f64,
    /// The score of the sample that the peak was refined from.
    pub score: f32,
}

impl Plane {
    /// The largest sample; the first of several. NaNs are left out, and a plane of NaNs peaks at
    /// its first sample.
    pub fn peak(&self) -> Peak {
        let mut best = Peak { column: 0, row: 0, score: f32::NEG_INFINITY };
        for (index, &score) in self.samples().iter().enumerate() {
            if score > best.score {
                best = Peak { column: index % self.width(), row: index / self.width(), score };
            }
        }
        best
    }
}

/// Offset of the vertex of the parabola through three neighbouring samples from the middle one, at
/// most half a sample; 0 where they have no maximum.
fn vertex(before: f32, here: f32, after: f32) -> f64 {
    let curvature = f64::from(before) - 2.0 * f64::from(here) + f64::from(after);
    if curvature >= -1e-12 {
        return 0.0;
    }
    // x = (a - c) / (2 (a - 2 b + c)).
    (0.5 * (f64::from(before) - f64::from(after)) / curvature).clamp(-0.5, 0.5)
}

impl Peak {
    /// The peak at its sample.
    pub fn whole(self) -> SubPixelPeak {
        SubPixelPeak { x: self.column as f64, y: self.row as f64, score: self.score }
    }

    /// The peak between the samples of `scores`, by a parabola per axis. At the border it stays at
    /// its sample.
    pub fn refined(self, scores: &Plane) -> SubPixelPeak {
        let Self { column, row, score } = self;
        let inner_x = column > 0 && column + 1 < scores.width();
        let inner_y = row > 0 && row + 1 < scores.height();
        let here = scores.row(row);
        let dx =
            if inner_x { vertex(here[column - 1], here[column], here[column + 1]) } else { 0.0 };
        let dy = if inner_y {
            vertex(scores.row(row - 1)[column], here[column], scores.row(row + 1)[column])
        } else {
            0.0
        };
        SubPixelPeak { x: column as f64 + dx, y: row as f64 + dy, score }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parabola_is_found_exactly_and_a_border_peak_stays() {
        let scores = Plane::from_fn(9, 7, |x, y| {
            1.0 - 0.01 * ((x as f32 - 4.3).powi(2) + (y as f32 - 2.8).powi(2))
        });
        let peak = scores.peak().refined(&scores);
        assert!((peak.x - 4.3).abs() < 1e-4 && (peak.y - 2.8).abs() < 1e-4);
        let slope = Plane::from_fn(5, 5, |x, _| x as f32);
        assert_eq!(slope.peak().refined(&slope).x, 4.0);
    }

    #[test]
    fn a_plane_of_nans_peaks_at_its_first_sample() {
        let peak = Plane::from_fn(3, 3, |_, _| f32::NAN).peak();
        assert_eq!((peak.column, peak.row), (0, 0));
    }
}
