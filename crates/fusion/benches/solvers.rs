//! Which library solves which size: the measurement behind the choice in `spatial`.
//!
//! `cargo bench -p crossfix-fusion`

#![allow(clippy::unwrap_used, reason = "a benchmark that cannot set itself up has failed")]

use crossfix_fusion::papers::{stacked, triple};
use crossfix_fusion::spatial::{TimedLine, map};
use crossfix_geometry::{SightLine, tangent_basis};
use crossfix_message::Timestamp;
use divan::{Bencher, black_box};
use faer::Mat;
use nalgebra::{DMatrix, Matrix2, Matrix6, Point3, Unit, Vector3};

fn main() {
    divan::main();
}

/// Cameras on a circle of 150 m that look at a moving target, a tenth of a second apart.
fn lines(cameras: usize) -> Vec<TimedLine> {
    (0..cameras)
        .map(|i| {
            let angle = 2.0 * std::f64::consts::PI * i as f64 / cameras as f64;
            let origin =
                Point3::new(150.0 * angle.cos(), 150.0 * angle.sin(), 3.0 * (i % 4) as f64);
            let time = 0.1 * i as f64;
            let target = Point3::new(10.0 * time, 5.0, 60.0);
            let direction = Unit::new_normalize(target - origin);
            let basis = tangent_basis(&direction);
            let line =
                SightLine { origin, direction, basis, covariance: Matrix2::identity() * 1e-6 };
            TimedLine::exact(line, Timestamp::from_seconds(time))
        })
        .collect()
}

/// The stacked system's shape with numbers of its kind.
fn entry(row: usize, column: usize) -> f64 {
    ((row * 31 + column * 17) % 23) as f64 / 23.0 - 0.5
}

#[divan::bench]
fn triple_of_three_cameras(bencher: Bencher) {
    let lines = lines(3);
    bencher.bench(|| triple([&lines[0], &lines[1], &lines[2]], black_box(15.0)));
}

#[divan::bench(args = [3, 4, 8, 16])]
fn stacked_of_n_cameras(bencher: Bencher, cameras: usize) {
    let lines = lines(cameras);
    bencher.bench(|| stacked(black_box(&lines), 15.0));
}

#[divan::bench(args = [2, 3, 8, 16])]
fn map_of_n_lines(bencher: Bencher, cameras: usize) {
    let lines = lines(cameras);
    bencher.bench(|| map(black_box(&lines), Timestamp::EPOCH, 15.0));
}

#[divan::bench]
fn svd_6x6_nalgebra_fixed(bencher: Bencher) {
    let a = Matrix6::from_fn(entry) + Matrix6::identity();
    bencher.bench(|| black_box(a).try_svd(true, true, f64::EPSILON, 200));
}

#[divan::bench]
fn svd_6x6_faer(bencher: Bencher) {
    let a = Mat::from_fn(6, 6, |r, c| entry(r, c) + f64::from(u8::from(r == c)));
    bencher.bench(|| black_box(&a).thin_svd().is_ok());
}

#[divan::bench(args = [4, 16, 64])]
fn svd_of_n_cameras_nalgebra_dynamic(bencher: Bencher, cameras: usize) {
    let a = DMatrix::from_fn(3 * (cameras - 1), cameras + 3, entry);
    bencher.bench(|| black_box(a.clone()).try_svd(true, true, f64::EPSILON, 500).is_some());
}

#[divan::bench(args = [4, 16, 64])]
fn svd_of_n_cameras_faer(bencher: Bencher, cameras: usize) {
    let a = Mat::from_fn(3 * (cameras - 1), cameras + 3, entry);
    bencher.bench(|| black_box(&a).thin_svd().is_ok());
}

/// The least squares step that a fusion of exact sight lines would start with.
#[divan::bench]
fn closest_point_of_eight_lines(bencher: Bencher) {
    let lines = lines(8);
    bencher.bench(|| {
        let mut normal = nalgebra::Matrix3::zeros();
        let mut right = Vector3::zeros();
        for line in black_box(&lines) {
            let u = line.line.direction.into_inner();
            let across = nalgebra::Matrix3::identity() - u * u.transpose();
            normal += across;
            right += across * line.line.origin.coords;
        }
        normal.cholesky().map(|c| c.solve(&right))
    });
}
