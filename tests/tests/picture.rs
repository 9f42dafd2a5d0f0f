//! What pictures of a site show, as Rerun's own reader and viewer see them.

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
use crossfix_tests::{crossfix, succeed};
use nalgebra::{Point3, Vector3};
use serde::Deserialize;

/// The program that reads the picture.
const READER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/peers/picture.py");
/// How long the scene lasts, s.
const DURATION_S: f64 = 10.0;
/// No line, point or box is drawn again more often than this, 1/s: what is fewer moves in jerks,
/// and what is more fills the viewer's memory.
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
    low: Option<Vec<f64>>,
    high: Option<Vec<f64>>,
}

impl Entity {
    fn has(&self, component: &str) -> bool {
        self.components.iter().any(|one| one == component)
    }

    /// Whether it reaches from one corner to another, within some metres.
    fn reaches(&self, low: Point3<f64>, high: Point3<f64>, within_m: f64) -> bool {
        let [from, to] = self.corners();
        (from - low).amax() < within_m && (to - high).amax() < within_m
    }

    /// The corners of all that it draws.
    fn corners(&self) -> [Point3<f64>; 2] {
        [&self.low, &self.high].map(|corner| Point3::from_slice(corner.as_ref().unwrap()))
    }
}

/// The picture as Rerun reads it; `None` and a clear word where Rerun is not to be had.
fn shown(picture: &Path, png: &str) -> Option<Shown> {
    let python = std::env::var("CROSSFIX_CHECKERS").unwrap_or_default();
    let has_reader = Command::new(&python).args(["-c", "import rerun.experimental, PIL"]).output();
    if !has_reader.is_ok_and(|tried| tried.status.success()) {
        eprintln!("SKIPPED: CROSSFIX_CHECKERS is no Python with PyPI's rerun-sdk");
        return None;
    }
    // Kept, to be looked at.
    let png = Path::new(env!("CARGO_TARGET_TMPDIR")).join(png);
    let output = Command::new(&python).arg(READER).arg(picture).arg(&png).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    println!("{}", png.display());
    Some(serde_json::from_slice(&output.stdout).unwrap())
}

/// When the targets are found, s: they appear after a second, and half a second is enough.
const FOUND_AFTER_S: f64 = 1.5;
/// How far a target flies in a quarter of a second, m.
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
    let Some(Shown { entities, shown }) = shown(&output.join("demo.rrd"), "demo.png") else {
        return;
    };
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
        let [low, high] = of(&lines).corners();
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
    let [low, high] = ground.corners();
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

/// Degrees of latitude and of longitude that a metre to the north and to the east is, at sea level:
/// by the radii of curvature of the ellipsoid (WGS84) along the meridian and across.
fn degrees_a_metre(latitude_deg: f64) -> [f64; 2] {
    let (sin, cos) = latitude_deg.to_radians().sin_cos();
    let (equator, squared) = (6_378_137.0, 6.694_379_990_14e-3);
    let across = equator / (1.0 - squared * sin * sin).sqrt();
    let along = across * (1.0 - squared) / (1.0 - squared * sin * sin);
    [(1.0 / along).to_degrees(), (1.0 / (across * cos)).to_degrees()]
}

#[test]
fn a_site_that_is_somewhere_lies_on_the_map_and_over_a_picture_of_its_ground() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let of_project = |name: &str| format!("{}/../{name}", env!("CARGO_MANIFEST_DIR"));
    let (fused, picture) = (path("fused.mcap"), path("fused.rrd"));
    succeed(&["replay", &of_project("recordings/two-uavs.mcap"), "--fuse", "-o", &fused]);
    let latitude_deg = 48.35;
    let [north, east] = degrees_a_metre(latitude_deg);
    // The ground 200 m round the origin, and more to the east.
    let edges = [
        latitude_deg - 200.0 * north,
        11.78 - 200.0 * east,
        latitude_deg + 200.0 * north,
        11.78 + 300.0 * east,
    ];
    let edges = edges.map(|edge| edge.to_string()).join(",");
    // Any picture is one of the ground.
    let map = of_project("docs/flight.png");
    let ground = ["--map", &map, "--map-edges", &edges];
    let view = ["view", &fused, "--save", &picture];
    let refused = crossfix(&[&view[..], &ground[..]].concat());
    let words = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && words.contains("--anchor"), "{words}");
    let anchor = format!("{latitude_deg},11.78,0");
    succeed(&[&view[..], &ground[..], &["--anchor", &anchor]].concat());

    let Some(Shown { entities, .. }) = shown(Path::new(&picture), "map.png") else { return };
    let of = |path: &str| entities.get(path).unwrap_or_else(|| panic!("nothing at {path}"));
    let scene: Scene = toml::from_str(include_str!("../../configs/demo/scene.toml")).unwrap();
    for camera in &scene.cameras {
        let [east_m, north_m, _] = camera.position_m;
        let wanted = [latitude_deg + north * north_m, 11.78 + east * east_m];
        let found = of(&format!("/map/cameras/{}", camera.name)).low.clone().unwrap();
        // What a centimetre is.
        let is_near = found.iter().zip(wanted).all(|(found, wanted)| (found - wanted).abs() < 1e-7);
        assert!(is_near, "{}: {found:?}, not {wanted:?}", camera.name);
    }
    let ways = entities.keys().filter(|path| path.starts_with("/map/tracks/"));
    assert_eq!(ways.count(), 4, "two tracks, each with its way");
    let (from, to) = (Point3::new(-200.0, -200.0, 0.0), Point3::new(300.0, 200.0, 0.0));
    let ground = of("/world/ground/picture/mesh");
    assert!(ground.reaches(from, to, 0.1), "{:?}", ground.corners());
    let [under, grid] =
        ["/world/ground/picture", "/world/ground/grid"].map(|path| of(path).corners()[0].z);
    assert!((0.01..2.0).contains(&(grid - under)), "{under} m is a little under {grid} m");
}
