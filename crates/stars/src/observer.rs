//! Who looks at the sky: where, when, through what air.

use crossfix_geometry::Geodetic;
use crossfix_message::Timestamp;
use erfars::Astrom;
use erfars::astrometry::{Apco13, Atciq, Atioq};
use nalgebra::{Matrix3, Unit, Vector3};

use crate::StarError;

/// Julian date of the Unix epoch: 1970-01-01, 0 h.
const UNIX_EPOCH_JD: f64 = 2_440_587.5;
const DAY_S: f64 = 86_400.0;
/// Julian date of J2000.0, and days of a Julian year: proper motions are counted in these.
const J2000_JD: f64 = 2_451_545.0;
const JULIAN_YEAR_D: f64 = 365.25;

/// Pressure at sea level (hPa) and the height in which it falls to 1/e (m): the standard atmosphere.
const SEA_LEVEL_HPA: f64 = 1013.25;
const SCALE_HEIGHT_M: f64 = 8434.0;
/// A cool night, degrees Celsius; ten degrees more bend light by 3.5 % less.
const TEMPERATURE_C: f64 = 10.0;
/// Relative humidity and wavelength (micrometres, the middle of what cameras see): both change
/// refraction by less than 1 %.
const HUMIDITY: f64 = 0.5;
const WAVELENGTH_UM: f64 = 0.6;
/// So uncertain is refraction by weather that nobody has told: 15 degrees of temperature and 20 hPa, each a
/// standard deviation.
const REFRACTION_SHARE: f64 = 0.05;

/// UT1, by which the Earth turns, was within 0.3 s of UTC in these years, ...
const QUIET_YEARS: std::ops::Range<f64> = 2017.0..2028.0;
const QUIET_EARTH_SD_S: f64 = 0.15;
/// ... and is kept within 0.9 s of it. What it is of a day is in no file here. Standard deviations, s.
const EARTH_SD_S: f64 = 0.4;
/// The Earth's rate against the stars, rad/s.
const EARTH_RATE: f64 = 7.292_115e-5;

/// Where somebody looks at the sky from, and when.
#[derive(Clone, Copy, Debug)]
pub struct Observer {
    /// The site's origin, in whose east, north and up directions are given. A camera a kilometre
    /// from it sees stars refracted by another 0.01 mrad at most.
    pub place: Geodetic,
    /// UTC, the middle of the exposure.
    pub time: Timestamp,
}

/// By what all directions to stars may be turned together: nothing in a picture tells it.
#[derive(Clone, Copy, Debug)]
pub struct Turn {
    /// Covariance about east, north and up, rad^2.
    pub covariance: Matrix3<f64>,
}

/// The observer as ERFA counts: what is the same for all stars is done once.
pub(crate) struct Prepared {
    astrom: Astrom,
}

impl Observer {
    /// The year, with its fraction, up to which stars have moved.
    pub(crate) fn julian_year(&self) -> f64 {
        2000.0 + (self.julian_date() - J2000_JD) / JULIAN_YEAR_D
    }

    fn julian_date(&self) -> f64 {
        UNIX_EPOCH_JD + self.time.seconds() / DAY_S
    }

    pub(crate) fn prepare(&self) -> Result<Prepared, StarError> {
        // Whole days apart from the rest: a Julian date in one number is good to 20 microseconds only.
        let days = (self.time.seconds() / DAY_S).floor();
        let rest = self.time.seconds() / DAY_S - days;
        if !(1960.0..2100.0).contains(&self.julian_year()) {
            return Err(StarError::Time);
        }
        let pressure_hpa = SEA_LEVEL_HPA * (-self.place.height() / SCALE_HEIGHT_M).exp();
        let mut astrom = Astrom::default();
        let (ut1_less_utc_s, pole_x, pole_y) = (0.0, 0.0, 0.0);
        Apco13(
            UNIX_EPOCH_JD + days,
            rest,
            ut1_less_utc_s,
            self.place.longitude(),
            self.place.latitude(),
            self.place.height(),
            pole_x,
            pole_y,
            pressure_hpa,
            TEMPERATURE_C,
            HUMIDITY,
            WAVELENGTH_UM,
            &mut astrom,
        )
        .map_err(|_| StarError::Time)?;
        Ok(Prepared { astrom })
    }

    /// By what the sky as a whole may be turned: the picture's time, known to `time_sd_s`, about the Earth's
    /// axis; and refraction towards where the stars are, in the middle, about the horizontal across it.
    pub fn turn(&self, middle: &Unit<Vector3<f64>>, time_sd_s: f64) -> Turn {
        let (sin, cos) = self.place.latitude().sin_cos();
        let is_quiet = QUIET_YEARS.contains(&self.julian_year());
        let earth_sd_s = if is_quiet { QUIET_EARTH_SD_S } else { EARTH_SD_S };
        let pole = Vector3::new(0.0, cos, sin) * EARTH_RATE * time_sd_s.hypot(earth_sd_s);
        let across = Vector3::z().cross(middle).try_normalize(1e-9).unwrap_or_default();
        let tilt = across * refraction_sd_rad(middle);
        Turn { covariance: pole * pole.transpose() + tilt * tilt.transpose() }
    }
}

/// Light from the zenith's side is bent by a minute of arc for each tangent of the distance from it, rad.
const REFRACTION_RAD: f64 = 2.9e-4;
/// Catalogues are good to less; double stars, and what has moved beside them, to 2 seconds of arc.
const STAR_SD_RAD: f64 = 1e-5;

/// By what a star may be seen lower or higher than it should, for the weather, rad.
fn refraction_sd_rad(direction: &Unit<Vector3<f64>>) -> f64 {
    REFRACTION_SHARE * REFRACTION_RAD * direction.xy().norm() / direction.z.max(0.05)
}

/// How well the direction to a star is known, rad: low ones less, as the air bends their light.
pub fn star_sd_rad(direction: &Unit<Vector3<f64>>) -> f64 {
    STAR_SD_RAD.hypot(refraction_sd_rad(direction))
}

impl Prepared {
    /// Where a star is seen to stand (local ENU), refracted, of right ascension and declination of the catalogue
    /// (ICRS, rad) at the year of the picture.
    pub(crate) fn direction(&self, right_ascension: f64, declination: f64) -> Unit<Vector3<f64>> {
        let still = 0.0;
        let (intermediate_ra, intermediate_dec) =
            Atciq(right_ascension, declination, still, still, still, still, &self.astrom);
        let (azimuth, from_zenith, ..) = Atioq(intermediate_ra, intermediate_dec, &self.astrom);
        let (sin, cos) = azimuth.sin_cos();
        let (across, up) = from_zenith.sin_cos();
        Unit::new_normalize(Vector3::new(sin * across, cos * across, up))
    }
}

#[cfg(test)]
mod tests {
    #![allow(
        clippy::unwrap_used,
        clippy::type_complexity,
        reason = "a test that cannot set itself up has failed, and a table of cases is no type"
    )]

    use super::*;

    /// Betelgeuse, Polaris, Alpha Centauri and Sirius, as astropy 8.0 has them: `SkyCoord(ra, dec,
    /// frame="icrs").transform_to(AltAz(obstime, location, pressure=1013.25*exp(-h/8434), temperature=10 C,
    /// relative_humidity=0.5, obswl=0.6 um))`, with the Earth's turn and pole as they were measured. What is
    /// not known of these here is the 3 arc seconds.
    #[test]
    fn stars_stand_where_astropy_has_them() {
        // Place (degrees, m), time, star (ICRS), and what is expected, degrees.
        let cases: [([f64; 3], f64, [f64; 2], [f64; 2]); 4] = [
            ([47.4, 8.5, 450.0], 1_710_538_200.0, [88.792_939, 7.407_064], [248.550_65, 28.173_98]),
            (
                [47.4, 8.5, 450.0],
                1_710_538_200.0,
                [37.954_561, 89.264_109],
                [359.084_64, 47.304_49],
            ),
            (
                [-33.9, 151.2, 20.0],
                1_656_670_530.0,
                [219.902_066, -60.833_976],
                [184.459_18, 62.839_13],
            ),
            (
                [35.0, -106.0, 1800.0],
                1_736_481_600.0,
                [101.287_155, -16.716_116],
                [138.924_54, 27.151_25],
            ),
        ];
        for ([latitude, longitude, height], time_s, star, [azimuth, elevation]) in cases {
            let place = Geodetic::from_degrees(latitude, longitude, height).unwrap();
            let observer = Observer { place, time: Timestamp::from_seconds(time_s) };
            let [right_ascension, declination] = star.map(f64::to_radians);
            let seen = observer.prepare().unwrap().direction(right_ascension, declination);
            let (sin, cos) = azimuth.to_radians().sin_cos();
            let (up, across) = elevation.to_radians().sin_cos();
            let expected = Vector3::new(sin * across, cos * across, up);
            let off_arcsec = seen.angle(&expected).to_degrees() * 3600.0;
            assert!(off_arcsec < 3.0, "{star:?}: {off_arcsec} arc seconds");
        }
    }

    #[test]
    fn a_time_that_no_calendar_knows_is_refused() {
        let place = Geodetic::from_degrees(47.4, 8.5, 450.0).unwrap();
        let observer = Observer { place, time: Timestamp::from_seconds(-1e9) };
        assert!(matches!(observer.prepare().err(), Some(StarError::Time)));
    }
}
