use std::collections::BTreeMap;

use mcap::records::Metadata;
use serde::Serialize;

/// The name of the metadata record that says who wrote the file.
const NAME: &str = "crossfix";

/// Who wrote a recording.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Source {
    /// The command, e.g. `record`.
    pub command: String,
    /// The version of Crossfix.
    pub version: String,
    /// The identity of the command's run, as in its health messages; empty offline.
    pub run: String,
    /// The host that it ran on, and its process id.
    pub host: String,
}

impl Source {
    /// A command of this build without a run, as one that is not on a network.
    pub fn of(command: &str) -> Self {
        Self {
            command: command.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            ..Self::default()
        }
    }

    pub(crate) fn write(&self) -> Metadata {
        let Self { command, version, run, host } = self.clone();
        let fields = [("command", command), ("version", version), ("run", run), ("host", host)];
        let metadata: BTreeMap<String, String> =
            fields.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
        Metadata { name: NAME.to_owned(), metadata }
    }

    pub(crate) fn read(record: &Texts) -> Option<Self> {
        let field = |name: &str| record.pairs.get(name).cloned().unwrap_or_default();
        (record.name == NAME).then(|| Self {
            command: field("command"),
            version: field("version"),
            run: field("run"),
            host: field("host"),
        })
    }
}

/// A metadata record, parsed without trusting the lengths that it states: the library would reserve
/// gigabytes for a damaged one.
#[derive(Debug)]
pub(crate) struct Texts {
    pub(crate) name: String,
    pub(crate) pairs: BTreeMap<String, String>,
}

impl Texts {
    pub(crate) fn read(mut body: &[u8]) -> Option<Self> {
        let name = text(&mut body)?;
        let mut inside = bytes(&mut body)?;
        let mut pairs = BTreeMap::new();
        while !inside.is_empty() {
            pairs.insert(text(&mut inside)?, text(&mut inside)?);
        }
        Some(Self { name, pairs })
    }
}

/// Length-prefixed bytes.
fn bytes<'a>(rest: &mut &'a [u8]) -> Option<&'a [u8]> {
    let (length, after) = rest.split_first_chunk::<4>()?;
    let (bytes, after) = after.split_at_checked(u32::from_le_bytes(*length) as usize)?;
    *rest = after;
    Some(bytes)
}

/// Id and topic of a channel record, likewise parsed without trusting its lengths.
pub(crate) fn channel(body: &[u8]) -> Option<(u16, String)> {
    let (id, rest) = body.split_first_chunk::<2>()?;
    // Skips the schema's id.
    let mut rest = rest.get(2..)?;
    Some((u16::from_le_bytes(*id), text(&mut rest)?))
}

fn text(rest: &mut &[u8]) -> Option<String> {
    String::from_utf8(bytes(rest)?.to_vec()).ok()
}
