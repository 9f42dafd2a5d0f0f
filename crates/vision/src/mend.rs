use crossfix_correlation::Plane;

/// No camera is brighter; sums of the squares of more would lose the rest.
pub(crate) const BRIGHTEST: f32 = 1e6;

/// Makes broken samples (not finite, or beyond every brightness) black: one of them must not spoil a
/// whole gate.
pub(crate) fn mend(plane: &mut Plane) {
    let broken = |sample: &f32| u32::from(!matches!(sample.abs(), level if level <= BRIGHTEST));
    // Counting is quicker than stopping at the first.
    if plane.samples().iter().map(broken).sum::<u32>() == 0 {
        return;
    }
    for sample in plane.samples_mut().iter_mut().filter(|sample| broken(sample) > 0) {
        *sample = 0.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn broken_samples_become_black_and_others_stay() {
        let mut plane = Plane::from_fn(3, 2, |x, y| [[1.0, f32::NAN, 2.0], [1e30, 3.0, -1e30]][y][x]);
        mend(&mut plane);
        assert_eq!(plane.samples(), [1.0, 0.0, 2.0, 0.0, 3.0, 0.0]);
    }
}
