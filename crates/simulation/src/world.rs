use crossfix_geometry::{Camera, PanTilt, ScanAngles};
use crossfix_message::CameraName;
use nalgebra::{Point3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::render::{RenderedTarget, RenderedThing, draw};
use crate::sky::{Panorama, sky};
use crate::{
    RenderedFrame, Scene, SceneCamera, SceneClutter, SceneError, SceneTarget, SimulatedMount,
};

/// True state of a target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TargetState {
    /// Its number.
    pub id: u64,
    /// Position, metres, world.
    pub position: Point3<f64>,
    /// Velocity, metres per second, world.
    pub velocity: Vector3<f64>,
}

/// A scene built from its description, ready to be rendered.
#[derive(Clone, Debug)]
pub struct World {
    targets: Vec<SceneTarget>,
    cameras: Vec<SimulatedCamera>,
    duration_s: f64,
}

/// A thing before a camera.
enum InView {
    Target(RenderedTarget),
    Clutter(RenderedThing),
}

/// A camera of a scene.
#[derive(Clone, Debug)]
pub struct SimulatedCamera {
    description: SceneCamera,
    camera: Camera,
    pan_tilt: Option<PanTilt>,
    sky: Vec<f32>,
    panorama: Option<Panorama>,
    seed: u64,
    targets: Vec<SceneTarget>,
    clutter: Vec<SceneClutter>,
    duration_s: f64,
}

impl World {
    pub(crate) fn new(scene: &Scene) -> Result<Self, SceneError> {
        let camera = |(index, description)| SimulatedCamera::new(scene, index, description);
        let cameras = scene.cameras.iter().enumerate().map(camera).collect::<Result<_, _>>()?;
        Ok(Self { targets: scene.targets.clone(), cameras, duration_s: scene.duration_s })
    }

    /// The cameras, in the scene's order.
    pub fn cameras(&self) -> &[SimulatedCamera] {
        &self.cameras
    }

    /// The camera with this name.
    pub fn camera(&self, name: &str) -> Option<&SimulatedCamera> {
        self.cameras.iter().find(|camera| camera.name().as_str() == name)
    }

    /// How long the scene lasts, s.
    pub fn duration_s(&self) -> f64 {
        self.duration_s
    }

    /// The state of every target at a true time; targets that have not appeared yet are left out.
    pub fn truth(&self, t: f64) -> Vec<TargetState> {
        self.targets
            .iter()
            .filter(|target| t >= target.appears_s)
            .map(|target| state(target, t))
            .collect()
    }
}

fn state(target: &SceneTarget, t: f64) -> TargetState {
    let (position, velocity) = target.path.state(t);
    TargetState { id: target.id, position, velocity }
}

impl SimulatedCamera {
    fn new(scene: &Scene, index: usize, description: &SceneCamera) -> Result<Self, SceneError> {
        let impossible = |source| SceneError::Camera { camera: description.name.clone(), source };
        let camera = description.camera().map_err(impossible)?;
        let mount = description.mount.as_ref();
        let pan_tilt = mount.map(|mount| mount.pan_tilt(*camera.pose())).transpose();
        // Each camera has its own random numbers, derived from the one seed.
        let seed = scene.seed.wrapping_mul(1_000_003).wrapping_add(index as u64);
        let [width, height] = description.size_px.map(|side| side as usize);
        Ok(Self {
            description: description.clone(),
            camera,
            pan_tilt: pan_tilt.map_err(impossible)?,
            sky: sky(width, height, seed),
            panorama: mount.map(|_| Panorama::new(seed)),
            seed,
            targets: scene.targets.clone(),
            clutter: scene.clutter.clone(),
            duration_s: scene.duration_s,
        })
    }

    /// Its name.
    pub fn name(&self) -> &CameraName {
        &self.description.name
    }

    /// Its model and pose.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The geometry of its mount, if it has one.
    pub fn pan_tilt(&self) -> Option<&PanTilt> {
        self.pan_tilt.as_ref()
    }

    /// Its mount, at rest, if it has one.
    pub fn mount(&self) -> Option<SimulatedMount> {
        self.description.mount.as_ref().map(|mount| SimulatedMount::new(mount, self.seed))
    }

    /// Its description in the scene.
    pub fn description(&self) -> &SceneCamera {
        &self.description
    }

    /// Number of frames that it takes in the scene.
    pub fn frames(&self) -> u64 {
        let SceneCamera { phase_s, rate_hz, .. } = self.description;
        ((self.duration_s - phase_s) * rate_hz).ceil().max(0.0) as u64
    }

    /// True time of a frame's mid-exposure, s from the scene's start.
    pub fn true_time(&self, index: u64) -> f64 {
        self.description.phase_s + index as f64 / self.description.rate_hz
    }

    /// Renders a frame: sky, clutter, targets smeared by their motion, lens blur, noise. A camera
    /// on a mount is at rest.
    pub fn frame(&self, index: u64) -> RenderedFrame {
        self.render(index, &self.camera, self.sky.clone())
    }

    /// Renders a frame of a camera whose mount points at `angles`; without a mount, the same as
    /// [`Self::frame`].
    pub fn frame_pointing(&self, index: u64, angles: ScanAngles) -> RenderedFrame {
        let Some(panorama) = &self.panorama else { return self.frame(index) };
        let [width, height] = self.description.size_px.map(|side| side as usize);
        // A turn to the left moves the visible part of the sky to the left, a turn upwards moves it
        // up: by focal length times angle.
        let aside = |angle: f64| -(angle * self.description.focal_px).round() as i64;
        let part = [aside(angles.azimuth), aside(angles.elevation)];
        self.render(index, &self.camera_pointing(angles), panorama.part(part, width, height))
    }

    /// Its model and pose while its mount points at `angles`; without a mount, as at rest.
    pub fn camera_pointing(&self, angles: ScanAngles) -> Camera {
        let posed = |pan_tilt: &PanTilt| self.camera.posed(pan_tilt.pose(angles));
        self.pan_tilt.as_ref().map_or_else(|| self.camera.clone(), posed)
    }

    fn render(&self, index: u64, camera: &Camera, mut image: Vec<f32>) -> RenderedFrame {
        let [width, height] = self.description.size_px.map(|side| side as usize);
        let true_s = self.true_time(index);
        for thing in self.in_view(camera, true_s) {
            match thing {
                InView::Target(target) => draw(&mut image, width, height, &target),
                InView::Clutter(thing) => thing.draw(&mut image, width, self.description.blur_px),
            }
        }
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(index + 1);
        let noise = self.description.noise_levels as f32;
        let brightness = image
            .iter()
            .map(|level| {
                let deviation: f32 = StandardNormal.sample(&mut rng);
                (level + noise * deviation).round().clamp(0.0, 255.0) as u8
            })
            .collect();
        let own_s = self.description.clock.own(true_s);
        RenderedFrame { index, true_s, own_s, width, height, brightness }
    }

    /// All that is before the camera at a time, the farthest first: clutter hides what is behind
    /// it, a target darkens it.
    fn in_view(&self, camera: &Camera, t: f64) -> Vec<InView> {
        let mut things: Vec<(f64, InView)> = Vec::new();
        for target in &self.targets {
            let appearance = self.appearance(camera, target, t);
            things.extend(appearance.map(|(range, target)| (range, InView::Target(target))));
        }
        let clutter = self.clutter.iter().filter_map(|thing| thing.appearance(camera, t));
        things.extend(clutter.map(|(range, thing)| (range, InView::Clutter(thing))));
        things.sort_by(|(one, _), (other, _)| other.total_cmp(one));
        things.into_iter().map(|(_, thing)| thing).collect()
    }

    /// How a target appears in the image at a time, with its distance from the camera, m; `None`
    /// before it exists, or if it is behind the camera.
    fn appearance(
        &self,
        camera: &Camera,
        target: &SceneTarget,
        t: f64,
    ) -> Option<(f64, RenderedTarget)> {
        if t < target.appears_s {
            return None;
        }
        let half = self.description.exposure_s / 2.0;
        let range = (target.path.state(t).0 - camera.pose().position()).norm();
        let rendered = RenderedTarget {
            from: pixel_of(camera, target, t - half)?,
            to: pixel_of(camera, target, t + half)?,
            span: target.span_m * self.description.focal_px / range,
            blur: self.description.blur_px,
        };
        Some((range, rendered))
    }
}

/// Where a target is in a camera's image at a time, px.
fn pixel_of(camera: &Camera, target: &SceneTarget, t: f64) -> Option<[f64; 2]> {
    let pixel = camera.project(target.path.state(t).0)?;
    Some([pixel.x(), pixel.y()])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn world() -> World {
        let scene: Scene =
            toml::from_str(include_str!("../../../configs/demo/scene.toml")).unwrap();
        scene.build().unwrap()
    }

    #[test]
    fn a_frame_is_the_same_whenever_it_is_rendered() {
        let (one, other) = (world(), world());
        let camera = one.camera("north").unwrap();
        assert_eq!(camera.frame(17), other.camera("north").unwrap().frame(17));
        assert_ne!(camera.frame(17).brightness, camera.frame(18).brightness);
    }

    #[test]
    fn a_target_is_darker_than_the_sky_where_it_is() {
        let world = world();
        let camera = world.camera("north").unwrap();
        let frame = camera.frame(100);
        for target in world.truth(frame.true_s) {
            let Some(pixel) = camera.camera().project(target.position) else { continue };
            if !camera.camera().sees(target.position) {
                continue;
            }
            let index = pixel.y().round() as usize * frame.width + pixel.x().round() as usize;
            let sky = camera.sky[index];
            assert!(f32::from(frame.brightness[index]) < sky - 30.0, "target {}", target.id);
        }
    }

    #[test]
    fn a_mast_hides_what_is_behind_it_and_not_what_is_before_it() {
        let mut scene: Scene =
            toml::from_str(include_str!("../../../configs/demo/scene.toml")).unwrap();
        let camera = scene.build().unwrap().cameras()[0].clone();
        let (position, target) =
            (camera.camera().pose().position(), scene.targets[0].path.state(3.0).0);
        let index = (3.0 * camera.description().rate_hz) as u64;
        let pixel = camera.camera().project(target).unwrap();
        let mut seen_with_mast_at = |share: f64| {
            let foot = position + (target - position) * share - Vector3::z() * 30.0;
            scene.clutter = vec![SceneClutter::Mast {
                foot_m: foot.coords.into(),
                height_m: 60.0,
                width_m: 3.0 * share,
                level: 250.0,
            }];
            let frame = scene.build().unwrap().cameras()[0].frame(index);
            frame.brightness[pixel.y().round() as usize * frame.width + pixel.x().round() as usize]
        };
        // Noise of a few levels about the mast's brightness, and about that less the darkness.
        assert!(seen_with_mast_at(0.5) > 230);
        assert!(seen_with_mast_at(1.5) < 200);
    }

    #[test]
    fn a_thing_of_impossible_size_is_refused() {
        let mut scene: Scene =
            toml::from_str(include_str!("../../../configs/demo/scene.toml")).unwrap();
        scene.clutter = vec![SceneClutter::Cloud {
            centre_m: [0.0, 80.0, 40.0],
            radius_m: -1.0,
            edge_m: 1.0,
            level: 100.0,
        }];
        assert!(matches!(scene.build(), Err(SceneError::Clutter { index: 0 })));
    }

    #[test]
    fn a_camera_that_is_turned_to_a_target_has_it_in_the_middle() {
        let mut scene: Scene =
            toml::from_str(include_str!("../../../configs/demo/scene.toml")).unwrap();
        scene.cameras[0].mount = Some(crate::SceneMount {
            azimuth_deg: [-170.0, 170.0],
            elevation_deg: [-20.0, 80.0],
            rate_deg_per_s: 60.0,
            angle_sd_mrad: 0.0,
        });
        let world = scene.build().unwrap();
        let camera = &world.cameras()[0];
        let index = 50;
        let target = world.truth(camera.true_time(index))[0].position;
        let pan_tilt = camera.pan_tilt().unwrap();
        let direction = pan_tilt.rest().camera_from_world(target);
        let angles = pan_tilt.aim(&nalgebra::Unit::new_normalize(direction));
        let frame = camera.frame_pointing(index, angles);
        let at = |x: usize, y: usize| f32::from(frame.brightness[y * frame.width + x]);
        let (x, y) = (frame.width / 2, frame.height / 2);
        assert!(at(x, y) < at(x - 60, y) - 30.0 && at(x, y) < at(x + 60, y) - 30.0);
        // Everything in the image moves with the turn.
        let turned = ScanAngles { azimuth: angles.azimuth + 0.02, ..angles };
        assert_ne!(frame.brightness, camera.frame_pointing(index, turned).brightness);
    }

    #[test]
    fn a_scene_with_two_cameras_of_one_name_is_refused() {
        let mut scene: Scene =
            toml::from_str(include_str!("../../../configs/demo/scene.toml")).unwrap();
        scene.cameras[1].name = scene.cameras[0].name.clone();
        assert!(matches!(scene.build(), Err(SceneError::Twice { .. })));
        scene.cameras.clear();
        scene.duration_s = f64::NAN;
        assert!(matches!(scene.build(), Err(SceneError::Number { .. })));
    }
}
