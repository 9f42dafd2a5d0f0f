//! What others are told of messages that nobody meant: those that the fuzzer begins from, and any
//! bytes.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a test that cannot set itself up has failed"
)]

#[path = "hostile/driver.rs"]
mod driver;

use proptest::prelude::*;

#[test]
fn what_the_fuzzer_begins_from_is_survived() {
    let corpus = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/corpus/messages");
    let mut read = 0;
    for entry in std::fs::read_dir(corpus).unwrap() {
        driver::drive(&std::fs::read(entry.unwrap().path()).unwrap());
        read += 1;
    }
    assert!(read >= 4, "{read}");
}

proptest! {
    #[test]
    fn any_bytes_are_survived(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        driver::drive(&bytes);
    }
}
