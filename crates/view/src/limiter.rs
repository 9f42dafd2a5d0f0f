use std::collections::BTreeMap;

use crossfix_message::Timestamp;

/// Rate limiter: lets each named thing through at most at a given rate, by data time.
#[derive(Debug, Default)]
pub(crate) struct Limiter {
    last: BTreeMap<String, Timestamp>,
}

impl Limiter {
    /// Whether `what` is due again.
    pub(crate) fn allows(&mut self, what: &str, now: Timestamp, rate_hz: f64) -> bool {
        let due = self.last.get(what).is_none_or(|last| {
            let since = now.seconds_since(*last);
            since * rate_hz >= 1.0 || since < 0.0
        });
        if due {
            self.last.insert(what.to_owned(), now);
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hundred_a_second_become_ten() {
        let mut limiter = Limiter::default();
        let passed = (0..200)
            .filter(|i| limiter.allows("x", Timestamp::from_nanos(i * 10_000_000), 10.0))
            .count();
        assert_eq!(passed, 20);
    }
}
