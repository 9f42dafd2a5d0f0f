//! Transport of an outlet's bytes: datagrams, streams, files.

use std::fmt;
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs, UdpSocket};
use std::path::PathBuf;
use std::str::FromStr;
use std::time::{Duration, Instant};

use anyhow::Context;
use crossfix_message::Timestamp;
use crossfix_outlet::Outlet;

use super::OutletNews;
use super::tls::{TlsClient, TlsStream};
use crate::pace::wall_seconds;

/// How long the receiver may take to answer, or to take a message: the site's messages wait
/// meanwhile, and are not lost. With half of it a receiver that takes longer to accept is never
/// reached.
const PATIENCE: Duration = Duration::from_secs(2);
/// Pause after a connection has failed. With twice as much a receiver that is back gets nothing
/// for up to two seconds.
const RETRY: Duration = Duration::from_secs(1);
/// How often it is logged that there is no receiver. With half of it an hour without one costs 120
/// lines instead of 60.
const REMINDER: Duration = Duration::from_secs(60);
/// How long a check for data from the receiver takes. Each message of the site waits for it: with
/// twice as much 500 of them per second would be the most.
const GLANCE: Duration = Duration::from_millis(1);
/// Size of the pieces in which the receiver's data are read, bytes: a TAK server relays everybody's
/// messages, and drops clients that do not read them. With half of it the same: the rest is read at
/// the next check.
const PIECE: usize = 64 << 10;
/// Most pieces read at one check, 4 MB: a receiver that sends without end must not keep the outlet
/// from sending. With half of it the same: the rest is read at the next check.
const MOST_PIECES: usize = 64;
/// A parent that has not accepted the registration after this long will not do so. With half of it
/// one that is just starting would be asked again before it has answered.
const WELCOME: Duration = Duration::from_secs(10);

/// Where an outlet's bytes are sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Destination {
    Udp(String),
    Tcp(String),
    Tls(String),
    File(PathBuf),
    Stdout,
}

impl FromStr for Destination {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "-" {
            return Ok(Self::Stdout);
        }
        let Some((protocol, address)) = text.split_once("://") else {
            return Ok(Self::File(text.into()));
        };
        let has_port =
            address.rsplit_once(':').is_some_and(|(_, port)| port.parse::<u16>().is_ok());
        if !has_port {
            return Err(format!("`{address}` is not of the form HOST:PORT"));
        }
        match protocol {
            "udp" => Ok(Self::Udp(address.to_owned())),
            "tcp" => Ok(Self::Tcp(address.to_owned())),
            "tls" => Ok(Self::Tls(address.to_owned())),
            _ => Err(format!("`{protocol}` is none of udp, tcp, tls")),
        }
    }
}

impl Destination {
    /// Whether the receiver can answer.
    pub fn answers(&self) -> bool {
        matches!(self, Self::Tcp(_) | Self::Tls(_))
    }
}

impl fmt::Display for Destination {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Udp(address) => write!(f, "udp://{address}"),
            Self::Tcp(address) => write!(f, "tcp://{address}"),
            Self::Tls(address) => write!(f, "tls://{address}"),
            Self::File(path) => write!(f, "{}", path.display()),
            Self::Stdout => f.write_str("stdout"),
        }
    }
}

/// An open connection to the receiver.
enum Connection {
    Datagrams(UdpSocket),
    Plain(TcpStream),
    Encrypted(Box<TlsStream>),
    File(File),
    Stdout,
}

impl Connection {
    fn open(destination: &Destination, tls: Option<&TlsClient>) -> io::Result<Self> {
        Ok(match destination {
            Destination::Udp(address) => {
                let address = resolve(address)?;
                let own = if address.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" };
                let socket = UdpSocket::bind(own)?;
                socket.connect(address)?;
                Self::Datagrams(socket)
            }
            Destination::Tcp(address) => Self::Plain(connect(address)?),
            Destination::Tls(address) => {
                let tls = tls.ok_or_else(|| io::Error::other("there is no --tls-ca"))?;
                Self::Encrypted(Box::new(tls.connect(connect(address)?, address)?))
            }
            Destination::File(path) => {
                Self::File(OpenOptions::new().append(true).create(true).open(path)?)
            }
            Destination::Stdout => Self::Stdout,
        })
    }

    fn write(&mut self, message: &[u8]) -> io::Result<()> {
        match self {
            Self::Datagrams(socket) => socket.send(message).map(drop),
            Self::Plain(stream) => stream.write_all(message),
            Self::Encrypted(stream) => stream.write_all(message),
            Self::File(file) => file.write_all(message),
            Self::Stdout => io::stdout().lock().write_all(message),
        }
    }

    /// Data that the receiver has sent, if any; an error if the connection is gone.
    fn read(&mut self) -> io::Result<Vec<u8>> {
        let stream: &mut dyn Read = match self {
            Self::Plain(stream) => {
                stream.set_read_timeout(Some(GLANCE))?;
                stream
            }
            Self::Encrypted(stream) => {
                stream.sock.set_read_timeout(Some(GLANCE))?;
                stream
            }
            Self::Datagrams(_) | Self::File(_) | Self::Stdout => return Ok(Vec::new()),
        };
        let mut heard = Vec::new();
        let mut piece = vec![0; PIECE];
        for _ in 0..MOST_PIECES {
            match stream.read(&mut piece) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(length) => heard.extend(&piece[..length]),
                Err(error) if is_silence(&error) => break,
                Err(error) => return Err(error),
            }
        }
        Ok(heard)
    }
}

/// Whether an error only means that no data came in time.
fn is_silence(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut)
}

fn resolve(address: &str) -> io::Result<SocketAddr> {
    address.to_socket_addrs()?.next().ok_or_else(|| io::Error::other("it has no address"))
}

fn connect(address: &str) -> io::Result<TcpStream> {
    let stream = TcpStream::connect_timeout(&resolve(address)?, PATIENCE)?;
    stream.set_write_timeout(Some(PATIENCE))?;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// Keeps a connection to the receiver open, and sends what there is to send.
pub struct Carrier {
    destination: Destination,
    tls: Option<TlsClient>,
    way: Option<Connection>,
    /// When the connection was last opened or tried to be opened.
    tried_at: Option<Instant>,
    complained_at: Option<Instant>,
    /// Whether the last write succeeded.
    goes_through: bool,
    messages: u64,
}

impl Carrier {
    pub fn new(destination: Destination, tls: Option<TlsClient>) -> Self {
        Self {
            destination,
            tls,
            way: None,
            tried_at: None,
            complained_at: None,
            goes_through: false,
            messages: 0,
        }
    }

    /// Number of messages sent.
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// Reads what the receiver has sent. A receiver that does not accept the registration in time
    /// is disconnected.
    ///
    /// # Errors
    /// As [`Self::say`].
    pub fn listen(&mut self, outlet: &mut dyn Outlet) -> anyhow::Result<()> {
        let Some(way) = &mut self.way else { return Ok(()) };
        let heard = way.read().and_then(|said| outlet.heard(&said).map_err(io::Error::other));
        let is_late = !outlet.is_ready() && self.tried_at.is_some_and(|at| at.elapsed() > WELCOME);
        self.mind(heard.and_then(|()| match is_late {
            true => Err(io::Error::other("it has not accepted the registration")),
            false => Ok(()),
        }))
    }

    /// Sends what has been heard since the last time, if the receiver is present and takes it.
    ///
    /// # Errors
    /// If trying again is useless: a file or a pipe that takes no more.
    pub fn say(&mut self, outlet: &mut dyn Outlet, heard: &mut OutletNews) -> anyhow::Result<()> {
        let said = self.try_to_say(outlet, heard);
        self.mind(said)
    }

    fn try_to_say(&mut self, outlet: &mut dyn Outlet, heard: &mut OutletNews) -> io::Result<()> {
        if self.way.is_none() {
            if self.tried_at.is_some_and(|at| at.elapsed() < RETRY) {
                return Ok(());
            }
            self.tried_at = Some(Instant::now());
            self.way = Some(Connection::open(&self.destination, self.tls.as_ref())?);
            self.put(outlet.greeting(Timestamp::from_seconds(wall_seconds())))?;
        }
        if !outlet.is_ready() {
            return Ok(());
        }
        self.put(heard.events.iter().flat_map(|event| outlet.event(event)).collect())?;
        heard.events.clear();
        match heard.snapshot() {
            Some(snapshot) => self.put(outlet.tracks(&snapshot)),
            None => Ok(()),
        }
    }

    fn put(&mut self, messages: Vec<Vec<u8>>) -> io::Result<()> {
        let Some(way) = &mut self.way else { return Ok(()) };
        for message in messages {
            way.write(&message)?;
            self.messages += 1;
            if !std::mem::replace(&mut self.goes_through, true) && self.complained_at.is_some() {
                tracing::info!("{} takes what is said again", self.destination);
            }
        }
        Ok(())
    }

    /// Handles an error: where the receiver may come back, another try, with a log line now and
    /// then.
    fn mind(&mut self, done: io::Result<()>) -> anyhow::Result<()> {
        let Err(error) = done else { return Ok(()) };
        (self.way, self.goes_through) = (None, false);
        if matches!(self.destination, Destination::File(_) | Destination::Stdout) {
            return Err(error).with_context(|| format!("cannot write to {}", self.destination));
        }
        if self.complained_at.is_none_or(|at| at.elapsed() >= REMINDER) {
            self.complained_at = Some(Instant::now());
            tracing::warn!("{}: {error}; trying again", self.destination);
        }
        Ok(())
    }

    /// Sends the outlet's farewell.
    pub fn finish(&mut self, outlet: &mut dyn Outlet) -> anyhow::Result<()> {
        let last = self.put(outlet.farewell(Timestamp::from_seconds(wall_seconds())));
        self.mind(last)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn destinations_are_read_as_they_are_written() {
        for text in ["udp://239.2.3.1:6969", "tcp://[::1]:8087", "tls://tak.example:8089"] {
            assert_eq!(text.parse::<Destination>().unwrap().to_string(), text);
        }
        assert_eq!("-".parse(), Ok(Destination::Stdout));
        assert_eq!("out.jsonl".parse(), Ok(Destination::File("out.jsonl".into())));
        assert!("udp://10.0.0.1".parse::<Destination>().is_err());
        assert!("http://10.0.0.1:80".parse::<Destination>().is_err());
    }
}
