//! Every command of the book, run as its reader runs it: each page's blocks marked `sh`, in their
//! order, in a folder of their own that holds the repository's `configs` and `recordings`. Blocks
//! marked `sh,ignore` need what is not here: a camera, another host, the system's administrator.

#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    reason = "a test that cannot set itself up has failed, and one that is skipped says so"
)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use crossfix_tests::program;

/// A page's commands take half a minute at most; three times that on a busy machine is not for
/// ever.
const PATIENCE: Duration = Duration::from_secs(150);
/// Pages use the ports of `configs/site`: where they have no network of their own they take turns.
static TURN: Mutex<()> = Mutex::new(());

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The blocks of a page that can be run.
fn blocks(page: &Path) -> Vec<String> {
    let (mut blocks, mut block): (Vec<String>, Option<(bool, String)>) = (Vec::new(), None);
    for line in fs::read_to_string(page).unwrap().lines() {
        match (line.trim_start().strip_prefix("```"), &mut block) {
            (Some(kind), None) => block = Some((kind == "sh", String::new())),
            (Some(_), Some((is_run, text))) => {
                if *is_run {
                    blocks.push(std::mem::take(text));
                }
                block = None;
            }
            (None, Some((_, text))) => text.extend([line, "\n"]),
            (None, None) => {}
        }
    }
    blocks
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let target = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            copy(&entry.path(), &target);
        } else {
            fs::copy(entry.path(), target).unwrap();
        }
    }
}

/// Whether a page can have a network of its own.
fn has_networks() -> bool {
    let tried = Command::new("unshare").args(["-n", "sh", "-c", "ip link set lo up"]).output();
    tried.is_ok_and(|tried| tried.status.success())
}

/// Runs one block as `sh -eu`.
fn run(block: &str, folder: &Path, alone: bool) -> Result<(), String> {
    let script = folder.join("block.sh");
    fs::write(&script, block).unwrap();
    let shell =
        if alone { "ip link set lo up && exec sh -eu block.sh" } else { "exec sh -eu block.sh" };
    let mut command = if alone { Command::new("unshare") } else { Command::new("sh") };
    let arguments: &[&str] = if alone { &["-n", "sh", "-c", shell] } else { &["-c", shell] };
    let path = format!(
        "{}:{}",
        program().parent().unwrap().display(),
        std::env::var("PATH").unwrap_or_default()
    );
    let said = fs::File::create(folder.join("said")).unwrap();
    let mut child = command
        .args(arguments)
        .current_dir(folder)
        .env("PATH", path)
        .stdin(Stdio::null())
        .stdout(said.try_clone().unwrap())
        .stderr(said)
        .spawn()
        .unwrap();
    let deadline = Instant::now() + PATIENCE;
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break Some(status);
        }
        if Instant::now() > deadline {
            child.kill().unwrap();
            child.wait().unwrap();
            break None;
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    if status.is_some_and(|status| status.success()) {
        return Ok(());
    }
    let said = fs::read_to_string(folder.join("said")).unwrap_or_default();
    let last: Vec<&str> = said.lines().rev().take(15).collect();
    Err(format!("{block}\n{status:?}\n{}", last.into_iter().rev().collect::<Vec<_>>().join("\n")))
}

fn run_page(page: &str) {
    let alone = has_networks();
    let _turn = (!alone).then(|| TURN.lock().unwrap_or_else(PoisonError::into_inner));
    let folder = tempfile::tempdir().unwrap();
    for held in ["configs", "recordings"] {
        copy(&repository().join(held), &folder.path().join(held));
    }
    let blocks = blocks(&repository().join(page));
    assert!(!blocks.is_empty(), "{page} has no command that is run: take it off the list");
    for block in blocks {
        if let Err(what) = run(&block, folder.path(), alone) {
            panic!("{page}:\n{what}");
        }
    }
}

macro_rules! pages {
    ($($name:ident: $path:literal,)*) => {
        $(
            #[test]
            fn $name() {
                run_page($path);
            }
        )*

        /// The pages with commands that are run.
        const PAGES: &[&str] = &[$($path),*];
    };
}

pages! {
    readme: "README.md",
    areas: "docs/areas.md",
    calibration: "docs/calibration.md",
    cameras: "docs/cameras.md",
    formats: "docs/formats.md",
    guide: "docs/guide.md",
    installation: "docs/installation.md",
    operation: "docs/operation.md",
    outlets: "docs/outlets.md",
    placement: "docs/placement.md",
    introduction: "docs/introduction.md",
    security: "docs/security.md",
    site: "docs/site.md",
    survey: "docs/survey.md",
    troubleshooting: "docs/troubleshooting.md",
}

/// The Markdown files of a folder, by their paths in the repository.
fn pages_in(folder: &str) -> Vec<String> {
    let files = fs::read_dir(repository().join(folder)).unwrap().map(Result::unwrap);
    let names = files.map(|entry| entry.file_name().into_string().unwrap());
    let pages = names.filter(|name| name.ends_with(".md"));
    pages.map(|name| if folder == "." { name } else { format!("{folder}/{name}") }).collect()
}

#[test]
fn no_page_with_commands_is_left_out_and_all_are_in_the_book() {
    let with_commands = ["docs", "recordings", "configs", "."]
        .into_iter()
        .flat_map(pages_in)
        .filter(|page| !blocks(&repository().join(page)).is_empty());
    for page in with_commands {
        assert!(PAGES.contains(&page.as_str()), "{page} is run by no test");
    }
    let summary = fs::read_to_string(repository().join("docs/SUMMARY.md")).unwrap();
    for page in pages_in("docs") {
        let name = page.trim_start_matches("docs/");
        assert!(name == "SUMMARY.md" || summary.contains(&format!("({name})")), "{name}");
    }
    for line in summary.lines().filter(|line| line.contains("](")) {
        let page = line.split("](").nth(1).and_then(|rest| rest.split(')').next()).unwrap();
        assert!(repository().join("docs").join(page).is_file(), "{line}");
    }
}
