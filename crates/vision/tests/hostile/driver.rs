// A tracker driven by any bytes: what a broken camera, a broken clock or a confused operator could
// give it. Shared by the property test and the fuzz target.

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_vision::{
    Algorithm, DetectorConfig, GateRule, ImagePoint, ImageTrack, ImageTracker, ImmConfig, PixelBox,
    ReferenceStrategy, TrackerConfig,
};

/// The bytes, one after the other; when they are used up, zeros.
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn next(&mut self) -> u8 {
        let Some((first, rest)) = self.0.split_first() else { return 0 };
        self.0 = rest;
        *first
    }

    /// From -128 to 127 times a scale; a few bytes are numbers that nobody expects.
    fn number(&mut self, scale: f64) -> f64 {
        match self.next() {
            255 => f64::NAN,
            254 => f64::INFINITY,
            253 => -1e300,
            byte => (f64::from(byte) - 128.0) * scale,
        }
    }
}

fn config(bytes: &mut Bytes<'_>) -> TrackerConfig {
    let choice = bytes.next();
    let base = if choice & 1 == 0 { TrackerConfig::default() } else { TrackerConfig::paper() };
    let reference = match bytes.next() % 5 {
        0 => ReferenceStrategy::Fixed,
        1 => ReferenceStrategy::Replacement,
        2 => ReferenceStrategy::Smoothing { memory: 0.9 },
        3 => ReferenceStrategy::PixelImm(ImmConfig::default()),
        _ => ReferenceStrategy::default(),
    };
    let gate = match bytes.next() % 3 {
        0 => GateRule::ThreeSided,
        1 => GateRule::Innovation { sigmas: 4.0 },
        _ => GateRule::Ellipsoid { probability: 0.99 },
    };
    let detector = (choice & 2 != 0).then(DetectorConfig::default);
    let algorithm = if choice & 4 != 0 { Algorithm::Posterior } else { base.algorithm };
    TrackerConfig { reference, gate, detector, algorithm, ..base }
}

/// A picture of one of the kinds that cameras deliver when they should not.
fn picture(bytes: &mut Bytes<'_>, frame: u32) -> Plane {
    let (mut width, mut height) = (48, 40);
    let kind = bytes.next() % 8;
    if kind == 7 {
        (width, height) = (usize::from(bytes.next() % 64), usize::from(bytes.next() % 64));
    }
    let (level, texture) = (f32::from(bytes.next()), bytes.next());
    let broken =
        [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, -1e30][usize::from(texture % 5)];
    Plane::from_fn(width, height, |x, y| {
        let (dx, dy) = (x as f32 - 10.0 - 1.5 * frame as f32, y as f32 - 15.0);
        let scene = level + 90.0 * (-(dx * dx + dy * dy) / 10.0).exp();
        match kind {
            // All one value, dark or saturated.
            0 => level,
            1 => 255.0,
            2 => broken,
            // Broken pixels here and there.
            3 if (x * 7 + y * 13) % usize::from(texture % 30 + 2) == 0 => {
                broken * if x % 2 == 0 { 1.0 } else { -1.0 }
            }
            4 => scene + f32::from(((x * 31 + y * 17) as u8).wrapping_mul(texture)),
            // Very bright, and hardly anything.
            5 => scene * 1e7,
            6 => scene * 1e-20,
            _ => scene,
        }
    })
}

/// Whether a track can be given to somebody.
fn is_sound(track: &ImageTrack) -> bool {
    let finite = |place: ImagePoint| place.x.is_finite() && place.y.is_finite();
    let measured = track.measured.is_none_or(|measured| {
        let covariance = measured.covariance;
        finite(measured.place)
            && covariance.m11 > 0.0
            && covariance.m22 > 0.0
            && covariance.determinant() >= 0.0
    });
    finite(track.position)
        && finite(track.velocity)
        && measured
        && track.width > 0.0
        && track.height > 0.0
        && track.score.is_finite()
        && track.certainty.is_finite()
        && track.nis.is_none_or(f64::is_finite)
        && track.features.is_none_or(|features| {
            [features.contrast, features.flicker, features.straightness]
                .iter()
                .all(|v| v.is_finite())
        })
        && track
            .covariances
            .is_none_or(|axes| axes.iter().all(|c| c.iter().all(|v| v.is_finite()) && c.m11 > 0.0))
}

/// Runs a tracker on bytes. Panics if it does, or if it answers with what cannot be.
pub fn drive(data: &[u8]) {
    let mut bytes = Bytes(data);
    let Ok(mut tracker) = ImageTracker::new(config(&mut bytes)) else { return };
    let mut time = 0_i64;
    for frame in 0..24 {
        let action = bytes.next();
        if frame == 0 || action & 3 == 3 {
            let [x, y, width, height] = [1.0, 1.0, 1.0, 1.0].map(|scale| bytes.number(scale));
            tracker.take_up(PixelBox { x, y, width: width.abs(), height: height.abs() });
        }
        // Forwards, twice the same, backwards, far ahead.
        time += match action >> 2 & 7 {
            0 => 0,
            1 => -20_000_000,
            2 => 3_600_000_000_000,
            _ => 33_000_000,
        };
        let image = picture(&mut bytes, frame);
        let tracks = tracker.step(&image, Timestamp::from_nanos(time));
        for track in tracks {
            assert!(is_sound(track), "{track:?}");
        }
        let first = tracks.first().map(|track| track.id);
        if let (Some(id), true) = (first, action & 32 != 0) {
            tracker.cue(id, ImagePoint { x: bytes.number(2.0), y: bytes.number(2.0) });
        }
        if bytes.0.is_empty() {
            break;
        }
    }
}
