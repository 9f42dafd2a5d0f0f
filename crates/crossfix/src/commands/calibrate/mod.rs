mod beside_survey;
mod check;
mod clicks;
mod compare;
mod cost;
mod flight;
mod hold_out;
mod landmarks;
mod log;
#[cfg_attr(not(feature = "viewer"), path = "no_picture.rs")]
mod picture;
mod plots;
mod remarks;
mod report;
mod stars;
mod survey;
mod verdict;

use crossfix_calibration::LensFreedom;

use crate::commands::examples;

/// Find where cameras stand, what their lenses are and how their clocks run.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix calibrate flight REC.mcap --log drone.csv --log-kind rtk -o my-site/calibration.toml",
]))]
pub struct Args {
    #[command(subcommand)]
    way: CalibrateCommand,
}

#[derive(Debug, clap::Subcommand)]
enum CalibrateCommand {
    Flight(Box<flight::Args>),
    Landmarks(landmarks::Args),
    Compare(compare::Args),
    Check(check::Args),
}

/// Which parameters of a lens may differ from its file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Lens {
    /// Nothing.
    Keep,
    /// The focal length: 1 %.
    Focal,
    /// All: focal length 1 %, aspect 0.1 %, principal point 3 of 1920 pixels, each coefficient of
    /// distortion a third of itself.
    All,
}

impl From<Lens> for LensFreedom {
    fn from(lens: Lens) -> Self {
        match lens {
            Lens::Keep => Self::Keep,
            Lens::Focal => Self::Focal,
            Lens::All => Self::All,
        }
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    match &args.way {
        CalibrateCommand::Flight(args) => flight::run(args),
        CalibrateCommand::Landmarks(args) => landmarks::run(args),
        CalibrateCommand::Compare(args) => compare::run(args),
        CalibrateCommand::Check(args) => check::run(args),
    }
}
