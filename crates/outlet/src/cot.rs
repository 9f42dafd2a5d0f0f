//! Cursor on Target, by MITRE's schema.

use crossfix_message::{Timestamp, TrackState};

use crate::target::{Motion, Target};
use crate::text::utc;
use crate::{Outlet, Snapshot};

/// Type of a target if none is configured: unknown, in the air. It says nothing more.
const UNKNOWN_IN_THE_AIR: &str = "a-u-A";
/// Time after its last event when a target is no longer valid, s. With half of it targets go stale
/// where a link stalls for five seconds; with twice as much, those of a fusion centre that is gone
/// stay on maps for 20 s.
const STALE_S: f64 = 10.0;
/// Decimals of a degree: a resolution of a centimetre. With one less a place moves in steps of a
/// decimetre.
const DEGREE_DIGITS: usize = 7;

/// Cursor on Target: one XML event per target (MITRE's event schema 2.0), for TAK's servers and
/// clients.
///
/// `ce` and `le` are the schema's "one sigma point": the standard deviation in the horizontal
/// direction in which it is largest, and that of the height above the ellipsoid. `how` says how
/// the position was obtained: `m-f` fused from several cameras, `m-i` measured in one camera's
/// images alone, `m-p` predicted while no camera sees the target.
#[derive(Clone, Debug)]
pub struct CursorOnTarget {
    kind: String,
}

impl Default for CursorOnTarget {
    fn default() -> Self {
        Self { kind: UNKNOWN_IN_THE_AIR.to_owned() }
    }
}

impl CursorOnTarget {
    /// An outlet with one type for all targets, for sites that know what flies: `a-u-A-M-H-Q` is a
    /// rotary drone of unknown allegiance. A type starts with `a-` and has letters, digits and
    /// dashes only; `None` for anything else.
    pub fn of_type(kind: &str) -> Option<Self> {
        let good = kind.chars().all(|c| c.is_ascii_alphanumeric() || c == '-');
        (good && kind.starts_with("a-")).then(|| Self { kind: kind.to_owned() })
    }

    fn event_of(&self, site: &str, time: Timestamp, target: &Target) -> String {
        let (how, stale) = match target.state {
            TrackState::OneCamera => ("m-i", STALE_S),
            TrackState::Coasting => ("m-p", STALE_S),
            TrackState::Lost => ("m-p", 1e-3),
            _ => ("m-f", STALE_S),
        };
        let (now, stale) = (utc(time), utc(time.plus_seconds(stale)));
        let number = target.number();
        format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\" standalone=\"yes\"?>\
             <event version=\"2.0\" uid=\"crossfix.{site}.{}\" type=\"{}\" how=\"{how}\" \
             time=\"{now}\" start=\"{now}\" stale=\"{stale}\">{}<detail><contact \
             callsign=\"XF-{number}\"/>{}<precisionlocation geopointsrc=\"CALC\" altsrc=\"CALC\"/>\
             <remarks>Crossfix track {number} of {site}: {}</remarks></detail></event>",
            target.id,
            self.kind,
            point(target),
            track(&target.motion()),
            crate::text::state(target.state),
        )
    }
}

/// The target's position with one standard deviation.
fn point(target: &Target) -> String {
    // The schema requires a value above zero.
    let sd = |value: f64| format!("{:.2}", value.max(0.01));
    format!(
        "<point lat=\"{:.DEGREE_DIGITS$}\" lon=\"{:.DEGREE_DIGITS$}\" hae=\"{:.2}\" ce=\"{}\" \
         le=\"{}\"/>",
        target.place.latitude_deg(),
        target.place.longitude_deg(),
        target.place.height(),
        sd(target.horizontal_sd_m()),
        sd(target.place_sd_m().z),
    )
}

fn track(motion: &Motion) -> String {
    let Motion { course_deg, speed_mps, slope_deg } = motion;
    // 359.996 is rounded to 360.00, which is north again.
    let course = format!("{:.2}", course_deg.value);
    let course = if course == "360.00" { "0.00" } else { &course };
    format!(
        "<track course=\"{course}\" speed=\"{:.2}\" slope=\"{:.2}\" eCourse=\"{:.2}\" \
         eSpeed=\"{:.2}\" eSlope=\"{:.2}\"/>",
        speed_mps.value, slope_deg.value, course_deg.sd, speed_mps.sd, slope_deg.sd
    )
}

impl Outlet for CursorOnTarget {
    fn tracks(&mut self, snapshot: &Snapshot) -> Vec<Vec<u8>> {
        let site = snapshot.site.as_str();
        let event = |target| self.event_of(site, snapshot.time, target).into_bytes();
        snapshot.targets.iter().map(event).collect()
    }
}
