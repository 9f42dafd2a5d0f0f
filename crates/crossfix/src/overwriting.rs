//! No command writes onto a file that it reads, nor two results into one file.

use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::{ArgMatches, Command};

/// The arguments that name files to write.
const WRITTEN: [&str; 12] = [
    "output", "csv", "save", "geojson", "kml", "cot", "sapient", "asterix", "foxglove", "log_out",
    "picture", "json",
];
/// What is read of a folder that the argument `dir` names: the files of data sets.
const OF_DATA_SETS: [&str; 5] =
    ["scenario.json", "exposures.csv", "detections.csv", "truth.csv", "poses.json"];
/// How the files end that are read of a folder that the argument `site` names, ...
const OF_SITES: [&str; 3] = ["toml", "yaml", "yml"];
/// ... but for the one that `calibrate` completes camera by camera.
const COMPLETED: &str = "calibration.toml";

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
        let name = written.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let ending = written.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
        let is_in_it = match self.argument.as_str() {
            "dir" => OF_DATA_SETS.contains(&name),
            "site" => OF_SITES.contains(&ending) && name != COMPLETED,
            _ => false,
        };
        let folder = written.parent().unwrap_or(Path::new(""));
        is_one_file(written, &self.path) || is_in_it && is_one_file(folder, &self.path)
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

    #[cfg(feature = "centre")]
    #[test]
    fn a_sites_calibration_is_completed_camera_by_camera() {
        let folder = tempfile::tempdir().unwrap();
        let site = folder.path().to_str().unwrap();
        let file = |name: &str| {
            let path = folder.path().join(name);
            std::fs::write(&path, "dear").unwrap();
            path.to_str().unwrap().to_owned()
        };
        let points = file("points.csv");
        let line = |output: &str| {
            let calibrate = ["crossfix", "calibrate", "landmarks", site, "--camera", "north"];
            refused(&[&calibrate[..], &["--landmarks", &points, "-o", output]].concat())
        };
        assert_eq!(line(&file("calibration.toml")), None);
        assert!(line(&file("north.toml")).is_some());
    }
}
