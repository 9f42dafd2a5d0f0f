use crossfix_geometry::{SightLine, tangent_basis};
use crossfix_message::Timestamp;
use nalgebra::{Matrix2, Point3, Unit, Vector2, Vector3};

use super::super::window::{ClockRole, StampedLine};
use super::*;
use crate::track::TrackId;
use crate::uncertainty::CorrelatedNoise;

const SD_RAD: f64 = 5e-4;

fn name(text: &str) -> CameraName {
    text.parse().unwrap()
}

/// The belief about the clock of `b` after a window of four seconds in which `a` sees a target at
/// 30 Hz until `until_s`, and `b` from `from_s` on, whose clock and lens err by so much; `None` if
/// the window is not accepted. Both clocks say 6 ms.
fn after(
    until_s: f64,
    from_s: f64,
    ahead_s: f64,
    lens_error: impl Fn(f64) -> Vector2<f64>,
) -> Option<crate::ClockEstimate> {
    let mut belief = Belief::default();
    for camera in ["a", "b"] {
        belief.add(&name(camera), [6e-3, 3e-5], 0.0, None);
    }
    belief.advance(Timestamp::EPOCH);
    let mut window = TrackWindow::new(TrackId(1), Timestamp::EPOCH);
    let place = |t: f64| Point3::new(-8.0 + 8.0 * t, 5.0 + t * t, 40.0);
    let origins = [("a", Point3::new(-70.0, -10.0, 2.0)), ("b", Point3::new(20.0, -60.0, 3.0))];
    for k in 0..240 {
        let (camera, origin) = origins[k % 2];
        let t = k as f64 / 60.0;
        let is_b = camera == "b";
        if is_b && t < from_s || !is_b && t > until_s {
            continue;
        }
        let exact = Unit::new_normalize(place(t) - origin);
        let error = if is_b { lens_error(t) } else { Vector2::zeros() };
        let direction = Unit::new_normalize(exact.into_inner() + tangent_basis(&exact) * error);
        let basis = tangent_basis(&direction);
        let covariance = Matrix2::identity() * SD_RAD.powi(2);
        let line = SightLine { origin, direction, basis, covariance };
        let stamped = Timestamp::EPOCH.plus_seconds(t + if is_b { ahead_s } else { 0.0 });
        let place = Vector3::from(place(t).coords);
        window.add(
            &name(camera),
            ClockRole::Estimated,
            StampedLine { time: stamped, line, lasting: CorrelatedNoise::NONE, white: 1.0 },
            place,
        );
    }
    match window_update(&belief, &window) {
        WindowUpdate::Accepted(belief) => {
            belief.estimate(&name("b"), Timestamp::EPOCH.plus_seconds(4.0))
        }
        WindowUpdate::Uninformative | WindowUpdate::Contradicts(_) => None,
    }
}

#[test]
fn a_clock_that_is_half_a_second_ahead_is_found() {
    let clock = after(4.0, 0.0, 0.5, |_| Vector2::zeros()).unwrap();
    // The other clock is as likely to be wrong: each has half of it, but for the chance that one of
    // them is right.
    assert!(clock.relative_sd_s < 0.02, "{clock:?}");
    assert!((clock.offset_s - 0.25).abs() < 0.02, "{clock:?}");
}

/// A lens that is wrong in a corner fits, too, where its bearings are moved to a time at which the
/// other camera is silent; and then its clock may have any offset.
#[test]
fn a_lens_that_errs_is_no_clock_that_has_jumped_by_nobody_knows_how_much() {
    for from_s in [0.0, 0.2, 0.4] {
        for across in [Vector2::new(0.0, 0.01), Vector2::new(-0.005, 0.008)] {
            let error = |t: f64| across * (0.5 + (t - from_s).max(0.0).powi(2));
            let clock = after(0.5, from_s, 0.0, error);
            assert!(
                clock.is_none_or(|clock| clock.relative_sd_s < 0.1),
                "from {from_s} s with {across:?}: {clock:?}"
            );
        }
    }
}
