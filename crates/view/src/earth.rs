//! Where on Earth the site is: its map, and a picture of the ground.

use crossfix_geometry::{Geodetic, LocalFrame};
use crossfix_message::{Track, TrackState};
use nalgebra::Point3;
use rerun::RecordingStream;
use rerun_types::archetypes::{Clear, GeoLineStrings, GeoPoints, Image, Mesh3D, Transform3D};
use rerun_types::blueprint::archetypes::MapZoom;
use rerun_types::components::{AlbedoFactor, Color, Radius};
use rerun_types::datatypes::Rgba32;

use crate::extent::{BoundingBox, Bounds};
use crate::{ViewError, draw};

/// Entity path from which the map view takes its points: any name that nothing else has.
pub(crate) const MAP: &str = "map";
/// Entity path of the picture of the ground.
const PICTURE: &str = "world/ground/picture";
/// Brightness to which the picture is dimmed, of 255: sight lines and trails must stand out from
/// it. With half of it little is left of a dark picture; undimmed it is as bright as they are.
const DIMMED: u8 = 130;
/// How far the picture lies below the grid, as a share of the diagonal of the site's extent: in one
/// plane the two would flicker. With half of it they may still flicker from afar.
const BELOW_GRID: f64 = 1e-3;

/// Size of a point of the map at the equator, at the zoom where the whole map is 256 points wide,
/// m: the Earth's circumference over 256. With half of it the site would be half as large as it
/// should.
const WHOLE_MAP_M: f64 = 156_543.0;
/// Length of the site's diagonal on the map, points: it fits into the smallest view. With half
/// of it the map shows twice as far; with twice as much the site is cut off in a small view.
const SITE_POINTS: f64 = 250.0;

/// A picture of the ground from above, north up: an orthophoto, a plan, a piece of a map.
#[derive(Clone, Debug)]
pub struct GroundPicture {
    /// Columns and rows.
    pub size: [u32; 2],
    /// Red, green and blue of each pixel, row by row from the north-west.
    pub rgb: Vec<u8>,
    /// Its south-western corner.
    pub south_west: Geodetic,
    /// Its north-eastern corner.
    pub north_east: Geodetic,
}

/// The site's place on Earth, and what is drawn with it.
pub(crate) struct Earth {
    frame: LocalFrame,
    has_picture: bool,
}

impl Earth {
    pub(crate) fn new(
        stream: &RecordingStream,
        anchor: Geodetic,
        picture: Option<GroundPicture>,
    ) -> Result<Self, ViewError> {
        let earth = Self { frame: LocalFrame::at(anchor), has_picture: picture.is_some() };
        if let Some(picture) = picture {
            // Logged once: it may be many megabytes.
            stream.log_static(format!("{PICTURE}/mesh"), &earth.mesh(picture))?;
        }
        Ok(earth)
    }

    /// The picture of the ground as a mesh at the height of the site's origin.
    fn mesh(&self, picture: GroundPicture) -> Mesh3D {
        let [from, to] =
            [picture.south_west, picture.north_east].map(|corner| self.frame.local(corner));
        let corners = [(from.x, from.y), (to.x, from.y), (to.x, to.y), (from.x, to.y)];
        Mesh3D::new(corners.map(|(x, y)| [x as f32, y as f32, 0.0]))
            .with_triangle_indices([[0, 1, 2], [0, 2, 3]])
            .with_vertex_texcoords([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
            .with_albedo_factor(AlbedoFactor(Rgba32::from_rgb(DIMMED, DIMMED, DIMMED)))
            .with_albedo_texture_image(Image::from_rgb24(picture.rgb, picture.size))
    }

    /// Latitude and longitude, deg: a pair, as Rerun takes it.
    fn lat_lon(&self, point: Point3<f64>) -> (f64, f64) {
        let place = self.frame.geodetic(point);
        (place.latitude_deg(), place.longitude_deg())
    }

    /// The zoom at which the map shows the whole site.
    pub(crate) fn zoom(&self, extent: &BoundingBox) -> MapZoom {
        let Bounds { low, high } = extent.bounds();
        let across = (high - low).norm().max(1.0);
        let (latitude_deg, _) = self.lat_lon(extent.middle());
        // metres per point at zoom z: WHOLE_MAP_M cos(latitude) / 2^z
        let point_m = WHOLE_MAP_M * latitude_deg.to_radians().cos();
        MapZoom::new((point_m * SITE_POINTS / across).log2().clamp(0.0, 20.0))
    }

    /// A camera on the map.
    pub(crate) fn camera(
        &self,
        stream: &RecordingStream,
        name: &str,
        place: Point3<f64>,
        colour: Color,
    ) -> Result<(), ViewError> {
        let point = GeoPoints::from_lat_lon([self.lat_lon(place)])
            .with_radii([Radius::new_ui_points(6.0)])
            .with_colors([colour]);
        Ok(stream.log_static(format!("{MAP}/cameras/{name}"), &point)?)
    }

    /// Draws a track on the map, with its trail; a track of one camera is removed from the map.
    pub(crate) fn track(
        &self,
        stream: &RecordingStream,
        track: &Track,
        place: Point3<f64>,
        trail: &[[f32; 3]],
    ) -> Result<(), ViewError> {
        if track.state() == TrackState::OneCamera {
            return self.clear(stream, track.id);
        }
        let (id, colour) = (track.id, draw::tint(track));
        let point = GeoPoints::from_lat_lon([self.lat_lon(place)])
            .with_radii([Radius::new_ui_points(5.0)])
            .with_colors([colour]);
        stream.log(format!("{MAP}/tracks/{id}"), &point)?;
        let way: Vec<(f64, f64)> =
            trail.iter().map(|point| self.lat_lon(point.map(f64::from).into())).collect();
        let way = GeoLineStrings::from_lat_lon([way])
            .with_radii([Radius::new_ui_points(1.5)])
            .with_colors([colour]);
        Ok(stream.log(format!("{MAP}/tracks/{id}/trail"), &way)?)
    }

    /// Removes an ended track from the map.
    pub(crate) fn clear(&self, stream: &RecordingStream, id: u64) -> Result<(), ViewError> {
        Ok(stream.log(format!("{MAP}/tracks/{id}"), &Clear::recursive())?)
    }

    /// Places the picture of the ground, if there is one, just under the grid of a site.
    pub(crate) fn ground(
        &self,
        stream: &RecordingStream,
        extent: &BoundingBox,
    ) -> Result<(), ViewError> {
        if !self.has_picture {
            return Ok(());
        }
        let Bounds { low, high } = extent.bounds();
        let height = low.z - BELOW_GRID * (high - low).norm();
        Ok(stream.log_static(PICTURE, &Transform3D::from_translation([0.0, 0.0, height as f32]))?)
    }
}
