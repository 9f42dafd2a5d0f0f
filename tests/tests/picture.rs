//! What the demo's picture shows, as Rerun's own reader and viewer see it.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a test that cannot set itself up has failed, and one that is skipped says so"
)]

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use crossfix_simulation::{Scene, World};
use crossfix_tests::succeed;
use nalgebra::{Point3, Vector3};
use serde::Deserialize;

const READER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/peers/picture.py");
const DURATION_S: f64 = 10.0;
/// No line, point or box is drawn anew more often than this, 1/s: what is fewer moves in jerks, and what
/// is more fills the viewer's memory.
const DRAWN_HZ: std::ops::Range<f64> = 5.0..12.0;

#[derive(Debug, Deserialize)]
struct Shown {
    entities: BTreeMap<String, Entity>,
    shown: Option<usize>,
}

#[derive(Debug, Deserialize)]
struct Entity {
    rows: usize,
    components: Vec<String>,
    low: Option<[f64; 3]>,
    high: Option<[f64; 3]>,
}

impl Entity {
    fn has(&self, component: &str) -> bool {
        self.components.iter().any(|one| one == component)
    }

    /// Whether it reaches from one corner to another, within so many metres.
    fn reaches(&self, low: Point3<f64>, high: Point3<f64>, within_m: f64) -> bool {
        let near = |corner: Option<[f64; 3]>, wanted: Point3<f64>| {
            corner.is_some_and(|corner| (Point3::from(corner) - wanted).amax() < within_m)
        };
        near(self.low, low) && near(self.high, high)
    }
}

/// The picture as Rerun reads it; `None` and a clear word where Rerun is not to be had.
fn shown(picture: &Path) -> Option<Shown> {
    let python = std::env::var("CROSSFIX_CHECKERS").unwrap_or_default();
    let has_reader = Command::new(&python).args(["-c", "import rerun.experimental, PIL"]).output();
    if !has_reader.is_ok_and(|tried| tried.status.success()) {
        eprintln!("SKIPPED: CROSSFIX_CHECKERS is no Python with PyPI's rerun-sdk");
        return None;
    }
    // Kept, to be looked at.
    let png = Path::new(env!("CARGO_TARGET_TMPDIR")).join("demo.png");
    let output = Command::new(&python).arg(READER).arg(picture).arg(&png).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    println!("{}", png.display());
    Some(serde_json::from_slice(&output.stdout).unwrap())
}

/// They appear after a second, and are found within the half second after; that is how far they fly
/// in a quarter of one, m.
const FOUND_AFTER_S: f64 = 1.5;
const NEAR_M: f64 = 2.5;

/// The corners of where a target of the scene flies once it has been found.
fn corners(world: &World, id: u64) -> (Point3<f64>, Point3<f64>) {
    let times =
        (0..=100).map(|k| FOUND_AFTER_S + (DURATION_S - FOUND_AFTER_S) * f64::from(k) / 100.0);
    let of_id = |t: f64| world.truth(t).into_iter().find(|target| target.id == id);
    let places: Vec<Point3<f64>> = times.filter_map(|t| Some(of_id(t)?.position)).collect();
    let fold = |pick: fn(f64, f64) -> f64| {
        let all = places.iter().map(|place| place.coords);
        Point3::from(all.reduce(|a, b| a.zip_map(&b, pick)).unwrap())
    };
    (fold(f64::min), fold(f64::max))
}

#[test]
fn the_demos_picture_shows_the_site_its_cameras_and_each_target_where_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("out");
    let duration = DURATION_S.to_string();
    let arguments = ["-q", "demo", "--duration", &duration, "--json", "--output"];
    succeed(&[&arguments[..], &[output.to_str().unwrap()]].concat());
    let Some(Shown { entities, shown }) = shown(&output.join("demo.rrd")) else { return };
    let scene: Scene = toml::from_str(include_str!("../../configs/demo/scene.toml")).unwrap();
    let world = scene.build().unwrap();
    let of = |path: &str| entities.get(path).unwrap_or_else(|| panic!("nothing at {path}"));
    let is_drawn = |path: &str| {
        let rows = of(path).rows as f64;
        let hz = DRAWN_HZ.start * DURATION_S..DRAWN_HZ.end * DURATION_S + 2.0;
        assert!(hz.contains(&rows), "{path}: {rows} rows");
    };

    for camera in &scene.cameras {
        let (name, place) = (&camera.name, Point3::from(camera.position_m));
        let stand = of(&format!("/world/cameras/{name}"));
        assert!(stand.has("Transform3D:mat3x3") && stand.reaches(place, place, 0.01), "{name}");
        let image = of(&format!("/world/cameras/{name}/image"));
        assert!(image.has("Pinhole:image_from_camera") && image.has("EncodedImage:blob"), "{name}");
        for drawn in ["targets", "tracks", "numbers"] {
            is_drawn(&format!("/world/cameras/{name}/image/{drawn}"));
        }
        let lines = format!("/world/sight_lines/{name}");
        is_drawn(&lines);
        // They begin at the camera and reach over the field.
        let (low, high) =
            (Point3::from(of(&lines).low.unwrap()), Point3::from(of(&lines).high.unwrap()));
        let is_within =
            (0..3).all(|axis| low[axis] <= place[axis] + 0.01 && place[axis] <= high[axis] + 0.01);
        assert!(is_within && (high - low).norm() > 100.0, "{name}: {low} {high}");
        assert!(of(&format!("/plots/residual/{name}")).has("Scalars:scalars"));
        of(&format!("/world/names/{name}"));
    }
    let tracks: Vec<&String> = entities
        .keys()
        .filter(|path| path.starts_with("/world/tracks/") && path.ends_with("/position"))
        .collect();
    assert_eq!(tracks.len(), 2, "two targets, each one track: {tracks:?}");
    for id in [1, 2] {
        let (low, high) = corners(&world, id);
        let of_target = |path: &&&String| entities[**path].reaches(low, high, NEAR_M);
        let track = tracks.iter().find(of_target).unwrap_or_else(|| panic!("{id}: {low} {high}"));
        let folder = track.trim_end_matches("/position");
        for (drawn, component) in [
            ("position", "Points3D:labels"),
            ("trail", "LineStrips3D:strips"),
            ("velocity", "Arrows3D:vectors"),
            ("covariance", "Ellipsoids3D:half_sizes"),
        ] {
            let path = format!("{folder}/{drawn}");
            is_drawn(&path);
            assert!(of(&path).has(component), "{path}");
        }
        let ellipsoids = of(&format!("{folder}/covariance"));
        assert!(ellipsoids.reaches(low, high, NEAR_M), "they lie where the track is");
    }
    // The ground is under all cameras, and north is shown.
    let ground = of("/world/ground/grid");
    let (low, high) = (Point3::from(ground.low.unwrap()), Point3::from(ground.high.unwrap()));
    for camera in &scene.cameras {
        let beside = Vector3::from(camera.position_m);
        let is_on = (0..2).all(|axis| (low[axis]..=high[axis]).contains(&beside[axis]));
        assert!(is_on, "{} stands beside the ground {low} {high}", camera.name);
    }
    for path in
        ["/world/ground/north", "/world/ground/scale", "/plots/latency", "/events", "/legend"]
    {
        of(path);
    }
    // Born and confirmed, both.
    assert_eq!(of("/events").rows, 4);
    match shown {
        Some(colours) => assert!(colours > 1000, "the viewer shows next to nothing: {colours}"),
        None => eprintln!("SKIPPED: Rerun's viewer cannot draw here (mesa-vulkan-drivers)"),
    }
}
