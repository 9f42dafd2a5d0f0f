//! Reads any bytes as each message of the wire, and tells what can be read to everybody who is
//! told.
//!
//! The first byte says what the rest is: a message of a channel, or what a SAPIENT parent answers.

use crossfix_geometry::Geodetic;
use crossfix_message::{
    CameraCalibration, Channel, CueFrame, Health, Key, SiteName, Timestamp, TrackEvent, TrackFrame,
    TruthFrame, decode, glance,
};
use crossfix_outlet::foxglove::{FoxgloveView, PictureExport};
use crossfix_outlet::{
    Asterix, CursorOnTarget, GeoJsonFlights, GeoJsonLines, Kml, Outlet, Sapient, Situation,
};

fn channels() -> [Channel; 9] {
    let camera = || "north".parse().expect("a name");
    [
        Channel::Bearings(camera()),
        Channel::Calibration(camera()),
        Channel::Preview(camera()),
        Channel::CameraHealth(camera()),
        Channel::Tracks,
        Channel::Events,
        Channel::Cues,
        Channel::FusionHealth,
        Channel::Truth,
    ]
}

pub fn drive(data: &[u8]) {
    let Some((kind, data)) = data.split_first() else { return };
    let site = || "field".parse::<SiteName>().expect("a name");
    let channels = channels();
    let Some(channel) = channels.get(usize::from(*kind)) else {
        let mut sapient = Sapient::of_site(site());
        let _ = sapient.heard(data);
        let _ = sapient.heard(data);
        return;
    };
    let _ = glance(channel, data);
    let _ = (decode::<CueFrame>(data), decode::<Health>(data), decode::<TruthFrame>(data));
    let anchor = Geodetic::from_degrees(48.0, 11.0, 500.0).expect("a place");
    let mut view = FoxgloveView::new(&site(), Some(anchor), PictureExport::Said);
    let _ = view.of(&Key::new(site(), channel.clone()), data, Timestamp::EPOCH);
    let mut situation = Situation::new(site(), anchor);
    if let Ok(calibration) = decode::<CameraCalibration>(data) {
        let _ = calibration.parse();
        situation.add_calibration(&calibration);
    }
    if let Ok(frame) = decode::<TrackFrame>(data) {
        situation.add_tracks(None, &frame);
    }
    let mut outlets: [Box<dyn Outlet>; 6] = [
        Box::<CursorOnTarget>::default(),
        Box::new(Sapient::of_site(site())),
        Box::new(Asterix::of_source(1, 2)),
        Box::new(GeoJsonLines),
        Box::<GeoJsonFlights>::default(),
        Box::new(Kml::above_geoid(0.0)),
    ];
    let event = decode::<TrackEvent>(data).ok();
    while let Some(snapshot) = situation.snapshot(0.0) {
        for outlet in &mut outlets {
            outlet.greeting(snapshot.time);
            let said = outlet.tracks(&snapshot);
            let events = event.iter().flat_map(|event| outlet.event(event));
            for message in said.into_iter().chain(events).collect::<Vec<_>>() {
                assert!(!message.is_empty());
            }
            outlet.farewell(snapshot.time);
        }
        // What is lost is said once; then nothing is left.
        if snapshot.targets.iter().all(|target| target.state != crossfix_message::TrackState::Lost)
        {
            break;
        }
    }
}
