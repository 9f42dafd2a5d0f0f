use std::collections::BTreeSet;

use crossfix_fusion::{CameraReport, CameraStanding, Rejection};
use crossfix_message::{CameraHealth, CameraName};

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

/// Says that a camera is left out, or used again.
pub fn report_camera(camera: &CameraName, standing: CameraStanding) {
    if standing == CameraStanding::Excluded {
        tracing::warn!(
            "camera `{camera}` is left out: its bearings do not fit the tracks that the others hold; check its pose and its clock"
        );
    } else {
        tracing::info!("camera `{camera}` is used again: its bearings fit the tracks");
    }
}

/// A camera's report as it goes over the wire.
pub fn camera_health(report: &CameraReport) -> CameraHealth {
    let standing = match report.standing {
        CameraStanding::Good => crossfix_message::CameraStanding::Good,
        CameraStanding::Doubted => crossfix_message::CameraStanding::Doubted,
        CameraStanding::Excluded => crossfix_message::CameraStanding::Excluded,
    };
    let clock = report.clock;
    CameraHealth {
        camera: report.camera.to_string(),
        standing: standing.into(),
        noise_factor: report.noise_factor,
        clock_offset_s: clock.map_or(0.0, |c| c.offset_s),
        clock_offset_sd_s: clock.map_or(0.0, |c| c.sd_s),
        clock_relative_sd_s: clock.map_or(0.0, |c| c.relative_sd_s),
        clock_drift: clock.map_or(0.0, |c| c.drift),
        clock_drift_sd: clock.map_or(0.0, |c| c.drift_sd),
    }
}
