mod board;
mod page;
mod plan;

use std::io::{IsTerminal, stdout};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use crossfix_message::{Key, SiteName};
use crossfix_transport::{Link, NetworkConfig, Role};

use self::board::Board;
use self::page::{Page, PageEvent};
use self::plan::PlanBoard;
use crate::commands::examples;
use crate::config;
use crate::network;
use crate::output;
use crate::shutdown::{LEAVE, Shutdown};

/// Interval at which the screen is redrawn. Health comes as often: with half of it most is drawn
/// twice.
const PERIOD: Duration = Duration::from_secs(1);
/// Time after which every component has been heard: a second to connect, and one between messages.
/// With half of it those whose message was about to come would not be heard.
const HEARD_AFTER: Duration = Duration::from_secs(3);
/// How long it waits for a message before it checks whether to draw or to stop. With twice as much
/// both may come a tenth of a second late.
const POLL: Duration = Duration::from_millis(50);
/// Escape sequence that moves to the upper left corner and clears the screen.
const CLEARED: &str = "\x1b[H\x1b[2J";

/// How a site does, on one screen: agents, rates, latencies, clocks, tracks, and what is wrong.
///
/// On a terminal until Ctrl-C; else, or with --once or --json, what is heard in three seconds.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix status -c configs/site/network.toml",
    "crossfix status -c configs/site/network.toml --page 127.0.0.1:8080",
]))]
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
    /// Serve a page instead, with a plan of the site, its tracks and what has happened, e.g.
    /// 127.0.0.1:8080. Whoever reaches the address can see it.
    #[arg(long, value_name = "ADDRESS", conflicts_with_all = ["once", "json"])]
    page: Option<SocketAddr>,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_stdin(args.stop_with_stdin);
    let network = config::load_network(&args.config)?;
    let Some(link) = network::open(&network, &Role::Observer, &shutdown)? else {
        return Ok(());
    };
    if let Some(address) = args.page {
        serve(&link, &network, address, &shutdown)?;
        return Ok(link.close(LEAVE)?);
    }
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

/// The key expressions of all components' health.
fn health_of_all(site: &SiteName) -> [String; 2] {
    // The keys of a single fusion centre and of the recorder match the same expression as the
    // cameras'.
    [Key::of_all_cameras, Key::of_all_areas].map(|of_all| of_all(site, "health"))
}

/// Receives a site's messages until asked to stop, or until enough has been heard; `draw` is called
/// each second and returns whether to go on for longer than that.
fn watch(
    link: &Link,
    network: &NetworkConfig,
    shutdown: &Shutdown,
    mut draw: impl FnMut(&Board) -> bool,
) -> anyhow::Result<Board> {
    let tracks = Key::of_all_centres(link.site(), "tracks");
    let health = health_of_all(link.site());
    let subscription = link.subscribe(&[health.as_slice(), &[tracks]].concat())?;
    let mut board = Board::new(network);
    let begun = Instant::now();
    let mut drawn = begun;
    while !shutdown.requested() {
        if let Some(received) = subscription.next(POLL) {
            board.take(&received.key, &received.data, received.at);
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

/// Serves the web page until asked to stop.
fn serve(
    link: &Link,
    network: &NetworkConfig,
    address: SocketAddr,
    shutdown: &Shutdown,
) -> anyhow::Result<()> {
    let page = Page::serve(address)?;
    if !address.ip().is_loopback() {
        tracing::warn!("whoever reaches {address} can look on: the page has no certificates");
    }
    let site = link.site();
    let calibrations = Key::of_all_cameras(site, "calibration");
    let of_centres = ["tracks", "events"].map(|kind| Key::of_all_centres(site, kind));
    let expressions = [health_of_all(site).as_slice(), &of_centres, &[calibrations]].concat();
    let subscription = link.subscribe(&expressions)?;
    output::line(format!("site `{site}`: http://{address}/"));
    let cameras: Vec<_> = network.cameras.keys().cloned().collect();
    let mut board = Board::new(network);
    let mut plan = PlanBoard::new(cameras);
    let mut shown_at = Instant::now();
    while !shutdown.requested() {
        if let Some(received) = subscription.next(POLL) {
            board.take(&received.key, &received.data, received.at);
            plan.take(&received.key.channel, &received.data, received.at);
        }
        if shown_at.elapsed() >= page::PERIOD {
            shown_at = Instant::now();
            page.show(&PageEvent { status: board.status(shown_at), plan: plan.plan(shown_at) })?;
        }
    }
    Ok(())
}
