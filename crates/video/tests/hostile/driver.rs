//! A network camera that answers with any bytes.
//!
//! A line `---` ends an answer: each is given to one request, and the last one ends the connection.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::Duration;

use crossfix_video::{
    FrameSource, RtspCamera, RtspOptions, RtspTransport, StreamAddress, StreamLatency, VideoError,
};

/// Whoever waits longer than this for what nobody sends has been forgotten.
const PATIENCE: Duration = Duration::from_millis(200);
/// More frames are not taken of one stream.
const MOST_FRAMES: usize = 50;
/// Every camera has an address of its own, so that no port is used up.
static CAMERAS: AtomicU16 = AtomicU16::new(1);

/// Watches a camera that says so: how many frames it showed, and what ended it.
pub fn drive(data: &[u8]) -> (usize, Option<VideoError>) {
    let [high, low] = CAMERAS.fetch_add(1, Ordering::Relaxed).to_be_bytes();
    let listener = TcpListener::bind((Ipv4Addr::new(127, 77, high, low), 0)).expect("a port");
    let place = listener.local_addr().expect("an address");
    let (address, login) =
        StreamAddress::parse(&format!("rtsp://{place}/live")).expect("an address of a stream");
    std::thread::scope(|scope| {
        scope.spawn(move || {
            // Nobody listens any more to one who takes leave in a connection of its own.
            let accepted = listener.accept();
            drop(listener);
            accepted.and_then(|(connection, _)| answer(connection, data))
        });
        let seen = watch(RtspOptions {
            address,
            login,
            transport: RtspTransport::Tcp,
            heeds_reports: true,
            latency: StreamLatency::default(),
        });
        // If nobody has called, the camera waits for ever.
        drop(TcpStream::connect(place));
        seen
    })
}

fn watch(options: RtspOptions) -> (usize, Option<VideoError>) {
    let mut source = match RtspCamera::new(options).open(PATIENCE) {
        Ok(source) => source,
        Err(error) => return (0, Some(error)),
    };
    let mut frames = 0;
    for _ in 0..MOST_FRAMES {
        match source.next_frame() {
            Ok(Some(_)) => frames += 1,
            Ok(None) => break,
            Err(error) if error.is_one_frame() => {}
            Err(error) => return (frames, Some(error)),
        }
    }
    (frames, None)
}

fn answer(mut connection: TcpStream, data: &[u8]) -> std::io::Result<()> {
    connection.set_read_timeout(Some(PATIENCE))?;
    let mut rest = data;
    while !rest.is_empty() {
        let mut request = Vec::new();
        let mut byte = [0];
        while !request.ends_with(b"\r\n\r\n") {
            connection.read_exact(&mut byte)?;
            request.push(byte[0]);
        }
        let separator = rest.windows(5).position(|window| window == b"\n---\n");
        let (reply, after) = match separator {
            Some(at) => (&rest[..at], &rest[at + 5..]),
            None => (rest, &[][..]),
        };
        connection.write_all(reply)?;
        rest = after;
    }
    connection.shutdown(std::net::Shutdown::Write)
}
