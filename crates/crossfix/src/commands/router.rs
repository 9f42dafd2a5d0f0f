use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, ensure};
use crossfix_transport::{NetworkConfig, Role};

use crate::commands::examples;
use crate::config;
use crate::health::WatchedCertificate;
use crate::network;
use crate::output;
use crate::service;
use crate::shutdown::{LEAVE, Shutdown};

/// How often it is checked whether to stop. With twice as much a stop comes up to 0.4 s late.
const POLL: Duration = Duration::from_millis(200);

/// Run the Zenoh router of a site whose network has mode = "client".
///
/// It carries everybody's messages; with `[security]` it holds each component to what it may say.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix router -c configs/site/network.toml --listen tcp/127.0.0.1:7447",
]))]
pub struct Args {
    /// The network's file (TOML).
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Which of the network's `routers` this one is; it connects to the others. Not needed where
    /// there is one.
    #[arg(long, value_name = "ENDPOINT")]
    listen: Option<String>,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

/// Endpoint of the network's router that this process is.
fn own_endpoint(network: &NetworkConfig, asked: Option<&String>) -> anyhow::Result<String> {
    if let Some(asked) = asked {
        ensure!(
            network.routers.contains(asked),
            "`{asked}` is none of the network's routers ({}): nobody would connect to it",
            network.routers.join(", ")
        );
        return Ok(asked.clone());
    }
    ensure!(network.routers.len() < 2, "the network has several routers: say which by --listen");
    network.routers.first().cloned().context("the network has no `routers`: give it one")
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_reload().with_stdin(args.stop_with_stdin);
    let network = config::load_network(&args.config)?;
    let endpoint = own_endpoint(&network, args.listen.as_ref())?;
    let role = Role::Router { listen: vec![endpoint.clone()] };
    let Some(link) = network::open(&network, &role, &shutdown)? else {
        return Ok(());
    };
    tracing::info!("the router of `{}` is up at {endpoint}, run {}", link.site(), link.run());
    service::ready(&format!("routing at {endpoint}"));
    // A router publishes no health: its log says when its certificate needs renewal.
    let mut certificate = link.certificate().cloned().map(WatchedCertificate::new);
    while !shutdown.requested() {
        std::thread::sleep(POLL);
        certificate.as_mut().and_then(WatchedCertificate::problem);
        service::alive();
    }
    service::stopping();
    link.close(LEAVE)?;
    output::line("router: ended");
    Ok(())
}
