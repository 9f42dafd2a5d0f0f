mod flight;
mod log;
mod report;
mod survey;

/// Find where cameras stand, what their lenses are and how their clocks run.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  crossfix calibrate flight REC.mcap --log drone.csv --log-kind rtk -o my-site/calibration.toml"
)]
pub struct Args {
    #[command(subcommand)]
    way: Way,
}

#[derive(Debug, clap::Subcommand)]
enum Way {
    Flight(flight::Args),
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    match &args.way {
        Way::Flight(args) => flight::run(args),
    }
}
