//! What whole sites cost: latency of each exposure, share of real time, memory; and beside it what
//! of the targets is found, so that speed is not bought with quality.
//!
//! `cargo bench -p crossfix-fusion --bench site` runs the short cases; names or parts of names
//! after `--` choose others, `all` runs everything: `cargo bench -p crossfix-fusion --bench site --
//! wide`.

#![allow(clippy::unwrap_used, reason = "a benchmark that cannot set itself up has failed")]
#![allow(clippy::print_stdout, reason = "a benchmark says what it has measured")]
#![allow(unsafe_code, reason = "an allocator is unsafe by its nature; this one only counts")]

use std::alloc::{GlobalAlloc, Layout as Memory, System};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use crossfix_fusion::{FusedTrack, Fusion, FusionConfig, Initiation, TrackId};
use crossfix_message::Timestamp;
use crossfix_simulation::{Layout, SimulatedSite, Site, SiteExposure, TargetState};

/// A track farther than this from every target that no nearer track has is false, m.
const MATCH_M: f64 = 5.0;
/// Quality is looked at this often, s.
const EPOCH_S: f64 = 0.5;
/// A target that fewer cameras see is not expected to be found.
const LEAST_CAMERAS: usize = 3;
/// The steady state begins this long after the first exposure, s.
const WARM_S: f64 = 5.0;
/// No case takes much longer than this, s; what is slower than that stops where it is.
const MAX_S: f64 = 60.0;

/// The system's allocator, counting the bytes that are held.
struct Counting;

static HELD: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

fn held(more: usize) {
    let now = HELD.fetch_add(more, Ordering::Relaxed) + more;
    PEAK.fetch_max(now, Ordering::Relaxed);
}

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Memory) -> *mut u8 {
        held(layout.size());
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Memory) {
        HELD.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// A case: its name, its site, the configuration, and whether it is run without being asked for.
struct Case {
    name: String,
    site: Site,
    config: FusionConfig,
    short: bool,
}

/// Latencies of a part of a run.
#[derive(Default)]
struct Latencies(Vec<f64>);

impl Latencies {
    fn line(&mut self, data_s: f64) -> String {
        self.0.sort_by(f64::total_cmp);
        let total: f64 = self.0.iter().sum();
        let at = |share: f64| {
            let index = (share * self.0.len() as f64) as usize;
            self.0.get(index.min(self.0.len().saturating_sub(1))).copied().unwrap_or(0.0) * 1e3
        };
        let mean = total / self.0.len().max(1) as f64 * 1e3;
        format!(
            "mean {mean:8.3}  p50 {:8.3}  p99 {:8.3}  max {:8.2} ms   {:6.3} s/s",
            at(0.5),
            at(0.99),
            at(1.0),
            total / data_s
        )
    }
}

/// What of the truth is found, summed over the epochs.
#[derive(Default)]
struct Quality {
    epochs: usize,
    expected: usize,
    found: usize,
    false_tracks: usize,
    /// Of the false tracks those that are near a target for how little they claim to know.
    unsure: usize,
    switches: usize,
    square_m2: f64,
    matched: usize,
    owners: BTreeMap<u64, TrackId>,
    /// When nine of ten expected targets were first found together, s.
    settled_s: Option<f64>,
}

impl Quality {
    /// Compares the confirmed tracks with the truth at a time: the nearest pairs first.
    fn look(&mut self, site: &SimulatedSite, fusion: &Fusion, t: f64, counts: bool) {
        let now = Timestamp::from_seconds(t);
        let tracks: Vec<&FusedTrack> =
            fusion.tracks().filter(|track| track.is_confirmed()).collect();
        let truth: Vec<TargetState> = site.truth(t).collect();
        let mut pairs = Vec::new();
        for (i, track) in tracks.iter().enumerate() {
            let state = track.state();
            let place = state.position() + state.velocity() * now.seconds_since(track.updated_at);
            for (k, target) in truth.iter().enumerate() {
                let apart = (place - target.position).norm();
                if apart < MATCH_M {
                    pairs.push((apart, i, k));
                }
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut target_of: Vec<Option<usize>> = vec![None; tracks.len()];
        let mut found = vec![false; truth.len()];
        for (apart, i, k) in pairs {
            if target_of[i].is_none() && !found[k] {
                (target_of[i], found[k]) = (Some(k), true);
                let old = self.owners.insert(truth[k].id, tracks[i].id);
                if counts {
                    self.square_m2 += apart * apart;
                    self.matched += 1;
                    self.switches += usize::from(old.is_some_and(|old| old != tracks[i].id));
                }
            }
        }
        let fair = |k: &usize| site.cameras_that_see(truth[*k].position) >= LEAST_CAMERAS;
        let expected: Vec<usize> = (0..truth.len()).filter(fair).collect();
        let reached = expected.iter().filter(|&&k| found[k]).count();
        if self.settled_s.is_none() && reached * 10 >= expected.len() * 9 {
            self.settled_s = Some(t);
        }
        if counts {
            self.epochs += 1;
            self.expected += expected.len();
            self.found += reached;
            let alone: Vec<&FusedTrack> = tracks
                .iter()
                .zip(&target_of)
                .filter(|(_, k)| k.is_none())
                .map(|(track, _)| *track)
                .collect();
            self.false_tracks += alone.len();
            self.unsure +=
                alone.iter().filter(|track| near_for_its_covariance(track, now, &truth)).count();
        }
    }

    fn line(&self) -> String {
        let epochs = self.epochs.max(1) as f64;
        let settled = self.settled_s.map_or("never".to_owned(), |t| format!("{t:.1} s"));
        format!(
            "found {:.1} of {:.1} ({:.1} %)  false {:.2} ({:.2} unsure)  switches {}  rmse {:.2} m  90 % by {settled}",
            self.found as f64 / epochs,
            self.expected as f64 / epochs,
            100.0 * self.found as f64 / self.expected.max(1) as f64,
            self.false_tracks as f64 / epochs,
            self.unsure as f64 / epochs,
            self.switches,
            (self.square_m2 / self.matched.max(1) as f64).sqrt(),
        )
    }
}

/// Whether a target lies within four standard deviations of where a track believes itself to be.
fn near_for_its_covariance(track: &FusedTrack, now: Timestamp, truth: &[TargetState]) -> bool {
    let state = track.state().predicted(now.seconds_since(track.updated_at), 1.0);
    let Some(covariance) = state.position_covariance().cholesky() else {
        return false;
    };
    truth.iter().any(|target| {
        let apart = target.position - state.position();
        apart.dot(&covariance.solve(&apart)) < 16.0
    })
}

/// Seconds that this thread has spent on a processor, where the system says so (Linux).
fn on_processor_s() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    text.split_whitespace().next()?.parse::<f64>().ok().map(|nanos| nanos / 1e9)
}

/// A site's fusion as it runs, with what it costs.
struct Run {
    site: SimulatedSite,
    fusion: Fusion,
    cold: Latencies,
    steady: Latencies,
    processor_s: f64,
    /// Bytes that the fusion holds, at the end of the cold start, now, and at most.
    warm_bytes: usize,
    bytes: usize,
    most_bytes: usize,
    quality: Quality,
}

impl Run {
    fn new(case: &Case) -> Self {
        let site = case.site.build().unwrap();
        let before = HELD.load(Ordering::Relaxed);
        let mut fusion = Fusion::new(case.config.clone()).unwrap();
        for calibration in site.calibrations() {
            fusion.calibrate(&calibration).unwrap();
        }
        let bytes = HELD.load(Ordering::Relaxed) - before;
        Self {
            site,
            fusion,
            cold: Latencies::default(),
            steady: Latencies::default(),
            processor_s: 0.0,
            warm_bytes: 0,
            bytes,
            most_bytes: bytes,
            quality: Quality::default(),
        }
    }

    /// Takes in what the cameras report until the next epoch; returns its time.
    fn advance(&mut self, exposures: &[SiteExposure], warm_s: f64) {
        let before = on_processor_s();
        let mut wall_s = 0.0;
        for exposure in exposures {
            let held = HELD.load(Ordering::Relaxed);
            PEAK.store(held, Ordering::Relaxed);
            let start = Instant::now();
            drop(self.fusion.ingest(&exposure.frame));
            let seconds = start.elapsed().as_secs_f64();
            wall_s += seconds;
            self.most_bytes = self.most_bytes.max(self.bytes + PEAK.load(Ordering::Relaxed) - held);
            self.bytes = (self.bytes + HELD.load(Ordering::Relaxed)).saturating_sub(held);
            if exposure.time_s < warm_s {
                self.cold.0.push(seconds);
                self.warm_bytes = self.bytes;
            } else {
                self.steady.0.push(seconds);
            }
        }
        let on_processor = before.zip(on_processor_s()).map(|(before, after)| after - before);
        self.processor_s += on_processor.unwrap_or(wall_s);
        if let Some(SiteExposure { time_s, .. }) = exposures.last() {
            self.quality.look(&self.site, &self.fusion, *time_s, *time_s >= warm_s);
        }
    }
}

fn run(case: &Case) {
    let mut run = Run::new(case);
    let warm_s = WARM_S.min(case.site.duration_s / 2.0);
    let an_epoch = ((EPOCH_S * case.site.rate_hz) as u64 * case.site.cameras as u64).max(1);
    let started = Instant::now();
    let mut index = 0;
    let mut data_s = 0.0;
    while index < run.site.exposures() && started.elapsed().as_secs_f64() < MAX_S {
        let end = (index + an_epoch).min(run.site.exposures());
        let exposures: Vec<SiteExposure> = (index..end).map(|i| run.site.exposure(i)).collect();
        run.advance(&exposures, warm_s);
        index = end;
        data_s = exposures.last().map_or(data_s, |exposure| exposure.time_s);
    }
    let megabytes = |bytes: usize| bytes as f64 / 1e6;
    println!("{}", case.name);
    println!("  cold    {}", run.cold.line(warm_s.min(data_s)));
    println!("  steady  {}", run.steady.line((data_s - warm_s).max(1e-9)));
    println!(
        "  whole   {:.3} processor seconds per second of data ({data_s:.1} s)",
        run.processor_s / data_s
    );
    println!(
        "  heap    {:.2} MB once warm, {:.2} MB at the end, {:.2} MB at most",
        megabytes(run.warm_bytes),
        megabytes(run.bytes),
        megabytes(run.most_bytes)
    );
    println!("  quality {}", run.quality.line());
}

/// A ring of cameras about an area of 600 m by 600 m, at 30 Hz.
fn ring(targets: usize, cameras: usize, duration_s: f64) -> Site {
    Site { targets, cameras, duration_s, false_bearings: 5.0, ..Site::default() }
}

/// Cameras over a whole town, each of which sees what is near.
fn wide(targets: usize, seed: u64) -> (Site, FusionConfig) {
    let range_m = 1400.0;
    let site = Site {
        seed,
        targets,
        cameras: 64,
        layout: Layout::Grid,
        area_m: [4000.0, 4000.0],
        range_m,
        rate_hz: 10.0,
        duration_s: 10.0,
        false_bearings: 5.0,
        ..Site::default()
    };
    let initiation = Initiation { max_range_m: range_m, ..Initiation::default() };
    (site, FusionConfig { initiation, ..FusionConfig::default() })
}

fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    let config = FusionConfig::default();
    for cameras in [3, 8, 16] {
        for targets in [1, 10, 100, 300] {
            cases.push(Case {
                name: format!("ring-{targets}-targets-{cameras}-cameras"),
                site: ring(targets, cameras, 10.0),
                config: config.clone(),
                short: true,
            });
        }
        cases.push(Case {
            name: format!("long-100-targets-{cameras}-cameras"),
            site: ring(100, cameras, 20.0),
            config: config.clone(),
            short: true,
        });
        cases.push(Case {
            name: format!("turning-100-targets-{cameras}-cameras"),
            site: Site { turn_rps: 0.2, ..ring(100, cameras, 20.0) },
            config: config.clone(),
            short: false,
        });
    }
    cases.push(Case {
        name: "memory-10-targets-3-cameras".to_owned(),
        site: ring(10, 3, 300.0),
        config,
        short: false,
    });
    // All cameras see all targets: the cost of what grows with the cameras of one target.
    cases.push(Case {
        name: "ring-20-targets-64-cameras".to_owned(),
        site: ring(20, 64, 10.0),
        config: FusionConfig::default(),
        short: false,
    });
    for targets in [100, 300, 1000] {
        let (site, config) = wide(targets, 1);
        cases.push(Case {
            name: format!("wide-{targets}-targets-64-cameras"),
            site,
            config,
            short: false,
        });
    }
    cases
}

fn main() {
    // Cargo adds arguments of its own.
    let wanted: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let all = wanted.iter().any(|name| name == "all");
    for case in cases() {
        let asked = wanted.iter().any(|name| case.name.contains(name.as_str()));
        if all || asked || (wanted.is_empty() && case.short) {
            run(&case);
        }
    }
}
