//! Reads any text as a site's calibration and as a lens's, and uses what can be read.

use crossfix_calibration::{
    CalibratedCamera, SiteCalibration, compare_sites, intrinsics_from_yaml, intrinsics_to_yaml,
};
use crossfix_geometry::Pixel;
use crossfix_message::Timestamp;

/// Own times that a clock is asked for: in its knots, far from them, and the ends of all time.
const TIMES_S: [f64; 5] = [0.0, 100.0, -1e4, 1.7e9, 9e9];

pub fn drive(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    if let Ok(intrinsics) = intrinsics_from_yaml(text) {
        let again = intrinsics_from_yaml(&intrinsics_to_yaml("north", &intrinsics));
        assert_eq!(again.expect("what was written can be read"), intrinsics);
    }
    let Ok(site) = SiteCalibration::from_toml(text) else { return };
    let again = SiteCalibration::from_toml(&site.to_toml()).expect("what was written can be read");
    assert_eq!(again.cameras().len(), site.cameras().len());
    site.cameras().iter().for_each(use_camera);
    let _ = compare_sites(&site, &again);
}

fn use_camera(camera: &CalibratedCamera) {
    let size = camera.camera.model().intrinsics().size;
    for share in [0.0, 0.4, 1.0] {
        let [x, y] = [size.width, size.height].map(|side| f64::from(side) * share);
        if let Ok(bearing) = camera.bearing(Pixel::new(x, y)) {
            assert!((bearing.direction().norm() - 1.0).abs() < 1e-6);
            assert!(bearing.covariance().iter().all(|value| value.is_finite()));
        }
    }
    let over_image = camera.over_image();
    assert!((0.0..=1.0).contains(&over_image.share), "{over_image:?}");
    for own_s in TIMES_S {
        let own = Timestamp::EPOCH.plus_seconds(own_s);
        let (_, sd_s) = camera.common_time(own, 10.0);
        assert!(sd_s >= 0.0 && sd_s.is_finite(), "{sd_s} s");
    }
}
