//! The successive files of a recorder, and the space that they and others use on the disk.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{bail, ensure};
use crossfix_recording::{RecordingError, RecordingWriter, Source};
use time::OffsetDateTime;

use crate::commands::numbers;
use crate::output::{self, Misuse};
use crate::repeats::Repeats;

/// Writer of a recording to a file.
pub type FileWriter = RecordingWriter<BufWriter<File>>;

/// Bytes of a megabyte, as disks are sold and as `--rotate-mb` counts.
const MB: f64 = 1e6;
/// Bytes of a gigabyte, as disks are sold and as the options with GB count.
const GB: f64 = 1e9;
/// Removals stop after this many old recordings in a row whose removal freed no space. With half as
/// many a disk that frees space late would end them too early; with twice as many twice as many
/// recordings may be lost for nothing.
const MOST_IN_VAIN: u32 = 10;
/// With less free space than this share of what is to be left free, only the messages from which
/// tracks can be made are recorded. With half of it other messages go on until 25 of the default
/// 500 MB are left, and those from which tracks are made lack the other 25.
const LAST_SHARE: f64 = 0.1;

/// How large and how long a file gets, and how much all of them may take.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct Limits {
    /// Begin a new file when the current one has this size, MB. Each file is named after the time
    /// at which it begins: today-20261125T221700Z.mcap.
    #[arg(long, value_name = "MB", value_parser = numbers::megabytes)]
    rotate_mb: Option<f64>,
    /// Begin a new file after this many minutes.
    #[arg(long, value_name = "MINUTES", value_parser = numbers::minutes)]
    rotate_min: Option<f64>,
    /// Most disk space for all files of that name, also those of earlier runs, GB: the oldest ones
    /// are removed when they take more.
    #[arg(long, value_name = "GB", value_parser = numbers::quota)]
    quota_gb: Option<f64>,
    /// Space to leave free on the disk, GB. If there is less, the oldest of these files is removed;
    /// if none is left to remove, pictures are no longer recorded; and below a tenth of it, only
    /// bearings, calibrations and tracks are.
    #[arg(long, value_name = "GB", default_value_t = 0.5, value_parser = numbers::gigabytes)]
    leave_free_gb: f64,
}

impl Limits {
    fn rotates(&self) -> bool {
        self.rotate_mb.is_some() || self.rotate_min.is_some()
    }
}

/// What the disk has room for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Room {
    /// Bearings, calibrations and tracks.
    Tracks,
    /// All but pictures.
    Messages,
    /// Everything.
    #[default]
    Pictures,
}

impl Room {
    /// Room with `free` bytes free, of which `left` are to be left free.
    fn of(free: f64, left: f64) -> Self {
        if free < left * LAST_SHARE {
            Self::Tracks
        } else if free < left {
            Self::Messages
        } else {
            Self::Pictures
        }
    }
}

/// The file that is being written.
#[derive(Debug)]
struct Current {
    path: PathBuf,
    begun: Instant,
    /// Locked while the file is written, so that no other recorder removes it.
    _lock: Option<File>,
}

/// The size of what was removed to make room, and the free space before, bytes.
#[derive(Clone, Copy, Debug)]
struct Removed {
    bytes: f64,
    free_before: f64,
}

/// The files of a recorder.
#[derive(Debug)]
pub struct RecordFiles {
    asked: PathBuf,
    overwrite: bool,
    limits: Limits,
    current: Option<Current>,
    /// Files that this run has completed, in their order: names are no guide, as the clock may have
    /// been set.
    ended: Vec<PathBuf>,
    /// Other files with names of this form, with their sizes, bytes; the oldest last.
    older: Vec<(PathBuf, f64)>,
    removed: Option<Removed>,
    /// Number of files removed in a row without freeing space.
    in_vain: u32,
    repeats: Repeats,
}

impl RecordFiles {
    /// Files under a name or, with rotation, under names that begin with it.
    ///
    /// # Errors
    /// If the options contradict each other.
    pub fn new(asked: &Path, overwrite: bool, limits: Limits) -> anyhow::Result<Self> {
        let misuse = |words: &str| Misuse(words.to_owned());
        ensure!(
            limits.rotates() || limits.quota_gb.is_none(),
            misuse("--quota-gb removes files by their age: give --rotate-min or --rotate-mb, too")
        );
        ensure!(
            !(limits.rotates() && overwrite),
            misuse("--overwrite replaces one file: rotated ones have names of their own")
        );
        let mut files = Self {
            asked: asked.to_owned(),
            overwrite,
            limits,
            current: None,
            ended: Vec::new(),
            older: Vec::new(),
            removed: None,
            in_vain: 0,
            repeats: Repeats::default(),
        };
        files.list();
        Ok(files)
    }

    /// Whether files are rotated, that is, one follows another.
    pub fn rotates(&self) -> bool {
        self.limits.rotates()
    }

    /// Begins the next file, which states who writes it.
    ///
    /// # Errors
    /// If it cannot be created; the previous file then remains the current one.
    pub fn create(&mut self, source: &Source) -> anyhow::Result<FileWriter> {
        let (mut writer, path) = if self.limits.rotates() {
            create_new(&self.named(OffsetDateTime::now_utc()))?
        } else {
            create(&self.asked, self.overwrite)?
        };
        writer.sign(source)?;
        let lock = File::open(&path).ok().filter(|file| path.is_file() && file.try_lock().is_ok());
        let next = Current { path, begun: Instant::now(), _lock: lock };
        self.ended.extend(self.current.replace(next).map(|before| before.path));
        self.list();
        Ok(writer)
    }

    /// Path of the file that is being written.
    pub fn path(&self) -> &Path {
        self.current.as_ref().map_or(&self.asked, |current| &current.path)
    }

    /// Whether it is time for the next file, also because somebody has removed this one.
    pub fn is_full(&self) -> bool {
        let Some(Current { path, begun, .. }) = &self.current else { return false };
        let Limits { rotate_mb, rotate_min, .. } = self.limits;
        let is_long = rotate_min.is_some_and(|min| begun.elapsed().as_secs_f64() >= min * 60.0);
        let is_large = rotate_mb.is_some_and(|mb| bytes(path) >= mb * MB);
        self.rotates() && (is_long || is_large || !path.exists())
    }

    /// Removes the oldest file if the quota or the disk requires it, one per call; returns what
    /// there is room for. To be called about once a second.
    pub fn make_room(&mut self) -> Room {
        let left = self.limits.leave_free_gb * GB;
        let quota = self.limits.quota_gb.map_or(f64::INFINITY, |gb| gb * GB);
        let free = self.free();
        self.see_what_it_brought(free);
        let older: f64 = self.older.iter().map(|(_, bytes)| bytes).sum();
        let is_over = older + bytes(self.path()) > quota;
        if is_over || (free < left && self.in_vain < MOST_IN_VAIN) {
            self.remove_oldest(free);
        }
        // The space of a removed file will be free in a moment.
        if self.removed.is_some() && self.in_vain == 0 {
            Room::Pictures
        } else {
            Room::of(free, left)
        }
    }

    /// Removes the oldest file that nobody is writing.
    pub fn remove_oldest(&mut self, free_before: f64) {
        while let Some((oldest, bytes)) = self.older.pop() {
            // A locked file is being written by another recorder.
            if File::open(&oldest).is_ok_and(|file| file.try_lock().is_err()) {
                continue;
            }
            match std::fs::remove_file(&oldest) {
                Ok(()) => {
                    tracing::info!("{} is removed to make room", oldest.display());
                    self.removed = Some(Removed { bytes, free_before });
                    return;
                }
                Err(error) => self.repeats.warn("remove", Instant::now(), || {
                    format!("{} cannot be removed: {error}", oldest.display())
                }),
            }
        }
    }

    /// Checks whether the last removal has freed space. Where snapshots or other programs take the
    /// freed space, the recordings must not all be lost for nothing.
    fn see_what_it_brought(&mut self, free: f64) {
        let Some(Removed { bytes, free_before }) = self.removed.take() else { return };
        self.in_vain = if free > free_before + bytes / 2.0 { 0 } else { self.in_vain + 1 };
        if self.in_vain == MOST_IN_VAIN {
            tracing::warn!("removing old recordings makes no room: no more are removed for it");
        }
    }

    /// Free space on the file's disk, bytes; infinite for a pipe or where the system does not say.
    pub fn free(&self) -> f64 {
        let path = self.path();
        if path.exists() && !path.is_file() {
            return f64::INFINITY;
        }
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        let disk = nix::sys::statvfs::statvfs(folder.unwrap_or(Path::new(".")));
        disk.map_or(f64::INFINITY, |disk| {
            disk.blocks_available() as f64 * disk.fragment_size() as f64
        })
    }

    /// Name of a file that begins at a time.
    fn named(&self, begins: OffsetDateTime) -> PathBuf {
        let (stem, extension) = parts(&self.asked);
        let (year, month, day) = begins.to_calendar_date();
        let (hour, minute, second) = begins.to_hms();
        let month = u8::from(month);
        self.asked.with_file_name(format!(
            "{stem}-{year:04}{month:02}{day:02}T{hour:02}{minute:02}{second:02}Z{extension}"
        ))
    }

    /// Lists the other files with names of this form.
    fn list(&mut self) {
        self.older.clear();
        if !self.rotates() {
            return;
        }
        let folder = self.asked.parent().filter(|folder| !folder.as_os_str().is_empty());
        let folder = folder.unwrap_or(Path::new("."));
        let entries = match std::fs::read_dir(folder) {
            Ok(entries) => entries,
            Err(error) => {
                let folder = folder.display();
                tracing::warn!("cannot look for older files in {folder}, so they stay: {error}");
                return;
            }
        };
        let (stem, extension) = parts(&self.asked);
        let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        let mut found: Vec<OlderFile> = names
            .filter_map(|name| {
                let begins_at = begins_at(&name, &stem, &extension)?;
                Some(self.older_file(self.asked.with_file_name(name), begins_at))
            })
            .filter(|file| file.path != self.path() && file.path.is_file())
            .collect();
        found.sort();
        let youngest_first = found.into_iter().rev();
        self.older = youngest_first.map(|file| (file.path.clone(), bytes(&file.path))).collect();
    }

    fn older_file(&self, path: PathBuf, begins_at: String) -> OlderFile {
        let ended = self.ended.iter().position(|ended| *ended == path);
        OlderFile { ended: ended.map_or(0, |place| place + 1), begins_at, path }
    }
}

/// A file of the recorder that is not written any more; the oldest come first.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct OlderFile {
    /// Its place among the files of this run, by their end, from 1; 0 for files of earlier runs,
    /// which are all older.
    ended: usize,
    /// When it begins, as its name says.
    begins_at: String,
    path: PathBuf,
}

/// The time in a file's name between two parts of it, if it is of that form.
fn begins_at(name: &str, stem: &str, extension: &str) -> Option<String> {
    let begins = name.strip_prefix(stem)?.strip_prefix('-')?.strip_suffix(extension)?;
    is_a_beginning(begins).then(|| begins.to_owned())
}

/// Whether a text is the time in a file's name, with a number after it if two files began in one
/// second.
fn is_a_beginning(text: &str) -> bool {
    let (time, number) = text.split_once('-').unwrap_or((text, "2"));
    let is_time = time.len() == 16
        && time.char_indices().all(|(place, letter)| match place {
            8 => letter == 'T',
            15 => letter == 'Z',
            _ => letter.is_ascii_digit(),
        });
    is_time && !number.is_empty() && number.chars().all(|letter| letter.is_ascii_digit())
}

/// A file's name before and after the inserted time.
fn parts(asked: &Path) -> (String, String) {
    let stem = asked.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let extension = asked.extension().map(|e| format!(".{}", e.to_string_lossy()));
    (stem, extension.unwrap_or_default())
}

fn bytes(path: &Path) -> f64 {
    std::fs::metadata(path).map_or(0.0, |file| file.len() as f64)
}

/// A new file under the name asked for, or under the first free one of `today-2.mcap`,
/// `today-3.mcap` ..: a recorder that is started again must not destroy its earlier recordings.
fn create(asked: &Path, overwrite: bool) -> anyhow::Result<(FileWriter, PathBuf)> {
    // A device or a pipe has no contents that could be lost.
    if overwrite || (asked.exists() && !asked.is_file()) {
        return Ok((RecordingWriter::create(asked)?, asked.to_owned()));
    }
    let (writer, path) = create_new(asked)?;
    output::say_other_name(asked, &path);
    Ok((writer, path))
}

/// A new file under the first name that is free.
fn create_new(asked: &Path) -> anyhow::Result<(FileWriter, PathBuf)> {
    for path in output::names(asked) {
        match RecordingWriter::create_new(&path) {
            Err(RecordingError::Exists { .. }) => {}
            Err(error) => return Err(error.into()),
            Ok(writer) => return Ok((writer, path)),
        }
    }
    bail!("{} is there, and so is every other name of it that was tried", asked.display())
}

#[cfg(test)]
mod tests {
    use crossfix_message::{CameraName, Channel};

    use super::super::recorder::room_for;
    use super::*;

    fn limits(quota_gb: Option<f64>) -> Limits {
        Limits { rotate_mb: Some(1.0), rotate_min: None, quota_gb, leave_free_gb: 0.0 }
    }

    fn at(second: i64) -> OffsetDateTime {
        OffsetDateTime::from_unix_timestamp(1_795_644_000 + second).unwrap()
    }

    #[test]
    fn the_oldest_files_go_and_nothing_that_is_not_the_recorders() {
        let folder = tempfile::tempdir().unwrap();
        let asked = folder.path().join("site.mcap");
        let mut files = RecordFiles::new(&asked, false, limits(Some(2.5e-3))).unwrap();
        let others = [
            "site.mcap",
            "site-2.mcap",
            "site-20261125.mcap",
            "other-20261125T210000Z.mcap",
            "site-20261125T210000Z.mcap.part",
            "site-2026112xT210000Z.mcap",
            "site-20261125T210000Z-x.mcap",
        ];
        for name in others {
            std::fs::write(folder.path().join(name), vec![0; 1_000_000]).unwrap();
        }
        let old: Vec<PathBuf> = [0, 1, 2, 3].map(|k| files.named(at(k * 60))).into();
        for path in &old {
            std::fs::write(path, vec![0; 1_000_000]).unwrap();
        }
        drop(files.create(&Source::default()).unwrap());
        // Each call removes one.
        for left in [3, 2, 2] {
            assert_eq!(files.make_room(), Room::Pictures);
            assert_eq!(old.iter().filter(|path| path.exists()).count(), left);
        }
        let stays: Vec<bool> = old.iter().map(|path| path.exists()).collect();
        assert_eq!(stays, [false, false, true, true]);
        assert!(
            others.iter().all(|name| folder.path().join(name).exists()) && files.path().exists()
        );
    }

    #[test]
    fn files_of_one_second_have_names_of_their_own_and_are_the_recorders() {
        let folder = tempfile::tempdir().unwrap();
        let mut files =
            RecordFiles::new(&folder.path().join("a.mcap"), false, limits(None)).unwrap();
        for _ in 0..3 {
            drop(files.create(&Source::default()).unwrap());
        }
        assert_eq!(files.older.len(), 2);
        assert!(!files.is_full());
        std::fs::write(files.path(), vec![0; 1_000_000]).unwrap();
        assert!(files.is_full());
    }

    #[test]
    fn a_disk_that_fills_loses_pictures_first_and_bearings_last() {
        for (free, room) in [(2.0, Room::Pictures), (0.9, Room::Messages), (0.05, Room::Tracks)] {
            assert_eq!(Room::of(free, 1.0), room);
        }
        assert!(room_for(&Channel::Preview("a".parse().unwrap())) == Room::Pictures);
        for of_all in [Channel::FusionHealth, Channel::Truth, Channel::Smoothed, Channel::Cues] {
            assert_eq!(room_for(&of_all), Room::Messages);
        }
        let name: CameraName = "a".parse().unwrap();
        for last in [
            Channel::Bearings(name.clone()),
            Channel::Calibration(name),
            Channel::Tracks,
            Channel::Events,
            Channel::RecorderHealth,
        ] {
            assert_eq!(room_for(&last), Room::Tracks);
        }
    }

    /// Where removal frees no space, as with snapshots, ten recordings are removed and no more.
    #[test]
    fn recordings_do_not_go_for_nothing() {
        let folder = tempfile::tempdir().unwrap();
        // More than any disk has, so no removal suffices.
        let endless = Limits { leave_free_gb: 1e12, ..limits(None) };
        for k in 0..30 {
            let files = RecordFiles::new(&folder.path().join("a.mcap"), false, endless).unwrap();
            // Sparse files: they have a large size, but occupy nothing.
            File::create(files.named(at(k))).unwrap().set_len(1 << 40).unwrap();
        }
        let mut files = RecordFiles::new(&folder.path().join("a.mcap"), false, endless).unwrap();
        drop(files.create(&Source::default()).unwrap());
        let rooms: Vec<Room> = (0..40).map(|_| files.make_room()).collect();
        assert_eq!(rooms.last(), Some(&Room::Tracks));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 31 - 10);
    }

    /// The clock was set back during the run: the newest recording must not count as the oldest.
    #[test]
    fn what_this_run_has_recorded_is_younger_than_what_was_there_before() {
        let folder = tempfile::tempdir().unwrap();
        let asked = folder.path().join("a.mcap");
        let mut files = RecordFiles::new(&asked, false, limits(Some(1e-9))).unwrap();
        let later = files.named(OffsetDateTime::now_utc() + time::Duration::days(9000));
        std::fs::write(&later, vec![0; 10]).unwrap();
        drop(files.create(&Source::default()).unwrap());
        let first = files.path().to_owned();
        drop(files.create(&Source::default()).unwrap());
        files.make_room();
        assert!(!later.exists() && first.exists() && files.path().exists());
    }

    #[test]
    fn what_another_recorder_writes_is_left_to_it_and_what_is_taken_away_is_begun_anew() {
        let folder = tempfile::tempdir().unwrap();
        let asked = folder.path().join("a.mcap");
        let mut one = RecordFiles::new(&asked, false, limits(Some(1e-9))).unwrap();
        drop(one.create(&Source::default()).unwrap());
        let mut other = RecordFiles::new(&asked, false, limits(Some(1e-9))).unwrap();
        drop(other.create(&Source::default()).unwrap());
        for _ in 0..3 {
            let _ = other.make_room();
        }
        assert!(one.path().exists() && !one.is_full());
        std::fs::remove_file(one.path()).unwrap();
        assert!(one.is_full());
    }

    #[test]
    fn limits_that_do_not_go_together_are_refused() {
        let alone = Limits { rotate_mb: None, ..limits(Some(1.0)) };
        assert!(RecordFiles::new(Path::new("a.mcap"), false, alone).is_err());
        assert!(RecordFiles::new(Path::new("a.mcap"), true, limits(None)).is_err());
    }
}
