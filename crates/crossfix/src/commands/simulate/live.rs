//! A scene's cameras as network cameras.

use std::net::SocketAddr;

use anyhow::{Context, anyhow};
use crossfix_message::Timestamp;
use crossfix_simulation::{SimulatedCamera, World};
use crossfix_video::{H264Encoder, Mount, RtspServer};

use crate::output;
use crate::pace::Pace;
use crate::shutdown::Shutdown;

/// Time between the server's coming up and the first frame, s: to be asked before it.
pub const RUN_UP_S: f64 = 1.0;
/// A camera says what its clock shows for the first time after so long, and then again and again, s:
/// as cameras do.
const FIRST_REPORT_S: f64 = 2.5;
const REPORT_EVERY_S: f64 = 5.0;
/// What a stream counts a second.
const TICKS_HZ: f64 = 90_000.0;

/// Plays a scene that begins at a time, a stream a camera, to its end.
pub fn play(
    world: &World,
    address: SocketAddr,
    begins: Timestamp,
    shutdown: &Shutdown,
) -> anyhow::Result<()> {
    let mut server =
        RtspServer::bind(address, None).with_context(|| format!("cannot listen at {address}"))?;
    let pace = Pace::beginning_at(begins.seconds(), 1.0);
    let mounted: Vec<(&SimulatedCamera, Mount)> = world
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

/// Plays what one camera sees, at its own time of exposure.
fn film(
    camera: &SimulatedCamera,
    mount: &Mount,
    begins: Timestamp,
    pace: Pace,
    shutdown: &Shutdown,
) -> anyhow::Result<()> {
    let description = camera.description();
    let mut encoder = H264Encoder::new(description.rate_hz).map_err(|what| anyhow!(what))?;
    let mut next_report_s = FIRST_REPORT_S;
    for index in 0..camera.frames() {
        // It is exposed up to half its exposure after its time.
        let exposed_s = camera.true_time(index) + description.exposure_s / 2.0;
        if !mount.is_watched() {
            if pace.wait(exposed_s, shutdown) {
                continue;
            }
            break;
        }
        // It is drawn and encoded before it is exposed, so that what takes time here is not taken for what
        // those take who watch.
        let frame = camera.frame(index);
        let unit = encoder
            .encode(&frame.brightness, frame.width, frame.height)
            .map_err(|what| anyhow!("camera `{}`: {what}", camera.name()))?;
        if !pace.wait(exposed_s, shutdown) {
            break;
        }
        // Any camera's count begins anywhere and turns over.
        let ticks = (frame.own_s * TICKS_HZ).round() as i64 as u32;
        mount.send(&unit, ticks);
        if exposed_s >= next_report_s {
            mount.report(begins.plus_seconds(frame.own_s), ticks);
            next_report_s = exposed_s + REPORT_EVERY_S;
        }
    }
    Ok(())
}
