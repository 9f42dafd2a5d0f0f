//! A simulated network camera on a mount, with the parts of the device, media and mount services
//! that are used.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use sha1::{Digest, Sha1};

/// The user that the stub accepts.
pub const USER: &str = "eye";
/// The password that the stub accepts.
pub const PASSWORD: &str = "hunter2";
/// Turning rate, in units of the position range (-1 to 1) per second.
const RATE: f64 = 0.8;
/// Delay from the order to the start of the turn.
const BEGINS_AFTER: Duration = Duration::from_millis(150);

/// Reply that the stub gives instead of the proper answer.
#[derive(Clone, Debug)]
pub enum Reply {
    Body(String),
    Redirect(String),
}

/// Where the mount is and where it goes.
#[derive(Clone, Debug)]
pub struct MountMotion {
    from: [f64; 2],
    to: [f64; 2],
    ordered: Instant,
    pub zoom: f64,
    /// Whether it reports where it is.
    pub says: bool,
    /// Whether it refuses to turn.
    pub refuses: bool,
    /// How often it was ordered to turn.
    pub moves: usize,
    pub instead: Option<Reply>,
}

impl MountMotion {
    /// Pan and tilt now, and whether they change.
    pub fn position(&self) -> ([f64; 2], bool) {
        let passed = self.ordered.elapsed().saturating_sub(BEGINS_AFTER).as_secs_f64();
        let now = [0, 1].map(|axis| self.turned(axis, passed));
        (now, now != self.to && passed > 0.0)
    }

    /// Where an axis is after it has turned for a time, s.
    fn turned(&self, axis: usize, passed_s: f64) -> f64 {
        let way = self.to[axis] - self.from[axis];
        self.from[axis] + way.clamp(-RATE * passed_s, RATE * passed_s)
    }
}

/// The simulated camera, which runs until it is dropped.
pub struct Stub {
    pub state: Arc<Mutex<MountMotion>>,
    pub port: u16,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Stub {
    /// Starts on a port of this host; 0 is any.
    pub fn start(port: u16) -> Self {
        let listener = TcpListener::bind(("127.0.0.1", port)).unwrap();
        let port = listener.local_addr().unwrap().port();
        let state = MountMotion {
            from: [0.0; 2],
            to: [0.0; 2],
            ordered: Instant::now(),
            zoom: 0.0,
            says: true,
            refuses: false,
            moves: 0,
            instead: None,
        };
        let (state, stop) = (Arc::new(Mutex::new(state)), Arc::new(AtomicBool::new(false)));
        let (shared, ends) = (state.clone(), stop.clone());
        let thread = std::thread::spawn(move || {
            while let Ok((stream, _)) = listener.accept() {
                if ends.load(Ordering::Relaxed) {
                    return;
                }
                // Each connection gets one answer.
                let _ = answer(&stream, &shared);
            }
        });
        Self { state, port, stop, thread: Some(thread) }
    }

    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}/onvif/device_service", self.port)
    }
}

impl Drop for Stub {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let _ = TcpStream::connect(("127.0.0.1", self.port));
        self.thread.take().unwrap().join().unwrap();
    }
}

fn answer(stream: &TcpStream, state: &Mutex<MountMotion>) -> std::io::Result<()> {
    let mut reader = BufReader::new(stream);
    let mut length = 0;
    for line in reader.by_ref().lines() {
        let line = line?.to_lowercase();
        if let Some(value) = line.strip_prefix("content-length:") {
            length = value.trim().parse().unwrap();
        }
        if line.is_empty() {
            break;
        }
    }
    let mut request = vec![0; length];
    reader.read_exact(&mut request)?;
    let instead = state.lock().unwrap().instead.clone();
    let (status, body, more) = match instead {
        Some(Reply::Body(body)) => ("200 OK", body, String::new()),
        Some(Reply::Redirect(to)) => {
            ("307 Temporary Redirect", String::new(), format!("Location: {to}\r\n"))
        }
        None => {
            let (status, body) = reply(&String::from_utf8_lossy(&request), state);
            (status, body, String::new())
        }
    };
    let text = format!(
        "<s:Envelope xmlns:s=\"http://www.w3.org/2003/05/soap-envelope\"><s:Body>{body}</s:Body>\
         </s:Envelope>"
    );
    let mut stream = stream;
    write!(
        stream,
        "HTTP/1.1 {status}\r\nContent-Type: application/soap+xml\r\nContent-Length: {}\r\n{more}\
         Connection: close\r\n\r\n{text}",
        text.len()
    )
}

/// The text between an element's tags, whatever its namespace prefix.
fn element<'a>(text: &'a str, name: &str) -> Option<&'a str> {
    let begin = [">", " "].iter().filter_map(|end| text.find(&format!(":{name}{end}"))).min()?;
    let inside = &text[begin..][text[begin..].find('>')? + 1..];
    Some(&inside[..inside.find("</")?])
}

fn attribute(text: &str, element: &str, name: &str) -> Option<f64> {
    let begin = text.find(&format!(":{element} "))?;
    let tag = &text[begin..][..text[begin..].find('>')?];
    let value = &tag[tag.find(&format!(" {name}=\""))? + name.len() + 3..];
    value[..value.find('"')?].parse().ok()
}

/// Whether the request proves knowledge of the password (WS-Security, `PasswordDigest`).
fn knows_password(request: &str) -> bool {
    is_proof_of_password(request).unwrap_or(false)
}

/// Whether the request's proof is right; `None` if it holds none.
fn is_proof_of_password(request: &str) -> Option<bool> {
    let nonce = STANDARD.decode(element(request, "Nonce")?).ok()?;
    let mut digest = Sha1::new();
    digest.update(&nonce);
    digest.update(element(request, "Created")?);
    digest.update(PASSWORD);
    let proved = STANDARD.encode(digest.finalize()) == element(request, "Password")?;
    Some(proved && element(request, "Username")? == USER)
}

fn fault(reason: &str) -> String {
    format!(
        "<s:Fault><s:Code><s:Value>s:Sender</s:Value></s:Code><s:Reason><s:Text>{reason}</s:Text>\
         </s:Reason></s:Fault>"
    )
}

fn reply(request: &str, state: &Mutex<MountMotion>) -> (&'static str, String) {
    let asks = |what: &str| {
        request.contains(&format!(":{what}>")) || request.contains(&format!(":{what}/>"))
    };
    if asks("GetSystemDateAndTime") {
        let body = "<SystemDateAndTime><DateTimeType>NTP</DateTimeType></SystemDateAndTime>";
        return (
            "200 OK",
            format!("<GetSystemDateAndTimeResponse>{body}</GetSystemDateAndTimeResponse>"),
        );
    }
    if !knows_password(request) {
        return ("400 Bad Request", fault("Sender not Authorized"));
    }
    let mut state = state.lock().unwrap();
    let (name, body) = if asks("GetCapabilities") {
        // Like many cameras, it states an address that is valid nowhere.
        let at = |service: &str| format!("<XAddr>http://0.0.0.0/onvif/{service}</XAddr>");
        let [media, ptz] = ["media", "ptz"].map(at);
        let body = format!("<Capabilities><Media>{media}</Media><PTZ>{ptz}</PTZ></Capabilities>");
        ("GetCapabilities", body)
    } else if asks("GetDeviceInformation") {
        ("GetDeviceInformation", "<Manufacturer>Stub</Manufacturer><Model>One</Model>".to_owned())
    } else if asks("GetProfiles") {
        let body = "<Profiles token=\"plain\"><Name>still</Name></Profiles>\
                    <Profiles token=\"main\"><Name>main</Name><PTZConfiguration \
                    token=\"t\"/></Profiles>";
        ("GetProfiles", body.to_owned())
    } else if asks("GetStreamUri") {
        ("GetStreamUri", "<MediaUri><Uri>rtsp://127.0.0.1/main</Uri></MediaUri>".to_owned())
    } else if asks("GetStatus") {
        let ([pan, tilt], moves) = state.position();
        let place = format!(
            "<Position><PanTilt x=\"{pan:.4}\" y=\"{tilt:.4}\"/><Zoom x=\"{}\"/></Position>",
            state.zoom
        );
        let moves = if moves { "MOVING" } else { "IDLE" };
        let place = if state.says { place } else { String::new() };
        let body = format!(
            "<PTZStatus>{place}<MoveStatus><PanTilt>{moves}</PanTilt></MoveStatus></PTZStatus>"
        );
        ("GetStatus", body)
    } else if asks("AbsoluteMove") {
        let of = |element, name| attribute(request, element, name).unwrap();
        let (from, _) = state.position();
        let to = [of("PanTilt", "x"), of("PanTilt", "y")];
        state.moves += 1;
        if state.refuses {
            return ("500 Internal Server Error", fault("Position out of bounds"));
        }
        let (ordered, zoom) = (Instant::now(), of("Zoom", "x"));
        *state = MountMotion { from, to, ordered, zoom, ..state.clone() };
        ("AbsoluteMove", String::new())
    } else {
        return ("400 Bad Request", String::new());
    };
    ("200 OK", format!("<{name}Response>{body}</{name}Response>"))
}
