//! The one command of Crossfix.

mod centre;
mod commands;
mod config;
mod eye;
mod import;
mod logging;
mod lookout;
mod network;
mod output;
mod pace;
mod recorded;
mod repeats;
mod scenario;
mod shutdown;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::commands::{
    agent, check, demo, evaluate, export, fuse, import as import_command, info, plan, record, replay,
    simulate, track, validate, view,
};

/// Where in the air a small thing is, with nothing but cameras.
///
/// Agents on camera hosts follow small targets and publish bearings; a fusion centre turns the
/// bearings of three and more cameras into 3D tracks. Start with `crossfix demo`.
#[derive(Debug, Parser)]
#[command(name = "crossfix", version, propagate_version = true)]
struct Cli {
    #[command(flatten)]
    logging: logging::LoggingArgs,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::Args),
    Agent(agent::Args),
    Track(track::Args),
    Fuse(fuse::Args),
    Record(record::Args),
    Replay(replay::Args),
    View(view::Args),
    Info(info::Args),
    Simulate(simulate::Args),
    Import(import_command::Args),
    Export(export::Args),
    Evaluate(evaluate::Args),
    Check(check::Args),
    Plan(plan::Args),
    Validate(validate::Args),
}

fn run(cli: Cli) -> anyhow::Result<()> {
    match cli.command {
        Command::Demo(args) => demo::run(&args),
        Command::Agent(args) => agent::run(&args),
        Command::Track(args) => track::run(&args),
        Command::Fuse(args) => fuse::run(&args),
        Command::Record(args) => record::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::View(args) => view::run(&args),
        Command::Info(args) => info::run(&args),
        Command::Simulate(args) => simulate::run(&args),
        Command::Import(args) => import_command::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Check(args) => check::run(&args),
        Command::Plan(args) => plan::run(&args),
        Command::Validate(args) => validate::run(&args),
    }
}

fn main() -> ExitCode {
    // Misuse ends in clap, with exit code 2.
    let cli = Cli::parse();
    logging::start(&cli.logging);
    match shutdown::supervise(move || run(cli)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            output::error(&error);
            ExitCode::FAILURE
        }
    }
}
