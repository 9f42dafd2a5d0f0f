use std::path::PathBuf;

use anyhow::ensure;
use crossfix_recording::{RecordingInfo, Source};

use crate::commands::examples;
use crate::output;
use crate::recorded::NO_NAME;

/// Say what a recording holds: channels, messages, times; and what it lacks: losses, damage.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix info recordings/two-uavs.mcap --json",
]))]
pub struct Args {
    /// The recording (MCAP).
    recording: PathBuf,
    /// Print JSON; times in ns since the Unix epoch.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let info = RecordingInfo::of(&args.recording)?;
    if args.json {
        output::json(&info)?;
    } else {
        print(&info);
    }
    let messages: u64 = info.channels.iter().map(|channel| channel.messages).sum();
    ensure!(messages > 0, "{} holds no message of Crossfix", args.recording.display());
    ensure!(
        messages > info.newer,
        "none of {messages} messages of {} can be read: they are of a newer version",
        args.recording.display()
    );
    Ok(())
}

fn print(info: &RecordingInfo) {
    let head =
        ["channel", "messages", "bytes", "first [s]", "last [s]", "schema"].map(str::to_owned);
    let mut rows = vec![head.to_vec()];
    rows.extend(info.channels.iter().map(|channel| {
        vec![
            channel.topic.clone(),
            channel.messages.to_string(),
            channel.bytes.to_string(),
            format!("{:.3}", channel.first.seconds()),
            format!("{:.3}", channel.last.seconds()),
            channel.schema.to_owned(),
        ]
    }));
    output::line(output::table(&rows));
    if info.foreign > 0 {
        output::line(format!("{} messages of others, such as Foxglove's", info.foreign));
    }
    for topic in &info.misnamed {
        output::line(format!("among them `{topic}`: {NO_NAME}"));
    }
    if info.newer > 0 {
        output::line(format!("{} messages are of a newer version: update this side", info.newer));
    }
    if let Some(source) = &info.source {
        let Source { command, version, run, host } = source;
        let run = if run.is_empty() { String::new() } else { format!(", run {run} on {host}") };
        output::line(format!("written by crossfix {version} {command}{run}"));
    }
    for (component, health) in &info.health {
        let counted = health.counters.iter().filter(|(name, _)| is_a_loss(name));
        let counted: Vec<String> = counted.map(|(name, value)| format!("{name} {value}")).collect();
        if !counted.is_empty() {
            output::line(format!("`{component}` counted {}", counted.join(", ")));
        }
        for problem in &health.problems {
            output::line(format!("`{component}` said at its last: {problem}"));
        }
    }
    match &info.damage {
        Some(damage) => output::line(format!("damaged {damage}; all of the above is readable")),
        None => output::line("complete"),
    }
}

/// Whether a component's counter counts messages that were lost or not used.
fn is_a_loss(counter: &str) -> bool {
    ["received_", "rejected_", "bad_", "unseen_"].iter().any(|kind| counter.starts_with(kind))
}
