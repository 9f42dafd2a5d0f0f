//! What a person meets at the command line.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::collections::BTreeSet;

use assert_cmd::Command;

/// All commands, in any order.
const COMMANDS: [&str; 23] = [
    "demo",
    "agent",
    "track",
    "fuse",
    "record",
    "replay",
    "view",
    "info",
    "simulate",
    "import",
    "export",
    "evaluate",
    "check",
    "plan",
    "calibrate",
    "sources",
    "recover",
    "doctor",
    "status",
    "router",
    "validate",
    "enroll",
    "outlet",
];

fn crossfix() -> Command {
    Command::new(assert_cmd::cargo::cargo_bin!("crossfix"))
}

#[test]
fn every_command_has_a_purpose_and_an_example() {
    let help = String::from_utf8(crossfix().arg("--help").output().unwrap().stdout).unwrap();
    for command in COMMANDS {
        assert!(help.contains(&format!("\n  {command} ")), "{command} is missing in:\n{help}");
        let output = crossfix().args([command, "--help"]).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(text.contains("Example"), "{command} has no example:\n{text}");
        assert!(text.contains(&format!("crossfix {command}")), "{command}:\n{text}");
    }
}

/// All commands and their subcommands, each as the arguments that name it.
fn all_commands() -> Vec<Vec<String>> {
    let mut all = vec![Vec::new()];
    let mut next = 0;
    while next < all.len() {
        let command = all[next].clone();
        let children = subcommands(&help_of(&command));
        all.extend(children.into_iter().map(|child| [command.as_slice(), &[child]].concat()));
        next += 1;
    }
    all
}

/// The help of a command in a terminal that is wider than the help may be.
fn help_of(command: &[String]) -> String {
    let output = crossfix().args(command).arg("--help").env("COLUMNS", "200").output().unwrap();
    assert!(output.status.success(), "{command:?} --help: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

fn subcommands(help: &str) -> Vec<String> {
    let list = help.split_once("\nCommands:\n").map_or("", |(_, rest)| rest);
    let names = list.lines().take_while(|line| !line.is_empty()).filter_map(|line| {
        // A description that goes on in another line is indented by more than a name.
        line.strip_prefix("  ").filter(|line| !line.starts_with(' '))?.split(' ').next()
    });
    names.filter(|name| *name != "help").map(str::to_owned).collect()
}

#[test]
fn no_help_is_wider_than_100_columns() {
    let commands = all_commands();
    assert!(commands.len() > COMMANDS.len(), "{commands:?}");
    for command in commands {
        for line in help_of(&command).lines() {
            assert!(line.chars().count() <= 100, "{command:?} --help: {line}");
        }
    }
}

/// An example is copied into a shell: where it goes on in another line, it says so.
#[test]
fn a_long_example_is_broken_as_a_shell_needs_it() {
    let mut with_examples = 0;
    for command in all_commands() {
        let help = help_of(&command);
        let Some((_, examples)) = help.split_once("\nExample") else { continue };
        with_examples += 1;
        let mut goes_on = false;
        for line in examples.lines().skip(1).filter(|line| !line.is_empty()) {
            assert_eq!(goes_on, !line.starts_with("  crossfix "), "{command:?} --help: {line}");
            goes_on = line.ends_with('\\');
        }
        assert!(!goes_on, "{command:?} --help ends with a backslash");
    }
    assert!(with_examples >= COMMANDS.len(), "{with_examples} helps have examples");
}

/// Two usages are written by hand, as clap breaks no long line of them.
#[test]
fn a_usage_that_is_written_by_hand_names_what_must_be_given() {
    for command in [&["export"][..], &["import", "drone-tracking-datasets"]] {
        let said = crossfix().args(command).output().unwrap();
        assert_eq!(said.status.code(), Some(2));
        let said = String::from_utf8(said.stderr).unwrap();
        let (missing, usage) = said.split_once("Usage:").unwrap();
        let usage = usage.split("\n\n").next().unwrap();
        assert!(!options_in(missing).is_empty(), "{said}");
        assert_eq!(options_in(missing), options_in(usage), "{said}");
    }
}

fn options_in(text: &str) -> BTreeSet<&str> {
    let words = text.split(|c: char| !c.is_ascii_alphanumeric() && c != '-');
    words.filter(|word| word.starts_with("--")).collect()
}

#[test]
fn misuse_ends_with_2_and_failure_with_1() {
    crossfix().arg("fly").assert().code(2);
    crossfix().args(["info", "no-such-file.mcap"]).assert().code(1);
}

#[test]
fn numbers_that_nobody_can_mean_are_misuse() {
    let of = [
        (&["evaluate", "a.mcap", "--cutoff-m"][..], ["nan", "-1", "0", "1e300"]),
        (&["evaluate", "a.mcap", "--skip-s"], ["nan", "-5", "inf", "1e300"]),
        (&["evaluate", "a.mcap", "--truth-sd"], ["nan", "-1", "inf", "1e300"]),
        (&["plan", "site", "--speed"], ["nan", "inf", "fast", "1e300"]),
        (&["plan", "site", "--step"], ["nan", "0", "inf", "1e9"]),
        (&["plan", "site", "--pixel-sd"], ["nan", "0", "inf", "1e300"]),
        (&["export", "a.mcap", "--geoid"], ["nan", "inf", "high", "1e300"]),
        (&["record", "-c", "a.toml", "-o", "a.mcap", "--rotate-mb"], ["nan", "0", "inf", "1e-9"]),
        (&["demo", "--duration"], ["nan", "-1", "4", "1e300"]),
        (&["simulate", "a.toml", "-o", "a.mcap", "--noise-px"], ["nan", "-1", "0", "1e300"]),
        (&["sources", "--seconds"], ["nan", "inf", "long", "1e300"]),
    ];
    for (arguments, bad) in of {
        for number in bad {
            let output = crossfix().args(arguments).arg(number).output().unwrap();
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            assert_eq!(output.status.code(), Some(2), "{arguments:?} {number}: {said}");
            assert!(said.contains("invalid value"), "{arguments:?} {number}: {said}");
        }
    }
}

#[test]
fn a_box_outside_the_image_is_no_target() {
    let folder = tempfile::tempdir().unwrap();
    let video = folder.path().join("grey.y4m");
    let mut bytes = b"YUV4MPEG2 W64 H48 F30:1 Ip A1:1 Cmono\n".to_vec();
    for _ in 0..3 {
        bytes.extend_from_slice(b"FRAME\n");
        bytes.extend_from_slice(&[128; 64 * 48]);
    }
    std::fs::write(&video, bytes).unwrap();
    let table = folder.path().join("rows.csv");
    let tracked = |place: &str| {
        let path = [video.to_str().unwrap(), table.to_str().unwrap()];
        let arguments = ["track", path[0], "--box", place, "--csv", path[1]];
        crossfix().args(arguments).output().unwrap()
    };
    for place in ["500,500,10,10", "64,10,10,10", "-10,10,10,10"] {
        let output = tracked(place);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.contains("lies outside the image of 64x48 pixels"), "{said}");
        assert!(!table.exists());
    }
    assert!(tracked("60,10,10,10").status.success(), "a part of it lies inside");
}

#[test]
fn an_error_is_a_line_and_its_causes() {
    let output = crossfix().args(["info", "no-such-file.mcap"]).output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(stderr.starts_with("error: cannot open no-such-file.mcap\n  because: "), "{stderr}");
}

#[test]
fn results_are_json_where_it_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let recording = folder.path().join("a.mcap");
    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/demo/scene.toml");
    let path = recording.to_str().unwrap();
    crossfix().args(["simulate", scene, "--set", "duration_s=2", "-o", path]).assert().success();
    let output = crossfix().args(["info", path, "--json"]).output().unwrap();
    let info: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(info["channels"].as_array().unwrap().len() >= 7, "{info}");
}

#[test]
fn the_site_to_copy_is_good() {
    let site = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/site");
    crossfix().args(["check", "-c", site]).assert().success();
}

/// A camera of the host that is not there, and one that is no camera, are reported with the remedy;
/// its configuration is compared with what cameras can do.
#[cfg(target_os = "linux")]
#[test]
fn a_camera_of_the_host_is_asked_for_by_its_device() {
    let tried = |arguments: &[&str]| {
        let output = crossfix().args(arguments).output().unwrap();
        let text = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
        (output.status.code(), text)
    };
    let (code, said) = tried(&["sources", "/dev/video999", "--seconds", "0.3"]);
    assert!(code == Some(1) && said.contains("is the camera plugged in?"), "{said}");
    let (code, _) = tried(&["sources", "/dev/null", "--seconds", "0.3"]);
    assert_eq!(code, Some(1));
    let (code, _) = tried(&["sources", "/dev/video999", "--size", "1280"]);
    assert_eq!(code, Some(2));
    assert_eq!(tried(&["sources"]).0, Some(0));
    let site = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/site");
    let camera = format!("{site}/north.toml");
    let with = |source: &str| {
        let set = format!("source={source}");
        tried(&["check", "-c", &camera, "--set", &set])
    };
    let (code, said) = with(r#"{ kind = "usb", device = "/dev/null", rate_hz = 0.0 }"#);
    assert!(code == Some(1) && said.contains("source.rate_hz"), "{said}");
    let (code, said) = with(r#"{ kind = "usb", device = "/dev/video999" }"#);
    assert!(code == Some(1) && said.contains("/dev/video999 is not there"), "{said}");
}
