//! Where one more camera would help most.

use crossfix_geometry::{Camera, Pose};
use nalgebra::{Matrix6, Point3, Vector2, Vector3};
use serde::Serialize;

use super::plan::{TimedCamera, accuracy, prior};
use super::{Assumptions, FisherInformation, PlannedCamera, Volume};

/// Radii of the candidates' rings, relative to the cameras' median distance from the volume's
/// middle. The smallest is about the border of the default volume; half of it would lie within the
/// volume.
const RINGS: [f64; 5] = [0.5, 0.75, 1.0, 1.25, 1.5];
/// Candidates per ring. With half of it the best direction may be missed by 15 degrees; with twice
/// as many the advice takes twice as long.
const DIRECTIONS: u32 = 24;
/// Largest number of cubes that a candidate is scored by; of more cubes every n-th is used. With
/// half of it places that are nearly as good as each other are ranked by which cubes were used;
/// with twice as many the advice takes twice as long.
const SAMPLE: usize = 2000;

/// Quality of a set of cameras over a volume.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Score {
    /// Median of the position's standard deviation, m, over *all* of the volume: where there is no
    /// fix, or a worse one, the volume's diagonal is counted.
    pub median_sd_m: f64,
    /// The geometric mean of the same, m, which decides between equal medians. The arithmetic mean
    /// would count the bad fixes of two cameras side by side as nearly as good as a good fix.
    pub mean_sd_m: f64,
    /// Share of the volume with a fix.
    pub fixed: f64,
}

/// A place for one more camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CandidatePlace {
    /// The place, ENU, m.
    pub position_m: [f64; 3],
    /// The score with it.
    pub score: Score,
}

/// Where one more camera would help most.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Advice {
    /// Name of the camera whose intrinsics, rate and clock the additional one has.
    pub like: String,
    /// The point that each candidate is aimed at, ENU, m.
    pub look_at_m: [f64; 3],
    /// The score of the present cameras.
    pub now: Score,
    /// The candidates, the best first.
    pub candidates: Vec<CandidatePlace>,
}

impl Advice {
    /// The best `count` candidates that are at least `apart_m` apart, m: neighbours are about
    /// equally good.
    pub fn best_apart(&self, count: usize, apart_m: f64) -> Vec<CandidatePlace> {
        let mut best: Vec<CandidatePlace> = Vec::new();
        for candidate in &self.candidates {
            let place = Point3::from(candidate.position_m);
            let apart =
                |other: &CandidatePlace| (Point3::from(other.position_m) - place).norm() >= apart_m;
            if best.len() < count && best.iter().all(apart) {
                best.push(*candidate);
            }
        }
        best
    }
}

fn score(deviations: &mut [f64], fixed: usize) -> Score {
    deviations.sort_by(f64::total_cmp);
    let count = deviations.len().max(1) as f64;
    Score {
        median_sd_m: deviations.get(deviations.len() / 2).copied().unwrap_or(f64::INFINITY),
        mean_sd_m: (deviations.iter().map(|sd| sd.ln()).sum::<f64>() / count).exp(),
        fixed: fixed as f64 / count,
    }
}

/// A cube of the sample with the present cameras' information on a target in it.
struct SampleCube {
    point: Point3<f64>,
    cameras: usize,
    information: FisherInformation,
}

fn known(cameras: &[PlannedCamera], volume: &Volume, assumptions: &Assumptions) -> Vec<SampleCube> {
    // Phases as if the candidate were the last of the list.
    let phase = |index: usize| index as f64 / (cameras.len() + 1) as f64;
    let observers: Vec<TimedCamera> = cameras
        .iter()
        .enumerate()
        .map(|(index, camera)| TimedCamera::new(camera, phase(index), assumptions))
        .collect();
    let stride = volume.centres().count().div_ceil(SAMPLE).max(1);
    let sample = volume.centres().step_by(stride);
    sample.map(|(_, point)| known_cube(point, &observers, assumptions)).collect()
}

fn known_cube(
    point: Point3<f64>,
    observers: &[TimedCamera<'_>],
    assumptions: &Assumptions,
) -> SampleCube {
    let theirs: Vec<FisherInformation> =
        observers.iter().filter_map(|o| o.information(point)).collect();
    let mut information = prior(assumptions);
    theirs.iter().for_each(|one| information += one);
    SampleCube { point, cameras: theirs.len(), information }
}

fn score_with(known: &[SampleCube], extra: Option<&TimedCamera>, worst_m: f64) -> Score {
    let known: Vec<Option<f64>> = known.iter().map(|known| deviation_with(known, extra)).collect();
    let fixed = known.iter().flatten().count();
    let mut deviations: Vec<f64> =
        known.into_iter().map(|sd| sd.unwrap_or(worst_m).min(worst_m)).collect();
    score(&mut deviations, fixed)
}

/// Standard deviation of a position in a cube with an additional camera, m; `None` without a fix.
fn deviation_with(known: &SampleCube, extra: Option<&TimedCamera>) -> Option<f64> {
    let (mut information, mut cameras) = (known.information, known.cameras);
    if let Some(more) = extra.and_then(|extra| extra.information(known.point)) {
        information += &more;
        cameras += 1;
    }
    accuracy(cameras, &information).map(|accuracy| accuracy.position_sd_m)
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Tries one additional camera, like the first, at places on rings round the volume at the cameras'
/// median height, aimed at the volume's middle. Ground and obstacles are not known.
///
/// `None` if there is no camera.
pub fn advise(
    cameras: &[PlannedCamera],
    volume: &Volume,
    assumptions: &Assumptions,
) -> Option<Advice> {
    let like = cameras.first()?;
    let places: Vec<Point3<f64>> =
        cameras.iter().map(|camera| camera.camera.pose().position()).collect();
    let height = median(places.iter().map(|place| place.z).collect())?;
    let middle = volume.middle();
    let away = |place: &Point3<f64>| Vector2::new(place.x - middle.x, place.y - middle.y).norm();
    let distance = median(places.iter().map(away).collect())?;

    let known = known(cameras, volume, assumptions);
    let worst_m = volume.diagonal_m();
    let phase = cameras.len() as f64 / (cameras.len() + 1) as f64;
    let mut candidates: Vec<CandidatePlace> = RINGS
        .into_iter()
        .flat_map(|ring| (0..DIRECTIONS).map(move |direction| (ring * distance, direction)))
        .filter_map(|(radius_m, direction)| {
            let place = on_ring(middle, radius_m, height, direction);
            let more = moved(like, place, middle)?;
            let observer = TimedCamera::new(&more, phase, assumptions);
            let score = score_with(&known, Some(&observer), worst_m);
            Some(CandidatePlace { position_m: place.into(), score })
        })
        .collect();
    candidates.sort_by(|a, b| {
        let medians = a.score.median_sd_m.total_cmp(&b.score.median_sd_m);
        medians.then(a.score.mean_sd_m.total_cmp(&b.score.mean_sd_m))
    });
    let now = score_with(&known, None, worst_m);
    Some(Advice { like: like.name.clone(), look_at_m: middle.into(), now, candidates })
}

fn on_ring(middle: Point3<f64>, radius_m: f64, height: f64, direction: u32) -> Point3<f64> {
    let (sin, cos) =
        (f64::from(direction) / f64::from(DIRECTIONS) * std::f64::consts::TAU).sin_cos();
    let offset = Vector3::new(cos, sin, 0.0) * radius_m;
    Point3::new(middle.x + offset.x, middle.y + offset.y, height)
}

/// A camera like another, at a place and aimed at a point.
fn moved(like: &PlannedCamera, place: Point3<f64>, point: Point3<f64>) -> Option<PlannedCamera> {
    let pose = Pose::looking_at(place, point).ok()?;
    let camera = Camera::new(*like.camera.model().intrinsics(), pose).ok()?;
    let pose_covariance = carried(like, &camera);
    Some(PlannedCamera { camera, pose_covariance, ..like.clone() })
}

/// A camera's pose covariance, transferred to another pose: the position's errors turn with the
/// direction in which it looks, as the rotation's do.
fn carried(like: &PlannedCamera, other: &Camera) -> Matrix6<f64> {
    let turn = other.pose().rotation() * like.camera.pose().rotation().inverse();
    let mut carry = Matrix6::identity();
    carry.fixed_view_mut::<3, 3>(3, 3).copy_from(turn.matrix());
    carry * like.pose_covariance * carry.transpose()
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::{Distortion, ImageSize, Intrinsics};

    use super::super::TargetSize;
    use super::*;

    fn planned(position: [f64; 3]) -> PlannedCamera {
        let size = ImageSize { width: 1200, height: 1000 };
        let lens = Intrinsics {
            size,
            fx: 700.0,
            fy: 700.0,
            cx: 600.0,
            cy: 500.0,
            distortion: Distortion::None,
        };
        let pose = Pose::looking_at(position.into(), Point3::new(0.0, 0.0, 50.0)).unwrap();
        let camera = Camera::new(lens, pose).unwrap();
        let (turn, shift): (f64, f64) = (3e-4, 0.05);
        let variances = [turn, turn, turn, shift, shift, shift].map(|sd| sd * sd);
        PlannedCamera {
            name: "first".to_owned(),
            camera,
            rate_hz: 30.0,
            clock_sd_s: 0.0,
            pixel_sd_px: 0.5,
            lasting_noise_rad: 0.0,
            pose_covariance: Matrix6::from_diagonal(&variances.into()),
            lens_sd_rad: 0.0,
        }
    }

    fn assumptions() -> Assumptions {
        Assumptions {
            window_s: 1.0,
            speed_mps: 15.0,
            velocity_prior_sd_mps: Some(15.0),
            target: None,
            max_range_m: None,
        }
    }

    fn volume() -> Volume {
        Volume::new(Point3::new(-20.0, -20.0, 30.0), Point3::new(20.0, 20.0, 70.0), Some(10.0))
            .unwrap()
    }

    #[test]
    fn a_shallow_pair_wants_a_camera_across() {
        let cameras = [planned([-100.0, -10.0, 50.0]), planned([-100.0, 10.0, 50.0])];
        let advice = advise(&cameras, &volume(), &assumptions()).unwrap();
        assert_eq!(advice.candidates.len(), RINGS.len() * DIRECTIONS as usize);
        let best = &advice.candidates[0];
        let few = advice.best_apart(3, 40.0);
        assert_eq!(few.first(), Some(best));
        assert!((Point3::from(few[1].position_m) - Point3::from(few[2].position_m)).norm() >= 40.0);
        let [x, y, z] = best.position_m;
        assert!(y.abs() > 2.0 * x.abs(), "across the line of sight, not at ({x}, {y})");
        assert_eq!(z, 50.0);
        assert!(
            best.score.median_sd_m < 0.5 * advice.now.median_sd_m,
            "{best:?} against {:?}",
            advice.now
        );
    }

    #[test]
    fn what_nobody_fixes_counts_as_the_diagonal() {
        let advice = advise(&[planned([-100.0, 0.0, 50.0])], &volume(), &assumptions()).unwrap();
        assert_eq!(advice.now.fixed, 0.0);
        assert_eq!(advice.now.median_sd_m, volume().diagonal_m());
        let best = &advice.candidates[0];
        assert!(best.score.fixed > 0.9 && best.score.median_sd_m < 1.0, "{best:?}");
        assert_eq!(advise(&[], &volume(), &assumptions()), None);
    }

    #[test]
    fn where_little_is_fixed_at_all_a_camera_beside_another_is_not_the_best() {
        // The site to copy, and a target that a camera sees up to 97 m away: no two see it in one
        // place.
        let size = ImageSize { width: 1920, height: 1080 };
        let lens = Intrinsics {
            size,
            fx: 1460.0,
            fy: 1460.0,
            cx: 960.0,
            cy: 540.0,
            distortion: Distortion::None,
        };
        let cameras = [[115.0, -45.0, 4.0], [15.0, 120.0, 3.0], [-110.0, -60.0, 2.0]].map(
            |place: [f64; 3]| {
                let pose = Pose::looking_at(place.into(), Point3::new(0.0, 0.0, 46.0)).unwrap();
                PlannedCamera { camera: Camera::new(lens, pose).unwrap(), ..planned(place) }
            },
        );
        let target = Some(TargetSize { size_m: 0.4, least_px: 6.0 });
        let volume =
            Volume::new(Point3::new(-65.0, -65.0, 0.0), Point3::new(65.0, 65.0, 110.0), Some(10.0));
        let advice =
            advise(&cameras, &volume.unwrap(), &Assumptions { target, ..assumptions() }).unwrap();
        assert_eq!(advice.now.fixed, 0.0);
        let best = Point3::from(advice.candidates[0].position_m);
        for camera in &cameras {
            assert!((camera.camera.pose().position() - best).norm() > 20.0, "{best}");
        }
    }

    #[test]
    fn one_more_camera_never_harms() {
        let cameras = [
            planned([-100.0, 0.0, 50.0]),
            planned([0.0, -100.0, 50.0]),
            planned([60.0, 70.0, 2.0]),
        ];
        let advice = advise(&cameras, &volume(), &assumptions()).unwrap();
        for candidate in &advice.candidates {
            assert!(
                candidate.score.mean_sd_m <= advice.now.mean_sd_m * (1.0 + 1e-9),
                "{candidate:?}"
            );
        }
    }
}
