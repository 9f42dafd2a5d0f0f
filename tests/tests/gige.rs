//! Industrial cameras that others have made, each in a network of its own.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a test that cannot set itself up has failed, and one that measures says what it found"
)]

use std::path::Path;

use crossfix_message::{BearingFrame, Channel, ClockSource, ImageTrackState, decode};
use crossfix_tests::{Site, alone, messages, program};

const CAMERAS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/peers/gige_cameras.py");
/// A lens for the camera's image.
const LENS: &str = "image_width: 512
image_height: 512
camera_matrix: {rows: 3, cols: 3, data: [600.0, 0.0, 255.5, 0.0, 600.0, 255.5, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.0, 0.0, 0.0, 0.0, 0.0]}
";

#[test]
fn a_dot_is_where_it_was_at_the_time_that_the_camera_says() {
    let site = Site::new(1.0);
    // It says that it exposes for 10 ms from its stamp on, and draws the dot of the stamp's time.
    let source = "kind = \"gige\"\naddress = \"127.0.0.1\"\nlatency_s = 0.0";
    site.write_camera("north", source, "");
    site.write("north.yaml", LENS);
    let commands = format!(
        "/usr/bin/python3 {CAMERAS} aravis > /dev/null & camera=$!
sleep 1.5
{program} record -c {network} -o {recording} > /dev/null & recorder=$!
{program} agent -c {agent} > /dev/null & agent=$!
sleep 12
kill $agent; wait $agent
kill $recorder; wait $recorder
kill $camera",
        program = program().display(),
        network = site.path("network.toml"),
        recording = site.path("live.mcap"),
        agent = site.path("north.toml"),
    );
    let needed = "/usr/bin/python3 -c 'import gi; gi.require_version(\"Aravis\", \"0.8\")'";
    if alone(needed, &commands).is_none() {
        return;
    }
    let of_camera = |channel: &Channel| *channel == Channel::Bearings("north".parse().unwrap());
    let entries = messages(Path::new(&site.path("live.mcap")), of_camera);
    let frames: Vec<BearingFrame> =
        entries.iter().map(|entry| decode(&entry.data).unwrap()).collect();
    assert!(frames.len() > 200, "{}", frames.len());
    assert!(frames.iter().all(|frame| frame.clock_source() == ClockSource::Host));
    // The dot is drawn at whole pixels below its place, so it is half a pixel beside it in the mean.
    let mut off: [Vec<f64>; 2] = Default::default();
    for frame in &frames {
        for track in frame.tracks.iter().filter(|t| t.state() == ImageTrackState::Tracking) {
            let seconds = frame.capture_time_ns as f64 * 1e-9;
            let place = [256.0 + 200.0 * seconds.cos(), 256.0 + 100.0 * seconds.sin()];
            off[0].push(track.pixel_x - place[0] + 0.5);
            off[1].push(track.pixel_y - place[1] + 0.5);
        }
    }
    for off in &mut off {
        off.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| off[(share * (off.len() - 1) as f64) as usize];
        println!("{} places, {:.2} {:.2} {:.2} px", off.len(), at(0.05), at(0.5), at(0.95));
        assert!(off.len() > 100, "{}", off.len());
        // A millisecond is a fifth of a pixel.
        assert!(at(0.5).abs() < 0.2 && at(0.05) > -0.8 && at(0.95) < 0.8, "{off:?}");
    }
}
