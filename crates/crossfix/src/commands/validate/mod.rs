mod ablate;
mod plot;
mod text;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use crossfix_evaluation::{Table, ValidationOptions, validate_fusion, validate_tracker};
use indicatif::{ProgressBar, ProgressStyle};

use crate::commands::examples;
use crate::output;

/// Repeat the papers' experiments and print our figures beside theirs.
#[derive(Debug, clap::Args)]
#[command(
    after_help = examples(&[
        "crossfix validate tracker --runs 1000 --only loss",
        "crossfix validate fusion --runs 4000 --only bound",
    ])
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
    ///
    /// With --ablate: what each part of the tracker brings. The share of frames that are lost with
    /// all parts, and how much more is lost without each, on drawn scenes (noise, masts, wires,
    /// birds, clouds' edges, a pan) and on labelled videos.
    #[command(after_help = examples(&[
        "crossfix validate tracker --runs 1000 --json tracker.json --plots plots",
        "crossfix validate tracker --ablate --clips videos",
    ]))]
    Tracker(TrackerOptions),
    /// The fusion: detection, degenerate geometries, the Cramer-Rao bound, manoeuvres (Klochko
    /// 2020, Kalinov 2019).
    ///
    /// Prints each figure with the paper's, an independent implementation's, ours, the Monte Carlo
    /// standard error and, where something is asked of it, pass or fail.
    #[command(
        after_help = examples(&[
            "crossfix validate fusion --runs 4000 --only bound --json fusion.json",
        ])
    )]
    Fusion(Options),
}

#[derive(Debug, clap::Args)]
struct TrackerOptions {
    #[command(flatten)]
    options: Options,
    /// Print what each part of the tracker brings instead of the papers' tables; --runs is then the
    /// number of scenes of each kind, 10 by default.
    #[arg(long, conflicts_with_all = ["only", "strict"])]
    ablate: bool,
    /// A folder of videos, each with a table of the same name (CSV: frame,x,y,w,h) that says where
    /// its one target is.
    #[arg(long, value_name = "FOLDER", requires = "ablate")]
    clips: Option<PathBuf>,
}

#[derive(Debug, clap::Args)]
struct Options {
    /// Monte Carlo runs of an experiment; the papers have 1000. Default: 200.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=1_000_000))]
    runs: Option<u32>,
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

/// Runs of an experiment, if nothing else is asked. With half of them the papers' figures have a
/// standard error of up to five per cent.
const RUNS: u32 = 200;
/// Scenes of each kind for an ablation, if nothing else is asked. With half of them a part that
/// brings a per cent can seldom be distinguished from none.
const SCENES: u32 = 10;

pub fn run(what: &Args) -> anyhow::Result<()> {
    let bar = ProgressBar::new(0).with_style(ProgressStyle::with_template(
        "{elapsed_precise} [{bar:24}] {pos}/{len} {msg}",
    )?);
    bar.enable_steady_tick(std::time::Duration::from_millis(200));
    let progress = |done, all, next: &str| show_progress(&bar, done, all, next);
    let (args, tables) = match &what.what {
        What::Tracker(TrackerOptions { options, ablate: true, clips }) => {
            let clips = clips.as_deref();
            (options, ablate::tables(options.with_runs(SCENES), clips, progress)?)
        }
        What::Tracker(TrackerOptions { options, .. }) => {
            (options, validate_tracker(options.with_runs(RUNS), &options.only, progress))
        }
        What::Fusion(options) => {
            (options, validate_fusion(options.with_runs(RUNS), &options.only, progress))
        }
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
        draw(&tables, folder)?;
    }
    let failures: usize = tables.iter().map(Table::failures).sum();
    output::line(text::summary(&tables));
    if args.strict && failures > 0 {
        bail!("{failures} figures are not what they must be");
    }
    Ok(())
}

/// Shows on the bar how many of the experiments are done, and which one is next.
fn show_progress(bar: &ProgressBar, done: usize, all: usize, next: &str) {
    bar.set_length(all as u64);
    bar.set_position(done as u64);
    bar.set_message(next.to_owned());
}

/// Draws a figure of each table into a folder.
fn draw(tables: &[Table], folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    for table in tables {
        let path = folder.join(format!("{}.svg", table.name));
        plot::draw(table, &path).with_context(|| format!("cannot draw {}", path.display()))?;
    }
    output::line(format!("{} figures written to {}", tables.len(), folder.display()));
    Ok(())
}

impl Options {
    /// The extent of the simulation, with this many runs if nothing else is asked.
    fn with_runs(&self, usual: u32) -> ValidationOptions {
        ValidationOptions { runs: self.runs.unwrap_or(usual) as usize, seed: self.seed }
    }
}
