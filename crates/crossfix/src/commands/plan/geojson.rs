//! A plan as a map: GeoJSON (RFC 7946), WGS84.

use crossfix_evaluation::bound::{CandidatePlace, Cell, PlannedCamera};
use crossfix_geometry::{Geodetic, LocalFrame};
use nalgebra::Point3;
use serde_json::{Value, json};

use super::report::PlanReport;

/// An RFC 7946 position: longitude and latitude in degrees, rounded to the millimetre.
fn position(frame: &LocalFrame, point: Point3<f64>) -> [f64; 2] {
    let place = frame.geodetic(point);
    [place.longitude_deg(), place.latitude_deg()].map(|degrees| (degrees * 1e8).round() / 1e8)
}

fn feature(geometry: &Value, properties: &Value) -> Value {
    json!({ "type": "Feature", "geometry": geometry, "properties": properties })
}

fn point(frame: &LocalFrame, place: Point3<f64>, properties: &Value) -> Value {
    feature(&json!({ "type": "Point", "coordinates": position(frame, place) }), properties)
}

/// A cell's outline, anticlockwise from the south-west and closed, with the predictions for it.
fn cell(frame: &LocalFrame, cell: &Cell, step_m: f64, cameras: &[PlannedCamera]) -> Value {
    let [x, y, z] = cell.centre_m;
    let half = 0.5 * step_m;
    let corners = [(-half, -half), (half, -half), (half, half), (-half, half), (-half, -half)];
    let ring = corners.map(|(east, north)| position(frame, Point3::new(x + east, y + north, z)));
    let names: Vec<&str> = cell
        .cameras
        .iter()
        .filter_map(|index| cameras.get(*index))
        .map(|c| c.name.as_str())
        .collect();
    let accuracy = cell.accuracy.as_ref();
    let properties = json!({
        "kind": "cell",
        "altitude_m": z,
        "height_m": frame.geodetic(Point3::new(x, y, z)).height(),
        "cameras": names.len(),
        "camera_names": names.join(" "),
        "position_sd_m": accuracy.map(|a| a.position_sd_m),
        "worst_axis_sd_m": accuracy.map(|a| a.worst_axis_sd_m),
        "velocity_sd_mps": accuracy.map(|a| a.velocity_sd_mps),
        "degenerate": accuracy.map(|a| a.is_degenerate()),
    });
    feature(&json!({ "type": "Polygon", "coordinates": [ring] }), &properties)
}

/// The cells, layer by layer, the cameras, and the candidate places for one more camera.
pub fn collection(report: &PlanReport, cameras: &[PlannedCamera], anchor: Geodetic) -> Value {
    let frame = LocalFrame::at(anchor);
    let mut features: Vec<Value> =
        report.cells.iter().map(|one| cell(&frame, one, report.step_m, cameras)).collect();
    features.extend(cameras.iter().map(|camera| {
        let properties = json!({ "kind": "camera", "name": camera.name });
        point(&frame, camera.camera.pose().position(), &properties)
    }));
    let candidates = report.advice.iter().flat_map(|advice| &advice.candidates).enumerate();
    features.extend(candidates.map(|(index, one)| candidate(&frame, index + 1, one)));
    json!({ "type": "FeatureCollection", "features": features })
}

/// A place for one more camera; the best has rank 1.
fn candidate(frame: &LocalFrame, rank: usize, place: &CandidatePlace) -> Value {
    let properties = json!({
        "kind": "candidate",
        "rank": rank,
        "median_position_sd_m": place.score.median_sd_m,
        "share_with_a_fix": place.score.fixed,
    });
    point(frame, place.position_m.into(), &properties)
}
