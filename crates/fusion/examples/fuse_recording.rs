//! Fuses the bearings of a recording and prints each track that comes to be and ends, without a
//! network: what `crossfix replay --fuse` does, in a page.
//!
//! ```text
//! cargo run --release -p crossfix-fusion --example fuse_recording -- recordings/two-uavs.mcap
//! ```
#![allow(clippy::print_stdout, reason = "a program that prints")]

use std::error::Error;
use std::path::PathBuf;

use crossfix_fusion::{Fusion, FusionConfig, Output};
use crossfix_message::{
    BearingFrame, CameraCalibration, Channel, DecodeError, TrackNumber, decode,
};
use crossfix_recording::{Entry, RecordingReader};

fn main() -> Result<(), Box<dyn Error>> {
    let path = std::env::args_os().nth(1).map(PathBuf::from).ok_or("which recording (MCAP)?")?;
    let mut fusion = Fusion::new(FusionConfig::default())?;
    RecordingReader::open(&path)?.for_each(|entry| {
        say(&take(&mut fusion, &entry)?);
        Ok::<_, DecodeError>(())
    })?;
    // What still waits for slower cameras.
    say(&fusion.flush());
    for track in fusion.tracks().filter(|track| track.is_confirmed()) {
        let (place, velocity) = (track.state().position(), track.state().velocity());
        let speed = velocity.norm();
        println!("at the end ({:.2}, {:.2}, {:.2}) m, {speed:.2} m/s", place.x, place.y, place.z);
    }
    Ok(())
}

/// Gives the fusion a message of the recording; messages that are not its input are passed over.
fn take(fusion: &mut Fusion, entry: &Entry) -> Result<Vec<Output>, DecodeError> {
    match &entry.key.channel {
        Channel::Calibration(camera) => {
            let calibration: CameraCalibration = decode(&entry.data)?;
            if let Err(error) = fusion.calibrate(&calibration) {
                println!("camera {camera} is not used: {error}");
            }
            Ok(Vec::new())
        }
        Channel::Bearings(_) => Ok(fusion.ingest(&decode::<BearingFrame>(&entry.data)?)),
        _ => Ok(Vec::new()),
    }
}

fn say(outputs: &[Output]) {
    for output in outputs {
        match output {
            Output::Event(event) => {
                let seconds = event.time_ns as f64 * 1e-9;
                let track = TrackNumber(event.track_id);
                println!("{seconds:.3} s: track {track} {}", event.kind().as_str_name());
            }
            Output::Camera(camera, standing) => println!("camera {camera}: {standing:?}"),
            // Positions of every exposure, and bearings of no use: more than one wants to read.
            Output::Tracks(_) | Output::Smoothed(_) | Output::Cues(_) | Output::Rejected(_) => {}
        }
    }
}
