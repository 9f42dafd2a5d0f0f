//! Relative pose of two cameras from a flight in a plane: any essential matrix of a whole family
//! fits such a flight, but a homography gives the two possible poses.

use nalgebra::{Matrix3, SMatrix, Vector3};

/// The second camera's frame from the first's: a direction `a` to a place is `R a + t` in the
/// second's.
#[derive(Clone, Copy, Debug)]
pub(super) struct SecondFromFirst {
    pub(super) rotation: Matrix3<f64>,
    /// In any unit of length.
    pub(super) shift: Vector3<f64>,
}

/// Eigenvalues nearer together than this are equal: the cameras stand in one place. With half of it
/// the same.
const EQUAL: f64 = 1e-6;

/// The homography `b ~ H a` from the first camera's directions to the second's, for places in a
/// plane, and the median angle by which it misses, rad.
pub(super) fn homography(seen: &[[Vector3<f64>; 2]]) -> Option<(Matrix3<f64>, f64)> {
    let mut sum = SMatrix::<f64, 9, 9>::zeros();
    for [a, b] in seen {
        // b x (H a) = 0, linear in H by columns: the Kronecker product of a' and [b]x.
        let row: SMatrix<f64, 3, 9> = a.transpose().kronecker(&b.cross_matrix());
        sum += row.transpose() * row;
    }
    let eigen = sum.symmetric_eigen();
    let least = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    let matrix = Matrix3::from_column_slice(least.as_slice());
    // Places lie ahead of both cameras, so the sign is the one that takes directions to directions
    // and not to their opposites.
    let ahead = seen.iter().filter(|[a, b]| b.dot(&(matrix * a)) > 0.0).count();
    let matrix = if 2 * ahead < seen.len() { -matrix } else { matrix };
    let mut angles: Vec<f64> = seen.iter().map(|[a, b]| (matrix * a).angle(b)).collect();
    angles.sort_unstable_by(f64::total_cmp);
    Some((matrix, *angles.get(angles.len() / 2)?))
}

/// Possible rotation and shift (in units of the plane's distance) of the second camera by a
/// homography: of the four those with all places ahead (Ma, Soatto, Kosecka and Sastry 2004,
/// section 5.3.3).
pub(super) fn poses(matrix: &Matrix3<f64>, seen: &[[Vector3<f64>; 2]]) -> Vec<SecondFromFirst> {
    let mut values = matrix.singular_values();
    values.as_mut_slice().sort_unstable_by(f64::total_cmp);
    // H = R + t n'/d has the middle singular value one.
    let unit = matrix / values[1];
    let eigen = unit.tr_mul(&unit).symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_unstable_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    let [most, _, least] = order.map(|k| eigen.eigenvalues[k]);
    let [v1, v2, v3] = order.map(|k| eigen.eigenvectors.column(k).into_owned());
    if most - least < EQUAL {
        return Vec::new();
    }
    let scale = (most - least).sqrt();
    let (along, across) =
        ((1.0 - least).max(0.0).sqrt() / scale, (most - 1.0).max(0.0).sqrt() / scale);
    // Unit vectors in the plane spanned by v1 and v3 whose length H keeps, as it does that of v2.
    let kept = [across, -across].map(|across| v1 * along + v3 * across);
    let found = kept.into_iter().flat_map(|u| poses_by_kept(&unit, v2, u));
    found.filter(|pose| is_ahead(&pose.normal, seen)).map(|pose| pose.second_from_first).collect()
}

/// A pose that a homography allows.
struct PoseByPlane {
    second_from_first: SecondFromFirst,
    /// The plane's normal in the first camera's frame.
    normal: Vector3<f64>,
}

/// The two poses, of opposite normals, by a homography of middle singular value one and two unit
/// vectors whose length it keeps.
fn poses_by_kept(unit: &Matrix3<f64>, v: Vector3<f64>, u: Vector3<f64>) -> [PoseByPlane; 2] {
    let normal = v.cross(&u);
    // R takes v and u to their images under H, and their cross product to that of the images; then
    // t n' = H - R.
    let before = Matrix3::from_columns(&[v, u, normal]);
    let (hv, hu) = (unit * v, unit * u);
    let after = Matrix3::from_columns(&[hv, hu, hv.cross(&hu)]);
    let rotation = after * before.transpose();
    let shift = (unit - rotation) * normal;
    [(shift, normal), (-shift, -normal)].map(|(shift, normal)| PoseByPlane {
        second_from_first: SecondFromFirst { rotation, shift },
        normal,
    })
}

/// Whether nearly all places lie ahead of the first camera, if this is the normal of their plane.
fn is_ahead(normal: &Vector3<f64>, seen: &[[Vector3<f64>; 2]]) -> bool {
    let ahead = seen.iter().filter(|[a, _]| normal.dot(a) > 0.0).count();
    10 * ahead > 9 * seen.len()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Rotation3};

    use super::*;

    #[test]
    fn one_of_the_poses_is_that_which_saw_the_plane() {
        let turn = Rotation3::new(Vector3::new(0.1, -0.8, 0.05));
        let centre = Point3::new(40.0, -3.0, 12.0);
        let seen: Vec<[Vector3<f64>; 2]> = (0..60)
            .map(|k| {
                let t = 0.1 * f64::from(k);
                // A plane askew to both.
                let (x, y) = (25.0 * t.sin(), 12.0 * (1.7 * t).cos());
                let place = Point3::new(x, y, 60.0 + 0.3 * x - 0.4 * y);
                [place.coords.normalize(), (turn * (place - centre)).normalize()]
            })
            .collect();
        let (matrix, misfit) = homography(&seen).unwrap();
        assert!(misfit < 1e-9, "{misfit}");
        let poses = poses(&matrix, &seen);
        assert!((1..=2).contains(&poses.len()), "{}", poses.len());
        let shift = turn * -centre.coords;
        let is_true = |found: &SecondFromFirst| {
            (found.rotation - turn.matrix()).norm() < 1e-6
                && found.shift.normalize().dot(&shift.normalize()) > 1.0 - 1e-9
        };
        assert!(poses.iter().any(is_true), "{poses:?}");
    }
}
