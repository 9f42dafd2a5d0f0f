//! An optical camera hands a target over to the scanning thermal receiver beside it (Klochko 2020,
//! eq. 3): a scan of the whole sector takes seconds, one about the cue a twentieth of one.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]
#![allow(dead_code, reason = "each test uses what it needs of the common scene")]

mod common;

use common::{Eye, Path, Scene, calibration, eye, found, fusion_of, straight};
use crossfix_fusion::{FusionConfig, Output};
use crossfix_geometry::{Camera, ScanAngles, ScanMeasurement, camera_from_paper};
use crossfix_message::{
    BearingFrame, BearingTrack, Cue, CueFrame, ImageTrackState, Payload, Timestamp,
};
use nalgebra::{Matrix2, Point3, Unit, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Noise of each angle, rad: a fifth of the cameras'.
const ANGLE_SD_RAD: f64 = 1e-4;
/// Half of the sector that it scans by itself, rad: azimuth to each side, and elevation.
const SECTOR_RAD: [f64; 2] = [0.8, 0.4];
/// Its beam is so high, rad: rows of a scan are so far apart.
const BEAM_RAD: f64 = 0.03;
/// It goes along a row so fast, rad/s, and takes so long between two, s.
const RATE_RAD_PER_S: f64 = 17.0;
const RETURN_S: f64 = 0.02;
/// A cue is scanned to so many deviations to each side, and with the beam around it.
const SCANNED_SDS: f64 = 4.0;
/// Cues hold for so long, s.
const VALID_S: f64 = 2.0;

/// What is scanned: its middle, and half of its width and height, rad.
#[derive(Clone, Copy, Debug)]
struct Sector {
    middle: ScanAngles,
    half: [f64; 2],
}

/// A receiver whose beam goes along rows.
struct Scanner {
    eye: Eye,
    cues: CueFrame,
    sector: Sector,
    /// The next row of the sector, from below.
    row: usize,
    /// Whether it looks where it is told.
    takes_cues: bool,
    /// How many sectors it has scanned.
    scans: usize,
    messages: u64,
    noise: ChaCha8Rng,
}

impl Scanner {
    fn new(seed: u64, takes_cues: bool) -> Self {
        // Beside the first camera; its sector is the field that its calibration tells.
        let mut eye = eye("thermal", [-149.0, -20.0, 2.0], [0.0, 0.0, 40.0], 0.0);
        let mut lens = *eye.camera.model().intrinsics();
        (lens.fx, lens.fy) = (lens.cx / SECTOR_RAD[0].tan(), lens.cy / SECTOR_RAD[1].tan());
        eye.camera = Camera::new(lens, *eye.camera.pose()).unwrap();
        Self {
            eye,
            cues: CueFrame::default(),
            sector: Sector {
                middle: ScanAngles { azimuth: 0.0, elevation: 0.0 },
                half: SECTOR_RAD,
            },
            row: 0,
            takes_cues,
            scans: 0,
            messages: 0,
            noise: ChaCha8Rng::seed_from_u64(seed),
        }
    }

    fn rows(&self) -> usize {
        (2.0 * self.sector.half[1] / BEAM_RAD).ceil().max(1.0) as usize
    }

    fn is_cued(&self) -> bool {
        self.sector.half != SECTOR_RAD
    }

    /// Where the beam has a target, by what the cue says of a time.
    fn expected(cue: &Cue, t: f64) -> Sector {
        let seconds = |k: usize| Timestamp::from_nanos(cue.ahead[k].time_ns).seconds();
        let direction = |k: usize| Vector3::from(cue.ahead[k].bearing.unwrap());
        let last = cue.ahead.len() - 1;
        let after = (1..last).find(|k| seconds(*k) >= t).unwrap_or(last);
        let share = (t - seconds(after - 1)) / (seconds(after) - seconds(after - 1));
        let towards = direction(after - 1).lerp(&direction(after), share);
        let far = &cue.ahead[after];
        let [xx, xy, yy] = [far.covariance_xx, far.covariance_xy, far.covariance_yy];
        let sd = Matrix2::new(xx, xy, xy, yy).symmetric_eigenvalues().max().sqrt();
        let half = SCANNED_SDS * sd + BEAM_RAD;
        Sector { middle: angles(towards), half: [half, half] }
    }

    /// Begins the next sector, if one is done or the first cue has come.
    fn choose(&mut self, t: f64) {
        let valid = t - Timestamp::from_nanos(self.cues.time_ns).seconds() < VALID_S;
        let cued = self.takes_cues && valid && !self.cues.cues.is_empty();
        let is_done = self.row == self.rows();
        if is_done || (cued && !self.is_cued()) {
            self.scans += usize::from(is_done);
            self.row = 0;
            // One after the other, if there are several.
            let cue = cued.then(|| &self.cues.cues[self.scans % self.cues.cues.len()]);
            self.sector =
                cue.map_or_else(|| Scanner::new(0, false).sector, |cue| Self::expected(cue, t));
        }
    }

    /// Goes along a row that begins at a time: what it meets, in the order of the times, and when
    /// the row ends.
    fn sweep(&mut self, begin: f64, paths: &[Path]) -> (Vec<BearingFrame>, f64) {
        self.choose(begin);
        let Sector { middle, half } = self.sector;
        let bottom = middle.elevation - self.rows() as f64 * BEAM_RAD / 2.0;
        let rows = bottom + BEAM_RAD * self.row as f64;
        self.row += 1;
        let first = middle.azimuth - half[0];
        let end = begin + 2.0 * half[0] / RATE_RAD_PER_S;
        let mut met: Vec<(f64, ScanAngles)> = Vec::new();
        for path in paths {
            // The target moves while the beam comes.
            let at = |t: f64| path(t).map(|p| angles(self.eye.camera.pose().camera_from_world(p)));
            let when = (0..5)
                .try_fold(begin, |t, _| Some(begin + (at(t)?.azimuth - first) / RATE_RAD_PER_S));
            let Some((t, there)) = when.and_then(|t| Some((t, at(t)?))) else { continue };
            if (begin..=end).contains(&t) && (rows..rows + BEAM_RAD).contains(&there.elevation) {
                met.push((t, there));
            }
        }
        met.sort_by(|a, b| a.0.total_cmp(&b.0));
        let messages = met.into_iter().map(|(t, there)| self.message(t, there)).collect();
        (messages, end + RETURN_S)
    }

    /// One meeting.
    fn message(&mut self, t: f64, truth: ScanAngles) -> BearingFrame {
        let mut off =
            || ANGLE_SD_RAD * Distribution::<f64>::sample(&StandardNormal, &mut self.noise);
        let (azimuth, elevation) = (truth.azimuth + off(), truth.elevation + off());
        let angles = ScanAngles { azimuth, elevation };
        let (azimuth_sd, elevation_sd) = (ANGLE_SD_RAD, ANGLE_SD_RAD);
        let bearing = ScanMeasurement { angles, azimuth_sd, elevation_sd }.bearing().unwrap();
        let covariance = bearing.covariance();
        self.messages += 1;
        let track = BearingTrack {
            track_id: self.messages,
            bearing: Some(bearing.direction().into_inner().into()),
            covariance_xx: covariance.m11,
            covariance_xy: covariance.m12,
            covariance_yy: covariance.m22,
            state: ImageTrackState::Tracking.into(),
            ..Default::default()
        };
        BearingFrame {
            camera: self.eye.name.to_string(),
            sequence: self.messages,
            capture_time_ns: Timestamp::from_seconds(t).nanos(),
            tracks: vec![track],
            ..Default::default()
        }
        .stamped()
    }
}

/// The angles of a direction in a camera's frame.
fn angles(direction: Vector3<f64>) -> ScanAngles {
    ScanAngles::of(&Unit::new_normalize(camera_from_paper(direction)))
}

/// What came of a scene.
#[derive(Debug, Default)]
struct Found {
    /// When the scanner met a target first, by a cue if it takes cues, s.
    first_s: Option<f64>,
    /// How many meetings there were.
    meetings: usize,
    /// How far each look at a target's track was off, m.
    errors_m: Vec<f64>,
    /// Looks at which a target had no track.
    missed: usize,
}

/// Which receivers there are.
#[derive(Clone, Copy, Debug, PartialEq)]
enum With {
    CamerasAlone,
    Scanner,
    CuedScanner,
}

fn run(scene: &Scene, with: With, seed: u64) -> Found {
    let mut scanner = Scanner::new(300 + seed, with == With::CuedScanner);
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    let message = calibration(&scanner.eye);
    let message = if scanner.takes_cues { message.taking_cues() } else { message };
    fusion.calibrate(&message).unwrap();
    let mut wide = scene.frames(seed).into_iter().peekable();
    let mut result = Found::default();
    let mut next_look = 4.0;
    let mut now = 0.0;
    while wide.peek().is_some() {
        let (meetings, end) = scanner.sweep(now, &scene.paths);
        let meetings = if with == With::CamerasAlone { Vec::new() } else { meetings };
        now = end;
        let mut meetings = meetings.into_iter().peekable();
        let end_ns = Timestamp::from_seconds(end).nanos();
        loop {
            let met = meetings.peek().map_or(end_ns, |frame| frame.capture_time_ns);
            let next = wide.next_if(|frame| frame.capture_time_ns <= met);
            let is_met = next.is_none();
            let Some(frame) = next.or_else(|| meetings.next()) else { break };
            if is_met {
                let t = Timestamp::from_nanos(frame.capture_time_ns).seconds();
                result.meetings += 1;
                if scanner.is_cued() || !scanner.takes_cues {
                    result.first_s.get_or_insert(t);
                }
            }
            for output in fusion.ingest(&frame) {
                if let Output::Cues(cues) = output {
                    scanner.cues = cues;
                }
            }
            let t = Timestamp::from_nanos(frame.capture_time_ns).seconds();
            if !is_met && t >= next_look {
                next_look += 0.5;
                for path in &scene.paths {
                    let Some(track) = found(&fusion, path) else {
                        result.missed += 1;
                        continue;
                    };
                    let truth = path(track.updated_at.seconds()).unwrap();
                    result.errors_m.push((track.state().position() - truth).norm());
                }
            }
        }
    }
    result
}

fn circle() -> Path {
    Box::new(|t| {
        let (sin, cos) = (0.25 * t).sin_cos();
        Some(Point3::new(30.0 * cos, 30.0 * sin, 40.0 + 0.2 * t))
    })
}

/// Of several runs: the latest first meeting, s; meetings a second and target; and the root mean
/// square of the errors, m. No look is without a track.
fn figures(targets: usize, with: With) -> [f64; 3] {
    const SECONDS: f64 = 16.0;
    const RUNS: u64 = 12;
    let (mut latest_s, mut meetings, mut errors_m) = (0.0f64, 0, Vec::new());
    for seed in 0..RUNS {
        let mut paths = vec![circle(), straight([-40.0, 40.0, 50.0], [4.0, -3.0, 0.3])];
        paths.truncate(targets);
        let found = run(&Scene::new(paths, SECONDS), with, seed);
        assert_eq!(found.missed, 0, "{targets} targets, {with:?}, seed {seed}");
        latest_s = latest_s.max(found.first_s.unwrap_or(f64::INFINITY));
        meetings += found.meetings;
        errors_m.extend(found.errors_m);
    }
    let rate_hz = meetings as f64 / (SECONDS * RUNS as f64) / targets as f64;
    let squares: f64 = errors_m.iter().map(|error| error.powi(2)).sum();
    let rmse_m = (squares / errors_m.len() as f64).sqrt();
    [latest_s, rate_hz, rmse_m]
}

#[test]
fn a_cued_scanner_meets_targets_soon_and_often_and_their_tracks_are_better() {
    for targets in [1, 2] {
        let [_, _, alone_m] = figures(targets, With::CamerasAlone);
        let [_, all_hz, all_m] = figures(targets, With::Scanner);
        let [cued_s, cued_hz, cued_m] = figures(targets, With::CuedScanner);
        println!(
            "{targets} targets: cued, met after {cued_s:.2} s at the latest, {cued_hz:.1} times a second \
             ({all_hz:.1} in scans of all); {cued_m:.3} m ({all_m:.3} m, without it {alone_m:.3} m)"
        );
        // The first camera saw it at once; a track of three is cued half a second later.
        assert!(cued_s < 1.2, "{targets}: {cued_s}");
        assert!(cued_hz > 15.0 * all_hz, "{targets}: {cued_hz} {all_hz}");
        assert!(all_m < 1.02 * alone_m, "{targets}: {all_m} {alone_m}");
        assert!(cued_m < 0.85 * alone_m, "{targets}: {cued_m} {alone_m}");
    }
}
