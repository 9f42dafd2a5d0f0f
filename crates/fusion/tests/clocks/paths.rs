//! Targets of many ways of flying before three or six cameras of one rate.

use crossfix_geometry::{Camera, Intrinsics};
use nalgebra::Point3;

use crate::common::{Eye, Path, Scene, eye, site, straight};

/// How long a target flies, s.
pub const FLIGHT_S: f64 = 60.0;

/// What makes a path.
pub type MakePath = fn() -> Path;

/// All paths by their names.
pub const PATHS: [(&str, MakePath); 9] = [
    ("pass", pass),
    ("fast pass", fast_pass),
    ("circle", circle),
    ("weaving", weaving),
    ("spiral", spiral),
    ("shuttle", shuttle),
    ("six passes", six_passes),
    ("hovering", hovering),
    ("racing", racing),
];

/// A straight pass of 10 m/s that the three cameras see for 20 of 60 s.
pub fn pass() -> Path {
    straight([-300.0, 60.0, 40.0], [10.0, -2.0, 0.2])
}

/// The same of 30 m/s: 9 s.
pub fn fast_pass() -> Path {
    straight([-900.0, 20.0, 40.0], [30.0, -1.0, 0.2])
}

/// A circle of 12 m/s round the middle of the site.
pub fn circle() -> Path {
    Box::new(|t| {
        let (sin, cos) = (0.3 * t).sin_cos();
        Some(Point3::new(40.0 * cos, 40.0 * sin, 45.0 + 5.0 * (0.2 * t).sin()))
    })
}

/// The straight pass with turns of 8 m to either side.
pub fn weaving() -> Path {
    Box::new(|t| {
        let side = 8.0 * (0.8 * t).sin();
        Some(Point3::new(-300.0 + 10.0 * t + 0.2 * side, 60.0 - 2.0 * t + side, 40.0 + 0.2 * t))
    })
}

/// 12 m/s round, 0.8 m/s up.
pub fn spiral() -> Path {
    Box::new(|t| {
        let (sin, cos) = (0.4 * t).sin_cos();
        Some(Point3::new(30.0 * cos, 30.0 * sin, 20.0 + 0.8 * t))
    })
}

/// There and back on a line: 4 m/s^2 up to 20 m/s, 4 m/s^2 down to rest, and back.
pub fn shuttle() -> Path {
    Box::new(|t| {
        let s = t.rem_euclid(20.0);
        let leg = |s: f64| if s < 5.0 { 2.0 * s * s } else { 100.0 - 2.0 * (10.0 - s).powi(2) };
        let x = if s < 10.0 { leg(s) } else { 100.0 - leg(s - 10.0) };
        Some(Point3::new(-45.0 + 0.9 * x, 20.0 - 0.4 * x, 40.0 + 0.15 * x))
    })
}

/// Six passes of 30 m/s in as many directions, ten seconds each.
pub fn six_passes() -> Path {
    Box::new(|t| {
        let pass = (t / 10.0).floor();
        let along = 30.0 * (t - 10.0 * pass - 5.0);
        let (sin, cos) = (1.1 * pass).sin_cos();
        Some(Point3::new(along * cos - 15.0 * sin, along * sin + 15.0 * cos, 40.0 + 0.05 * along))
    })
}

/// Half a minute on the spot, then circles of 12 m/s.
pub fn hovering() -> Path {
    let circle = circle();
    Box::new(move |t| circle((t - 30.0).max(0.0)))
}

/// Turns of two times gravity at 20 m/s.
pub fn racing() -> Path {
    Box::new(|t| {
        let (sin, cos) = t.sin_cos();
        Some(Point3::new(20.0 * cos, 20.0 * sin, 40.0 + 3.0 * (0.7 * t).sin()))
    })
}

/// Targets before these cameras, all of them this fast.
pub fn scene(eyes: Vec<Eye>, paths: Vec<Path>, rate_hz: f64) -> Scene {
    let mut scene = Scene { eyes, ..Scene::new(paths, FLIGHT_S) };
    for eye in &mut scene.eyes {
        eye.phase_s *= 10.0 / rate_hz;
        eye.rate_hz = rate_hz;
    }
    scene
}

/// Six cameras.
pub fn six() -> Vec<Eye> {
    let middle = [0.0, 0.0, 40.0];
    let mut eyes = site();
    eyes.push(eye("d", [-40.0, 150.0, 4.0], middle, 0.015));
    eyes.push(eye("e", [-30.0, -160.0, 2.0], middle, 0.08));
    eyes.push(eye("f", [160.0, 10.0, 2.0], middle, 0.05));
    eyes
}

/// A straight flight of a minute before three cameras that see all of it: 150 m from it with lenses
/// as wide as that needs (noise of an angle stays as it is), or `farther` times as far with
/// narrower ones.
pub fn a_minute_in_sight(speed: f64, farther: f64, rate_hz: f64) -> Scene {
    let path = move || straight([-30.0 * speed, 0.0, 40.0], [speed, 0.0, 0.0]);
    let places =
        [("a", [-60.0, -150.0, 2.0]), ("b", [60.0, -140.0, 5.0]), ("c", [0.0, 150.0, 3.0])];
    let eyes = places.into_iter().zip(site()).map(|((name, [x, y, z]), like)| {
        let (x, y) = (farther * x, farther * y);
        let narrow = eye(name, [x, y, z], [x, 0.0, 40.0], like.phase_s);
        let ends =
            [0.0, FLIGHT_S].map(|t| narrow.camera.pose().camera_from_world(path()(t).unwrap()));
        let widest = ends.iter().map(|end| (end.x / end.z).abs()).fold(0.0, f64::max);
        let lens = *narrow.camera.model().intrinsics();
        let wide = Intrinsics { fx: 950.0 / widest, fy: 950.0 / widest, ..lens };
        Eye { camera: Camera::new(wide, *narrow.camera.pose()).unwrap(), ..narrow }
    });
    scene(eyes.collect(), vec![path()], rate_hz)
}
