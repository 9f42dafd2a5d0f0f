//! What systemd is told, where it started the program (`Type=notify`, `WatchdogSec`); elsewhere
//! nobody listens, and that is no error.

use sd_notify::NotifyState;

/// The program is up and does what it is for, or waits for those whom it needs.
pub fn ready(status: &str) {
    tell(&[NotifyState::Ready, NotifyState::Status(status)]);
}

/// Its main loop goes round. Said every second; one that hangs does not say it, and is started again.
pub fn alive() {
    tell(&[NotifyState::Watchdog]);
}

/// It reads its configuration again; [`ready`] says that it has.
pub fn reloading() {
    match NotifyState::monotonic_usec_now() {
        Ok(now) => tell(&[NotifyState::Reloading, now]),
        Err(_) => tell(&[NotifyState::Reloading]),
    }
}

/// It has been asked to stop, and does.
pub fn stopping() {
    tell(&[NotifyState::Stopping]);
}

fn tell(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::debug!("systemd cannot be told: {error}");
    }
}
