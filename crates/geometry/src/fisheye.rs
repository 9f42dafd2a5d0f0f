//! The Kannala-Brandt equidistant projection with four coefficients (ROS: `equidistant`, OpenCV:
//! `fisheye`). It is implemented here, as it takes only a page: the maintained crates that offer it
//! each bring a second nalgebra, and stop inverting at 1e-6 of a focal length or panic on bad
//! input.

use nalgebra::{Vector2, Vector3};

/// theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
fn distorted_angle([k1, k2, k3, k4]: [f64; 4], theta: f64) -> f64 {
    let t2 = theta * theta;
    theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
}

/// d theta_d / d theta = 1 + 3 k1 theta^2 + 5 k2 theta^4 + 7 k3 theta^6 + 9 k4 theta^8.
fn slope([k1, k2, k3, k4]: [f64; 4], theta: f64) -> f64 {
    let t2 = theta * theta;
    1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
}

/// The image point of a direction (camera frame, any length), in focal lengths from the principal
/// point.
pub(crate) fn project(k: [f64; 4], direction: &Vector3<f64>) -> Vector2<f64> {
    let radius = direction.x.hypot(direction.y);
    let theta = radius.atan2(direction.z);
    // Exactly backwards every direction across is as good.
    let across = if radius > 0.0 { direction.xy() / radius } else { Vector2::x() };
    across * distorted_angle(k, theta)
}

/// The direction (a vector, not a point on z = 1: any angle up to pi) that falls on an image point;
/// `None` where the model has no inverse.
pub(crate) fn unproject(k: [f64; 4], point: Vector2<f64>) -> Option<Vector3<f64>> {
    let wanted = point.norm();
    // Newton's method for theta (1 + k1 theta^2 + ...) = |point|.
    let mut theta = wanted.min(std::f64::consts::PI);
    for _ in 0..50 {
        let step = (distorted_angle(k, theta) - wanted) / slope(k, theta);
        theta = (theta - step).clamp(0.0, std::f64::consts::PI);
        if step.abs() < 1e-14 {
            break;
        }
    }
    // Where the polynomial decreases again, its root is not a direction that the lens images.
    let found = (distorted_angle(k, theta) - wanted).abs() < 1e-9 && slope(k, theta) > 0.0;
    let (sin, cos) = theta.sin_cos();
    let across = if wanted > 1e-15 { point / wanted * sin } else { Vector2::zeros() };
    found.then(|| Vector3::new(across.x, across.y, cos))
}
