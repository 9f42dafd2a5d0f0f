use crossfix_geometry::{CameraModel, Distortion, GeometryError, ImageSize, Intrinsics};
use serde::Deserialize;
use thiserror::Error;

/// What is wrong with an intrinsics file.
#[derive(Debug, Error)]
pub enum IntrinsicsError {
    /// No YAML, or without a key that it needs.
    #[error("the file is no camera calibration of OpenCV or ROS")]
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
    /// A lens model that we do not have.
    #[error("the distortion model `{0}` is not known: plumb_bob, equidistant or fisheye")]
    Model(String),
    /// Numbers that are no camera's.
    #[error("the numbers describe no camera")]
    Numbers(#[source] GeometryError),
}

/// A matrix as both write it.
#[derive(Debug, Deserialize)]
struct YamlMatrix {
    data: Vec<f64>,
}

/// The keys of both that matter; others are left alone.
#[derive(Debug, Deserialize)]
struct CalibrationFile {
    image_width: u32,
    image_height: u32,
    camera_matrix: YamlMatrix,
    #[serde(alias = "camera_model")]
    distortion_model: Option<String>,
    distortion_coefficients: YamlMatrix,
}

/// Reads the YAML of ROS (`camera_info`) or of OpenCV's `FileStorage`.
///
/// # Errors
/// [`IntrinsicsError`] naming the key that is wrong.
pub fn intrinsics_from_yaml(text: &str) -> Result<Intrinsics, IntrinsicsError> {
    // OpenCV begins with a directive that YAML does not have.
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
    // Some programs write the last bits of a fit.
    if k[1].abs() > 1e-3 {
        return Err(IntrinsicsError::Skew(k[1]));
    }
    let coefficients = &file.distortion_coefficients.data;
    let model = file.distortion_model.as_deref().unwrap_or("plumb_bob");
    let shape = |wanted| IntrinsicsError::Shape {
        key: "distortion_coefficients",
        wanted,
        found: coefficients.len(),
    };
    let distortion = match model {
        "plumb_bob" | "pinhole" | "radtan" => match coefficients[..] {
            [] => Distortion::None,
            [k1, k2, p1, p2] => Distortion::BrownConrady([k1, k2, p1, p2, 0.0]),
            [k1, k2, p1, p2, k3] => Distortion::BrownConrady([k1, k2, p1, p2, k3]),
            _ => return Err(shape("4 or 5")),
        },
        "equidistant" | "fisheye" | "kannala_brandt" => {
            Distortion::Fisheye(coefficients.as_slice().try_into().map_err(|_| shape("4"))?)
        }
        other => return Err(IntrinsicsError::Model(other.to_owned())),
    };
    let intrinsics = Intrinsics {
        size: ImageSize { width: file.image_width, height: file.image_height },
        fx: k[0],
        fy: k[4],
        cx: k[2],
        cy: k[5],
        distortion,
    };
    CameraModel::new(intrinsics).map_err(IntrinsicsError::Numbers)?;
    Ok(intrinsics)
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
