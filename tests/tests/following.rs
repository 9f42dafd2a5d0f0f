//! `crossfix track` as its user meets it: several targets, a later beginning, the table's columns.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::path::Path;

use crossfix_tests::{FollowedRow, crossfix, followed_rows, succeed};

/// Width of the images, pixels.
const WIDTH: usize = 320;
/// Height of the images, pixels.
const HEIGHT: usize = 240;
/// Frame rate of the video.
const RATE_HZ: f64 = 25.0;

/// Where two spots are in a frame: the first from the beginning, the second from frame 30 on.
fn places(frame: u64) -> [[f64; 2]; 2] {
    let t = frame as f64;
    [[40.0 + 2.0 * t, 60.0], [290.0 - 2.0 * t, 150.0 + 0.5 * t]]
}

/// A video of two spots over ground that does not change, with noise.
fn video(path: &Path, frames: u64) {
    let mut bytes = format!("YUV4MPEG2 W{WIDTH} H{HEIGHT} F25:1 Cmono\n").into_bytes();
    let mut state = 1_u32;
    for frame in 0..frames {
        bytes.extend_from_slice(b"FRAME\n");
        let [first, second] = places(frame);
        for y in 0..HEIGHT {
            for x in 0..WIDTH {
                state ^= state << 13;
                state ^= state >> 17;
                state ^= state << 5;
                let spot = |[cx, cy]: [f64; 2]| {
                    let (u, v) = ((x as f64 - cx) / 3.5, (y as f64 - cy) / 2.5);
                    90.0 * (-0.5 * (u * u + v * v)).exp()
                };
                let ground = 8.0 * (x as f64 * 0.3).sin() * (y as f64 * 0.2).cos();
                let second = if frame >= 30 { spot(second) } else { 0.0 };
                let noise = f64::from(state >> 24) / 64.0;
                bytes.push((100.0 + ground + noise + spot(first) + second) as u8);
            }
        }
    }
    std::fs::write(path, bytes).unwrap();
}

fn is_at(row: &FollowedRow, [x, y]: [f64; 2]) -> bool {
    row.middle().is_some_and(|[cx, cy]| (cx - 0.5 - x).hypot(cy - 0.5 - y) < 3.0)
}

#[test]
fn what_moves_is_found_and_has_a_row_in_every_frame() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    video(&folder.path().join("a.y4m"), 80);
    succeed(&[
        "track",
        &path("a.y4m"),
        "--detect",
        "--csv",
        &path("a.csv"),
        "--save",
        &path("a.rrd"),
    ]);
    assert!(folder.path().join("a.rrd").metadata().unwrap().len() > 10_000);

    let rows = followed_rows(&folder.path().join("a.csv"));
    let of = |id: u64| rows.iter().filter(move |row| row.id == Some(id));
    assert_eq!(rows.iter().filter_map(|row| row.id).max(), Some(2), "two targets and no third");
    for (id, from) in [(1, 15), (2, 43)] {
        let frames: Vec<u64> = of(id).map(|row| row.frame).collect();
        assert!(frames[0] <= from && frames.iter().copied().eq(frames[0]..80), "{id}: {frames:?}");
        assert!(of(id).all(|row| is_at(row, places(row.frame)[id as usize - 1])), "{id}");
    }
    for row in of(1).filter(|row| row.frame >= 40) {
        let (vx, vy) = (row.vx.unwrap(), row.vy.unwrap());
        assert!((vx - 2.0 * RATE_HZ).abs() < 12.0 && vy.abs() < 12.0, "{row:?}");
        assert!(
            row.certainty.unwrap() > 0.9 && row.sd_x.unwrap() < 0.5 && row.sd_y.unwrap() > 0.0,
            "{row:?}"
        );
    }
    // Frames without a target have a row without a box.
    assert!(
        rows[0].id.is_none() && rows[0].x.is_none() && rows[0].ok == 0 && rows[0].frame == 0,
        "{:?}",
        rows[0]
    );
}

#[test]
fn boxes_are_numbered_in_their_order_from_a_later_frame_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    video(&folder.path().join("a.y4m"), 60);
    let boxes = places(35).map(|[x, y]| format!("{},{},12,9", x - 5.5, y - 4.0));
    let [one, two] = &boxes;
    succeed(&[
        "track",
        &path("a.y4m"),
        "--from",
        "35",
        "--box",
        two,
        "--box",
        one,
        "--csv",
        &path("a.csv"),
    ]);
    let rows = followed_rows(&folder.path().join("a.csv"));
    assert_eq!(rows.len(), 2 * 25);
    for (row, (frame, id)) in rows.iter().zip((35..60).flat_map(|frame| [(frame, 1), (frame, 2)])) {
        assert_eq!((row.frame, row.id, row.ok), (frame, Some(id), 1));
        assert!(is_at(row, places(frame)[2 - id as usize]), "{row:?}");
    }

    let output = crossfix(&["track", &path("a.y4m"), "--from", "60", "--csv", &path("b.csv")]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("has 60 frames, counted from 0: there is no frame 60"), "{said}");
    assert!(!folder.path().join("b.csv").exists());
}
