//! The settings of a Zenoh session.

use crossfix_message::MOST_MESSAGE_BYTES;
use zenoh::Config;

use crate::error::zenoh;
use crate::security::access_control;
use crate::{LinkError, Mode, NetworkConfig, NetworkError, Role};

/// Batches of 64 kB that wait for one slow receiver of bearings and tracks before it loses the
/// next: 1 MB, the most that Zenoh takes. With half of it, a good receiver loses part of a burst of
/// a thousand tracks.
const QUEUED_BATCHES: u32 = 16;
/// The same for pictures, so that what a slow receiver sees is at most this much old. With half of
/// it only one preview of 100 kB waits, and the next is lost.
const PICTURE_BATCHES: u32 = 4;
/// Bytes that the operating system holds for one receiver besides that. Its own default is four
/// megabytes: then a receiver behind 5 kB per second would get tracks a quarter of an hour old
/// before it loses one.
const SEND_BUFFER_BYTES: u32 = 256 << 10;
/// How long opening a link may take, ms: with a one-way delay of 700 ms two exchanges take three
/// seconds. A program that waits for a router that does not answer at all can report that within
/// five seconds. With half of it such slow links are never opened.
const OPEN_TIMEOUT_MS: u32 = 4000;
/// A peer that has not been heard for this long counts as gone, ms. With half of it a wireless
/// link that stalls for two seconds ends the session; with twice as much a peer that is gone counts
/// as there for six.
const LEASE_MS: u32 = 3000;

/// Zenoh's settings by which this component shows its identity, and accepts from others only what
/// each may publish.
fn secured(network: &NetworkConfig, role: &Role) -> Result<Vec<(String, String)>, LinkError> {
    let Some(security) = &network.security else {
        return Ok(Vec::new());
    };
    let identity = role.identity().ok_or(LinkError::Config(NetworkError::NobodysIdentity))?;
    let (authority, own, key) = (
        security.authority_file(),
        security.certificate_file(&identity),
        security.key_file(&identity),
    );
    let tls = serde_json::json!({
        "root_ca_certificate": authority,
        "listen_certificate": own, "listen_private_key": key,
        "connect_certificate": own, "connect_private_key": key,
        "enable_mtls": true, "verify_name_on_connect": true,
        // A link is closed when its certificate ends.
        "close_link_on_expiration": true,
        "so_sndbuf": SEND_BUFFER_BYTES,
    });
    let access = access_control(security, network);
    Ok(vec![
        ("transport/link/tls".to_owned(), tls.to_string()),
        ("access_control".to_owned(), access.to_string()),
    ])
}

/// All settings of a component's session.
pub(crate) fn config(network: &NetworkConfig, role: &Role) -> Result<Config, LinkError> {
    network.validate().map_err(LinkError::Config)?;
    let (listen, connect) = network.endpoints(role).map_err(LinkError::Config)?;
    let is_router = matches!(role, Role::Router { .. });
    // A client gets an error at once if no router is there, and this program tries again: Zenoh
    // itself would not.
    let (mode, patience) = match network.mode {
        _ if is_router => ("router", "-1"),
        Mode::Peer => ("peer", "-1"),
        Mode::Client => ("client", "0"),
    };
    let mut config = Config::default();
    let queue = |priority: &str| format!("transport/link/tx/queue/size/{priority}");
    let settings = [
        ("mode".to_owned(), format!("{mode:?}")),
        // Always set: the default listens on all interfaces.
        ("listen/endpoints".to_owned(), format!("{listen:?}")),
        ("connect/endpoints".to_owned(), format!("{connect:?}")),
        ("connect/timeout_ms".to_owned(), patience.to_owned()),
        ("connect/exit_on_failure".to_owned(), "false".to_owned()),
        (
            "connect/retry".to_owned(),
            "{period_init_ms: 200, period_max_ms: 1000, period_increase_factor: 1.5}".to_owned(),
        ),
        ("transport/unicast/open_timeout".to_owned(), OPEN_TIMEOUT_MS.to_string()),
        ("transport/link/tx/lease".to_owned(), LEASE_MS.to_string()),
        (queue("data"), QUEUED_BATCHES.to_string()),
        (queue("data_low"), PICTURE_BATCHES.to_string()),
        ("transport/link/tcp/so_sndbuf".to_owned(), SEND_BUFFER_BYTES.to_string()),
        // A message that gets longer than this is discarded before it is whole.
        ("transport/link/rx/max_message_size".to_owned(), (2 * MOST_MESSAGE_BYTES).to_string()),
        ("scouting/multicast/enabled".to_owned(), "false".to_owned()),
        ("scouting/gossip/enabled".to_owned(), "false".to_owned()),
        // How long opening waits for peers that are not up yet, ms.
        ("scouting/delay".to_owned(), "200".to_owned()),
    ];
    for (key, value) in settings.into_iter().chain(secured(network, role)?) {
        config.insert_json5(&key, &value).map_err(zenoh(format!("cannot set Zenoh's `{key}`")))?;
    }
    Ok(config)
}
