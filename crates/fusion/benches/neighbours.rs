//! What it costs an area's fusion centre to have neighbours: a second in which each of two says so
//! many targets 90 times, as by three cameras of 30 Hz that all see them, half of them in the strip
//! that both see.
//!
//! `cargo bench -p crossfix-fusion --bench neighbours`

#![allow(clippy::unwrap_used, reason = "a benchmark that cannot set itself up has failed")]

use crossfix_fusion::{FusionConfig, Neighbours, Output, Share};
use crossfix_message::{Timestamp, Track, TrackFrame, TrackState, Vector3};
use divan::Bencher;

fn main() {
    divan::main();
}

/// Targets on a grid of 100 m; those from `first` on, as a centre says them at a time.
fn said(first: usize, count: usize, seconds: f64, off_m: f64) -> TrackFrame {
    let track = |index: usize| {
        let mut covariance = vec![0.0; 36];
        (0..6).for_each(|axis| covariance[axis * 7] = 1.0);
        let [column, row] = [index % 30, index / 30];
        Track {
            id: index as u64 + 1,
            state: TrackState::Confirmed.into(),
            position: Some(Vector3 {
                x: 100.0 * column as f64 + 10.0 * seconds,
                y: 100.0 * row as f64 + off_m,
                z: 50.0,
            }),
            velocity: Some(Vector3 { x: 10.0, y: 0.0, z: 0.0 }),
            covariance,
            ..Default::default()
        }
    };
    TrackFrame {
        time_ns: Timestamp::from_seconds(1000.0 + seconds).nanos(),
        tracks: (first..first + count).map(track).collect(),
        ..Default::default()
    }
}

#[divan::bench(args = [10, 100, 1000])]
fn a_second_of_so_many_targets(bencher: Bencher, targets: usize) {
    let frames = |first: usize, off_m: f64| {
        (0..90).map(|k| said(first, targets, f64::from(k) / 90.0, off_m)).collect::<Vec<_>>()
    };
    let [ours, theirs] = [frames(0, 0.0), frames(targets / 2, 0.5)];
    let share = Share { index: 0, of: 2 };
    bencher
        .with_inputs(|| (Neighbours::new(share, &FusionConfig::default()), ours.clone()))
        .bench_values(|(mut neighbours, ours)| {
            for (ours, theirs) in ours.into_iter().zip(&theirs) {
                neighbours.receive(1, theirs);
                divan::black_box(neighbours.forward(vec![Output::Tracks(ours)]));
            }
        });
}
