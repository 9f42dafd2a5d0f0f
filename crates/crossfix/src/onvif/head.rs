//! What turns a network camera, and where it says that it points.
//!
//! A mount by ONVIF is told a place and goes there in its own time; asked, it says where it is and
//! whether it moves, a network's delay later. So what it says is where an image was taken only if it
//! has stood still for as long as an image takes to come, and while it does not, nothing is.

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

/// How often it is asked where it is. Twice as often burdens a camera's small host; half as often
/// makes each turn a tenth of a second longer.
const ASKED_EVERY: Duration = Duration::from_millis(100);
/// How long an image takes to come at most: from the exposure through encoder, network and decoder.
/// With less than a camera takes, images of a turn are taken for those of where it ended.
const IMAGE_COMES_WITHIN: Duration = Duration::from_millis(500);
/// What it said so long ago is where it was.
const SAID_HOLDS: Duration = Duration::from_secs(1);
/// If it has not moved by then, it goes no farther.
const BEGINS_WITHIN: Duration = Duration::from_secs(1);
/// A mount that has refused to turn is not asked to for so long, so that its camera sees meanwhile.
const ASKED_TO_TURN_AGAIN: Duration = Duration::from_secs(5);
/// It has arrived, or stands still, within so many deviations of its angles.
const SAME_SDS: f64 = 3.0;
/// Zooms farther apart are not the same: a hundredth is one of focal length, too, on most lenses.
const SAME_ZOOM: f32 = 0.01;
/// It is asked again after a failure, at first and at last: some lock who errs too often.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_secs(60);

/// What a mount's angles are by the positions that it says, each from -1 to 1.
#[derive(Clone, Copy, Debug)]
struct Scale {
    /// Azimuth at a pan of -1 and 1, rad.
    pan: [f64; 2],
    /// Elevation at a tilt of -1 and 1, rad.
    tilt: [f64; 2],
}

impl Scale {
    fn angles(&self, [pan, tilt]: [f32; 2]) -> ScanAngles {
        let at = |[least, most]: [f64; 2], place: f32| {
            least + (most - least) * (f64::from(place) + 1.0) / 2.0
        };
        ScanAngles { azimuth: at(self.pan, pan), elevation: at(self.tilt, tilt) }
    }

    fn position(&self, angles: ScanAngles) -> [f32; 2] {
        let of = |[least, most]: [f64; 2], angle: f64| {
            (2.0 * (angle - least) / (most - least) - 1.0).clamp(-1.0, 1.0) as f32
        };
        [of(self.pan, angles.azimuth), of(self.tilt, angles.elevation)]
    }
}

/// Where a head was told to turn.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Order {
    to: ScanAngles,
    /// Since when it knows; `None` while it has not been told.
    sent: Option<Instant>,
}

/// Where a head points, by what it has said.
#[derive(Clone, Copy, Debug)]
struct Head {
    /// Angles that differ by less are the same, rad.
    same_rad: f64,
    /// What it said last, and when.
    said: Option<(ScanAngles, Instant)>,
    /// Where it has stood still, and since when.
    still: Option<(ScanAngles, Instant)>,
    order: Option<Order>,
    /// When it refused to turn last.
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
        self.order = Some(Order { to, sent: None });
    }

    /// Whether it has not refused to turn of late.
    fn obeys(&self, now: Instant) -> bool {
        self.refused.is_none_or(|refused| now.duration_since(refused) > ASKED_TO_TURN_AGAIN)
    }

    /// It does not turn there: it goes on where it is.
    fn refuse(&mut self, now: Instant) {
        (self.order, self.refused) = (None, Some(now));
    }

    /// It has been told to turn, unless it is to turn elsewhere by now.
    fn told(&mut self, to: ScanAngles, now: Instant) {
        if let Some(order) = self.order.as_mut().filter(|order| order.to == to) {
            order.sent = Some(now);
        }
    }

    /// It says where it is, and whether it moves.
    fn hear(&mut self, angles: ScanAngles, moves: bool, now: Instant) {
        let same = |other: ScanAngles| {
            (angles.azimuth - other.azimuth).abs() <= self.same_rad
                && (angles.elevation - other.elevation).abs() <= self.same_rad
        };
        let stays = !moves && self.still.is_some_and(|(there, _)| same(there));
        if !stays {
            self.still = (!moves).then_some((angles, now));
        }
        self.said = Some((angles, now));
        let Some(Order { to, sent: Some(sent) }) = self.order else { return };
        if !stays {
            // It may stop short of where it was told to go: the wait begins anew where it stops.
            self.order = Some(Order { to, sent: Some(now) });
        } else if same(to) || now.duration_since(sent) > BEGINS_WITHIN {
            self.order = None;
        }
    }

    /// It says nothing, or its lens is another.
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
struct Shared(Arc<Mutex<Head>>);

impl Shared {
    fn with<T>(&self, act: impl FnOnce(&mut Head) -> T) -> T {
        // Whoever panics has not left it half told.
        act(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// How a mount is reached.
struct Reach {
    address: Url,
    login: Option<Login>,
    scale: Scale,
    /// That of the lens: as it is declared, or else as the mount says it first.
    zoom: Option<f32>,
}

impl Reach {
    /// Whether somebody has made the lens another than that which is calibrated.
    fn is_zoomed(&mut self, said: Option<f32>) -> bool {
        let Some(said) = said else { return false };
        (said - *self.zoom.get_or_insert(said)).abs() > SAME_ZOOM
    }
}

/// A mount that is turned by ONVIF, and asked where it points ten times a second. It is asked again
/// for as long as it lives, whatever becomes of it.
#[derive(Debug)]
pub struct OnvifMount {
    shared: Shared,
    /// Ends the thread when it is dropped.
    stop: Option<oneshot::Sender<Infallible>>,
    thread: Option<JoinHandle<()>>,
}

impl OnvifMount {
    /// Begins to ask it.
    ///
    /// # Errors
    /// If the password cannot be read, or the host has no threads left.
    pub fn start(config: &OnvifConfig, angle_sd_rad: f64) -> anyhow::Result<Self> {
        let radians = |degrees: [f64; 2]| degrees.map(f64::to_radians);
        let reach = Reach {
            address: config.url.clone(),
            login: config.login()?,
            scale: Scale { pan: radians(config.pan_deg), tilt: radians(config.tilt_deg) },
            zoom: config.zoom.map(|zoom| zoom as f32),
        };
        let shared = Shared(Arc::new(Mutex::new(Head::new(angle_sd_rad))));
        let (stop, stopped) = oneshot::channel();
        let runtime = runtime()?;
        let asked = shared.clone();
        let thread = std::thread::Builder::new().name("mount".to_owned()).spawn(move || {
            runtime.spawn(ask_for_ever(asked, reach));
            // What is under way ends with the runtime.
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
            // It has said what it had to say.
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

/// Asks a mount for ever, ever less often while it does not answer.
async fn ask_for_ever(shared: Shared, mut reach: Reach) {
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

/// Asks a mount where it points, and tells it where to turn, until it does not answer.
async fn ask(
    shared: &Shared,
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
            shared.with(|head| head.hear(angles, moves, now));
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
