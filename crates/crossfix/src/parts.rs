//! What this build leaves out, said to whoever asks for it.

/// The parts of the program that a build may leave out, with the feature that brings each.
const PARTS: [(&str, &str, bool); 2] = [
    ("the fusion centre's commands", "centre", cfg!(feature = "centre")),
    ("pictures for Rerun", "viewer", cfg!(feature = "viewer")),
];

/// A line for the help: what is left out, and how to have it; nothing of a whole build.
pub fn left_out() -> String {
    let lines = PARTS.iter().filter(|(.., is_here)| !is_here);
    let lines = lines.map(|(part, feature, _)| {
        format!("This build leaves out {part} (`--features {feature}`).")
    });
    lines.collect::<Vec<_>>().join("\n")
}

/// The error of asking for a part that is left out.
#[cfg(not(all(feature = "centre", feature = "viewer")))]
pub fn is_left_out(part: &str, feature: &str) -> anyhow::Error {
    anyhow::anyhow!("this build leaves out {part}: build it with `--features {feature}`")
}
