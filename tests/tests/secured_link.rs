//! A secured link loses nothing of what goes over it in both directions at once.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use crossfix_message::{CameraName, Channel};
use crossfix_tests::{PATIENCE, Site};
use crossfix_transport::{Delivery, Link, LinkPublisher, Role, Subscription};

/// Publishes numbered messages, one per millisecond.
fn count_aloud(publisher: &LinkPublisher, messages: u32) {
    for number in 0..messages {
        publisher.put(number.to_le_bytes().to_vec()).unwrap();
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Which of the numbers that were published did not come.
fn missing(heard: &Subscription, messages: u32) -> BTreeSet<u32> {
    let mut missing: BTreeSet<u32> = (0..messages).collect();
    while let Some(last) = missing.last().copied()
        && let Some(received) = heard.next(Duration::from_secs(5))
    {
        let number = u32::from_le_bytes(received.data.try_into().unwrap());
        assert!(missing.remove(&number), "{number} came twice, {last} not yet");
    }
    missing
}

#[test]
fn a_secured_link_is_not_broken_by_what_goes_both_ways() {
    /// Messages in each direction.
    const MESSAGES: u32 = 5000;
    let mut site = Site::new(1.0);
    site.route();
    site.enroll(&[]);
    let _router = site.start(&["router", "-c", &site.path("network.toml")]);
    let deadline = Instant::now() + PATIENCE;
    let open =
        |role| Link::open_while(site.network(), &role, |_| Instant::now() < deadline).unwrap();
    // The fusion centre's link to the router carries bearings in and tracks out.
    let east: CameraName = "east".parse().unwrap();
    let (fusion, agent, viewer) =
        (open(Role::Fusion(None)), open(Role::Camera(east.clone())), open(Role::Observer));
    for link in [&fusion, &agent, &viewer] {
        assert!(link.certificate().is_some(), "the link is secured");
    }
    let bearings = agent.publisher(Channel::Bearings(east.clone()), Delivery::Every).unwrap();
    let tracks = fusion.publisher(Channel::Tracks, Delivery::Every).unwrap();
    let in_bearings = fusion.subscribe(&[fusion.key(Channel::Bearings(east)).to_string()]).unwrap();
    let in_tracks = viewer.subscribe(&[viewer.key(Channel::Tracks).to_string()]).unwrap();
    for publisher in [&bearings, &tracks] {
        while !publisher.has_subscribers().unwrap() {
            assert!(Instant::now() < deadline, "nobody listens");
            std::thread::sleep(Duration::from_millis(5));
        }
    }
    std::thread::scope(|scope| {
        scope.spawn(|| count_aloud(&bearings, MESSAGES));
        scope.spawn(|| count_aloud(&tracks, MESSAGES));
    });
    assert_eq!(missing(&in_bearings, MESSAGES), BTreeSet::new(), "bearings");
    assert_eq!(missing(&in_tracks, MESSAGES), BTreeSet::new(), "tracks");
}
