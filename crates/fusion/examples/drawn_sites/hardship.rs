//! What goes wrong at a hard site.

use std::fmt;

use nalgebra::Vector2;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::site::{DURATION_S, between, normal};

/// What goes wrong with a camera of a hard site beside all that.
pub struct Hardship {
    /// Standard deviation of its bearings, in units of the reported one.
    understated: f64,
    /// Share of their variance that lasts for a second.
    lasting: f64,
    /// It sees nothing from one of these times to the other, s after the beginning.
    hidden_s: [f64; 2],
    /// How far its clock is ahead beside what it says, s.
    pub clock_s: f64,
}

impl Hardship {
    /// Nothing goes wrong.
    pub const NONE: Self =
        Self { understated: 1.0, lasting: 0.0, hidden_s: [0.0; 2], clock_s: 0.0 };

    /// Whether the camera sees nothing at a time after the beginning, s.
    pub fn hides_at(&self, t: f64) -> bool {
        let [from, to] = self.hidden_s;
        (from..to).contains(&t)
    }

    /// Each of them befalls a third of the cameras, but for a clock, which one in twenty has.
    pub fn draw(random: &mut ChaCha8Rng) -> Self {
        let mut befalls = |share: f64| random.random::<f64>() < share;
        let [is_understated, lasts, is_hidden, is_ahead] =
            [0.33, 0.33, 0.33, 0.05].map(&mut befalls);
        let begins_s = random.random_range(0.0..DURATION_S);
        let hidden_s = [begins_s, begins_s + between(2.0, 20.0, random)];
        let understated = random.random_range(1.0..3.0);
        let clock_s = between(0.005, 0.2, random);
        Self {
            understated: if is_understated { understated } else { 1.0 },
            lasting: if lasts { 0.5 } else { 0.0 },
            hidden_s: if is_hidden { hidden_s } else { [0.0; 2] },
            clock_s: if is_ahead { clock_s } else { 0.0 },
        }
    }

    /// The error of a bearing whose camera reports a deviation of `sd_rad` per axis; `lasting` is
    /// the part that lasts, and was that of the target's bearing `interval_s` before, if there was
    /// one.
    pub fn noise(
        &self,
        sd_rad: f64,
        interval_s: f64,
        lasting: &mut Option<Vector2<f64>>,
        random: &mut ChaCha8Rng,
    ) -> Vector2<f64> {
        let mut noise = normal(random).xy() * sd_rad;
        if self.lasting > 0.0 {
            let kept = (-interval_s).exp();
            let drawn = normal(random).xy() * sd_rad;
            let goes_on =
                |before: Vector2<f64>| before * kept + drawn * (1.0 - kept.powi(2)).sqrt();
            let now = *lasting.insert(lasting.map_or(drawn, goes_on));
            noise = noise * (1.0 - self.lasting).sqrt() + now * self.lasting.sqrt();
        }
        noise * self.understated
    }
}

impl fmt::Display for Hardship {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { understated, lasting, hidden_s: [from, to], clock_s } = self;
        if *understated > 1.0 {
            write!(f, " understated {understated:.1} times")?;
        }
        if *lasting > 0.0 {
            write!(f, " lasting {lasting:.1}")?;
        }
        if to > from {
            write!(f, " hidden {from:.0} to {to:.0} s")?;
        }
        if *clock_s > 0.0 {
            write!(f, " clock {clock_s:.3} s ahead")?;
        }
        Ok(())
    }
}
