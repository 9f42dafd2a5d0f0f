//! SAPIENT, as dstl's middleware accepts it.

use crossfix_message::{SiteName, Timestamp, TrackEvent, TrackEventKind, TrackState};
use prost::Message;
use sapient::sapient_message::Content;
use sapient_rs::bsi_flex_335_v2_0 as sapient;
use sha2::{Digest, Sha256};

use crate::text::state;
use crate::{Outlet, OutletRefusal, Snapshot, Target};

/// The interface's version, spelt as its validators require.
const VERSION: &str = "BSI Flex 335 v2.0";
/// Interval between the node's status reports, s of data time. The registration states it: with
/// twice as much it takes twice as long until a silent node is missed, with half of it reports are
/// twice as many.
const STATUS_PERIOD_S: f64 = 5.0;
/// Least time between two detections, s: dstl's middleware refuses one less than 0.08 s after the
/// last.
const DETECTION_PERIOD_S: f64 = 0.1;
/// Most bytes of a frame; a longer one is damage: dstl's middleware takes one megabyte. With half
/// of it long messages of the middleware would be refused.
const MOST_FRAME_BYTES: usize = 1 << 20;
/// Metres per degree of a great circle, to a third of a percent: used for standard deviations only.
const DEGREE_M: f64 = 111_320.0;

/// SAPIENT (BSI Flex 335 v2.0): the site is a fusion node that registers with a middleware or a
/// parent node, and reports its tracks as detections with a position on the Earth and a velocity.
///
/// Each message is a frame: its length in four bytes, little-endian, and the protobuf message. A
/// detection has no time of its own except that of its message, so all tracks are reported at one
/// time, at most ten times a second. Errors are one standard deviation per axis: of the position in
/// the units of its coordinates (degrees, degrees, metres), of the velocity in m/s; the
/// registration states this. Identifiers follow from the site, the track and the time, so that the
/// same data give the same bytes.
#[derive(Clone, Debug)]
pub struct Sapient {
    site: SiteName,
    node: String,
    /// Bytes received that are not a whole frame yet.
    inbox: Vec<u8>,
    is_registered: bool,
    status_at: Option<Timestamp>,
    said_at: Option<Timestamp>,
}

impl Sapient {
    /// An outlet of a site; its node has the same identity each time.
    pub fn of_site(site: SiteName) -> Self {
        let mut bytes = digest(&["crossfix-node", site.as_str()]);
        // Marked as a random UUID (RFC 9562), the only kind that is accepted.
        bytes[6] = bytes[6] & 0x0f | 0x40;
        bytes[8] = bytes[8] & 0x3f | 0x80;
        let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        let node = format!(
            "{}-{}-{}-{}-{}",
            &hex[..8],
            &hex[8..12],
            &hex[12..16],
            &hex[16..20],
            &hex[20..]
        );
        Self { site, node, inbox: Vec::new(), is_registered: false, status_at: None, said_at: None }
    }

    fn frame(&self, time: Timestamp, content: Content) -> Vec<u8> {
        /// A second, ns.
        const SECOND: i64 = 1_000_000_000;
        let message = sapient::SapientMessage {
            timestamp: Some(prost_types::Timestamp {
                seconds: time.nanos().div_euclid(SECOND),
                nanos: i32::try_from(time.nanos().rem_euclid(SECOND)).unwrap_or(0),
            }),
            node_id: Some(self.node.clone()),
            content: Some(content),
            ..Default::default()
        };
        let bytes = message.encode_to_vec();
        // Our messages have a few kilobytes, so the length always fits.
        let length = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
        [length.to_le_bytes().as_slice(), &bytes].concat()
    }

    fn status(&mut self, time: Timestamp, system: sapient::status_report::System) -> Vec<u8> {
        let is_first = self.status_at.replace(time).is_none();
        let info = if is_first {
            sapient::status_report::Info::New
        } else {
            sapient::status_report::Info::Unchanged
        };
        let report = sapient::StatusReport {
            report_id: Some(ulid(&self.node, "status", &time.nanos().to_string(), time)),
            system: Some(system.into()),
            info: Some(info.into()),
            mode: Some("Default".to_owned()),
            ..Default::default()
        };
        self.frame(time, Content::StatusReport(report))
    }

    fn detection(&self, time: Timestamp, target: &Target) -> Vec<u8> {
        let id = target.id.to_string();
        let stated = format!("{id} {}", time.nanos());
        let report = sapient::DetectionReport {
            report_id: Some(ulid(&self.node, "report", &stated, time)),
            object_id: Some(ulid(&self.node, "object", &id, born(target.id))),
            state: Some(state(target.state).to_owned()),
            id: Some(id),
            location_oneof: Some(sapient::detection_report::LocationOneof::Location(location(
                target,
            ))),
            velocity_oneof: Some(sapient::detection_report::VelocityOneof::EnuVelocity(velocity(
                target,
            ))),
            ..Default::default()
        };
        self.frame(time, Content::DetectionReport(report))
    }

    /// Takes the complete frames out of the inbox.
    fn whole_frames(&mut self) -> Result<Vec<Vec<u8>>, OutletRefusal> {
        let mut frames = Vec::new();
        while let Some((head, rest)) = self.inbox.split_first_chunk::<4>() {
            let length = u32::from_le_bytes(*head) as usize;
            if length > MOST_FRAME_BYTES {
                return Err(OutletRefusal::Malformed(format!("a message of {length} bytes")));
            }
            let Some(frame) = rest.get(..length) else { break };
            frames.push(frame.to_vec());
            self.inbox.drain(..4 + length);
        }
        Ok(frames)
    }
}

/// The first 16 bytes of the SHA-256 digest of several texts.
fn digest(texts: &[&str]) -> [u8; 16] {
    let hash = Sha256::digest(texts.join("\0"));
    std::array::from_fn(|k| hash[k])
}

/// An identifier as SAPIENT requires it (ULID): 48 bits of time, ms, and 80 bits of a digest of
/// what it identifies.
fn ulid(node: &str, kind: &str, of: &str, time: Timestamp) -> String {
    /// Crockford's base 32, in which ULIDs are written.
    const DIGITS: &[u8; 32] = b"0123456789ABCDEFGHJKMNPQRSTVWXYZ";
    let ms = u64::try_from(time.nanos() / 1_000_000).unwrap_or(0) & ((1 << 48) - 1);
    let hash = digest(&[node, kind, of]);
    let below = hash[..10].iter().fold(0_u128, |sum, byte| sum << 8 | u128::from(*byte));
    let value = u128::from(ms) << 80 | below;
    (0..26).rev().map(|k| DIGITS[(value >> (5 * k) & 31) as usize] as char).collect()
}

/// When the fusion centre's run began that assigned a track's identity.
fn born(track_id: u64) -> Timestamp {
    Timestamp::from_seconds((track_id >> 20) as f64)
}

fn location(target: &Target) -> sapient::Location {
    let (place, sd) = (&target.place, target.place_sd_m());
    // A degree of longitude is shorter by the cosine of the latitude.
    let parallel_m = DEGREE_M * place.latitude().cos().max(f64::EPSILON);
    sapient::Location {
        x: Some(place.longitude_deg()),
        y: Some(place.latitude_deg()),
        z: Some(place.height()),
        x_error: Some(sd.x / parallel_m),
        y_error: Some(sd.y / DEGREE_M),
        z_error: Some(sd.z),
        coordinate_system: Some(sapient::LocationCoordinateSystem::LatLngDegM.into()),
        datum: Some(sapient::LocationDatum::Wgs84E.into()),
        ..Default::default()
    }
}

/// Time since something was sent, s. If it never was, or time has gone back, it is due.
fn since(at: Option<Timestamp>, now: Timestamp) -> f64 {
    at.map(|at| now.seconds_since(at)).filter(|s| *s >= 0.0).unwrap_or(f64::INFINITY)
}

fn velocity(target: &Target) -> sapient::EnuVelocity {
    let sd = target.velocity_sd_mps();
    // dstl's test harness takes a rate of exactly zero as missing.
    let rate = |value: f64| Some(if value == 0.0 { f64::MIN_POSITIVE } else { value });
    sapient::EnuVelocity {
        east_rate: rate(target.velocity.x),
        north_rate: rate(target.velocity.y),
        up_rate: rate(target.velocity.z),
        east_rate_error: Some(sd.x),
        north_rate_error: Some(sd.y),
        up_rate_error: Some(sd.z),
    }
}

fn seconds(value: f32) -> sapient::registration::Duration {
    use sapient::registration as r;
    r::Duration { units: Some(r::TimeUnits::Seconds.into()), value: Some(value) }
}

/// Places in degrees and metres of WGS84.
fn degrees() -> sapient::registration::LocationType {
    use sapient::registration as r;
    r::LocationType {
        coordinates_oneof: Some(r::location_type::CoordinatesOneof::LocationUnits(
            sapient::LocationCoordinateSystem::LatLngDegM.into(),
        )),
        datum_oneof: Some(r::location_type::DatumOneof::LocationDatum(
            sapient::LocationDatum::Wgs84E.into(),
        )),
        ..Default::default()
    }
}

/// What is reported of a target.
fn detections() -> sapient::registration::DetectionDefinition {
    use sapient::registration as r;
    let metres_a_second = r::VelocityType {
        velocity_units_oneof: Some(r::velocity_type::VelocityUnitsOneof::EnuVelocityUnits(
            sapient::EnuVelocityUnits {
                east_north_rate_units: Some(sapient::SpeedUnits::Ms.into()),
                up_rate_units: Some(sapient::SpeedUnits::Ms.into()),
            },
        )),
        datum_oneof: Some(r::velocity_type::DatumOneof::LocationDatum(
            sapient::LocationDatum::Wgs84E.into(),
        )),
        ..Default::default()
    };
    r::DetectionDefinition {
        location_type: Some(degrees()),
        velocity_type: Some(metres_a_second),
        geometric_error: Some(r::GeometricError {
            r#type: Some("Standard Deviation".to_owned()),
            units: Some("Degrees, degrees, metres; m/s".to_owned()),
            variation_type: Some("Of each report".to_owned()),
            ..Default::default()
        }),
        ..Default::default()
    }
}

/// The one mode: it tracks all the time, and takes no tasks.
fn mode() -> sapient::registration::ModeDefinition {
    use sapient::registration as r;
    let region = r::RegionDefinition {
        region_type: vec![r::RegionType::AreaOfInterest.into()],
        region_area: vec![degrees()],
        ..Default::default()
    };
    r::ModeDefinition {
        mode_name: Some("Default".to_owned()),
        mode_type: Some(r::ModeType::Permanent.into()),
        settle_time: Some(seconds(1.0)),
        tracking_type: Some(r::TrackingType::Track.into()),
        detection_definition: vec![detections()],
        task: Some(r::TaskDefinition {
            concurrent_tasks: Some(0),
            region_definition: Some(region),
            ..Default::default()
        }),
        ..Default::default()
    }
}

fn node(kind: sapient::registration::NodeType) -> sapient::registration::NodeDefinition {
    sapient::registration::NodeDefinition { node_type: Some(kind.into()), ..Default::default() }
}

fn registration(site: &SiteName) -> sapient::Registration {
    use sapient::registration as r;
    sapient::Registration {
        node_definition: vec![node(r::NodeType::FusionNode), node(r::NodeType::Camera)],
        icd_version: Some(VERSION.to_owned()),
        name: Some(format!("Crossfix site {site}")),
        short_name: Some(site.to_string()),
        capabilities: vec![r::Capability {
            category: Some("Sensing".to_owned()),
            r#type: Some("Passive optical 3D tracking".to_owned()),
            ..Default::default()
        }],
        status_definition: Some(r::StatusDefinition {
            status_interval: Some(seconds(STATUS_PERIOD_S as f32)),
            location_definition: Some(degrees()),
            ..Default::default()
        }),
        mode_definition: vec![mode()],
        config_data: vec![r::ConfigurationData {
            manufacturer: "Crossfix".to_owned(),
            model: "Crossfix".to_owned(),
            software_version: Some(env!("CARGO_PKG_VERSION").to_owned()),
            ..Default::default()
        }],
        ..Default::default()
    }
}

impl Outlet for Sapient {
    fn greeting(&mut self, now: Timestamp) -> Vec<Vec<u8>> {
        (self.is_registered, self.status_at) = (false, None);
        self.inbox.clear();
        vec![self.frame(now, Content::Registration(registration(&self.site)))]
    }

    /// Takes in the answer to the registration. Tasks and other messages are ignored: they are for
    /// nodes that can be steered.
    fn heard(&mut self, bytes: &[u8]) -> Result<(), OutletRefusal> {
        self.inbox.extend(bytes);
        for frame in self.whole_frames()? {
            let message = sapient::SapientMessage::decode(frame.as_slice())
                .map_err(|error| OutletRefusal::Malformed(error.to_string()))?;
            if let Some(Content::RegistrationAck(answer)) = message.content {
                if answer.acceptance == Some(false) {
                    return Err(OutletRefusal::Registration(answer.ack_response_reason.join("; ")));
                }
                self.is_registered = true;
            }
        }
        Ok(())
    }

    fn is_ready(&self) -> bool {
        self.is_registered
    }

    fn tracks(&mut self, snapshot: &Snapshot) -> Vec<Vec<u8>> {
        let time = snapshot.time;
        let mut said = Vec::new();
        if since(self.status_at, time) >= STATUS_PERIOD_S {
            said.push(self.status(time, sapient::status_report::System::Ok));
        }
        if since(self.said_at, time) < DETECTION_PERIOD_S {
            return said;
        }
        self.said_at = Some(time);
        said.extend(snapshot.targets.iter().map(|target| self.detection(time, target)));
        said
    }

    fn event(&mut self, event: &TrackEvent) -> Vec<Vec<u8>> {
        let what = match event.kind() {
            TrackEventKind::Confirmed => "confirmed",
            TrackEventKind::Lost => state(TrackState::Lost),
            _ => return Vec::new(),
        };
        let (time, id) = (Timestamp::from_nanos(event.time_ns), event.track_id.to_string());
        let alert = sapient::Alert {
            alert_id: Some(ulid(&self.node, "alert", &format!("{id} {what}"), time)),
            alert_type: Some(sapient::alert::AlertType::Information.into()),
            status: Some(sapient::alert::AlertStatus::Active.into()),
            description: Some(format!(
                "track {} {what}",
                crossfix_message::TrackNumber(event.track_id)
            )),
            associated_detection: vec![sapient::AssociatedDetection {
                node_id: Some(self.node.clone()),
                object_id: Some(ulid(&self.node, "object", &id, born(event.track_id))),
                ..Default::default()
            }],
            ..Default::default()
        };
        vec![self.frame(time, Content::Alert(alert))]
    }

    fn farewell(&mut self, now: Timestamp) -> Vec<Vec<u8>> {
        if !self.is_registered {
            return Vec::new();
        }
        vec![self.status(now, sapient::status_report::System::Goodbye)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identifiers_are_of_their_forms_and_follow_from_what_they_are_of() {
        let node = Sapient::of_site("site".parse().unwrap()).node;
        assert_eq!(node, "308c4166-f236-4375-801d-dbef77049458");
        let time = Timestamp::from_nanos(1_795_696_496_789_000_000);
        let one = ulid(&node, "report", "7", time);
        assert!(one.starts_with("01M8BXM44N") && one.len() == 26, "{one}");
        assert_eq!(one, ulid(&node, "report", "7", time));
        assert_ne!(one, ulid(&node, "report", "8", time));
    }

    #[test]
    fn nothing_is_said_before_the_registration_was_taken() {
        let mut sapient = Sapient::of_site("site".parse().unwrap());
        assert_eq!(sapient.greeting(Timestamp::EPOCH).len(), 1);
        assert!(!sapient.is_ready());
        let ack = |acceptance| {
            let answer = sapient::RegistrationAck {
                acceptance: Some(acceptance),
                ack_response_reason: vec!["no".to_owned()],
            };
            Sapient::of_site("parent".parse().unwrap())
                .frame(Timestamp::EPOCH, Content::RegistrationAck(answer))
        };
        let yes = ack(true);
        // In two parts, as a stream may deliver it.
        sapient.heard(&yes[..7]).unwrap();
        assert!(!sapient.is_ready());
        sapient.heard(&yes[7..]).unwrap();
        assert!(sapient.is_ready());
        assert_eq!(sapient.heard(&ack(false)), Err(OutletRefusal::Registration("no".to_owned())));
        let endless = sapient.heard(&[0xff; 8]);
        assert!(matches!(endless, Err(OutletRefusal::Malformed(_))), "{endless:?}");
    }
}
