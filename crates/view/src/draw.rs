//! What each thing looks like.

use crossfix_geometry::{Camera, ImageSize};
use crossfix_message::{BearingFrame, BearingTrack, Track, TrackNumber, TrackState};
use nalgebra::{Matrix3, Point3, SymmetricEigen, Vector3};
use rerun::{
    Arrows3D, Boxes2D, Color, Ellipsoids3D, FillMode, LineStrips3D, Pinhole, Points3D, Quaternion, Radius,
    RecordingStream, SeriesLines, Transform3D,
};

use crate::paths::image_path;
use crate::{ViewError, colour};

/// Length of the frustums, m: large enough to be seen in a site of 100 m.
const FRUSTUM_M: f32 = 12.0;
/// An ellipsoid's half axes, standard deviations.
const SIGMAS: f64 = 3.0;
/// An ellipsoid smaller than this would not be seen, m.
const LEAST_HALF_AXIS_M: f64 = 0.3;
/// Arrows show the way of this time, s.
const ARROW_S: f64 = 1.0;

fn f32s(v: &Vector3<f64>) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}

/// A camera: its pose, and a frustum whose image has sides scaled by `scale`.
pub(crate) fn camera(
    stream: &RecordingStream,
    name: &str,
    index: u64,
    camera: &Camera,
    scale: f64,
) -> Result<(), ViewError> {
    let matrix = camera.pose().rotation().matrix();
    let column = |i: usize| [matrix[(0, i)] as f32, matrix[(1, i)] as f32, matrix[(2, i)] as f32];
    let columns = [column(0), column(1), column(2)];
    let position = f32s(&camera.pose().position().coords);
    stream.log_static(
        format!("world/cameras/{name}"),
        &Transform3D::from_translation_mat3x3(position, columns),
    )?;
    stream.log_static(
        format!("world/names/{name}"),
        &Points3D::new([position])
            .with_labels([name])
            .with_show_labels(true)
            .with_colors([colour::of(index)])
            .with_radii([Radius::new_ui_points(3.0)]),
    )?;
    let lens = camera.model().intrinsics();
    let ImageSize { width, height } = lens.size;
    let scaled = |value: f64| (value * scale) as f32;
    let projection = rerun::components::PinholeProjection::from_focal_length_and_principal_point(
        [scaled(lens.fx), scaled(lens.fy)],
        [scaled(lens.cx), scaled(lens.cy)],
    );
    stream.log_static(
        image_path(name),
        &Pinhole::new(projection)
            .with_resolution([scaled(f64::from(width)), scaled(f64::from(height))])
            .with_image_plane_distance(FRUSTUM_M)
            .with_color(colour::of(index))
            .with_line_width(Radius::new_ui_points(1.0)),
    )?;
    Ok(())
}

/// What the plot of a camera's residuals looks like.
pub(crate) fn residual_plot(stream: &RecordingStream, name: &str, index: u64) -> Result<(), ViewError> {
    stream.log_static(
        format!("plots/residual/{name}"),
        &SeriesLines::new().with_names([name]).with_colors([colour::of(index)]),
    )?;
    Ok(())
}

/// The sight lines of a frame, `reach_m` long, and the boxes in its image.
pub(crate) fn bearings(
    stream: &RecordingStream,
    frame: &BearingFrame,
    index: u64,
    camera: &Camera,
    reach_m: f64,
    scale: f64,
) -> Result<(), ViewError> {
    let measured = |track: &&BearingTrack| track.state() == crossfix_message::ImageTrackState::Tracking;
    let origin = camera.pose().position();
    let strips: Vec<[[f32; 3]; 2]> = frame
        .tracks
        .iter()
        .filter(measured)
        .filter_map(|track| {
            let direction: Vector3<f64> = track.bearing?.into();
            let end = origin + camera.pose().rotation() * direction * reach_m;
            end.iter().all(|v| v.is_finite()).then(|| [f32s(&origin.coords), f32s(&end.coords)])
        })
        .collect();
    stream.log(
        format!("world/sight_lines/{}", frame.camera),
        &LineStrips3D::new(strips)
            .with_colors([colour::faint(index, 150)])
            .with_radii([Radius::new_ui_points(0.8)]),
    )?;
    let boxes: Vec<&BearingTrack> = frame.tracks.iter().filter(|t| t.width > 0.0).collect();
    let scaled = |value: f64| (value * scale) as f32;
    // Rerun's pixels have their upper left corner at whole numbers.
    let centres = boxes.iter().map(|t| (scaled(t.pixel_x + 0.5), scaled(t.pixel_y + 0.5)));
    let sizes = boxes.iter().map(|t| (scaled(t.width), scaled(t.height)));
    stream.log(
        format!("{}/targets", image_path(&frame.camera)),
        &Boxes2D::from_centers_and_sizes(centres, sizes)
            .with_labels(boxes.iter().map(|t| t.track_id.to_string()))
            // Labels would hide targets of a few pixels.
            .with_show_labels(false)
            .with_colors([colour::of(index)])
            .with_radii([Radius::new_ui_points(1.5)]),
    )?;
    Ok(())
}

/// A track: where it is, how fast, how sure, and where it has been.
pub(crate) fn track(stream: &RecordingStream, track: &Track, trail: &[[f32; 3]]) -> Result<(), ViewError> {
    let (Some(position), Some(velocity)) = (track.position, track.velocity) else {
        return Ok(());
    };
    let position: Point3<f64> = position.into();
    let velocity: Vector3<f64> = velocity.into();
    let place = f32s(&position.coords);
    let path = format!("world/tracks/{}", track.id);
    let sure = track.state() == TrackState::Confirmed;
    let tint: Color = if sure { colour::of(track.id + 3) } else { colour::faint(track.id + 3, 110) };
    let number = TrackNumber(track.id);
    let label = match track.state() {
        TrackState::Tentative => format!("{number}?"),
        TrackState::Coasting => format!("{number} (coasting)"),
        _ => format!("{number}  {:.0} m/s  {:.0} m", velocity.norm(), position.z),
    };
    stream.log(
        format!("{path}/position"),
        &Points3D::new([place])
            .with_colors([tint])
            .with_labels([label])
            .with_show_labels(true)
            .with_radii([Radius::new_ui_points(5.0)]),
    )?;
    stream.log(
        format!("{path}/velocity"),
        &Arrows3D::from_vectors([f32s(&(velocity * ARROW_S))])
            .with_origins([place])
            .with_colors([tint])
            .with_radii([Radius::new_ui_points(1.5)]),
    )?;
    stream.log(
        format!("{path}/trail"),
        &LineStrips3D::new([trail.to_vec()])
            .with_colors([colour::faint(track.id + 3, 200)])
            .with_radii([Radius::new_ui_points(1.5)]),
    )?;
    if let Some((half_axes, rotation)) = ellipsoid(track) {
        stream.log(
            format!("{path}/covariance"),
            &Ellipsoids3D::from_centers_and_half_sizes([place], [half_axes])
                .with_quaternions([rotation])
                .with_fill_mode(FillMode::MajorWireframe)
                .with_colors([tint]),
        )?;
    }
    Ok(())
}

/// Half axes and turn of a track's ellipsoid of position.
fn ellipsoid(track: &Track) -> Option<([f32; 3], Quaternion)> {
    let covariance: &[f64; 36] = track.covariance.as_slice().try_into().ok()?;
    let block = Matrix3::from_fn(|row, column| covariance[6 * row + column]);
    if !block.iter().all(|v| v.is_finite()) {
        return None;
    }
    let SymmetricEigen { eigenvalues, mut eigenvectors } = block.symmetric_eigen();
    if eigenvectors.determinant() < 0.0 {
        eigenvectors.column_mut(0).neg_mut();
    }
    let rotation = nalgebra::UnitQuaternion::from_matrix(&eigenvectors);
    let half = |i: usize| (SIGMAS * eigenvalues[i].max(0.0).sqrt()).max(LEAST_HALF_AXIS_M) as f32;
    let [x, y, z, w] = [rotation.i, rotation.j, rotation.k, rotation.w].map(|v| v as f32);
    Some(([half(0), half(1), half(2)], Quaternion::from_xyzw([x, y, z, w])))
}
