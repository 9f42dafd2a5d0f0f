// A fusion centre driven by any bytes: what broken cameras, broken clocks, a broken network and a
// confused operator could give it. Shared by the property test and the fuzz target.

use std::collections::{BTreeMap, BTreeSet};

use crossfix_fusion::{
    Fusion, FusionConfig, InitiationMethod, Manoeuvres, Output, SpatialSolver, TrackStatus,
    Weighting,
};
use crossfix_geometry::{Bearing, Camera, Distortion, ImageSize, Intrinsics, PanTilt, Pose};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, Cue, Expected, ImageTrackState, Pointing,
    Timestamp, Track, TrackEventKind, TrackState, Vector3,
};
use nalgebra::{Matrix2, Matrix6, Point3};

/// Three cameras that see the targets, one beside the first, and something that is no name.
const NAMES: [&str; 5] = ["a", "b", "c", "d", "no/name"];
const PLACES: [[f64; 3]; 5] = [
    [-150.0, -20.0, 2.0],
    [90.0, -120.0, 5.0],
    [60.0, 140.0, 3.0],
    [-149.0, -20.0, 2.0],
    [1.0, 2.0, 3.0],
];
/// Numbers that nobody expects of a camera, a clock or a lens.
const ODD: [f64; 14] = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    1e-300,
    1e-160,
    1e-12,
    1e-3,
    1e6,
    1e150,
    1e300,
    f64::INFINITY,
    f64::NEG_INFINITY,
    f64::NAN,
];
/// Steps of a clock, ns: back and forth, by a frame, by seconds, by years, by everything.
const JUMPS: [i64; 12] = [
    1,
    0,
    -1,
    -100_000_000,
    -2_000_000_000,
    700_000_000,
    5_000_000_000,
    9_900_000_000,
    60_000_000_000,
    31_557_600_000_000_000,
    i64::MAX,
    i64::MIN,
];
/// Clutter bearings that a run may have in all, and those of a frame that are all alike: a fuzzer
/// must get on. Whatever there are, a period takes a few tenths of a second.
const MAX_CLUTTER: usize = 6_000;
const MAX_ALIKE: usize = 200;
/// Operations of a run.
const MAX_OPERATIONS: usize = 60;

/// An input that ends with this has an appendix before it, of what older inputs do not have: they
/// mean what they meant.
pub const MARK: &[u8] = b"\xc5+";
/// The appendix: two numbers of the configuration, four poses, clocks.
const APPENDIX: usize = 11;

/// What is driven: operations, and what the appendix says.
fn split(data: &[u8]) -> (Bytes<'_>, Bytes<'_>) {
    let Some(rest) = data.strip_suffix(MARK).filter(|rest| rest.len() >= APPENDIX) else {
        return (Bytes(data), Bytes(&[]));
    };
    let (operations, appendix) = rest.split_at(rest.len() - APPENDIX);
    (Bytes(operations), Bytes(appendix))
}

/// The bytes, one after the other; when they are used up, zeros.
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn next(&mut self) -> u8 {
        let Some((first, rest)) = self.0.split_first() else { return 0 };
        self.0 = rest;
        *first
    }

    fn below(&mut self, end: usize) -> usize {
        usize::from(self.next()) % end
    }

    fn odd(&mut self) -> f64 {
        ODD[self.below(ODD.len())]
    }
}

/// A configuration with up to two numbers that nobody would choose; what is refused ends the run.
fn config(bytes: &mut Bytes<'_>) -> FusionConfig {
    let mut config = FusionConfig::default();
    let choice = bytes.next();
    config.tracking.manoeuvres = [
        Manoeuvres::Models,
        Manoeuvres::SmoothedResidual,
        Manoeuvres::Innovation,
        Manoeuvres::None,
    ][usize::from(choice & 3)];
    let solvers =
        [SpatialSolver::Map, SpatialSolver::Stacked, SpatialSolver::Triple, SpatialSolver::Pair];
    match choice >> 2 & 7 {
        0..=3 => {}
        grouping => {
            config.initiation.method = InitiationMethod::Grouping;
            config.initiation.solver = solvers[usize::from(grouping) - 4];
        }
    }
    if choice & 32 != 0 {
        config.bearings.weighting = Weighting::Equal;
    }
    config.initiation.shared_lines = usize::from(choice >> 6);
    for _ in 0..bytes.below(3) {
        let (field, value) = (bytes.below(20), bytes.odd());
        let (initiation, tracking) = (&mut config.initiation, &mut config.tracking);
        match field {
            0 => config.event_time.lateness_s = value,
            1 => config.event_time.max_ahead_s = value,
            2 => config.bearings.equal_sd_rad = value,
            3 => config.bearings.systematic_sd_rad = value,
            4 => initiation.birth_density_per_m3 = value,
            5 => initiation.period_s = value,
            6 => initiation.velocity_prior_sd_mps = value,
            7 => initiation.max_range_m = value,
            8 => initiation.temporal_gate_m = Some(value),
            9 => initiation.pair_gate_m2 = value,
            10 => tracking.acceleration_density = value,
            11 => tracking.switching_rate_per_s = value,
            12 => tracking.clutter_per_sr = value,
            13 => tracking.confirm_score = value,
            14 => tracking.lost_after_s = value,
            15 => tracking.coasting_after_s = value,
            16 => tracking.max_position_sd_m = value,
            17 => (initiation.periods, initiation.fixes) = (20, 1),
            18 => tracking.gate_probability = 1.0 - 1e-16,
            _ => tracking.models.iter_mut().for_each(|model| model.acceleration_density = value),
        }
    }
    config
}

/// Numbers of the configuration that came later: two pairs of a field and a value, four bytes.
fn configure_more(config: &mut FusionConfig, bytes: &mut Bytes<'_>) {
    for _ in 0..2 {
        let (field, value) = (bytes.below(8), bytes.odd());
        match field {
            0 if value != 0.0 => config.tracking.smoothing_s = 0.5,
            1 => config.clocks.estimate = false,
            2 => {
                config.clocks.trusted =
                    NAMES[..2].iter().filter_map(|name| name.parse().ok()).collect();
            }
            3 => config.clocks.least_sd_s = value,
            4 => config.clocks.drift_sd = value,
            5 => config.initiation.pair_s = value,
            6 => config.tracking.detection_probability = value,
            7 => config.tracking.detection_probability = 0.5,
            _ => {}
        }
    }
}

/// Standard deviations of clocks, s: good, unsure, very unsure.
const CLOCKS: [f64; 6] = [0.0, 0.9e-3, 2e-3, 0.02, 0.1, 9.9];
/// Standard deviations of poses, rad and m: of a survey, of a guess, and of nothing.
const POSES: [(f64, f64); 5] = [(1e-3, 0.05), (1e-6, 1e-5), (0.1, 3.0), (0.0, 0.0), (1.0, 1e3)];

/// A camera's pose as well known as a byte says.
fn with_pose(message: CameraCalibration, choice: u8, odd: f64) -> CameraCalibration {
    match usize::from(choice % 8) {
        0 => message,
        known @ 1..=5 => message.with_pose_sd(POSES[known - 1].0, POSES[known - 1].1),
        6 => message.with_pose_sd(odd, odd),
        _ => CameraCalibration { pose_covariance: vec![odd; 36], ..message },
    }
}

fn camera(at: [f64; 3]) -> Option<Camera> {
    let pose = Pose::looking_at(Point3::from(at), Point3::new(0.0, 0.0, 40.0)).ok()?;
    let size = ImageSize { width: 1920, height: 1080 };
    let lens = Intrinsics {
        size,
        fx: 1400.0,
        fy: 1400.0,
        cx: 959.5,
        cy: 539.5,
        distortion: Distortion::None,
    };
    Camera::new(lens, pose).ok()
}

/// Variances and covariance of a standard deviation of half a milliradian.
const ORDINARY: [f64; 3] = [2.5e-7, 0.0, 2.5e-7];

/// A bearing that is right.
fn bearing(towards: nalgebra::Vector3<f64>, [xx, xy, yy]: [f64; 3]) -> BearingTrack {
    BearingTrack {
        bearing: Some(towards.normalize().into()),
        covariance_xx: xx,
        covariance_xy: xy,
        covariance_yy: yy,
        state: ImageTrackState::Tracking.into(),
        ..Default::default()
    }
}

/// Where three targets are at a time: two fly straight, one turns.
fn targets(seconds: f64) -> [Point3<f64>; 3] {
    // Every half minute they are back where they were.
    let t = seconds.rem_euclid(30.0);
    [
        Point3::new(-30.0 + 8.0 * t, 5.0, 40.0 + t),
        Point3::new(20.0, 25.0 - 6.0 * t, 55.0),
        Point3::new(25.0 * (t * 0.4).cos(), 25.0 * (t * 0.4).sin(), 30.0),
    ]
}

/// A run: the fusion centre, and what it must have counted and said by now.
struct Run<'a> {
    bytes: Bytes<'a>,
    fusion: Fusion,
    clutter_left: usize,
    /// Whether no two tracks may begin with the same sight lines.
    lines_are_owned: bool,
    /// Whether the input has an appendix.
    is_appended: bool,
    time: i64,
    /// What cameras say of their bearings' and times' errors.
    covariance: [f64; 3],
    time_sd: f64,
    /// What each camera says of its time beside that, and how far its clock is ahead, ns.
    clock_sds: [f64; 5],
    ahead: [i64; 5],
    /// Where each camera's mount points, as it says.
    pointings: [Option<Pointing>; 5],
    sent: Vec<BearingFrame>,
    bearings: usize,
    rejected: BTreeMap<&'static str, u64>,
    born: BTreeSet<u64>,
    frames_out: u64,
    smoothed_out: u64,
}

impl Run<'_> {
    fn operate(&mut self) {
        // The byte was taken by 13 when there were 13 operations: those below 13 mean what they
        // meant.
        match self.bytes.next() {
            255 if self.is_appended => self.mount(),
            kind if self.is_appended && kind >= 247 => self.of_cameras(kind),
            kind => self.operate_on(kind % 13),
        }
    }

    /// What cameras say of their poses and clocks in flight.
    fn of_cameras(&mut self, kind: u8) {
        let (eye, choice) = (self.bytes.below(4), self.bytes.next());
        let value = self.bytes.odd();
        match kind % 3 {
            0 => {
                let Some((camera, Ok(name))) = camera(PLACES[eye]).zip(Some(NAMES[eye].parse()))
                else {
                    return;
                };
                let message = CameraCalibration::new(&name, &camera, Timestamp::EPOCH);
                // What describes no camera changes nothing.
                let _ = self.fusion.calibrate(&with_pose(message, choice, value));
            }
            1 => self.clock_sds[eye] = CLOCKS[usize::from(choice) % CLOCKS.len()],
            // Up to a quarter of a second.
            _ => self.ahead[eye] = i64::from(choice) * 2_000_000 - 256_000_000,
        }
    }

    /// A camera on a mount, that points somewhere, or nowhere that can be; or that takes cues.
    fn mount(&mut self) {
        let (eye, choice) = (self.bytes.below(4), self.bytes.next());
        let (angle, odd) = (f64::from(self.bytes.next() as i8) / 100.0, self.bytes.odd());
        let Some((camera, Ok(name))) = camera(PLACES[eye]).zip(Some(NAMES[eye].parse())) else {
            return;
        };
        let message = CameraCalibration::new(&name, &camera, Timestamp::EPOCH);
        let mount = PanTilt::new(*camera.pose(), [-1.0, 1.0], [-0.5, 0.5]).unwrap();
        let message = match choice & 3 {
            0 => message.on_mount(&mount),
            1 => message.taking_cues(),
            2 => message.on_mount(&mount).with_pose_sd(odd, odd),
            _ => message,
        };
        let _ = self.fusion.calibrate(&message);
        let pointing = Pointing { azimuth: angle, settled: choice & 4 == 0, ..Default::default() };
        self.pointings[eye] = match choice >> 3 & 3 {
            0 => None,
            1 => Some(Pointing { azimuth_sd: 1e-3, elevation_sd: 1e-3, ..pointing }),
            2 => Some(Pointing { azimuth_sd: odd, elevation: odd, ..pointing }),
            _ => Some(pointing),
        };
    }

    fn operate_on(&mut self, kind: u8) {
        match kind {
            0..=2 => self.fly(),
            3 => self.glimpse(),
            4 => self.odd_frame(),
            5 => self.clutter(),
            6 => self.calibrate_oddly(),
            7 => {
                let name = NAMES[self.bytes.below(4)];
                if let Ok(name) = name.parse() {
                    let outputs = self.fusion.camera_ended(&name);
                    self.check(&outputs);
                }
            }
            8 => {
                let outputs = self.fusion.flush();
                self.check(&outputs);
            }
            9 | 10 => {
                let jump = JUMPS[self.bytes.below(JUMPS.len())];
                self.time = self.time.saturating_add(jump);
            }
            11 => self.again(),
            _ => {
                self.covariance = self.odd_covariance();
                self.time_sd = self.bytes.odd();
            }
        }
    }

    /// What a camera may say of a bearing's error, rad^2: `[xx, xy, yy]`.
    fn odd_covariance(&mut self) -> [f64; 3] {
        let [x, y] = [self.bytes.odd(), self.bytes.odd()];
        match self.bytes.next() % 6 {
            0 | 1 => ORDINARY,
            2 => [x.abs(), 0.0, y.abs()],
            3 => [x.abs(), 0.0, x.abs()],
            // As good as singular.
            4 => [1e-6, 1e-6 * (1.0 - 1e-15), 1e-6],
            _ => [x, self.bytes.odd(), y],
        }
    }

    /// Up to sixteen rounds of all three cameras, a tenth of a second each.
    fn fly(&mut self) {
        let seen = self.bytes.next();
        for _ in 0..=seen >> 4 {
            for eye in 0..3 {
                self.time = self.time.saturating_add(33_000_000);
                self.see(eye, seen & 7);
            }
        }
    }

    /// One frame of one camera, out of turn.
    fn glimpse(&mut self) {
        let (eye, seen) = (self.bytes.below(NAMES.len()), self.bytes.next());
        self.time = self.time.saturating_add(i64::from(seen >> 3) * 2_000_000);
        self.see(eye, seen & 7);
    }

    fn see(&mut self, eye: usize, seen: u8) {
        let Some(camera) = camera(PLACES[eye]) else { return };
        let places = targets(self.time as f64 / 1e9).into_iter().enumerate();
        let tracks = places
            .filter(|(i, place)| seen >> i & 1 == 1 && camera.sees(*place))
            .map(|(_, place)| bearing(camera.pose().camera_from_world(place), self.covariance));
        self.send(eye, tracks.collect());
    }

    fn send(&mut self, eye: usize, tracks: Vec<BearingTrack>) {
        let frame = BearingFrame {
            camera: NAMES[eye].into(),
            sequence: self.sent.len() as u64,
            capture_time_ns: self.time.saturating_add(self.ahead[eye]),
            // What is odd of a standard deviation stays odd.
            capture_time_sd_s: if self.time_sd == 0.0 { self.clock_sds[eye] } else { self.time_sd },
            tracks,
            pointing: self.pointings[eye],
            ..Default::default()
        };
        self.ingest(frame);
    }

    fn ingest(&mut self, frame: BearingFrame) {
        self.bearings += frame.tracks.len();
        let outputs = self.fusion.ingest(&frame);
        self.sent.push(frame);
        self.check(&outputs);
    }

    /// A frame of bearings that no camera should report.
    fn odd_frame(&mut self) {
        let (eye, count) = (self.bytes.below(NAMES.len()), self.bytes.below(6));
        let mut tracks = Vec::new();
        for _ in 0..count {
            let kind = self.bytes.next();
            let vector = match kind & 7 {
                0 => None,
                1 => Some([self.bytes.odd(), self.bytes.odd(), 1.0]),
                2 => Some([0.0, 0.0, -1.0]),
                3 => Some([1.0, 0.0, 0.0]),
                4 => Some([0.0, 0.0, 1.000_000_9]),
                _ => Some([0.0, 0.0, 1.0]),
            };
            let state =
                if kind & 8 == 0 { ImageTrackState::Tracking } else { ImageTrackState::Coasting };
            let covariance = self.odd_covariance();
            let sound = bearing(nalgebra::Vector3::z(), covariance);
            let vector = vector.map(|[x, y, z]| Vector3 { x, y, z });
            tracks.push(BearingTrack { bearing: vector, state: state.into(), ..sound });
        }
        self.time = self.time.saturating_add(20_000_000);
        self.send(eye, tracks);
    }

    /// Up to some hundred bearings of nothing, or of the same nothing.
    fn clutter(&mut self) {
        let (eye, wanted, seed) =
            (self.bytes.below(4), self.bytes.below(256) * 8, self.bytes.next());
        let most = if seed & 1 == 0 { MAX_ALIKE } else { wanted };
        let count = wanted.min(self.clutter_left).min(most);
        self.clutter_left -= count;
        let mut state = u64::from(seed);
        let mut uniform = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / (1u64 << 31) as f64 - 0.5
        };
        let alike = nalgebra::Vector3::new(uniform(), 0.7 * uniform(), 1.0);
        let tracks = (0..count).map(|_| {
            let other = nalgebra::Vector3::new(1.3 * uniform(), 0.7 * uniform(), 1.0);
            bearing(if seed & 1 == 0 { alike } else { other }, ORDINARY)
        });
        let tracks = tracks.collect();
        self.time = self.time.saturating_add(30_000_000);
        self.send(eye, tracks);
    }

    /// A camera elsewhere, turned otherwise, or impossible.
    fn calibrate_oddly(&mut self) {
        let (eye, kind) = (self.bytes.below(NAMES.len()), self.bytes.next());
        let number = self.bytes.odd();
        // Where another camera is, or nearly.
        let place = PLACES[usize::from(kind >> 4) % PLACES.len()];
        let Some((camera, Ok(name))) = camera(place).zip(Some("x".parse())) else { return };
        let mut message = CameraCalibration::new(&name, &camera, Timestamp::EPOCH);
        message.camera = NAMES[eye].into();
        match kind & 15 {
            0..=2 => {}
            3 => message.position = Some(Vector3 { x: number, y: 0.0, z: 0.0 }),
            4 => message.fx = number,
            5 => (message.fx, message.fy) = (number, number),
            6 => message.rotation[usize::from(kind >> 4) % 9] = number,
            7 => message.rotation.truncate(usize::from(kind >> 4)),
            8 => message.position = None,
            9 => (message.distortion_model, message.distortion) = (2, vec![number; 5]),
            10 => (message.distortion_model, message.distortion) = (3, vec![number; 4]),
            11 => message.distortion_model = i32::from(kind),
            12 => message.width = u32::from(kind >> 4),
            13 => (message.cx, message.cy) = (number, -number),
            14 => message.rotation = vec![0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0],
            _ => message.rotation.iter_mut().for_each(|r| *r = -*r),
        }
        // What describes no camera changes nothing.
        let _ = self.fusion.calibrate(&message);
    }

    /// A frame that has been sent comes again, as it was or nearly.
    fn again(&mut self) {
        if self.sent.is_empty() {
            return;
        }
        let back = self.bytes.below(self.sent.len());
        let mut frame = self.sent[self.sent.len() - 1 - back].clone();
        match self.bytes.next() & 7 {
            0 => frame.camera = NAMES[back % 4].into(),
            1 => frame.capture_time_ns = frame.capture_time_ns.saturating_add(1),
            2 => frame.capture_time_ns = self.time,
            3 => frame.tracks.reverse(),
            4 => frame.sequence = u64::MAX,
            _ => {}
        }
        self.ingest(frame);
    }

    /// What must hold of whatever comes out.
    fn check(&mut self, outputs: &[Output]) {
        for output in outputs {
            match output {
                Output::Tracks(frame) => {
                    assert_eq!(
                        frame.sequence, self.frames_out,
                        "the frames are numbered without gaps"
                    );
                    self.frames_out += 1;
                    assert!(frame.tracks.is_sorted_by(|a, b| a.id < b.id), "{frame:?}");
                    frame.tracks.iter().for_each(assert_sound);
                }
                Output::Smoothed(frame) => {
                    assert_eq!(frame.sequence, self.smoothed_out, "each goes out once more");
                    self.smoothed_out += 1;
                    frame.tracks.iter().for_each(assert_sound);
                }
                Output::Event(event) => {
                    let first =
                        event.kind() == TrackEventKind::Born && self.born.insert(event.track_id);
                    let later =
                        event.kind() != TrackEventKind::Born && self.born.contains(&event.track_id);
                    assert!(first || later, "each track is born once, and first of all: {event:?}");
                }
                Output::Cues(cues) => cues.cues.iter().for_each(assert_sound_cue),
                Output::Camera(..) => {}
                Output::Rejected(rejection) => {
                    *self.rejected.entry(rejection.reason.counter()).or_default() += 1;
                }
            }
        }
        let tracks: Vec<_> = self.fusion.tracks().collect();
        assert!(tracks.is_sorted_by(|a, b| a.id < b.id), "{tracks:?}");
        if self.lines_are_owned {
            assert!(tracks.len() <= self.bearings, "no track without a bearing of its own");
        }
        for track in &tracks {
            let state = track.state();
            assert!(state.mean.iter().all(|v| v.is_finite()), "{track:?}");
            assert!(is_possible(&state.covariance), "{track:?}");
        }
        for report in self.fusion.cameras() {
            assert!(report.noise_factor.is_finite() && report.noise_factor >= 0.0, "{report:?}");
            let Some(clock) = report.clock else { continue };
            let sds = [clock.sd_s, clock.relative_sd_s, clock.drift_sd];
            assert!(sds.iter().all(|sd| sd.is_finite() && *sd >= 0.0), "{report:?}");
            assert!(clock.offset_s.is_finite() && clock.drift.is_finite(), "{report:?}");
        }
        let alive = tracks.iter().filter(|track| track.status != TrackStatus::Lost).count() as u64;
        let count = |name| self.fusion.counters().get(name);
        assert_eq!(alive, count("tracks_born") - count("tracks_lost") - count("tracks_merged"));
        for (&name, &number) in &self.rejected {
            assert_eq!(count(name), number, "what is refused is told and counted: {name}");
        }
    }

    /// After the last frame every frame has become an exposure or has been refused.
    fn end(mut self) {
        let outputs = self.fusion.flush();
        self.check(&outputs);
        let refused: u64 = self
            .rejected
            .iter()
            .filter(|(name, _)| **name != "rejected_bearing")
            .map(|(_, n)| n)
            .sum();
        let count = |name| self.fusion.counters().get(name);
        assert_eq!(count("frames"), self.sent.len() as u64);
        assert_eq!(count("frames"), count("exposures") + refused, "{:?}", self.fusion.counters());
        assert_eq!(count("tracks_born"), self.born.len() as u64);
    }
}

/// Finite, symmetric to rounding, and no negative variance.
fn is_possible(covariance: &Matrix6<f64>) -> bool {
    let symmetric = |i: usize, j: usize| {
        let scale = (covariance[(i, i)] * covariance[(j, j)]).sqrt();
        (covariance[(i, j)] - covariance[(j, i)]).abs() <= 1e-9 * scale
    };
    covariance.iter().all(|v| v.is_finite())
        && covariance.diagonal().iter().all(|v| *v >= 0.0)
        && (0..6).all(|i| (0..i).all(|j| symmetric(i, j)))
}

/// Whether a track can be given to somebody.
fn assert_sound(track: &Track) {
    let place = [track.position, track.velocity].into_iter().flatten();
    let numbers: Vec<f64> = place.flat_map(|v| [v.x, v.y, v.z]).collect();
    assert_eq!(numbers.len(), 6, "{track:?}");
    assert!(numbers.iter().all(|v| v.is_finite()), "{track:?}");
    assert_eq!(track.covariance.len(), 36, "{track:?}");
    assert!(is_possible(&Matrix6::from_column_slice(&track.covariance)), "{track:?}");
    assert!(track.residuals.iter().all(|r| r.angle_rad.is_finite() && r.nis >= 0.0), "{track:?}");
    assert!(
        track.state() != TrackState::Unspecified && !track.condition_number.is_nan(),
        "{track:?}"
    );
}

fn assert_sound_cue(cue: &Cue) {
    assert!(cue.range_m > 0.0 && cue.log_range_sd >= 0.0, "{cue:?}");
    assert!(!cue.ahead.is_empty(), "{cue:?}");
    for Expected { bearing, covariance_xx: xx, covariance_xy: xy, covariance_yy: yy, .. } in
        &cue.ahead
    {
        let covariance = Matrix2::new(*xx, *xy, *xy, *yy);
        let vector = bearing.unwrap_or_default().into();
        assert!(Bearing::new(vector, covariance).is_ok(), "{cue:?}");
    }
}

/// Runs a fusion centre on bytes. Panics if it does, or if it answers with what cannot be.
pub fn drive(data: &[u8]) {
    let (mut bytes, mut appendix) = split(data);
    let is_appended = !appendix.0.is_empty();
    let mut config = config(&mut bytes);
    configure_more(&mut config, &mut appendix);
    let lines_are_owned = config.initiation.shared_lines == 0;
    let Ok(mut fusion) = Fusion::new(config) else { return };
    let (mut clock_sds, mut ahead) = ([0.0; 5], [0; 5]);
    let odd = appendix.odd();
    for (index, (name, place)) in NAMES.iter().zip(PLACES).take(4).enumerate() {
        let choice = appendix.next();
        if let Some((camera, Ok(name))) = camera(place).zip(Some(name.parse())) {
            let message = CameraCalibration::new(&name, &camera, Timestamp::EPOCH);
            let known = fusion.calibrate(&with_pose(message.clone(), choice, odd)).is_ok();
            // A pose that cannot be is refused; the camera is known without.
            assert!(known || (choice % 8 >= 6 && fusion.calibrate(&message).is_ok()));
        }
        clock_sds[index] = CLOCKS[usize::from(choice >> 3) % CLOCKS.len()];
    }
    // Two clocks are off by up to a quarter of a second.
    for (index, choice) in [appendix.next(), appendix.next()].into_iter().enumerate() {
        ahead[index + 1] = i64::from(choice as i8) * 2_000_000;
    }
    let mut run = Run {
        bytes,
        fusion,
        clutter_left: MAX_CLUTTER,
        lines_are_owned,
        is_appended,
        time: 0,
        covariance: ORDINARY,
        time_sd: 0.0,
        clock_sds,
        ahead,
        pointings: [None; 5],
        sent: Vec::new(),
        bearings: 0,
        rejected: BTreeMap::new(),
        born: BTreeSet::new(),
        frames_out: 0,
        smoothed_out: 0,
    };
    for _ in 0..MAX_OPERATIONS {
        if run.bytes.0.is_empty() {
            break;
        }
        run.operate();
    }
    run.end();
}
