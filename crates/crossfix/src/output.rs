//! What people and programs read: results on stdout, the last error on stderr.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use anyhow::{Context, bail, ensure};
use serde::Serialize;

/// Why a line of the result could not be written, the first time.
static UNWRITTEN: OnceLock<io::Error> = OnceLock::new();

/// Writes a line of the result. A reader that has gone away (`| head`) is not an error; any other
/// is one of the whole command: see [`ensure_written`].
pub fn line(text: impl std::fmt::Display) {
    note_written(writeln!(io::stdout().lock(), "{text}"));
}

fn note_written(written: io::Result<()>) {
    if let Err(error) = written
        && error.kind() != io::ErrorKind::BrokenPipe
    {
        // What follows is lost for the same reason.
        let _ = UNWRITTEN.set(error);
    }
}

/// Fails if a line of the result could not be written.
pub fn ensure_written() -> anyhow::Result<()> {
    note_written(io::stdout().flush());
    match UNWRITTEN.get() {
        None => Ok(()),
        Some(error) => bail!("cannot write the result: {error}"),
    }
}

/// Writes a result as JSON.
pub fn json(value: &impl Serialize) -> anyhow::Result<()> {
    line(serde_json::to_string_pretty(value)?);
    Ok(())
}

/// Arguments that contradict each other, which the parser of the command line cannot see.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Misuse(pub String);

/// Prints why the command failed: the error and its causes, one per line.
pub fn error(error: &anyhow::Error) {
    let mut stderr = io::stderr().lock();
    let _ = writeln!(stderr, "error: {error}");
    for cause in error.chain().skip(1) {
        let _ = writeln!(stderr, "  because: {cause}");
    }
}

/// The temporary files that exist now: where the process is asked to stop and a command does not
/// check for that, it ends without their owners.
static DRAFTS: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// Removes the files that are not complete; the program is about to end.
pub fn remove_drafts() {
    for part in std::mem::take(&mut *drafts()) {
        let _ = std::fs::remove_file(part);
    }
}

fn drafts() -> MutexGuard<'static, BTreeSet<PathBuf>> {
    DRAFTS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A file that is being written. It has a temporary name until it is complete, so that an existing
/// file of the wanted name stays until then, and nobody takes half a file for a whole one.
#[derive(Debug)]
pub struct Draft {
    path: PathBuf,
    /// Temporary path. `None`: written in place, as pipes and devices must be.
    part: Option<PathBuf>,
}

impl Draft {
    /// A draft of a file that is made from `inputs`, none of which it may overwrite.
    pub fn new(path: &Path, inputs: &[&Path]) -> anyhow::Result<Self> {
        for input in inputs {
            ensure!(
                !same_file::is_same_file(path, input).unwrap_or(false),
                "{} is what is read: write to another file",
                path.display()
            );
        }
        let in_place = path.exists() && !path.is_file();
        ensure!(!path.is_dir(), "cannot write {}: it is a folder", path.display());
        // If the path is a link, the file it points to is replaced, not the link.
        let path = path.canonicalize().unwrap_or_else(|_| path.to_owned());
        let mut part = path.clone().into_os_string();
        part.push(format!(".{}.part", std::process::id()));
        let part: Option<PathBuf> = (!in_place).then(|| part.into());
        drafts().extend(part.clone());
        Ok(Self { path, part })
    }

    /// The path to write to.
    pub fn path(&self) -> &Path {
        self.part.as_deref().unwrap_or(&self.path)
    }

    /// Moves the completed file to its final name.
    pub fn keep(mut self) -> anyhow::Result<()> {
        if let Some(part) = self.part.take() {
            drafts().remove(&part);
            std::fs::rename(&part, &self.path)
                .with_context(|| format!("cannot write {}", self.path.display()))?;
        }
        Ok(())
    }
}

impl Drop for Draft {
    fn drop(&mut self) {
        if let Some(part) = &self.part {
            drafts().remove(part);
            let _ = std::fs::remove_file(part);
        }
    }
}

/// Most names that are tried for a file whose name is in use. With half as many the 5000th file of
/// one name would be refused.
const MOST_NAMES: u32 = 10_000;

/// The wanted name, and those tried where it is in use: `today-2.mcap`, `today-3.mcap` ..
pub fn names(asked: &Path) -> impl Iterator<Item = PathBuf> + '_ {
    let stem = asked.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let extension =
        asked.extension().map(|e| format!(".{}", e.to_string_lossy())).unwrap_or_default();
    let others = (2..MOST_NAMES)
        .map(move |number| asked.with_file_name(format!("{stem}-{number}{extension}")));
    std::iter::once(asked.to_owned()).chain(others)
}

/// Logs that a file is written under another name than was asked for.
pub fn say_other_name(asked: &Path, path: &Path) {
    if path != asked {
        tracing::warn!(
            "{} is there already and stays: writing to {} (--overwrite replaces it)",
            asked.display(),
            path.display()
        );
    }
}

/// Writes a complete file.
pub fn write_file(path: &Path, inputs: &[&Path], bytes: &[u8]) -> anyhow::Result<()> {
    let draft = Draft::new(path, inputs)?;
    std::fs::write(draft.path(), bytes)
        .with_context(|| format!("cannot write {}", path.display()))?;
    draft.keep()
}

/// A number for a table, or a dash.
pub fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
}

/// Lines up the columns of a table; the first row is its head.
pub fn table(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(|column| width(rows, column)).collect();
    let mut lines: Vec<String> = rows.iter().map(|row| line_of(row, &widths)).collect();
    if lines.len() > 1 {
        let total = widths.iter().sum::<usize>() + 2 * columns.saturating_sub(1);
        lines.insert(1, "-".repeat(total));
    }
    lines.join("\n")
}

/// Width of a table's column, in characters.
fn width(rows: &[Vec<String>], column: usize) -> usize {
    let cells = rows.iter().filter_map(|row| row.get(column));
    cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
}

/// A row of a table: the first column aligned to the left, all others to the right.
fn line_of(row: &[String], widths: &[usize]) -> String {
    let mut line = String::new();
    for (column, (text, &width)) in row.iter().zip(widths).enumerate() {
        line += &if column == 0 { format!("{text:<width$}") } else { format!("  {text:>width$}") };
    }
    line.trim_end().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_has_its_name_only_once_it_is_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.csv");
        std::fs::write(&path, "before").unwrap();
        let draft = Draft::new(&path, &[]).unwrap();
        std::fs::write(draft.path(), "half").unwrap();
        drop(draft);
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "before");
        assert_eq!(
            std::fs::read_dir(folder.path()).unwrap().count(),
            1,
            "nothing is left lying about"
        );
        write_file(&path, &[], b"after").unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "after");
    }

    #[test]
    fn nothing_is_written_onto_what_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mcap");
        std::fs::write(&path, "dear").unwrap();
        let detour = folder.path().join(".").join("a.mcap");
        assert!(Draft::new(&detour, &[&path]).is_err());
        let link = folder.path().join("link.mcap");
        std::fs::hard_link(&path, &link).unwrap();
        assert!(Draft::new(&link, &[&path]).unwrap_err().to_string().contains("is what is read"));
    }

    #[test]
    fn devices_are_written_in_place() {
        let null = Path::new("/dev/null");
        if null.exists() {
            write_file(null, &[], b"gone").unwrap();
            assert!(!null.is_file() && !Path::new("/dev/null.part").exists());
        }
    }
}
