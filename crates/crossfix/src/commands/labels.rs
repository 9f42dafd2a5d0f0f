//! Tables of labels: where a video's target truly is.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Context;
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
        let number = |column: usize| record.get(column)?.trim().parse::<f64>().ok();
        if let [Some(frame), Some(x), Some(y), Some(width), Some(height)] = columns.map(number) {
            labels.insert(frame as u64, PixelBox { x, y, width, height });
        }
    }
    Ok(labels)
}
