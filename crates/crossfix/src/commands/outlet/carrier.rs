//! What carries an outlet's bytes: datagrams, streams, files.

use std::fmt;
use std::fs::File;
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs, UdpSocket};
use std::path::PathBuf;
use std::str::FromStr;
use std::time::{Duration, Instant};

use crossfix_message::Timestamp;
use crossfix_outlet::Outlet;

use super::Heard;
use super::tls::{TlsClient, TlsStream};
use crate::pace::wall_seconds;

/// How long the other side may take to answer, or to take a message: the site's messages wait
/// meanwhile, and are not lost.
const PATIENCE: Duration = Duration::from_secs(2);
/// The pause after a connection that failed.
const RETRY: Duration = Duration::from_secs(1);
/// How often it is said that nobody is there.
const REMINDER: Duration = Duration::from_secs(60);
/// Looking whether the other side has said something takes so long.
const GLANCE: Duration = Duration::from_millis(1);
/// What it says at once, bytes; the rest is read the next time.
const HEARD_AT_ONCE: usize = 64 << 10;

/// Where an outlet's bytes go.
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

/// An open way to the other side.
enum Way {
    Datagrams(UdpSocket),
    Plain(TcpStream),
    Encrypted(Box<TlsStream>),
    File(File),
    Stdout,
}

impl Way {
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
            Destination::File(path) => Self::File(File::create(path)?),
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

    /// What the other side has said, if it has; an error if it is gone.
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
        let mut heard = vec![0; HEARD_AT_ONCE];
        match stream.read(&mut heard) {
            Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(length) => {
                heard.truncate(length);
                Ok(heard)
            }
            Err(error)
                if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) =>
            {
                Ok(Vec::new())
            }
            Err(error) => Err(error),
        }
    }
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

/// Keeps a way to the other side open and says what there is to say.
pub struct Carrier {
    destination: Destination,
    tls: Option<TlsClient>,
    way: Option<Way>,
    tried_at: Option<Instant>,
    complained_at: Option<Instant>,
    messages: u64,
}

impl Carrier {
    pub fn new(destination: Destination, tls: Option<TlsClient>) -> Self {
        let (way, tried_at, complained_at) = (None, None, None);
        Self { destination, tls, way, tried_at, complained_at, messages: 0 }
    }

    /// Messages that have gone out.
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// Says what has been heard since the last time, if the other side is there and takes it.
    pub fn say(&mut self, outlet: &mut dyn Outlet, heard: &mut Heard) {
        if let Err(error) = self.try_to_say(outlet, heard) {
            self.way = None;
            self.complain(&error);
        }
    }

    fn try_to_say(&mut self, outlet: &mut dyn Outlet, heard: &mut Heard) -> io::Result<()> {
        if self.way.is_none() {
            if self.tried_at.is_some_and(|at| at.elapsed() < RETRY) {
                return Ok(());
            }
            self.tried_at = Some(Instant::now());
            self.way = Some(Way::open(&self.destination, self.tls.as_ref())?);
            self.put(outlet.greeting(Timestamp::from_seconds(wall_seconds())))?;
            if self.complained_at.take().is_some() {
                tracing::info!("{} is there again", self.destination);
            }
        }
        if let Some(way) = &mut self.way {
            let said = way.read()?;
            outlet.heard(&said).map_err(io::Error::other)?;
        }
        if !outlet.is_ready() {
            return Ok(());
        }
        let events = std::mem::take(&mut heard.events);
        self.put(events.iter().flat_map(|event| outlet.event(event)).collect())?;
        match heard.situation.snapshot() {
            Some(snapshot) => self.put(outlet.tracks(&snapshot)),
            None => Ok(()),
        }
    }

    fn put(&mut self, messages: Vec<Vec<u8>>) -> io::Result<()> {
        let Some(way) = &mut self.way else { return Ok(()) };
        for message in messages {
            way.write(&message)?;
            self.messages += 1;
        }
        Ok(())
    }

    fn complain(&mut self, error: &io::Error) {
        if self.complained_at.is_none_or(|at| at.elapsed() >= REMINDER) {
            self.complained_at = Some(Instant::now());
            tracing::warn!("{}: {error}; trying again", self.destination);
        }
    }

    /// Says goodbye.
    pub fn finish(&mut self, outlet: &mut dyn Outlet) {
        let last = outlet.farewell(Timestamp::from_seconds(wall_seconds()));
        if let Err(error) = self.put(last) {
            self.complain(&error);
        }
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
