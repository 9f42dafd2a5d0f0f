//! A site whose messages go through a router that dies, or comes late.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::time::Duration;

use crossfix_message::{Channel, TrackFrame, TrackState, decode};
use crossfix_recording::Entry;
use crossfix_tests::{Process, Site, messages, now_seconds};

/// What is asked of every fault: all is as before this long after its cause has ended, s.
const RECOVERED_S: f64 = 5.0;

fn router(site: &Site) -> Process {
    site.start(&["router", "-c", &site.path("network.toml")])
}

/// The site, and when it has been recorded to its end.
fn ended(site: &Site, agents: Vec<Process>, parts: Vec<Process>) -> Vec<Entry> {
    for mut agent in agents {
        assert!(agent.wait(), "an agent ends well");
    }
    std::thread::sleep(Duration::from_secs(1));
    assert!(parts.into_iter().all(Process::stop));
    messages(site.path("live.mcap").as_ref(), |channel| *channel == Channel::Tracks)
}

/// When two confirmed tracks had been said since a time, by the wall's clock, s.
fn times_of_both(tracks: &[Entry], since: f64) -> Vec<f64> {
    let mut held = std::collections::BTreeMap::new();
    let mut times = Vec::new();
    for entry in tracks.iter().filter(|entry| entry.arrival.seconds() > since) {
        let frame: TrackFrame = decode(&entry.data).unwrap();
        for track in &frame.tracks {
            held.insert(track.id, track.state());
        }
        if held.values().filter(|state| **state == TrackState::Confirmed).count() == 2 {
            times.push(entry.arrival.seconds());
        }
    }
    times
}

#[test]
fn a_router_that_is_killed_and_started_again_costs_seconds_and_no_part() {
    let mut site = Site::new(36.0);
    site.route();
    let first = router(&site);
    let parts = vec![site.start_fusion(), site.start_recorder("live.mcap")];
    // Twice as fast as life.
    let begin = now_seconds() + 2.0;
    let agents = site.start_agents(begin, &[]);
    std::thread::sleep(Duration::from_secs_f64(begin + 6.0 - now_seconds()));
    first.crash();
    std::thread::sleep(Duration::from_secs(1));
    let second = router(&site);
    let again = now_seconds();
    let tracks = ended(&site, agents, parts);
    assert!(second.stop());
    let before = times_of_both(&tracks, 0.0);
    assert!(before.iter().any(|time| *time < again - 1.0), "there were tracks before");
    let recovered = times_of_both(&tracks, again).first().unwrap() - again;
    println!("both tracks again {recovered:.2} s after the router");
    assert!(recovered < RECOVERED_S, "{recovered} s");
}

#[test]
fn a_router_that_comes_last_is_waited_for() {
    let mut site = Site::new(8.0);
    site.route();
    let parts = vec![site.start_fusion(), site.start_recorder("live.mcap")];
    let begin = now_seconds() + 6.0;
    let agents = site.start_agents(begin, &[]);
    std::thread::sleep(Duration::from_secs(4));
    let router = router(&site);
    let times = times_of_both(&ended(&site, agents, parts), 0.0);
    assert!(router.stop());
    assert!(times.first().is_some_and(|first| first - begin < RECOVERED_S), "{:?}", times.first());
}
