//! Reading recordings, and reporting what is missing in them.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::ensure;
use crossfix_message::{DecodeError, Payload, decode};
use crossfix_recording::{Damage, Entry, ReadFailure, RecordingReader};
use serde::Serialize;

use crate::shutdown::Shutdown;

/// What could not be read from a recording.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Lacks {
    /// Parts of the file that cannot be read.
    pub damage: Option<Damage>,
    /// Number of wanted messages that could not be read.
    pub unreadable: u64,
    /// Why the first of them could not be read.
    pub first_unreadable: Option<String>,
    /// Topics whose messages are left out: they begin as ours, but a name in them is not possible.
    #[serde(skip_serializing_if = "BTreeSet::is_empty")]
    pub misnamed: BTreeSet<String>,
}

/// What is wrong with a topic that begins as ours.
pub const NO_NAME: &str = "a name of a site or camera has letters, digits, `-` and `_`";

impl Lacks {
    /// Decodes a message, or counts that it cannot be read.
    pub fn read<M: Payload>(&mut self, data: &[u8]) -> Option<M> {
        match decode(data) {
            Ok(message) => Some(message),
            Err(error) => {
                self.note(&error);
                None
            }
        }
    }

    /// Counts a message that cannot be read.
    pub fn note(&mut self, error: &DecodeError) {
        self.unreadable += 1;
        self.first_unreadable.get_or_insert_with(|| error.to_string());
    }

    /// Logs a warning of what is missing.
    pub fn say(&self, path: &Path) {
        if let Some(damage) = &self.damage {
            tracing::warn!("{} is damaged {damage}; everything else was read", path.display());
        }
        for topic in &self.misnamed {
            tracing::warn!("{}: `{topic}` is left out: {NO_NAME}", path.display());
        }
        if let Some(first) = &self.first_unreadable {
            tracing::warn!(
                "{} messages of {} cannot be read: {first}",
                self.unreadable,
                path.display()
            );
        }
    }

    /// An error that says what was not found and the likely reason, unless it was found.
    pub fn ensure_found(&self, found: bool, what: &str, path: &Path) -> anyhow::Result<()> {
        let why = match (&self.first_unreadable, &self.damage) {
            (Some(first), _) => format!(": {} messages cannot be read ({first})", self.unreadable),
            (None, Some(damage)) => format!(": it is damaged {damage}"),
            (None, None) => String::new(),
        };
        ensure!(found, "{} holds no {what}{why}", path.display());
        Ok(())
    }
}

/// Refuses a recording of whose messages none can be read, and says how many cannot.
pub fn ensure_readable(path: &Path, messages: u64, newer: u64) -> anyhow::Result<()> {
    let path = path.display();
    ensure!(
        newer == 0 || newer < messages,
        "none of {messages} messages of {path} can be read: they are of a newer version"
    );
    if newer > 0 {
        tracing::warn!("{newer} of {messages} messages of {path} are of a newer version");
    }
    Ok(())
}

/// Passes every message of a recording to `handle`, and adds damage to `lacks`.
pub fn for_each(
    path: &Path,
    lacks: &mut Lacks,
    mut handle: impl FnMut(&mut Lacks, Entry) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let report = RecordingReader::open(path)?
        .for_each(|entry| handle(lacks, entry).map_err(|error| Handled(error.into())));
    match report {
        Ok(report) => {
            (lacks.damage, lacks.misnamed) = (report.damage, report.misnamed);
            Ok(())
        }
        Err(ReadFailure::Recording(error)) => Err(error.into()),
        Err(ReadFailure::Handler(Handled(error))) => Err(anyhow::Error::from_boxed(error)),
    }
}

/// Passes the messages of a recording to `handle` until the program is asked to stop, which ends
/// the reading of a long file early.
pub fn for_each_until(
    path: &Path,
    lacks: &mut Lacks,
    shutdown: &Shutdown,
    mut handle: impl FnMut(&mut Lacks, Entry) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let mut is_stopped = false;
    let read = for_each(path, lacks, |lacks, entry| {
        is_stopped = shutdown.requested();
        anyhow::ensure!(!is_stopped, SearchOver);
        handle(lacks, entry)
    });
    if is_stopped { Ok(()) } else { read }
}

/// The first answer that is not `None`, over the messages of a recording.
pub fn find<T>(
    path: &Path,
    mut answer: impl FnMut(Entry) -> Option<T>,
) -> anyhow::Result<Option<T>> {
    let mut found = None;
    let read = RecordingReader::open(path)?.for_each(|entry| {
        found = answer(entry);
        if found.is_some() { Err(SearchOver) } else { Ok(()) }
    });
    match read {
        Ok(_) | Err(ReadFailure::Handler(SearchOver)) => Ok(found),
        Err(ReadFailure::Recording(error)) => Err(error.into()),
    }
}

/// Signals that the search is over, so the rest need not be read.
#[derive(Debug, thiserror::Error)]
#[error("the search is over")]
struct SearchOver;

/// An error of the handler's.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
struct Handled(Box<dyn std::error::Error + Send + Sync>);
