//! Fuses sites that nobody tuned for: how many cameras, how far, how fast, how noisy, how wrong
//! their poses and clocks, and what flies before them is drawn from a seed. Says how often a target
//! has a track, and how often a track is not where it says.
//!
//! ```text
//! cargo run --release -p crossfix-fusion --example drawn_sites -- --first 1000 --sites 60
//! ```
//!
//! A row for each kind of poses: number of sites; the share of looks at targets that two cameras
//! have in view, four times a second after the fifth second, in which they have a track; the share
//! of answers (confirmed tracks, where they were at their newest bearing) beyond four stated
//! deviations, and of those that are also 5 m or more from every target; the median NEES of the
//! position, 2.37 where covariances are right; the median error. The first seed is 1 and there are
//! 60 sites if nothing else is asked for.
//!
//! `--cameras N`, `--targets N` and `--poses exact|careful|declared` set what is otherwise drawn;
//! `--each` adds a line for each site. With `--hard` half of the targets fly from rest to rest as
//! autopilots do, at 2 to 12 m/s^2, and of the cameras one in three each has noise that is up to
//! three times as large as reported, noise of which half the variance lasts for a second, and a
//! time of 2 to 20 s in which it sees nothing, and one in twenty a clock that is 5 to 200 ms ahead
//! without a word. A change to the fusion is tried on seeds that it was not
//! made with.

#![allow(clippy::print_stdout, clippy::print_stderr, reason = "it says what it has measured")]

mod flight;
mod hardship;
mod site;
mod tally;

use std::collections::BTreeMap;
use std::error::Error;
use std::process::ExitCode;

use crossfix_fusion::{Fusion, FusionConfig};

use self::site::{DrawnSite, Poses};
use self::tally::Tally;

/// What is asked for.
#[derive(Default)]
pub struct Wishes {
    first: u64,
    sites: u64,
    each: bool,
    /// Whether more goes wrong.
    pub hard: bool,
    /// Number of cameras of each site.
    pub cameras: Option<usize>,
    /// Number of its targets.
    pub targets: Option<usize>,
    /// How good its poses are.
    pub poses: Option<Poses>,
}

impl Wishes {
    fn of(mut arguments: impl Iterator<Item = String>) -> Result<Self, Box<dyn Error>> {
        let mut wishes = Self { first: 1, sites: 60, ..Self::default() };
        while let Some(name) = arguments.next() {
            if name == "--each" {
                wishes.each = true;
                continue;
            }
            if name == "--hard" {
                wishes.hard = true;
                continue;
            }
            let value = arguments.next().ok_or_else(|| format!("{name} has no value"))?;
            match name.as_str() {
                "--first" => wishes.first = value.parse()?,
                "--sites" => wishes.sites = value.parse()?,
                "--cameras" => wishes.cameras = Some(value.parse()?),
                "--targets" => wishes.targets = Some(value.parse()?),
                "--poses" => {
                    let named = |poses: &Poses| format!("{poses:?}").to_lowercase() == value;
                    let poses = Poses::ALL.into_iter().find(named);
                    wishes.poses = Some(poses.ok_or("exact, careful or declared")?);
                }
                _ => return Err(format!("{name} is not known").into()),
            }
        }
        Ok(wishes)
    }
}

/// What becomes of one site.
fn fuse(site: &mut DrawnSite) -> Result<Tally, Box<dyn Error>> {
    let mut fusion = Fusion::new(FusionConfig::default())?;
    for camera in &site.cameras {
        fusion.calibrate(&camera.calibration(site.poses))?;
    }
    let mut tally = Tally::default();
    for frame in site.frames() {
        fusion.ingest(&frame);
        tally.look(&fusion, site);
    }
    Ok(tally)
}

fn run() -> Result<(), Box<dyn Error>> {
    let wishes = Wishes::of(std::env::args().skip(1))?;
    let mut all: BTreeMap<Poses, Tally> = BTreeMap::new();
    println!("{:<10} {:>6}  {}", "poses", "", Tally::HEADING);
    for seed in wishes.first..wishes.first + wishes.sites {
        let mut site = DrawnSite::draw(seed, &wishes)?;
        let tally = fuse(&mut site)?;
        if wishes.each {
            let poses = format!("{:?}", site.poses);
            println!("{poses:<10} {seed:>6}  {tally}  {site}");
        }
        all.entry(site.poses).or_default().add(tally);
    }
    for (poses, tally) in all {
        println!("{:<10} {:>6}  {tally}", format!("{poses:?}"), "all");
    }
    Ok(())
}

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
