//! Finds targets in a video, follows them, and prints where they are: what `crossfix track
//! --detect` does, in a page.
//!
//! ```text
//! cargo run --release -p crossfix-vision --example follow_video -- clip.mp4
//! ```
#![allow(clippy::print_stdout, reason = "a program that prints")]

use std::error::Error;
use std::path::PathBuf;

use crossfix_correlation::Plane;
use crossfix_video::FrameClock;
use crossfix_vision::{DetectorConfig, ImageTracker, TrackPhase, TrackerConfig};

fn main() -> Result<(), Box<dyn Error>> {
    let path = std::env::args_os().nth(1).map(PathBuf::from).ok_or("which video?")?;
    let mut video = crossfix_video::open(&path, FrameClock::default())?;
    let detector = Some(DetectorConfig::default());
    let mut tracker = ImageTracker::new(TrackerConfig { detector, ..TrackerConfig::default() })?;
    println!("frame,id,x,y,certainty");
    while let Some(frame) = video.next_frame()? {
        let image = Plane::new(frame.width, frame.height, frame.brightness())
            .ok_or("a frame without pixels")?;
        let tracks = tracker.step(&image, frame.capture.time);
        for track in tracks.iter().filter(|track| track.phase == TrackPhase::Tracking) {
            let place = track.position;
            let (id, certainty) = (track.id.0, track.certainty);
            println!("{},{id},{:.2},{:.2},{certainty:.3}", frame.index, place.x, place.y);
        }
    }
    Ok(())
}
