//! Publishes topics for Foxglove's application over the WebSocket server of its SDK.
//!
//! Names, types and bytes are those of ROS 2 and of bags, so that one layout fits all of them. Topics that no viewer
//! shows are not sent or encoded. A slow viewer loses the oldest messages; the publisher never waits for it. At most 32
//! viewers can connect, and of pages in browsers only Foxglove's and those that were allowed ([`gate`]).

mod gate;

use std::{
    fmt::Display,
    hash::{BuildHasher as _, RandomState},
    io,
    net::{Ipv4Addr, SocketAddr, TcpListener},
    sync::Arc,
};

use foxglove::{
    ChannelBuilder, Context, FoxgloveError, RawChannel, Schema, WebSocketServer,
    WebSocketServerHandle,
};

use super::{ListenAddress, Publisher, TransportError};
use eddy_frames::Frame;
use eddy_messages::{FrameCdr, UnknownType, type_support};
use gate::Gate;

/// Capacity of the queue of a viewer, for all topics (messages): 38 MB of clouds of 100,000 particles.
const BACKLOG: usize = 16;

/// Address of the server, with the default port of Foxglove's application.
pub type FoxgloveAddress = ListenAddress<8765>;

/// The server; it stops when it is dropped.
pub struct FoxgloveServer {
    /// Not the SDK's global context, which would include everything else that the process logs to it.
    context: Arc<Context>,
    /// Closed before the server stops.
    gate: Gate,
    handle: Option<WebSocketServerHandle>,
}

/// The server cannot listen at the address.
#[derive(Debug, thiserror::Error)]
#[error("{address}: found `{reason}`, expected a free port of this machine (0 takes any)")]
pub struct NotServed {
    address: SocketAddr,
    reason: String,
}

impl FoxgloveServer {
    /// Listens at `address`; viewers see the server as `name`. Pages of `origins` may connect, beside Foxglove's own.
    ///
    /// # Errors
    /// [`NotServed`] when the address is not available.
    pub fn start(
        address: FoxgloveAddress,
        name: &str,
        origins: &[String],
    ) -> Result<Self, NotServed> {
        let ListenAddress(address) = address;
        let failed = |reason: &dyn Display| NotServed { address, reason: reason.to_string() };
        let listener = TcpListener::bind(address).map_err(|error| failed(&error))?;
        let context = Context::new();
        let (handle, server) = serve(name, &context).map_err(|error| failed(&error))?;
        let gate = Gate::open(listener, server, origins.to_vec());
        let gate = gate.map_err(|error: io::Error| failed(&error))?;
        Ok(Self { context, gate, handle: Some(handle) })
    }

    /// The address of the server.
    pub fn address(&self) -> SocketAddr {
        self.gate.address()
    }

    /// A publisher of messages of type `type_name`.
    ///
    /// # Errors
    /// [`UnknownType`] when the type is not part of eddy-messages.
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
            .expect("a channel with an encoding is complete");
        Ok(Box::new(FoxglovePublisher { channel }))
    }
}

/// Starts the server behind the gate on a random address of the loopback network, where no page of a browser finds it;
/// on systems with a single loopback address, on that.
fn serve(
    name: &str,
    context: &Arc<Context>,
) -> Result<(WebSocketServerHandle, SocketAddr), FoxgloveError> {
    let start = |host: Ipv4Addr| {
        let server = WebSocketServer::new()
            .name(name)
            .bind(host.to_string(), 0)
            .message_backlog_size(BACKLOG)
            .context(context);
        let handle = server.start_blocking()?;
        let address = SocketAddr::from((host, handle.port()));
        Ok((handle, address))
    };
    let [a, b, c, ..] = RandomState::new().hash_one(name).to_le_bytes();
    start(Ipv4Addr::new(127, a, b, c.clamp(1, 254))).or_else(|_| start(Ipv4Addr::LOCALHOST))
}

impl Drop for FoxgloveServer {
    fn drop(&mut self) {
        // Without waiting for viewers.
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

    /// 1 while a viewer shows the topic.
    fn subscribers(&self) -> usize {
        usize::from(self.channel.has_sinks())
    }
}
