//! Two calibrations of one site held against each other.

use crossfix_geometry::{Pixel, tangent_basis};
use crossfix_message::CameraName;
use nalgebra::{Matrix3, Point3, Rotation3, SMatrix, SVector, Unit, Vector2, Vector3};

use crate::calibrated_camera::{CalibratedCamera, grid};
use crate::site_file::SiteCalibration;

/// Of fewer cameras a move of the site would take on what one of them was knocked by.
const LEAST_MOVED: usize = 3;
/// Gauss and Newton's steps to the move of the site: from what logs lie beside it takes three, and a dozen
/// more until a camera that was knocked counts no more.
const STEPS: usize = 24;
/// Degrees of freedom of Student's t, a camera's pixels together: one that lies ten deviations beside the others
/// counts a twentieth.
const FREEDOM: f64 = 4.0;
/// What no sight tells of the move is nothing: deviations that leave what one tells, m, rad, share.
const UNTOLD: [f64; 7] = [1e3, 1e3, 1e3, 3.0, 3.0, 3.0, 3.0];

/// A calibration that says that it knows a direction better than this, rad, counts no more: a
/// thousandth of a pixel.
const LEAST_SAID_RAD: f64 = 1e-6;

/// How two calibrations differ.
#[derive(Clone, Debug)]
pub struct SiteComparison {
    /// What brings the first to the second as a whole: where a log lay beside or went ahead, it
    /// does so for all cameras. `None` where fewer than three are in both: it would take on what one
    /// of them was knocked by, and they are compared as they are.
    pub moved: Option<SiteMove>,
    /// How the cameras that both have differ beside that, in the order of the first.
    pub cameras: Vec<CameraComparison>,
    /// Cameras that one of them alone has.
    pub missing: Vec<CameraName>,
}

/// How one site becomes another: `x -> centre + shift + size turn (x - centre)`.
#[derive(Clone, Copy, Debug)]
pub struct SiteMove {
    /// The middle of what the cameras look at, in the first.
    pub middle: Point3<f64>,
    /// By how much that is shifted, m.
    pub shift: Vector3<f64>,
    /// How the second is turned against the first.
    pub turn: Rotation3<f64>,
    /// How many times larger the second is.
    pub size: f64,
    /// By how much the second's common time is later, s; `None` where no clock was calibrated in
    /// both.
    pub later_s: Option<f64>,
}

impl SiteMove {
    /// A site that stays where it is; `None` if nothing is seen.
    fn none(sights: &[Sight]) -> Option<Self> {
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

    /// By how much a target misses the second's line of sight along its tangents, rad, and how that
    /// follows shift, turn and the size's share.
    fn miss(&self, sight: &Sight) -> Option<(Vector2<f64>, SMatrix<f64, 2, 7>)> {
        let arm = self.turn * (sight.target - self.middle) * self.size;
        let (towards, range) =
            Unit::try_new_and_get(self.middle + self.shift + arm - sight.from, 1e-6)?;
        let towards = towards.into_inner();
        let tangents = tangent_basis(&sight.direction).transpose();
        let by_place = tangents * (Matrix3::identity() - towards * towards.transpose()) / range;
        let mut by = SMatrix::<f64, 2, 7>::zeros();
        by.fixed_columns_mut::<3>(0).copy_from(&by_place);
        by.fixed_columns_mut::<3>(3).copy_from(&(-by_place * arm.cross_matrix()));
        by.set_column(6, &(by_place * arm));
        Some((tangents * towards, by))
    }
}

/// How one camera differs beside what the site is moved by.
#[derive(Clone, Debug)]
pub struct CameraComparison {
    /// Which.
    pub name: CameraName,
    /// How far apart its centres are, m.
    pub centre_m: f64,
    /// Root mean square over the image of the angle between the directions of a pixel, towards
    /// targets at the range of the first's, rad per axis.
    pub apart_rad: f64,
    /// The largest of these angles, rad.
    pub most_rad: f64,
    /// What both say that this may be: the root mean square over the same pixels, rad per axis.
    pub said_rad: f64,
    /// The root mean square of each pixel's angle by what is said of it: one, where both are honest
    /// and know nothing of each other.
    pub deviations: f64,
    /// How many times longer the second's focal length is.
    pub focal_ratio: f64,
    /// By how much more the second's clock is corrected than the first's, beside what all are, s;
    /// `None` where one was not calibrated.
    pub later_s: Option<f64>,
    /// Pixels over the image, and where the second shows what the first shows there, beside that.
    pub pixels: Vec<(Pixel, Pixel)>,
}

/// A pixel of a camera in both calibrations.
#[derive(Clone, Copy)]
struct Sight {
    /// The pixel.
    pixel: Pixel,
    /// Where a target is that it shows by the first.
    target: Point3<f64>,
    /// Where the second has the camera, ...
    from: Point3<f64>,
    /// ... and the pixel's direction.
    direction: Unit<Vector3<f64>>,
    /// Standard deviation of the angle between the two, rad per axis.
    said_rad: f64,
}

/// Compares two calibrations. `None` if they have no camera in common, or one whose lens shows
/// nothing.
pub fn compare_sites(first: &SiteCalibration, second: &SiteCalibration) -> Option<SiteComparison> {
    let pairs: Vec<(&CalibratedCamera, &CalibratedCamera)> = first
        .cameras()
        .iter()
        .filter_map(|camera| Some((camera, second.camera(&camera.name)?)))
        .collect();
    let sights: Vec<Vec<Sight>> = pairs.iter().map(|(one, other)| sights(one, other)).collect();
    let has_move = pairs.len() >= LEAST_MOVED;
    let later: Vec<Option<f64>> = pairs.iter().map(|(one, other)| later_s(one, other)).collect();
    let mut known: Vec<f64> = later.iter().copied().flatten().collect();
    known.sort_unstable_by(f64::total_cmp);
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
            camera(*pair, sights, &moved, later_s)
        })
        .collect();
    let names = |site: &SiteCalibration, other: &SiteCalibration| -> Vec<CameraName> {
        let alone = |camera: &&CalibratedCamera| other.camera(&camera.name).is_none();
        site.cameras().iter().filter(alone).map(|camera| camera.name.clone()).collect()
    };
    let missing = [names(first, second), names(second, first)].concat();
    let moved = has_move.then_some(SiteMove { later_s: common_s, ..moved });
    Some(SiteComparison { moved, cameras, missing })
}

/// The pixels that both calibrations have a direction for.
fn sights(one: &CalibratedCamera, other: &CalibratedCamera) -> Vec<Sight> {
    let size = one.camera.model().intrinsics().size;
    let direction = |camera: &CalibratedCamera, pixel: Pixel| {
        let own = camera.camera.model().direction(pixel).ok()?;
        Some(Unit::new_normalize(camera.camera.pose().rotation() * own.into_inner()))
    };
    let said = |camera: &CalibratedCamera, pixel| camera.pointing_sd_rad(pixel, one.range_m);
    let sight = |pixel| {
        let target = direction(one, pixel)?.into_inner() * one.range_m;
        Some(Sight {
            pixel,
            target: one.camera.pose().position() + target,
            from: other.camera.pose().position(),
            direction: direction(other, pixel)?,
            said_rad: said(one, pixel)?.hypot(said(other, pixel)?).max(LEAST_SAID_RAD),
        })
    };
    grid(size).filter_map(sight).collect()
}

/// The similarity that brings the first's targets nearest to the second's lines of sight, in
/// deviations. A camera that was knocked must not draw at the site: its pixels have one weight, and heavy tails.
fn site_move(mut moved: SiteMove, cameras: &[Vec<Sight>]) -> Option<SiteMove> {
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
            let typical = squares / (2 * sights.len()).max(1) as f64;
            let of_camera = (FREEDOM + 1.0) / (FREEDOM + typical);
            for ((residual, by), weight) in misses.iter().zip(weights) {
                information += by.transpose() * by * (weight * of_camera);
                right -= by.transpose() * residual * (weight * of_camera);
            }
        }
        let step = information.cholesky()?.solve(&right);
        moved.shift += step.fixed_rows::<3>(0);
        moved.turn = Rotation3::new(step.fixed_rows::<3>(3).into_owned()) * moved.turn;
        moved.size *= 1.0 + step[6].clamp(-0.5, 0.5);
    }
    Some(moved)
}

fn later_s(one: &CalibratedCamera, other: &CalibratedCamera) -> Option<f64> {
    let middle = one.clock.knots_s.get(one.clock.knots_s.len() / 2)?[0];
    other.clock.knots_s.first()?;
    Some(other.clock.at(middle).0 - one.clock.at(middle).0)
}

fn camera(
    (one, other): (&CalibratedCamera, &CalibratedCamera),
    sights: &[Sight],
    moved: &SiteMove,
    later_s: Option<f64>,
) -> CameraComparison {
    // By the tangent: the cosine knows no angle below 1e-8.
    let angle = |sight: &Sight| {
        let before = moved.applied(sight.target) - sight.from;
        before.cross(&sight.direction).norm().atan2(before.dot(&sight.direction))
    };
    let mean = |value: &dyn Fn(&Sight) -> f64| {
        (sights.iter().map(value).sum::<f64>() / sights.len() as f64).sqrt()
    };
    let focal = |camera: &CalibratedCamera| camera.camera.model().intrinsics().fx;
    let centre = moved.applied(one.camera.pose().position());
    CameraComparison {
        name: one.name.clone(),
        centre_m: (other.camera.pose().position() - centre).norm(),
        apart_rad: mean(&|sight| angle(sight).powi(2) / 2.0),
        most_rad: sights.iter().map(angle).fold(0.0, f64::max),
        said_rad: mean(&|sight| sight.said_rad.powi(2)),
        deviations: mean(&|sight| (angle(sight) / sight.said_rad).powi(2) / 2.0),
        focal_ratio: focal(other) / focal(one),
        later_s,
        pixels: sights
            .iter()
            .filter_map(|sight| {
                Some((sight.pixel, other.camera.project(moved.applied(sight.target))?))
            })
            .collect(),
    }
}
