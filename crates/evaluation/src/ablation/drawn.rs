//! Drawn scenes that are hard for an image tracker: each kind has one thing that real videos do.

use std::f64::consts::TAU;

use crossfix_correlation::Plane;
use crossfix_geometry::ScanAngles;
use crossfix_message::Timestamp;
use crossfix_simulation::{
    FlightPath, Scene, SceneCamera, SceneClutter, SceneMount, SceneTarget, SimulatedCamera,
    SimulatedClock,
};
use crossfix_vision::{ImagePoint, PixelBox, TrackerPart};
use nalgebra::Point3;

use super::trial::Trial;
use super::{RunScores, TrialStart, configurations};
use crate::papers::Noise;

/// A kind of scene.
pub(super) struct DrawnKind {
    pub(super) name: &'static str,
    pub(super) title: &'static str,
    /// Standard deviation of the image's noise, 8-bit levels.
    noise_levels: f64,
    /// Amplitude of the camera's pan, rad.
    pan_rad: f64,
    clutter: fn(&mut Noise) -> Vec<SceneClutter>,
}

/// The kinds, in the order of their tables.
pub(super) const KINDS: [DrawnKind; 6] = [
    DrawnKind {
        name: "ablation-noise",
        title: "clouds and noise",
        noise_levels: 50.0,
        pan_rad: 0.0,
        clutter: |_| Vec::new(),
    },
    DrawnKind {
        name: "ablation-masts",
        title: "masts before and behind the target",
        noise_levels: 3.0,
        pan_rad: 0.0,
        clutter: masts,
    },
    DrawnKind {
        name: "ablation-wires",
        title: "wires",
        noise_levels: 3.0,
        pan_rad: 0.0,
        clutter: wires,
    },
    DrawnKind {
        name: "ablation-birds",
        title: "birds",
        noise_levels: 3.0,
        pan_rad: 0.0,
        clutter: birds,
    },
    DrawnKind {
        name: "ablation-edges",
        title: "clouds with edges, before and behind the target",
        noise_levels: 3.0,
        pan_rad: 0.0,
        clutter: clouds,
    },
    DrawnKind {
        name: "ablation-pan",
        title: "a camera that pans over masts",
        noise_levels: 3.0,
        pan_rad: 0.3,
        clutter: masts,
    },
];

/// Frames per second. With half of it the target moves by twice as much from image to image.
const RATE_HZ: f64 = 30.0;
/// How long a scene lasts, s. With half of it the target crosses what is in its way once at most.
const DURATION_S: f64 = 10.0;
/// Columns and rows of the images. With half of them each run takes a quarter of the time, and the
/// scenes leave the image.
const SIZE_PX: [u32; 2] = [320, 240];
/// Focal length, px: a field of view of 56 degrees across. With half of it the target is half as
/// large in the image.
const FOCAL_PX: f64 = 300.0;
/// Distance of the target's path, m. With half of it the target is twice as large in the image, and
/// before all that should hide it.
const RANGE_M: f64 = 100.0;
/// Span of the target, m: 9 px there. With half of it it is lost in the noise at once.
const SPAN_M: f64 = 3.0;
/// Height of a silhouette as a share of its span, as it is drawn. With half of it the box would be
/// twice as high as its target.
const HEIGHT: f64 = 0.4;
/// Period of the camera's pan, s. With half of it the scene moves by 12 px an image at most,
/// instead of 6.
const PAN_S: f64 = 3.0;
/// How the target is given: a box beside it and too large, as an operator draws it. With half of
/// both the box needs no correction.
const START: TrialStart = TrialStart { aside_px: 3.0, larger: 1.3, later_s: 0.0 };

/// Upright masts, bright and dark, before the target and behind it.
fn masts(noise: &mut Noise) -> Vec<SceneClutter> {
    [(80.0, 235.0), (85.0, 30.0), (130.0, 235.0), (130.0, 30.0)]
        .map(|(range, level)| SceneClutter::Mast {
            foot_m: [(noise.uniform() - 0.5) * 60.0 * range / RANGE_M, range, -60.0],
            height_m: 60.0 + (noise.uniform() + 0.5) * 30.0,
            width_m: 1.2 * range / RANGE_M,
            level,
        })
        .into()
}

/// Wires behind the target, which its sight line crosses.
fn wires(noise: &mut Noise) -> Vec<SceneClutter> {
    [-12.0, 0.0, 12.0].map(|up| wire(up, noise)).into()
}

/// A wire whose ends are about `up` m above the camera.
fn wire(up: f64, noise: &mut Noise) -> SceneClutter {
    let mut end = || up + (noise.uniform() - 0.5) * 12.0;
    SceneClutter::Wire {
        from_m: [-80.0, 120.0, end()],
        to_m: [80.0, 120.0, end()],
        sag_m: 5.0,
        width_m: 0.5,
        level: 40.0,
    }
}

/// Birds as large and as dark as the target, on paths of their own.
fn birds(noise: &mut Noise) -> Vec<SceneClutter> {
    (0..4).map(|_| bird(noise)).collect()
}

fn bird(noise: &mut Noise) -> SceneClutter {
    SceneClutter::Bird {
        span_m: SPAN_M * (0.7 + 0.6 * noise.uniform()),
        beats_per_s: 2.0 + 4.0 * noise.uniform(),
        level: 70.0,
        path: path(noise, 95.0),
    }
}

/// Clouds: a large bright one and a large dark one behind the target, small ones before it.
fn clouds(noise: &mut Noise) -> Vec<SceneClutter> {
    let near = (70.0, 5.0, 170.0);
    [(140.0, 40.0, 225.0), (140.0, 30.0, 95.0), near, near, near, near]
        .map(|(range, radius_m, level)| SceneClutter::Cloud {
            centre_m: [
                (noise.uniform() - 0.5) * 0.9 * range,
                range,
                (noise.uniform() - 0.5) * 0.6 * range,
            ],
            radius_m,
            edge_m: 1.5,
            level,
        })
        .into()
}

/// A curved path that crosses the image in a few seconds.
fn path(noise: &mut Noise, range_m: f64) -> FlightPath {
    FlightPath::Curved {
        centre_m: [0.0, range_m, 0.0],
        amplitude_m: [35.0, 4.0, 24.0],
        period_s: [7.0 + 4.0 * noise.uniform(), 9.0, 5.0 + 4.0 * noise.uniform()],
        phase_turns: [noise.uniform(), 0.0, noise.uniform()],
    }
}

/// One run of a kind of scene.
pub(super) struct DrawnRun {
    camera: SimulatedCamera,
    path: FlightPath,
    pan_rad: f64,
}

impl DrawnRun {
    /// Run number `run` of a kind.
    ///
    /// # Panics
    /// If a scene of this file is impossible.
    pub(super) fn new(kind: &DrawnKind, seed: u64, run: usize) -> Self {
        let mut noise = Noise::new(seed, run);
        let path = path(&mut noise, RANGE_M);
        let scene = Scene {
            seed: seed.wrapping_mul(1_000).wrapping_add(run as u64),
            duration_s: DURATION_S,
            targets: vec![SceneTarget {
                id: 1,
                span_m: SPAN_M,
                appears_s: 0.0,
                path: path.clone(),
            }],
            cameras: vec![camera(kind)],
            clutter: (kind.clutter)(&mut noise),
        };
        let world = scene.build().unwrap_or_else(|error| panic!("{}: {error}", kind.title));
        Self { camera: world.cameras()[0].clone(), path, pan_rad: kind.pan_rad }
    }

    /// Follows the target with all parts, and without each of some.
    pub(super) fn scores(&self, parts: &[TrackerPart]) -> RunScores {
        let mut trials: Vec<Trial> = Vec::new();
        for index in 0..self.camera.frames() {
            let angles = self.angles(index);
            let rendered = self.camera.frame_pointing(index, angles);
            let bytes = rendered.brightness;
            let image = Plane::from_fn(rendered.width, rendered.height, |x, y| {
                f32::from(bytes[y * rendered.width + x])
            });
            let label = self.label(index, angles);
            if let Some(label) = label.filter(|_| trials.is_empty()) {
                let given = START.of(label);
                trials.extend(configurations(parts).map(|config| Trial::new(config, given)));
            }
            let time = Timestamp::from_seconds(rendered.own_s);
            trials.iter_mut().for_each(|trial| trial.step(&image, time, label));
        }
        trials.into_iter().map(Trial::score).collect()
    }

    /// Where the camera points.
    fn angles(&self, index: u64) -> ScanAngles {
        let azimuth = self.pan_rad * (TAU * self.camera.true_time(index) / PAN_S).sin();
        ScanAngles { azimuth, elevation: 0.0 }
    }

    /// The target's box, if its centre is in the image.
    fn label(&self, index: u64, angles: ScanAngles) -> Option<PixelBox> {
        let camera = self.camera.camera_pointing(angles);
        let place: Point3<f64> = self.path.state(self.camera.true_time(index)).0;
        let pixel = camera.project(place).filter(|_| camera.sees(place))?;
        let span = SPAN_M * FOCAL_PX / (place - camera.pose().position()).norm();
        let centre = ImagePoint { x: pixel.x(), y: pixel.y() };
        Some(PixelBox::about(centre, span, HEIGHT * span))
    }
}

/// The camera of a kind of scene.
fn camera(kind: &DrawnKind) -> SceneCamera {
    SceneCamera {
        name: "drawn".parse().unwrap_or_else(|_| unreachable!("a plain name")),
        position_m: [0.0; 3],
        look_at_m: [0.0, RANGE_M, 0.0],
        size_px: SIZE_PX,
        focal_px: FOCAL_PX,
        distortion: [0.0; 5],
        rate_hz: RATE_HZ,
        phase_s: 0.0,
        exposure_s: 0.002,
        noise_levels: kind.noise_levels,
        blur_px: 0.7,
        clock: SimulatedClock::default(),
        mount: (kind.pan_rad > 0.0).then(|| SceneMount {
            azimuth_deg: [-90.0, 90.0],
            elevation_deg: [-30.0, 30.0],
            rate_deg_per_s: 100.0,
            angle_sd_mrad: 0.0,
        }),
    }
}
