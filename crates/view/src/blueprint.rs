use rerun::RecordingStream;
use rerun::blueprint::components::{PanelState, PlayState};
use rerun::blueprint::{
    Blueprint, BlueprintActivation, BlueprintPanel, ContainerLike, Grid, Horizontal, SelectionPanel,
    Spatial2DView, Spatial3DView, TextLogView, TimePanel, TimeSeriesView, Vertical,
};

use crate::ViewError;
use crate::picture::{TIMELINE, image_path};

/// Lays the picture out: the site on the left, cameras, plots and events on the right.
pub(crate) fn send(stream: &RecordingStream, cameras: &[String]) -> Result<(), ViewError> {
    let site: ContainerLike = Spatial3DView::new("site").with_origin("/world").into();
    let images: Vec<ContainerLike> = cameras
        .iter()
        .map(|name| Spatial2DView::new(name.clone()).with_origin(image_path(name)).into())
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
    blueprint.send(stream, BlueprintActivation { make_active: true, make_default: true })?;
    Ok(())
}
