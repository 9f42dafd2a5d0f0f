use rerun::Color;

/// Colours that can be told apart, also by those who see red and green alike.
const PALETTE: [[u8; 3]; 8] = [
    [230, 159, 0],
    [86, 180, 233],
    [0, 158, 115],
    [240, 228, 66],
    [0, 114, 178],
    [213, 94, 0],
    [204, 121, 167],
    [180, 180, 180],
];

/// The colour of the n-th camera or track.
pub(crate) fn of(index: u64) -> Color {
    let [r, g, b] = PALETTE[(index % PALETTE.len() as u64) as usize];
    Color::from_rgb(r, g, b)
}

/// The same, see-through.
pub(crate) fn faint(index: u64, alpha: u8) -> Color {
    let [r, g, b] = PALETTE[(index % PALETTE.len() as u64) as usize];
    Color::from_unmultiplied_rgba(r, g, b, alpha)
}

/// Dark to light, even to the eye and to those who see red and green alike (matplotlib's viridis).
const SCALE: [[u8; 3]; 9] = [
    [68, 1, 84],
    [71, 44, 122],
    [59, 81, 139],
    [44, 113, 142],
    [33, 144, 141],
    [39, 173, 129],
    [92, 200, 99],
    [170, 220, 50],
    [253, 231, 37],
];

/// A colour from dark (0) to light (1), red, green and blue.
pub(crate) fn scale(share: f64) -> [u8; 3] {
    // What is no number is dark.
    let share = if share > 0.0 { share.min(1.0) } else { 0.0 };
    let place = share * (SCALE.len() - 1) as f64;
    let low = place as usize;
    let [from, to] = [low, low + 1].map(|index| SCALE[index.min(SCALE.len() - 1)]);
    let part = place - low as f64;
    std::array::from_fn(|i| (f64::from(from[i]) * (1.0 - part) + f64::from(to[i]) * part).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_goes_from_dark_to_light() {
        assert_eq!(scale(-1.0), SCALE[0]);
        assert_eq!(scale(f64::NAN), SCALE[0]);
        assert_eq!(scale(0.5), SCALE[4]);
        assert_eq!(scale(1.0), SCALE[8]);
    }
}
