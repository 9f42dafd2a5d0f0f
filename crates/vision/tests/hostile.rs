//! Whatever a camera, a clock or an operator gives a tracker, it answers with what can be, or not
//! at all. `fuzz/` runs the same driver with a fuzzer; its corpus is replayed here.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

#[path = "hostile/driver.rs"]
mod driver;

use proptest::prelude::*;

proptest! {
    #![proptest_config(ProptestConfig { cases: 150, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_survived(data in prop::collection::vec(any::<u8>(), 0..220)) {
        driver::drive(&data);
    }
}

#[test]
fn the_corpus_is_survived() {
    let corpus = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/corpus/image_tracker");
    let mut files = 0;
    for entry in std::fs::read_dir(corpus).unwrap() {
        driver::drive(&std::fs::read(entry.unwrap().path()).unwrap());
        files += 1;
    }
    assert!(files > 0, "the corpus is empty");
}
