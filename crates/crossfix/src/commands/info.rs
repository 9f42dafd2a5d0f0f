use std::path::PathBuf;

use crossfix_recording::RecordingInfo;

use crate::output;

/// Say what a recording holds: channels, messages, times, damage.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  crossfix info recordings/two-uavs.mcap --json")]
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
        return output::json(&info);
    }
    let head = ["channel", "messages", "bytes", "first [s]", "last [s]", "schema"].map(str::to_owned);
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
        output::line(format!("{} messages on topics that are not Crossfix's", info.foreign));
    }
    match &info.damage {
        Some(damage) => output::line(format!("torn: {damage}; all of the above is readable")),
        None => output::line("complete"),
    }
    Ok(())
}
