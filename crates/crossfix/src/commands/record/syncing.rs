//! Syncing of written files to the disk itself.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, channel, sync_channel};
use std::time::Duration;

/// Syncs written data to the disk itself, so that a power cut loses no more than a second or two. A
/// slow disk delays only this thread.
#[derive(Debug)]
pub struct Syncing {
    files: SyncSender<PathBuf>,
    done: Receiver<io::Result<()>>,
    /// Completed files that wait to be synced.
    ended: Vec<PathBuf>,
}

impl Syncing {
    /// Starts a thread that syncs files.
    ///
    /// # Errors
    /// If the system cannot start another thread.
    pub fn start() -> io::Result<Self> {
        let (files, written) = sync_channel::<PathBuf>(1);
        let (says, done) = channel();
        std::thread::Builder::new().name("syncing".to_owned()).spawn(move || {
            for path in written {
                // A file that has been removed meanwhile needs no syncing.
                let file = File::open(path).ok();
                let synced = file.map_or(Ok(()), |file| file.sync_data());
                if says.send(synced).is_err() {
                    return;
                }
            }
        })?;
        Ok(Self { files, done, ended: Vec::new() })
    }

    /// Requests syncing of a file; skipped if the last request is still in progress. A pipe is not
    /// synced.
    ///
    /// # Errors
    /// Errors of earlier requests: what was written is not on the disk.
    pub fn ask(&mut self, path: &Path) -> io::Result<()> {
        // Completed files come first, as nobody requests them again.
        while let Some(ended) = self.ended.pop() {
            if let Err(TrySendError::Full(ended)) = self.files.try_send(ended) {
                self.ended.push(ended);
                break;
            }
        }
        if path.is_file() && self.ended.is_empty() {
            let _ = self.files.try_send(path.to_owned());
        }
        self.done.try_iter().collect()
    }

    /// Notes a completed file, to be synced as soon as possible.
    pub fn end(&mut self, path: PathBuf) {
        self.ended.push(path);
    }

    /// Waits up to `patience` until the last file is on the disk.
    ///
    /// # Errors
    /// The disk's error, if there was one.
    pub fn finish(mut self, path: &Path, patience: Duration) -> io::Result<()> {
        if path.is_file() {
            self.end(path.to_owned());
        }
        let mut all = Ok(());
        let until = std::time::Instant::now() + patience;
        while all.is_ok() && !self.ended.is_empty() && std::time::Instant::now() < until {
            all = self.ask(Path::new(""));
            std::thread::sleep(Duration::from_millis(5));
        }
        drop(self.files);
        let left = until.saturating_duration_since(std::time::Instant::now());
        all.and(self.done.recv_timeout(left).unwrap_or(Ok(())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_that_has_ended_is_synced_and_a_pipe_is_not_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let paths: Vec<PathBuf> = (0..5).map(|k| folder.path().join(format!("{k}"))).collect();
        paths.iter().for_each(|path| std::fs::write(path, "x").unwrap());
        let mut syncing = Syncing::start().unwrap();
        paths[..4].iter().for_each(|path| syncing.end(path.clone()));
        syncing.ask(&paths[4]).unwrap();
        syncing.ask(Path::new("/dev/null")).unwrap();
        syncing.finish(&paths[4], Duration::from_secs(20)).unwrap();
    }
}
