use super::*;

fn direction(track: &BearingTrack) -> Vector3<f64> {
    track.bearing.unwrap().into()
}

#[test]
fn bearings_point_at_the_truth_within_their_noise() {
    for layout in [Layout::Ring, Layout::Grid] {
        let site = Site { layout, cameras: 5, duration_s: 2.0, turn_rps: 0.1, ..Site::default() };
        let simulated = site.build().unwrap();
        let (mut squares, mut count) = (0.0, 0.0);
        for exposure in simulated.bearings() {
            let SiteCamera { camera, .. } = &simulated.cameras()[exposure.camera];
            let truth: Vec<TargetState> = simulated.truth(exposure.time_s).collect();
            for (track, id) in exposure.frame.tracks.iter().zip(&exposure.sources) {
                let Some(id) = id else { continue };
                let target = truth[*id as usize];
                assert!(camera.sees(target.position), "{layout:?}: out of view");
                let exact = camera.pose().camera_from_world(target.position).normalize();
                let off = (direction(track) - exact).norm();
                assert!(off < 6.0 * site.noise_rad, "{layout:?}: {off}");
                squares += off.powi(2);
                count += 1.0;
            }
        }
        let sd = f64::sqrt(squares / count / 2.0);
        assert!(
            count > 500.0 && (sd / site.noise_rad - 1.0).abs() < 0.06,
            "{layout:?}: {sd} of {count}"
        );
    }
}

#[test]
fn a_target_in_view_is_reported_as_often_as_it_should() {
    let site =
        Site { detection_probability: 0.8, false_bearings: 0.0, range_m: 400.0, ..Site::default() };
    let simulated = site.build().unwrap();
    let (mut seen, mut reported) = (0, 0);
    for exposure in simulated.bearings() {
        let camera = &simulated.cameras()[exposure.camera].camera;
        seen +=
            simulated.truth(exposure.time_s).filter(|t| simulated.sees(camera, t.position)).count();
        reported += exposure.frame.tracks.len();
    }
    let share = reported as f64 / seen as f64;
    assert!(seen > 5000 && (share - 0.8).abs() < 0.02, "{share} of {seen}");
}

#[test]
fn false_bearings_are_poisson_and_within_the_image() {
    let site = Site { targets: 0, false_bearings: 5.0, ..Site::default() };
    let simulated = site.build().unwrap();
    let (mut sum, mut squares, mut count) = (0.0, 0.0, 0.0);
    for SiteExposure { frame, .. } in simulated.bearings() {
        let n = frame.tracks.len() as f64;
        (sum, squares, count) = (sum + n, squares + n * n, count + 1.0);
        for track in &frame.tracks {
            assert!(
                (0.0..1920.0).contains(&track.pixel_x) && (0.0..1080.0).contains(&track.pixel_y)
            );
        }
    }
    let mean = sum / count;
    let variance = squares / count - mean * mean;
    assert!(
        (mean - 5.0).abs() < 0.2 && (variance - 5.0).abs() < 0.6,
        "{mean} {variance} of {count}"
    );
}

/// All messages of a site.
fn bytes(site: &Site) -> Vec<Vec<u8>> {
    let simulated = site.build().unwrap();
    let calibrations: Vec<Vec<u8>> = simulated.calibrations().iter().map(Payload::encode).collect();
    calibrations.into_iter().chain(simulated.bearings().map(|e| e.frame.encode())).collect()
}

#[test]
fn the_same_seed_gives_the_same_bytes_in_order_of_time() {
    let site = Site { duration_s: 1.0, cameras: 7, layout: Layout::Grid, ..Site::default() };

    assert_eq!(bytes(&site), bytes(&site));
    assert_ne!(bytes(&site), bytes(&Site { seed: 2, ..site.clone() }));
    let times: Vec<i64> =
        site.build().unwrap().bearings().map(|exposure| exposure.frame.capture_time_ns).collect();
    assert!(times.is_sorted() && times.len() == 210, "{}", times.len());
}

#[test]
fn every_place_of_a_grid_is_seen_by_several_cameras() {
    let site = Site {
        area_m: [4000.0, 4000.0],
        cameras: 64,
        layout: Layout::Grid,
        range_m: 1400.0,
        targets: 1000,
        ..Site::default()
    };
    let simulated = site.build().unwrap();
    let enough =
        simulated.truth(0.0).filter(|t| simulated.cameras_that_see(t.position) >= 3).count();
    assert!(enough > 900, "{enough} of 1000 are seen by three");
}

#[test]
fn numbers_that_make_no_sense_are_named() {
    for (site, key) in [
        (Site { detection_probability: f64::NAN, ..Site::default() }, "detection_probability"),
        (Site { heights_m: [50.0, 40.0], ..Site::default() }, "heights_m"),
        (Site { cameras: 0, ..Site::default() }, "cameras"),
    ] {
        match site.build() {
            Err(SceneError::Number { what, .. }) => assert_eq!(what, key),
            other => panic!("{other:?}"),
        }
    }
    assert!(Site { focal_px: 0.0, ..Site::default() }.build().is_err());
}
