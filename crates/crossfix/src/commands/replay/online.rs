//! Onto the network, in the time of the recording or faster.

use std::path::Path;
use std::time::Duration;

use crossfix_message::{Channel, Key};
use crossfix_recording::{ReadFailure, RecordingReader};
use crossfix_transport::{Link, LinkError, Role};

use super::{Args, Range};
use crate::config;
use crate::output;
use crate::pace::{Pace, wall_seconds};
use crate::shutdown::Shutdown;

/// Time for those who listen to connect before the first message, s.
const RUN_UP_S: f64 = 2.0;

/// Whether the cameras would publish it.
fn is_cameras(channel: &Channel) -> bool {
    !matches!(channel, Channel::Tracks | Channel::Events | Channel::FusionHealth)
}

/// Publishes a range of a recording's bytes under the network's site.
pub fn publish(args: &Args, network: &Path, range: Range) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen();
    let network = config::load_network(network)?;
    let link = Link::open(&network, &Role::Cameras { and_fusion: args.tracks })?;
    tracing::info!("publishing as the cameras of `{}` in {RUN_UP_S} s", link.site());
    let mut published = 0_u64;
    loop {
        let pace = Pace { start: wall_seconds() + RUN_UP_S, speed: args.speed };
        // The run-up holds at any speed.
        if !(Pace { speed: 1.0, ..pace }).wait(0.0, &shutdown) {
            break;
        }
        let report = RecordingReader::open(&args.recording)?.for_each(|entry| {
            let wanted = range.holds(&entry) && (args.tracks || is_cameras(&entry.key.channel));
            if !wanted || shutdown.requested() {
                return Ok(());
            }
            let since = entry.data_time.seconds_since(range.from);
            if pace.wait(since, &shutdown) {
                // The same bytes, in the site that listens now.
                link.put(&Key::new(link.site().clone(), entry.key.channel), entry.data)?;
                published += 1;
            }
            Ok::<_, LinkError>(())
        });
        match report {
            Ok(report) => {
                if let Some(damage) = report.damage {
                    tracing::warn!(
                        "{} is torn: {damage}; everything before was played",
                        args.recording.display()
                    );
                }
            }
            Err(ReadFailure::Recording(error)) => return Err(error.into()),
            Err(ReadFailure::Handler(error)) => return Err(error.into()),
        }
        if !args.again || shutdown.requested() {
            break;
        }
    }
    // What was put last is on its way.
    std::thread::sleep(Duration::from_millis(200));
    link.close()?;
    output::line(format!("{published} messages published"));
    Ok(())
}
