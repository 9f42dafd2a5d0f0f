//! The observer of the sky: place, time and air.

use crossfix_geometry::Geodetic;
use crossfix_message::Timestamp;
use erfars::Astrom;
use erfars::astrometry::{Apco13, Atciq, Atioq};
use nalgebra::{Matrix3, Unit, Vector3};

use crate::StarError;

/// Julian date of the Unix epoch: 1970-01-01, 0 h.
const UNIX_EPOCH_JD: f64 = 2_440_587.5;
/// Length of a day, s.
const DAY_S: f64 = 86_400.0;
/// Julian date of J2000.0, from which proper motions are counted.
const J2000_JD: f64 = 2_451_545.0;
/// Days of a Julian year, in which proper motions are counted.
const JULIAN_YEAR_D: f64 = 365.25;

/// Pressure at sea level in the standard atmosphere, hPa. With half of it refraction would be half
/// as large.
const SEA_LEVEL_HPA: f64 = 1013.25;
/// Height over which the pressure falls to 1/e in the standard atmosphere, m. With half of it
/// refraction at 1000 m would be 11 % too small.
const SCALE_HEIGHT_M: f64 = 8434.0;
/// Temperature of a cool night, degrees Celsius; ten degrees more reduce refraction by 3.5 %, five
/// less add 1.8 %.
const TEMPERATURE_C: f64 = 10.0;
/// Relative humidity. With half of it refraction changes by less than 1 %.
const HUMIDITY: f64 = 0.5;
/// Wavelength, micrometres: the middle of what cameras see. From there to the ends of that range
/// refraction changes by less than 1 %.
const WAVELENGTH_UM: f64 = 0.6;
/// Relative standard deviation of refraction, as the weather is not known: 15 degrees of
/// temperature and 20 hPa, each a standard deviation. With half of it low stars weigh up to four
/// times as much, and the weather tilts cameras by more than they state.
const REFRACTION_SHARE: f64 = 0.05;

/// Years in which UT1, by which the Earth turns, was within 0.3 s of UTC. The difference on a given
/// day is in no file here.
const QUIET_YEARS: std::ops::Range<f64> = 2017.0..2028.0;
/// Standard deviation of UT1 against UTC in these years, s. With half of it their bound is four
/// deviations, and cameras may be turned by more than they state.
const QUIET_EARTH_SD_S: f64 = 0.15;
/// The same in other years, s: UT1 is kept within 0.9 s of UTC. With half of it that bound is more
/// than four deviations.
const EARTH_SD_S: f64 = 0.4;
/// The Earth's rate against the stars, rad/s.
const EARTH_RATE: f64 = 7.292_115e-5;

/// Place and time from which the sky is observed.
#[derive(Clone, Copy, Debug)]
pub struct Observer {
    /// The site's origin, whose east, north and up axes directions are given in. For a camera a
    /// kilometre from it refraction differs by 0.01 mrad at most.
    pub place: Geodetic,
    /// UTC, the middle of the exposure.
    pub time: Timestamp,
}

/// Turn that all directions to stars may have in common: nothing in a picture determines it.
#[derive(Clone, Copy, Debug)]
pub struct Turn {
    /// Covariance about east, north and up, rad^2.
    pub covariance: Matrix3<f64>,
}

/// ERFA's parameters of the observer, which are the same for all stars.
pub(crate) struct Prepared {
    astrom: Astrom,
}

impl Observer {
    /// The year, with its fraction, for which proper motion is applied.
    pub(crate) fn julian_year(&self) -> f64 {
        2000.0 + (self.julian_date() - J2000_JD) / JULIAN_YEAR_D
    }

    fn julian_date(&self) -> f64 {
        UNIX_EPOCH_JD + self.time.seconds() / DAY_S
    }

    pub(crate) fn prepare(&self) -> Result<Prepared, StarError> {
        // Whole days are passed apart from the rest: a Julian date in one number resolves only 20
        // microseconds.
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

    /// Turn that the whole sky may have: about the Earth's axis, by the error of the picture's
    /// time, known to `time_sd_s`; and by the error of refraction in the direction of the stars'
    /// middle, about the horizontal axis across it.
    pub fn turn(&self, middle: &Unit<Vector3<f64>>, time_sd_s: f64) -> Turn {
        let (sin, cos) = self.place.latitude().sin_cos();
        let is_quiet = QUIET_YEARS.contains(&self.julian_year());
        let earth_sd_s = if is_quiet { QUIET_EARTH_SD_S } else { EARTH_SD_S };
        // A rotation about the pole (0, cos lat, sin lat) in ENU, by the Earth's rate times the
        // time's error.
        let pole = Vector3::new(0.0, cos, sin) * EARTH_RATE * time_sd_s.hypot(earth_sd_s);
        let across = Vector3::z().cross(middle).try_normalize(1e-9).unwrap_or_default();
        let tilt = across * refraction_sd_rad(middle);
        Turn { covariance: pole * pole.transpose() + tilt * tilt.transpose() }
    }
}

/// Refraction, rad, at a zenith distance whose tangent is one: it grows with that tangent; a minute
/// of arc.
const REFRACTION_RAD: f64 = 2.9e-4;
/// Standard deviation of a star's catalogued direction, rad. Catalogues are better than this;
/// double stars, and what has moved beside them, are good to 2 seconds of arc. With half of it the
/// same but for long lenses: of 1400 pixels' focal length it is 0.014 pixels.
const STAR_SD_RAD: f64 = 1e-5;

/// Standard deviation of a star's elevation due to the unknown weather, rad.
fn refraction_sd_rad(direction: &Unit<Vector3<f64>>) -> f64 {
    REFRACTION_SHARE * REFRACTION_RAD * direction.xy().norm() / direction.z.max(0.05)
}

/// Standard deviation of the direction to a star, rad: larger for low ones, as refraction is larger
/// there.
pub fn star_sd_rad(direction: &Unit<Vector3<f64>>) -> f64 {
    STAR_SD_RAD.hypot(refraction_sd_rad(direction))
}

impl Prepared {
    /// Apparent direction of a star (local ENU), refracted, for its right ascension and declination
    /// in the catalogue (ICRS, rad) at the year of the picture.
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
    /// frame="icrs").transform_to(AltAz(obstime, location, pressure=1013.25*exp(-h/8434),
    /// temperature=10 C, relative_humidity=0.5, obswl=0.6 um))`, with the Earth's rotation and pole
    /// as measured. These are not known here, which explains the 3 arc seconds.
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
