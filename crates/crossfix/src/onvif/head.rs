//! A network camera's mount, and where it reports that it points.
//!
//! An ONVIF mount gets a position and goes there in its own time; asked, it reports where it is
//! and whether it moves, a network delay later. So its report is valid for an image only if it has
//! stood still for as long as an image takes to arrive; until then no image has a known direction.

use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::Context;
use crossfix_geometry::ScanAngles;
use crossfix_video::Login;
use tokio::sync::oneshot;
use url::Url;

use super::{Device, answered, runtime};
use crate::config::OnvifConfig;
use crate::repeats::Repeats;
use crate::seeker::{Mount, Pointed};

/// Interval at which the mount is asked for its position. Asking twice as often burdens a camera's
/// small processor; half as often makes each turn a tenth of a second longer.
const ASKED_EVERY: Duration = Duration::from_millis(100);
/// Longest time from an exposure through encoder, network and decoder to its image here. If a
/// camera takes longer, images of a turn are attributed to the place where the turn ended.
const IMAGE_COMES_WITHIN: Duration = Duration::from_millis(500);
/// A report older than this no longer says where the mount is. With half of it an answer that
/// takes half a second leaves images without a direction; with twice as much a mount that answers
/// no more still gives them one for two seconds.
const SAID_HOLDS: Duration = Duration::from_secs(1);
/// If the mount has not moved this long after an order, it counts as having gone as far as it can.
/// With half of it one that takes longer to begin would get the order again.
const BEGINS_WITHIN: Duration = Duration::from_secs(1);
/// A mount that has refused to turn is not asked again for this long, so that its camera can see
/// meanwhile. With half of it the camera would be kept from seeing twice as often.
const ASKED_TO_TURN_AGAIN: Duration = Duration::from_secs(5);
/// Positions within this many SDs of the angles count as the same: it has arrived, or stands still.
/// With half of it noise in its reports may keep it from ever standing still.
const SAME_SDS: f64 = 3.0;
/// Zooms that differ by more than this are different: on most lenses a hundredth is also one of
/// focal length. With twice as much images of a lens with another focal length would be used.
const SAME_ZOOM: f32 = 0.01;
/// First pause before a failed request is repeated; each further one is longer, as some cameras
/// lock out a client that fails too often. With half of it one more request fails.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Longest pause before a failed request is repeated. With twice as much a mount that is back may
/// be unknown for two minutes.
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

/// Angles of a mount as a function of the positions that it reports, each from -1 to 1.
#[derive(Clone, Copy, Debug)]
struct AngleScale {
    /// Azimuth at a pan of -1 and 1, rad.
    pan: [f64; 2],
    /// Elevation at a tilt of -1 and 1, rad.
    tilt: [f64; 2],
}

impl AngleScale {
    fn angles(&self, [pan, tilt]: [f32; 2]) -> ScanAngles {
        ScanAngles { azimuth: angle(self.pan, pan), elevation: angle(self.tilt, tilt) }
    }

    fn position(&self, angles: ScanAngles) -> [f32; 2] {
        [position(self.pan, angles.azimuth), position(self.tilt, angles.elevation)]
    }
}

/// The angle at a position from -1 to 1, given those at both ends.
fn angle([first, last]: [f64; 2], position: f32) -> f64 {
    first + (last - first) * (f64::from(position) + 1.0) / 2.0
}

/// The position, from -1 to 1, of an angle, given those at both ends.
fn position([first, last]: [f64; 2], angle: f64) -> f32 {
    (2.0 * (angle - first) / (last - first) - 1.0).clamp(-1.0, 1.0) as f32
}

/// An order to a mount to turn.
#[derive(Clone, Copy, Debug, PartialEq)]
struct TurnOrder {
    to: ScanAngles,
    /// When it was sent; `None` while it has not been.
    sent: Option<Instant>,
}

/// Where a mount points, by its reports.
#[derive(Clone, Copy, Debug)]
struct Head {
    /// Angles that differ by no more than this count as the same, rad.
    same_rad: f64,
    /// The last report, and when it came.
    said: Option<(ScanAngles, Instant)>,
    /// Where it has stood still, and since when.
    still: Option<(ScanAngles, Instant)>,
    order: Option<TurnOrder>,
    /// When it last refused to turn.
    refused: Option<Instant>,
}

impl Head {
    fn new(angle_sd_rad: f64) -> Self {
        Self {
            same_rad: SAME_SDS * angle_sd_rad,
            said: None,
            still: None,
            order: None,
            refused: None,
        }
    }

    fn order(&mut self, to: ScanAngles) {
        self.order = Some(TurnOrder { to, sent: None });
    }

    /// Whether it has not refused to turn recently.
    fn obeys(&self, now: Instant) -> bool {
        self.refused.is_none_or(|refused| now.duration_since(refused) > ASKED_TO_TURN_AGAIN)
    }

    /// Notes that the mount refused to turn: it goes on observing where it is.
    fn refuse(&mut self, now: Instant) {
        (self.order, self.refused) = (None, Some(now));
    }

    /// Notes that the order was sent, unless a newer order has replaced this one.
    fn told(&mut self, to: ScanAngles, now: Instant) {
        if let Some(order) = self.order.as_mut().filter(|order| order.to == to) {
            order.sent = Some(now);
        }
    }

    /// Whether reported angles are the same as others but for the reports' errors.
    fn is_at(&self, reported: ScanAngles, there: ScanAngles) -> bool {
        (reported.azimuth - there.azimuth).abs() <= self.same_rad
            && (reported.elevation - there.elevation).abs() <= self.same_rad
    }

    /// Takes in a report of where the mount is, and whether it moves.
    fn observe(&mut self, angles: ScanAngles, moves: bool, now: Instant) {
        let stays = !moves && self.still.is_some_and(|(there, _)| self.is_at(angles, there));
        if !stays {
            self.still = (!moves).then_some((angles, now));
        }
        self.said = Some((angles, now));
        let Some(TurnOrder { to, sent: Some(sent) }) = self.order else { return };
        if !stays {
            // It may stop short of its goal: the wait begins again where it stops.
            self.order = Some(TurnOrder { to, sent: Some(now) });
        } else if self.is_at(angles, to) || now.duration_since(sent) > BEGINS_WITHIN {
            self.order = None;
        }
    }

    /// Forgets the reports: the mount no longer answers, or its lens has been zoomed.
    fn lose(&mut self) {
        (self.said, self.still) = (None, None);
    }

    /// Where it pointed in the newest image.
    fn at(&self, now: Instant) -> Pointed {
        let said = self.said.filter(|(_, said)| now.duration_since(*said) < SAID_HOLDS);
        let Some((angles, _)) = said else { return Pointed::Unknown };
        let since = self.still.filter(|_| self.order.is_none()).map(|(_, since)| since);
        if since.is_some_and(|since| now.duration_since(since) > IMAGE_COMES_WITHIN) {
            Pointed::Settled(angles)
        } else {
            Pointed::Turning(angles)
        }
    }
}

/// What an agent and the thread that asks the mount share.
#[derive(Clone, Debug)]
struct SharedHead(Arc<Mutex<Head>>);

impl SharedHead {
    fn with<T>(&self, act: impl FnOnce(&mut Head) -> T) -> T {
        // A panic cannot leave the value half written.
        act(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// How to reach a mount, and how to interpret its answers.
struct Reach {
    address: Url,
    login: Option<Login>,
    scale: AngleScale,
    /// Zoom of the calibrated lens: as declared, or else as the mount first reports it.
    zoom: Option<f32>,
}

impl Reach {
    /// Whether the zoom differs from that of the calibrated lens.
    fn is_zoomed(&mut self, said: Option<f32>) -> bool {
        let Some(said) = said else { return false };
        (said - *self.zoom.get_or_insert(said)).abs() > SAME_ZOOM
    }
}

/// A mount controlled by ONVIF, and asked where it points ten times a second. Failures do not end
/// this: it is asked again as long as the value lives.
#[derive(Debug)]
pub struct OnvifMount {
    shared: SharedHead,
    /// Ends the thread when dropped.
    stop: Option<oneshot::Sender<Infallible>>,
    thread: Option<JoinHandle<()>>,
}

impl OnvifMount {
    /// Starts asking the mount.
    ///
    /// # Errors
    /// If the password cannot be read, or the host cannot start another thread.
    pub fn start(config: &OnvifConfig, angle_sd_rad: f64) -> anyhow::Result<Self> {
        let radians = |degrees: [f64; 2]| degrees.map(f64::to_radians);
        let reach = Reach {
            address: config.url.clone(),
            login: config.login()?,
            scale: AngleScale { pan: radians(config.pan_deg), tilt: radians(config.tilt_deg) },
            zoom: config.zoom.map(|zoom| zoom as f32),
        };
        let shared = SharedHead(Arc::new(Mutex::new(Head::new(angle_sd_rad))));
        let (stop, stopped) = oneshot::channel();
        let runtime = runtime()?;
        let asked = shared.clone();
        let thread = std::thread::Builder::new().name("mount".to_owned()).spawn(move || {
            runtime.spawn(ask_for_ever(asked, reach));
            // Requests in progress end with the runtime.
            let _ = runtime.block_on(stopped);
        });
        let thread = thread.context("no thread for the mount")?;
        Ok(Self { shared, stop: Some(stop), thread: Some(thread) })
    }
}

impl Drop for OnvifMount {
    fn drop(&mut self) {
        self.stop = None;
        if let Some(thread) = self.thread.take() {
            // The thread has reported its errors itself.
            let _ = thread.join();
        }
    }
}

impl Mount for OnvifMount {
    fn aim(&mut self, angles: ScanAngles) {
        self.shared.with(|head| head.order(angles));
    }

    fn obeys(&self) -> bool {
        self.shared.with(|head| head.obeys(Instant::now()))
    }

    fn pointed(&mut self) -> Pointed {
        self.shared.with(|head| head.at(Instant::now()))
    }
}

/// Asks a mount for ever, with growing pauses while it does not answer.
async fn ask_for_ever(shared: SharedHead, mut reach: Reach) {
    let mut repeats = Repeats::default();
    let mut pause = FIRST_PAUSE;
    loop {
        let mut answered = false;
        let Err(error) = ask(&shared, &mut reach, &mut repeats, &mut answered).await;
        shared.with(Head::lose);
        repeats.warn("lost", Instant::now(), || {
            format!("the mount at {}: {error:#}; going on", reach.address)
        });
        pause = if answered { FIRST_PAUSE } else { (2 * pause).min(LONGEST_PAUSE) };
        tokio::time::sleep(pause).await;
        repeats.remind(Instant::now());
    }
}

/// Asks a mount where it points, and orders it where to turn, until it stops answering.
async fn ask(
    shared: &SharedHead,
    reach: &mut Reach,
    repeats: &mut Repeats,
    has_answered: &mut bool,
) -> anyhow::Result<Infallible> {
    let device = Device::connect(&reach.address, reach.login.as_ref()).await?;
    let (head, profile) = device.profile_of_head().await?;
    let mut zoom_set = None::<Instant>;
    loop {
        let status = answered(device.client.ptz_get_status(head.as_str(), &profile)).await?;
        let position = status.pan.zip(status.tilt).map(|(pan, tilt)| [pan, tilt]);
        let position = position.context("it does not say where it points, so it is of no use")?;
        if !std::mem::replace(has_answered, true) {
            tracing::info!("the mount at {} says where it points", reach.address);
        }
        let now = Instant::now();
        let is_zoomed = reach.is_zoomed(status.zoom);
        if is_zoomed {
            shared.with(Head::lose);
        } else {
            let moves = status.pan_tilt_status == "MOVING" || status.zoom_status == "MOVING";
            let angles = reach.scale.angles(position);
            shared.with(|head| head.observe(angles, moves, now));
        }
        let order = shared.with(|head| head.order).filter(|order| order.sent.is_none());
        let is_due = zoom_set.is_none_or(|at| now.duration_since(at) > ASKED_TO_TURN_AGAIN);
        if order.is_some() || (is_zoomed && is_due) {
            zoom_set = Some(now);
            let [pan, tilt] = order.map_or(position, |order| reach.scale.position(order.to));
            let zoom = reach.zoom.unwrap_or(0.0);
            let moved = device.client.ptz_absolute_move(head.as_str(), &profile, pan, tilt, zoom);
            match (answered(moved).await, order) {
                (Ok(()), Some(order)) => shared.with(|head| head.told(order.to, Instant::now())),
                (Ok(()), None) => {}
                (Err(error), _) => {
                    shared.with(|head| head.refuse(Instant::now()));
                    repeats.warn("refused", Instant::now(), || {
                        format!("the mount at {} does not turn: {error:#}", reach.address)
                    });
                }
            }
        }
        tokio::time::sleep(ASKED_EVERY).await;
    }
}

#[cfg(test)]
mod tests;
