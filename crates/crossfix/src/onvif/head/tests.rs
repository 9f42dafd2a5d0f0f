use super::super::stub::{PASSWORD, Reply, Stub, USER};
use super::super::{OfferedStream, describe};
use super::*;

const ANGLE_SD_RAD: f64 = 1e-3;

fn degrees(azimuth: f64, elevation: f64) -> ScanAngles {
    ScanAngles { azimuth: azimuth.to_radians(), elevation: elevation.to_radians() }
}

fn config(stub: &Stub, password: &str) -> (OnvifConfig, tempfile::NamedTempFile) {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), password).unwrap();
    let config = OnvifConfig {
        url: stub.url().parse().unwrap(),
        user: Some(USER.to_owned()),
        password_file: Some(file.path().to_owned()),
        pan_deg: [180.0, -180.0],
        tilt_deg: [0.0, 90.0],
        zoom: Some(0.5),
    };
    (config, file)
}

/// Waits until `holds` is true of where the mount points; after `seconds`, returns what it reported
/// last.
fn until(mount: &mut OnvifMount, seconds: f64, mut holds: impl FnMut(Pointed) -> bool) -> Pointed {
    let begun = Instant::now();
    loop {
        let pointed = mount.pointed();
        if holds(pointed) || begun.elapsed().as_secs_f64() > seconds {
            return pointed;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn is_settled(pointed: Pointed) -> bool {
    matches!(pointed, Pointed::Settled(_))
}

fn is_unknown(pointed: Pointed) -> bool {
    pointed == Pointed::Unknown
}

/// The angles at which it has settled.
fn settled(pointed: Pointed) -> ScanAngles {
    match pointed {
        Pointed::Settled(angles) => angles,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_position_is_an_angle_and_back() {
    let scale = AngleScale { pan: [3.0, -3.0], tilt: [-0.5, 1.5] };
    let angles = scale.angles([0.5, -0.5]);
    assert!((angles.azimuth + 1.5).abs() < 1e-12 && angles.elevation.abs() < 1e-12);
    let [pan, tilt] = scale.position(angles);
    assert!((pan - 0.5).abs() < 1e-6 && (tilt + 0.5).abs() < 1e-6);
    // Clamped to the ends of its range.
    assert_eq!(scale.position(ScanAngles { azimuth: 9.0, elevation: 9.0 }), [-1.0, 1.0]);
}

/// One report per tenth of a second: where it is, whether it says that it moves, whether it is
/// settled.
#[test]
fn it_has_settled_when_it_has_stood_for_as_long_as_an_image_takes() {
    let begun = Instant::now();
    let at = |tenth: u32| begun + ASKED_EVERY * tenth;
    let mut pointed = Head::new(ANGLE_SD_RAD);
    let hear = |pointed: &mut Head, tenth: u32, azimuth: f64, moves: bool| {
        pointed.observe(degrees(azimuth, 0.0), moves, at(tenth));
        is_settled(pointed.at(at(tenth)))
    };
    let settled: Vec<bool> = (0..8).map(|k| hear(&mut pointed, k, 10.0, false)).collect();
    assert_eq!(settled, [false, false, false, false, false, false, true, true]);
    // Once told to turn it is not settled, even while it still stands and does not report moving.
    pointed.order(degrees(20.0, 0.0));
    assert!(!hear(&mut pointed, 8, 10.0, false));
    pointed.told(degrees(20.0, 0.0), at(8));
    for (tenth, azimuth) in [(9, 10.0), (10, 10.0), (11, 12.0), (12, 16.0), (13, 20.0)] {
        assert!(!hear(&mut pointed, tenth, azimuth, false), "{tenth}");
    }
    let first = (14..30).find(|k| hear(&mut pointed, *k, 20.0, false));
    assert_eq!(first, Some(19), "half a second after it was there");
    // It drifts by less than the deviations per report, and the drift is noticed.
    let drifts = (30..45).map(|k| hear(&mut pointed, k, 20.0 + 0.1 * f64::from(k - 29), false));
    assert!(drifts.skip(2).all(|settled| !settled));
    // It never starts to turn: told to go farther than it can, it stands where it is.
    let stands: Vec<bool> = (45..60).map(|k| hear(&mut pointed, k, 21.5, false)).collect();
    assert!(stands[8]);
    pointed.order(degrees(90.0, 0.0));
    pointed.told(degrees(90.0, 0.0), at(60));
    let first = (60..90).find(|k| hear(&mut pointed, *k, 21.5, false));
    assert_eq!(first, Some(71));
    // It refuses to turn: it keeps observing from where it is, and is not asked again at once.
    pointed.order(degrees(95.0, 0.0));
    pointed.refuse(at(73));
    assert!(hear(&mut pointed, 74, 21.5, false) && !pointed.obeys(at(75)));
    assert!(pointed.obeys(at(124)));
    // An old report tells nothing.
    assert!(is_unknown(pointed.at(at(100))));
}

#[test]
fn it_turns_where_it_is_told_and_says_where_it_is_when_it_stands() {
    let stub = Stub::start(0);
    let (config, _file) = config(&stub, PASSWORD);
    let mut mount = OnvifMount::start(&config, ANGLE_SD_RAD).unwrap();
    let rest = settled(until(&mut mount, 6.0, is_settled));
    assert!((rest.azimuth - 0.0).abs() < 1e-3 && (rest.elevation - 0.785).abs() < 1e-3);
    // The lens's zoom is set once.
    assert_eq!(stub.state.lock().unwrap().zoom, 0.5);

    let aim = degrees(-72.0, 18.0);
    mount.aim(aim);
    assert!(!is_settled(mount.pointed()));
    let told = Instant::now();
    let mut last_moved = told;
    // When it is reported as settled it is there, and has been for as long as an image takes.
    let there = settled(until(&mut mount, 6.0, |pointed| {
        if stub.state.lock().unwrap().position().1 {
            last_moved = Instant::now();
        }
        is_settled(pointed)
    }));
    assert!((there.azimuth - aim.azimuth).abs() < 4e-4, "{there:?}");
    assert!((there.elevation - aim.elevation).abs() < 4e-4, "{there:?}");
    assert!(last_moved > told && last_moved.elapsed() > IMAGE_COMES_WITHIN);
    assert!(last_moved.elapsed() < 4 * IMAGE_COMES_WITHIN);

    // Somebody zooms: the lens is a different one until the zoom is set back.
    stub.state.lock().unwrap().zoom = 0.9;
    assert!(is_unknown(until(&mut mount, 3.0, is_unknown)));
    settled(until(&mut mount, 9.0, is_settled));
    assert_eq!(stub.state.lock().unwrap().zoom, 0.5);
}

#[test]
fn a_mount_that_is_gone_points_nowhere_and_is_asked_again() {
    let stub = Stub::start(0);
    let (config, _file) = config(&stub, PASSWORD);
    let mut mount = OnvifMount::start(&config, ANGLE_SD_RAD).unwrap();
    settled(until(&mut mount, 9.0, is_settled));
    let port = stub.port;
    drop(stub);
    assert!(is_unknown(until(&mut mount, 6.0, is_unknown)));
    mount.aim(degrees(30.0, 50.0));
    let stub = Stub::start(port);
    let there = settled(until(&mut mount, 15.0, is_settled));
    assert!((there.azimuth - 30f64.to_radians()).abs() < 1e-3, "told late: {there:?}");
    // The mount keeps running, but no longer reports where it is.
    stub.state.lock().unwrap().says = false;
    assert!(is_unknown(until(&mut mount, 6.0, is_unknown)));
}

#[test]
fn a_wrong_password_is_refused_and_shown_nowhere() {
    let stub = Stub::start(0);
    let (config, _file) = config(&stub, "wrong-one");
    let login = config.login().unwrap();
    let error = format!("{:#}", describe(&config.url, login.as_ref()).unwrap_err());
    assert!(error.contains("not Authorized") && !error.contains("wrong-one"), "{error}");
    let mut mount = OnvifMount::start(&config, ANGLE_SD_RAD).unwrap();
    assert!(is_unknown(until(&mut mount, 1.5, |pointed| !is_unknown(pointed))));
}

#[test]
fn a_camera_says_its_streams_and_where_it_points() {
    let stub = Stub::start(0);
    let (config, _file) = config(&stub, PASSWORD);
    let login = config.login().unwrap();
    let camera = describe(&config.url, login.as_ref()).unwrap();
    assert_eq!(camera.name, "Stub One");
    let main =
        OfferedStream { profile: "main".to_owned(), url: "rtsp://127.0.0.1/main".to_owned() };
    assert_eq!(camera.streams[1], main);
    assert_eq!(camera.position, Some([0.0, 0.0]));
}

#[test]
fn a_mount_that_refuses_to_turn_sees_on_where_it_is() {
    let stub = Stub::start(0);
    stub.state.lock().unwrap().refuses = true;
    let (config, _file) = config(&stub, PASSWORD);
    let config = OnvifConfig { zoom: None, ..config };
    let mut mount = OnvifMount::start(&config, ANGLE_SD_RAD).unwrap();
    let rest = settled(until(&mut mount, 6.0, is_settled));
    mount.aim(degrees(30.0, 50.0));
    assert!(!is_settled(mount.pointed()));
    assert_eq!(settled(until(&mut mount, 6.0, is_settled)), rest);
    assert!(!mount.obeys());
    assert_eq!(stub.state.lock().unwrap().moves, 1, "asked once");
}

/// The camera cannot make us read more than it should send, nor redirect the login elsewhere.
#[test]
fn a_camera_that_answers_too_much_too_deeply_or_with_another_address_is_no_camera() {
    let stub = Stub::start(0);
    let (config, _file) = config(&stub, PASSWORD);
    let login = config.login().unwrap();
    let elsewhere = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    elsewhere.set_nonblocking(true).unwrap();
    let address = elsewhere.local_addr().unwrap();
    let deep = format!("{}{}", "<a>".repeat(20_000), "</a>".repeat(20_000));
    for (reply, what) in [
        (Reply::Body("x".repeat(10 << 20)), "too long"),
        (Reply::Body(deep), "too deep"),
        (Reply::Redirect(format!("http://{address}/onvif/device_service")), "307"),
    ] {
        stub.state.lock().unwrap().instead = Some(reply);
        let error = format!("{:#}", describe(&config.url, login.as_ref()).unwrap_err());
        assert!(error.contains(what), "{what}: {error}");
    }
    assert!(elsewhere.accept().is_err(), "nobody was asked there");
}
