use super::*;
use crate::clocks::ClockEstimate;

fn name(text: &str) -> CameraName {
    text.parse().unwrap()
}

/// Three clocks of 0.1 s deviation, of which the second and the third are learnt relative to
/// the first, the reference.
fn learnt(poses: [Option<Matrix6<f64>>; 3]) -> (Belief, Vec<usize>) {
    let mut belief = Belief::default();
    for (camera, pose) in ["a", "b", "c"].into_iter().zip(poses) {
        belief.add(&name(camera), [0.1, 3e-5], 0.0, pose);
    }
    belief.advance(Timestamp::EPOCH);
    let components: Vec<usize> = ["b", "c"]
        .into_iter()
        .filter_map(|c| belief.index(&name(c)))
        .flat_map(|k| [k, k + 1])
        .collect();
    let mean = DVector::from_vec(vec![0.06, 1e-5, -0.03, 0.0]);
    belief.learn(&components, &mean, &DMatrix::from_diagonal_element(4, 4, 1e-12));
    (belief, components)
}

fn of(belief: &Belief, camera: &str) -> ClockEstimate {
    belief.estimate(&name(camera), Timestamp::EPOCH).unwrap()
}

/// The likeliest common offset where each clock is off from it by its deviation or, one clock
/// in a hundred, by a second: where the likelihood's slope is 0.
fn most_likely(offsets: &[f64], sd: f64) -> f64 {
    let slope = |common: f64| -> f64 {
        let of_clock = |offset: &f64| {
            let off = offset - common;
            let [(honest, a), (liar, b)] =
                [(0.99, sd), (0.01, 1.0)].map(|(share, sd): (f64, f64)| {
                    (share / sd * (-(off / sd).powi(2) / 2.0).exp(), sd.powi(-2))
                });
            off * (honest * a + liar * b) / (honest + liar)
        };
        offsets.iter().map(of_clock).sum()
    };
    let (mut below, mut above) = (-0.1, 0.1);
    for _ in 0..60 {
        let middle = f64::midpoint(below, above);
        *if slope(middle) > 0.0 { &mut below } else { &mut above } = middle;
    }
    below
}

#[test]
fn offsets_are_against_what_all_clocks_say_and_their_mean_stays_unknown() {
    let (belief, _) = learnt([None; 3]);
    for (camera, offset) in [("a", -0.01), ("b", 0.05), ("c", -0.04)] {
        let estimate = of(&belief, camera);
        // The chance of one in a hundred that a clock is a liar takes a microsecond off the
        // mean.
        let offset = offset + 0.01 - most_likely(&[0.0, 0.06, -0.03], 0.1);
        assert!((estimate.offset_s - offset).abs() < 1e-9, "{estimate:?}");
        assert!((estimate.sd_s - 0.1 / 3.0_f64.sqrt()).abs() < 1e-4, "{estimate:?}");
        assert!(estimate.relative_sd_s < 1e-5, "{estimate:?}");
    }
    let later = belief.estimate(&name("b"), Timestamp::from_seconds(100.0)).unwrap();
    assert!((later.offset_s - of(&belief, "b").offset_s - 100.0 * later.drift).abs() < 1e-9);
}

#[test]
fn a_doubted_clock_is_as_badly_known_as_it_was_reported_and_the_others_stay() {
    for doubted in ["a", "b"] {
        let (mut belief, _) = learnt([Some(Matrix6::identity() * 1e-6), None, None]);
        belief.widen(&name(doubted));
        assert!(of(&belief, doubted).relative_sd_s > 0.06, "{:?}", of(&belief, doubted));
        let (b, c) = (of(&belief, "b"), of(&belief, "c"));
        if doubted == "a" {
            assert!((b.offset_s - c.offset_s - 0.09).abs() < 1e-9);
        }
        assert!(belief.covariance.clone().cholesky().is_some());
    }
}

#[test]
fn moving_on_is_the_transition_of_all_offsets_by_their_drifts() {
    let (mut belief, components) = learnt([Some(Matrix6::identity() * 1e-6), None, None]);
    let (mean, covariance) = (belief.mean.clone(), belief.covariance.clone());
    let mut transition = DMatrix::<f64>::identity(mean.len(), mean.len());
    let mut walk = DMatrix::<f64>::zeros(mean.len(), mean.len());
    for pair in components.chunks(2) {
        transition[(pair[0], pair[1])] = 20.0;
        walk[(pair[0], pair[0])] = 20.0 * OFFSET_WALK;
        walk[(pair[1], pair[1])] = 20.0 * DRIFT_WALK;
    }
    belief.advance(Timestamp::from_seconds(20.0));
    assert!((&belief.mean - &transition * mean).amax() < 1e-15);
    let expected = &transition * covariance * transition.transpose() + walk;
    assert!((&belief.covariance - expected).amax() < 1e-18);
}

#[test]
fn a_clock_that_says_that_it_has_become_worse_may_be_off_from_where_it_stood() {
    for reopened in ["a", "b"] {
        let (mut belief, _) = learnt([None; 3]);
        let before = ["a", "b", "c"].map(|camera| of(&belief, camera));
        belief.worsen(&name(reopened), [0.5, 3e-5]);
        for (camera, before) in ["a", "b", "c"].into_iter().zip(before) {
            let after = of(&belief, camera);
            // No clock's estimate steps, and only the reopened clock becomes uncertain.
            assert!(
                (after.offset_s - before.offset_s).abs() < 1e-9,
                "{camera}: {after:?} {before:?}"
            );
            assert!((after.drift - before.drift).abs() < 1e-12, "{camera}: {after:?} {before:?}");
            let unsure = if camera == reopened { 0.4..0.5 } else { 0.0..0.05 };
            assert!(unsure.contains(&after.relative_sd_s), "{camera}: {after:?}");
        }
        assert!(belief.covariance.clone().cholesky().is_some());
        let (b, later) =
            (of(&belief, "b"), belief.estimate(&name("b"), Timestamp::from_seconds(60.0)));
        assert!((later.unwrap().offset_s - b.offset_s - 60.0 * b.drift).abs() < 1e-9);
        belief.advance(Timestamp::from_seconds(60.0));
        let moved = belief.estimate(&name("b"), Timestamp::from_seconds(60.0)).unwrap();
        assert!((moved.offset_s - later.unwrap().offset_s).abs() < 1e-9);
    }
}

#[test]
fn beginning_anew_and_calibrating_leave_a_regular_covariance() {
    let pose = Some(Matrix6::identity() * 1e-6);
    let (mut belief, _) = learnt([pose, None, pose]);
    belief.calibrate(&name("b"), pose);
    belief.calibrate(&name("c"), None);
    assert_eq!(belief.pose(&name("c")), None);
    assert!(belief.covariance.clone().cholesky().is_some());
    belief.reset_all();
    assert!(belief.covariance.clone().cholesky().is_some());
    assert_eq!(of(&belief, "b").offset_s, 0.0);
    assert!(belief.pose(&name("b")).is_some());
}
