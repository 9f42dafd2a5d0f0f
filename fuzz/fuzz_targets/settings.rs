//! A fusion centre's, an image tracker's or a scene's file of any text. (A network's and a camera's
//! are tried in tests of their own crates: Zenoh under a fuzzer takes a quarter of an hour to
//! build.)
#![no_main]

use crossfix_fusion::{Fusion, FusionConfig};
use crossfix_simulation::Scene;
use crossfix_vision::{ImageTracker, TrackerConfig};

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    let Ok(text) = std::str::from_utf8(data) else { return };
    if let Ok(config) = toml::from_str::<FusionConfig>(text) {
        let _ = Fusion::new(config);
    }
    if let Ok(config) = toml::from_str::<TrackerConfig>(text) {
        let _ = ImageTracker::new(config);
    }
    if let Ok(scene) = toml::from_str::<Scene>(text) {
        let _ = scene.build();
    }
});
