//! What has been written, put onto the disk itself.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{SyncSender, sync_channel};

/// Puts what has been written onto the disk itself, so that a power cut takes no more than a second
/// or two. A slow disk holds up its thread alone.
#[derive(Debug)]
pub struct Syncing {
    files: SyncSender<PathBuf>,
}

impl Syncing {
    /// Begins a thread that waits for files.
    ///
    /// # Errors
    /// If the system has no threads left.
    pub fn start() -> std::io::Result<Self> {
        let (files, written) = sync_channel::<PathBuf>(1);
        std::thread::Builder::new().name("syncing".to_owned()).spawn(move || {
            for path in written {
                // What cannot be synced is seen where it is written.
                let _ = File::open(path).and_then(|file| file.sync_data());
            }
        })?;
        Ok(Self { files })
    }

    /// Asks for what has been written to a file; not if the last one is still under way. A pipe has
    /// no disk.
    pub fn ask(&self, path: &Path) {
        if path.is_file() {
            let _ = self.files.try_send(path.to_owned());
        }
    }
}
