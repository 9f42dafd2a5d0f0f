use std::collections::BTreeMap;

use crossfix_message::Timestamp;
use nalgebra::Point3;
use rerun::RecordingStream;
use rerun_types::archetypes::{
    LineStrips3D, Points3D, Scalars, SeriesLines, TextDocument, ViewCoordinates,
};
use rerun_types::components::{Color, MediaType, Radius};

use crate::draw::f32s;
use crate::extent::BoundingBox;
use crate::paths::TIMELINE;
use crate::{ViewError, blueprint, colour, ground};

/// Colour of the true targets: white, as no run's.
const TRUTH: Color = Color(rerun_types::datatypes::Rgba32::from_rgb(240, 240, 240));
/// Longest gap between two places that are joined by a line, s: over a longer one the track was
/// lost. With half of it instants that are half a second apart are not joined.
const LONGEST_JOIN_S: f64 = 1.0;

/// A place of a target or track at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlaceInTime {
    /// When.
    pub time: Timestamp,
    /// Whose: a target of the truth, or a track of a run.
    pub id: u64,
    /// Where, world, m.
    pub place: Point3<f64>,
}

/// One of several runs over the same data.
#[derive(Clone, Debug, PartialEq)]
pub struct ComparedRun {
    /// Its name: the file's.
    pub name: String,
    /// Its tracks at the instants of the truth, in the order of time.
    pub tracks: Vec<PlaceInTime>,
}

/// Several runs over the same data: their tracks and the truth in space, and each track's distance
/// from the nearest target over time.
#[derive(Clone, Debug, PartialEq)]
pub struct ComparisonPicture {
    /// The truth, in the order of time.
    pub truth: Vec<PlaceInTime>,
    /// The runs.
    pub runs: Vec<ComparedRun>,
}

impl ComparisonPicture {
    /// Draws all of it on a stream of [`crate::save`], and waits until it is drawn.
    ///
    /// # Errors
    /// [`ViewError`] if the stream does not take it.
    pub fn draw(&self, stream: &RecordingStream) -> Result<(), ViewError> {
        stream.set_log_time_enabled(false);
        stream.log_static("world", &ViewCoordinates::RIGHT_HAND_Z_UP())?;
        draw_ways(stream, "world/truth", &self.truth, TRUTH)?;
        for (index, run) in self.runs.iter().enumerate() {
            let colour = colour::of(index as u64);
            draw_ways(stream, &format!("world/runs/{index}"), &run.tracks, colour)?;
            self.draw_errors(stream, index, run, colour)?;
        }
        let extent = BoundingBox::of(self.truth.iter().map(|at| at.place));
        ground::draw(stream, &extent)?;
        let legend = TextDocument::new(self.legend()).with_media_type(MediaType::markdown());
        stream.log_static("legend", &legend)?;
        blueprint::send_comparison(stream, &extent)?;
        stream.flush_blocking().map_err(|error| ViewError::Flush(error.to_string()))
    }

    /// Draws the distance of each of a run's tracks from the nearest target, m, over time.
    fn draw_errors(
        &self,
        stream: &RecordingStream,
        index: usize,
        run: &ComparedRun,
        colour: Color,
    ) -> Result<(), ViewError> {
        let path = format!("plots/error/{index}");
        let lines = SeriesLines::new().with_names([run.name.as_str()]).with_colors([colour]);
        stream.log_static(path.clone(), &lines)?;
        let mut targets: BTreeMap<Timestamp, Vec<Point3<f64>>> = BTreeMap::new();
        for at in &self.truth {
            targets.entry(at.time).or_default().push(at.place);
        }
        for at in &run.tracks {
            let distances = targets.get(&at.time).into_iter().flatten();
            let nearest = distances.map(|target| (target - at.place).norm()).reduce(f64::min);
            if let Some(nearest) = nearest {
                stream.set_timestamp_nanos_since_epoch(TIMELINE, at.time.nanos());
                stream.log(path.clone(), &Scalars::single(nearest))?;
            }
        }
        Ok(())
    }

    fn legend(&self) -> String {
        let runs = self.runs.iter().enumerate().map(|(index, run)| {
            let [r, g, b, _] = colour::of(index as u64).to_array();
            format!("- rgb {r} {g} {b}: {}\n", run.name)
        });
        format!(
            "**White**: where the targets were. **In a run's colour**: its tracks, and below how \
             far each of its answers is from the nearest target.\n\n{}",
            runs.collect::<String>()
        )
    }
}

/// Draws the trajectories of all targets or tracks, interrupted at gaps, and each place at its
/// time.
fn draw_ways(
    stream: &RecordingStream,
    path: &str,
    places: &[PlaceInTime],
    colour: Color,
) -> Result<(), ViewError> {
    let mut ways: BTreeMap<u64, Vec<PlaceInTime>> = BTreeMap::new();
    for at in places {
        ways.entry(at.id).or_default().push(*at);
    }
    let joined = |a: &PlaceInTime, b: &PlaceInTime| b.time.seconds_since(a.time) < LONGEST_JOIN_S;
    let strips = ways.values().flat_map(|way| way.chunk_by(joined));
    let strips: Vec<Vec<[f32; 3]>> =
        strips.map(|strip| strip.iter().map(|at| f32s(&at.place.coords)).collect()).collect();
    stream.log_static(
        format!("{path}/way"),
        &LineStrips3D::new(strips).with_colors([colour]).with_radii([Radius::new_ui_points(0.8)]),
    )?;
    for now in places.chunk_by(|a, b| a.time == b.time) {
        stream.set_timestamp_nanos_since_epoch(TIMELINE, now[0].time.nanos());
        let points = now.iter().map(|at| f32s(&at.place.coords));
        stream.log(
            format!("{path}/now"),
            &Points3D::new(points).with_colors([colour]).with_radii([Radius::new_ui_points(4.0)]),
        )?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_runs_are_drawn_to_a_file() {
        let at = |tenth: i64, id, x: f64| PlaceInTime {
            time: Timestamp::from_nanos(tenth * 100_000_000),
            id,
            place: Point3::new(x, tenth as f64, 30.0),
        };
        let run = |name: &str, off: f64| ComparedRun {
            name: name.to_owned(),
            tracks: (0..50).map(|tenth| at(tenth, 7, off)).collect(),
        };
        let picture = ComparisonPicture {
            truth: (0..50).map(|tenth| at(tenth, 1, 0.0)).collect(),
            runs: vec![run("a", 0.1), run("b", 0.2)],
        };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("both.rrd");
        picture.draw(&crate::save(&file).unwrap()).unwrap();
        assert!(std::fs::metadata(&file).unwrap().len() > 10_000);
    }
}
