//! Topics for Foxglove's application, by the WebSocket server of its SDK: to look at, nothing is received.
//!
//! Names, types and bytes are those of ROS 2 and of our bags, so that a layout that was made for one of them shows
//! the others. Nothing is sent on a topic that nobody shows, and of clouds nothing is encoded. A viewer that does not keep up loses the
//! oldest messages; the publisher never waits for it.

use std::{
    net::{IpAddr, SocketAddr},
    sync::Arc,
};

use foxglove::{
    ChannelBuilder, Context, FoxgloveError, RawChannel, Schema, WebSocketServer,
    WebSocketServerHandle,
};

use super::{ListenAddress, Publisher, TransportError};
use eddy_frames::Frame;
use eddy_messages::{FrameCdr, UnknownType, type_support};

/// Messages of all topics that wait for one viewer: at 100,000 particles, clouds of 38 MB.
const BACKLOG: usize = 16;

/// Where it listens; the port is the one that Foxglove's application expects.
pub type FoxgloveAddress = ListenAddress<8765>;

/// Foxglove's server, until it is dropped.
pub struct FoxgloveServer {
    /// Ours alone: the SDK's own one would show whatever else the process logs to it.
    context: Arc<Context>,
    address: SocketAddr,
    handle: Option<WebSocketServerHandle>,
}

/// Why there is no server.
#[derive(Debug, thiserror::Error)]
#[error("{address}: found `{reason}`, expected a free port of this machine (0 takes any)")]
pub struct NotServed {
    address: SocketAddr,
    reason: FoxgloveError,
}

impl FoxgloveServer {
    /// Listens at `address`; viewers see the server as `name`.
    ///
    /// # Errors
    /// [`NotServed`] where that address cannot be had.
    pub fn start(address: FoxgloveAddress, name: &str) -> Result<Self, NotServed> {
        let ListenAddress(address) = address;
        let context = Context::new();
        let host = match address.ip() {
            IpAddr::V4(host) => host.to_string(),
            IpAddr::V6(host) => format!("[{host}]"),
        };
        let server = WebSocketServer::new()
            .name(name)
            .bind(host, address.port())
            .message_backlog_size(BACKLOG)
            .context(&context);
        let handle = server.start_blocking().map_err(|reason| NotServed { address, reason })?;
        let address = SocketAddr::new(address.ip(), handle.port());
        Ok(Self { context, address, handle: Some(handle) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// A topic of messages of the type of this name.
    ///
    /// # Errors
    /// [`UnknownType`] where it is none of ours.
    pub fn publisher(
        &self,
        topic: &str,
        type_name: &str,
    ) -> Result<Box<dyn Publisher>, UnknownType> {
        let support = type_support(type_name)?;
        let schema = Schema::new(type_name, "ros2msg", support.schema.as_bytes());
        let channel = ChannelBuilder::new(topic)
            .context(&self.context)
            .message_encoding("cdr")
            .schema(schema)
            .build_raw()
            .expect("a channel whose encoding is given is complete");
        Ok(Box::new(FoxglovePublisher { channel }))
    }
}

impl Drop for FoxgloveServer {
    fn drop(&mut self) {
        // Nobody waits for viewers that do not read.
        drop(self.handle.take().map(WebSocketServerHandle::stop));
    }
}

struct FoxglovePublisher {
    channel: Arc<RawChannel>,
}

impl Publisher for FoxglovePublisher {
    fn publish_frame(&mut self, frame: &Frame) -> Result<(), TransportError> {
        if self.channel.has_sinks() {
            self.channel.log(&frame.to_cdr());
        }
        Ok(())
    }

    fn publish_cdr(&mut self, bytes: &[u8]) -> Result<(), TransportError> {
        self.channel.log(bytes);
        Ok(())
    }

    /// One as soon as somebody shows the topic.
    fn subscribers(&self) -> usize {
        usize::from(self.channel.has_sinks())
    }
}
