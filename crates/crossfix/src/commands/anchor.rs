//! The option that says where on Earth a site is.

use crossfix_geometry::Geodetic;

use crate::commands::numbers;

/// Where on Earth the site's origin is.
#[derive(Clone, Copy, Debug, Default, clap::Args)]
pub struct AnchorArg {
    /// Where on Earth the site's origin is: degrees north, degrees east, metres above the WGS84
    /// ellipsoid (or above what the heights of the file read count from).
    #[arg(
        long,
        value_name = "LAT,LON,HEIGHT",
        value_parser = numbers::place,
        allow_hyphen_values = true
    )]
    pub anchor: Option<Geodetic>,
}
