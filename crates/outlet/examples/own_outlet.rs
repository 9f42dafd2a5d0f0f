//! An outlet of one's own: one line of text per target, for whoever reads lines.
//!
//! `cargo run -p crossfix-outlet --example own_outlet`

#![allow(clippy::print_stdout, reason = "an example shows what it does")]

use std::error::Error;

use crossfix_geometry::Geodetic;
use crossfix_message::{Timestamp, Track, TrackEvent, TrackFrame, TrackState, Vector3};
use crossfix_outlet::{Outlet, Situation, Snapshot};

/// `seconds number latitude longitude height +- sd`.
struct Lines;

impl Outlet for Lines {
    fn tracks(&mut self, snapshot: &Snapshot) -> Vec<Vec<u8>> {
        let line = |target: &crossfix_outlet::Target| {
            format!(
                "{:.1} {} {:.6} {:.6} {:.1} +- {:.1}\n",
                snapshot.time.seconds(),
                target.number(),
                target.place.latitude_deg(),
                target.place.longitude_deg(),
                target.place.height(),
                target.place_sd_m().norm(),
            )
        };
        snapshot.targets.iter().map(|target| line(target).into_bytes()).collect()
    }

    fn event(&mut self, event: &TrackEvent) -> Vec<Vec<u8>> {
        vec![format!("track {} {}\n", event.track_id, event.kind().as_str_name()).into_bytes()]
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let anchor = Geodetic::from_degrees(48.3538, 11.7861, 490.0)?;
    let mut situation = Situation::new("airfield".parse()?, anchor);
    let mut outlet = Lines;
    for second in 0..3 {
        situation.add_tracks(
            None,
            &TrackFrame {
                time_ns: Timestamp::from_seconds(f64::from(second)).nanos(),
                tracks: vec![Track {
                    id: 1,
                    state: TrackState::Confirmed.into(),
                    position: Some(Vector3 { x: 12.0 * f64::from(second), y: 0.0, z: 50.0 }),
                    velocity: Some(Vector3 { x: 12.0, y: 0.0, z: 0.0 }),
                    covariance: (0..36).map(|k| if k % 7 == 0 { 0.01 } else { 0.0 }).collect(),
                    ..Default::default()
                }],
                ..Default::default()
            },
        );
        let snapshot = situation.snapshot(0.0).ok_or("nothing was heard")?;
        for message in outlet.tracks(&snapshot) {
            print!("{}", String::from_utf8_lossy(&message));
        }
    }
    Ok(())
}
