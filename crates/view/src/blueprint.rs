use nalgebra::{Point3, Vector3};
use rerun::blueprint::components::{BackgroundKind, Eye3DKind, PanelState, PlayState};
use rerun::blueprint::{
    Blueprint, BlueprintActivation, BlueprintPanel, ContainerLike, Grid, Horizontal, SelectionPanel,
    Spatial2DView, Spatial3DView, TextDocumentView, TextLogView, TimePanel, TimeSeriesView, Vertical,
};
use rerun::external::re_log_types::BlueprintActivationCommand;
use rerun::external::re_sdk_types::blueprint::archetypes::{Background, EyeControls3D};
use rerun::log::LogMsg;
use rerun::{AsComponents, Color, EntityPath, RecordingStream, RecordingStreamBuilder};

use crate::ViewError;
use crate::paths::{TIMELINE, image_path};

/// Where targets are likely to be above the cameras, m.
const AIR_M: f64 = 25.0;

/// A camera's name and place.
pub(crate) type NamedPlace = (String, Point3<f64>);

/// Lays the picture out: the site on the left, cameras, plots and events on the right.
pub(crate) fn send(stream: &RecordingStream, cameras: &[NamedPlace]) -> Result<(), ViewError> {
    let (site, site_path) = site_view();
    let images: Vec<ContainerLike> = cameras
        .iter()
        .map(|(name, _)| Spatial2DView::new(name.clone()).with_origin(image_path(name)).into())
        .collect();
    let plots: Vec<ContainerLike> = vec![
        TimeSeriesView::new("residuals [mrad]").with_origin("/plots/residual").into(),
        TimeSeriesView::new("latency [ms]").with_origin("/plots/latency").into(),
        TextLogView::new("events").with_origin("/events").into(),
    ];
    let right = Vertical::new([
        ContainerLike::from(Grid::new(images).with_grid_columns(2)),
        ContainerLike::from(Vertical::new(plots)),
    ])
    .with_row_shares([1.0, 1.0]);
    let root = Horizontal::new([site, right.into()]).with_column_shares([1.7, 1.0]);
    let blueprint = Blueprint::new(root)
        .with_auto_views(false)
        .with_auto_layout(false)
        .with_blueprint_panel(BlueprintPanel::from_state(PanelState::Collapsed))
        .with_selection_panel(SelectionPanel::from_state(PanelState::Collapsed))
        .with_time_panel(
            TimePanel::new()
                .with_state(PanelState::Collapsed)
                .with_timeline(TIMELINE)
                .with_play_state(PlayState::Following),
        );
    let places: Vec<Point3<f64>> = cameras.iter().map(|(_, place)| *place).collect();
    send_site(stream, &blueprint, site_path.as_ref(), &eye_on(&places))
}

/// Lays a volume out: the site on the left, the scale of colours and the words on the right.
pub(crate) fn send_volume(stream: &RecordingStream, places: &[Point3<f64>]) -> Result<(), ViewError> {
    let (site, site_path) = site_view();
    let right = Horizontal::new([
        ContainerLike::from(Spatial2DView::new("SD [m]").with_origin("/scale")),
        ContainerLike::from(TextDocumentView::new("legend").with_origin("/legend")),
    ])
    .with_column_shares([0.4, 1.0]);
    let root = Horizontal::new([site, right.into()]).with_column_shares([1.8, 1.0]);
    let blueprint = Blueprint::new(root)
        .with_auto_views(false)
        .with_auto_layout(false)
        .with_blueprint_panel(BlueprintPanel::from_state(PanelState::Collapsed))
        .with_selection_panel(SelectionPanel::from_state(PanelState::Collapsed))
        .with_time_panel(TimePanel::new().with_state(PanelState::Collapsed));
    send_site(stream, &blueprint, site_path.as_ref(), &eye_on(places))
}

/// The view of the world, and where its properties are written.
fn site_view() -> (ContainerLike, Option<EntityPath>) {
    let site: ContainerLike = Spatial3DView::new("site").with_origin("/world").into();
    let path = match &site {
        ContainerLike::View(view) => Some(view.blueprint_path()),
        _ => None,
    };
    (site, path)
}

/// Sends a blueprint whose view of the world has this eye, and a dark background.
fn send_site(
    stream: &RecordingStream,
    blueprint: &Blueprint,
    site_path: Option<&EntityPath>,
    eye: &EyeControls3D,
) -> Result<(), ViewError> {
    let background = Background::new(BackgroundKind::SolidColor).with_color(Color::from_rgb(18, 20, 28));
    let part = |name: &str| site_path.map(|path| EntityPath::from(format!("{path}/{name}")));
    let mut properties: Vec<(EntityPath, &dyn AsComponents)> = Vec::new();
    properties.extend(part("EyeControls3D").map(|path| (path, eye as &dyn AsComponents)));
    properties.extend(part("Background").map(|path| (path, &background as &dyn AsComponents)));
    send_with(stream, blueprint, &properties)
}

/// Lays an image tracker's work out: the video on the left, the curves on the right.
pub(crate) fn send_tracking(stream: &RecordingStream) -> Result<(), ViewError> {
    let video: ContainerLike = Spatial2DView::new("video").with_origin("/video").into();
    let curves = Vertical::new([
        ContainerLike::from(TimeSeriesView::new("score and certainty").with_origin("/curves")),
        ContainerLike::from(TimeSeriesView::new("innovation squared").with_origin("/innovation")),
    ]);
    let root = Horizontal::new([video, curves.into()]).with_column_shares([1.6, 1.0]);
    let time = TimePanel::new().with_state(PanelState::Collapsed).with_timeline(TIMELINE);
    let blueprint = Blueprint::new(root)
        .with_auto_views(false)
        .with_auto_layout(false)
        .with_blueprint_panel(BlueprintPanel::from_state(PanelState::Collapsed))
        .with_selection_panel(SelectionPanel::from_state(PanelState::Collapsed))
        .with_time_panel(time);
    send_with(stream, &blueprint, &[])
}

/// An eye that has all cameras, or other places, and the air above them in view.
fn eye_on(places: &[Point3<f64>]) -> EyeControls3D {
    let count = places.len().max(1) as f64;
    let sum = places.iter().map(|place| place.coords).sum::<Vector3<f64>>();
    let middle = sum / count + Vector3::z() * AIR_M;
    let reach = places.iter().map(|place| (place.coords - middle).norm()).fold(50.0, f64::max);
    let eye = middle + Vector3::new(-0.75, -1.5, 1.05) * reach;
    let f32s = |v: Vector3<f64>| [v.x as f32, v.y as f32, v.z as f32];
    EyeControls3D::new()
        .with_kind(Eye3DKind::Orbital)
        .with_position(f32s(eye))
        .with_look_target(f32s(middle))
        .with_eye_up([0.0_f32, 0.0, 1.0])
}

/// Sends a blueprint with properties of views, for which this version of Rerun has no setters in
/// Rust: they are written into the blueprint's own store, as its Python code does.
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
        .filter(|m| m.store_id().is_blueprint() && !matches!(m, LogMsg::BlueprintActivationCommand(_)))
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
    let activation = BlueprintActivationCommand { blueprint_id: id, make_active: true, make_default: true };
    stream.send_blueprint(messages, activation);
    Ok(())
}
