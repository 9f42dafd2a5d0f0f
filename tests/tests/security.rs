//! A site with certificates: it works as one without, and nobody else gets anything in. Real
//! processes, real sockets, and intruders who are held to none of our own checks.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crossfix_message::{AreaName, Channel, Health, Key, TrackFrame, TrackState, decode};
use crossfix_tests::{PATIENCE, Process, Site, crossfix, messages, now_seconds, succeed};
use crossfix_transport::{Authority, Identity, Link, Role, Subscription, address};
use time::OffsetDateTime;
use zenoh::qos::CongestionControl;
use zenoh::{Config, Session, Wait};

/// How long what was put is on its way at most, health's own second included.
const ARRIVED: Duration = Duration::from_millis(1500);
/// Number of messages that an intruder sends.
const SENT: u64 = 20;

/// The files by which somebody shows who he is.
struct Shown {
    folder: PathBuf,
    name: String,
}

/// The folder of the site's certificates.
fn certificates(site: &Site) -> PathBuf {
    site.network().security.as_ref().unwrap().certificates.clone()
}

/// A session of somebody who shows such files, or none, with whoever listens at an endpoint; `None`
/// if he is not let in.
fn intruder(endpoint: &str, tls: bool, shown: Option<&Shown>, site: &Site) -> Option<Session> {
    let protocol = if tls { "tls" } else { "tcp" };
    let mut config = Config::default();
    let mut set = |key: &str, value: serde_json::Value| {
        config.insert_json5(key, &value.to_string()).unwrap();
    };
    set("mode", "client".into());
    set("scouting/multicast/enabled", false.into());
    set("connect/endpoints", vec![format!("{protocol}/{}", address(endpoint))].into());
    set("connect/timeout_ms", 1500.into());
    let mut files = serde_json::json!({
        "root_ca_certificate": certificates(site).join("authority.pem"),
        "enable_mtls": shown.is_some(),
    });
    if let Some(Shown { folder, name }) = shown {
        files["connect_certificate"] =
            folder.join(format!("{name}.pem")).display().to_string().into();
        files["connect_private_key"] =
            folder.join(format!("{name}.key")).display().to_string().into();
    }
    set("transport/link/tls", files);
    zenoh::open(config).wait().ok()
}

/// Sends what nobody can read on a key, over a session that may not be there.
fn send(session: Option<&Session>, key: &str) {
    let Some(session) = session else { return };
    let publisher = session.declare_publisher(key.to_owned());
    let publisher = publisher.congestion_control(CongestionControl::Block).wait().unwrap();
    for _ in 0..SENT {
        publisher.put(vec![0xff; 40]).wait().unwrap();
    }
}

/// What the fusion centre says that it counts, as of now.
fn counted(health: &Subscription) -> BTreeMap<String, u64> {
    let (until, mut last) = (Instant::now() + ARRIVED, BTreeMap::new());
    while let Some(left) = until.checked_duration_since(Instant::now()) {
        let Some(received) = health.next(left) else { continue };
        let health: Health = decode(&received.data).unwrap();
        last = health.counters.into_iter().map(|c| (c.name, c.value)).collect();
    }
    last
}

/// A site with certificates, its fusion centre, and what that says of itself.
struct Guarded {
    site: Site,
    /// Where everybody connects to.
    endpoint: String,
    _processes: Vec<Process>,
    health: Subscription,
    /// How many unreadable messages have got in before.
    before: u64,
    _ear: Link,
}

impl Guarded {
    fn start(mut site: Site, routed: bool) -> Self {
        if routed {
            site.route();
        }
        site.enroll(&[]);
        let network = site.path("network.toml");
        let mut processes = Vec::new();
        if routed {
            processes.push(site.start(&["router", "-c", &network]));
        }
        processes.push(site.start_fusion());
        // A client is refused until the router is up.
        let deadline = Instant::now() + PATIENCE;
        let ear = Link::open_while(site.network(), &Role::Observer, |_| Instant::now() < deadline);
        let ear = ear.unwrap();
        let key = Key::new(ear.site().clone(), Channel::FusionHealth).to_string();
        let health = ear.subscribe(&[key]).unwrap();
        ear.wait_for(&[Channel::FusionAlive], PATIENCE, || true).unwrap();
        let network = site.network();
        let endpoint = network.routers.first().or(network.fusion.as_ref()).unwrap().clone();
        Self { site, endpoint, _processes: processes, health, before: 0, _ear: ear }
    }

    /// The fusion centre of one of two areas.
    fn of_area(mut site: Site, area: &str) -> Self {
        site.divide(&[("west", &["west", "north"]), ("east", &["east", "north"])], "");
        site.enroll(&[]);
        let process = site.start(&["fuse", "-c", &site.path(&format!("fusion-{area}.toml"))]);
        let area: AreaName = area.parse().unwrap();
        let ear = Link::open(site.network(), &Role::Observer).unwrap();
        let key = |channel| Key::of_centre(ear.site().clone(), Some(area.clone()), channel);
        let health = ear.subscribe(&[key(Channel::FusionHealth).to_string()]).unwrap();
        // It says how it does once a second from its beginning on.
        assert!(health.next(PATIENCE).is_some());
        let endpoint = site.network().areas[&area].fusion.clone();
        Self { site, endpoint, _processes: vec![process], health, before: 0, _ear: ear }
    }

    /// How many unreadable messages the fusion centre has had of its cameras.
    fn got_in(&self) -> u64 {
        counted(&self.health).get("received_malformed").copied().unwrap_or(0)
    }

    /// Sends as somebody on a key, and says how much of it got in.
    fn got_in_of(&mut self, tls: bool, shown: Option<&Shown>, key: &str) -> u64 {
        let session = intruder(&self.endpoint, tls, shown, &self.site);
        // Who has a certificate of the site gets a link, and is held to what it may say.
        let is_of_site = shown.is_some_and(|shown| shown.folder == certificates(&self.site));
        assert!(session.is_some() || !is_of_site, "a certified one has no link");
        // Zenoh tells a publisher of subscribers in a moment.
        std::thread::sleep(Duration::from_millis(500));
        send(session.as_ref(), key);
        let after = self.got_in();
        if let Some(session) = session {
            session.close().wait().unwrap();
        }
        after - std::mem::replace(&mut self.before, after)
    }

    fn own(&self, name: &str) -> Shown {
        Shown { folder: certificates(&self.site), name: name.to_owned() }
    }
}

/// Writes a certificate by an authority for a common name, valid from a time for so long.
fn issue(
    authority: &Authority,
    folder: &Path,
    file: &str,
    name: &str,
    from_s: i64,
    holds: Duration,
) {
    let now = OffsetDateTime::now_utc() + time::Duration::seconds(from_s);
    let issued = authority.issue(name, &[], now, holds).unwrap();
    fs::write(folder.join(format!("{file}.pem")), issued.certificate).unwrap();
    fs::write(folder.join(format!("{file}.key")), issued.key).unwrap();
}

fn own_authority(site: &Site) -> Authority {
    let public = fs::read_to_string(certificates(site).join("authority.pem")).unwrap();
    Authority::load(&public, &site.text("authority/authority.key")).unwrap()
}

/// Everybody who should get nothing in, and the one who should.
fn only_its_own_agent_gets_anything_in(routed: bool) {
    let mut guarded = Guarded::start(Site::new(1.0), routed);
    let theirs = tempfile::tempdir().unwrap();
    let foreign = Authority::create(&"test".parse().unwrap(), OffsetDateTime::now_utc()).unwrap();
    let day = Duration::from_secs(24 * 3600);
    issue(&foreign, theirs.path(), "foreign", "camera-east", 0, day);
    issue(&own_authority(&guarded.site), theirs.path(), "expired", "camera-east", -7200, day / 24);
    issue(&own_authority(&guarded.site), theirs.path(), "nobody", "camera-nobody", 0, day);
    let theirs = |name: &str| Shown { folder: theirs.path().to_owned(), name: name.to_owned() };
    let east = "crossfix/test/east/bearings";

    assert_eq!(guarded.got_in_of(false, None, east), 0, "without TLS");
    assert_eq!(guarded.got_in_of(true, None, east), 0, "without a certificate");
    for who in ["foreign", "expired", "nobody"] {
        assert_eq!(guarded.got_in_of(true, Some(&theirs(who)), east), 0, "{who}");
    }
    for who in ["camera-north", "viewer", "recorder"] {
        let shown = guarded.own(who);
        assert_eq!(guarded.got_in_of(true, Some(&shown), east), 0, "{who}");
    }
    let agent = guarded.own("camera-east");
    assert_eq!(guarded.got_in_of(true, Some(&agent), east), SENT, "its own agent");
    // Neither may another agent move its camera, nor end it.
    for kind in ["calibration", "health"] {
        let key = format!("crossfix/test/east/{kind}");
        let north = guarded.own("camera-north");
        assert_eq!(guarded.got_in_of(true, Some(&north), &key), 0, "{kind} by another");
        assert_eq!(guarded.got_in_of(true, Some(&agent), &key), SENT, "{kind} by its own");
    }
}

#[test]
fn only_a_cameras_own_agent_says_what_it_sees() {
    only_its_own_agent_gets_anything_in(false);
}

#[test]
fn only_a_cameras_own_agent_says_through_a_router_what_it_sees() {
    only_its_own_agent_gets_anything_in(true);
}

#[test]
fn only_an_areas_own_fusion_centre_says_its_tracks_to_a_neighbour() {
    let mut guarded = Guarded::of_area(Site::new(1.0), "east");
    let tracks = "crossfix/test/fusion/west/tracks";
    for who in ["fusion-east", "camera-north", "viewer", "recorder"] {
        let shown = guarded.own(who);
        assert_eq!(guarded.got_in_of(true, Some(&shown), tracks), 0, "{who}");
    }
    let neighbour = guarded.own("fusion-west");
    assert_eq!(guarded.got_in_of(true, Some(&neighbour), tracks), SENT, "its own fusion centre");
    // Nor may the neighbour speak for a camera.
    let bearings = "crossfix/test/east/bearings";
    assert_eq!(guarded.got_in_of(true, Some(&neighbour), bearings), 0, "for a camera");
}

#[test]
fn a_certificate_that_ends_takes_its_link_along() {
    let guarded = Guarded::start(Site::new(1.0), false);
    let folder = tempfile::tempdir().unwrap();
    let (begun, holds) = (Instant::now(), Duration::from_secs(8));
    issue(&own_authority(&guarded.site), folder.path(), "short", "camera-east", 0, holds);
    let short = Shown { folder: folder.path().to_owned(), name: "short".to_owned() };
    let session = intruder(&guarded.endpoint, true, Some(&short), &guarded.site);
    let east = "crossfix/test/east/bearings";
    std::thread::sleep(Duration::from_millis(500));
    send(session.as_ref(), east);
    assert_eq!(guarded.got_in(), SENT, "while it holds");
    // Validity is told to the second.
    std::thread::sleep((holds + Duration::from_millis(1500)).saturating_sub(begun.elapsed()));
    send(session.as_ref(), east);
    assert_eq!(guarded.got_in(), SENT, "after its end");
}

#[test]
fn a_revoked_certificate_gets_nothing_in_and_its_successor_does() {
    let mut site = Site::new(1.0);
    site.enroll(&[]);
    let stolen = tempfile::tempdir().unwrap();
    for end in ["pem", "key"] {
        let file = format!("camera-east.{end}");
        fs::copy(certificates(&site).join(&file), stolen.path().join(&file)).unwrap();
    }
    let said = site.enroll(&["--revoke", "camera-east"]);
    assert!(said.contains("until it is started again"), "{said}");
    let security = site.network().security.clone().unwrap();
    assert_eq!(security.revoked, [(Identity::Camera("east".parse().unwrap()), 1)].into());
    let mut guarded = Guarded::start(site, false);
    let stolen = Shown { folder: stolen.path().to_owned(), name: "camera-east".to_owned() };
    let east = "crossfix/test/east/bearings";
    assert_eq!(guarded.got_in_of(true, Some(&stolen), east), 0);
    let successor = guarded.own("camera-east");
    assert_eq!(guarded.got_in_of(true, Some(&successor), east), SENT);
}

/// Plays the site from its agents to its recorder.
fn tracks_of_a_secured_site(routed: bool) {
    let mut site = Site::new(6.0);
    if routed {
        site.route();
    }
    site.enroll(&[]);
    let network = site.path("network.toml");
    let _router = routed.then(|| site.start(&["router", "-c", &network]));
    let fusion = site.start_fusion();
    let recorder = site.start_recorder("live.mcap");
    for mut agent in site.start_agents(now_seconds() + 2.0, &["--wait-for-recorder"]) {
        assert!(agent.wait(), "an agent ends well");
    }
    std::thread::sleep(Duration::from_secs(1));
    assert!(fusion.stop() && recorder.stop());
    let recorded = site.path("live.mcap");
    let tracks = messages(recorded.as_ref(), |channel| *channel == Channel::Tracks);
    let confirmed = |entry: &crossfix_recording::Entry| {
        let frame: TrackFrame = decode(&entry.data).unwrap();
        frame.tracks.iter().any(|track| track.state() == TrackState::Confirmed)
    };
    assert!(tracks.iter().filter(|entry| confirmed(entry)).count() > 50, "{}", tracks.len());
    let of_north = Channel::Bearings("north".parse().unwrap());
    let heard = messages(recorded.as_ref(), |channel| *channel == of_north).len();
    let played = messages(site.path("source.mcap").as_ref(), |channel| *channel == of_north).len();
    assert_eq!(heard, played, "each bearing of `north` is recorded");
    let health = messages(recorded.as_ref(), |channel| *channel == Channel::RecorderHealth);
    assert!(!health.is_empty(), "the recorder may say how it does");
}

#[test]
fn a_secured_site_gives_tracks() {
    tracks_of_a_secured_site(false);
}

#[test]
fn a_secured_site_gives_tracks_through_a_router() {
    tracks_of_a_secured_site(true);
}

/// What the doctor finds of the network, as one text.
fn doctor(site: &Site) -> String {
    let output = crossfix(&["doctor", "-c", &site.path("network.toml")]);
    String::from_utf8(output.stdout).unwrap()
}

/// Issues the fusion centre's certificate anew and starts it with that.
fn fusion_with(site: &Site, authority: &Authority, hosts: &[&str], from_s: i64) -> Process {
    let now = OffsetDateTime::now_utc() + time::Duration::seconds(from_s);
    let hosts: Vec<String> = hosts.iter().map(|host| (*host).to_owned()).collect();
    let issued = authority.issue("fusion", &hosts, now, Duration::from_secs(3600)).unwrap();
    fs::write(certificates(site).join("fusion.pem"), issued.certificate).unwrap();
    fs::write(certificates(site).join("fusion.key"), issued.key).unwrap();
    let fusion = site.start_fusion();
    std::thread::sleep(Duration::from_millis(1500));
    fusion
}

#[test]
fn the_doctor_says_whose_certificate_is_wrong_and_why() {
    let mut site = Site::new(1.0);
    site.enroll(&[]);
    let own = own_authority(&site);
    {
        let _fusion = fusion_with(&site, &own, &["127.0.0.1"], 0);
        let said = doctor(&site);
        assert!(said.contains("answers as fusion"), "{said}");
        assert!(said.contains("viewer for 89 more days"), "{said}");
    }
    {
        let _fusion = fusion_with(&site, &own, &["10.9.8.7"], 0);
        let said = doctor(&site);
        assert!(said.contains("its certificate is not for this address"), "{said}");
    }
    let foreign = Authority::create(&"test".parse().unwrap(), OffsetDateTime::now_utc()).unwrap();
    {
        // A fusion centre of another site, where ours should be.
        let theirs = PathBuf::from(site.path("theirs"));
        fs::create_dir(&theirs).unwrap();
        fs::write(theirs.join("authority.pem"), foreign.certificate()).unwrap();
        let hosts = ["127.0.0.1".to_owned()];
        let now = OffsetDateTime::now_utc();
        let issued = foreign.issue("fusion", &hosts, now, Duration::from_secs(3600)).unwrap();
        fs::write(theirs.join("fusion.pem"), issued.certificate).unwrap();
        fs::write(theirs.join("fusion.key"), issued.key).unwrap();
        let network = site.text("network.toml").replace("\"certificates\"", "\"theirs\"");
        site.write("theirs.toml", &network);
        site.write("fusion.toml", "network = \"theirs.toml\"\n");
        let _fusion = site.start_fusion();
        std::thread::sleep(Duration::from_millis(1500));
        let said = doctor(&site);
        assert!(said.contains("by another authority than this site's"), "{said}");
    }
    // The doctor's own.
    let file = |end: &str| certificates(&site).join(format!("viewer.{end}"));
    issue(&own, &certificates(&site), "viewer", "viewer", -7200, Duration::from_secs(3600));
    assert!(
        doctor(&site).contains("ended 1 hours ago: run `crossfix enroll`"),
        "{}",
        doctor(&site)
    );
    issue(&own, &certificates(&site), "viewer", "fusion", 0, Duration::from_secs(3600));
    assert!(doctor(&site).contains("is of `fusion`, and the network file believes `viewer` alone"));
    fs::copy(certificates(&site).join("camera-east.key"), file("key")).unwrap();
    issue(&own, &certificates(&site), "other", "viewer", 0, Duration::from_secs(3600));
    fs::copy(certificates(&site).join("other.pem"), file("pem")).unwrap();
    assert!(doctor(&site).contains("viewer.key is not the key of"), "{}", doctor(&site));
    // A certificate by another authority than the one beside it.
    issue(&foreign, &certificates(&site), "viewer", "viewer", 0, Duration::from_secs(3600));
    assert!(doctor(&site).contains("is not by the authority of"), "{}", doctor(&site));
    fs::remove_file(file("pem")).unwrap();
    assert!(doctor(&site).contains("run `crossfix enroll`, and copy"), "{}", doctor(&site));
}

#[test]
fn check_says_whose_certificates_are_there_and_which_is_wrong() {
    let mut site = Site::new(1.0);
    site.enroll(&[]);
    site.write("fusion.toml", "network = \"network.toml\"\n");
    let folder = site.path("");
    let said = succeed(&["check", "-c", &folder]);
    for identity in ["camera-north", "fusion", "viewer"] {
        let words = format!("certificate of {identity}: is good for 89 more days");
        assert!(said.contains(&words), "{identity}: {said}");
    }
    fs::copy(site.path("certificates/viewer.pem"), site.path("certificates/fusion.pem")).unwrap();
    let output = crossfix(&["check", "-c", &folder]);
    let words = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && words.contains("the certificate of fusion"), "{words}");
}

#[test]
fn a_component_without_its_certificate_says_so_and_does_not_start() {
    let mut site = Site::new(1.0);
    site.enroll(&[]);
    fs::remove_file(certificates(&site).join("fusion.key")).unwrap();
    let output = crossfix(&["fuse", "-c", &site.path("fusion.toml")]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(said.contains("this component cannot show who it is"), "{said}");
    assert!(said.contains("fusion.key is not there: run `crossfix enroll`"), "{said}");
}

#[test]
fn without_certificates_nothing_listens_for_other_hosts_unless_it_was_told_to() {
    let site = Site::new(1.0);
    let open = site.text("network.toml").replacen("127.0.0.1", "0.0.0.0", 1);
    site.write("network.toml", &open);
    let output = crossfix(&["fuse", "-c", &site.path("fusion.toml")]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(said.contains("Run `crossfix enroll`, or set `unsecured = true`"), "{said}");
    site.write("network.toml", &format!("unsecured = true\n{open}"));
    let fusion = site.start_logged(&["fuse", "-c", &site.path("fusion.toml")], "fuse.log");
    assert!(site.wait_for_line("fuse.log", "nothing on this network is encrypted", PATIENCE));
    assert!(site.wait_for_line("fuse.log", "is up", PATIENCE));
    assert!(fusion.stop());
}

#[test]
fn keys_are_their_owners_alone_and_the_file_stays_as_it_was_written() {
    use std::os::unix::fs::PermissionsExt;
    let mut site = Site::new(1.0);
    let written = format!("# Ours.\n{}", site.text("network.toml"));
    site.write("network.toml", &written);
    site.enroll(&["--days", "30"]);
    assert!(site.text("network.toml").starts_with(&written), "{}", site.text("network.toml"));
    let mode = |path: PathBuf| fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode(certificates(&site).join("fusion.key")), 0o600);
    assert_eq!(mode(site.path("authority").into()), 0o700);
    assert_eq!(mode(site.path("authority/authority.key").into()), 0o600);
    // Renewed, by the same authority.
    let read = |name: &str| fs::read_to_string(certificates(&site).join(name)).unwrap();
    let before = [read("authority.pem"), read("viewer.pem"), read("fusion.pem")];
    succeed(&["enroll", "-c", &site.path("network.toml"), "--only", "viewer"]);
    let after = [read("authority.pem"), read("viewer.pem"), read("fusion.pem")];
    assert_eq!([0, 1, 2].map(|k| before[k] == after[k]), [true, false, true]);
}

#[test]
fn enroll_leaves_everything_as_it_was_where_it_cannot_issue() {
    let mut site = Site::new(1.0);
    site.enroll(&[]);
    let (network, key) = (site.text("network.toml"), site.path("authority/authority.key"));
    let kept = fs::read_to_string(certificates(&site).join("camera-east.pem")).unwrap();
    let other = Authority::create(&"other".parse().unwrap(), OffsetDateTime::now_utc()).unwrap();
    fs::write(&key, other.key()).unwrap();
    let file = site.path("network.toml");
    let output = crossfix(&["enroll", "-c", &file, "--revoke", "camera-east"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(said.contains("the authority's key is not that of its certificate"), "{said}");
    assert_eq!(site.text("network.toml"), network);
    let now = fs::read_to_string(certificates(&site).join("camera-east.pem")).unwrap();
    assert_eq!(now, kept);
}

#[test]
fn the_doctor_asks_the_router_where_there_is_one_and_notices_whose_endpoint_it_is() {
    let mut site = Site::new(1.0);
    site.route();
    site.enroll(&[]);
    let network = site.path("network.toml");
    let router = site.start(&["router", "-c", &network]);
    let fusion = site.start_fusion();
    std::thread::sleep(Duration::from_secs(2));
    let output = crossfix(&["doctor", "-c", &network]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && said.contains("answers as router"), "{said}");
    assert!(fusion.stop() && router.stop());
    // Somebody else's certificate where the router should be.
    for end in ["pem", "key"] {
        let of = |name: &str| certificates(&site).join(format!("{name}.{end}"));
        fs::copy(of("fusion"), of("router")).unwrap();
    }
    let output = crossfix(&["router", "-c", &network]);
    assert_eq!(output.status.code(), Some(1), "it does not pass for the router");
}

#[test]
fn the_log_of_who_waits_for_another_says_what_is_wrong_with_the_certificate() {
    let mut site = Site::new(1.0);
    site.enroll(&[]);
    let own = own_authority(&site);
    // `east` says that it is another host.
    let hosts = ["10.9.8.7".to_owned()];
    let issued = own
        .issue("camera-east", &hosts, OffsetDateTime::now_utc(), Duration::from_secs(600))
        .unwrap();
    fs::write(certificates(&site).join("camera-east.pem"), issued.certificate).unwrap();
    fs::write(certificates(&site).join("camera-east.key"), issued.key).unwrap();
    let _agent = site.start(&["agent", "-c", &site.path("east.toml")]);
    let fusion = site.start_logged(&["fuse", "-c", &site.path("fusion.toml")], "fuse.log");
    let words = "its certificate is not for this address";
    assert!(site.wait_for_line("fuse.log", words, PATIENCE), "{}", site.text("fuse.log"));
    assert!(fusion.stop());
}
