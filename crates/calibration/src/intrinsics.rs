use std::collections::BTreeMap;

use crossfix_geometry::{CameraModel, Distortion, GeometryError, ImageSize, Intrinsics};
use serde::Deserialize;
use thiserror::Error;

/// What is wrong with an intrinsics file.
#[derive(Debug, Error)]
pub enum IntrinsicsError {
    /// No YAML, or without a key that it needs.
    #[error("the file is no camera calibration of OpenCV, ROS or Kalibr")]
    Yaml(#[source] Box<serde_saphyr::Error>),
    /// A matrix of the wrong shape.
    #[error("`{key}` must have {wanted} numbers, it has {found}")]
    Shape {
        /// The key.
        key: &'static str,
        /// How many it must have.
        wanted: &'static str,
        /// How many it has.
        found: usize,
    },
    /// Axes of the image that are not at right angles.
    #[error("`camera_matrix` has a skew of {0}: only images with square corners are supported")]
    Skew(f64),
    /// An unsupported lens model.
    #[error("the lens model `{0}` is not known: plumb_bob, radtan, equidistant or fisheye")]
    Model(String),
    /// A file of several cameras, none of which was asked for.
    #[error(
        "the file is of several cameras ({0}): say which, as in `camchain.yaml#{first}`",
        first = .0.split(", ").next().unwrap_or("cam0")
    )]
    Several(String),
    /// A camera that the file has not.
    #[error("the file has no camera `{wanted}`: it has {known}")]
    NoSuch {
        /// Which was asked for.
        wanted: String,
        /// Those that it has.
        known: String,
    },
    /// Numbers that describe no camera.
    #[error("the numbers describe no camera")]
    Numbers(#[source] GeometryError),
}

/// A matrix as OpenCV and ROS write it.
#[derive(Debug, Deserialize)]
struct YamlMatrix {
    data: Vec<f64>,
}

/// The keys that matter in files of OpenCV and ROS; others are ignored.
#[derive(Debug, Deserialize)]
struct CalibrationFile {
    image_width: u32,
    image_height: u32,
    camera_matrix: YamlMatrix,
    #[serde(alias = "camera_model")]
    distortion_model: Option<String>,
    distortion_coefficients: YamlMatrix,
}

/// A camera of Kalibr's `camchain.yaml`; its pose relative to the others is ignored.
#[derive(Debug, Deserialize)]
struct ChainCamera {
    camera_model: String,
    intrinsics: Vec<f64>,
    distortion_model: String,
    distortion_coeffs: Vec<f64>,
    resolution: [u32; 2],
}

/// Reads the YAML of ROS (`camera_info`), of OpenCV's `FileStorage`, or Kalibr's `camchain.yaml` of
/// one camera.
///
/// # Errors
/// [`IntrinsicsError`] naming the key that is wrong.
pub fn intrinsics_from_yaml(text: &str) -> Result<Intrinsics, IntrinsicsError> {
    if let Ok(chain) = serde_saphyr::from_str::<BTreeMap<String, ChainCamera>>(text) {
        return match chain.values().next() {
            Some(camera) if chain.len() == 1 => camera.intrinsics(),
            _ => Err(IntrinsicsError::Several(names(&chain))),
        };
    }
    // OpenCV begins with a directive that is not valid YAML.
    let text = match text.split_once('\n') {
        Some((first, rest)) if first.starts_with("%YAML:") => rest,
        _ => text,
    };
    let file: CalibrationFile =
        serde_saphyr::from_str(text).map_err(|error| IntrinsicsError::Yaml(Box::new(error)))?;
    let k: [f64; 9] =
        file.camera_matrix.data.as_slice().try_into().map_err(|_| IntrinsicsError::Shape {
            key: "camera_matrix",
            wanted: "9",
            found: file.camera_matrix.data.len(),
        })?;
    // A skew of the size of rounding errors is accepted: some programs write the last bits of a
    // fit.
    if k[1].abs() > 1e-3 {
        return Err(IntrinsicsError::Skew(k[1]));
    }
    let intrinsics = Intrinsics {
        size: ImageSize { width: file.image_width, height: file.image_height },
        fx: k[0],
        fy: k[4],
        cx: k[2],
        cy: k[5],
        distortion: distortion(
            file.distortion_model.as_deref().unwrap_or("plumb_bob"),
            ("distortion_coefficients", &file.distortion_coefficients.data),
        )?,
    };
    CameraModel::new(intrinsics).map_err(IntrinsicsError::Numbers)?;
    Ok(intrinsics)
}

/// Reads a camera of Kalibr's `camchain.yaml`.
///
/// # Errors
/// [`IntrinsicsError`] naming the key that is wrong, or the cameras that the file has.
pub fn intrinsics_from_camchain(text: &str, camera: &str) -> Result<Intrinsics, IntrinsicsError> {
    let chain: BTreeMap<String, ChainCamera> =
        serde_saphyr::from_str(text).map_err(|error| IntrinsicsError::Yaml(Box::new(error)))?;
    let no_such = || IntrinsicsError::NoSuch { wanted: camera.to_owned(), known: names(&chain) };
    chain.get(camera).ok_or_else(no_such)?.intrinsics()
}

fn names(chain: &BTreeMap<String, ChainCamera>) -> String {
    chain.keys().map(String::as_str).collect::<Vec<_>>().join(", ")
}

impl ChainCamera {
    fn intrinsics(&self) -> Result<Intrinsics, IntrinsicsError> {
        if self.camera_model != "pinhole" {
            return Err(IntrinsicsError::Model(self.camera_model.clone()));
        }
        let [fx, fy, cx, cy] = self.intrinsics[..] else {
            let found = self.intrinsics.len();
            return Err(IntrinsicsError::Shape { key: "intrinsics", wanted: "4", found });
        };
        let [width, height] = self.resolution;
        let intrinsics = Intrinsics {
            size: ImageSize { width, height },
            fx,
            fy,
            cx,
            cy,
            distortion: distortion(
                &self.distortion_model,
                ("distortion_coeffs", &self.distortion_coeffs),
            )?,
        };
        CameraModel::new(intrinsics).map_err(IntrinsicsError::Numbers)?;
        Ok(intrinsics)
    }
}

/// The distortion by a model's name in these files, with the key of the coefficients and their
/// values.
fn distortion(
    model: &str,
    (key, coefficients): (&'static str, &[f64]),
) -> Result<Distortion, IntrinsicsError> {
    let shape = |wanted| IntrinsicsError::Shape { key, wanted, found: coefficients.len() };
    Ok(match model {
        "none" => Distortion::None,
        "plumb_bob" | "pinhole" | "radtan" => match coefficients[..] {
            [] => Distortion::None,
            [k1, k2, p1, p2] => Distortion::BrownConrady([k1, k2, p1, p2, 0.0]),
            [k1, k2, p1, p2, k3] => Distortion::BrownConrady([k1, k2, p1, p2, k3]),
            _ => return Err(shape("4 or 5")),
        },
        "equidistant" | "fisheye" | "kannala_brandt" => {
            Distortion::Fisheye(coefficients.try_into().map_err(|_| shape("4"))?)
        }
        other => return Err(IntrinsicsError::Model(other.to_owned())),
    })
}

/// Writes the YAML of ROS.
pub fn intrinsics_to_yaml(name: &str, intrinsics: &Intrinsics) -> String {
    let Intrinsics { size, fx, fy, cx, cy, distortion } = intrinsics;
    let (model, coefficients) = match distortion {
        Distortion::None => ("plumb_bob", vec![0.0; 5]),
        Distortion::BrownConrady(k) => ("plumb_bob", k.to_vec()),
        Distortion::Fisheye(k) => ("equidistant", k.to_vec()),
    };
    format!(
        "image_width: {}\nimage_height: {}\ncamera_name: {name}\n\
         camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{fx:?}, 0.0, {cx:?}, 0.0, {fy:?}, {cy:?}, 0.0, 0.0, 1.0]\n\
         distortion_model: {model}\n\
         distortion_coefficients:\n  rows: 1\n  cols: {}\n  data: {coefficients:?}\n",
        size.width,
        size.height,
        coefficients.len(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    const OPENCV: &str = "%YAML:1.0\n---\nimage_width: 1920\nimage_height: 1080\n\
        camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1400., 0., 960., 0., 1400., 540., 0., 0., 1. ]\n\
        distortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n   data: [ -1.0e-01, 2.0e-02, 0., 0., 0. ]\n";

    #[test]
    fn opencvs_file_is_read_with_and_without_its_directive() {
        let with = intrinsics_from_yaml(OPENCV).unwrap();
        let without = intrinsics_from_yaml(OPENCV.split_once("---\n").unwrap().1).unwrap();
        assert_eq!(with, without);
        assert_eq!(with.distortion, Distortion::BrownConrady([-0.1, 0.02, 0.0, 0.0, 0.0]));
    }

    const KALIBR: &str = "cam0:\n  camera_model: pinhole\n  intrinsics: [461.6, 460.2, 362.7, 246.0]\n  \
        distortion_model: radtan\n  distortion_coeffs: [-0.277, 0.0671, 0.0009, 0.0001]\n  \
        rostopic: /cam0/image_raw\n  resolution: [752, 480]\n";

    #[test]
    fn kalibrs_chain_is_read_camera_by_camera() {
        let first = intrinsics_from_yaml(KALIBR).unwrap();
        assert_eq!(first.size, ImageSize { width: 752, height: 480 });
        assert_eq!((first.fx, first.cy), (461.6, 246.0));
        assert_eq!(
            first.distortion,
            Distortion::BrownConrady([-0.277, 0.0671, 0.0009, 0.0001, 0.0])
        );
        let second = KALIBR.replace("cam0", "cam1").replace("radtan", "equidistant");
        let both = format!("{KALIBR}{second}  T_cn_cnm1:\n  - [1.0, 0.0, 0.0, 0.1]\n");
        assert_eq!(intrinsics_from_camchain(&both, "cam0").unwrap(), first);
        let second = intrinsics_from_camchain(&both, "cam1").unwrap();
        assert!(matches!(second.distortion, Distortion::Fisheye(_)));
        let several = intrinsics_from_yaml(&both).unwrap_err().to_string();
        assert!(
            several.contains("cam0, cam1") && several.contains("camchain.yaml#cam0"),
            "{several}"
        );
        let none = intrinsics_from_camchain(&both, "cam2").unwrap_err().to_string();
        assert!(none.contains("`cam2`") && none.contains("cam0, cam1"), "{none}");
        let omni = KALIBR.replace("pinhole", "omni");
        assert!(matches!(intrinsics_from_yaml(&omni), Err(IntrinsicsError::Model(_))));
    }

    #[test]
    fn what_is_written_is_read() {
        for distortion in [
            Distortion::BrownConrady([0.1, 0.2, 0.01, 0.02, 0.3]),
            Distortion::Fisheye([0.1, 0.0, 0.0, 0.01]),
        ] {
            let intrinsics = Intrinsics { distortion, ..intrinsics_from_yaml(OPENCV).unwrap() };
            assert_eq!(
                intrinsics_from_yaml(&intrinsics_to_yaml("a", &intrinsics)).unwrap(),
                intrinsics
            );
        }
    }

    #[test]
    fn impossible_files_are_named() {
        let short = OPENCV.replace("0., 0., 1. ]", "0. ]");
        assert!(matches!(
            intrinsics_from_yaml(&short),
            Err(IntrinsicsError::Shape { key: "camera_matrix", .. })
        ));
        let negative = OPENCV.replace("[ 1400.", "[ -1400.");
        assert!(matches!(intrinsics_from_yaml(&negative), Err(IntrinsicsError::Numbers(_))));
        let model = OPENCV.replace(
            "distortion_coefficients",
            "distortion_model: rational\ndistortion_coefficients",
        );
        assert!(matches!(intrinsics_from_yaml(&model), Err(IntrinsicsError::Model(_))));
        assert!(matches!(intrinsics_from_yaml("hello"), Err(IntrinsicsError::Yaml(_))));
    }
}
