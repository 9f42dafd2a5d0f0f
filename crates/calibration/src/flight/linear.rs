//! A camera's pose from directions and places without a first guess: the direct linear
//! transformation.

use nalgebra::{Matrix3, Point3, Rotation3, SMatrix, SVector, Vector3};

/// A direction in the camera's frame, and the place that is seen there.
pub(super) type DirectionToPlace = (Vector3<f64>, Point3<f64>);

/// Rounds in which pairs that do not fit are given less weight: with half as many rounds a tenth of
/// outliers still bends the solution.
const ROUNDS: usize = 6;

/// A linear map from places to directions, `d ~ M X + m` with any matrix M, so that it also fits a
/// camera whose lens or log is stretched.
#[derive(Clone, Debug)]
pub(super) struct AffineMap {
    /// M, up to its scale.
    pub(super) matrix: Matrix3<f64>,
    shift: Vector3<f64>,
}

impl AffineMap {
    /// The map with the sign that puts most places ahead of the camera.
    fn new(matrix: Matrix3<f64>, shift: Vector3<f64>, pairs: &[DirectionToPlace]) -> Self {
        let map = Self { matrix, shift };
        let ahead = pairs.iter().filter(|pair| map.is_ahead(pair)).count();
        let sign = if 2 * ahead >= pairs.len() { 1.0 } else { -1.0 };
        Self { matrix: matrix * sign, shift: shift * sign }
    }

    fn is_ahead(&self, (direction, place): &DirectionToPlace) -> bool {
        direction.dot(&(self.matrix * place.coords + self.shift)) > 0.0
    }

    /// Angle between a direction and the direction in which the map has its place, rad.
    fn misfit(&self, (direction, place): &DirectionToPlace) -> f64 {
        (self.matrix * place.coords + self.shift).angle(direction)
    }

    /// The angle that [`FITTING`] of all pairs lie below, rad.
    pub(super) fn typical_misfit(&self, pairs: &[DirectionToPlace]) -> f64 {
        typical(pairs.iter().map(|pair| self.misfit(pair)))
    }

    /// The nearest rotation and the camera's centre; `None` if the map is a mirror image.
    pub(super) fn pose(&self) -> Option<(Rotation3<f64>, Point3<f64>)> {
        let factors = self.matrix.svd(true, true);
        // M = U S V' is near s R' with the rotation R' = U V' and the scale s = mean of S.
        let camera_from_world = factors.u? * factors.v_t?;
        let size = factors.singular_values.mean();
        if size <= 0.0 || camera_from_world.determinant() < 0.0 {
            return None;
        }
        // M C + m = 0, so that C = -R m / s.
        let centre = -(camera_from_world.transpose() * self.shift) / size;
        let rotation = Rotation3::from_matrix_unchecked(camera_from_world.transpose());
        Some((rotation, Point3::from(centre)))
    }
}

/// Share of all pairs that must fit: the rest may be of birds. Half of the pairs can be made to fit
/// a wrong clock by a pose that leaves the other half anywhere.
const FITTING: f64 = 0.7;

/// The number that a share [`FITTING`] of some numbers lies below; infinite for none.
pub(super) fn typical(numbers: impl Iterator<Item = f64>) -> f64 {
    quantile(numbers, FITTING)
}

/// The median of some numbers; infinite for none.
pub(super) fn median(numbers: impl Iterator<Item = f64>) -> f64 {
    quantile(numbers, 0.5)
}

fn quantile(numbers: impl Iterator<Item = f64>, share: f64) -> f64 {
    let mut numbers: Vec<f64> = numbers.collect();
    numbers.sort_unstable_by(f64::total_cmp);
    let place = (share * numbers.len() as f64) as usize;
    numbers.get(place).copied().unwrap_or(f64::INFINITY)
}

/// The map that most pairs fit: outliers, such as birds among the labels, are given less weight
/// from round to round.
pub(super) fn robust(pairs: &[DirectionToPlace]) -> Option<AffineMap> {
    let axes = Normalised::of(pairs)?;
    // Iteratively reweighted: the scale of the weights is the misfit that most pairs stay below.
    let mut weights = vec![1.0; pairs.len()];
    let mut best: Option<(f64, AffineMap)> = None;
    for _ in 0..ROUNDS {
        let linear = axes.in_space(pairs, &weights)?;
        let misfit = linear.typical_misfit(pairs);
        for (weight, pair) in weights.iter_mut().zip(pairs) {
            // Cauchy's weights, 1 / (1 + (angle / scale)^2).
            *weight = (1.0 + (linear.misfit(pair) / misfit.max(LEAST_RAD)).powi(2)).recip();
        }
        if best.as_ref().is_none_or(|(least, _)| misfit < *least) {
            best = Some((misfit, linear));
        }
    }
    best.map(|(_, linear)| linear)
}

/// Misfit below which outliers need no smaller weights, rad. With half of it the same: only labels
/// without errors fit as well.
const LEAST_RAD: f64 = 1e-5;

/// The direct linear transformation: `d x (M X + m) = 0` for every direction d and place X.
pub(super) fn in_space(pairs: &[DirectionToPlace]) -> Option<AffineMap> {
    Normalised::of(pairs)?.in_space(pairs, &vec![1.0; pairs.len()])
}

/// The same for places in a plane, as of a flight at one height: the third axis follows from the
/// first two.
pub(super) fn in_plane(pairs: &[DirectionToPlace]) -> Option<AffineMap> {
    Normalised::of(pairs)?.in_plane(pairs)
}

/// Normalised coordinates of places: about their mean, along their principal axes with the widest
/// spread first, scaled to a spread of one.
struct Normalised {
    middle: Point3<f64>,
    axes: Matrix3<f64>,
    scale: f64,
}

impl Normalised {
    fn of(pairs: &[DirectionToPlace]) -> Option<Self> {
        let count = pairs.len() as f64;
        let middle =
            Point3::from(pairs.iter().map(|(_, p)| p.coords).sum::<Vector3<f64>>() / count);
        let offsets = pairs.iter().map(|(_, place)| place - middle);
        let squares: Matrix3<f64> = offsets.map(|offset| offset * offset.transpose()).sum();
        let spread = squares / count;
        // Principal axes, the widest spread first, made right-handed.
        let eigen = spread.symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        let columns = order.map(|k| eigen.eigenvectors.column(k).into_owned());
        let mut axes = Matrix3::from_columns(&columns);
        if axes.determinant() < 0.0 {
            axes.column_mut(2).neg_mut();
        }
        let scale = spread.trace().sqrt();
        (scale > 0.0).then_some(Self { middle, axes, scale })
    }

    fn place(&self, place: Point3<f64>) -> Vector3<f64> {
        self.axes.transpose() * (place - self.middle) / self.scale
    }

    /// Converts a map of normalised coordinates into one of world coordinates.
    fn in_world(
        &self,
        matrix: &Matrix3<f64>,
        shift: &Vector3<f64>,
        pairs: &[DirectionToPlace],
    ) -> AffineMap {
        // d ~ N A' (X - c) / s + n, with N and n of the normalised places: up to the factor s,
        // M = N A' and m = s n - M c.
        let from_world = matrix * self.axes.transpose();
        let shift = shift * self.scale - from_world * self.middle.coords;
        AffineMap::new(from_world, shift, pairs)
    }

    /// See [`in_space`]; each pair counts with its weight.
    fn in_space(&self, pairs: &[DirectionToPlace], weights: &[f64]) -> Option<AffineMap> {
        let sum: SMatrix<f64, 12, 12> =
            squares(pairs.iter().zip(weights).map(|((direction, place), weight)| {
                let place = self.place(*place).push(1.0).into();
                WeightedPair { direction, place, weight: *weight }
            }));
        // The eigenvector of the least eigenvalue minimises the sum of squares at unit length.
        let eigen = sum.try_symmetric_eigen(f64::EPSILON, MOST_ITERATIONS)?;
        let least = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
        let matrix = Matrix3::from_column_slice(&least.as_slice()[..9]);
        Some(self.in_world(&matrix, &least.fixed_rows::<3>(9).into_owned(), pairs))
    }

    /// See [`in_plane`].
    fn in_plane(&self, pairs: &[DirectionToPlace]) -> Option<AffineMap> {
        let sum: SMatrix<f64, 9, 9> = squares(pairs.iter().map(|(direction, place)| {
            let place = self.place(*place);
            WeightedPair { direction, place: [place.x, place.y, 1.0], weight: 1.0 }
        }));
        let eigen = sum.try_symmetric_eigen(f64::EPSILON, MOST_ITERATIONS)?;
        let least: SVector<f64, 9> =
            eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
        let (x, y) = (least.fixed_rows::<3>(0).into_owned(), least.fixed_rows::<3>(3).into_owned());
        let shift = least.fixed_rows::<3>(6).into_owned();
        // The first two columns of a rotation have length one, which sets the scale.
        let size = f64::midpoint(x.norm(), y.norm());
        if size <= 0.0 {
            return None;
        }
        let (x, y, shift) = (x / size, y / size, shift / size);
        // The eigenvector's sign is arbitrary: the one with most places ahead is taken, and the
        // third axis follows from it.
        let ahead = pairs.iter().filter(|(direction, place)| {
            let place = self.place(*place);
            direction.dot(&(x * place.x + y * place.y + shift)) > 0.0
        });
        let sign = if 2 * ahead.count() >= pairs.len() { 1.0 } else { -1.0 };
        let (x, y) = (x * sign, y * sign);
        let matrix = Matrix3::from_columns(&[x, y, x.cross(&y)]);
        Some(self.in_world(&matrix, &(shift * sign), pairs))
    }
}

/// A direction and the homogeneous coordinates of the place that is seen there.
struct WeightedPair<'a, const H: usize> {
    direction: &'a Vector3<f64>,
    place: [f64; H],
    weight: f64,
}

/// The sum of `A'A` of the equations `d x (M h) = 0`, for directions d and homogeneous places h
/// with their weights: with `A = h' (x) [d]x` each term is `h h' (x) [d]x'[d]x`.
fn squares<'a, const H: usize, const N: usize>(
    pairs: impl Iterator<Item = WeightedPair<'a, H>>,
) -> SMatrix<f64, N, N> {
    const { assert!(N == 3 * H) };
    let mut sum = SMatrix::<f64, N, N>::zeros();
    for WeightedPair { direction, place, weight } in pairs {
        // [d]x'[d]x = |d|^2 I - d d'
        let across = (Matrix3::from_diagonal_element(direction.norm_squared())
            - direction * direction.transpose())
            * weight;
        for row in 0..H {
            for column in 0..=row {
                let mut block = sum.fixed_view_mut::<3, 3>(3 * row, 3 * column);
                block += across * (place[row] * place[column]);
            }
        }
    }
    sum.fill_upper_triangle_with_lower_triangle();
    sum
}

/// Iterations at most: a symmetric matrix of a dozen rows takes about ten; one with values that are
/// not numbers would never end. With half of it the same.
const MOST_ITERATIONS: usize = 200;
