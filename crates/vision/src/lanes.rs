//! Exponential and logarithm in single precision that the compiler can vectorise: no branches, no
//! calls. Good to 1e-5 of the exponential, and to 1e-6 of the logarithm.

use std::ops::{Add, Div, Mul, Sub};

/// `e^x`; below -87, where it is 0 to single precision, the value at -87 is taken.
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    let x = x.clamp(-87.0, 88.0) * std::f32::consts::LOG2_E;
    /// Adding and subtracting 1.5 2^23 rounds to a whole number: there a single-precision number
    /// has no fraction. With half of it halves would be left.
    const ROUND: f32 = 12_582_912.0;
    let whole = (x + ROUND) - ROUND;
    let t = (x - whole) * std::f32::consts::LN_2;
    // e^t by its series; then times 2^whole, made of the exponent's bits.
    let series = 1.0
        + t * (1.0
            + t * (0.5 + t * (1.0 / 6.0 + t * (1.0 / 24.0 + t * (1.0 / 120.0 + t / 720.0)))));
    f32::from_bits(((whole as i32 + 127) << 23) as u32) * series
}

/// `ln x` of a positive, normal number.
#[inline(always)]
pub(crate) fn ln(x: f32) -> f32 {
    // x = 2^e m with m between sqrt(1/2) and sqrt(2).
    let bits = x.to_bits() as i32;
    // 0x3f3504f3 is sqrt(1/2) in bits.
    let exponent = (bits - 0x3f35_04f3) >> 23;
    let mantissa = f32::from_bits((bits - (exponent << 23)) as u32);
    // ln m = 2 artanh((m - 1) / (m + 1)).
    let t = (mantissa - 1.0) / (mantissa + 1.0);
    let s = t * t;
    let series = 2.0 * t * (1.0 + s * (1.0 / 3.0 + s * (0.2 + s * (1.0 / 7.0 + s / 9.0))));
    exponent as f32 * std::f32::consts::LN_2 + series
}

/// Number of values that are computed together: those of a 256-bit register. With half of it half
/// the register is idle.
pub(crate) const LANES: usize = 8;

/// The greatest of some numbers; minus infinity of none. Those that are not numbers are left out.
pub(crate) fn greatest(values: &[f32]) -> f32 {
    let (chunks, rest) = values.as_chunks();
    let of_lanes =
        chunks.iter().fold(Lanes::splat(f32::NEG_INFINITY), |most, chunk| most.max(Lanes(*chunk)));
    of_lanes.0.iter().chain(rest).copied().fold(f32::NEG_INFINITY, f32::max)
}

/// The sum of some numbers.
pub(crate) fn sum(values: &[f32]) -> f32 {
    let (chunks, rest) = values.as_chunks();
    let of_lanes = chunks.iter().fold(Lanes::splat(0.0), |sum, chunk| sum + Lanes(*chunk));
    rest.iter().sum::<f32>() + of_lanes.0.iter().sum::<f32>()
}

/// Eight numbers in one: an operation is done to each, by one instruction where there is one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Lanes(pub(crate) [f32; LANES]);

impl Lanes {
    /// The same number eight times.
    #[inline(always)]
    pub(crate) fn splat(value: f32) -> Self {
        Self([value; LANES])
    }

    #[inline(always)]
    fn with(self, other: Self, of: impl Fn(f32, f32) -> f32) -> Self {
        let mut lanes = self.0;
        for (lane, other) in lanes.iter_mut().zip(other.0) {
            *lane = of(*lane, other);
        }
        Self(lanes)
    }

    #[inline(always)]
    fn each(self, of: impl Fn(f32) -> f32) -> Self {
        let mut lanes = self.0;
        for lane in &mut lanes {
            *lane = of(*lane);
        }
        Self(lanes)
    }

    #[inline(always)]
    pub(crate) fn max(self, other: Self) -> Self {
        self.with(other, f32::max)
    }

    #[inline(always)]
    pub(crate) fn sqrt(self) -> Self {
        self.each(f32::sqrt)
    }

    /// [`exp`] of each.
    #[inline(always)]
    pub(crate) fn exp(self) -> Self {
        self.each(exp)
    }
}

impl Add for Lanes {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.with(other, |a, b| a + b)
    }
}

impl Sub for Lanes {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.with(other, |a, b| a - b)
    }
}

impl Mul for Lanes {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.with(other, |a, b| a * b)
    }
}

impl Div for Lanes {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.with(other, |a, b| a / b)
    }
}

impl Mul<f32> for Lanes {
    type Output = Self;
    #[inline(always)]
    fn mul(self, factor: f32) -> Self {
        self.each(|a| a * factor)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::{greatest, sum};

    proptest! {
        #[test]
        fn they_are_the_exponential_and_the_logarithm(x in -80.0f32..80.0, y in 1e-30f32..1e30) {
            prop_assert!((super::exp(x) / x.exp() - 1.0).abs() < 1e-5);
            prop_assert!((super::ln(y) - y.ln()).abs() < 1e-6 * (1.0 + y.ln().abs()));
        }
    }

    #[test]
    fn the_greatest_and_the_sum_of_numbers_of_any_count() {
        for count in 0..40 {
            let values: Vec<f32> = (0..count).map(|k| ((k * 7) % 11) as f32 - 20.0).collect();
            let largest = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            assert_eq!(greatest(&values), largest);
            assert_eq!(sum(&values), values.iter().sum::<f32>());
        }
        assert_eq!(greatest(&[f32::NAN, -3.0, f32::NAN]), -3.0);
    }
}
