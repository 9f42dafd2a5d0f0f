//! Alignment to the survey: a site reconstructed from what cameras saw is brought to its true
//! place.

use crossfix_geometry::{Pose, Ray, turn_between, turn_vector};
use crossfix_message::CameraName;
use nalgebra::{Matrix3, Point3, Rotation3, Unit, Vector3};

use super::model::{CameraLabels, CameraUnknowns};
use super::state::FlightState;
use super::{linear, triangulation};
use crate::landmarks::{Landmark, LandmarkError, LandmarkPicture, calibrate_landmarks};
use crate::lens;
use crate::survey::{Click, ENOUGH_PLACES, Survey, SurveyedLandmark};

/// Similarity transformation: rotation, scale and shift.
struct SimilarityTransform {
    rotation: Rotation3<f64>,
    scale: f64,
    from: Point3<f64>,
    to: Point3<f64>,
}

/// Something of the site in both frames.
#[derive(Clone, Copy, Debug)]
struct InBoth<T> {
    /// As cameras reconstruct it.
    here: T,
    /// As the survey has it.
    there: T,
}

/// What is known in both frames: that of the reconstruction, and that of the survey.
struct Correspondences {
    places: Vec<InBoth<Point3<f64>>>,
    rotations: Vec<InBoth<Rotation3<f64>>>,
    /// Why cameras' own landmarks tell no pose.
    untold: Vec<String>,
}

/// Brings cameras and trajectory to where the survey has them, as near as it determines that, and
/// returns the scale, how many times larger they are there.
///
/// # Errors
/// The survey does not determine the size: what its landmarks lack.
pub(super) fn to_survey(
    state: &FlightState,
    labels: &[CameraLabels],
    survey: &Survey,
) -> Result<(FlightState, f64), Vec<String>> {
    let Correspondences { places, rotations, untold } =
        Correspondences::of(state, labels, survey).without_wrong();
    let scale = size(&places).or_else(|| taped(state, labels, survey)).ok_or(untold)?;
    let origins = if places.is_empty() {
        InBoth { here: state.cameras[0].centre, there: Point3::origin() }
    } else {
        middles(&places)
    };
    let mut arms = arms(&places, origins);
    let rotation = if rotations.is_empty() {
        turn(&arms).filter(|_| places.len() >= ENOUGH_PLACES)
    } else {
        // A camera's known pose also tells where its axes point.
        // Axes as long as the longest arm weigh as much in the sum as a place there.
        let length = arms.iter().map(|arm| arm.here.norm()).fold(1.0, f64::max);
        let axes = [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| axis * length);
        arms.extend(rotations.iter().flat_map(|InBoth { here, there }| {
            axes.map(|axis| InBoth { here: here * axis, there: there * axis })
        }));
        turn(&arms)
    };
    // Too few places for a rotation: upright by the images' rows, then turned to where the places
    // are.
    let rotation = rotation.unwrap_or_else(|| about(&arms, upright(&state.cameras)));
    let transform = SimilarityTransform { rotation, scale, from: origins.here, to: origins.there };
    Ok((transform.moved(state), scale))
}

fn middles(places: &[InBoth<Point3<f64>>]) -> InBoth<Point3<f64>> {
    InBoth {
        here: middle(places.iter().map(|place| place.here)),
        there: middle(places.iter().map(|place| place.there)),
    }
}

/// The places from an origin.
fn arms(places: &[InBoth<Point3<f64>>], origins: InBoth<Point3<f64>>) -> Vec<InBoth<Vector3<f64>>> {
    let InBoth { here: from, there: to } = origins;
    places.iter().map(|place| InBoth { here: place.here - from, there: place.there - to }).collect()
}

/// Of more places than these, evenly chosen ones make the triples that are tried: 1140. With half
/// of it 120, and wrong places are found all the same unless most of those chosen are wrong.
const TRIED_PLACES: usize = 20;
/// A place with a misfit this many times the median is wrong (with half of it one right place in
/// forty goes as well, by normal errors), ...
const FAR: f64 = 4.0;
/// ... if that is more than this share of their spread: lenses are off by percents at this stage.
/// With half of it places go that only the lenses have moved.
const LEAST_FAR: f64 = 0.05;
/// A pose turned by more than this is wrong, too, rad. With half of it right poses go where lens
/// files have bent the reconstruction by 6 degrees.
const FAR_TURNED_RAD: f64 = 0.2;

impl SimilarityTransform {
    /// The similarity that three places determine; `None` where they lie on a line.
    fn of_three(three: &[InBoth<Point3<f64>>]) -> Option<Self> {
        let origins = middles(three);
        let rotation = turn(&arms(three, origins))?;
        Some(Self { rotation, scale: size(three)?, from: origins.here, to: origins.there })
    }

    fn place(&self, place: Point3<f64>) -> Point3<f64> {
        self.to + self.rotation * (place - self.from) * self.scale
    }

    fn misfit(&self, place: &InBoth<Point3<f64>>) -> f64 {
        (self.place(place.here) - place.there).norm()
    }
}

impl Correspondences {
    /// Removes what is not where the rest is (least median of squares: the triple whose similarity
    /// half of all places fit best): one wrong place among four would turn the site over.
    fn without_wrong(mut self) -> Self {
        self.leave_turned_out();
        if self.places.len() <= ENOUGH_PLACES {
            return self;
        }
        let tried: Vec<InBoth<Point3<f64>>> =
            self.places.iter().step_by(self.places.len().div_ceil(TRIED_PLACES)).copied().collect();
        let mut best: Option<(f64, SimilarityTransform)> = None;
        for a in 0..tried.len() {
            for b in a + 1..tried.len() {
                for c in b + 1..tried.len() {
                    let three = [tried[a], tried[b], tried[c]];
                    let Some(shown) = SimilarityTransform::of_three(&three) else { continue };
                    // The median over all places: half of them may be wrong.
                    let misfit =
                        linear::median(self.places.iter().map(|place| shown.misfit(place)));
                    if best.as_ref().is_none_or(|(least, _)| misfit < *least) {
                        best = Some((misfit, shown));
                    }
                }
            }
        }
        let Some((misfit, shown)) = best else { return self };
        let to = middles(&self.places).there;
        let spread = linear::median(self.places.iter().map(|place| (place.there - to).norm()));
        // FAR times the median misfit, but at least LEAST_FAR of the spread.
        let most = FAR * misfit.max(LEAST_FAR / FAR * spread);
        self.places.retain(|place| shown.misfit(place) <= most);
        // R_there' R R_here is the turn that is left of a pose when the site is moved by R.
        self.rotations.retain(|InBoth { here, there }| {
            turn_vector(&(there.inverse() * shown.rotation * here)).norm() < FAR_TURNED_RAD
        });
        self
    }

    /// Removes rotations that differ far from what most others say of the site's rotation: those of
    /// cameras that have been knocked since.
    fn leave_turned_out(&mut self) {
        let site = |one: &InBoth<Rotation3<f64>>| one.there * one.here.inverse();
        let apart = |a: &Rotation3<f64>, b: &Rotation3<f64>| turn_vector(&(a.inverse() * b)).norm();
        let said: Vec<Rotation3<f64>> = self.rotations.iter().map(site).collect();
        // The medoid: the rotation with the least median distance from all.
        let median = |one: &Rotation3<f64>| linear::median(said.iter().map(|b| apart(one, b)));
        let middle = said.iter().min_by(|a, b| median(a).total_cmp(&median(b))).copied();
        if let Some(middle) = middle.filter(|_| said.len() > 2) {
            self.rotations.retain(|pair| apart(&site(pair), &middle) < FAR_TURNED_RAD);
        }
    }

    /// Collects cameras' surveyed places and earlier poses, landmarks that two cameras see, and
    /// cameras whose own landmarks tell their pose.
    fn of(state: &FlightState, labels: &[CameraLabels], survey: &Survey) -> Self {
        let mut known = Self { places: Vec::new(), rotations: Vec::new(), untold: Vec::new() };
        for (labels, camera) in labels.iter().zip(&state.cameras) {
            if let Some(place) = survey.place(&labels.name) {
                known.places.push(InBoth { here: camera.centre, there: place.position });
            }
            if let Some(earlier) = survey.known(&labels.name) {
                let there = *earlier.camera.pose().rotation();
                known.rotations.push(InBoth { here: camera.rotation, there });
            }
            match by_own_landmarks(labels, survey) {
                Ok(Some(pose)) => {
                    let there = *pose.rotation();
                    known.rotations.push(InBoth { here: camera.rotation, there });
                    known.places.push(InBoth { here: camera.centre, there: pose.position() });
                }
                Ok(None) => {}
                Err(why) => known.untold.push(why),
            }
        }
        for (landmark, there) in survey.placed_landmarks() {
            let clicks = landmark.clicks.iter();
            let lines: Vec<_> =
                clicks.filter_map(|click| sight_line(click, state, labels)).collect();
            let here = triangulation::place(&lines);
            known.places.extend(here.map(|(here, _)| InBoth { here, there }));
        }
        known
    }
}

/// The line on which a click has its landmark.
fn sight_line(click: &Click, state: &FlightState, labels: &[CameraLabels]) -> Option<Ray> {
    let index = labels.iter().position(|camera| camera.name == click.camera)?;
    let direction = lens::direction(&labels[index].intrinsics, click.pixel)?;
    let camera = &state.cameras[index];
    let direction = camera.rotation * Unit::new_normalize(direction);
    Some(Ray { origin: camera.centre, direction })
}

/// A camera's pose by the landmarks in its own picture; `None` where it has too few.
///
/// # Errors
/// Why the landmarks do not tell it.
fn by_own_landmarks(camera: &CameraLabels, survey: &Survey) -> Result<Option<Pose>, String> {
    let landmarks = survey.landmarks.iter();
    let mut picture = LandmarkPicture {
        camera: camera.name.clone(),
        intrinsics: camera.intrinsics,
        freedom: camera.freedom,
        place: survey.place(&camera.name).cloned(),
        landmarks: landmarks.filter_map(|known| in_picture(known, &camera.name)).collect(),
        sky_turn: Matrix3::zeros(),
    };
    let mut result = match calibrate_landmarks(&picture) {
        Err(LandmarkError::TooFew { .. }) => return Ok(None),
        result => result.map_err(|error| error.to_string())?,
    };
    if let [wrong] = &result.suspects[..] {
        picture.landmarks.retain(|landmark| landmark.name != *wrong);
        result = calibrate_landmarks(&picture).map_err(|error| error.to_string())?;
    }
    if result.is_wrong() {
        return Err(format!(
            "camera `{}`: its landmarks do not fit one another (six let a wrong one be named)",
            camera.name
        ));
    }
    Ok(Some(*result.camera.pose()))
}

/// A landmark in the picture of a camera.
fn in_picture(landmark: &SurveyedLandmark, camera: &CameraName) -> Option<Landmark> {
    let click = landmark.click_of(camera)?;
    Some(Landmark {
        name: landmark.name.clone(),
        pixel: click.pixel,
        click_sd_px: click.sd_px,
        at: landmark.at,
    })
}

fn middle(places: impl ExactSizeIterator<Item = Point3<f64>>) -> Point3<f64> {
    let count = places.len() as f64;
    Point3::from(places.map(|place| place.coords).sum::<Vector3<f64>>() / count)
}

/// Scale from the reconstruction to the survey, by at least two places.
fn size(places: &[InBoth<Point3<f64>>]) -> Option<f64> {
    let (mut here, mut there) = (0.0, 0.0);
    for (k, a) in places.iter().enumerate() {
        for b in &places[..k] {
            here += (a.here - b.here).norm();
            there += (a.there - b.there).norm();
        }
    }
    // Ratio of the summed distances: long ones, which are known better by their share, count for
    // more.
    (here > 0.0 && there > 0.0).then(|| there / here)
}

/// The same from a taped distance.
fn taped(state: &FlightState, labels: &[CameraLabels], survey: &Survey) -> Option<f64> {
    survey.distances.iter().find_map(|distance| {
        let [a, b] = distance.between.each_ref().map(|name| {
            let index = labels.iter().position(|camera| camera.name == *name);
            index.map(|index| state.cameras[index].centre)
        });
        Some(distance.metres / (b? - a?).norm())
    })
}

/// The rotation that brings arms over one another best (Kabsch); `None` where they lie on a line.
fn turn(arms: &[InBoth<Vector3<f64>>]) -> Option<Rotation3<f64>> {
    /// A second singular value below this share of the first counts as zero. Places beside a line
    /// by 3 % of its length are on it; with half of it errors of places turn the site about that
    /// line.
    const FLAT: f64 = 1e-3;
    // H = sum of there here' = U S V': R = U diag(1, 1, det(U V')) V'.
    let sum: Matrix3<f64> = arms.iter().map(|arm| arm.there * arm.here.transpose()).sum();
    let factors = sum.svd(true, true);
    let (u, v_t) = (factors.u?, factors.v_t?);
    if factors.singular_values[1] < FLAT * factors.singular_values[0] {
        return None;
    }
    let sign = (u * v_t).determinant().signum();
    let last = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign));
    Some(Rotation3::from_matrix_unchecked(u * last * v_t))
}

/// The rotation that makes cameras upright, taking the rows of their images as level.
fn upright(cameras: &[CameraUnknowns]) -> Rotation3<f64> {
    let rows = cameras.iter().map(|camera| camera.rotation * Vector3::x());
    let sum: Matrix3<f64> = rows.map(|row| row * row.transpose()).sum();
    // Up is across all rows: the direction of their least spread.
    let eigen = sum.symmetric_eigen();
    let across = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    // Image rows count downwards.
    let up: Vector3<f64> = cameras.iter().map(|camera| camera.rotation * -Vector3::y()).sum();
    let up = if across.dot(&up) < 0.0 { -across } else { across };
    turn_between(&Unit::new_normalize(up), &Vector3::z_axis())
        .unwrap_or_else(|| Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI))
}

/// The same, turned about the vertical to where arms point, and tipped by what remains.
fn about(arms: &[InBoth<Vector3<f64>>], upright: Rotation3<f64>) -> Rotation3<f64> {
    // The heading that maximises the sum of level scalar products: tan = sum of sines / sum of
    // cosines.
    let level = arms.iter().map(|arm| ((upright * arm.here).xy(), arm.there.xy()));
    let (sine, cosine) = level.fold((0.0, 0.0), |(sine, cosine), (here, there)| {
        (sine + here.perp(&there), cosine + here.dot(&there))
    });
    let turned = Rotation3::from_axis_angle(&Vector3::z_axis(), sine.atan2(cosine)) * upright;
    // Places on one line: the longest arm determines the tip best.
    let longest =
        arms.iter().max_by(|a, b| a.here.norm_squared().total_cmp(&b.here.norm_squared()));
    let tip = longest.and_then(|arm| smallest_turn(&(turned * arm.here), &arm.there));
    tip.map_or(turned, |tip| tip * turned)
}

/// The smallest turn that lays one arm on another; `None` where they are parallel.
fn smallest_turn(from: &Vector3<f64>, to: &Vector3<f64>) -> Option<Rotation3<f64>> {
    let axis = Unit::try_new(from.cross(to), 1e-9)?;
    Some(Rotation3::from_axis_angle(&axis, from.angle(to)))
}

impl SimilarityTransform {
    fn moved(&self, state: &FlightState) -> FlightState {
        let place = |place: Point3<f64>| self.place(place);
        let mut moved = state.clone();
        for camera in &mut moved.cameras {
            camera.centre = place(camera.centre);
            camera.rotation = self.rotation * camera.rotation;
        }
        for coefficient in &mut moved.way.coefficients {
            // The B-spline's weights sum to 1: moving the coefficients moves the trajectory.
            *coefficient = place(Point3::from(*coefficient)).coords;
        }
        moved
    }
}
