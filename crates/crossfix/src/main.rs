//! The one command of Crossfix.

mod commands;
mod config;
mod eye;
mod import;
mod logging;
mod output;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::commands::{evaluate, export, import as import_command, info, replay, track};

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
    Track(track::Args),
    Replay(replay::Args),
    Info(info::Args),
    Import(import_command::Args),
    Export(export::Args),
    Evaluate(evaluate::Args),
}

fn run(cli: Cli) -> anyhow::Result<()> {
    match cli.command {
        Command::Track(args) => track::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::Info(args) => info::run(&args),
        Command::Import(args) => import_command::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
    }
}

fn main() -> ExitCode {
    // Misuse ends in clap, with exit code 2.
    let cli = Cli::parse();
    logging::start(&cli.logging);
    match run(cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            output::error(&error);
            ExitCode::FAILURE
        }
    }
}
