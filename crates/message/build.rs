//! Compiles the protobuf definitions without a system `protoc`.

use std::{env, error::Error, fs, path::PathBuf};

use prost_build::Config;

fn main() -> Result<(), Box<dyn Error>> {
    const ROOT: &str = "proto";
    const FILE: &str = "proto/crossfix/v1/messages.proto";
    println!("cargo:rerun-if-changed={FILE}");
    println!("cargo:rerun-if-changed=build.rs");

    let descriptors = protox::compile([FILE], [ROOT])?;
    let out = PathBuf::from(env::var_os("OUT_DIR").ok_or("cargo sets OUT_DIR")?);
    // The recordings embed this set as the schema of every channel.
    // Without its comments, which are ten times as long as the rest.
    let mut schema = descriptors.clone();
    for file in &mut schema.file {
        file.source_code_info = None;
    }
    fs::write(out.join("descriptors.bin"), prost::Message::encode_to_vec(&schema))?;
    Config::new()
        .type_attribute(".", "#[derive(serde::Serialize, serde::Deserialize)]")
        .message_attribute(".", "#[serde(default)]")
        .compile_fds(descriptors)?;
    Ok(())
}
