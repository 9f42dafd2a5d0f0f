use thiserror::Error;

/// What can be wrong with the numbers that describe a camera or a bearing.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum GeometryError {
    /// A number is not finite.
    #[error("{what} is not a finite number")]
    NotFinite {
        /// Which.
        what: &'static str,
    },
    /// A vector that should have length one does not.
    #[error("a bearing has length {length}, not 1")]
    NotUnit {
        /// Its length.
        length: f64,
    },
    /// A covariance that is not symmetric positive definite.
    #[error("the covariance [{xx} {xy}; {xy} {yy}] is not positive definite")]
    NotPositive {
        /// Variance along the first axis.
        xx: f64,
        /// Covariance.
        xy: f64,
        /// Variance along the second axis.
        yy: f64,
    },
    /// A standard deviation so large that the bearing may point anywhere.
    #[error("a bearing with a standard deviation of {sd:.3e} rad may lie anywhere")]
    Anywhere {
        /// The larger of its two standard deviations, rad.
        sd: f64,
    },
    /// A matrix that should be a rotation is not one.
    #[error(
        "the rotation is not orthonormal: R'R differs from the identity by {deviation:.2e} \
         and its determinant is {determinant:.3}"
    )]
    NotRotation {
        /// The largest element of R'R - I.
        deviation: f64,
        /// Its determinant; -1 is a mirrored frame.
        determinant: f64,
    },
    /// A camera that looks at its own centre or straight up or down has no defined roll.
    #[error("a camera cannot be aimed at a point straight above, below or at itself")]
    Aim,
    /// A mount whose angle limits are not in order, or go beyond a turn (azimuth) or a quarter of
    /// one (elevation).
    #[error(
        "a mount's least angles must not be above its most, the azimuth's within a turn and the \
         elevation's within a quarter of one"
    )]
    Reach,
    /// A focal length, size or principal point that no camera has.
    #[error("{what} is {value}: {must}")]
    Intrinsics {
        /// Which number.
        what: &'static str,
        /// Its value.
        value: f64,
        /// What it must be.
        must: &'static str,
    },
    /// A latitude, longitude or height outside its valid range.
    #[error("{what} is {value}: it must be {must}")]
    Geodetic {
        /// Which number.
        what: &'static str,
        /// Its value.
        value: f64,
        /// What it must be.
        must: &'static str,
    },
    /// A pixel at which the distortion cannot be undone.
    #[error("the lens model cannot be inverted at pixel ({x:.1}, {y:.1})")]
    NoInverse {
        /// Column.
        x: f64,
        /// Row.
        y: f64,
    },
}
