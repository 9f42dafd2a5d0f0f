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
