mod board;

use std::io::{IsTerminal, stdout};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use crossfix_message::{Channel, Key};
use crossfix_transport::{Link, NetworkConfig, Role};

use self::board::Board;
use crate::config;
use crate::network;
use crate::output;
use crate::shutdown::{LEAVE, Shutdown};

/// How often a screen is drawn anew.
const PERIOD: Duration = Duration::from_secs(1);
/// Each part says how it does every second, and is connected in another.
const HEARD_AFTER: Duration = Duration::from_secs(3);
const POLL: Duration = Duration::from_millis(50);
/// From the upper left corner on, the screen is empty.
const CLEARED: &str = "\x1b[H\x1b[2J";

/// How a site does, on one screen: agents, rates, latencies, clocks, tracks, and what is wrong.
///
/// On a terminal until Ctrl-C; else, or with --once or --json, what is heard in three seconds.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  crossfix status -c configs/site/network.toml")]
pub struct Args {
    /// The network's file (TOML).
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Say it once, on a terminal, too.
    #[arg(long)]
    once: bool,
    /// Print JSON, once.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen();
    let network = config::load_network(&args.config)?;
    let Some(link) = network::open(&network, &Role::Observer, &shutdown)? else {
        return Ok(());
    };
    let is_screen = stdout().is_terminal() && !args.once && !args.json;
    let board = watch(&link, &network, &shutdown, |board| {
        if is_screen {
            output::line(format!("{CLEARED}{}", board.status(Instant::now()).text()));
        }
        is_screen
    })?;
    link.close(LEAVE)?;
    let status = board.status(Instant::now());
    match (is_screen, args.json) {
        (true, _) => Ok(()),
        (false, true) => output::json(&status),
        (false, false) => {
            output::line(status.text());
            Ok(())
        }
    }
}

/// Hears a site until it is asked to stop, or has heard enough; `draw` says each second whether it
/// wants more than that.
fn watch(
    link: &Link,
    network: &NetworkConfig,
    shutdown: &Shutdown,
    mut draw: impl FnMut(&Board) -> bool,
) -> anyhow::Result<Board> {
    // That of the fusion centre and the recorder, too.
    let health = Key::of_all_cameras(link.site(), "health");
    let tracks = Key::new(link.site().clone(), Channel::Tracks).to_string();
    let subscription = link.subscribe(&[health, tracks])?;
    let mut board = Board::new(link.site().to_string(), network.cameras.keys().cloned().collect());
    let begun = Instant::now();
    let mut drawn = begun;
    while !shutdown.requested() {
        if let Some(received) = subscription.next(POLL) {
            board.hear(&received.key.channel, &received.data, received.at);
        }
        if drawn.elapsed() >= PERIOD {
            drawn = Instant::now();
            if !draw(&board) && begun.elapsed() >= HEARD_AFTER {
                break;
            }
        }
    }
    Ok(board)
}
