//! Logs go to stderr; results go to stdout.

use std::io::{IsTerminal, Stderr};

use clap::{Args, ValueEnum};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::{Directive, LevelFilter};
use tracing_subscriber::fmt::SubscriberBuilder;
use tracing_subscriber::fmt::format::{DefaultFields, Format};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// Form of the logs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
}

/// The options that every command has.
#[derive(Debug, Args)]
pub struct LoggingArgs {
    /// More logs on stderr: -v details, -vv everything.
    #[arg(short, long, global = true, help_heading = "Logs", action = clap::ArgAction::Count)]
    verbose: u8,
    /// Fewer logs: errors only.
    #[arg(short, long, global = true, help_heading = "Logs", conflicts_with = "verbose")]
    quiet: bool,
    /// Form of the logs on stderr.
    #[arg(
        long,
        global = true,
        help_heading = "Logs",
        value_enum,
        default_value_t,
        value_name = "FORMAT"
    )]
    log_format: LogFormat,
}

/// Starts logging for the process. `RUST_LOG` overrides the options.
pub fn start(args: &LoggingArgs) {
    let level = match (args.quiet, args.verbose) {
        (true, _) => "error",
        (_, 0) => "warn,crossfix=info",
        (_, 1) => "info,crossfix=debug",
        _ => "debug",
    };
    // Zenoh warns about what is configured on purpose (no gossip) and about peers that are not up
    // yet.
    let filter = format!("{level},zenoh=error,zenoh_transport=error,zenoh_link_tcp=error");
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(filter));
    // What the stream reader (retina) warns of in cameras that break the standard is in its errors
    // already, and its detailed logs may contain login data; so it stays at `error` whatever level
    // is asked for.
    let quiet = Directive::from(LevelFilter::ERROR);
    let filter = filter.add_directive("retina=error".parse().unwrap_or(quiet));
    match (args.log_format, journal()) {
        (LogFormat::Text, Some(journal)) => {
            tracing_subscriber::registry().with(journal).with(filter).init();
        }
        (LogFormat::Text, None) => to_stderr(filter).with_target(false).init(),
        (LogFormat::Json, _) => to_stderr(filter).json().init(),
    }
}

fn to_stderr(
    filter: EnvFilter,
) -> SubscriberBuilder<DefaultFields, Format, EnvFilter, fn() -> Stderr> {
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr)
}

/// The system's journal, if stderr goes there: log lines then carry their level and code location
/// as fields (`journalctl -p warning -t crossfix`).
#[cfg(target_os = "linux")]
fn journal() -> Option<tracing_journald::Layer> {
    use std::os::fd::AsFd;
    use std::os::linux::fs::MetadataExt;

    // systemd says which socket is the journal's (systemd.exec(5), `JOURNAL_STREAM`); stderr may
    // have been redirected since, so the two are compared.
    let said = std::env::var("JOURNAL_STREAM").ok()?;
    let stderr = std::io::stderr().as_fd().try_clone_to_owned().ok()?;
    let stderr = std::fs::File::from(stderr).metadata().ok()?;
    let is_stderr = said == format!("{}:{}", stderr.st_dev(), stderr.st_ino());
    let layer = is_stderr.then(tracing_journald::layer)?.ok()?;
    Some(layer.with_syslog_identifier("crossfix".to_owned()))
}

/// Other systems have no journal.
#[cfg(not(target_os = "linux"))]
fn journal() -> Option<tracing_subscriber::layer::Identity> {
    None
}
