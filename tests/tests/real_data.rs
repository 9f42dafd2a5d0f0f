//! The figures of the README, on real data.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crossfix_message::{BearingFrame, Channel, TruthFrame, decode};
use crossfix_tests::{messages, real_data, succeed};

/// Whether a camera had a label just before and just after a time: `times` are those of its labels.
fn brackets(times: &[f64], t: f64, interval: f64) -> bool {
    let after = times.partition_point(|time| *time < t);
    after > 0 && after < times.len() && times[after] - times[after - 1] < 1.7 * interval
}

#[test]
fn three_cameras_follow_the_drone_of_the_drone_tracking_datasets() {
    let Some(data) = real_data() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let source = data.join("eth-multiview-drone").display().to_string();
    let cameras = [("gopro3", 1.0 / 59.94), ("sony5100", 1.0 / 29.97), ("sonyG", 1.0 / 50.0)];
    let names = cameras.map(|(name, _)| name).join(",");
    let arguments = ["import", "drone-tracking-datasets", &source, "--dataset", "3", "--cameras", &names];
    succeed(&[&arguments[..], &["-o", &path("half.mcap")]].concat());
    succeed(&["-q", "replay", &path("half.mcap"), "--fuse", "-o", &path("tracks.mcap")]);

    // The instants that must be answered: all three cameras see the drone.
    let half = Path::new(folder.path()).join("half.mcap");
    let mut labels: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for entry in messages(&half, |channel| matches!(channel, Channel::Bearings(_))) {
        let frame: BearingFrame = decode(&entry.data).unwrap();
        if !frame.tracks.is_empty() {
            labels.entry(frame.camera).or_default().push(entry.data_time.seconds());
        }
    }
    let mut truth: BTreeMap<i64, [f64; 3]> = BTreeMap::new();
    let mut times = String::from("t\n");
    for entry in messages(&half, |channel| *channel == Channel::Truth) {
        let t = entry.data_time.seconds();
        if cameras.iter().all(|(name, interval)| brackets(&labels[*name], t, *interval)) {
            let frame: TruthFrame = decode(&entry.data).unwrap();
            let p = frame.targets[0].position.unwrap();
            truth.insert((t * 1e6).round() as i64, [p.x, p.y, p.z]);
            times += &format!("{t:.6}\n");
        }
    }
    std::fs::write(path("times.csv"), times).unwrap();
    assert!((410..=430).contains(&truth.len()), "{} instants", truth.len());

    succeed(&["export", &path("tracks.mcap"), "--csv", &path("tracks.csv"), "--times", &path("times.csv")]);
    let mut best: BTreeMap<i64, f64> = BTreeMap::new();
    let mut rows = 0;
    for row in csv::Reader::from_path(path("tracks.csv")).unwrap().deserialize() {
        let (t, _, x, y, z, ..): (f64, u64, f64, f64, f64, f64, f64, f64) = row.unwrap();
        let key = (t * 1e6).round() as i64;
        let [tx, ty, tz] = truth[&key];
        let square = (x - tx).powi(2) + (y - ty).powi(2) + (z - tz).powi(2);
        let slot = best.entry(key).or_insert(f64::INFINITY);
        *slot = slot.min(square);
        rows += 1;
    }
    let coverage = best.len() as f64 / truth.len() as f64;
    let rmse = (best.values().sum::<f64>() / best.len() as f64).sqrt();
    let extra = (rows - best.len()) as f64 / truth.len() as f64;
    assert!(rmse <= 0.114, "position RMSE {rmse:.4} m");
    assert!(coverage >= 0.99, "coverage {coverage:.4}");
    assert!(extra <= 0.01, "{extra:.4} extra tracks an instant");
}

#[test]
fn silhouettes_are_those_of_the_reference() {
    let Some(data) = real_data() else { return };
    let text = std::fs::read_to_string(data.join("templates/templates.json")).unwrap();
    let templates: serde_json::Value = serde_json::from_str(&text).unwrap();
    for [width, height] in crossfix_simulation::TEMPLATE_SIZES {
        let template = &templates[format!("{width}x{height}")];
        let margin = template["margin"].as_u64().unwrap() as usize;
        let canvas = crossfix_simulation::Silhouette::new(width, height).canvas(margin);
        let rows = template["image"].as_array().unwrap();
        let wanted = rows.iter().flat_map(|row| row.as_array().unwrap()).map(|b| b.as_f64().unwrap());
        let wanted: Vec<f64> = wanted.collect();
        assert_eq!(canvas.len(), wanted.len());
        for (drawn, wanted) in canvas.iter().zip(wanted) {
            assert!((f64::from(*drawn) - wanted).abs() < 0.01, "{width}x{height}: {drawn} for {wanted}");
        }
    }
}

/// Follows a clip from its first labelled box on; returns the frames within 10 px, and those labelled.
fn followed(clip: &Path) -> (usize, usize) {
    let mut labels: BTreeMap<u64, [f64; 4]> = BTreeMap::new();
    for row in csv::Reader::from_path(clip.with_extension("csv")).unwrap().deserialize() {
        let (frame, x, y, w, h): (u64, Option<f64>, Option<f64>, Option<f64>, Option<f64>) = row.unwrap();
        if let (Some(x), Some(y), Some(w), Some(h)) = (x, y, w, h) {
            labels.insert(frame, [x, y, w, h]);
        }
    }
    let [x, y, w, h] = labels[labels.keys().next().unwrap()];
    let folder = tempfile::tempdir().unwrap();
    let table = folder.path().join("out.csv").display().to_string();
    let video = clip.display().to_string();
    succeed(&["track", &video, "--box", &format!("{x},{y},{w},{h}"), "--csv", &table]);
    let mut near = 0;
    for row in csv::Reader::from_path(&table).unwrap().deserialize() {
        let (frame, x, y, w, h, _, _): (u64, f64, f64, f64, f64, u8, f64) = row.unwrap();
        let Some([tx, ty, tw, th]) = labels.get(&frame) else { continue };
        let error = (x + w / 2.0 - tx - tw / 2.0).hypot(y + h / 2.0 - ty - th / 2.0);
        near += usize::from(error <= 10.0);
    }
    (near, labels.len())
}

#[test]
fn drones_are_followed_in_real_video() {
    let Some(data) = real_data() else { return };
    let sets = [
        ("svanstrom-drone-video", "IR_DRONE", 15, 0.98),
        ("svanstrom-drone-video", "V_DRONE", 15, 0.90),
        ("anti-uav-ir-video", "", 4, 0.85),
    ];
    for (folder, prefix, count, wanted) in sets {
        let mut clips: Vec<PathBuf> = std::fs::read_dir(data.join(folder))
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .filter(|path| path.extension().is_some_and(|e| e == "mp4"))
            .filter(|path| path.file_name().unwrap().to_str().unwrap().starts_with(prefix))
            .collect();
        clips.sort();
        assert_eq!(clips.len(), count, "{folder} {prefix}");
        let (mut near, mut labelled) = (0, 0);
        for clip in clips {
            let (n, of) = followed(&clip);
            println!("{}: {:.1} %", clip.display(), 100.0 * n as f64 / of as f64);
            near += n;
            labelled += of;
        }
        let share = near as f64 / labelled as f64;
        assert!(share >= wanted, "{folder} {prefix}: {share:.3} of the frames within 10 px");
    }
}
