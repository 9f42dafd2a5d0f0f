//! Calibrations and lenses of any text: refused, or of use.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a test that cannot set itself up has failed"
)]

use crossfix_calibration::SiteCalibration;

#[path = "hostile/driver.rs"]
mod driver;

/// What the fuzzer begins with, and what it has found.
#[test]
fn the_fuzzer_s_corpus_is_read_or_refused() {
    let corpus = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/corpus/calibration");
    let mut read = 0;
    for entry in std::fs::read_dir(corpus).unwrap() {
        driver::drive(&std::fs::read(entry.unwrap().path()).unwrap());
        read += 1;
    }
    assert!(read > 3, "{read}");
}

#[test]
fn a_camera_that_is_there_twice_and_numbers_too_large_are_named() {
    let refused = |name: &str| {
        let corpus = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/corpus/calibration");
        let text = std::fs::read_to_string(format!("{corpus}/{name}.toml")).unwrap();
        SiteCalibration::from_toml(&text).unwrap_err().to_string()
    };
    assert!(refused("the-same-camera-twice").contains("`north` is there twice"));
    assert!(refused("numbers-too-large").contains("camera `north`: `position_m` is impossible"));
}
