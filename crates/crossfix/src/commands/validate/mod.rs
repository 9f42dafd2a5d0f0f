mod plot;
mod text;

use std::path::PathBuf;

use anyhow::{Context, bail};
use crossfix_evaluation::{Table, ValidationOptions, validate_fusion, validate_tracker};
use indicatif::{ProgressBar, ProgressStyle};

use crate::output;

/// Make the papers' tables and figures again, beside the papers' figures.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  crossfix validate tracker --runs 1000 --only loss\n  crossfix validate fusion --runs 4000 --only bound"
)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    /// The image tracker: positioning, loss of track, consistency, reference strategies
    /// (Herasymenko 2021, Lytvynets 2020, Solonar 2023).
    ///
    /// Prints each figure with the paper's, ours, the Monte Carlo standard error and, where
    /// something is asked of it, pass or fail.
    #[command(
        after_help = "Example:\n  crossfix validate tracker --runs 1000 --json tracker.json --plots plots"
    )]
    Tracker(Options),
    /// The fusion: detection, degenerate geometries, the Cramer-Rao bound, manoeuvres (Klochko
    /// 2020, Kalinov 2019).
    ///
    /// Prints each figure with the paper's, a reference implementation's, ours, the Monte Carlo
    /// standard error and, where something is asked of it, pass or fail.
    #[command(
        after_help = "Example:\n  crossfix validate fusion --runs 4000 --only bound --json fusion.json"
    )]
    Fusion(Options),
}

#[derive(Debug, clap::Args)]
struct Options {
    /// Monte Carlo runs of an experiment; the papers have 1000.
    #[arg(long, default_value_t = 200, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=1_000_000))]
    runs: u32,
    /// Seed of everything random.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Only the experiments whose name holds this, e.g. loss.
    #[arg(long, default_value = "", value_name = "TEXT")]
    only: String,
    /// Write the tables as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write a figure of each table (SVG) into this folder.
    #[arg(long, value_name = "FOLDER")]
    plots: Option<PathBuf>,
    /// End with exit code 1 if a figure fails.
    #[arg(long)]
    strict: bool,
}

pub fn run(what: &Args) -> anyhow::Result<()> {
    let (What::Tracker(args) | What::Fusion(args)) = &what.what;
    let options = ValidationOptions { runs: args.runs as usize, seed: args.seed };
    let bar = ProgressBar::new(0).with_style(ProgressStyle::with_template(
        "{elapsed_precise} [{bar:24}] {pos}/{len} {msg}",
    )?);
    bar.enable_steady_tick(std::time::Duration::from_millis(200));
    let progress = |done, all, next: &str| {
        bar.set_length(all as u64);
        bar.set_position(done as u64);
        bar.set_message(next.to_owned());
    };
    let tables = match &what.what {
        What::Tracker(_) => validate_tracker(options, &args.only, progress),
        What::Fusion(_) => validate_fusion(options, &args.only, progress),
    };
    bar.finish_and_clear();
    if tables.is_empty() {
        bail!("no experiment has `{}` in its name", args.only);
    }
    for table in &tables {
        output::line(text::table(table));
    }
    if let Some(path) = &args.json {
        let json = serde_json::to_vec_pretty(&tables).context("cannot write the tables as JSON")?;
        std::fs::write(path, json).with_context(|| format!("cannot write {}", path.display()))?;
    }
    if let Some(folder) = &args.plots {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot make {}", folder.display()))?;
        for table in &tables {
            let path = folder.join(format!("{}.svg", table.name));
            plot::draw(table, &path).with_context(|| format!("cannot draw {}", path.display()))?;
        }
        output::line(format!("{} figures written to {}", tables.len(), folder.display()));
    }
    let failures: usize = tables.iter().map(Table::failures).sum();
    output::line(text::summary(&tables));
    if args.strict && failures > 0 {
        bail!("{failures} figures are not what they must be");
    }
    Ok(())
}
