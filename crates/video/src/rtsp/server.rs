use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use crossfix_message::Timestamp;

use super::Login;
use super::packets::{CLOCK_HZ, PAYLOAD_TYPE, Packetiser};
use crate::annex_b::is_key;

/// Number of frames that may wait for a watcher; one that is farther behind is disconnected. With
/// half of it a watcher that stops reading for one second at 30 frames per second is disconnected.
const WAITING: usize = 64;
/// How long a watcher may take no data before it is disconnected. With half of it the same at 30
/// frames per second, where the queue is full after two seconds.
const PATIENCE: Duration = Duration::from_secs(5);
/// The longest line of a request, bytes. With half of it the same: requests have short lines.
const LONGEST_LINE: u64 = 4096;
/// The most lines of a request. With half of it the same: requests have some ten.
const MOST_LINES: usize = 64;
/// The session's name. Each watcher has a connection of its own, so all can have the same.
const SESSION: &str = "1";

/// The streams of a server, by path.
type Streams = Arc<Mutex<BTreeMap<String, Arc<Mutex<StreamState>>>>>;

/// Serves H.264 streams as a network camera does: RTSP, with the packets within the connection.
///
/// For scenes and tests. The server does not make the pictures: the holder of a stream's
/// [`ServedStream`] sends each at its time.
///
/// ```
/// use crossfix_video::RtspServer;
///
/// let mut server = RtspServer::bind("127.0.0.1:0".parse().unwrap(), None)?;
/// let north = server.mount("north");
/// assert!(!north.is_watched());
/// println!("rtsp://{}/north", server.address());
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Debug)]
pub struct RtspServer {
    address: SocketAddr,
    streams: Streams,
}

/// A stream of a server, to send frames to.
#[derive(Debug)]
pub struct ServedStream(Arc<Mutex<StreamState>>);

#[derive(Debug)]
struct StreamState {
    packetiser: Packetiser,
    watchers: Vec<Watcher>,
}

/// A client that watches.
#[derive(Debug)]
struct Watcher {
    queue: SyncSender<Vec<u8>>,
    connection: TcpStream,
    /// Whether it has been sent a key picture, which can be decoded without others.
    sees: bool,
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl RtspServer {
    /// Listens at an address; clients have to log in if a login is given (basic authentication).
    ///
    /// # Errors
    /// What the system says.
    pub fn bind(address: SocketAddr, login: Option<Login>) -> std::io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        let server = Self { address: listener.local_addr()?, streams: Arc::default() };
        let streams = Arc::clone(&server.streams);
        std::thread::Builder::new().name("rtsp".to_owned()).spawn(move || {
            for connection in listener.incoming().flatten() {
                let (streams, login) = (Arc::clone(&streams), login.clone());
                std::thread::spawn(move || {
                    Caller { streams, login, path: None }.serve(&connection);
                });
            }
        })?;
        Ok(server)
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Adds a stream at a path.
    pub fn mount(&mut self, path: &str) -> ServedStream {
        let source = locked(&self.streams).len() as u32 + 1;
        let packetiser = Packetiser::new(source);
        let stream = Arc::new(Mutex::new(StreamState { packetiser, watchers: Vec::new() }));
        locked(&self.streams).insert(path.to_owned(), Arc::clone(&stream));
        ServedStream(stream)
    }
}

impl ServedStream {
    /// Whether any client watches.
    pub fn is_watched(&self) -> bool {
        !locked(&self.0).watchers.is_empty()
    }

    /// Sends an access unit (Annex B) to all who watch; `ticks` is its time by the stream's count
    /// of 90 000 per second.
    pub fn send(&self, unit: &[u8], ticks: u32) {
        let mut stream = locked(&self.0);
        let packets = stream.packetiser.access_unit(unit, ticks);
        let is_key = is_key(unit);
        stream.watchers.retain_mut(|watcher| {
            watcher.sees |= is_key;
            !watcher.sees || watcher.send(packets.clone())
        });
    }

    /// Reports to all who watch that the camera's clock showed `shown` when the count was at
    /// `ticks`.
    pub fn report(&self, shown: Timestamp, ticks: u32) {
        let mut stream = locked(&self.0);
        let report = stream.packetiser.report(shown, ticks);
        stream.watchers.retain_mut(|watcher| !watcher.sees || watcher.send(report.clone()));
    }

    /// Closes all connections to it, as a restarting camera does.
    pub fn hang_up(&self) {
        locked(&self.0).watchers.clear();
    }
}

impl Watcher {
    /// Queues packets; returns whether the client still watches.
    fn send(&self, packets: Vec<u8>) -> bool {
        !matches!(
            self.queue.try_send(packets),
            Err(TrySendError::Full(_) | TrySendError::Disconnected(_))
        )
    }
}

impl Drop for Watcher {
    fn drop(&mut self) {
        // The client may have closed it already.
        let _ = self.connection.shutdown(Shutdown::Both);
    }
}

/// A connected client.
struct Caller {
    streams: Streams,
    login: Option<Login>,
    path: Option<String>,
}

/// An RTSP request.
struct Request {
    method: String,
    url: String,
    headers: BTreeMap<String, String>,
}

impl Request {
    /// The next request; `None` at the end of the connection, or if what comes is not a request.
    fn read(reader: &mut BufReader<&TcpStream>) -> Option<Self> {
        // Clients may send receiver reports within the connection: they are skipped.
        while *reader.fill_buf().ok()?.first()? == b'$' {
            let mut head = [0; 4];
            reader.read_exact(&mut head).ok()?;
            let length = u64::from(u16::from_be_bytes([head[2], head[3]]));
            std::io::copy(&mut reader.by_ref().take(length), &mut std::io::sink()).ok()?;
        }
        let mut lines = Vec::new();
        while lines.len() < MOST_LINES {
            let mut line = Vec::new();
            reader.by_ref().take(LONGEST_LINE).read_until(b'\n', &mut line).ok()?;
            let text = String::from_utf8_lossy(&line).trim_end().to_owned();
            if text.is_empty() {
                break;
            }
            lines.push(text);
        }
        let mut words = lines.first()?.split(' ');
        let (method, url) = (words.next()?.to_owned(), words.next()?.to_owned());
        let headers = lines.iter().skip(1).filter_map(|line| header(line)).collect();
        Some(Self { method, url, headers })
    }

    /// An answer to it.
    fn reply(&self, status: &str, headers: &[&str], body: &str) -> String {
        let number = self.headers.get("cseq").map_or("0", String::as_str);
        let mut text = format!("RTSP/1.0 {status}\r\nCSeq: {number}\r\n");
        headers.iter().for_each(|header| text += &format!("{header}\r\n"));
        if !body.is_empty() {
            text += &format!("Content-Length: {}\r\n", body.len());
        }
        text + "\r\n" + body
    }
}

/// Name, in lower case, and value of a header's line.
fn header(line: &str) -> Option<(String, String)> {
    let (name, value) = line.split_once(':')?;
    Some((name.trim().to_ascii_lowercase(), value.trim().to_owned()))
}

impl Caller {
    fn serve(mut self, connection: &TcpStream) {
        let Ok(queue) = write_behind(connection) else {
            return;
        };
        let mut reader = BufReader::new(connection);
        while let Some(request) = Request::read(&mut reader) {
            let (answer, plays) = self.answer(&request);
            if queue.send(answer.into_bytes()).is_err() {
                return;
            }
            if plays && self.play(connection, &queue).is_none() {
                return;
            }
            if request.method == "TEARDOWN" {
                return;
            }
        }
    }

    /// The path that a URL names, and its stream.
    fn stream(&self, url: &str) -> Option<(String, Arc<Mutex<StreamState>>)> {
        let path = url.split_once("://").map_or(url, |(_, rest)| rest);
        let path = path.split_once('/').map_or("", |(_, path)| path);
        let path = path.trim_end_matches("/video").trim_end_matches('/');
        let stream = locked(&self.streams).get(path).cloned()?;
        Some((path.to_owned(), stream))
    }

    fn is_welcome(&self, request: &Request) -> bool {
        self.login.as_ref().is_none_or(|login| {
            let wanted = BASE64_STANDARD.encode(format!("{}:{}", login.user(), login.password()));
            let said = request.headers.get("authorization");
            said.is_some_and(|said| *said == format!("Basic {wanted}"))
        })
    }

    /// The answer, and whether the stream starts after it.
    fn answer(&mut self, request: &Request) -> (String, bool) {
        let session = format!("Session: {SESSION};timeout=60");
        if !self.is_welcome(request) {
            let ask = "WWW-Authenticate: Basic realm=\"crossfix\"";
            return (request.reply("401 Unauthorized", &[ask], ""), false);
        }
        let answer = match request.method.as_str() {
            "OPTIONS" => request.reply(
                "200 OK",
                &["Public: OPTIONS, DESCRIBE, SETUP, PLAY, GET_PARAMETER, TEARDOWN"],
                "",
            ),
            "GET_PARAMETER" | "SET_PARAMETER" | "TEARDOWN" => {
                request.reply("200 OK", &[&session], "")
            }
            "DESCRIBE" if self.stream(&request.url).is_some() => {
                let base = format!("Content-Base: {}/", request.url.trim_end_matches('/'));
                let body = format!(
                    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=crossfix\r\nt=0 0\r\n\
                     m=video 0 RTP/AVP {PAYLOAD_TYPE}\r\n\
                     a=rtpmap:{PAYLOAD_TYPE} H264/{CLOCK_HZ}\r\n\
                     a=fmtp:{PAYLOAD_TYPE} packetization-mode=1\r\na=control:video\r\n"
                );
                request.reply("200 OK", &[&base, "Content-Type: application/sdp"], &body)
            }
            "SETUP" => match self.stream(&request.url) {
                Some((path, _)) => {
                    let transport = request.headers.get("transport").map_or("", String::as_str);
                    if !transport.contains("interleaved") {
                        return (request.reply("461 Unsupported Transport", &[], ""), false);
                    }
                    self.path = Some(path);
                    let transport = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1";
                    request.reply("200 OK", &[transport, &session], "")
                }
                None => request.reply("404 Not Found", &[], ""),
            },
            "PLAY" if self.path.is_some() => {
                return (request.reply("200 OK", &[&session], ""), true);
            }
            "DESCRIBE" | "PLAY" => request.reply("404 Not Found", &[], ""),
            _ => request.reply("501 Not Implemented", &[], ""),
        };
        (answer, false)
    }

    /// Starts to send the stream.
    fn play(&self, connection: &TcpStream, queue: &SyncSender<Vec<u8>>) -> Option<()> {
        let (_, stream) = self.stream(&format!("/{}", self.path.as_deref()?))?;
        let connection = connection.try_clone().ok()?;
        let watcher = Watcher { queue: queue.clone(), connection, sees: false };
        locked(&stream).watchers.push(watcher);
        Some(())
    }
}

/// A queue that a thread of its own writes to a connection, answers and frames in order.
fn write_behind(connection: &TcpStream) -> std::io::Result<SyncSender<Vec<u8>>> {
    let (queue, waiting) = sync_channel::<Vec<u8>>(WAITING);
    let mut writer = connection.try_clone()?;
    writer.set_write_timeout(Some(PATIENCE))?;
    std::thread::spawn(move || {
        for bytes in waiting {
            if writer.write_all(&bytes).is_err() {
                // Shutting the connection down ends the thread that reads from it.
                let _ = writer.shutdown(Shutdown::Both);
                return;
            }
        }
    });
    Ok(queue)
}
