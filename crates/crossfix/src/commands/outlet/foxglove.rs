//! A server for Foxglove: our own messages, with Foxglove's schemas beside them.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use crossfix_geometry::Geodetic;
use crossfix_message::{Channel, Key, Timestamp, glance};
use crossfix_outlet::foxglove::{FoxgloveView, PictureExport, file_descriptor_set};
use crossfix_transport::{NetworkConfig, Received, Role};
use foxglove::{ChannelBuilder, Context, PartialMetadata, RawChannel, Schema, WebSocketServer};

use crate::network;
use crate::output;
use crate::shutdown::{LEAVE, Shutdown};

/// How long it waits for a message before it checks whether to stop. With twice as much a stop may
/// come a tenth of a second late.
const POLL: Duration = Duration::from_millis(50);
/// Messages queued for a slow client before its oldest are dropped; no other client waits for it.
/// With half of it a client that pauses loses messages after half of the time.
const WAITING: usize = 256;
/// Most topics served; more counts as an attack. With half as many the same: a hundred cameras
/// have some hundreds.
const MOST_TOPICS: usize = 10_000;

/// The served topics, with a channel each.
struct Served {
    context: Arc<Context>,
    channels: BTreeMap<String, Arc<RawChannel>>,
}

impl Served {
    fn put(
        &mut self,
        topic: &str,
        schema: &str,
        definitions: &'static [u8],
        time: Timestamp,
        data: &[u8],
    ) -> anyhow::Result<()> {
        if !self.channels.contains_key(topic) && self.channels.len() < MOST_TOPICS {
            let channel = ChannelBuilder::new(topic)
                .message_encoding("protobuf")
                .schema(Schema::new(schema, "protobuf", definitions))
                .context(&self.context)
                .build_raw()
                .with_context(|| format!("cannot serve {topic}"))?;
            self.channels.insert(topic.to_owned(), channel);
        }
        if let Some(channel) = self.channels.get(topic) {
            let nanos = u64::try_from(time.nanos()).unwrap_or(0);
            channel.log_with_meta(data, PartialMetadata::with_log_time(nanos));
        }
        Ok(())
    }

    /// Serves a message of the site, and its contents in Foxglove's schemas.
    fn take(&mut self, view: &mut FoxgloveView, received: &Received) -> anyhow::Result<()> {
        let Received { key, data, .. } = received;
        let Ok(Some(seen)) = glance(&key.channel, data) else { return Ok(()) };
        // Pictures are served in Foxglove's schema alone: Foxglove cannot show ours.
        if !matches!(key.channel, Channel::Preview(_)) {
            let schema = (
                crossfix_recording::schema_of(&key.channel),
                crossfix_message::file_descriptor_set(),
            );
            if let (Some(name), definitions) = schema {
                self.put(&format!("/{key}"), name, definitions, seen.time, data)?;
            }
        }
        for message in view.of(key, data, seen.time) {
            let definitions = file_descriptor_set();
            self.put(&message.topic, message.schema, definitions, message.time, &message.data)?;
        }
        Ok(())
    }
}

/// Serves a site until it is asked to stop.
pub fn serve(
    network: &NetworkConfig,
    anchor: Option<Geodetic>,
    address: SocketAddr,
    shutdown: &Shutdown,
) -> anyhow::Result<()> {
    let Some(link) = network::open(network, &Role::Observer, shutdown)? else {
        return Ok(());
    };
    let context = Context::new();
    let server = WebSocketServer::new()
        .name(format!("crossfix {}", network.site))
        .bind(address.ip().to_string(), address.port())
        .message_backlog_size(WAITING)
        .context(&context)
        .start_blocking()
        .with_context(|| format!("cannot serve at {address}"))?;
    let subscription = link.subscribe(&[Key::everything_of(link.site())])?;
    output::line(format!("Foxglove: open ws://{}:{}", address.ip(), server.port()));
    let mut served = Served { context, channels: BTreeMap::new() };
    let mut view = FoxgloveView::new(&network.site, anchor, PictureExport::Said);
    while !shutdown.requested() {
        if let Some(received) = subscription.next(POLL) {
            served.take(&mut view, &received)?;
        }
    }
    server.stop().wait_blocking();
    drop(subscription);
    Ok(link.close(LEAVE)?)
}
