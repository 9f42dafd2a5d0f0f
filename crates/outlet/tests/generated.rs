//! The generated code is that of the definitions; whoever changes `foxglove.proto` writes it anew
//! with
//! `CROSSFIX_GENERATE=1 cargo test -p crossfix-outlet --test generated`.
#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::fs;
use std::path::Path;

/// Compares a committed file with what the definitions give now, or writes it where that is asked
/// for.
fn check(name: &str, fresh: &[u8]) {
    let committed = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/generated").join(name);
    if std::env::var_os("CROSSFIX_GENERATE").is_some() {
        fs::write(&committed, fresh).unwrap();
    }
    assert!(
        fs::read(&committed).unwrap() == fresh,
        "{} is not what foxglove.proto says: run this test with CROSSFIX_GENERATE=1",
        committed.display()
    );
}

#[test]
fn the_committed_code_and_schema_are_those_of_the_definitions() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("proto");
    let descriptors = protox::compile(["foxglove/foxglove.proto"], [root]).unwrap();
    let mut schema = descriptors.clone();
    for file in &mut schema.file {
        file.source_code_info = None;
    }
    check("foxglove.bin", &prost::Message::encode_to_vec(&schema));
    let out = tempfile::tempdir().unwrap();
    prost_build::Config::new().out_dir(out.path()).compile_fds(descriptors).unwrap();
    check("foxglove.rs", &fs::read(out.path().join("foxglove.rs")).unwrap());
}
