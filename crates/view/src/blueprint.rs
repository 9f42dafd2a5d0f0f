use nalgebra::Point3;
use rerun::blueprint::{
    Blueprint, BlueprintActivation, BlueprintPanel, ContainerLike, Grid, Horizontal, MapView,
    SelectionPanel, Spatial2DView, Spatial3DView, Tabs, TextDocumentView, TextLogView, TimePanel,
    TimeSeriesView, Vertical,
};
use rerun::external::re_log_types::BlueprintActivationCommand;
use rerun::log::LogMsg;
use rerun::{AsComponents, EntityPath, RecordingStream, RecordingStreamBuilder};
use rerun_types::blueprint::archetypes::{Background, LineGrid3D, VisualBounds2D};
use rerun_types::blueprint::components::{BackgroundKind, PanelState, PlayState};
use rerun_types::components::Color;
use rerun_types::datatypes::Range2D;

use crate::earth::{Earth, MAP};
use crate::extent::BoundingBox;
use crate::paths::{TIMELINE, image_path};
use crate::{ViewError, eye};

/// The view of a camera's images in the layout.
pub(crate) struct CameraPanel {
    /// The camera.
    pub(crate) name: String,
    /// Low and high corner of the part of its pictures that is shown, in the picture's pixels;
    /// `None` for all of it.
    pub(crate) shown: Option<[[f64; 2]; 2]>,
}

/// Sends a site's layout: the world, plots and the legend on the left, images and events on the
/// right.
pub(crate) fn send(
    stream: &RecordingStream,
    cameras: &[CameraPanel],
    extent: &BoundingBox,
    earth: Option<&Earth>,
) -> Result<(), ViewError> {
    let (site, site_path) = site_view();
    let (site, map_path) = if earth.is_some() { with_map(site) } else { (site, None) };
    let (images, image_paths): (Vec<_>, Vec<_>) =
        cameras.iter().map(|camera| image_view(&camera.name)).unzip();
    let plots: [ContainerLike; 3] = [
        TimeSeriesView::new("residuals [mrad]").with_origin("/plots/residual").into(),
        TimeSeriesView::new("latency [ms]").with_origin("/plots/latency").into(),
        TextDocumentView::new("legend").with_origin("/legend").into(),
    ];
    let plots = Horizontal::new(plots).with_column_shares([1.0, 1.0, 1.3]);
    let left = Vertical::new([site, plots.into()]).with_row_shares([3.2, 1.0]);
    // Up to three images are stacked: so they are wide, and few enough to be high as well.
    let columns = if cameras.len() <= 3 { 1 } else { 2 };
    let right = Vertical::new([
        ContainerLike::from(Grid::new(images).with_grid_columns(columns)),
        ContainerLike::from(TextLogView::new("events").with_origin("/events")),
    ])
    .with_row_shares([5.0, 1.0]);
    let root =
        Horizontal::new([ContainerLike::from(left), right.into()]).with_column_shares([1.9, 1.0]);
    let time = TimePanel::new()
        .with_state(PanelState::Collapsed)
        .with_timeline(TIMELINE)
        .with_play_state(PlayState::Following);
    let shown = cameras.iter().map(|camera| camera.shown.map(visual_bounds));
    let bounds: Vec<(EntityPath, VisualBounds2D)> = image_paths
        .into_iter()
        .zip(shown)
        .filter_map(|(path, shown)| {
            Some((EntityPath::from(format!("{}/VisualBounds2D", path?)), shown?))
        })
        .collect();
    let zoom = earth.map(|earth| earth.zoom(extent));
    let mut zooms: Vec<(EntityPath, &dyn AsComponents)> =
        bounds.iter().map(|(path, bounds)| (path.clone(), bounds as &dyn AsComponents)).collect();
    if let (Some(path), Some(zoom)) = (map_path, &zoom) {
        zooms.push((EntityPath::from(format!("{path}/MapZoom")), zoom));
    }
    send_site(stream, &without_panels(root).with_time_panel(time), site_path, extent, zooms)
}

/// Puts the site and a map into tabs; the map asks for its tiles only when somebody opens its tab.
/// Also returns where the map's properties are written.
fn with_map(site: ContainerLike) -> (ContainerLike, Option<EntityPath>) {
    let map: ContainerLike = MapView::new("map").with_origin(MAP).into();
    let path = path_of(&map);
    (Tabs::new([site, map]).into(), path)
}

/// The view of a camera's images, and where its properties are written.
fn image_view(name: &str) -> (ContainerLike, Option<EntityPath>) {
    let view: ContainerLike = Spatial2DView::new(name).with_origin(image_path(name)).into();
    let path = path_of(&view);
    (view, path)
}

fn visual_bounds([low, high]: [[f64; 2]; 2]) -> VisualBounds2D {
    let range = |axis: usize| [low[axis], high[axis]];
    VisualBounds2D::new(Range2D { x_range: range(0).into(), y_range: range(1).into() })
}

/// A blueprint whose side panels are collapsed.
fn without_panels(root: impl Into<ContainerLike>) -> Blueprint {
    Blueprint::new(root)
        .with_auto_views(false)
        .with_auto_layout(false)
        .with_blueprint_panel(BlueprintPanel::from_state(PanelState::Collapsed))
        .with_selection_panel(SelectionPanel::from_state(PanelState::Collapsed))
}

/// Sends the layout of a calibration's flight: the site, the residuals and the legend on the left,
/// images on the right.
pub(crate) fn send_flight(
    stream: &RecordingStream,
    cameras: &[String],
    extent: &BoundingBox,
) -> Result<(), ViewError> {
    let (site, site_path) = site_view();
    let below: [ContainerLike; 2] = [
        TimeSeriesView::new("labels beside the way [px]").with_origin("/plots/residual").into(),
        TextDocumentView::new("legend").with_origin("/legend").into(),
    ];
    let left = Vertical::new([site, Horizontal::new(below).into()]).with_row_shares([3.2, 1.0]);
    let images = cameras.iter().map(|name| image_view(name).0);
    let columns = if cameras.len() <= 3 { 1 } else { 2 };
    let right = Grid::new(images.collect::<Vec<_>>()).with_grid_columns(columns);
    let root =
        Horizontal::new([ContainerLike::from(left), right.into()]).with_column_shares([1.9, 1.0]);
    let time = TimePanel::new().with_state(PanelState::Collapsed).with_timeline(TIMELINE);
    send_site(stream, &without_panels(root).with_time_panel(time), site_path, extent, vec![])
}

/// Sends the layout of several runs: the site, and below it their errors and the legend.
pub(crate) fn send_comparison(
    stream: &RecordingStream,
    extent: &BoundingBox,
) -> Result<(), ViewError> {
    let (site, site_path) = site_view();
    let below: [ContainerLike; 2] = [
        TimeSeriesView::new("error [m]").with_origin("/plots/error").into(),
        TextDocumentView::new("legend").with_origin("/legend").into(),
    ];
    let below = Horizontal::new(below).with_column_shares([2.0, 1.0]);
    let root = Vertical::new([site, below.into()]).with_row_shares([2.0, 1.0]);
    let time = TimePanel::new().with_state(PanelState::Collapsed).with_timeline(TIMELINE);
    send_site(stream, &without_panels(root).with_time_panel(time), site_path, extent, vec![])
}

/// Sends the layout of a volume: the site on the left, the colour scale and the legend on the
/// right.
pub(crate) fn send_volume(
    stream: &RecordingStream,
    places: &[Point3<f64>],
) -> Result<(), ViewError> {
    let (site, site_path) = site_view();
    let right = Horizontal::new([
        ContainerLike::from(Spatial2DView::new("SD [m]").with_origin("/scale")),
        ContainerLike::from(TextDocumentView::new("legend").with_origin("/legend")),
    ])
    .with_column_shares([0.4, 1.0]);
    let root = Horizontal::new([site, right.into()]).with_column_shares([1.8, 1.0]);
    let time = TimePanel::new().with_state(PanelState::Collapsed);
    let extent = BoundingBox::of(places.iter().copied());
    send_site(stream, &without_panels(root).with_time_panel(time), site_path, &extent, vec![])
}

/// The view of the world, and where its properties are written.
fn site_view() -> (ContainerLike, Option<EntityPath>) {
    let site: ContainerLike = Spatial3DView::new("site").with_origin("/world").into();
    let path = path_of(&site);
    (site, path)
}

/// Where a view's properties are written.
fn path_of(view: &ContainerLike) -> Option<EntityPath> {
    match view {
        ContainerLike::View(view) => Some(view.blueprint_path()),
        _ => None,
    }
}

/// Sends a blueprint whose 3D view shows a whole box, on a dark background and without Rerun's
/// grid, which has no end and no scale.
fn send_site(
    stream: &RecordingStream,
    blueprint: &Blueprint,
    site_path: Option<EntityPath>,
    extent: &BoundingBox,
    zooms: Vec<(EntityPath, &dyn AsComponents)>,
) -> Result<(), ViewError> {
    let background =
        Background::new(BackgroundKind::SolidColor).with_color(Color::from_rgb(18, 20, 28));
    let grid = LineGrid3D::new().with_visible(false);
    let eye = eye::on(extent);
    let of_site: [(&str, &dyn AsComponents); 3] =
        [("EyeControls3D", &eye), ("Background", &background), ("LineGrid3D", &grid)];
    let mut properties = zooms;
    if let Some(path) = site_path {
        let places =
            of_site.map(|(name, property)| (EntityPath::from(format!("{path}/{name}")), property));
        properties.extend(places);
    }
    send_with(stream, blueprint, &properties)
}

/// Sends the layout of an image tracker's work: the video on the left, the curves on the right.
pub(crate) fn send_tracking(stream: &RecordingStream) -> Result<(), ViewError> {
    let video: ContainerLike = Spatial2DView::new("video").with_origin("/video").into();
    let curves = Vertical::new([
        ContainerLike::from(TimeSeriesView::new("score and certainty").with_origin("/curves")),
        ContainerLike::from(TimeSeriesView::new("innovation squared").with_origin("/innovation")),
    ]);
    let root = Horizontal::new([video, curves.into()]).with_column_shares([1.6, 1.0]);
    let time = TimePanel::new().with_state(PanelState::Collapsed).with_timeline(TIMELINE);
    send_with(stream, &without_panels(root).with_time_panel(time), &[])
}

/// Sends a blueprint with properties of views for which this version of Rerun has no setters in
/// Rust: they are written into the blueprint's own store, as Rerun's Python code does.
fn send_with(
    stream: &RecordingStream,
    blueprint: &Blueprint,
    properties: &[(EntityPath, &dyn AsComponents)],
) -> Result<(), ViewError> {
    let Some(info) = stream.store_info() else {
        return Ok(());
    };
    let application = info.application_id().clone();
    let (store, memory) = RecordingStreamBuilder::new(application).enabled(true).memory()?;
    blueprint.send(&store, BlueprintActivation::default())?;
    let mut messages: Vec<LogMsg> = memory
        .take()
        .into_iter()
        .filter(|m| {
            m.store_id().is_blueprint() && !matches!(m, LogMsg::BlueprintActivationCommand(_))
        })
        .collect();
    store.disconnect();
    let Some(id) = messages.first().map(|m| m.store_id().clone()) else {
        return Ok(());
    };
    let (store, memory) =
        RecordingStreamBuilder::from_store_id(&id).send_properties(false).enabled(true).memory()?;
    store.set_log_time_enabled(false);
    store.set_time_sequence("blueprint", 0_i64);
    for (path, property) in properties {
        store.log(path.clone(), *property)?;
    }
    messages.extend(memory.take().into_iter().filter(|m| matches!(m, LogMsg::ArrowMsg(..))));
    store.disconnect();
    let activation =
        BlueprintActivationCommand { blueprint_id: id, make_active: true, make_default: true };
    stream.send_blueprint(messages, activation);
    Ok(())
}
