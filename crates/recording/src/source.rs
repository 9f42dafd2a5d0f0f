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
    /// The run of the command, as its health says it; empty offline.
    pub run: String,
    /// The host that it ran on, and the number of its process.
    pub host: String,
}

impl Source {
    pub(crate) fn write(&self) -> Metadata {
        let Self { command, version, run, host } = self.clone();
        let fields = [("command", command), ("version", version), ("run", run), ("host", host)];
        let metadata: BTreeMap<String, String> =
            fields.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
        Metadata { name: NAME.to_owned(), metadata }
    }

    pub(crate) fn read(metadata: &Metadata) -> Option<Self> {
        let field = |name: &str| metadata.metadata.get(name).cloned().unwrap_or_default();
        (metadata.name == NAME).then(|| Self {
            command: field("command"),
            version: field("version"),
            run: field("run"),
            host: field("host"),
        })
    }
}
