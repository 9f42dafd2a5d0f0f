//! A plan as a coloured volume.

use std::path::Path;

use anyhow::Context;
use crossfix_evaluation::bound::{CandidatePlace, Cell, PlannedCamera};
use crossfix_view::{DrawnPlace, VolumeCell, VolumePicture};
use nalgebra::Point3;

use super::report::{self, PlanReport};

fn legend(report: &PlanReport) -> String {
    let assumed = report::assumed(report).replace('\n', "\n\n");
    let conclusion = report::conclusion(report).unwrap_or_default();
    format!(
        "**Predicted SD of a target's position**\n\n\
         A cube is a cell with a fix, in the colours of the scale; bright is good. No cube: fewer \
         than two cameras see it. A layer can be switched off under `world/volume`.\n\n\
         The dots are places for one more camera, coloured by the median SD over the volume with \
         it; the best are named.\n\n{assumed}\n\n**{conclusion}**"
    )
}

fn landmark(report: &PlanReport, candidate: &CandidatePlace) -> DrawnPlace {
    let rank = report.best.iter().position(|best| best == candidate);
    let sd = candidate.score.median_sd_m;
    DrawnPlace {
        place: Point3::from(candidate.position_m),
        sd_m: sd,
        label: rank.map(|rank| format!("choice {}: {sd:.3} m", rank + 1)),
    }
}

/// A cell of the volume, if it has a fix.
fn cell(cell: &Cell) -> Option<VolumeCell> {
    let sd_m = cell.accuracy.as_ref()?.position_sd_m;
    Some(VolumeCell { centre: Point3::from(cell.centre_m), sd_m })
}

/// Writes the picture to a file.
pub fn draw(report: &PlanReport, cameras: &[PlannedCamera], path: &Path) -> anyhow::Result<()> {
    let candidates = report.advice.iter().flat_map(|advice| &advice.candidates);
    let picture = VolumePicture {
        cameras: cameras.iter().map(|planned| (planned.name.clone(), &planned.camera)).collect(),
        cells: report.cells.iter().filter_map(cell).collect(),
        side_m: report.step_m,
        landmarks: candidates.map(|candidate| landmark(report, candidate)).collect(),
        legend: legend(report),
    };
    picture.draw(&crossfix_view::save(path)?).context("the picture is not complete")
}
