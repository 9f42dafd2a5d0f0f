//! A site of two areas, each with a fusion centre of its own: a target that flies from the one into
//! the other is one target for whoever looks on.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a test that cannot set itself up has failed, and one that measures says what it found"
)]

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;

use crossfix_message::{AreaName, Channel, TrackFrame, TrackState, decode};
use crossfix_simulation::Scene;
use crossfix_tests::{Process, Site, messages, now_seconds, succeed};
use nalgebra::Point3;

/// How long the scene lasts, s: the target flies through both areas in this time.
const DURATION_S: f64 = 28.0;
/// The cameras of each area; the middle ones are in both.
const AREAS: [(&str, &[&str]); 2] =
    [("west", &["w1", "w2", "m1", "m2"]), ("east", &["e1", "e2", "m1", "m2"])];

/// Six cameras along a way, on both sides of it, and a target that flies down the way. Those in the
/// west see it for the first half, those in the east for the second, those in the middle between.
fn scene() -> Scene {
    let cameras: String = [("w", -130.0_f64, 0.0), ("m", 0.0, 0.017), ("e", 130.0, 0.033)]
        .iter()
        .flat_map(|(name, x, phase_s)| {
            [(1, -1.0), (2, 1.0)].map(|(number, side)| {
                format!(
                    "[[cameras]]\nname = \"{name}{number}\"\nposition_m = [{x:.1}, {:.1}, 2.0]\n\
                     look_at_m = [{x:.1}, 0.0, 45.0]\nsize_px = [640, 480]\nfocal_px = 340.0\n\
                     rate_hz = 15.0\nphase_s = {:.3}\nexposure_s = 0.004\nnoise_levels = 2.0\nblur_px = 0.6\n",
                    side * 110.0,
                    phase_s + 0.007 * f64::from(number),
                )
            })
        })
        .collect();
    let text = format!(
        "seed = 3\nduration_s = {DURATION_S}\n[[targets]]\nid = 1\nspan_m = 3.0\n[targets.path]\n\
         kind = \"straight\"\nfrom_m = [-190.0, -5.0, 45.0]\nvelocity_mps = [13.5, 0.4, 0.0]\n{cameras}"
    );
    toml::from_str(&text).unwrap()
}

/// What was said of a sure track: when in the data, by which area, under which number, and where.
struct Said {
    seconds: f64,
    area: AreaName,
    number: u64,
    place: Point3<f64>,
    sd_m: f64,
}

fn said(recording: &Path) -> Vec<Said> {
    let mut all = Vec::new();
    for entry in messages(recording, |channel| *channel == Channel::Tracks) {
        let frame: TrackFrame = decode(&entry.data).unwrap();
        for track in frame.tracks.iter().filter(|track| track.state() == TrackState::Confirmed) {
            let variances = [0, 7, 14].map(|axis| track.covariance[axis]);
            all.push(Said {
                seconds: entry.data_time.seconds(),
                area: entry.key.area.clone().unwrap(),
                number: track.id,
                place: track.position.unwrap().into(),
                sd_m: variances.iter().sum::<f64>().sqrt(),
            });
        }
    }
    all.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
    all
}

/// Plays the site and returns what was said in its time; `meanwhile` is told when the scene begins
/// by the wall's clock.
fn play(site: &Site, meanwhile: impl FnOnce(f64)) -> Vec<Said> {
    let recorder = site.start_recorder("live.mcap");
    let begin = now_seconds() + 3.0;
    let agents = site.start_agents(begin, &["--wait-for-recorder"]);
    meanwhile(begin);
    for mut agent in agents {
        assert!(agent.wait(), "an agent ends well");
    }
    std::thread::sleep(Duration::from_secs(1));
    assert!(recorder.stop());
    said(site.path("live.mcap").as_ref())
}

fn divided() -> Site {
    let mut site = Site::of(&scene());
    site.divide(&AREAS, "[event_time]\nlateness_s = 1.0\n");
    site
}

/// The longest time for which nothing sure was said, s.
fn longest_gap(said: &[Said]) -> f64 {
    said.windows(2).map(|two| two[1].seconds - two[0].seconds).fold(0.0, f64::max)
}

fn of_area<'a>(said: &'a [Said], area: &str) -> impl Iterator<Item = &'a Said> {
    said.iter().filter(move |one| one.area.as_str() == area)
}

#[test]
fn a_target_that_crosses_the_border_is_one_target_and_each_centre_shows_who_it_is() {
    let mut site = divided();
    site.enroll(&[]);
    let centres = ["west", "east"]
        .map(|area| site.start(&["fuse", "-c", &site.path(&format!("fusion-{area}.toml"))]));
    let mut parts = String::new();
    let said = play(&site, |begin| {
        std::thread::sleep(Duration::from_secs_f64(begin + 2.0 - now_seconds()));
        parts = succeed(&["status", "-c", &site.path("network.toml"), "--once"]);
    });
    for part in ["fusion-east", "fusion-west"] {
        let line = parts.lines().find(|line| line.starts_with(part));
        assert!(line.is_some_and(|line| line.contains("good")), "{parts}");
    }
    assert!(centres.into_iter().all(Process::stop));

    let numbers: BTreeSet<u64> = said.iter().map(|one| one.number).collect();
    let changes = said.windows(2).filter(|two| two[0].area != two[1].area).count();
    let truth = |seconds: f64| site.world().truth(seconds)[0].position;
    let (first, last) = (said.first().unwrap(), said.last().unwrap());
    println!(
        "said from {:.1} s to {:.1} s, by {} and then by {}, {changes} changes, longest gap {:.2} s",
        first.seconds,
        last.seconds,
        first.area,
        last.area,
        longest_gap(&said)
    );
    assert_eq!(numbers.len(), 1, "{numbers:?}");
    assert_eq!([first.area.as_str(), last.area.as_str()], ["west", "east"]);
    // From the first centre to the second; for what is on the way just then, both.
    assert!(changes < 8, "{changes}");
    assert!(longest_gap(&said) < 0.5, "{}", longest_gap(&said));
    assert!(first.seconds < 5.0 && last.seconds > DURATION_S - 3.0, "all the way");
    let beside = said.iter().filter(|one| (one.place - truth(one.seconds)).norm() > 3.0 * one.sd_m);
    let share = beside.count() as f64 / said.len() as f64;
    assert!(share < 0.02, "{share}");
}

#[test]
fn a_centre_that_dies_leaves_its_targets_to_the_one_beside() {
    let mut site = divided();
    // Here everything goes through a router.
    site.route();
    let router = site.start(&["router", "-c", &site.path("network.toml")]);
    let [west, east] = ["west", "east"]
        .map(|area| site.start(&["fuse", "-c", &site.path(&format!("fusion-{area}.toml"))]));
    // In the middle of the way, where the cameras of the middle see it: both centres have it.
    let dies_at_s = 14.0;
    let said = play(&site, |begin| {
        std::thread::sleep(Duration::from_secs_f64(begin + dies_at_s / 2.0 - now_seconds()));
        west.crash();
    });
    assert!(east.stop() && router.stop());
    let numbers: BTreeSet<u64> = said.iter().map(|one| one.number).collect();
    let last_of_west = of_area(&said, "west").map(|one| one.seconds).fold(0.0, f64::max);
    let next = of_area(&said, "east").map(|one| one.seconds).find(|at| *at > last_of_west);
    println!("west is heard to {last_of_west:.2} s, east goes on at {next:?} s");
    assert_eq!(numbers.len(), 1, "{numbers:?}");
    assert!(last_of_west > 10.0, "it was west's: {last_of_west}");
    assert!(next.is_some_and(|next| next - last_of_west < 2.0), "{next:?}");
}
