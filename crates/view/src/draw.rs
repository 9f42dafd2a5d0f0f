//! The appearance of cameras, sight lines and tracks.

use crossfix_geometry::{Camera, ImageSize};
use crossfix_message::{BearingFrame, BearingTrack, Track, TrackNumber, TrackState};
use nalgebra::{Matrix3, Point3, SymmetricEigen, Vector3};
use rerun::RecordingStream;
use rerun_types::archetypes::{
    Arrows3D, Ellipsoids3D, LineStrips3D, Pinhole, Points3D, SeriesLines, Transform3D,
};
use rerun_types::components::{Color, FillMode, PinholeProjection, Radius};
use rerun_types::datatypes::Quaternion;

use crate::paths::image_path;
use crate::{ViewError, colour};

/// Length of the frustums, m: large enough to be seen in a site of 100 m. With half of it they are
/// hardly seen there; with twice as much they hide the middle of such a site.
const FRUSTUM_M: f32 = 12.0;
/// Half axes of an ellipsoid, standard deviations. Of the errors 97 in 100 lie within; with half of
/// it, 48.
pub(crate) const SIGMAS: f64 = 3.0;
/// Factor by which ellipsoids of tracks known to within [`ENLARGED_UP_TO_M`] are drawn too large,
/// as the legend says: five centimetres are less than a point of the screen in a site of 100 m.
/// With half of it their half axes are of 2 m there and not of 4.5.
pub(crate) const ENLARGED: f64 = 30.0;
/// Standard deviation along the worst axis up to which an ellipsoid is enlarged, m: enlarged, one
/// of this size is as large as the site. With twice as much it would be twice as large as the site;
/// with half of it half axes shrink from 22 m to 0.75 m at that deviation.
pub(crate) const ENLARGED_UP_TO_M: f64 = 0.5;
/// An arrow's length is the distance flown in this time, s. With half of it the arrow of a target
/// at 5 m/s is hardly seen in a site of 100 m.
const ARROW_S: f64 = 1.0;

pub(crate) fn f32s(v: &Vector3<f64>) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}

/// A camera's pose.
fn transform(camera: &Camera) -> Transform3D {
    let matrix = camera.pose().rotation().matrix();
    let column = |i: usize| [matrix[(0, i)] as f32, matrix[(1, i)] as f32, matrix[(2, i)] as f32];
    let position = f32s(&camera.pose().position().coords);
    Transform3D::from_translation_mat3x3(position, [column(0), column(1), column(2)])
}

/// Draws the pose of a fixed camera, for all times.
pub(crate) fn fixed_pose(
    stream: &RecordingStream,
    name: &str,
    camera: &Camera,
) -> Result<(), ViewError> {
    Ok(stream.log_static(format!("world/cameras/{name}"), &transform(camera))?)
}

/// Draws the pose of a camera on a mount, from now on.
pub(crate) fn turned_pose(
    stream: &RecordingStream,
    name: &str,
    camera: &Camera,
) -> Result<(), ViewError> {
    Ok(stream.log(format!("world/cameras/{name}"), &transform(camera))?)
}

/// Draws a camera: its position, and a frustum whose image is scaled by `scale`.
pub(crate) fn camera(
    stream: &RecordingStream,
    name: &str,
    index: u64,
    camera: &Camera,
    scale: f64,
) -> Result<(), ViewError> {
    let position = f32s(&camera.pose().position().coords);
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
    let projection = PinholeProjection::from_focal_length_and_principal_point(
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

/// Sets name and colour of a camera's residual plot.
pub(crate) fn residual_plot(
    stream: &RecordingStream,
    name: &str,
    index: u64,
) -> Result<(), ViewError> {
    stream.log_static(
        format!("plots/residual/{name}"),
        &SeriesLines::new().with_names([name]).with_colors([colour::of(index)]),
    )?;
    Ok(())
}

/// Draws the sight lines of a frame, `reach_m` long.
pub(crate) fn bearings(
    stream: &RecordingStream,
    frame: &BearingFrame,
    index: u64,
    camera: &Camera,
    reach_m: f64,
) -> Result<(), ViewError> {
    let measured =
        |track: &&BearingTrack| track.state() == crossfix_message::ImageTrackState::Tracking;
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
    Ok(())
}

pub(crate) fn tint(track: &Track) -> Color {
    match track.state() {
        TrackState::Confirmed => colour::of_track(track.id),
        _ => colour::of_unsure_track(track.id),
    }
}

/// Draws a track's trail.
pub(crate) fn trail(
    stream: &RecordingStream,
    track: &Track,
    trail: &[[f32; 3]],
) -> Result<(), ViewError> {
    let strip = LineStrips3D::new([trail.to_vec()])
        .with_colors([tint(track)])
        .with_radii([Radius::new_ui_points(1.5)]);
    Ok(stream.log(format!("world/tracks/{}/trail", track.id), &strip)?)
}

/// Draws a track: position, velocity and covariance.
pub(crate) fn track(stream: &RecordingStream, track: &Track) -> Result<(), ViewError> {
    let (Some(position), Some(velocity)) = (track.position, track.velocity) else {
        return Ok(());
    };
    let position: Point3<f64> = position.into();
    let velocity: Vector3<f64> = velocity.into();
    let place = f32s(&position.coords);
    let path = format!("world/tracks/{}", track.id);
    let tint = tint(track);
    let text = label(track, velocity.norm(), position.z);
    stream.log(
        format!("{path}/position"),
        &Points3D::new([place])
            .with_colors([tint])
            .with_labels([text])
            .with_show_labels(true)
            .with_radii([Radius::new_ui_points(2.0)]),
    )?;
    stream.log(
        format!("{path}/velocity"),
        &Arrows3D::from_vectors([f32s(&(velocity * ARROW_S))])
            .with_origins([place])
            .with_colors([tint])
            .with_radii([Radius::new_ui_points(1.5)]),
    )?;
    // A track that only one camera sees may be anywhere along its sight line, which is drawn
    // already.
    let ellipsoid = ellipsoid(track).filter(|_| track.state() != TrackState::OneCamera);
    let (half_axes, rotation): (Vec<_>, Vec<_>) = ellipsoid.into_iter().unzip();
    let centres = half_axes.iter().map(|_| place);
    stream.log(
        format!("{path}/covariance"),
        &Ellipsoids3D::from_centers_and_half_sizes(centres, half_axes.iter().copied())
            .with_quaternions(rotation)
            .with_fill_mode(FillMode::TransparentFillMajorWireframe)
            .with_colors([tint]),
    )?;
    Ok(())
}

/// Standard deviation of a track's position, m: the root of the sum of its three variances.
pub(crate) fn position_sd(track: &Track) -> f64 {
    let variance: f64 = (0..3).filter_map(|axis| track.covariance.get(7 * axis)).sum();
    variance.max(0.0).sqrt()
}

/// A bound on the standard deviation of a track's position across a line, m: the root of the sum of
/// its three variances, less the variance along the line.
pub(crate) fn across_sd(track: &Track, line: &Vector3<f64>) -> f64 {
    let length = line.norm();
    let of = |row: usize, column: usize| track.covariance.get(6 * row + column).unwrap_or(&0.0);
    // along = u' P u with u = line / |line|; across = sqrt(trace P - along)
    let along: f64 =
        (0..9).map(|k| of(k / 3, k % 3) * line[k / 3] * line[k % 3]).sum::<f64>() / length.powi(2);
    (position_sd(track).powi(2) - along).max(0.0).sqrt()
}

/// A track's label: its number, and its state or its height, speed and standard deviation.
fn label(track: &Track, speed: f64, height: f64) -> String {
    let number = TrackNumber(track.id);
    let what = match track.state() {
        TrackState::Tentative => return format!("{number}?"),
        TrackState::Coasting => "(coasting) ",
        TrackState::OneCamera => return format!("{number} (one camera)"),
        _ => "",
    };
    let sd = position_sd(track);
    format!("{number}  {what}{height:.0} m  {speed:.0} m/s  \u{b1}{sd:.2}")
}

/// Half axes and rotation of the ellipsoid of a track's position.
fn ellipsoid(track: &Track) -> Option<([f32; 3], Quaternion)> {
    let covariance: &[f64; 36] = track.covariance.as_slice().try_into().ok()?;
    ellipsoid_of(&Matrix3::from_fn(|row, column| covariance[6 * row + column]))
}

/// Half axes and rotation of a covariance's ellipsoid; the covariance is in m^2.
pub(crate) fn ellipsoid_of(covariance: &Matrix3<f64>) -> Option<([f32; 3], Quaternion)> {
    if !covariance.iter().all(|v| v.is_finite()) {
        return None;
    }
    let SymmetricEigen { eigenvalues, mut eigenvectors } = covariance.symmetric_eigen();
    // A rotation needs determinant +1: one eigenvector is turned round.
    if eigenvectors.determinant() < 0.0 {
        eigenvectors.column_mut(0).neg_mut();
    }
    let rotation = nalgebra::UnitQuaternion::from_matrix(&eigenvectors);
    let deviations = eigenvalues.map(|variance| variance.max(0.0).sqrt());
    let factor = if deviations.max() < ENLARGED_UP_TO_M { ENLARGED * SIGMAS } else { SIGMAS };
    let half = |i: usize| (factor * deviations[i]) as f32;
    let [x, y, z, w] = [rotation.i, rotation.j, rotation.k, rotation.w].map(|v| v as f32);
    Some(([half(0), half(1), half(2)], Quaternion::from_xyzw([x, y, z, w])))
}
