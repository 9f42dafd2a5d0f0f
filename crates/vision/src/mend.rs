use crossfix_correlation::Plane;

/// No camera is brighter; the squares of more would not be finite.
const BRIGHTEST: f32 = 1e9;

/// Makes broken samples (not finite, or beyond every brightness) black: one of them must not spoil a
/// whole gate.
pub(crate) fn mend(plane: &mut Plane) {
    let sound = |sample: f32| sample.abs() <= BRIGHTEST;
    // Their mean is out of bounds if one sample is far enough out; that is quicker to see.
    if sound(plane.mean() * plane.samples().len() as f32) {
        return;
    }
    for sample in plane.samples_mut().iter_mut().filter(|sample| !sound(**sample)) {
        *sample = 0.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn broken_samples_become_black_and_others_stay() {
        let mut plane =
            Plane::from_fn(3, 2, |x, y| [[1.0, f32::NAN, 2.0], [f32::INFINITY, 3.0, -1e30]][y][x]);
        mend(&mut plane);
        assert_eq!(plane.samples(), [1.0, 0.0, 2.0, 0.0, 3.0, 0.0]);
    }
}
