//! Parts that this build leaves out, and the messages about them.

/// Parts of the program that a build may leave out, with the feature that includes each.
const PARTS: [(&str, &str, bool); 2] = [
    ("the fusion centre's commands", "centre", cfg!(feature = "centre")),
    ("pictures for Rerun", "viewer", cfg!(feature = "viewer")),
];

/// Whether this build decodes H.264 half as fast as it could: what doubles it exists for x86 only.
pub const DECODES_SLOWLY: bool = cfg!(all(target_arch = "x86_64", not(has_nasm)));

/// How a build decodes H.264 twice as fast.
pub const WITH_NASM: &str = "with nasm installed at build time H.264 is decoded twice as fast: \
                             apt-get install nasm, cargo clean -p openh264-sys2, build again";

/// End of the help text: where to start, or what is left out and how to include it.
pub fn closing_words() -> String {
    let lines: Vec<String> = PARTS
        .iter()
        .filter(|(.., is_here)| !is_here)
        .map(|(part, feature, _)| format!("This build leaves out {part} (`--features {feature}`)."))
        .collect();
    if lines.is_empty() { "Start with `crossfix demo`.".to_owned() } else { lines.join("\n") }
}

/// The error of a build without the viewer when a picture is asked for.
#[cfg(not(feature = "viewer"))]
pub fn no_pictures() -> anyhow::Error {
    is_left_out("pictures for Rerun", "viewer")
}

/// The error when a part that is left out is asked for.
#[cfg(not(all(feature = "centre", feature = "viewer", feature = "onvif")))]
pub fn is_left_out(part: &str, feature: &str) -> anyhow::Error {
    anyhow::anyhow!("this build leaves out {part}: build it with `--features {feature}`")
}
