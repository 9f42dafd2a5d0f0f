//! No command writes onto a file that it reads, nor two results into one file.

use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::{ArgMatches, Command};

/// The arguments that name files to write.
const WRITTEN: [&str; 12] = [
    "output", "csv", "save", "geojson", "kml", "cot", "sapient", "asterix", "foxglove", "log_out",
    "picture", "json",
];
/// The arguments that name folders of which the files with these endings are read.
const FOLDERS: [&str; 2] = ["dir", "site"];
const READ_IN_FOLDERS: [&str; 5] = ["csv", "json", "toml", "yaml", "yml"];

/// A path on the command line.
struct NamedPath {
    argument: String,
    path: PathBuf,
}

impl NamedPath {
    fn is_written(&self) -> bool {
        WRITTEN.contains(&self.argument.as_str())
    }

    /// Whether this is a file that is read, of which `written` would be the end.
    fn is_read_from(&self, written: &Path) -> bool {
        let is_folder = FOLDERS.contains(&self.argument.as_str()) && self.path.is_dir();
        let ending = written.extension().and_then(|ending| ending.to_str());
        if is_folder && ending.is_some_and(|ending| READ_IN_FOLDERS.contains(&ending)) {
            return is_one_file(written.parent().unwrap_or(Path::new("")), &self.path);
        }
        is_one_file(written, &self.path)
    }
}

/// Refuses a command line on which a file that exists is to be read and written, or one file to be
/// written twice. Pipes and devices may be.
pub fn check(command: &Command, matches: &ArgMatches) -> anyhow::Result<()> {
    let paths = paths(command, matches);
    let (written, read): (Vec<_>, Vec<_>) = paths.into_iter().partition(NamedPath::is_written);
    let is_ordinary = |path: &Path| path.is_file() || !path.exists();
    for (index, NamedPath { path, .. }) in written.iter().enumerate() {
        let shown = path.display();
        if path.is_file() && read.iter().any(|other| other.is_read_from(path)) {
            bail!("{shown} is what is read: write to another file");
        }
        let earlier = written[..index].iter();
        if is_ordinary(path) && earlier.clone().any(|other| is_one_file(&other.path, path)) {
            bail!("{shown} is to be written twice: name two files");
        }
    }
    Ok(())
}

/// Whether two paths name one file, which need not exist.
fn is_one_file(one: &Path, other: &Path) -> bool {
    let here = |path: &Path| if path.as_os_str().is_empty() { ".".into() } else { path.to_owned() };
    let (one, other) = (here(one), here(other));
    one == other || same_file::is_same_file(one, other).unwrap_or(false)
}

/// The values on the command line, as paths, those of the subcommand that is called.
fn paths(mut command: &Command, mut matches: &ArgMatches) -> Vec<NamedPath> {
    while let Some((name, of_subcommand)) = matches.subcommand()
        && let Some(subcommand) = command.find_subcommand(name)
    {
        (command, matches) = (subcommand, of_subcommand);
    }
    let arguments = command.get_arguments().filter(|argument| argument.get_action().takes_values());
    let mut paths = Vec::new();
    for argument in arguments {
        let name = argument.get_id().as_str();
        let values = matches.try_get_raw(name).ok().flatten().into_iter().flatten();
        paths.extend(values.map(|path| NamedPath { argument: name.to_owned(), path: path.into() }));
    }
    paths
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    /// Why a command line is refused, if it is.
    fn refused(line: &[&str]) -> Option<String> {
        let command = crate::Cli::command();
        let matches = command.clone().try_get_matches_from(line).unwrap();
        check(&command, &matches).err().map(|error| error.to_string())
    }

    #[test]
    fn what_is_read_is_not_written_whatever_the_option_is_called() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str| {
            let path = folder.path().join(name);
            std::fs::write(&path, "dear").unwrap();
            path.to_str().unwrap().to_owned()
        };
        let (video, config, other) = (file("a.mp4"), file("c.toml"), file("table.csv"));
        let detour = folder.path().join(".").join("c.toml");
        let detour = detour.to_str().unwrap();
        let line = |csv| refused(&["crossfix", "track", &video, "-c", &config, "--csv", csv]);
        assert_eq!(line(&other), None);
        for csv in [config.as_str(), detour, &video] {
            assert!(line(csv).unwrap().ends_with("is what is read: write to another file"));
        }
    }

    #[test]
    fn one_file_is_not_written_twice_but_a_device_may_be() {
        let line =
            |csv, save| refused(&["crossfix", "track", "a.mp4", "--csv", csv, "--save", save]);
        assert!(line("new", "new").unwrap().ends_with("is to be written twice: name two files"));
        assert_eq!(line("new", "newer"), None);
        assert_eq!(line("/dev/null", "/dev/null"), None);
    }

    #[cfg(feature = "centre")]
    #[test]
    fn what_a_folder_is_read_of_is_not_written_and_a_recording_in_it_may_be() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
        let line = |output: &str| {
            std::fs::write(output, "dear").unwrap();
            refused(&["crossfix", "import", "scenario", &path(""), "-o", output])
        };
        assert!(line(&path("detections.csv")).is_some());
        assert_eq!(line(&path("before.mcap")), None);
    }
}
