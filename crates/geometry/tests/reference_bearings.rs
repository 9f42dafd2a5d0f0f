//! Undistortion and frame conventions against an independent implementation on real calibrations.
#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crossfix_geometry::{CameraModel, Distortion, ImageSize, Intrinsics, Pixel};
use nalgebra::{Matrix3, Vector3};
use serde_json::Value;

fn read(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

/// The calibration file that the data's README assigns to a camera of a dataset.
fn calibration(data: &Path, name: &str, dataset: u32) -> PathBuf {
    let file = match (name, dataset) {
        ("sonyG", 1 | 2) => "sonyG_1",
        ("sonyG", _) => "sonyG_2",
        ("mate10", 3) => "mate10_1",
        ("mate10", _) => "mate10_2",
        _ => name,
    };
    data.join("calibration").join(name).join(format!("{file}.json"))
}

fn model(data: &Path, name: &str, dataset: u32) -> CameraModel {
    let file = read(&calibration(data, name, dataset));
    let k = &file["K-matrix"];
    let size = numbers(&file["resolution"]);
    let mut coefficients = numbers(&file["distCoeff"]);
    coefficients.resize(5, 0.0);
    CameraModel::new(Intrinsics {
        size: ImageSize { width: size[0] as u32, height: size[1] as u32 },
        fx: k[0][0].as_f64().unwrap(),
        fy: k[1][1].as_f64().unwrap(),
        cx: k[0][2].as_f64().unwrap(),
        cy: k[1][2].as_f64().unwrap(),
        distortion: Distortion::BrownConrady(coefficients.try_into().unwrap()),
    })
    .unwrap()
}

#[test]
fn real_labels_become_the_reference_bearings() {
    let Some(data) = std::env::var_os("CROSSFIX_DATA") else {
        eprintln!("SKIPPED: set CROSSFIX_DATA to the folder of real data");
        return;
    };
    let data = Path::new(&data).join("eth-multiview-drone");
    let poses = read(&data.join("poses.json"));
    let mut models = BTreeMap::new();
    let mut worst = BTreeMap::<String, f64>::new();
    let mut unconverged = BTreeMap::<String, usize>::new();
    let mut rows = csv::Reader::from_path(data.join("reference_bearings.csv")).unwrap();
    for row in rows.deserialize() {
        let (dataset, camera, _, x, y, u_norm, v_norm, _, e, n, u): (
            u32,
            String,
            u32,
            f64,
            f64,
            f64,
            f64,
            f64,
            f64,
            f64,
            f64,
        ) = row.unwrap();
        let description = &poses[dataset.to_string()]["half"]["cameras"][&camera];
        let name = description["name"].as_str().unwrap();
        let model =
            models.entry((dataset, camera.clone())).or_insert_with(|| model(&data, name, dataset));
        // The file was made with five fixed-point steps of the inverse. Where those do not converge
        // (the corners of the wide lens) its direction does not fall back on its own pixel.
        let theirs = model.project(&Vector3::new(u_norm, v_norm, 1.0)).unwrap();
        if (theirs.x() - x).hypot(theirs.y() - y) > 1e-3 {
            *unconverged.entry(name.to_owned()).or_default() += 1;
            continue;
        }
        let rotation = &description["R_world_to_cam"];
        let camera_from_world = Matrix3::from_row_slice(
            &(0..3).flat_map(|r| numbers(&rotation[r])).collect::<Vec<_>>(),
        );
        let ours =
            camera_from_world.transpose() * model.direction(Pixel::new(x, y)).unwrap().into_inner();
        let error = (ours - Vector3::new(e, n, u)).norm();
        let slot = worst.entry(format!("{dataset}/{name}")).or_default();
        *slot = slot.max(error);
    }
    assert_eq!(worst.len(), 10, "cameras in the reference file");
    assert_eq!(unconverged.keys().collect::<Vec<_>>(), ["gopro3"], "only the wide lens");
    assert!(unconverged["gopro3"] < 60, "some of its rows converged: {unconverged:?}");
    for (camera, error) in worst {
        assert!(error < 1e-6, "{camera}: {error:.2e} rad");
    }
}
