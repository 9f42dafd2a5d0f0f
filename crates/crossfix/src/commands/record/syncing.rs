//! What has been written, put onto the disk itself.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, channel, sync_channel};
use std::time::Duration;

/// Puts what has been written onto the disk itself, so that a power cut takes no more than a second
/// or two. A slow disk holds up its thread alone.
#[derive(Debug)]
pub struct Syncing {
    files: SyncSender<PathBuf>,
    done: Receiver<io::Result<()>>,
    /// Files that have ended, and for which there was no place yet.
    ended: Vec<PathBuf>,
}

impl Syncing {
    /// Begins a thread that waits for files.
    ///
    /// # Errors
    /// If the system has no threads left.
    pub fn start() -> io::Result<Self> {
        let (files, written) = sync_channel::<PathBuf>(1);
        let (says, done) = channel();
        std::thread::Builder::new().name("syncing".to_owned()).spawn(move || {
            for path in written {
                // Taken away meanwhile, it needs no disk.
                let file = File::open(path).ok();
                let synced = file.map_or(Ok(()), |file| file.sync_data());
                if says.send(synced).is_err() {
                    return;
                }
            }
        })?;
        Ok(Self { files, done, ended: Vec::new() })
    }

    /// Asks for what has been written to a file; not if the last one is still under way. A pipe has
    /// no disk.
    ///
    /// # Errors
    /// What the disk said of those before: that what was written is not on it.
    pub fn ask(&mut self, path: &Path) -> io::Result<()> {
        // Those that have ended first: nobody asks for them again.
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

    /// A file has ended, and is to be asked for as soon as there is a place.
    pub fn end(&mut self, path: PathBuf) {
        self.ended.push(path);
    }

    /// Waits so long until a last file is on the disk.
    ///
    /// # Errors
    /// What the disk said of it.
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
