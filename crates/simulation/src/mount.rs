//! A simulated mount that turns a camera: turning takes time, and its true angles differ slightly
//! from those that it reports.

use crossfix_geometry::{GeometryError, PanTilt, Pose, ScanAngles};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

/// Description of a mount that turns a camera of a scene. At rest the camera looks as the scene
/// says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneMount {
    /// Limits of the azimuth, to the left (least and most), degrees.
    pub azimuth_deg: [f64; 2],
    /// Limits of the elevation, upwards (least and most), degrees.
    pub elevation_deg: [f64; 2],
    /// Rate of turn about each axis, degrees per second.
    pub rate_deg_per_s: f64,
    /// Standard deviation of each angle's error, which is drawn again at each turn, mrad.
    #[serde(default)]
    pub angle_sd_mrad: f64,
}

impl SceneMount {
    /// The mount's geometry, from the camera's pose at rest.
    ///
    /// # Errors
    /// [`GeometryError::Reach`] where no mount turns so.
    pub fn pan_tilt(&self, rest: Pose) -> Result<PanTilt, GeometryError> {
        let radians = |degrees: [f64; 2]| degrees.map(f64::to_radians);
        PanTilt::new(rest, radians(self.azimuth_deg), radians(self.elevation_deg))
    }
}

/// True and reported angles of a mount at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MountState {
    /// The true angles.
    pub truth: ScanAngles,
    /// The reported angles.
    pub said: ScanAngles,
    /// Whether it stands still.
    pub settled: bool,
}

/// A mount in operation.
///
/// ```
/// use crossfix_geometry::ScanAngles;
/// use crossfix_simulation::{SceneMount, SimulatedMount};
///
/// let mount = SceneMount {
///     azimuth_deg: [-90.0, 90.0],
///     elevation_deg: [-10.0, 80.0],
///     rate_deg_per_s: 57.3,
///     angle_sd_mrad: 0.1,
/// };
/// let mut mount = SimulatedMount::new(&mount, 7);
/// mount.aim(1.0, ScanAngles { azimuth: 0.5, elevation: 0.1 });
/// assert!(!mount.at(1.2).settled);
/// let there = mount.at(1.6);
/// assert!(there.settled && (there.truth.azimuth - 0.5).abs() < 1e-3);
/// ```
#[derive(Clone, Debug)]
pub struct SimulatedMount {
    rate: f64,
    angle_sd: f64,
    noise: ChaCha8Rng,
    /// True less reported angles, to the left and upwards, rad.
    off: [f64; 2],
    from: ScanAngles,
    to: ScanAngles,
    began_s: f64,
}

impl SimulatedMount {
    /// A mount at rest, with random errors from a seed.
    pub fn new(mount: &SceneMount, seed: u64) -> Self {
        let rest = ScanAngles { azimuth: 0.0, elevation: 0.0 };
        let mut at_rest = Self {
            rate: mount.rate_deg_per_s.to_radians(),
            angle_sd: mount.angle_sd_mrad * 1e-3,
            noise: ChaCha8Rng::seed_from_u64(seed),
            off: [0.0; 2],
            from: rest,
            to: rest,
            began_s: f64::NEG_INFINITY,
        };
        at_rest.draw();
        at_rest
    }

    fn draw(&mut self) {
        self.off = self.off.map(|_| {
            let drawn: f64 = StandardNormal.sample(&mut self.noise);
            drawn * self.angle_sd
        });
    }

    /// Begins at time `t` (s) to turn towards the reported angles `to`, from where the mount is by
    /// then.
    pub fn aim(&mut self, t: f64, to: ScanAngles) {
        if to != self.to {
            (self.from, self.to, self.began_s) = (self.at(t).said, to, t);
            self.draw();
        }
    }

    /// State at a time (s), if no other order follows.
    pub fn at(&self, t: f64) -> MountState {
        let reach = (self.rate * (t - self.began_s)).max(0.0);
        // Each angle moves at the constant rate until it is there.
        let said = ScanAngles {
            azimuth: moved_towards(self.to.azimuth, self.from.azimuth, reach),
            elevation: moved_towards(self.to.elevation, self.from.elevation, reach),
        };
        let truth = ScanAngles {
            azimuth: said.azimuth + self.off[0],
            elevation: said.elevation + self.off[1],
        };
        MountState { truth, said, settled: said == self.to }
    }
}

/// An angle after a turn towards another by at most `reach`.
fn moved_towards(to: f64, from: f64, reach: f64) -> f64 {
    if (to - from).abs() <= reach { to } else { from + reach.copysign(to - from) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mount(angle_sd_mrad: f64) -> SimulatedMount {
        let mount = SceneMount {
            azimuth_deg: [-170.0, 170.0],
            elevation_deg: [-10.0, 80.0],
            rate_deg_per_s: 1f64.to_degrees(),
            angle_sd_mrad,
        };
        SimulatedMount::new(&mount, 3)
    }

    #[test]
    fn it_turns_at_its_rate_and_may_be_told_otherwise_on_the_way() {
        let mut mount = mount(0.0);
        mount.aim(10.0, ScanAngles { azimuth: 1.0, elevation: 0.2 });
        let half = mount.at(10.5);
        assert!(!half.settled && (half.said.azimuth - 0.5).abs() < 1e-12);
        assert!((half.said.elevation - 0.2).abs() < 1e-12);
        // Not a whole number of steps later, and settled all the same.
        assert!(mount.at(11.7).settled);
        mount.aim(10.5, ScanAngles { azimuth: 0.0, elevation: 0.2 });
        assert!(!mount.at(10.9).settled);
        assert_eq!(mount.at(11.1).truth.azimuth, 0.0);
        assert!(mount.at(11.1).settled);
    }

    #[test]
    fn what_it_is_off_by_is_the_same_until_it_turns_and_as_large_as_it_says() {
        let mut mount = mount(0.5);
        let mut squares = 0.0;
        for k in 0..500 {
            let t = f64::from(k) * 10.0;
            mount.aim(t, ScanAngles { azimuth: f64::from(k % 7) * 0.1, elevation: 0.1 });
            let off = |t: f64| mount.at(t).truth.azimuth - mount.at(t).said.azimuth;
            assert!((off(t + 5.0) - off(t + 9.0)).abs() < 1e-15);
            squares += off(t + 5.0).powi(2);
        }
        let sd = (squares / 500.0).sqrt();
        // The standard deviation of n draws has a relative error of 1 / sqrt(2 n).
        assert!((sd / 0.5e-3 - 1.0).abs() < 4.0 / 1000f64.sqrt(), "{sd}");
    }
}
