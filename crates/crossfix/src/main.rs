//! The one command of Crossfix.
#![cfg_attr(
    not(all(feature = "centre", feature = "viewer")),
    allow(
        dead_code,
        unused_imports,
        reason = "what only a part uses that this build leaves out is left in"
    )
)]

mod calibrated;
#[cfg(feature = "centre")]
mod centre;
mod commands;
mod config;
mod eye;
mod health;
mod host;
mod http;
#[cfg(feature = "centre")]
mod import;
mod logging;
mod lookout;
mod metrics;
mod network;
#[cfg(feature = "onvif")]
mod onvif;
mod output;
mod overwriting;
mod pace;
mod parts;
#[cfg(feature = "centre")]
mod planned;
#[cfg(feature = "centre")]
mod pose_watch;
#[cfg(feature = "centre")]
mod recalibration;
mod recorded;
mod repeats;
#[cfg(feature = "centre")]
mod scenario;
mod seeker;
mod service;
mod shutdown;

use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser};

use crate::commands::Command;

/// Where in the air a small thing is, with nothing but cameras.
///
/// Agents on camera hosts follow small targets and publish bearings; a fusion centre turns the
/// bearings of three and more cameras into 3D tracks.
#[derive(Debug, Parser)]
#[command(
    name = "crossfix",
    version,
    propagate_version = true,
    max_term_width = 100,
    after_help = parts::closing_words()
)]
struct Cli {
    #[command(flatten)]
    logging: logging::LoggingArgs,
    #[command(subcommand)]
    command: Command,
}

fn main() -> ExitCode {
    network::give_zenoh_threads();
    // clap handles wrong arguments itself, with exit code 2; contradictions that it cannot see end
    // with 2, too.
    let command = takes_negative_numbers(Cli::command());
    let matches = command.clone().get_matches();
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    logging::start(&cli.logging);
    let run = move || {
        overwriting::check(&command, &matches)?;
        cli.command.run()
    };
    match shutdown::supervise(run).and_then(|()| output::ensure_written()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            output::error(&error);
            if error.is::<output::Misuse>() { ExitCode::from(2) } else { ExitCode::FAILURE }
        }
    }
}

/// The command with options that take negative numbers: one that makes no sense is refused with its
/// range, and not read as an option.
fn takes_negative_numbers(command: clap::Command) -> clap::Command {
    let options = command.mut_args(|argument| {
        let takes = argument.get_action().takes_values() && !argument.is_positional();
        if takes { argument.allow_negative_numbers(true) } else { argument }
    });
    options.mut_subcommands(takes_negative_numbers)
}
