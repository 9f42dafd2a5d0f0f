//! A camera on a mount that is told where to look, and what its bearings are worth then.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]
#![allow(dead_code, reason = "each test uses what it needs of the common scene")]

mod common;

use common::{Eye, Path, Scene, calibration, eye, found, fusion_of, site, straight};
use crossfix_fusion::{Fusion, FusionConfig, Output};
use crossfix_geometry::{PanTilt, ScanAngles, tangent_basis};
use crossfix_message::{
    BearingFrame, BearingTrack, CueFrame, Expected, ImageTrackState, Pointing, Timestamp,
};
use nalgebra::{Matrix2, Matrix6, Unit, Vector2, Vector3, Vector6};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Noise of the narrow camera's bearings, rad: ten times less than the wide ones'.
const NARROW_SD_RAD: f64 = 5e-5;
/// What its mount's angles are off by, rad, anew after each turn.
const ENCODER_SD_RAD: f64 = 2e-4;
/// It turns again when the target is so far from the middle, rad: it sees 180 mrad to each side.
const OFF_AXIS_RAD: f64 = 0.06;
/// A turn takes so many exposures.
const TURNING: u32 = 3;

/// A narrow camera beside the second wide one, that looks away at rest.
fn narrow() -> Eye {
    let mut eye = eye("narrow", [92.0, -118.0, 5.0], [400.0, -300.0, 30.0], 0.05);
    let mut lens = *eye.camera.model().intrinsics();
    (lens.fx, lens.fy) = (5000.0, 5000.0);
    eye.camera = crossfix_geometry::Camera::new(lens, *eye.camera.pose()).unwrap();
    eye
}

/// A narrow camera on a mount as it really points, and as it says.
struct Head {
    eye: Eye,
    mount: PanTilt,
    truth: ScanAngles,
    said: ScanAngles,
    turning: u32,
    cues: Option<CueFrame>,
    /// Whether its detector takes what goes by in a turn for targets.
    sees_ghosts: bool,
    /// What its clock is said to be off by, s.
    clock_sd_s: f64,
    frames: u64,
    noise: ChaCha8Rng,
}

impl Head {
    fn new(seed: u64) -> Self {
        let eye = narrow();
        let mount = PanTilt::new(*eye.camera.pose(), [-3.2, 3.2], [-0.5, 1.5]).unwrap();
        let rest = ScanAngles { azimuth: 0.0, elevation: 0.0 };
        let noise = ChaCha8Rng::seed_from_u64(seed);
        Self {
            eye,
            mount,
            truth: rest,
            said: rest,
            turning: 0,
            cues: None,
            sees_ghosts: false,
            clock_sd_s: 0.0,
            frames: 0,
            noise,
        }
    }

    fn normal(&mut self) -> f64 {
        StandardNormal.sample(&mut self.noise)
    }

    /// Where the first cue has its target, in the frame at rest; by then in a line.
    fn expected(&self, t: f64) -> Option<Unit<Vector3<f64>>> {
        let cue = self.cues.as_ref()?.cues.first()?;
        let at = |k: usize| {
            let one = &cue.ahead[k];
            let seconds = Timestamp::from_nanos(one.time_ns).seconds();
            (seconds, Vector3::from(one.bearing.unwrap()))
        };
        let ((t0, v0), (t1, v1)) = (at(0), at(2));
        Some(Unit::new_normalize(v0 + (v1 - v0) * ((t - t0) / (t1 - t0))))
    }

    /// Turns where it is told, if it has not, or the target has gone.
    fn turn(&mut self, t: f64) {
        if self.turning > 0 {
            self.turning -= 1;
            return;
        }
        let Some(expected) = self.expected(t) else { return };
        let axis = self.mount.rest().rotation().inverse()
            * (self.mount.pose(self.said).rotation() * Vector3::z());
        if expected.angle(&axis) > OFF_AXIS_RAD {
            let ahead = self.expected(t + 0.8).unwrap();
            self.said = self.mount.aim(&ahead);
            let [azimuth, elevation] = [self.normal(), self.normal()];
            self.truth = ScanAngles {
                azimuth: self.said.azimuth + azimuth * ENCODER_SD_RAD,
                elevation: self.said.elevation + elevation * ENCODER_SD_RAD,
            };
            self.turning = TURNING;
        }
    }

    /// Its frame of a time.
    fn frame(&mut self, time_ns: i64, path: &Path) -> BearingFrame {
        let t = time_ns as f64 * 1e-9;
        self.turn(t);
        let camera = self.eye.camera.posed(self.mount.pose(self.truth));
        let noise = Vector2::new(self.normal(), self.normal()) * NARROW_SD_RAD;
        let place = path(t).filter(|place| self.turning == 0 && camera.sees(*place));
        let seen = place.map(|place| camera.pose().camera_from_world(place));
        let ghost = (self.turning > 0 && self.sees_ghosts).then(|| Vector3::new(0.01, 0.02, 1.0));
        let track = seen.or(ghost).map(|seen| {
            let exact = Unit::new_normalize(seen);
            let towards = (exact.into_inner() + tangent_basis(&exact) * noise).normalize();
            BearingTrack {
                track_id: 1,
                bearing: Some(towards.into()),
                covariance_xx: NARROW_SD_RAD.powi(2),
                covariance_yy: NARROW_SD_RAD.powi(2),
                state: ImageTrackState::Tracking.into(),
                ..Default::default()
            }
        });
        self.frames += 1;
        BearingFrame {
            camera: self.eye.name.to_string(),
            sequence: self.frames,
            capture_time_ns: time_ns,
            capture_time_sd_s: self.clock_sd_s,
            tracks: track.into_iter().collect(),
            pointing: Some(Pointing {
                azimuth: self.said.azimuth,
                elevation: self.said.elevation,
                azimuth_sd: ENCODER_SD_RAD,
                elevation_sd: ENCODER_SD_RAD,
                settled: self.turning == 0,
            }),
            ..Default::default()
        }
    }
}

/// A fusion centre of the site, and of the head.
fn centre(eyes: &[Eye], head: &Head) -> Fusion {
    let mut fusion = fusion_of(FusionConfig::default(), eyes);
    let message = calibration(&head.eye).on_mount(&head.mount);
    fusion.calibrate(&message).unwrap();
    fusion
}

/// Runs wide cameras and the head, and gives what each cue says and the fusion centre after each
/// wide frame to `see`.
fn run(
    scene: &Scene,
    head: &mut Head,
    seed: u64,
    mut see: impl FnMut(&mut Head, &Fusion, Option<CueFrame>),
) {
    let mut fusion = centre(&scene.eyes, head);
    let mut wide = scene.frames(seed).into_iter().peekable();
    let mut k = 0;
    let heard = |outputs: Vec<Output>| {
        outputs
            .into_iter()
            .filter_map(|output| match output {
                Output::Cues(cues) => Some(cues),
                _ => None,
            })
            .next_back()
    };
    while let Some(next) = wide.peek() {
        let own_ns = 50_000_000 + k * 100_000_000;
        let outputs = if own_ns <= next.capture_time_ns {
            k += 1;
            let frame = head.frame(own_ns, &scene.paths[0]);
            fusion.ingest(&frame)
        } else {
            fusion.ingest(&wide.next().unwrap())
        };
        let cues = heard(outputs);
        if let Some(cues) = &cues {
            head.cues = Some(cues.clone());
        }
        see(head, &fusion, cues);
    }
}

/// How far a cue is from the truth, squared, in its own deviations: two degrees of freedom.
fn squared_distance(head: &Head, cue: &crossfix_message::Cue, ahead: usize, path: &Path) -> f64 {
    let expected = &cue.ahead[ahead];
    let t = Timestamp::from_nanos(expected.time_ns).seconds();
    let truth = head.mount.rest().camera_from_world(path(t).unwrap());
    let direction = Unit::new_normalize(Vector3::from(expected.bearing.unwrap()));
    // As far away as the angle says: a stripe is longer than a plane is flat.
    let across = tangent_basis(&direction).transpose() * truth;
    let aside = across.normalize() * direction.angle(&truth);
    let [xx, xy, yy] = [expected.covariance_xx, expected.covariance_xy, expected.covariance_yy];
    aside.dot(&(Matrix2::new(xx, xy, xy, yy).try_inverse().unwrap() * aside))
}

#[test]
fn a_cue_says_where_the_target_will_be_as_well_as_it_is_known() {
    let (mut now, mut ahead, mut largest_s) = (Vec::new(), Vec::new(), 0.0f64);
    for seed in 0..20 {
        let path = || straight([-30.0, 5.0, 40.0], [8.0, 2.0, 0.5]);
        let scene = Scene::new(vec![path()], 8.0);
        let mut head = Head::new(100 + seed);
        let mut last: Option<i64> = None;
        run(&scene, &mut head, seed, |head, _, cues| {
            let Some(cues) = cues else { return };
            let t = Timestamp::from_nanos(cues.time_ns).seconds();
            if let Some(before) = last.replace(cues.time_ns) {
                largest_s = largest_s.max((cues.time_ns - before) as f64 * 1e-9);
            }
            if t < 2.0 || (t * 10.0).round() as i64 % 20 != 0 {
                return;
            }
            assert_eq!(cues.cues.len(), 1, "at {t}");
            now.push(squared_distance(head, &cues.cues[0], 0, &scene.paths[0]));
            ahead.push(squared_distance(head, &cues.cues[0], 2, &scene.paths[0]));
        });
    }
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    println!(
        "{} cues: {:.2} now, {:.2} half a second ahead, of 2",
        now.len(),
        mean(&now),
        mean(&ahead)
    );
    // Straight flight is calmer than the models allow for, so what lies ahead is known better.
    assert!((1.2..2.6).contains(&mean(&now)), "{}", mean(&now));
    assert!((0.3..2.6).contains(&mean(&ahead)), "{}", mean(&ahead));
    assert!(largest_s < 0.21, "{largest_s}");
}

#[test]
fn a_narrow_camera_that_follows_cues_makes_the_track_better_and_the_track_knows_how_much() {
    let path = || -> Path {
        Box::new(|t| {
            let (sin, cos) = (0.25 * t).sin_cos();
            Some(nalgebra::Point3::new(30.0 * cos, 30.0 * sin, 40.0 + 0.2 * t))
        })
    };
    // Squared errors across the narrow camera's line and in all, with it and without; distances.
    let (mut errors, mut nees, mut turns, mut looks) = ([0.0; 2], Vec::new(), 0, 0);
    for with in [true, false] {
        for seed in 0..12 {
            let scene = Scene::new(vec![path()], 16.0);
            let mut head = Head::new(200 + seed);
            let mut was_turning = false;
            let mut next = 4.0;
            run(&scene, &mut head, seed, |head, fusion, _| {
                if !with {
                    head.cues = None;
                }
                turns += u32::from(head.turning > 0 && !was_turning);
                was_turning = head.turning > 0;
                let Some(track) = found(fusion, &scene.paths[0]) else { return };
                let t = track.updated_at.seconds();
                if t < next {
                    return;
                }
                next += 0.5;
                looks += 1;
                let truth = (scene.paths[0])(t).unwrap();
                let d = 1e-4;
                let velocity = ((scene.paths[0])(t + d).unwrap()
                    - (scene.paths[0])(t - d).unwrap())
                    / (2.0 * d);
                let state = track.state();
                let mut error = Vector6::zeros();
                error.fixed_rows_mut::<3>(0).copy_from(&(state.position() - truth));
                error.fixed_rows_mut::<3>(3).copy_from(&(state.velocity() - velocity));
                errors[usize::from(!with)] += error.fixed_rows::<3>(0).norm_squared();
                if with {
                    let covariance: Matrix6<f64> = state.covariance;
                    nees.push(error.dot(&(covariance.try_inverse().unwrap() * error)));
                }
            });
        }
    }
    let [with, without] = errors.map(|sum| (sum / f64::from(looks / 2)).sqrt());
    let mean = nees.iter().sum::<f64>() / nees.len() as f64;
    println!("with it {with:.3} m, without {without:.3} m; NEES {mean:.2} of 6; {turns} turns");
    assert!(turns > 12 * 4, "it follows: {turns}");
    assert!(with < 0.8 * without, "{with} {without}");
    assert!((4.0..9.0).contains(&mean), "{mean}");
}

#[test]
fn what_one_camera_alone_sees_is_looked_for_along_its_sight_line() {
    let mut held = Vec::new();
    for (seed, near) in [(1, -90.0), (2, -20.0), (3, 400.0)] {
        let path = straight([near, -25.0, 40.0], [3.0, 9.0, 0.0]);
        let mut scene = Scene::new(vec![path], 4.0);
        // The first wide camera alone.
        scene.eyes.truncate(1);
        let mut head = Head::new(7);
        run(&scene, &mut head, seed, |head, fusion, cues| {
            assert!(fusion.tracks().all(|track| !track.is_confirmed()));
            // It stays where it is: nobody else sees the target.
            head.cues = None;
            let Some(cue) = cues.as_ref().and_then(|cues| cues.cues.first()) else { return };
            assert_eq!(cue.of.as_ref().unwrap().camera, "a");
            assert!(cue.log_range_sd > 0.5, "{cue:?}");
            held.push(squared_distance(head, cue, 0, &scene.paths[0]));
            let spread = &cue.ahead[0];
            assert!(spread.covariance_xx + spread.covariance_yy > 0.01, "a stripe: {spread:?}");
        });
    }
    assert!(held.len() > 90, "{}", held.len());
    // One in a hundred lies beyond 9.2; they are not independent.
    let beyond = held.iter().filter(|squared| **squared > 9.2).count();
    let mean = held.iter().sum::<f64>() / held.len() as f64;
    assert!(beyond <= held.len() / 20 && (1.0..4.0).contains(&mean), "{beyond}, {mean}: {held:?}");
}

#[test]
fn a_camera_on_a_mount_that_does_not_say_where_it_points_is_refused_frame_by_frame() {
    let head = Head::new(1);
    let mut fusion = centre(&site(), &head);
    let frame = BearingFrame {
        camera: "narrow".into(),
        capture_time_ns: 1_000_000_000,
        ..Default::default()
    };
    for pointing in [
        None,
        Some(Pointing { elevation: 2.0, ..Default::default() }),
        Some(Pointing { azimuth_sd: f64::NAN, ..Default::default() }),
        Some(Pointing { azimuth_sd: -1.0, ..Default::default() }),
    ] {
        let outputs = fusion.ingest(&BearingFrame { pointing, ..frame.clone() });
        assert!(matches!(&outputs[..], [Output::Rejected(_)]), "{outputs:?}");
    }
    assert_eq!(fusion.counters().get("rejected_pointing"), 4);
}

/// While it turns it has seen nothing, and so it has missed nothing: a track of two cameras that it
/// should see, too, lives on; and what its detector makes of the turn is not used.
#[test]
fn a_turning_camera_misses_nothing() {
    let mut scene = Scene::new(vec![straight([-30.0, 5.0, 40.0], [4.0, 2.0, 0.5])], 10.0);
    scene.eyes.truncate(2);
    let mut head = Head::new(3);
    // It looks where the target is.
    let towards = head.mount.rest().camera_from_world((scene.paths[0])(5.0).unwrap());
    head.said = head.mount.aim(&Unit::new_normalize(towards));
    (head.truth, head.turning, head.sees_ghosts) = (head.said, 5, true);
    let (mut looks, mut seen, mut ghosts) = (0, 0, 0);
    run(&scene, &mut head, 3, |head, fusion, _| {
        // It turns for ever, and says so.
        head.turning = 5;
        let after_start = fusion.now().is_some_and(|now| now.seconds() > 3.0);
        looks += u32::from(after_start);
        seen += u32::from(after_start && found(fusion, &scene.paths[0]).is_some());
        ghosts = fusion.counters().get("bearings_while_turning");
    });
    assert_eq!(seen, looks);
    assert!(looks > 150 && ghosts > 80, "{looks} {ghosts}");
}

/// Where its clock may be off the target may be elsewhere in its images.
#[test]
fn a_cue_is_as_wide_as_the_cameras_clock_makes_it() {
    let path = || straight([-30.0, 5.0, 40.0], [8.0, 2.0, 0.5]);
    let widest = |clock_sd_s: f64| {
        let scene = Scene::new(vec![path()], 4.0);
        let mut head = Head::new(5);
        head.clock_sd_s = clock_sd_s;
        let mut widest = 0.0;
        run(&scene, &mut head, 5, |head, _, cues| {
            // It stays where it is, and sees nothing by which its clock could be learnt.
            head.cues = None;
            if let Some(cue) = cues.as_ref().and_then(|cues| cues.cues.first()) {
                let Expected { covariance_xx, covariance_yy, .. } = cue.ahead[0];
                widest = (covariance_xx + covariance_yy).sqrt();
            }
        });
        widest
    };
    let (exact, unsure) = (widest(0.0), widest(0.1));
    // 8 m/s at some 165 m for a tenth of a second, across or so.
    assert!(exact < 2e-3 && (2e-3..8e-3).contains(&unsure), "{exact} {unsure}");
}
