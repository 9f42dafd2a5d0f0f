use crossfix_message::TrackNumber;
use rerun_types::components::Color;

/// Colours of cameras, red, green and blue: they can be distinguished, also by those who confuse
/// red and green (Okabe and Ito's). With half of them the fourth camera has the first one's.
const PALETTE: [[u8; 3]; 6] =
    [[230, 159, 0], [86, 180, 233], [0, 158, 115], [240, 228, 66], [0, 114, 178], [180, 180, 180]];

/// Colours of tracks, red, green and blue: none is a camera's. With half of them the third track
/// has the first one's.
const TRACKS: [[u8; 3]; 5] =
    [[255, 190, 225], [255, 80, 70], [185, 130, 255], [255, 60, 190], [190, 120, 90]];

/// A track's colour follows from the number that is shown, so the colours of a run come in order.
fn of_id(id: u64) -> [u8; 3] {
    TRACKS[(TrackNumber(id).in_run() % TRACKS.len() as u64) as usize]
}

/// The colour of a track, the same for as long as it lives.
pub(crate) fn of_track(id: u64) -> Color {
    let [r, g, b] = of_id(id);
    Color::from_rgb(r, g, b)
}

/// The same but translucent, for a track that is not sure or not seen.
pub(crate) fn of_unsure_track(id: u64) -> Color {
    let [r, g, b] = of_id(id);
    Color::from_unmultiplied_rgba(r, g, b, 120)
}

/// The colour of the n-th camera.
pub(crate) fn of(index: u64) -> Color {
    let [r, g, b] = PALETTE[(index % PALETTE.len() as u64) as usize];
    Color::from_rgb(r, g, b)
}

/// The same but translucent.
pub(crate) fn faint(index: u64, alpha: u8) -> Color {
    let [r, g, b] = PALETTE[(index % PALETTE.len() as u64) as usize];
    Color::from_unmultiplied_rgba(r, g, b, alpha)
}

/// Colour scale from dark to light, even to the eye, also to those who confuse red and green
/// (matplotlib's viridis, at nine places). With half of the places the colours between would be
/// greyer.
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
    // NaN counts as dark.
    let share = if share > 0.0 { share.min(1.0) } else { 0.0 };
    let place = share * (SCALE.len() - 1) as f64;
    let low = place as usize;
    let [from, to] = [low, low + 1].map(|index| SCALE[index.min(SCALE.len() - 1)]);
    let part = place - low as f64;
    std::array::from_fn(|i| {
        (f64::from(from[i]) * (1.0 - part) + f64::from(to[i]) * part).round() as u8
    })
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
