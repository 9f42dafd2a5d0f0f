use std::collections::BTreeMap;

use crossfix_message::{CameraName, Channel, Timestamp};

/// Current data time: the latest received capture time of each camera, and of the site. Not the
/// greatest, as one frame from the future must not shift all later messages. Some messages carry
/// the time from which they are valid instead of the time they were sent; in a recording they are
/// placed where they were sent.
#[derive(Debug, Default)]
pub struct DataTime {
    cameras: BTreeMap<CameraName, Timestamp>,
    site: Option<Timestamp>,
}

/// When a message was sent, in data time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Said {
    /// At this time.
    At(Timestamp),
    /// Before any data: the time is known once there are some.
    BeforeAnyData,
}

impl DataTime {
    /// When a message was sent that carries `time`.
    pub fn of(&mut self, channel: &Channel, time: Timestamp) -> Said {
        match channel {
            Channel::Calibration(camera) => {
                let newest = self.cameras.get(camera).copied().or(self.site);
                newest.map_or(Said::BeforeAnyData, |newest| Said::At(newest.max(time)))
            }
            Channel::CameraHealth(_) | Channel::FusionHealth | Channel::RecorderHealth
                if time == Timestamp::EPOCH =>
            {
                self.now()
            }
            Channel::Bearings(camera) => {
                self.cameras.insert(camera.clone(), time);
                self.site = Some(time);
                Said::At(time)
            }
            _ => Said::At(time),
        }
    }

    /// The site's current data time.
    pub fn now(&self) -> Said {
        self.site.map_or(Said::BeforeAnyData, Said::At)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_calibration_lies_where_it_was_said_and_health_without_a_time_too() {
        let mut times = DataTime::default();
        let north: CameraName = "north".parse().unwrap();
        let calibration = Channel::Calibration(north.clone());
        let at = |seconds: f64| Timestamp::from_seconds(seconds);
        assert_eq!(times.of(&calibration, at(5.0)), Said::BeforeAnyData);
        assert_eq!(times.of(&Channel::FusionHealth, Timestamp::EPOCH), Said::BeforeAnyData);
        assert_eq!(times.of(&Channel::Bearings(north), at(1000.0)), Said::At(at(1000.0)));
        assert_eq!(times.of(&calibration, at(5.0)), Said::At(at(1000.0)));
        assert_eq!(times.of(&calibration, at(1001.0)), Said::At(at(1001.0)));
        assert_eq!(times.of(&Channel::FusionHealth, Timestamp::EPOCH), Said::At(at(1000.0)));
        assert_eq!(times.of(&Channel::FusionHealth, at(999.0)), Said::At(at(999.0)));
    }
}
