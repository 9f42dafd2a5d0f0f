//! Noise model of a camera's labels.

/// Error of a camera's labels, per axis: a white part that is new in every frame, and a lasting
/// part whose correlation decays exponentially.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LabelNoise {
    /// Standard deviation of the white part, pixels.
    pub white_px: f64,
    /// Standard deviation of the lasting part, pixels.
    pub lasting_px: f64,
    /// Correlation time of the lasting part, after which e^-1 is left, s.
    pub lasting_s: f64,
}

impl LabelNoise {
    /// Standard deviation of both parts together, pixels.
    pub fn sd_px(&self) -> f64 {
        self.white_px.hypot(self.lasting_px)
    }

    /// Correlation of two labels `apart_s` seconds apart.
    pub fn correlation(&self, apart_s: f64) -> f64 {
        (self.lasting_px / self.sd_px()).powi(2) * (-apart_s / self.lasting_s).exp()
    }

    /// Deviation of white noise of labels `frame_s` apart whose mean over seconds is as uncertain
    /// as that of this noise, pixels. Its square is `w^2 + c^2 (1 + a) / (1 - a)` with
    /// `a = exp(-frame / T)`.
    pub fn white_equivalent_px(&self, frame_s: f64) -> f64 {
        let kept = (-frame_s / self.lasting_s).exp();
        let slow = (1.0 + kept) / (1.0 - kept);
        (self.white_px.powi(2) + self.lasting_px.powi(2) * slow).sqrt()
    }
}
