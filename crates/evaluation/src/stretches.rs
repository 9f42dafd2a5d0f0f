//! How long targets wait for an answer.

use std::collections::BTreeMap;

use crossfix_message::Timestamp;
use serde::Serialize;

/// Two instants of a target that are farther apart than this belong to different stretches, s. With
/// half of it each instant of a truth that is given once a second would be a stretch of its own.
const GAP_S: f64 = 1.0;
/// A stretch that is shorter than this and without an answer does not count, s. With half of it a
/// target that is asked for during half a second only would count as missed.
const LEAST_S: f64 = 1.0;

/// Times until a target was answered for, from the beginning of each stretch of instants at which
/// it was asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Delays {
    /// Time from a target's first instant to its first answer, the longest of all targets, s;
    /// absent if one was never answered for.
    pub first_s: Option<f64>,
    /// Number of stretches after a target's first one: it was not asked for during more than a
    /// second, and then again. Stretches of up to a second without an answer do not count.
    pub returns: u64,
    /// Median time from a return to the next answer, s; absent without a return, or if more than
    /// half got no answer.
    pub next_median_s: Option<f64>,
    /// The same time, within which nine of ten returns are answered, s.
    pub next_p90_s: Option<f64>,
    /// Number of stretches (of more than a second) without any answer.
    pub unanswered: u64,
}

#[derive(Clone, Copy, Debug)]
struct Stretch {
    from: Timestamp,
    to: Timestamp,
    answered: Option<Timestamp>,
}

impl Stretch {
    /// From its begin to its first answer, s.
    fn delay_s(&self) -> f64 {
        self.answered.map_or(f64::INFINITY, |answered| answered.seconds_since(self.from))
    }

    /// Whether it could have been answered.
    fn counts(&self) -> bool {
        self.answered.is_some() || self.to.seconds_since(self.from) > LEAST_S
    }
}

/// From the begin of a target's first stretch to the first answer in any of them, s.
fn first_delay_s(stretches: &[Stretch]) -> f64 {
    let begun = stretches.first().map(|stretch| stretch.from);
    let answered = stretches.iter().find_map(|stretch| stretch.answered);
    answered.zip(begun).map_or(f64::INFINITY, |(answered, begun)| answered.seconds_since(begun))
}

/// The stretches of all targets.
#[derive(Clone, Debug, Default)]
pub(crate) struct Stretches(BTreeMap<u64, Vec<Stretch>>);

impl Stretches {
    /// Adds an instant of a target, in order of time.
    pub(crate) fn add(&mut self, target: u64, time: Timestamp, answered: bool) {
        let stretches = self.0.entry(target).or_default();
        let goes_on = stretches.last().is_some_and(|last| time.seconds_since(last.to) <= GAP_S);
        if !goes_on {
            stretches.push(Stretch { from: time, to: time, answered: None });
        }
        if let Some(last) = stretches.last_mut() {
            last.to = time;
            if answered && last.answered.is_none() {
                last.answered = Some(time);
            }
        }
    }

    pub(crate) fn delays(&self) -> Delays {
        let first_s = self.0.values().map(|stretches| first_delay_s(stretches)).fold(0.0, f64::max);
        let returns = self.0.values().flat_map(|stretches| stretches.iter().skip(1));
        let mut nexts: Vec<f64> =
            returns.filter(|stretch| stretch.counts()).map(Stretch::delay_s).collect();
        nexts.sort_by(f64::total_cmp);
        let all = self.0.values().flatten().filter(|stretch| stretch.counts());
        Delays {
            first_s: (first_s.is_finite() && !self.0.is_empty()).then_some(first_s),
            returns: nexts.len() as u64,
            next_median_s: quantile(&nexts, 0.5),
            next_p90_s: quantile(&nexts, 0.9),
            unanswered: all.filter(|stretch| stretch.answered.is_none()).count() as u64,
        }
    }
}

/// A quantile of ascending values, rounded up to the next value; `None` if that is not finite.
pub(crate) fn quantile(sorted: &[f64], share: f64) -> Option<f64> {
    let place = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(place.saturating_sub(1)).copied().filter(|value| value.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_by_hand() {
        let mut stretches = Stretches::default();
        let at = |s: f64| Timestamp::EPOCH.plus_seconds(s);
        for (time, answered) in [(0.0, false), (0.5, false), (1.0, true), (1.5, true)] {
            stretches.add(7, at(time), answered);
        }
        // It returns after ten seconds, answered for at once; and once more, never answered for.
        stretches.add(7, at(11.5), true);
        for k in 0..4 {
            stretches.add(7, at(20.0 + 0.5 * f64::from(k)), false);
        }
        // Too short to count as missed.
        stretches.add(7, at(30.0), false);
        let delays = stretches.delays();
        assert_eq!(delays.first_s, Some(1.0));
        assert_eq!((delays.returns, delays.unanswered), (2, 1));
        assert_eq!((delays.next_median_s, delays.next_p90_s), (Some(0.0), None));
    }
}
