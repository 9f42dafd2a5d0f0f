use super::*;

#[test]
fn a_clock_that_is_not_estimated_is_as_good_as_each_frame_says_and_a_trusted_one_is_right() {
    let [word, trusted, unsure] = ["a", "t", "u"].map(|name| name.parse::<CameraName>().unwrap());
    let config = Clocks { trusted: vec![trusted.clone()], ..Clocks::default() };
    let mut clocks = ClockEstimator::new(config);
    for (camera, sd_s) in [(&word, 0.9e-3), (&trusted, 0.3), (&unsure, 0.1)] {
        clocks.see(camera, &CameraUncertainty::of_time(sd_s));
    }
    let sd_s = |clocks: &ClockEstimator, camera: &CameraName, said| {
        clocks.time_sd_s(camera, &clocks.estimate(camera).unwrap(), said)
    };
    assert_eq!(sd_s(&clocks, &word, 0.9e-3), 0.9e-3);
    assert_eq!(sd_s(&clocks, &word, 2e-3), 2e-3);
    assert!(sd_s(&clocks, &trusted, 0.3) < 1e-5);
    assert!((sd_s(&clocks, &unsure, 1e-4) - 0.1).abs() < 1e-3);
    // Twice as bad is not much worse; a lost source of time is.
    for (said, expected) in [(2e-3, 2e-3), (0.3, 0.3), (1e-3, 0.3)] {
        clocks.see(&word, &CameraUncertainty::of_time(said));
        assert!((sd_s(&clocks, &word, said) - expected).abs() < 0.01 * expected, "{said}");
    }
    assert!(clocks.is_needed());
}

#[test]
fn of_another_clock_nothing_is_known_but_what_is_said() {
    let [late, other] = ["a", "b"].map(|name| name.parse::<CameraName>().unwrap());
    let by =
        |clock_source, sd_s| CameraUncertainty { clock_source, ..CameraUncertainty::of_time(sd_s) };
    // The camera that is heard first is the reference of the others' offsets.
    for late_is_first in [false, true] {
        let mut clocks = ClockEstimator::new(Clocks::default());
        let mut first =
            [(&other, by(ClockSource::Ntp, 0.01)), (&late, by(ClockSource::Arrival, 0.1))];
        if late_is_first {
            first.reverse();
        }
        first.iter().for_each(|(camera, said)| clocks.see(camera, said));
        let of = |clocks: &ClockEstimator, camera| clocks.estimate(camera).unwrap();
        let sd_s = of(&clocks, &late).sd_s;
        assert!((sd_s - 0.1).abs() < 0.01, "{sd_s}");
        // The camera's own clock is good, and its offset is not that of the arrival times.
        clocks.see(&late, &by(ClockSource::Camera, 0.02));
        for (camera, sd_s) in [(&late, 0.02), (&other, 0.01)] {
            let estimate = of(&clocks, camera);
            assert!(estimate.offset_s.abs() < 1e-9, "{camera}: {estimate:?}");
            assert!(estimate.sd_s < 1.1 * sd_s, "{camera}: {estimate:?}");
        }
        // The offset between the two clocks is no better known than the new clock is.
        let apart_s = of(&clocks, &late).relative_sd_s.hypot(of(&clocks, &other).relative_sd_s);
        assert!(apart_s > 0.01, "{apart_s}");
        clocks.see(&late, &by(ClockSource::Arrival, 0.1));
        let sd_s = of(&clocks, &late).sd_s;
        assert!((sd_s - 0.1).abs() < 0.01, "{sd_s}");
    }
}
