//! What each camera may see by itself: one object, or several of which lines are taken for one
//! target's.

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};

use super::sight::DirectionFilter;
use super::speeds::{BySpeed, SPEEDS, SpeedCase};

/// Most objects of one camera whose lines may be taken for one target's; the one that was seen
/// least lately goes. With half of it, lines of two objects by turns are no object's, and fit one
/// target better than any: 397 ghosts where there were 38 when it was tried (`tests/ghosts.rs`,
/// strangers before clocks of 30 ms).
const MAX_SIGHTS: usize = 3;

/// What each camera sees by itself.
#[derive(Clone, Debug, Default)]
pub(super) struct OwnSights {
    /// Each with its camera, the one that was seen last at the end.
    sights: Vec<(CameraName, BySpeed<DirectionFilter>)>,
}

/// An object that a line may continue.
#[derive(Clone, Copy, Debug)]
pub(super) struct Continued {
    /// Its place among the sights.
    place: usize,
    /// How many times the line's reported covariance counts.
    pub(super) factor: f64,
    /// Logarithm of the line's probability density, 1/sr.
    pub(super) log_density: f64,
}

impl OwnSights {
    /// Of one camera, which follows one object.
    pub(super) fn of_one(camera: &CameraName, sight: DirectionFilter) -> Self {
        Self { sights: vec![(camera.clone(), BySpeed::new([(sight, 0.0)]))] }
    }

    /// Whether a camera has given a line.
    pub(super) fn knows(&self, camera: &CameraName) -> bool {
        self.places(camera).next().is_some()
    }

    /// Whether a camera has given more than one line of an object: a first one may be clutter,
    /// whatever it fits.
    pub(super) fn follows(&self, camera: &CameraName) -> bool {
        let fastest = |place: usize| self.sights[place].1.fastest();
        self.places(camera).filter_map(fastest).any(|sight| !sight.is_first())
    }

    /// Adds a first line of an object, which may move across the line at up to `rate_sd` (rad/s,
    /// standard deviation).
    pub(super) fn begin(
        &mut self,
        camera: &CameraName,
        line: &SightLine,
        time: Timestamp,
        rate_sd: f64,
    ) {
        let oldest = self.places(camera).next();
        if let Some(oldest) = oldest.filter(|_| self.places(camera).count() == MAX_SIGHTS) {
            self.sights.remove(oldest);
        }
        let cases = SPEEDS.map(|SpeedCase { share, log_prior }| {
            (DirectionFilter::first(line, time, share * rate_sd), log_prior)
        });
        self.sights.push((camera.clone(), BySpeed::new(cases)));
    }

    /// The object of a camera that a line is likeliest to continue. They are predicted to its time;
    /// `density` is that of the white acceleration that drives their directions, rad^2/s^3, and the
    /// line's covariance counts at least `factor` times.
    pub(super) fn likeliest(
        &mut self,
        camera: &CameraName,
        line: &SightLine,
        time: Timestamp,
        density: f64,
        factor: f64,
    ) -> Option<Continued> {
        let own = self.sights.iter_mut().enumerate().filter(|(_, (name, _))| name == camera);
        let continued = own.map(|(place, (_, sight))| {
            sight.each(|sight| sight.predict(time, density));
            let factor = sight.fastest().map_or(1.0, DirectionFilter::factor).max(factor);
            let log_density = sight.log_density(|sight| sight.log_density(line, factor));
            Continued { place, factor, log_density: log_density.unwrap_or(f64::NEG_INFINITY) }
        });
        continued.max_by(|one, other| one.log_density.total_cmp(&other.log_density))
    }

    /// Continues an object with a line.
    pub(super) fn go_on(&mut self, Continued { place, factor, .. }: Continued, line: &SightLine) {
        let (camera, mut sight) = self.sights.remove(place);
        sight.see(|sight| sight.log_density(line, factor));
        sight.each(|sight| sight.update(line));
        self.sights.push((camera, sight));
    }

    /// The places of a camera's objects, the one that was seen last at the end.
    fn places(&self, camera: &CameraName) -> impl Iterator<Item = usize> {
        let named = self.sights.iter().enumerate().filter(move |(_, (name, _))| name == camera);
        named.map(|(place, _)| place)
    }
}
