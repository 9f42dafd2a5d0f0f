use std::convert::Infallible;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use crossfix_outlet::foxglove::{FoxgloveView, PictureExport};
use crossfix_recording::{
    Entry, ReadReport, RecordingInfo, RecordingReader, RecordingWriter, Source,
};

use super::record::foxglove;
use crate::commands::examples;
use crate::output::{self, Draft};
use crate::recorded::Lacks;

/// Make a whole recording of a torn or damaged one: all of Crossfix's that can be read of it, with
/// an index. What was written is read back before it gets its name.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix recover torn.mcap -o whole.mcap",
]))]
pub struct Args {
    /// The recording (MCAP) that is torn or damaged.
    recording: PathBuf,
    /// The recording (MCAP) to write.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

/// Summary of what was read, for comparison: the number of messages, and a hash over all in their
/// order.
#[derive(Debug, Default, PartialEq, Eq)]
struct Tally {
    messages: u64,
    all: u64,
}

impl Tally {
    fn see(&mut self, entry: &Entry) {
        let Entry { key, data_time, arrival, data } = entry;
        let mut hasher = DefaultHasher::new();
        (self.all, key, data_time.nanos(), arrival.nanos(), data).hash(&mut hasher);
        (self.messages, self.all) = (self.messages + 1, hasher.finish());
    }

    /// Tally of a complete file.
    fn of(path: &Path) -> anyhow::Result<(Self, ReadReport)> {
        let mut tally = Self::default();
        let report = RecordingReader::open(path)?.for_each(|entry| {
            tally.see(&entry);
            Ok::<_, Infallible>(())
        })?;
        Ok((tally, report))
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let draft = Draft::new(&args.output, &[&args.recording])?;
    ensure!(
        !args.output.exists() || args.output.is_file(),
        "{} cannot be read back",
        args.output.display()
    );
    let (tally, read) = rewrite(&args.recording, draft.path())?;
    let lacks = Lacks { damage: read.damage, ..Lacks::default() };
    lacks.ensure_found(tally.messages > 0, "message of Crossfix", &args.recording)?;
    let (read_back, report) = Tally::of(draft.path()).context("what was written cannot be read")?;
    ensure!(
        read_back == tally && report.damage.is_none(),
        "what was written is not what was read: {} of {} messages; nothing is kept",
        read_back.messages,
        tally.messages
    );
    draft.keep()?;
    let mut lost =
        lacks.damage.map_or("it was whole".to_owned(), |damage| format!("damaged {damage}"));
    if read.foreign > 0 {
        lost = format!(
            "{lost}; {} messages in other schemas were left out, and Foxglove's made anew (with \
             places on Earth by `export --foxglove --anchor`)",
            read.foreign
        );
    }
    output::line(format!(
        "{} messages recovered to {}, and read back; {lost}",
        tally.messages,
        args.output.display()
    ));
    Ok(())
}

/// Writes what can be read of a recording, and the source it states, to a new file.
fn rewrite(from: &Path, to: &Path) -> anyhow::Result<(Tally, ReadReport)> {
    let info = RecordingInfo::of(from)?;
    let has_beside = info.foreign > 0;
    let Source { command, run, host, .. } = info.source.unwrap_or_default();
    let own = Source::of("recover");
    let command = format!("{} of {command}", own.command);
    let mut writer = RecordingWriter::create(to)?;
    writer.sign(&Source { command, run, host, ..own })?;
    let mut tally = Tally::default();
    let mut view: Option<FoxgloveView> = None;
    let report = RecordingReader::open(from)?.for_each(|entry| {
        tally.see(&entry);
        writer.write(&entry)?;
        if !has_beside {
            return Ok(());
        }
        let site = &entry.key.site;
        let view = view.get_or_insert_with(|| FoxgloveView::new(site, None, PictureExport::Said));
        foxglove::write(&mut writer, view, &entry)
    })?;
    writer.finish()?;
    Ok((tally, report))
}
