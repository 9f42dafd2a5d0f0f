use crossfix_message::decode;
use serde_json::json;

use super::*;

/// A lens of 500 px at 30 Hz, with this distortion of the third order.
fn lens(distortion: f64) -> LensFile {
    serde_json::from_value(json!({
        "K-matrix": [[500.0, 0.0, 960.0], [0.0, 500.0, 540.0], [0.0, 0.0, 1.0]],
        "distCoeff": [distortion, 0.0, 0.0, 0.0],
        "fps": 30.0,
        "resolution": [1920, 1080],
    }))
    .unwrap()
}

/// A camera that was fitted to a milliradian.
fn fitted() -> FittedCamera {
    serde_json::from_value(json!({
        "name": "wide",
        "R_world_to_cam": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        "centre_enu_m": [0.0, 0.0, 0.0],
        "clock_offset_s": 0.0,
        "clock_rate": 0.0,
        "readout_fraction_of_frame": 0.0,
        "residual_sigma_rad": 0.001,
    }))
    .unwrap()
}

/// The labels' reader of a camera that was fitted to a minute and a half.
fn source<'a>(
    site: &'a SiteName,
    fitted: &'a FittedCamera,
    lens: &'a LensFile,
) -> CameraSource<'a> {
    CameraSource { site, fitted, fitted_over_s: 90.0, lens, is_raw: false }
}

#[test]
fn a_clock_is_as_unsure_as_the_residual_leaves_it() {
    let (lens, fitted, site) = (lens(0.0), fitted(), "test".parse().unwrap());
    let source = source(&site, &fitted, &lens);
    // 12 of 500 px in six frames are 120 mrad/s; over the gap before frame 60 there is no rate.
    let label = |frame, x| ImportedLabel { frame, pixel: Some(Pixel::new(x, 540.0)) };
    let labels = [label(0, 954.0), label(6, 966.0), label(60, 1200.0)];
    let sd_s = |labels: &[ImportedLabel]| {
        let entries = source.entries(labels, |_| true).unwrap();
        decode::<BearingFrame>(&entries[1].data).unwrap().capture_time_sd_s
    };
    assert!((sd_s(&labels) - 0.001 / 0.12).abs() < 1e-6, "{}", sd_s(&labels));
    assert_eq!(sd_s(&labels[..1]), MOST_CLOCK_SD_S);
    assert_eq!(sd_s(&[label(0, 960.0), label(6, 960.0)]), MOST_CLOCK_SD_S, "it does not move");
    assert_eq!(sd_s(&[label(0, 960.0), label(u64::MAX, 960.0)]), MOST_CLOCK_SD_S);
}

#[test]
fn a_clock_wanders_by_the_frames_that_are_lost_or_taken_twice() {
    // One frame of 1/30 s taken twice every ten seconds, for twenty seconds: two on average, give
    // or take the root of two.
    let fitted = FittedCamera { clock_rate: -1.0 / 300.0, ..fitted() };
    let (lens, site) = (lens(0.0), "test".parse().unwrap());
    let source = source(&site, &fitted, &lens);
    let entries = source.entries(&[], |_| true).unwrap();
    let calibration = decode::<CameraCalibration>(&entries[0].data).unwrap();
    assert_eq!(calibration.hash, calibration.content_hash());
    let after_20_s = calibration.clock_wander_s * 20.0_f64.sqrt();
    assert!((after_20_s - 2.0_f64.sqrt() / 30.0).abs() < 1e-12, "{after_20_s}");
    // In the 90 s of the fit nine frames, of which the line has left 2/15 at its ends.
    let labels = [(0, 954.0), (6, 966.0)]
        .map(|(frame, x)| ImportedLabel { frame, pixel: Some(Pixel::new(x, 540.0)) });
    let entries = source.entries(&labels, |_| true).unwrap();
    let sd_s = decode::<BearingFrame>(&entries[1].data).unwrap().capture_time_sd_s;
    let expected = f64::hypot(0.001 / 0.12, (9.0_f64 * 2.0 / 15.0).sqrt() / 30.0);
    assert!((sd_s - expected).abs() < 1e-5, "{sd_s}");
}

#[test]
fn a_label_where_the_lens_has_no_direction_is_left_out_and_the_others_are_not() {
    // A barrel so strong that the polynomial turns back within the image.
    let (lens, fitted) = (lens(-0.3), fitted());
    let label = |frame, x, y| ImportedLabel { frame, pixel: Some(Pixel::new(x, y)) };
    let labels = [label(0, 960.0, 540.0), label(1, 3.0, 3.0), label(2, 1000.0, 500.0)];
    let site = "test".parse().unwrap();
    let source = source(&site, &fitted, &lens);
    let entries = source.entries(&labels, |_| true).unwrap();
    let seen: Vec<usize> = entries[1..]
        .iter()
        .map(|entry| decode::<BearingFrame>(&entry.data).unwrap().tracks.len())
        .collect();
    assert_eq!(seen, [1, 0, 1]);
}

#[test]
fn the_velocity_beside_a_masked_sample_is_that_of_the_curve() {
    let at =
        |t: f64| RtkSample { time_s: t, place: Point3::new(1.0 + 2.0 * t + 3.0 * t * t, -t, 0.0) };
    let velocity = velocity_between(&at(0.8), &at(1.0), &at(1.6));
    assert!((velocity - Vector3::new(8.0, -1.0, 0.0)).norm() < 1e-12, "{velocity}");
}
