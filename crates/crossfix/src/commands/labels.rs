//! Tables of labels: where a video's target truly is.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, ensure};
use crossfix_vision::PixelBox;

/// The boxes of a table with the columns frame,x,y,w,h, by frame; a row without a box is a frame
/// without a target.
pub(crate) fn read_labels(path: &Path) -> anyhow::Result<BTreeMap<u64, PixelBox>> {
    let context = || format!("cannot read the labels in {}", path.display());
    let mut reader = csv::Reader::from_path(path).with_context(context)?;
    let headers = reader.headers().with_context(context)?.clone();
    let column = |name: &str| headers.iter().position(|header| header.trim() == name);
    let mut columns = [0; 5];
    for (place, name) in columns.iter_mut().zip(["frame", "x", "y", "w", "h"]) {
        *place = column(name).with_context(|| {
            format!("{} has no column `{name}`; it needs frame,x,y,w,h", path.display())
        })?;
    }
    let mut labels = BTreeMap::new();
    for record in reader.records() {
        let record = record.with_context(context)?;
        let cells = columns.map(|column| record.get(column).unwrap_or_default().trim());
        if cells[1..].iter().any(|cell| !cell.is_empty()) {
            let label = label(cells);
            let (frame, place) = label.with_context(|| {
                format!("{}: a row has frame,x,y,w,h = {}", path.display(), cells.join(","))
            })?;
            let is_first = labels.insert(frame, place).is_none();
            ensure!(is_first, "{}: frame {frame} has two boxes", path.display());
        }
    }
    Ok(labels)
}

/// A frame's number and the box in it.
fn label([frame, x, y, width, height]: [&str; 5]) -> anyhow::Result<(u64, PixelBox)> {
    let place =
        PixelBox { x: x.parse()?, y: y.parse()?, width: width.parse()?, height: height.parse()? };
    // NaN is not positive.
    let is_box = place.width > 0.0 && place.height > 0.0 && place.centre().is_possible();
    ensure!(is_box, "that is no box");
    Ok((frame.parse()?, place))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

    use super::*;

    #[test]
    fn rows_without_a_box_are_left_out_and_impossible_ones_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("labels.csv");
        let read = |rows: &str| {
            std::fs::write(&path, format!("frame,x,y,w,h\n{rows}")).unwrap();
            read_labels(&path)
        };
        let labels = read("0,1.5,2,10,6\n1,,,,\n2,3,4,10,6\n").unwrap();
        assert_eq!(labels.keys().copied().collect::<Vec<_>>(), [0, 2]);
        let frames = ["-1,1,2,10,6", "nan,1,2,10,6", "1e300,1,2,10,6", ",1,2,5,6"];
        let boxes = ["0,1,2,-5,6", "0,nan,2,5,6", "0,1,2,,6"];
        for wrong in frames.into_iter().chain(boxes) {
            let error = format!("{:#}", read(wrong).unwrap_err());
            assert!(error.contains(wrong), "{error}");
        }
        let twice = format!("{:#}", read("3,1,2,10,6\n3,1,2,10,6\n").unwrap_err());
        assert!(twice.contains("frame 3 has two boxes"), "{twice}");
    }
}
