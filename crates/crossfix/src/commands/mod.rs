//! The subcommands, one thin module each.

use clap::Subcommand;

pub mod agent;
#[cfg(any(feature = "centre", feature = "viewer"))]
pub mod anchor;
pub mod check;
pub mod doctor;
pub mod info;
#[cfg(any(feature = "centre", feature = "viewer"))]
pub mod labels;
pub mod numbers;
pub mod record;
pub mod recover;
pub mod router;
pub mod sources;
pub mod status;
pub mod track;

#[cfg(feature = "centre")]
pub mod calibrate;
#[cfg(all(feature = "centre", feature = "viewer"))]
pub mod demo;
#[cfg(feature = "centre")]
pub mod enroll;
#[cfg(feature = "centre")]
pub mod evaluate;
#[cfg(feature = "centre")]
pub mod export;
#[cfg(feature = "centre")]
pub mod fuse;
#[cfg(feature = "centre")]
pub mod import;
#[cfg(feature = "centre")]
pub mod outlet;
#[cfg(feature = "centre")]
pub mod plan;
#[cfg(feature = "centre")]
pub mod replay;
#[cfg(feature = "centre")]
pub mod simulate;
#[cfg(feature = "centre")]
pub mod validate;
#[cfg(feature = "viewer")]
pub mod view;

/// The end of a command's help: how it is called. An example that goes on in another line must be
/// broken as a shell needs it, after a backslash.
fn examples(lines: &[&str]) -> String {
    let title = if lines.len() == 1 { "Example:" } else { "Examples:" };
    let lines = lines.iter().map(|line| format!("\n  {}", line.replace('\n', "\n      ")));
    title.to_owned() + &lines.collect::<String>()
}

/// All commands: a camera host's, and what the build's features add.
#[derive(Debug, Subcommand)]
pub enum Command {
    #[cfg(all(feature = "centre", feature = "viewer"))]
    Demo(demo::Args),
    Agent(agent::Args),
    Sources(sources::Args),
    Track(track::Args),
    Record(record::Args),
    Recover(recover::Args),
    Info(info::Args),
    Check(check::Args),
    Doctor(doctor::Args),
    Status(status::Args),
    Router(router::Args),
    #[cfg(feature = "viewer")]
    View(view::Args),
    #[cfg(feature = "centre")]
    #[command(flatten)]
    Centre(CentreCommand),
}

/// What the fusion centre does, and what evaluates or plans a site.
#[cfg(feature = "centre")]
#[derive(Debug, Subcommand)]
pub enum CentreCommand {
    Fuse(fuse::Args),
    Replay(replay::Args),
    Import(import::Args),
    Export(export::Args),
    Evaluate(evaluate::Args),
    Calibrate(calibrate::Args),
    Plan(plan::Args),
    Simulate(simulate::Args),
    Validate(validate::Args),
    Enroll(enroll::Args),
    Outlet(outlet::Args),
}

#[cfg(feature = "centre")]
impl CentreCommand {
    fn run(self) -> anyhow::Result<()> {
        match self {
            Self::Fuse(args) => fuse::run(&args),
            Self::Replay(args) => replay::run(&args),
            Self::Import(args) => import::run(&args),
            Self::Export(args) => export::run(&args),
            Self::Evaluate(args) => evaluate::run(&args),
            Self::Calibrate(args) => calibrate::run(&args),
            Self::Plan(args) => plan::run(&args),
            Self::Simulate(args) => simulate::run(&args),
            Self::Validate(args) => validate::run(&args),
            Self::Enroll(args) => enroll::run(&args),
            Self::Outlet(args) => outlet::run(&args),
        }
    }
}

impl Command {
    pub fn run(self) -> anyhow::Result<()> {
        match self {
            #[cfg(all(feature = "centre", feature = "viewer"))]
            Self::Demo(args) => demo::run(&args),
            Self::Agent(args) => agent::run(&args),
            Self::Sources(args) => sources::run(&args),
            Self::Track(args) => track::run(&args),
            Self::Record(args) => record::run(&args),
            Self::Recover(args) => recover::run(&args),
            Self::Info(args) => info::run(&args),
            Self::Check(args) => check::run(&args),
            Self::Doctor(args) => doctor::run(&args),
            Self::Status(args) => status::run(&args),
            Self::Router(args) => router::run(&args),
            #[cfg(feature = "viewer")]
            Self::View(args) => view::run(&args),
            #[cfg(feature = "centre")]
            Self::Centre(command) => command.run(),
        }
    }
}
