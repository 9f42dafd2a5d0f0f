//! Comparison of two calibrations of one site.

use crossfix_geometry::{Pixel, tangent_basis};
use crossfix_message::CameraName;
use nalgebra::{Matrix3, Point3, Rotation3, SMatrix, SVector, Unit, Vector2, Vector3};

use crate::calibrated_camera::{CalibratedCamera, grid};
use crate::site_file::SiteCalibration;

/// Least number of cameras for a move of the site: with fewer it would absorb what one of them was
/// knocked by.
const LEAST_MOVED: usize = 3;
/// Gauss-Newton steps to the move of the site: a common offset, as logs cause, takes three, and a
/// dozen more until a camera that was knocked no longer counts. With half of it such a camera still
/// draws the site after it.
const STEPS: usize = 24;
/// Degrees of freedom of Student's t for all pixels of a camera together: a camera that differs
/// from the others by ten deviations counts a twentieth. With twice as much it counts a twelfth.
const FREEDOM: f64 = 4.0;
/// Priors of the move, which is taken to be none where no sight line determines it: deviations wide
/// enough to leave what a sight line does determine, m, rad, share. With half of them the same.
const UNTOLD: [f64; 7] = [1e3, 1e3, 1e3, 3.0, 3.0, 3.0, 3.0];

/// Least stated deviation of a direction, rad: a calibration that states less counts no more; a
/// thousandth of a pixel. With half of it one that states next to nothing counts four times as
/// much.
const LEAST_SAID_RAD: f64 = 1e-6;

/// How two calibrations differ.
#[derive(Clone, Debug)]
pub struct SiteComparison {
    /// The move of the site that brings the first calibration to the second: what a log was off by
    /// in place or time is common to all cameras. `None` where fewer than three cameras are in
    /// both: the move would absorb what one of them was knocked by, and they are compared as they
    /// are.
    pub moved: Option<SiteMove>,
    /// Remaining differences of the cameras that are in both, in the order of the first.
    pub cameras: Vec<CameraComparison>,
    /// Cameras that are in one calibration only.
    pub missing: Vec<CameraName>,
}

/// A move of a site: `x -> centre + shift + size turn (x - centre)`, where the centre is
/// [`Self::middle`].
#[derive(Clone, Copy, Debug)]
pub struct SiteMove {
    /// Mean of the points that the cameras look at, in the first.
    pub middle: Point3<f64>,
    /// Shift of that point, m.
    pub shift: Vector3<f64>,
    /// Rotation of the second against the first.
    pub turn: Rotation3<f64>,
    /// Scale: how many times larger the second is.
    pub size: f64,
    /// How much later the second's common time is, s; `None` where no clock was calibrated in both.
    pub later_s: Option<f64>,
}

impl SiteMove {
    /// The identity about the mean of the sights' targets; `None` if there are none.
    fn none(sights: &[ComparedPixel]) -> Option<Self> {
        let sum: Vector3<f64> = sights.iter().map(|sight| sight.target.coords).sum();
        (!sights.is_empty()).then(|| Self {
            middle: Point3::from(sum / sights.len() as f64),
            shift: Vector3::zeros(),
            turn: Rotation3::identity(),
            size: 1.0,
            later_s: None,
        })
    }

    fn applied(&self, place: Point3<f64>) -> Point3<f64> {
        self.middle + self.shift + self.turn * (place - self.middle) * self.size
    }

    /// Angle between a moved target and the second's line of sight, rad.
    fn angle(&self, sight: &ComparedPixel) -> f64 {
        let before = self.applied(sight.target) - sight.from;
        // By the tangent: the cosine cannot resolve angles below 1e-8.
        before.cross(&sight.direction).norm().atan2(before.dot(&sight.direction))
    }

    /// How far a moved target misses the second's line of sight, in the line's tangents, rad, and
    /// the derivative of that by shift, turn and relative size.
    fn miss(&self, sight: &ComparedPixel) -> Option<(Vector2<f64>, SMatrix<f64, 2, 7>)> {
        let arm = self.turn * (sight.target - self.middle) * self.size;
        let (towards, range) =
            Unit::try_new_and_get(self.middle + self.shift + arm - sight.from, 1e-6)?;
        let towards = towards.into_inner();
        // d(direction) / d(place) = (I - u u') / range
        let tangents = tangent_basis(&sight.direction).transpose();
        let by_place = tangents * (Matrix3::identity() - towards * towards.transpose()) / range;
        let mut by = SMatrix::<f64, 2, 7>::zeros();
        by.fixed_columns_mut::<3>(0).copy_from(&by_place);
        // A turn moves the place by turn x arm = -[arm]x turn, growth moves it along the arm.
        by.fixed_columns_mut::<3>(3).copy_from(&(-by_place * arm.cross_matrix()));
        by.set_column(6, &(by_place * arm));
        Some((tangents * towards, by))
    }
}

/// Remaining difference of one camera after the move of the site.
#[derive(Clone, Debug)]
pub struct CameraComparison {
    /// Which.
    pub name: CameraName,
    /// How far apart its centres are, m.
    pub centre_m: f64,
    /// Root mean square over the image of the angle between the directions of a pixel, towards
    /// targets at the first's range, rad per axis.
    pub apart_rad: f64,
    /// The largest of these angles, rad.
    pub most_rad: f64,
    /// Its standard deviation as both calibrations state it: the root mean square over the same
    /// pixels, rad per axis.
    pub said_rad: f64,
    /// Root mean square of each pixel's angle divided by its stated deviation: one, where both
    /// state consistent deviations and are independent of each other.
    pub deviations: f64,
    /// The second's focal length relative to the first's.
    pub focal_ratio: f64,
    /// How much more the second's clock is corrected than the first's, beside what all clocks have
    /// in common, s; `None` where one was not calibrated.
    pub later_s: Option<f64>,
    /// Pixels over the image.
    pub pixels: Vec<ShownPixel>,
}

/// Where a target is shown at the first calibration's range.
#[derive(Clone, Copy, Debug)]
pub struct ShownPixel {
    /// By the first calibration.
    pub first: Pixel,
    /// By the second, after the move of the site.
    pub second: Pixel,
}

/// A pixel of a camera in both calibrations, as a sight line.
#[derive(Clone, Copy)]
struct ComparedPixel {
    /// The pixel.
    pixel: Pixel,
    /// A target that the pixel shows by the first calibration.
    target: Point3<f64>,
    /// Where the second has the camera, ...
    from: Point3<f64>,
    /// ... and the pixel's direction.
    direction: Unit<Vector3<f64>>,
    /// Stated standard deviation of the angle between the two, rad per axis.
    said_rad: f64,
}

/// Compares two calibrations. `None` if they have no camera in common, or none whose lens shows
/// anything.
pub fn compare_sites(first: &SiteCalibration, second: &SiteCalibration) -> Option<SiteComparison> {
    let pairs: Vec<(&CalibratedCamera, &CalibratedCamera)> = first
        .cameras()
        .iter()
        .filter_map(|camera| Some((camera, second.camera(&camera.name)?)))
        .collect();
    let sights: Vec<Vec<ComparedPixel>> =
        pairs.iter().map(|(one, other)| sights(one, other)).collect();
    let has_move = pairs.len() >= LEAST_MOVED;
    let later: Vec<Option<f64>> = pairs.iter().map(|(one, other)| later_s(one, other)).collect();
    let mut known: Vec<f64> = later.iter().copied().flatten().collect();
    known.sort_unstable_by(f64::total_cmp);
    // The median: a clock that was set again must not make all others late.
    let common_s = known.get(known.len() / 2).copied().filter(|_| has_move);
    let all = sights.concat();
    let stays = SiteMove::none(&all)?;
    let moved = if has_move { site_move(stays, &sights)? } else { stays };
    let cameras = pairs
        .iter()
        .zip(&sights)
        .zip(later)
        .filter(|((_, sights), _)| !sights.is_empty())
        .map(|((pair, sights), later_s)| {
            let later_s = later_s.map(|own| own - common_s.unwrap_or(0.0));
            camera(pair.0, pair.1, sights, &moved, later_s)
        })
        .collect();
    let missing = [only_in(first, second), only_in(second, first)].concat();
    let moved = has_move.then_some(SiteMove { later_s: common_s, ..moved });
    Some(SiteComparison { moved, cameras, missing })
}

/// The cameras of a calibration that another one does not have.
fn only_in(site: &SiteCalibration, other: &SiteCalibration) -> Vec<CameraName> {
    let alone = |camera: &&CalibratedCamera| other.camera(&camera.name).is_none();
    site.cameras().iter().filter(alone).map(|camera| camera.name.clone()).collect()
}

/// The pixels that both calibrations have a direction for.
fn sights(one: &CalibratedCamera, other: &CalibratedCamera) -> Vec<ComparedPixel> {
    let size = one.camera.model().intrinsics().size;
    grid(size).filter_map(|pixel| sight(one, other, pixel)).collect()
}

fn sight(one: &CalibratedCamera, other: &CalibratedCamera, pixel: Pixel) -> Option<ComparedPixel> {
    let said = |camera: &CalibratedCamera| camera.pointing_sd_rad(pixel, one.range_m);
    let target = direction(one, pixel)?.into_inner() * one.range_m;
    Some(ComparedPixel {
        pixel,
        target: one.camera.pose().position() + target,
        from: other.camera.pose().position(),
        direction: direction(other, pixel)?,
        // The calibrations' errors are taken to be independent: their variances add.
        said_rad: said(one)?.hypot(said(other)?).max(LEAST_SAID_RAD),
    })
}

/// A pixel's direction in the world.
fn direction(camera: &CalibratedCamera, pixel: Pixel) -> Option<Unit<Vector3<f64>>> {
    let own = camera.camera.model().direction(pixel).ok()?;
    Some(Unit::new_normalize(camera.camera.pose().rotation() * own.into_inner()))
}

/// The similarity that brings the first's targets nearest to the second's lines of sight, in
/// deviations. A camera that was knocked must not draw the site after it: its pixels share one
/// weight, from heavy tails.
fn site_move(mut moved: SiteMove, cameras: &[Vec<ComparedPixel>]) -> Option<SiteMove> {
    for _ in 0..STEPS {
        let mut information =
            SMatrix::<f64, 7, 7>::from_diagonal(&SVector::from(UNTOLD).map(|sd: f64| sd.powi(-2)));
        let mut right = SVector::<f64, 7>::zeros();
        for sights in cameras {
            let misses: Vec<_> =
                sights.iter().map(|sight| moved.miss(sight)).collect::<Option<_>>()?;
            let weights = sights.iter().map(|sight| sight.said_rad.powi(-2));
            let squares: f64 =
                misses.iter().zip(weights.clone()).map(|((r, _), w)| r.norm_squared() * w).sum();
            // Student's t weight by the camera's mean square, per axis.
            let typical = squares / (2 * sights.len()).max(1) as f64;
            let of_camera = (FREEDOM + 1.0) / (FREEDOM + typical);
            for ((residual, by), weight) in misses.iter().zip(weights) {
                information += by.transpose() * by * (weight * of_camera);
                right -= by.transpose() * residual * (weight * of_camera);
            }
        }
        let step = information.cholesky()?.solve(&right);
        moved.shift += step.fixed_rows::<3>(0);
        // The turn is about the world's axes, hence from the left.
        moved.turn = Rotation3::new(step.fixed_rows::<3>(3).into_owned()) * moved.turn;
        moved.size *= 1.0 + step[6].clamp(-0.5, 0.5);
    }
    Some(moved)
}

/// Root of the mean of some squares.
fn root_mean(squares: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = squares.len() as f64;
    (squares.sum::<f64>() / count).sqrt()
}

fn later_s(one: &CalibratedCamera, other: &CalibratedCamera) -> Option<f64> {
    let middle = one.clock.knots_s.get(one.clock.knots_s.len() / 2)?[0];
    other.clock.knots_s.first()?;
    Some(other.clock.at(middle).ahead_s - one.clock.at(middle).ahead_s)
}

fn camera(
    one: &CalibratedCamera,
    other: &CalibratedCamera,
    sights: &[ComparedPixel],
    moved: &SiteMove,
    later_s: Option<f64>,
) -> CameraComparison {
    // An angle's square is that of two axes, hence the halves below.
    let mean = |square: &dyn Fn(&ComparedPixel) -> f64| root_mean(sights.iter().map(square));
    let focal = |camera: &CalibratedCamera| camera.camera.model().intrinsics().fx;
    let centre = moved.applied(one.camera.pose().position());
    CameraComparison {
        name: one.name.clone(),
        centre_m: (other.camera.pose().position() - centre).norm(),
        apart_rad: mean(&|sight| moved.angle(sight).powi(2) / 2.0),
        most_rad: sights.iter().map(|sight| moved.angle(sight)).fold(0.0, f64::max),
        said_rad: mean(&|sight| sight.said_rad.powi(2)),
        deviations: mean(&|sight| (moved.angle(sight) / sight.said_rad).powi(2) / 2.0),
        focal_ratio: focal(other) / focal(one),
        later_s,
        pixels: sights
            .iter()
            .filter_map(|sight| {
                let second = other.camera.project(moved.applied(sight.target))?;
                Some(ShownPixel { first: sight.pixel, second })
            })
            .collect(),
    }
}
