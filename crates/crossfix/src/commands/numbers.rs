//! Numbers on the command line: parsed, or refused with the permitted range.

/// Latest time accepted, seconds since the Unix epoch: the end of this century. The earliest is 0,
/// at which simulations begin. With half of it times after 2034 would be refused.
const LAST_WALL_TIME: f64 = 4_102_444_800.0;
/// Lowest playing speed but 0: a minute takes an hour and a half. Half of it would do as well; one
/// of 1e-300 waits for ever.
const LEAST_SPEED: f64 = 0.01;
/// Highest playing speed: a day takes a minute and a half. With half of it one of three minutes
/// would be the shortest.
const MOST_SPEED: f64 = 1000.0;

fn number(text: &str) -> Result<f64, String> {
    let number: f64 = text.trim().parse().map_err(|_| format!("`{text}` is no number"))?;
    if number.is_finite() { Ok(number) } else { Err(format!("`{text}` is not finite")) }
}

pub fn within(text: &str, least: f64, most: f64, unit: &str) -> Result<f64, String> {
    let number = number(text)?;
    if (least..=most).contains(&number) {
        Ok(number)
    } else {
        Err(format!("it must be from {least} to {most}{unit}"))
    }
}

/// Speed relative to real time; 0 is as fast as possible.
pub fn speed(text: &str) -> Result<f64, String> {
    let number = number(text)?;
    if number == 0.0 || (LEAST_SPEED..=MOST_SPEED).contains(&number) {
        Ok(number)
    } else {
        Err(format!("it must be 0, or from {LEAST_SPEED} to {MOST_SPEED}"))
    }
}

/// A distance on a site, metres: at most 100 km, farther than any camera sees a drone.
pub fn distance(text: &str) -> Result<f64, String> {
    within(text, 0.01, 100_000.0, " m")
}

/// A standard deviation of places, metres: not 0, as nobody knows a place exactly.
pub fn sd_metres(text: &str) -> Result<f64, String> {
    within(text, 1e-4, 1000.0, " m")
}

/// A size or a standard deviation of places, metres; 0 is none.
pub fn metres_or_none(text: &str) -> Result<f64, String> {
    within(text, 0.0, 1000.0, " m")
}

/// A difference of heights, metres: the sea is within 110 m of the ellipsoid everywhere.
pub fn height_difference(text: &str) -> Result<f64, String> {
    within(text, -200.0, 200.0, " m")
}

/// A length or a standard deviation in an image, pixels: not 0, as no label is exact.
pub fn pixels(text: &str) -> Result<f64, String> {
    within(text, 0.01, 1000.0, " px")
}

/// A standard deviation of a rotation, degrees.
pub fn degrees(text: &str) -> Result<f64, String> {
    within(text, 0.0, 90.0, " degrees")
}

/// A speed or a standard deviation of velocities, metres per second.
pub fn metres_per_second(text: &str) -> Result<f64, String> {
    within(text, 0.0, 10_000.0, " m/s")
}

/// How long the demo's scene lasts, seconds: the first ones, until its tracks are sure, are left
/// out of what it evaluates.
pub fn demo_seconds(text: &str) -> Result<f64, String> {
    within(text, 5.0, 3600.0, " s")
}

/// How long states of a track wait for later bearings, seconds: as `tracking.smoothing_s` may.
pub fn lag(text: &str) -> Result<f64, String> {
    within(text, 0.001, 2.0, " s")
}

/// How long a file or a part of it lasts, minutes.
pub fn minutes(text: &str) -> Result<f64, String> {
    within(text, 0.01, 100_000.0, " minutes")
}

/// A time after the beginning of a recording, seconds: at most three years.
pub fn seconds(text: &str) -> Result<f64, String> {
    within(text, 0.0, 1e8, " s")
}

/// Size of a file, MB: a smaller one would hold a few messages.
pub fn megabytes(text: &str) -> Result<f64, String> {
    within(text, 0.1, 1e9, " MB")
}

/// What files may take together, GB: not 0, which would remove them all.
pub fn quota(text: &str) -> Result<f64, String> {
    within(text, 1e-9, 1e9, " GB")
}

/// How long a camera is watched, seconds: a moment to a day.
pub fn seconds_of_a_day(text: &str) -> Result<f64, String> {
    within(text, 0.1, 86_400.0, " s")
}

/// A time that a clock by hand may be off by, seconds.
pub fn seconds_by_hand(text: &str) -> Result<f64, String> {
    within(text, 0.0, 600.0, " s")
}

/// A standard deviation of simulated bearings, pixels.
pub fn noise_pixels(text: &str) -> Result<f64, String> {
    within(text, 0.01, 100.0, " px")
}

/// How many there are of something in the mean.
pub fn mean_count(text: &str) -> Result<f64, String> {
    within(text, 0.0, 10_000.0, "")
}

/// A probability.
pub fn probability(text: &str) -> Result<f64, String> {
    within(text, 0.0, 1.0, "")
}

/// A rate of turn, radians per second.
pub fn radians_per_second(text: &str) -> Result<f64, String> {
    within(text, 0.0, 100.0, " rad/s")
}

/// Space that is left free on a disk, GB.
pub fn gigabytes(text: &str) -> Result<f64, String> {
    within(text, 0.0, 1e9, " GB")
}

/// Seconds since the Unix epoch.
pub fn wall_time(text: &str) -> Result<f64, String> {
    within(text, 0.0, LAST_WALL_TIME, " s since the Unix epoch")
}

/// How often tracks are sent to other programs, per second.
#[cfg(feature = "centre")]
pub fn outlet_rate(text: &str) -> Result<f64, String> {
    within(text, 0.001, 100.0, " a second")
}

/// A time in seconds, at most an hour.
pub fn seconds_of_an_hour(text: &str) -> Result<f64, String> {
    within(text, 0.0, 3600.0, " s")
}

/// Frames per second.
pub fn rate(text: &str) -> Result<f64, String> {
    within(text, 0.001, 10_000.0, " frames a second")
}

/// `N` numbers with commas between them.
#[cfg(any(feature = "centre", feature = "viewer"))]
fn several<const N: usize>(text: &str, example: &str) -> Result<[f64; N], String> {
    let numbers = text.split(',').map(number).collect::<Result<Vec<f64>, String>>()?;
    numbers
        .try_into()
        .map_err(|_| format!("it must be {N} numbers with commas between them, e.g. {example}"))
}

#[cfg(any(feature = "centre", feature = "viewer"))]
pub fn triple(text: &str) -> Result<[f64; 3], String> {
    several(text, "-80,-80,10")
}

/// A position on the Earth: degrees of latitude and longitude, metres above the ellipsoid.
#[cfg(any(feature = "centre", feature = "viewer"))]
pub fn place(text: &str) -> Result<crossfix_geometry::Geodetic, String> {
    geodetic(triple(text)?)
}

#[cfg(any(feature = "centre", feature = "viewer"))]
fn geodetic(
    [latitude, longitude, height]: [f64; 3],
) -> Result<crossfix_geometry::Geodetic, String> {
    crossfix_geometry::Geodetic::from_degrees(latitude, longitude, height)
        .map_err(|error| error.to_string())
}

/// Edges of a picture of the ground: its south-western and north-eastern corners.
#[cfg(feature = "viewer")]
pub fn edges(text: &str) -> Result<[crossfix_geometry::Geodetic; 2], String> {
    let [south, west, north, east] = several(text, "48.352,11.783,48.356,11.789")?;
    if south >= north || west >= east {
        return Err("south must be below north, and west below east".to_owned());
    }
    Ok([geodetic([south, west, 0.0])?, geodetic([north, east, 0.0])?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_out_of_range_is_refused_with_its_range() {
        assert!(
            distance("0").is_err() && metres_or_none("0").is_ok() && metres_or_none("-1").is_err()
        );
        for bad in ["nan", "inf", "-1000", "1e300", "fast"] {
            let ranges =
                [speed, distance, metres_or_none, height_difference, pixels, degrees, lag, minutes];
            let more = [metres_per_second, seconds, megabytes, gigabytes, quota, wall_time, rate];
            assert!(ranges.iter().chain(&more).all(|range| range(bad).is_err()), "{bad}");
        }
        for bad in ["-1", "1e-300", "1001"] {
            assert_eq!(speed(bad).unwrap_err(), "it must be 0, or from 0.01 to 1000");
        }
        assert_eq!(speed("0"), Ok(0.0));
    }
}
