//! A scene's cameras as network cameras.

use std::net::SocketAddr;

use anyhow::{Context, anyhow};
use crossfix_message::Timestamp;
use crossfix_simulation::{SimulatedCamera, World};
use crossfix_video::{H264Encoder, RtspServer, ServedStream};

use crate::output;
use crate::pace::Pace;
use crate::shutdown::Shutdown;

/// Time between the server's start and the first frame, s: clients should connect before it. With
/// half of it those that take longer miss the first frames.
pub const RUN_UP_S: f64 = 1.0;
/// When a camera first reports what its clock shows, s after its start, as real cameras do. With
/// half of it clocks would be known sooner than real ones are.
const FIRST_REPORT_S: f64 = 2.5;
/// Interval of further reports, s, like that of real cameras. With half of it clocks would be
/// followed more closely than real ones are.
const REPORT_EVERY_S: f64 = 5.0;
/// Ticks per second of a stream's time stamps, Hz.
const TICKS_HZ: f64 = 90_000.0;

/// Plays a scene from a time to its end, with one stream per camera.
pub fn play(
    world: &World,
    address: SocketAddr,
    begins: Timestamp,
    shutdown: &Shutdown,
) -> anyhow::Result<()> {
    let mut server =
        RtspServer::bind(address, None).with_context(|| format!("cannot listen at {address}"))?;
    let pace = Pace::beginning_at(begins.seconds(), 1.0);
    let mounted: Vec<(&SimulatedCamera, ServedStream)> = world
        .cameras()
        .iter()
        .map(|camera| (camera, server.mount(camera.name().as_str())))
        .collect();
    for (camera, _) in &mounted {
        output::line(format!("rtsp://{}/{}", server.address(), camera.name()));
    }
    std::thread::scope(|scope| {
        let threads: Vec<_> = mounted
            .iter()
            .map(|(camera, mount)| scope.spawn(|| film(camera, mount, begins, pace, shutdown)))
            .collect();
        threads.into_iter().try_for_each(|thread| {
            thread.join().map_err(|_| anyhow!("a camera has failed")).and_then(|filmed| filmed)
        })
    })
}

/// Streams what one camera sees, each frame at its time of exposure.
fn film(
    camera: &SimulatedCamera,
    mount: &ServedStream,
    begins: Timestamp,
    pace: Pace,
    shutdown: &Shutdown,
) -> anyhow::Result<()> {
    let description = camera.description();
    let mut encoder = H264Encoder::new(description.rate_hz).map_err(|what| anyhow!(what))?;
    let mut next_report_s = FIRST_REPORT_S;
    for index in 0..camera.frames() {
        // An exposure ends half its length after the frame's time.
        let exposed_s = camera.true_time(index) + description.exposure_s / 2.0;
        if !mount.is_watched() {
            if pace.wait(exposed_s, shutdown) {
                continue;
            }
            break;
        }
        // The frame is rendered and encoded before its time of exposure, so that the time this
        // takes is not attributed to the receivers.
        let frame = camera.frame(index);
        let unit = encoder
            .encode(&frame.brightness, frame.width, frame.height)
            .map_err(|what| anyhow!("camera `{}`: {what}", camera.name()))?;
        if !pace.wait(exposed_s, shutdown) {
            break;
        }
        // A camera's tick count begins anywhere and wraps around at 2^32.
        let ticks = (frame.own_s * TICKS_HZ).round() as i64 as u32;
        mount.send(&unit, ticks);
        if exposed_s >= next_report_s {
            mount.report(begins.plus_seconds(frame.own_s), ticks);
            next_report_s = exposed_s + REPORT_EVERY_S;
        }
    }
    Ok(())
}
