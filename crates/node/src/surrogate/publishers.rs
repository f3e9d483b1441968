//! The topics that belong to the outputs of a node, with the QoS of each.

use eddy_messages::{
    DiagnosticArray, Message as _, ParameterEvent, ParticleFrame, PointCloud2, PredictionStatus,
    lifecycle::TransitionEvent,
};
use eddy_transport::{
    Link, Publisher, PublisherOptions, Reliability, TransportError, Transports, default_qos,
};

use super::{CloudTopic, NodeLinks, Outputs};
use crate::ros::{RosNode, TopicQos};

/// Opens the publishers of a node.
pub(super) struct Publishers<'a> {
    pub(super) transports: &'a Transports,
    pub(super) ros: &'a RosNode,
    pub(super) qos: TopicQos,
    /// Of predictions and their status.
    pub(super) reliability: Reliability,
}

impl Publishers<'_> {
    /// Opens the outputs; topics of the whole node once per transport.
    pub(super) fn open(
        &mut self,
        links: &NodeLinks,
        clouds: bool,
        is_managed: bool,
    ) -> Result<Vec<Outputs>, TransportError> {
        let (ros, reliability) = (self.ros, self.reliability);
        let mut opened = Vec::new();
        for (index, link) in links.outputs.iter().enumerate() {
            let prediction = self.publisher(&ros.link(link), ParticleFrame::TYPE, reliability)?;
            let status = ros.subtopic(link, "status");
            let status = self.publisher(&status, PredictionStatus::TYPE, reliability)?;
            let mut outputs = Outputs::new(prediction, status);
            if clouds {
                outputs.prediction_cloud = Some(self.cloud(link)?);
            }
            if links.outputs[..index].iter().all(|other| other.transport != link.transport) {
                let shared = |topic: &str| ros.link(&link.with_topic(topic));
                let mut publish = |link: &Link, type_name| {
                    self.publisher(link, type_name, Reliability::Drop).map(Some)
                };
                outputs.diagnostics = publish(&shared("/diagnostics"), DiagnosticArray::TYPE)?;
                if link.transport.is_of_ros() {
                    let events = shared("/parameter_events");
                    outputs.parameter_events = publish(&events, ParameterEvent::TYPE)?;
                    if is_managed {
                        let events = shared("~/transition_event");
                        outputs.transition_events = publish(&events, TransitionEvent::TYPE)?;
                    }
                }
                if clouds {
                    let observed = link.with_topic(&links.input.topic);
                    outputs.input_cloud = Some(self.cloud(&observed)?);
                }
            }
            opened.push(outputs);
        }
        Ok(opened)
    }

    fn cloud(&mut self, link: &Link) -> Result<CloudTopic, TransportError> {
        let link = self.ros.subtopic(link, "cloud");
        self.publisher(&link, PointCloud2::TYPE, Reliability::Drop).map(CloudTopic::new)
    }

    /// A publisher with the QoS in the parameters, or else what follows from `reliability`.
    fn publisher(
        &mut self,
        link: &Link,
        type_name: &str,
        reliability: Reliability,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        let default = default_qos(reliability, type_name);
        let qos = self.qos.publisher(&link.topic, default);
        let reliability = qos.as_ref().map_or(reliability, Reliability::of_offer);
        self.transports.publisher(link, type_name, PublisherOptions { reliability, qos })
    }
}
