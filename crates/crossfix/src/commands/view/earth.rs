//! The site's position on Earth in the viewer, and a picture of its ground.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use crossfix_geometry::Geodetic;
use crossfix_video::{Pixels, Still, decode_still};
use crossfix_view::{GroundPicture, RecordingStream, SitePicture};

use crate::commands::anchor::AnchorArg;
use crate::commands::numbers;

/// Longest side of a picture of the ground, pixels: every graphics card takes this as one texture.
/// With half of it a site of more than two kilometres could not have half a metre per pixel.
const MOST_SIDE: usize = 8192;

#[derive(Debug, Default, clap::Args)]
pub struct EarthArgs {
    #[command(flatten)]
    origin: AnchorArg,
    /// A picture of the ground from above, north up (PNG or JPEG), to be shown under the site. (A
    /// map of the surroundings is shown whenever --anchor, or live the network file's `[anchor]`,
    /// says where the site is.)
    #[arg(long, value_name = "FILE", requires = "map_edges")]
    map: Option<PathBuf>,
    /// The edges of the picture of the ground, degrees north and east.
    #[arg(
        long,
        value_name = "SOUTH,WEST,NORTH,EAST",
        value_parser = numbers::edges,
        allow_hyphen_values = true,
        requires = "map"
    )]
    map_edges: Option<[Geodetic; 2]>,
}

/// The site's position on Earth, if it is known, and a picture of its ground.
pub struct OnEarth(Option<(Geodetic, Option<GroundPicture>)>);

impl EarthArgs {
    /// Reads the position and the picture asked for; `known` is the anchor in the network's file.
    pub fn read(&self, known: Option<Geodetic>) -> anyhow::Result<OnEarth> {
        let ground = match (&self.map, self.map_edges) {
            (Some(path), Some(edges)) => {
                let has_error = || format!("cannot lay {} under the site", path.display());
                Some(ground(path, edges).with_context(has_error)?)
            }
            _ => None,
        };
        let anchor = self.origin.anchor.or(known);
        ensure!(
            anchor.is_some() || ground.is_none(),
            "where under the picture of the ground is the site? \
             Say where on Earth its origin is, with --anchor"
        );
        Ok(OnEarth(anchor.map(|anchor| (anchor, ground))))
    }
}

impl OnEarth {
    /// A new picture, placed at that position on Earth.
    pub fn picture(self, stream: RecordingStream) -> anyhow::Result<SitePicture> {
        let picture = SitePicture::new(stream)?;
        Ok(match self.0 {
            Some((anchor, ground)) => picture.on_earth(anchor, ground)?,
            None => picture,
        })
    }
}

fn ground(path: &Path, [south_west, north_east]: [Geodetic; 2]) -> anyhow::Result<GroundPicture> {
    let Still { width, height, pixels } =
        decode_still(&std::fs::read(path)?).map_err(anyhow::Error::msg)?;
    ensure!(
        width.max(height) <= MOST_SIDE,
        "it is {width}x{height} pixels, and {MOST_SIDE} a side are the most"
    );
    let grey = |sample: u8| [sample; 3];
    let high = |sample: u16| (sample >> 8) as u8;
    let rgb = match pixels {
        Pixels::Gray8(samples) => samples.into_iter().flat_map(grey).collect(),
        Pixels::Gray16(samples) => samples.into_iter().map(high).flat_map(grey).collect(),
        Pixels::Rgb8(samples) => samples,
        Pixels::Rgb16(samples) => samples.into_iter().map(high).collect(),
    };
    Ok(GroundPicture { size: [width as u32, height as u32], rgb, south_west, north_east })
}
