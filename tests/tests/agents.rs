//! Agents: how they begin, and how they end.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::path::Path;
use std::time::{Duration, Instant};

use crossfix_message::{BearingFrame, Channel, Health, Payload, decode};
use crossfix_tests::{PATIENCE, Process, Site, crossfix, messages};
use crossfix_transport::{Delivery, Link, Role};

fn agent(site: &Site, index: usize, options: &[&str]) -> Process {
    let file = site.path(&format!("{}.toml", site.world().cameras()[index].name()));
    site.start(&[&["agent", "-c", &file], options].concat())
}

/// What the fusion centre counted last, by its recording.
fn counted(site: &Site, recording: &str, name: &str) -> u64 {
    let health = messages(Path::new(&site.path(recording)), |c| *c == Channel::FusionHealth);
    let last: Health = decode(&health.last().unwrap().data).unwrap();
    last.counters.iter().find(|counter| counter.name == name).map_or(0, |counter| counter.value)
}

#[test]
fn agents_started_by_hand_one_after_the_other_play_in_step() {
    let site = Site::new(12.0);
    site.write("fusion.toml", "network = \"network.toml\"\n");
    let recorder = site.start_recorder("live.mcap");
    let fusion = site.start_fusion();
    let mut agents = Vec::new();
    for index in 0..3 {
        agents.push(agent(&site, index, &[]));
        std::thread::sleep(Duration::from_millis(1500));
    }
    assert!(agents.iter_mut().all(Process::wait));
    assert!(fusion.stop() && recorder.stop());
    let is_bearing = |channel: &Channel| matches!(channel, Channel::Bearings(_));
    let sent = messages(Path::new(&site.path("source.mcap")), is_bearing);
    let recorded = messages(Path::new(&site.path("live.mcap")), is_bearing);
    assert_eq!(recorded.len(), sent.len(), "each plays all that it has");
    assert_eq!(counted(&site, "live.mcap", "rejected_late"), 0);
}

#[test]
fn an_agent_that_comes_late_joins_those_that_play() {
    let site = Site::new(24.0);
    site.write("fusion.toml", "network = \"network.toml\"\n");
    let recorder = site.start_recorder("live.mcap");
    let fusion = site.start_fusion();
    // Twice as fast as life.
    let mut agents: Vec<Process> =
        (0..2).map(|index| agent(&site, index, &["--no-wait"])).collect();
    std::thread::sleep(Duration::from_secs(3));
    agents.push(agent(&site, 2, &[]));
    assert!(agents.iter_mut().all(Process::wait));
    assert!(fusion.stop() && recorder.stop());
    let late = site.world().cameras()[2].name().clone();
    let of_late = |file: &str| {
        messages(Path::new(&site.path(file)), |c| *c == Channel::Bearings(late.clone()))
    };
    let (sent, published) = (of_late("source.mcap"), of_late("live.mcap"));
    let share = published.len() as f64 / sent.len() as f64;
    assert!((0.3..0.9).contains(&share), "{} of {}", published.len(), sent.len());
    assert_eq!(published.last().unwrap().data, sent.last().unwrap().data);
    let late = counted(&site, "live.mcap", "rejected_late");
    assert!(late <= 3, "{late} frames came too late");
}

#[test]
fn an_agent_waits_for_nobody_but_the_recorder_when_the_fusion_centre_is_dead() {
    let site = Site::new(2.0);
    let recorder = site.start_recorder("live.mcap");
    let begun = Instant::now();
    let mut agents: Vec<Process> = (0..3).map(|index| agent(&site, index, &[])).collect();
    assert!(agents.iter_mut().all(Process::wait));
    assert!(begun.elapsed() < Duration::from_secs(30), "{:?}", begun.elapsed());
    assert!(recorder.stop());
    let is_bearing = |channel: &Channel| matches!(channel, Channel::Bearings(_));
    let sent = messages(Path::new(&site.path("source.mcap")), is_bearing).len();
    assert_eq!(messages(Path::new(&site.path("live.mcap")), is_bearing).len(), sent);
}

#[test]
fn an_agent_whose_video_breaks_ends_with_an_error() {
    let site = Site::new(2.0);
    let source = "kind = \"video\"\npath = \"north.y4m\"\nspeed = 0.0";
    site.write_camera("north", source, "");
    // Two frames, then something else.
    let size = site.world().camera("north").unwrap().camera().model().intrinsics().size;
    let mut bytes =
        format!("YUV4MPEG2 W{} H{} F25:1 Cmono\n", size.width, size.height).into_bytes();
    for _ in 0..2 {
        bytes.extend(b"FRAME\n");
        bytes.extend(vec![100_u8; (size.width * size.height) as usize]);
    }
    bytes.extend(b"NONSENSE\n");
    bytes.extend(vec![0_u8; 5000]);
    std::fs::write(site.path("north.y4m"), bytes).unwrap();
    let mut agent =
        site.start_logged(&["agent", "-c", &site.path("north.toml"), "--no-wait"], "agent.log");
    assert_eq!(agent.exit_code(), Some(1), "{}", site.text("agent.log"));
    assert!(
        site.text("agent.log").contains("camera `north` sees no more"),
        "{}",
        site.text("agent.log")
    );
    // A folder of nothing but bad pictures.
    std::fs::create_dir(site.path("pictures")).unwrap();
    std::fs::write(site.path("pictures/1.png"), "no picture").unwrap();
    site.write_camera("north", "kind = \"video\"\npath = \"pictures\"\nspeed = 0.0", "");
    let mut agent =
        site.start_logged(&["agent", "-c", &site.path("north.toml"), "--no-wait"], "agent.log");
    assert_eq!(agent.exit_code(), Some(1), "{}", site.text("agent.log"));
}

#[test]
fn an_agent_that_is_behind_its_source_says_so() {
    let site = Site::new(2.0);
    let recorder = site.start_recorder("live.mcap");
    std::thread::sleep(Duration::from_millis(500));
    // It should have begun five seconds ago.
    let begin = format!("{:.3}", crossfix_tests::now_seconds() - 5.0);
    let file = site.path("north.toml");
    let mut agent =
        site.start_logged(&["agent", "-c", &file, "--no-wait", "--start-at", &begin], "agent.log");
    assert!(agent.wait());
    assert!(recorder.stop());
    assert!(site.text("agent.log").contains("behind its source"), "{}", site.text("agent.log"));
}

#[test]
fn who_waits_says_for_whom_within_five_seconds() {
    let site = Site::new(2.0);
    let logged =
        |name: &str, arguments: &[&str]| (name.to_owned(), site.start_logged(arguments, name));
    let processes = [
        logged("fuse.log", &["fuse", "-c", &site.path("fusion.toml")]),
        logged(
            "record.log",
            &["record", "-c", &site.path("network.toml"), "-o", &site.path("a.mcap")],
        ),
        logged(
            "view.log",
            &["view", "-c", &site.path("network.toml"), "--save", &site.path("a.rrd")],
        ),
    ];
    for (log, _) in &processes {
        assert!(
            site.wait_for_line(log, "nobody of site", Duration::from_secs(6)),
            "{log}: {}",
            site.text(log)
        );
    }
    drop(processes);
    let agent = site.start_logged(&["agent", "-c", &site.path("north.toml")], "agent.log");
    assert!(site.wait_for_line("agent.log", "the fusion centre at tcp/", Duration::from_secs(5)));
    drop(agent);
}

#[test]
fn a_second_program_under_a_cameras_name_is_named_in_health() {
    let site = Site::new(2.0);
    let recorder = site.start_recorder("live.mcap");
    // The recorder hears two programs: one in the cameras' place, one in the fusion centre's.
    let one = Link::open(site.network(), &Role::Cameras { and_fusion: false }).unwrap();
    let two = Link::open(site.network(), &Role::Fusion(None)).unwrap();
    for link in [&one, &two] {
        link.wait_for(&[Channel::RecorderAlive], PATIENCE, || true).unwrap();
    }
    std::thread::sleep(Duration::from_millis(300));
    let name = site.world().cameras()[0].name().clone();
    let frame = BearingFrame { camera: name.to_string(), capture_time_ns: 1, ..Default::default() }
        .encode();
    let publish = |link: &Link| {
        let publisher = link.publisher(Channel::Bearings(name.clone()), Delivery::Queued).unwrap();
        (0..3).for_each(|_| publisher.put(frame.clone()).unwrap());
    };
    // One, then the other: a restart. Then the first again.
    for link in [&one, &two, &one] {
        publish(link);
        std::thread::sleep(Duration::from_millis(200));
    }
    std::thread::sleep(Duration::from_millis(1500));
    assert!(recorder.stop());
    let health = messages(Path::new(&site.path("live.mcap")), |c| *c == Channel::RecorderHealth);
    let problems: Vec<String> =
        health.iter().flat_map(|entry| decode::<Health>(&entry.data).unwrap().problems).collect();
    let [one, two] = [&one, &two].map(|link| link.run().to_string());
    let named = |problem: &String| {
        problem.contains(&format!("{name}/bearings"))
            && problem.contains(&one)
            && problem.contains(&two)
    };
    assert!(problems.iter().any(named), "{problems:?}");
}

#[test]
fn a_damaged_mp4_is_refused_with_a_way_to_mend_it() {
    let site = Site::new(2.0);
    site.write("a.mp4", "no video at all, and long enough to have a header");
    let output = crossfix(&["track", &site.path("a.mp4")]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("ffmpeg -i"), "{said}");
}
