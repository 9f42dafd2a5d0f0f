//! A place on a straight edge is known across it, and not along it (the aperture problem).

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_vision::{ImagePoint, ImageTrack, ImageTracker, PixelBox, TrackerConfig};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// A bright evening sky with a dark upright wire, and in the wire, where there is one, a knot.
fn image(rng: &mut ChaCha8Rng, wire_x: f32, knot_y: Option<f32>) -> Plane {
    Plane::from_fn(160, 200, |column, row| {
        let noise: f32 = StandardNormal.sample(&mut *rng);
        let (x, y) = (column as f32 - wire_x, row as f32);
        let wire = (-0.5 * (x / 1.5).powi(2)).exp();
        let knot =
            knot_y.map_or(0.0, |at| (-0.5 * ((x / 3.0).powi(2) + ((y - at) / 3.0).powi(2))).exp());
        170.0 - 60.0 * wire.max(knot) + 2.0 * noise
    })
}

/// The track of a box on the wire in each of the first thirty images, while the wire sways.
fn followed(has_knot: bool) -> Vec<ImageTrack> {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
    tracker.take_up(PixelBox::about(ImagePoint { x: 80.0, y: 100.0 }, 12.0, 12.0));
    (0..30)
        .map(|frame| {
            let image = image(&mut rng, 80.0 + 0.2 * frame as f32, has_knot.then_some(100.0));
            tracker.step(&image, Timestamp::from_seconds(f64::from(frame) / 30.0))[0]
        })
        .collect()
}

/// Standard deviations of the place across the wire and along it, px.
fn deviations(track: &ImageTrack) -> [f64; 2] {
    track.covariances.unwrap().map(|covariance| covariance.m11.sqrt())
}

#[test]
fn a_place_on_a_bare_wire_is_known_across_it_and_not_along() {
    let tracks = followed(false);
    let measured = tracks[1].measured.unwrap().covariance;
    assert!(measured.m22 > 25.0 * measured.m11, "one image alone: {measured}");
    for track in &tracks[1..5] {
        let [across, along] = deviations(track);
        assert!(across < 1.0 && along > 5.0 * across, "{track:?}");
    }
    let [_, along] = deviations(&tracks[4]);
    assert!(along > 5.0, "more images tell no more of where on the wire it is: {along} px");
    assert!(tracks[29].certainty < 0.5, "nobody knows any more where it is: {:?}", tracks[29]);
}

#[test]
fn a_place_with_a_knot_in_the_wire_is_known_along_it_too() {
    let tracks = followed(true);
    for track in &tracks[10..] {
        let [across, along] = deviations(track);
        assert!(across < 0.3 && along < 0.3 && track.certainty > 0.9, "{track:?}");
        assert!((track.position.y - 100.0).abs() < 1.0, "{track:?}");
    }
}
