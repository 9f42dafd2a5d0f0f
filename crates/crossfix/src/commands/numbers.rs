//! Numbers on the command line: parsed, or refused with the permitted range.

/// Latest time accepted, seconds since the Unix epoch: the end of this century. The earliest is 0,
/// at which simulations begin. With half of it times after 2034 would be refused.
const LAST_WALL_TIME: f64 = 4_102_444_800.0;
/// Highest playing speed: a day takes a minute and a half. With half of it one of three minutes
/// would be the shortest.
const MOST_SPEED: f64 = 1000.0;

pub fn number(text: &str) -> Result<f64, String> {
    let number: f64 = text.trim().parse().map_err(|_| format!("`{text}` is no number"))?;
    if number.is_finite() { Ok(number) } else { Err(format!("`{text}` is not finite")) }
}

fn within(text: &str, least: f64, most: f64, unit: &str) -> Result<f64, String> {
    let number = number(text)?;
    if (least..=most).contains(&number) {
        Ok(number)
    } else {
        Err(format!("it must be from {least} to {most}{unit}"))
    }
}

pub fn positive(text: &str) -> Result<f64, String> {
    number(text)
        .and_then(|n| if n > 0.0 { Ok(n) } else { Err("it must be more than 0".to_owned()) })
}

pub fn not_negative(text: &str) -> Result<f64, String> {
    number(text)
        .and_then(|n| if n >= 0.0 { Ok(n) } else { Err("it must not be negative".to_owned()) })
}

/// Speed relative to real time; 0 is as fast as possible.
pub fn speed(text: &str) -> Result<f64, String> {
    within(text, 0.0, MOST_SPEED, "")
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
    let [latitude, longitude, height] = triple(text)?;
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
    let corner = |latitude, longitude| {
        crossfix_geometry::Geodetic::from_degrees(latitude, longitude, 0.0)
            .map_err(|error| error.to_string())
    };
    Ok([corner(south, west)?, corner(north, east)?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_out_of_range_is_refused_with_its_range() {
        assert!(positive("0").is_err() && not_negative("0").is_ok() && not_negative("-1").is_err());
        for bad in ["nan", "inf", "-1", "1e300", "fast"] {
            assert!(speed(bad).is_err() && wall_time(bad).is_err() && rate(bad).is_err(), "{bad}");
        }
        assert_eq!(speed("-1").unwrap_err(), "it must be from 0 to 1000");
        assert_eq!(speed("0"), Ok(0.0));
    }
}
