use std::collections::BTreeSet;

use crossfix_fusion::Rejection;

/// Reports what was not used once for each source and reason; the counters have the rest.
#[derive(Debug, Default)]
pub struct RejectionLog {
    reported: BTreeSet<(String, &'static str)>,
}

impl RejectionLog {
    /// Logs the first rejection of its kind from its camera.
    pub fn report(&mut self, rejection: &Rejection) {
        // Bounded, as names come from outside.
        let kind = (rejection.camera.clone(), rejection.reason.counter());
        if self.reported.len() < 1000 && self.reported.insert(kind) {
            tracing::warn!("not used, and counted from now on: {rejection}");
        }
    }
}
