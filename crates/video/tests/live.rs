//! Network cameras that do what cameras do, on this machine alone.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crossfix_message::Timestamp;
use crossfix_video::{
    CaptureTime, Frame, FrameSource, H264Encoder, Live, LiveEvent, Login, Pixels, RtspCamera,
    RtspOptions, RtspServer, RtspTransport, ServedStream, StreamAddress, StreamLatency, TimedBy,
    VideoError,
};

const WIDTH: usize = 320;
const HEIGHT: usize = 240;
const RATE_HZ: f64 = 30.0;

fn now() -> Timestamp {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    Timestamp::from_nanos(now.as_nanos() as i64)
}

/// A picture whose bright square says which it is.
fn picture(number: u64, width: usize, height: usize) -> Vec<u8> {
    let (x, y) = (8 + number as usize % 32 * 9, 8 + number as usize / 32 % 20 * 11);
    let bright = |at: usize| {
        let (column, row) = (at % width, at / width);
        (x..x + 8).contains(&column) && (y..y + 8).contains(&row)
    };
    (0..width * height).map(|at| if bright(at) { 230 } else { 40 }).collect()
}

/// The number that a picture shows, modulo 640.
fn shown(frame: &Frame) -> u64 {
    let Pixels::Gray8(samples) = &frame.pixels else { panic!("it is no brightness") };
    let lit = samples.iter().enumerate().filter(|(_, s)| **s > 130).map(|(at, _)| at);
    let places: Vec<(usize, usize)> = lit.map(|at| (at % frame.width, at / frame.width)).collect();
    let mean = |of: fn(&(usize, usize)) -> usize| {
        places.iter().map(of).sum::<usize>() as f64 / places.len() as f64
    };
    let [x, y] = [mean(|p| p.0) - 3.5, mean(|p| p.1) - 3.5];
    ((y - 8.0) / 11.0).round() as u64 * 32 + ((x - 8.0) / 9.0).round() as u64
}

/// A camera that runs on a thread of its own until it is dropped. What it does beyond playing
/// pictures, `each` does before every frame, which it is told with the time of its capture; if that
/// says no, the frame is not sent.
struct Camera {
    begun: Timestamp,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    server: RtspServer,
}

impl Camera {
    fn start(
        login: Option<Login>,
        rate_hz: f64,
        mut each: impl FnMut(&ServedStream, u64, Timestamp) -> bool + Send + 'static,
    ) -> Self {
        let mut server = RtspServer::bind("127.0.0.1:0".parse().unwrap(), login).unwrap();
        let mount = server.mount("north");
        let (begun, start, stop) = (now(), Instant::now(), Arc::new(AtomicBool::new(false)));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            let mut encoder = H264Encoder::new(rate_hz).unwrap();
            for number in 0.. {
                let due = start + Duration::from_secs_f64(number as f64 / rate_hz);
                std::thread::sleep(due.saturating_duration_since(Instant::now()));
                if stopped.load(Ordering::Relaxed) {
                    return;
                }
                let unit = encoder.encode(&picture(number, WIDTH, HEIGHT), WIDTH, HEIGHT).unwrap();
                let captured = begun.plus_seconds(number as f64 / rate_hz);
                if each(&mount, number, captured) {
                    mount.send(&unit, ticks(number, rate_hz));
                }
            }
        });
        Self { begun, stop, thread: Some(thread), server }
    }

    /// One that says every half second what its clock shows, the first time after a second.
    fn with_clock(ahead_s: f64) -> Self {
        Self::start(None, RATE_HZ, move |mount, number, captured| {
            if number >= 30 && number % 15 == 0 {
                mount.report(captured.plus_seconds(ahead_s), ticks(number, RATE_HZ));
            }
            true
        })
    }

    fn options(&self, path: &str) -> RtspOptions {
        let url = format!("rtsp://{}/{path}", self.server.address());
        RtspOptions {
            address: StreamAddress::parse(&url).unwrap().0,
            login: None,
            transport: RtspTransport::Tcp,
            heeds_reports: true,
            latency: StreamLatency::default(),
        }
    }

    fn watched(&self) -> Live {
        watched(self.options("north"))
    }

    /// When the frame with a number was captured.
    fn captured(&self, number: u64) -> Timestamp {
        self.begun.plus_seconds(number as f64 / RATE_HZ)
    }
}

impl Drop for Camera {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let ended = self.thread.take().unwrap().join();
        assert!(ended.is_ok() || std::thread::panicking(), "the camera has failed");
    }
}

fn ticks(number: u64, rate_hz: f64) -> u32 {
    // A count that turns over in the first second.
    ((number as f64 / rate_hz * 90_000.0).round() as u32).wrapping_sub(45_000)
}

fn watched(options: RtspOptions) -> Live {
    let camera = RtspCamera::new(options);
    Live::start(move |silence| Ok(Box::new(camera.open(silence)?)))
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

/// A frame of one pixel.
fn a_frame(index: u64) -> Frame {
    Frame {
        index,
        capture: CaptureTime { time: Timestamp::EPOCH, sd_s: 0.0 },
        live: None,
        width: 1,
        height: 1,
        pixels: Pixels::Gray8(vec![0]),
    }
}

/// What is said first when a camera is opened.
fn refused(options: RtspOptions) -> String {
    match watched(options).next(Duration::from_secs(10)) {
        LiveEvent::Trouble(trouble) => trouble.to_string(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn every_frame_comes_once_and_at_its_time() {
    let camera = Camera::with_clock(0.0);
    let live = camera.watched();
    let (frames, troubles) = within(&live, 4.0);
    assert!(troubles.is_empty(), "{troubles:?}");
    assert!(frames.len() > 80, "{}", frames.len());
    let numbers: Vec<u64> = frames.iter().map(shown).collect();
    assert!(numbers.windows(2).all(|n| n[1] == n[0] + 1), "{numbers:?}");
    assert!(frames.iter().zip(0..).all(|(frame, index)| frame.index == index));
    let by = |frame: &Frame| frame.live.unwrap().timed_by;
    let (by_arrival, by_camera): (Vec<&Frame>, Vec<&Frame>) =
        frames.iter().partition(|frame| by(frame) == TimedBy::Arrival);
    assert!(by_arrival.len() > 5 && by_camera.len() > 50, "{}", by_arrival.len());
    let error_s = |frame: &Frame| frame.capture.time.seconds_since(camera.captured(shown(frame)));
    // Nothing takes 100 ms here, or one in two does on a busy machine.
    let mut errors_s: Vec<f64> = by_arrival.into_iter().map(error_s).collect();
    errors_s.sort_unstable_by(f64::total_cmp);
    assert!((-0.101..0.0).contains(&errors_s[errors_s.len() / 2]), "{errors_s:?}");
    for frame in by_camera {
        assert!(error_s(frame).abs() < 1e-4, "{}", error_s(frame));
    }
}

#[test]
fn a_camera_of_another_time_is_timed_by_arrival_and_it_is_said_how_far_off_it_is() {
    let camera = Camera::with_clock(3600.0);
    let live = camera.watched();
    let (frames, _) = within(&live, 2.5);
    let last = frames.last().unwrap();
    let TimedBy::ArrivalAgainstCamera { camera_ahead_s } = last.live.unwrap().timed_by else {
        panic!("{:?}", last.live)
    };
    assert!((camera_ahead_s - 3600.0).abs() < 0.1, "{camera_ahead_s}");
    let error_s = last.capture.time.seconds_since(camera.captured(shown(last)));
    assert!((-0.101..0.0).contains(&error_s), "{error_s}");
}

#[test]
fn who_is_refused_is_told_why() {
    let camera = Camera::start(Some(Login::new("eye", "secret")), RATE_HZ, |_, _, _| true);
    let wrong =
        RtspOptions { login: Some(Login::new("eye", "hunter2")), ..camera.options("north") };
    let said = refused(wrong);
    assert!(said.contains("user or password are wrong") && !said.contains("hunter2"), "{said}");
    assert!(refused(camera.options("north")).contains("password"));
    let login = Some(Login::new("eye", "secret"));
    let nowhere = RtspOptions { login: login.clone(), ..camera.options("south") };
    assert!(refused(nowhere).contains("no stream at this path"));
    let udp = RtspOptions {
        login: login.clone(),
        transport: RtspTransport::Udp,
        ..camera.options("north")
    };
    assert!(refused(udp).contains("try the other `transport`"));
    let welcome = RtspOptions { login, ..camera.options("north") };
    assert!(!within(&watched(welcome), 1.5).0.is_empty());
    let nobody = {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("rtsp://{}/north", listener.local_addr().unwrap());
        RtspOptions { address: StreamAddress::parse(&url).unwrap().0, ..camera.options("north") }
    };
    let said = refused(nobody);
    assert!(said.contains("Connection refused"), "{said}");
}

#[test]
fn a_camera_that_falls_silent_or_hangs_up_is_opened_anew() {
    for silent in [true, false] {
        let camera = Camera::start(None, RATE_HZ, move |mount, number, _| {
            if !silent && number == 45 {
                mount.hang_up();
            }
            // Its connection stays, nothing comes for three seconds.
            !(silent && (45..135).contains(&number))
        });
        let live = camera.watched();
        let (frames, troubles) = within(&live, 7.0);
        let said: Vec<String> = troubles.iter().map(ToString::to_string).collect();
        assert_eq!(said.len(), 1, "{said:?}");
        assert!(said[0].contains(if silent { "no frame for 2.0 s" } else { "ended" }), "{said:?}");
        assert_eq!(live.counts().opened, 2);
        let gap = frames.windows(2).find(|f| f[1].index != f[0].index + 1).unwrap();
        assert_eq!(gap[1].index, gap[0].index + 2, "the gap is seen");
        let missed_s = (shown(&gap[1]) - shown(&gap[0])) as f64 / RATE_HZ;
        // The pause before it is opened, and up to a second to a picture that builds on none.
        let most_s = if silent { 3.0 + 1.2 } else { 0.5 + 1.2 };
        assert!(missed_s < most_s, "{missed_s}");
        assert!(shown(frames.last().unwrap()) > 150);
    }
}

#[test]
fn a_camera_that_sends_a_frame_in_ten_seconds_is_watched_all_the_same() {
    let camera = Camera::start(None, 0.1, |_, _, _| true);
    let live = camera.watched();
    // How slow it is, is found out in the first twenty.
    let (frames, troubles) = within(&live, 55.0);
    assert!(frames.len() >= 3, "{}: {troubles:?}", frames.len());
    let late = frames.last().unwrap().live.unwrap().at;
    assert!(late.elapsed() < Duration::from_secs(11));
}

#[test]
fn a_camera_of_eight_million_pixels_is_seen_whole_and_in_time() {
    const SIZE: [usize; 2] = [3840, 2160];
    let mut encoder = H264Encoder::new(2.0).unwrap();
    let camera = Camera::start(None, 2.0, move |mount, number, _| {
        let unit = encoder.encode(&picture(number, SIZE[0], SIZE[1]), SIZE[0], SIZE[1]).unwrap();
        mount.send(&unit, ticks(number, 2.0));
        false
    });
    let (frames, troubles) = within(&camera.watched(), 8.0);
    assert!(troubles.is_empty(), "{troubles:?}");
    assert!(frames.len() >= 8, "{}", frames.len());
    for pair in frames.windows(2) {
        assert_eq!([pair[1].width, pair[1].height], SIZE);
        assert_eq!(shown(&pair[1]), shown(&pair[0]) + 1);
    }
}

#[test]
fn what_cannot_be_decoded_is_counted_and_the_rest_is_seen() {
    let camera = Camera::start(None, RATE_HZ, |mount, number, _| {
        if number == 40 {
            let noise = |n: u32| (n.wrapping_mul(2_654_435_761) >> 13) as u8 | 2;
            let noise: Vec<u8> = (0..5000).map(noise).collect();
            mount.send(&[&[0, 0, 0, 1, 0x41][..], &noise].concat(), ticks(number, RATE_HZ));
        }
        number != 40
    });
    let (frames, troubles) = within(&camera.watched(), 3.5);
    assert!(troubles.iter().all(VideoError::is_one_frame), "{troubles:?}");
    assert!(!troubles.is_empty());
    assert!(shown(frames.last().unwrap()) > 80);
}

#[test]
fn another_resolution_in_mid_stream_is_seen_as_it_is() {
    let mut encoder = H264Encoder::new(RATE_HZ).unwrap();
    let camera = Camera::start(None, RATE_HZ, move |mount, number, _| {
        if number >= 45 {
            let unit = encoder.encode(&picture(number, 640, 480), 640, 480).unwrap();
            mount.send(&unit, ticks(number, RATE_HZ));
        }
        number < 45
    });
    let (frames, troubles) = within(&camera.watched(), 3.0);
    assert!(troubles.is_empty(), "{troubles:?}");
    let sizes: Vec<usize> = frames.iter().map(|frame| frame.width).collect();
    assert_eq!((sizes[0], *sizes.last().unwrap()), (320, 640));
    assert!(shown(frames.last().unwrap()) > 70);
}

#[test]
fn a_reader_that_fails_is_begun_anew_and_numbers_go_on() {
    struct Failing(u64);
    impl FrameSource for Failing {
        fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
            assert!(self.0 < 5, "it fails on purpose");
            self.0 += 1;
            Ok(Some(a_frame(self.0 - 1)))
        }
    }
    let live = Live::start(|_| Ok(Box::new(Failing(0))));
    let (frames, troubles) = within(&live, 2.0);
    assert!(troubles.len() >= 2, "{troubles:?}");
    assert!(frames.windows(2).all(|f| f[1].index > f[0].index), "{frames:?}");
}

/// A source that cannot be opened a second time, and how often that was tried.
fn opened_once(source: impl FrameSource + 'static) -> (Live, Arc<AtomicU64>) {
    let openings = Arc::new(AtomicU64::new(0));
    let counted = Arc::clone(&openings);
    let mut source: Option<Box<dyn FrameSource>> = Some(Box::new(source));
    let live = Live::start(move |_| {
        counted.fetch_add(1, Ordering::SeqCst);
        source.take().ok_or(VideoError::Refused { url: "rtsp://eye/".into() })
    });
    (live, openings)
}

/// Waits until the source has ended and is opened again.
fn await_second_opening(openings: &AtomicU64) {
    let begun = Instant::now();
    while openings.load(Ordering::SeqCst) < 2 {
        assert!(begun.elapsed() < Duration::from_secs(10), "it is not opened again");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// What a camera has shown before it is lost does not look like one that is back.
#[test]
fn what_is_fetched_late_comes_in_its_order() {
    struct Ending(u64);
    impl FrameSource for Ending {
        fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
            self.0 += 1;
            Ok((self.0 <= 3).then(|| a_frame(self.0 - 1)))
        }
    }
    let (live, openings) = opened_once(Ending(0));
    await_second_opening(&openings);
    for index in 0..3 {
        let event = live.next(Duration::ZERO);
        assert!(matches!(&event, LiveEvent::Frame(frame) if frame.index == index), "{event:?}");
    }
    let event = live.next(Duration::ZERO);
    assert!(matches!(event, LiveEvent::Trouble(VideoError::Ended)), "{event:?}");
}

/// However many bad frames nobody has asked about, the loss of the camera is said.
#[test]
fn the_loss_of_a_camera_is_said_after_any_number_of_bad_frames() {
    struct Broken(u64);
    impl FrameSource for Broken {
        fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
            let (url, what, index) = ("rtsp://eye/".into(), "no picture".into(), self.0);
            self.0 += 1;
            if index < 1000 { Err(VideoError::StreamFrame { url, index, what }) } else { Ok(None) }
        }
    }
    let (live, openings) = opened_once(Broken(0));
    await_second_opening(&openings);
    let mut troubles = Vec::new();
    while let LiveEvent::Trouble(trouble) = live.next(Duration::ZERO) {
        troubles.push(trouble);
    }
    assert!(troubles.len() < 100, "{}", troubles.len());
    assert!(troubles[0].is_one_frame(), "{troubles:?}");
    let is_end = |trouble: &VideoError| matches!(trouble, VideoError::Ended);
    assert_eq!(troubles.iter().filter(|trouble| is_end(trouble)).count(), 1, "{troubles:?}");
}

#[test]
fn who_looks_too_slowly_sees_the_newest() {
    let camera = Camera::with_clock(0.0);
    let live = camera.watched();
    let begun = Instant::now();
    while live.counts().left_out < 20 {
        assert!(begun.elapsed() < Duration::from_secs(10), "{:?}", live.counts());
        std::thread::sleep(Duration::from_millis(50));
    }
    let LiveEvent::Frame(first) = live.next(Duration::ZERO) else { panic!("nothing came") };
    assert!(now().seconds_since(camera.captured(shown(&first))) < 0.3);
    assert!(live.counts().left_out > 0, "{:?}", live.counts());
}

#[test]
fn what_is_no_request_or_no_answer_ends_nothing_but_the_connection() {
    let camera = Camera::with_clock(0.0);
    for garbage in [&b"GET / HTTP/1.1\r\n\r\n"[..], b"\xff\xfe\x00", b"$\x00\xff\xff", b"PLAY"] {
        let mut peer = std::net::TcpStream::connect(camera.server.address()).unwrap();
        peer.write_all(garbage).unwrap();
    }
    assert!(!within(&camera.watched(), 1.5).0.is_empty());
    let mute = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("rtsp://{}/north", mute.local_addr().unwrap());
    let address = StreamAddress::parse(&url).unwrap().0;
    let said = refused(RtspOptions { address, ..camera.options("north") });
    assert!(said.contains("does not answer within 5 s"), "{said}");
}

/// Needs avdec_h264 (gstreamer1.0-libav).
#[cfg(feature = "gstreamer")]
#[test]
fn a_pipeline_is_watched_as_a_stream_is() {
    use crossfix_video::{GstreamerCamera, GstreamerOptions};

    let camera = Camera::with_clock(0.0);
    let address = camera.server.address();
    let decoded = "rtph264depay ! h264parse ! avdec_h264 max-threads=1";
    let watched = |source: &str| {
        let camera = GstreamerCamera::new(GstreamerOptions {
            pipeline: format!("{source} ! {decoded}"),
            login: None,
            heeds_reports: true,
            latency: StreamLatency::default(),
        });
        Live::start(move |silence| camera.open(silence))
    };
    let source = "rtspsrc latency=0 protocols=tcp add-reference-timestamp-meta=true";
    let (frames, troubles) =
        within(&watched(&format!("{source} location=rtsp://{address}/north")), 6.0);
    assert!(troubles.is_empty(), "{troubles:?}");
    assert!(frames.len() > 120, "{}", frames.len());
    let numbers: Vec<u64> = frames.iter().map(shown).collect();
    assert!(numbers.windows(2).all(|n| n[1] == n[0] + 1), "{numbers:?}");
    let by_camera: Vec<&Frame> =
        frames.iter().filter(|f| f.live.unwrap().timed_by == TimedBy::Camera).collect();
    assert!(by_camera.len() > 80, "{}", by_camera.len());
    for frame in by_camera {
        let error_s = frame.capture.time.seconds_since(camera.captured(shown(frame)));
        assert!(error_s.abs() < 2e-3, "{error_s}");
    }
    for (source, says) in [
        (format!("{source} location=rtsp://{address}/nowhere"), "Not"),
        ("nothing_like_it".to_owned(), "nothing_like_it"),
    ] {
        match watched(&source).next(Duration::from_secs(10)) {
            LiveEvent::Trouble(trouble) => {
                assert!(trouble.to_string().contains(says), "{trouble}");
            }
            other => panic!("{other:?}"),
        }
    }
}
