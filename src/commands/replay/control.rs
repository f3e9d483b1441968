//! What others want: the services of rosbag2's player, where the transport has services.

use std::sync::Arc;

use eddy_node::{Asked, Remote, Service, player_services, ros::RosNode};
use eddy_transport::{Link, Served, TransportError, TransportKind, Transports};

/// The services, as long as it lives.
pub(super) struct RemoteControl {
    remote: Arc<Remote>,
    _services: Vec<Box<dyn Served>>,
}

impl RemoteControl {
    /// Offers them on a transport, under the names that they have after remapping. `None` when it has no services.
    pub(super) fn offer(
        transports: &Transports,
        transport: TransportKind,
        ros: &RosNode,
    ) -> Result<Option<Self>, TransportError> {
        let remote = Arc::new(Remote::default());
        let mut services = Vec::new();
        for Service { name, type_name, handler } in player_services(&ros.full_name(), &remote) {
            let link = Link { transport, topic: ros.service(&name) };
            services.extend(transports.serve(&link, type_name, handler)?);
        }
        Ok((!services.is_empty()).then_some(Self { remote, _services: services }))
    }

    /// What was asked for since the last look.
    pub(super) fn wishes(&self) -> Vec<Asked> {
        std::iter::from_fn(|| self.remote.next()).collect()
    }
}

impl Drop for RemoteControl {
    fn drop(&mut self) {
        // Before the services, which wait for the answers they still owe.
        self.remote.close();
    }
}
