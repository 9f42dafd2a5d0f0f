//! Industrial cameras that do what they do, on this machine alone.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

#[path = "gige/fake.rs"]
mod fake;

use std::net::Ipv4Addr;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crossfix_video::{
    Frame, GigeCamera, GigeOptions, Live, LiveEvent, Pixels, TimedBy, VideoError,
};

use self::fake::{Behaviour, Clock, Fake};

/// Columns, rows and images a second that are asked for.
const SIZE: [u32; 2] = [256, 200];
const RATE_HZ: f64 = 50.0;

/// Where the dot is at a time by the camera's clock, whole pixels.
fn place(seconds: f64) -> [f64; 2] {
    [(100.0 + 50.0 * seconds.cos()).trunc(), (100.0 + 50.0 * seconds.sin()).trunc()]
}

fn picture(seconds: f64, width: usize, height: usize) -> Vec<u8> {
    let mut pixels = vec![40; width * height];
    let [x, y] = place(seconds).map(|at| at as usize);
    for row in y - 3..=y + 3 {
        pixels[row * width + x - 3..][..7].fill(230);
    }
    pixels
}

/// The middle of the dot.
fn seen(frame: &Frame) -> [f64; 2] {
    let Pixels::Gray8(pixels) = &frame.pixels else { panic!("it is no brightness") };
    let bright = pixels.iter().enumerate().filter(|(_, pixel)| **pixel > 150).map(|(at, _)| at);
    let places: Vec<[usize; 2]> = bright.map(|at| [at % frame.width, at / frame.width]).collect();
    [0, 1].map(|axis| places.iter().map(|p| p[axis] as f64).sum::<f64>() / places.len() as f64)
}

/// A camera whose clock runs by itself, 300 millionths too fast.
fn own_clock() -> Behaviour {
    Behaviour {
        clock: Clock { begins: 5_000_000_000, ticks_hz: 125_000_000, fast_ppm: 300.0 },
        drops: Box::new(|_, _| false),
        picture: Box::new(picture),
        resends: false,
        follows: false,
        taken: false,
        describes: |right| right,
    }
}

fn watched(camera: &Fake) -> Live {
    let camera = GigeCamera::new(GigeOptions {
        address: camera.ip,
        size: Some(SIZE),
        rate_hz: Some(RATE_HZ),
        latency_s: None,
        sd_s: 1e-3,
        heeds_stamps: true,
    });
    Live::start(move |silence| camera.open(silence))
}

/// What comes within a time.
fn within(live: &Live, seconds: f64) -> (Vec<Frame>, Vec<VideoError>) {
    let (mut frames, mut troubles) = (Vec::new(), Vec::new());
    let until = Instant::now() + Duration::from_secs_f64(seconds);
    while Instant::now() < until {
        match live.next(until.saturating_duration_since(Instant::now())) {
            LiveEvent::Frame(frame) => frames.push(frame),
            LiveEvent::Trouble(trouble) => troubles.push(trouble),
            LiveEvent::Nothing => {}
        }
    }
    (frames, troubles)
}

/// Frames whose numbers are missing.
fn gaps(frames: &[Frame]) -> u64 {
    frames.windows(2).map(|pair| pair[1].index - pair[0].index - 1).sum()
}

fn address(last: u8) -> Ipv4Addr {
    Ipv4Addr::new(127, 77, 0, last)
}

fn wall_s() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64()
}

#[test]
fn a_camera_whose_clock_runs_by_itself_is_timed_by_what_it_answers() {
    let camera = Fake::start(address(1), own_clock());
    let begun_s = camera.begun.duration_since(UNIX_EPOCH).unwrap().as_secs_f64();
    let live = watched(&camera);
    let (frames, troubles) = within(&live, 6.0);
    assert!(troubles.is_empty(), "{troubles:?}");
    assert_eq!(gaps(&frames), live.counts().left_out);
    assert!(frames.len() > 200, "{}", frames.len());
    let mut errors_s = Vec::new();
    for frame in &frames {
        assert_eq!([frame.width, frame.height], SIZE.map(|side| side as usize));
        let live = frame.live.unwrap();
        assert_eq!(live.timed_by, TimedBy::Driver);
        assert_eq!(seen(frame), place(live.stream_s));
        // Its clock showed 40 s when it was begun.
        let true_s = begun_s + (live.stream_s - 40.0) / (1.0 + 300e-6);
        errors_s.push(frame.capture.time.seconds() - true_s);
    }
    // A busy machine holds answers up.
    errors_s.sort_unstable_by(f64::total_cmp);
    let ninety = &errors_s[errors_s.len() / 20..errors_s.len() * 19 / 20];
    assert!(ninety.iter().all(|error_s| (-1e-3..3e-3).contains(error_s)), "{errors_s:?}");
    assert!(errors_s[errors_s.len() / 2].abs() < 1e-3, "{errors_s:?}");
}

#[test]
fn a_camera_whose_clock_is_utc_is_believed() {
    let now_ns = (wall_s() * 1e9) as u64;
    let clock = Clock { begins: now_ns, ticks_hz: 1_000_000_000, fast_ppm: 0.0 };
    let behaviour = Behaviour { clock, follows: true, ..own_clock() };
    let camera = Fake::start(address(2), behaviour);
    let (frames, troubles) = within(&watched(&camera), 3.0);
    assert!(troubles.is_empty(), "{troubles:?}");
    assert!(frames.len() > 100, "{}", frames.len());
    for frame in frames {
        let live = frame.live.unwrap();
        assert_eq!(live.timed_by, TimedBy::Camera);
        assert_eq!(seen(&frame), place(live.stream_s));
        assert!((frame.capture.time.seconds() - live.stream_s).abs() < 1e-4);
    }
}

#[test]
fn packets_that_are_lost_are_asked_for_again_and_else_the_frame_is_missing() {
    let lossy = |resends| Behaviour {
        resends,
        drops: Box::new(|block, packet| block % 5 == 0 && packet == 7),
        ..own_clock()
    };
    let camera = Fake::start(address(3), lossy(true));
    let live = watched(&camera);
    let (frames, troubles) = within(&live, 3.0);
    assert!(troubles.is_empty(), "{troubles:?}");
    let counts = live.counts();
    assert_eq!(gaps(&frames), counts.left_out);
    let asked_again = counts.packets_recovered;
    assert!(asked_again >= frames.len() as u64 / 5 - 1 && counts.packets_lost == 0, "{counts:?}");
    drop((live, camera));

    let camera = Fake::start(address(3), lossy(false));
    let live = watched(&camera);
    let (frames, troubles) = within(&live, 3.0);
    assert!(troubles.iter().all(VideoError::is_one_frame), "{troubles:?}");
    let counts = live.counts();
    assert!(counts.packets_lost >= troubles.len() as u64, "{counts:?}");
    assert_eq!(counts.packets_recovered, 0);
    // Of five frames one is missing, and its number is.
    let last = frames.last().unwrap().index + 1;
    let missing = last - frames.len() as u64;
    assert!((missing as f64 / last as f64 - 0.2).abs() < 0.06, "{missing} of {last}");
    assert!(frames.iter().all(|frame| seen(frame) == place(frame.live.unwrap().stream_s)));
    assert!(troubles.len() as u64 + 2 >= missing, "{} of {missing} are told", troubles.len());
}

#[test]
fn a_camera_that_falls_silent_is_opened_anew_and_one_that_is_left_is_free() {
    let camera = Fake::start(address(4), own_clock());
    let live = watched(&camera);
    assert!(within(&live, 2.0).0.len() > 40);
    camera.mute.store(true, Ordering::SeqCst);
    let (frames, troubles) = within(&live, 5.0);
    assert!(frames.len() < 20, "{}", frames.len());
    assert!(matches!(troubles[0], VideoError::Silent { .. }), "{troubles:?}");
    assert!(troubles[1].to_string().contains("no GigE Vision camera answers"), "{troubles:?}");
    camera.mute.store(false, Ordering::SeqCst);
    let (frames, troubles) = within(&live, 6.0);
    assert!(frames.len() > 40, "{} {troubles:?}", frames.len());
    assert!(frames.iter().all(|frame| seen(frame) == place(frame.live.unwrap().stream_s)));
    drop(live);
    std::thread::sleep(Duration::from_millis(100));
    assert!(!camera.is_controlled() && !camera.is_acquiring());
}

#[test]
fn a_camera_that_somebody_else_controls_or_that_is_not_there_is_said() {
    let camera = Fake::start(address(5), Behaviour { taken: true, ..own_clock() });
    let first = |live: Live| match live.next(Duration::from_secs(10)) {
        LiveEvent::Trouble(trouble) => trouble.to_string(),
        other => panic!("{other:?}"),
    };
    let said = first(watched(&camera));
    assert!(said.contains("gige://127.77.0.5") && said.contains("ACCESS_DENIED"), "{said}");
    drop(camera);
    let nobody = GigeCamera::new(GigeOptions {
        address: address(6),
        size: None,
        rate_hz: None,
        latency_s: None,
        sd_s: 1e-3,
        heeds_stamps: true,
    });
    let said = first(Live::start(move |silence| nobody.open(silence)));
    assert!(said.contains("no GigE Vision camera answers there"), "{said}");
}

/// What comes first of a camera that describes itself wrongly: frames by what can be read of it, or
/// trouble.
fn first_of(last: u8, describes: fn(String) -> String) -> LiveEvent {
    let camera = Fake::start(address(last), Behaviour { describes, ..own_clock() });
    watched(&camera).next(Duration::from_secs(10))
}

#[test]
fn a_camera_whose_width_is_its_width_is_trouble() {
    let sight = first_of(7, |right| right.replace("<pValue>WidthReg<", "<pValue>Width<"));
    assert!(matches!(sight, LiveEvent::Trouble(_)), "{sight:?}");
}

#[test]
fn a_camera_whose_payload_is_a_sum_of_itself_is_survived() {
    let sight =
        first_of(8, |right| right.replace(">WidthReg</pVariable>", ">PayloadSize</pVariable>"));
    assert!(!matches!(sight, LiveEvent::Nothing), "{sight:?}");
}

#[test]
fn a_camera_whose_formula_has_brackets_without_end_is_survived() {
    let sight = first_of(9, |right| {
        right.replace("W*H", &format!("{}W*H{}", "(".repeat(100_000), ")".repeat(100_000)))
    });
    assert!(!matches!(sight, LiveEvent::Nothing), "{sight:?}");
}

#[test]
fn a_camera_that_describes_groups_within_groups_is_survived() {
    let sight = first_of(10, |right| {
        let group = "<Group Comment=\"a\">".repeat(50_000) + &"</Group>".repeat(50_000);
        right.replace("<Port ", &(group + "<Port "))
    });
    assert!(!matches!(sight, LiveEvent::Nothing), "{sight:?}");
}

#[test]
fn a_camera_whose_description_breaks_off_is_trouble() {
    let sight = first_of(11, |right| right[..right.len() / 2].to_owned());
    assert!(matches!(sight, LiveEvent::Trouble(_)), "{sight:?}");
}

/// What was wrong is said, and another program may have the camera at once.
#[test]
fn a_camera_that_cannot_be_set_up_is_given_back() {
    let describes = |right: String| right.replace("Mono8", "Mono12");
    let camera = Fake::start(address(13), Behaviour { describes, ..own_clock() });
    let live = watched(&camera);
    let LiveEvent::Trouble(trouble) = live.next(Duration::from_secs(10)) else {
        panic!("no trouble")
    };
    assert!(trouble.to_string().contains("Mono8"), "{trouble}");
    drop(live);
    let until = Instant::now() + Duration::from_secs(2);
    while camera.is_controlled() && Instant::now() < until {
        std::thread::sleep(Duration::from_millis(10));
    }
    assert!(!camera.is_controlled());
}

/// As deep as it may be: a thread has the stack for it.
#[test]
fn a_camera_whose_formula_and_references_are_deep_is_survived() {
    let sight = first_of(12, |right| {
        let deep = format!("{}W*H{}{}", "(".repeat(120), ")".repeat(120), "+1-1".repeat(249));
        let chain: String = (1..120)
            .map(|k| format!("<Integer Name=\"N{k}\"><pValue>N{}</pValue></Integer>", k + 1))
            .collect();
        let last = "<Integer Name=\"N120\"><pValue>WidthReg</pValue></Integer>";
        right
            .replace("W*H", &deep)
            .replace("<pValue>WidthReg<", "<pValue>N1<")
            .replace("<Port ", &format!("{chain}{last}<Port "))
    });
    assert!(matches!(sight, LiveEvent::Frame(_)), "{sight:?}");
}
