//! The generated code is that of the definitions.
//!
//! It is committed, as compiling the protobuf compiler in every build takes a minute of processor
//! time. Whoever changes `messages.proto` writes it anew with
//! `CROSSFIX_GENERATE=1 cargo test -p crossfix-message --test generated`.
#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::fs;
use std::path::{Path, PathBuf};

use prost_build::Config;

const PROTO: &str = "crossfix/v1/messages.proto";

fn generated() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src/generated")
}

/// Compares a committed file with what the definitions give now, or writes it where that is asked
/// for.
fn check(name: &str, fresh: &[u8]) {
    let committed = generated().join(name);
    if std::env::var_os("CROSSFIX_GENERATE").is_some() {
        fs::write(&committed, fresh).unwrap();
    }
    assert!(
        fs::read(&committed).unwrap() == fresh,
        "{} is not what messages.proto says: run this test with CROSSFIX_GENERATE=1",
        committed.display()
    );
}

#[test]
fn the_committed_code_and_schema_are_those_of_the_definitions() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("proto");
    let descriptors = protox::compile([PROTO], [root]).unwrap();

    // Recordings embed this set as the schema of every channel, without the definitions' comments,
    // which are ten times as long as the rest.
    let mut schema = descriptors.clone();
    for file in &mut schema.file {
        file.source_code_info = None;
    }
    check("descriptors.bin", &prost::Message::encode_to_vec(&schema));

    let out = tempfile::tempdir().unwrap();
    Config::new()
        .out_dir(out.path())
        .type_attribute(".", "#[derive(serde::Serialize, serde::Deserialize)]")
        .message_attribute(".", "#[serde(default)]")
        .compile_fds(descriptors)
        .unwrap();
    check("crossfix.v1.rs", &fs::read(out.path().join("crossfix.v1.rs")).unwrap());
}
