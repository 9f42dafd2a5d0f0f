//! Notifications to systemd, if it started the program (`Type=notify`, `WatchdogSec`); elsewhere
//! nobody listens, and that is no error.

use sd_notify::NotifyState;

/// The program is up and does its work, or waits for the components it needs.
pub fn ready(status: &str) {
    notify(&[NotifyState::Ready, NotifyState::Status(status)]);
}

/// Reports that the main loop runs. To be sent every second; systemd restarts a program that hangs
/// and does not send it.
pub fn alive() {
    notify(&[NotifyState::Watchdog]);
}

/// Reports that the configuration is being read again; [`ready`] reports that it has been.
pub fn reloading() {
    match NotifyState::monotonic_usec_now() {
        Ok(now) => notify(&[NotifyState::Reloading, now]),
        Err(_) => notify(&[NotifyState::Reloading]),
    }
}

/// Reports that the program is stopping.
pub fn stopping() {
    notify(&[NotifyState::Stopping]);
}

fn notify(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::debug!("systemd cannot be told: {error}");
    }
}
