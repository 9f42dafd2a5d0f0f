//! The error of a camera's labels.

/// The error of a camera's labels, per axis: a part that is new in every frame, and one that lasts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LabelNoise {
    /// Standard deviation of what is new in every frame, pixels.
    pub white_px: f64,
    /// Of what lasts, pixels.
    pub lasting_px: f64,
    /// Time after which e^-1 of that is left, s.
    pub lasting_s: f64,
}

impl LabelNoise {
    /// Standard deviation in all, pixels.
    pub fn sd_px(&self) -> f64 {
        self.white_px.hypot(self.lasting_px)
    }

    /// Correlation of two labels so many seconds apart.
    pub fn correlation(&self, apart_s: f64) -> f64 {
        (self.lasting_px / self.sd_px()).powi(2) * (-apart_s / self.lasting_s).exp()
    }

    /// The deviation of white noise of labels `frame_s` apart that over seconds averages out as
    /// slowly as this does, pixels: `w^2 + c^2 (1 + a) / (1 - a)` with `a = exp(-frame / T)`.
    pub fn white_equivalent_px(&self, frame_s: f64) -> f64 {
        let kept = (-frame_s / self.lasting_s).exp();
        let slow = (1.0 + kept) / (1.0 - kept);
        (self.white_px.powi(2) + self.lasting_px.powi(2) * slow).sqrt()
    }
}
