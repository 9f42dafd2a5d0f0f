//! What a track costs when it goes on and on: no memory, and no drift.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]
#![allow(unsafe_code, reason = "an allocator is unsafe by its nature; this one only counts")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_vision::{
    ImageTracker, ImmConfig, PixelBox, ReferenceStrategy, TrackPhase, TrackerConfig,
};

/// The system's allocator, counting what each thread asks of it.
struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// Frames of a closed path.
const ROUND: usize = 60;

fn place(frame: usize) -> (f64, f64) {
    let angle = frame as f64 / ROUND as f64 * std::f64::consts::TAU;
    (80.0 + 20.0 * angle.cos(), 60.0 + 20.0 * angle.sin())
}

fn pictures() -> Vec<Plane> {
    let mut state = 1_u32;
    (0..ROUND)
        .map(|frame| {
            let (x, y) = place(frame);
            Plane::from_fn(160, 120, |column, row| {
                state ^= state << 13;
                state ^= state >> 17;
                state ^= state << 5;
                let (u, v) = ((column as f64 - x) / 3.0, (row as f64 - y) / 2.0);
                90.0 + (state >> 24) as f32 / 16.0 + 80.0 * (-0.5 * (u * u + v * v)).exp() as f32
            })
        })
        .collect()
}

#[test]
fn a_track_allocates_nothing() {
    for reference in
        [ReferenceStrategy::default(), ReferenceStrategy::PixelImm(ImmConfig::default())]
    {
        let pictures = pictures();
        let mut tracker =
            ImageTracker::new(TrackerConfig { reference, ..TrackerConfig::default() }).unwrap();
        tracker.take_up(PixelBox { x: 95.0, y: 57.0, width: 11.0, height: 7.0 });
        let mut step = |frame: usize| {
            let time = Timestamp::from_seconds(frame as f64 / 30.0);
            tracker.step(&pictures[frame % ROUND], time)[0].phase
        };
        for frame in 0..4 * ROUND {
            step(frame);
        }
        let before = ALLOCATIONS.with(Cell::get);
        for frame in 4 * ROUND..8 * ROUND {
            assert_eq!(step(frame), TrackPhase::Tracking);
        }
        assert_eq!(ALLOCATIONS.with(Cell::get) - before, 0, "{reference:?}");
    }
}

#[test]
fn ten_minutes_leave_the_reference_where_it_was() {
    let pictures = pictures();
    let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
    tracker.take_up(PixelBox { x: 95.0, y: 57.0, width: 11.0, height: 7.0 });
    let mut last = None;
    for frame in 0..18_000 {
        let time = Timestamp::from_seconds(frame as f64 / 30.0);
        last = tracker.step(&pictures[frame % ROUND], time).first().copied();
    }
    let (track, (x, y)) = (last.unwrap(), place(17_999));
    assert_eq!(track.phase, TrackPhase::Tracking);
    assert!((track.position.x - x).hypot(track.position.y - y) < 0.1, "{track:?}");
    assert!((track.width / 11.0 - 1.0).abs() < 0.1, "{track:?}");
}
