//! Streams of network cameras (RTSP).

mod address;
mod packets;
mod server;

use std::collections::{BTreeMap, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::StreamExt;
use retina::client::{
    Credentials, Demuxed, PlayOptions, Session, SessionGroup, SessionOptions, SetupOptions,
    TcpTransportOptions, Transport, UdpTransportOptions,
};
use retina::codec::{CodecItem, FrameFormat, VideoFrame};
use retina::rtcp::{ReceivedCompoundPacket, TypedPacketRef};
use tokio::runtime::Runtime;

pub use self::address::{Login, StreamAddress};
pub use self::server::{RtspServer, ServedStream};

#[cfg(feature = "gstreamer")]
use crate::gstreamer::H265Decoder;
use crate::h264::{DecodedPicture, H264Decoder};
use crate::live::SILENCE;
use crate::stream_clock::{ClockMemory, HostClock, SET_S, StreamClock, unix_time};
use crate::{Arrival, Frame, FrameSource, Still, TimedBy, VideoError, decode_still};

/// Codecs that are decoded, as session descriptions name them. A stream of another one is refused.
const DECODED: &[&str] =
    if cfg!(feature = "gstreamer") { &["h264", "h265", "jpeg"] } else { &["h264", "jpeg"] };
/// How long a camera may take to answer before it is given up. With half of it a camera that takes
/// three seconds to begin is never seen; with twice as much each try of one that is gone takes ten.
const ANSWER: Duration = Duration::from_secs(5);
/// How long closing the session may take. With half of it a camera that answers in 150 ms may keep
/// the session, and have no room for the next client.
const FAREWELL: Duration = Duration::from_millis(200);
/// A slow stream may pause for this many times its longest recent interval. With half of it a slow
/// stream counts as silent as soon as one frame is missing.
const INTERVALS: u32 = 3;
/// Number of recent intervals of which the longest counts. With half of it a pause that comes
/// with every sixth frame is forgotten before the next.
const REMEMBERED_INTERVALS: usize = 8;
/// A stream of which nothing could be decoded for this long is reopened: longer than the time
/// between two key pictures of any camera. With half of it a stream with a key picture every 20 s
/// may be reopened before anything of it is seen.
const UNDECODED: Duration = Duration::from_secs(30);
/// Most units whose arrival is kept while the decoder holds their pictures back. With half of it
/// the same.
const MOST_ARRIVALS: usize = 64;

/// How a stream is transported.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RtspTransport {
    /// Within the RTSP connection: lost packets are sent again, so nothing is missing but some
    /// comes late.
    #[default]
    Tcp,
    /// In datagrams: a lost packet is not sent again, and all pictures that need it are lost too.
    Udp,
}

/// A stream to watch, and how.
#[derive(Clone, Debug)]
pub struct RtspOptions {
    /// Address of the stream.
    pub address: StreamAddress,
    /// User and password, if the camera requires them.
    pub login: Option<Login>,
    /// How the stream is transported.
    pub transport: RtspTransport,
    /// Whether the camera's clock reports are believed; otherwise frames are timed by their
    /// arrival.
    pub heeds_reports: bool,
    /// Delay from the exposure to the arrival.
    pub latency: StreamLatency,
}

impl RtspOptions {
    /// An error of this stream.
    fn wrong(&self, what: String) -> VideoError {
        VideoError::Stream { url: self.address.to_string(), what }
    }
}

/// Delay from the exposure of a frame to its arrival.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StreamLatency {
    /// The mean, s.
    pub mean_s: f64,
    /// Standard deviation of the latency, s. It is also used where the camera reports its clock, as
    /// some cameras report when they sent a frame and not when they took it.
    pub sd_s: f64,
}

impl Default for StreamLatency {
    /// Typical of cameras of many makes, which take 50 to 300 ms.
    fn default() -> Self {
        Self { mean_s: 0.1, sd_s: 0.1 }
    }
}

/// A network camera, whose stream can be opened again and again.
#[derive(Clone, Debug)]
pub struct RtspCamera {
    options: RtspOptions,
    memory: ClockMemory,
}

impl RtspCamera {
    /// A camera that is watched with these options.
    pub fn new(options: RtspOptions) -> Self {
        Self { options, memory: ClockMemory::default() }
    }

    /// Its address, without user and password.
    pub fn address(&self) -> String {
        self.options.address.to_string()
    }

    /// Opens its stream. `silence` is how long it may send nothing; a stream whose frames come
    /// slowly may pause for three of their intervals.
    ///
    /// # Errors
    /// [`VideoError::Stream`] if nobody answers, the camera refuses, or it has no video that can be
    /// decoded.
    pub fn open(&self, silence: Duration) -> Result<RtspSource, VideoError> {
        RtspSource::open(&self.options, self.memory.clone(), silence)
    }
}

/// A network camera's stream, H.264 or Motion JPEG, over RTSP, until it ends or falls silent.
///
/// Capture times are by the camera's clock as its sender reports state it (RFC 3550, 6.4.1), and by
/// arrival until the first report comes, which takes some seconds.
pub struct RtspSource {
    runtime: Runtime,
    /// Always there until this is dropped.
    stream: Option<Demuxed>,
    sessions: Arc<SessionGroup>,
    stream_id: usize,
    codec: Codec,
    url: String,
    clock: StreamClock,
    host: HostClock,
    begun: Instant,
    /// How long the stream may be silent.
    silence: Duration,
    /// When the last frame arrived, ...
    last: Option<Instant>,
    /// ... and the last one that could be decoded.
    pictured: Instant,
    /// The last intervals between frames.
    intervals: VecDeque<Duration>,
    /// Arrival of the units whose pictures have not come out yet, by their stream time, ticks.
    arrivals: BTreeMap<i64, Instant>,
    /// A packet was lost: pictures cannot be decoded until the next key picture.
    torn: bool,
    next: u64,
    /// Frames that came out together with the frame before them.
    ready: VecDeque<Frame>,
}

/// A picture that has come out of a decoder.
struct Decoded {
    /// Its stream time, ticks.
    ticks: i64,
    image: Still,
}

impl From<DecodedPicture> for Decoded {
    fn from(picture: DecodedPicture) -> Self {
        Self { ticks: picture.shown_at, image: picture.into_still() }
    }
}

enum Codec {
    H264(Box<H264Decoder>),
    #[cfg(feature = "gstreamer")]
    H265(H265Decoder),
    MotionJpeg,
}

impl RtspSource {
    fn open(
        options: &RtspOptions,
        memory: ClockMemory,
        silence: Duration,
    ) -> Result<Self, VideoError> {
        let url = options.address.to_string();
        let wrong = |what: String| options.wrong(what);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|error| wrong(error.to_string()))?;
        let sessions = Arc::new(SessionGroup::default());
        let connected = unharmed(&url, || {
            let answer = async { tokio::time::timeout(ANSWER, connect(options, &sessions)).await };
            runtime.block_on(answer).unwrap_or_else(|_| {
                Err(wrong(format!("it does not answer within {} s", ANSWER.as_secs())))
            })
        });
        if connected.is_err() {
            // The camera may have reserved a place for this client: the session is closed.
            runtime.block_on(async {
                let _ = tokio::time::timeout(FAREWELL, sessions.await_teardown()).await;
            });
        }
        let RtspConnection { stream, stream_id, codec } = connected?;
        let host = HostClock::read();
        Ok(Self {
            runtime,
            stream: Some(stream),
            sessions,
            stream_id,
            codec,
            url,
            clock: StreamClock::new(host, options.latency, options.heeds_reports, memory),
            host,
            begun: Instant::now(),
            silence,
            last: None,
            pictured: Instant::now(),
            intervals: VecDeque::new(),
            arrivals: BTreeMap::new(),
            torn: false,
            next: 0,
            ready: VecDeque::new(),
        })
    }

    /// How long the stream may pause before it counts as silent.
    fn patience(&self) -> Duration {
        let slowest = self.intervals.iter().max();
        slowest.map_or(self.silence, |slowest| SILENCE.max(*slowest * INTERVALS))
    }

    /// Notes when a frame has come.
    fn note_arrival(&mut self, at: Instant) {
        if let Some(last) = self.last.replace(at) {
            self.intervals.push_back(at.saturating_duration_since(last));
            if self.intervals.len() > REMEMBERED_INTERVALS {
                self.intervals.pop_front();
            }
        }
    }

    /// The next packet of frames or reports.
    fn receive(&mut self) -> Result<Option<CodecItem>, VideoError> {
        let patience = self.patience();
        // The wait counts from the last frame: a clock report does not prolong it.
        let silent = self.last.unwrap_or(self.begun).elapsed();
        let left = patience.saturating_sub(silent);
        let Some(stream) = &mut self.stream else {
            return Ok(None);
        };
        let url = || self.url.clone();
        unharmed(&self.url, || {
            let item =
                self.runtime.block_on(async { tokio::time::timeout(left, stream.next()).await });
            let seconds = patience.as_secs_f64();
            let item = item.map_err(|_| VideoError::Silent { url: url(), seconds })?;
            let what = |error: retina::Error| first_line(&error.to_string());
            item.transpose().map_err(|error| VideoError::Stream { url: url(), what: what(error) })
        })
    }

    /// Decodes a unit and puts the frames that come out into `ready`; none if its picture comes out
    /// later.
    fn take(&mut self, unit: &VideoFrame) -> Result<(), VideoError> {
        let at = unit.end_ctx().received();
        self.note_arrival(at);
        if at.saturating_duration_since(self.pictured) > UNDECODED {
            return Err(VideoError::Stream {
                url: self.url.clone(),
                what: format!("nothing of {} s could be decoded", UNDECODED.as_secs()),
            });
        }
        for decoded in self.decode(unit, at)? {
            let frame = self.frame(unit, decoded, at)?;
            self.ready.push_back(frame);
        }
        while self.arrivals.len() > MOST_ARRIVALS {
            self.arrivals.pop_first();
        }
        Ok(())
    }

    /// A frame of a picture that came out after a unit had arrived at `at`.
    fn frame(
        &mut self,
        unit: &VideoFrame,
        Decoded { ticks, image }: Decoded,
        at: Instant,
    ) -> Result<Frame, VideoError> {
        let index = self.next;
        self.next += 1;
        self.pictured = at;
        let at = self.arrivals.remove(&ticks).unwrap_or(at);
        self.arrivals.retain(|&waiting, _| waiting > ticks);
        let stream_s = ticks as f64 / f64::from(unit.timestamp().clock_rate().get());
        let (capture, timed_by) = self.clock.time(stream_s, self.host.since_s(at));
        let set_by_s = self.host.set_by_s(&HostClock::read());
        if timed_by != TimedBy::Camera && set_by_s.abs() > SET_S {
            return Err(VideoError::HostClockSet { by_s: set_by_s });
        }
        let live = Some(Arrival { at, stream_s, timed_by });
        let Still { width, height, pixels } = image;
        Ok(Frame { index, capture, live, width, height, pixels })
    }

    /// The pictures that come out after a unit.
    fn decode(&mut self, unit: &VideoFrame, at: Instant) -> Result<Vec<Decoded>, VideoError> {
        let is_whole = unit.loss() == 0;
        self.torn = !is_whole || self.torn && !unit.is_random_access_point();
        let ticks = unit.timestamp().timestamp();
        self.arrivals.insert(ticks, at);
        let decoded = match &mut self.codec {
            _ if self.torn => Err("packets were lost on the way".to_owned()),
            Codec::H264(decoder) => {
                let picture = decoder.decode(unit.data(), ticks);
                picture.map(|picture| picture.map(Decoded::from).into_iter().collect())
            }
            #[cfg(feature = "gstreamer")]
            Codec::H265(decoder) => decoder
                .decode(unit.data(), ticks)
                .map(|pictures| pictures.into_iter().map(Decoded::from).collect()),
            Codec::MotionJpeg => {
                decode_still(unit.data()).map(|image| vec![Decoded { ticks, image }])
            }
        };
        decoded.map_err(|what| {
            self.arrivals.remove(&ticks);
            let index = self.next;
            self.next += 1;
            VideoError::StreamFrame { url: self.url.clone(), index, what }
        })
    }

    /// Takes in the camera's reports of its clock.
    fn heed(&mut self, reports: &ReceivedCompoundPacket) {
        let of_stream = reports.stream_id() == self.stream_id;
        let Some(time) = reports.rtp_timestamp().filter(|_| of_stream) else {
            return;
        };
        for report in reports.pkts() {
            if let Ok(Some(TypedPacketRef::SenderReport(report))) = report.as_typed() {
                let stream_s = time.timestamp() as f64 / f64::from(time.clock_rate().get());
                if let Some(shown) = unix_time(report.ntp_timestamp().0) {
                    self.clock.report(stream_s, shown);
                }
            }
        }
    }
}

/// Runs `read` and turns a panic into a stream error: what a camera sends can make the libraries
/// that read it panic (a line without `=` in a session's description does).
fn unharmed<T>(url: &str, read: impl FnOnce() -> Result<T, VideoError>) -> Result<T, VideoError> {
    catch_unwind(AssertUnwindSafe(read)).unwrap_or_else(|panic| {
        let said = panic.downcast_ref::<String>().map(String::as_str);
        let said = said.or(panic.downcast_ref::<&str>().copied()).unwrap_or("without a word");
        let what = format!("what it sends cannot be read ({})", said.replace('\n', " "));
        Err(VideoError::Stream { url: url.to_owned(), what })
    })
}

/// The part of a protocol error that is worth showing: further lines hold the details of the
/// connection.
fn first_line(text: &str) -> String {
    text.lines().next().unwrap_or_default().to_owned()
}

/// What is wrong with a camera that offers only streams that are not decoded.
fn no_codec(offered: &[String]) -> String {
    format!(
        "it offers no H.264 or Motion JPEG (it offers {}): set the camera to H.264, or build with \
         --features gstreamer for H.265",
        offered.join(", ")
    )
}

/// What a camera's refusal means, in words for people.
fn refusal(options: &RtspOptions, error: &retina::Error) -> VideoError {
    // What follows the `?` of an address may be a password, so it is replaced.
    let query = options.address.url().query().map(|query| format!("?{query}"));
    let said = first_line(&error.to_string()).replace(query.as_deref().unwrap_or("\n"), "?...");
    options.wrong(match error.status_code() {
        Some(401 | 403) => return VideoError::Refused { url: options.address.to_string() },
        Some(404 | 454) => "the camera is there but has no stream at this path".to_owned(),
        Some(461) => {
            format!("the camera does not send this way, try the other `transport` ({said})")
        }
        Some(503 | 453) => format!("the camera has no room for one more who watches ({said})"),
        _ => said,
    })
}

/// A stream that plays.
struct RtspConnection {
    stream: Demuxed,
    /// Its number in the session.
    stream_id: usize,
    codec: Codec,
}

async fn connect(
    options: &RtspOptions,
    sessions: &Arc<SessionGroup>,
) -> Result<RtspConnection, VideoError> {
    let credentials = options.login.as_ref().map(|login| Credentials {
        username: login.user().to_owned(),
        password: login.password().to_owned(),
    });
    let session = SessionOptions::default()
        .creds(credentials)
        .session_group(Arc::clone(sessions))
        .user_agent("crossfix".to_owned());
    let mut session = Session::describe(options.address.url().clone(), session)
        .await
        .map_err(|error| refusal(options, &error))?;
    let offered: Vec<String> = session
        .streams()
        .iter()
        .map(|stream| format!("{} {}", stream.media(), stream.encoding_name()))
        .collect();
    let refusal = |error: retina::Error| refusal(options, &error);
    let found = session
        .streams()
        .iter()
        .position(|stream| stream.media() == "video" && DECODED.contains(&stream.encoding_name()));
    let stream_id = found.ok_or_else(|| options.wrong(no_codec(&offered)))?;
    let codec = match session.streams()[stream_id].encoding_name() {
        "h264" => {
            Codec::H264(Box::new(H264Decoder::of_stream().map_err(|what| options.wrong(what))?))
        }
        #[cfg(feature = "gstreamer")]
        "h265" => Codec::H265(H265Decoder::new().map_err(|what| options.wrong(what))?),
        _ => Codec::MotionJpeg,
    };
    let transport = match options.transport {
        RtspTransport::Tcp => Transport::Tcp(TcpTransportOptions::default()),
        RtspTransport::Udp => Transport::Udp(UdpTransportOptions::default()),
    };
    let setup = SetupOptions::default().transport(transport).frame_format(FrameFormat::SIMPLE);
    session.setup(stream_id, setup).await.map_err(refusal)?;
    let playing = session.play(PlayOptions::default()).await.map_err(refusal)?;
    let stream = playing.demuxed().map_err(refusal)?;
    Ok(RtspConnection { stream, stream_id, codec })
}

impl Drop for RtspSource {
    /// Closes the session: many cameras have room for only a few clients.
    fn drop(&mut self) {
        let _guard = self.runtime.enter();
        drop(self.stream.take());
        self.runtime.block_on(async {
            // A camera that is gone does not answer, so there is a time limit.
            let _ = tokio::time::timeout(FAREWELL, self.sessions.await_teardown()).await;
        });
    }
}

impl FrameSource for RtspSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        if let Some(frame) = self.ready.pop_front() {
            return Ok(Some(frame));
        }
        while let Some(item) = self.receive()? {
            match item {
                CodecItem::VideoFrame(unit) => {
                    self.take(&unit)?;
                    if let Some(frame) = self.ready.pop_front() {
                        return Ok(Some(frame));
                    }
                }
                CodecItem::Rtcp(reports) => self.heed(&reports),
                _ => {}
            }
        }
        Ok(None)
    }
}
