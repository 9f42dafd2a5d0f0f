//! The figures of the README, on real data.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crossfix_message::{BearingFrame, Channel, TruthFrame, decode};
use crossfix_tests::video::{Finds, labels, off};
use crossfix_tests::{FollowedRow, followed_rows, messages, real_data, succeed};

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
    let arguments =
        ["import", "drone-tracking-datasets", &source, "--dataset", "3", "--cameras", &names];
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

    succeed(&[
        "export",
        &path("tracks.mcap"),
        "--csv",
        &path("tracks.csv"),
        "--times",
        &path("times.csv"),
    ]);
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
        let wanted =
            rows.iter().flat_map(|row| row.as_array().unwrap()).map(|b| b.as_f64().unwrap());
        let wanted: Vec<f64> = wanted.collect();
        assert_eq!(canvas.len(), wanted.len());
        for (drawn, wanted) in canvas.iter().zip(wanted) {
            assert!(
                (f64::from(*drawn) - wanted).abs() < 0.01,
                "{width}x{height}: {drawn} for {wanted}"
            );
        }
    }
}

fn track(clip: &Path, arguments: &[&str]) -> Vec<FollowedRow> {
    let folder = tempfile::tempdir().unwrap();
    let table = folder.path().join("out.csv").display().to_string();
    let video = clip.display().to_string();
    succeed(&[&["track", &video, "--csv", &table], arguments].concat());
    followed_rows(Path::new(&table))
}

/// Follows a clip from its first labelled box on; returns the frames within 10 px, and those
/// labelled.
fn followed(clip: &Path) -> (usize, usize) {
    let labels = labels(clip);
    let (first, [x, y, w, h]) = labels.first_key_value().unwrap();
    let rows = track(clip, &["--from", &first.to_string(), "--box", &format!("{x},{y},{w},{h}")]);
    let is_near = |row: &&FollowedRow| {
        let off = labels.get(&row.frame).and_then(|label| off(row, *label));
        row.ok == 1 && off.is_some_and(|[x, y]| x.hypot(y) <= 10.0)
    };
    (rows.iter().filter(is_near).count(), labels.len())
}

/// The clips of a set.
fn clips(data: &Path, folder: &str, prefix: &str) -> Vec<PathBuf> {
    let mut clips: Vec<PathBuf> = std::fs::read_dir(data.join(folder))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "mp4"))
        .filter(|path| path.file_name().unwrap().to_str().unwrap().starts_with(prefix))
        .collect();
    clips.sort();
    clips
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
        let clips = clips(&data, folder, prefix);
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

#[test]
fn drones_are_found_in_real_video_without_a_box() {
    let Some(data) = real_data() else { return };
    // Most of the tracks elsewhere in visible video are of cars.
    for (prefix, found, boxes, tracks) in
        [("IR_DRONE", 0.90, 0.05, 2.0), ("V_DRONE", 0.80, 0.2, 2.0)]
    {
        let mut finds = Finds::default();
        for clip in clips(&data, "svanstrom-drone-video", prefix) {
            let rows = track(&clip, &["--detect"]);
            let frames = rows.last().map_or(0, |row| row.frame + 1);
            finds.add(&labels(&clip), &rows, frames);
        }
        println!("{prefix}: {finds:?}");
        let [share, elsewhere, a_minute] =
            [finds.share(), finds.boxes_a_frame(), finds.tracks_a_minute()];
        assert!(share >= found, "{prefix}: {share:.3} of the frames within 10 px");
        assert!(elsewhere <= boxes, "{prefix}: {elsewhere:.3} boxes a frame elsewhere");
        assert!(a_minute <= tracks, "{prefix}: {a_minute:.1} tracks a minute elsewhere");
    }
}
