//! Names of the services of a topic: `eddy<topic>`, in a ROS domain other than 0 `eddy<domain>:<topic>`.

use iceoryx2::prelude::ServiceName;

use crate::{Link, TransportError, TransportKind};

const PREFIX: &str = "eddy";

/// The service of a topic.
pub(super) fn service(domain_id: u16, link: &Link) -> Result<ServiceName, TransportError> {
    let name = format!("{}{}", prefix(domain_id), link.topic);
    ServiceName::new(&name).map_err(|_| TransportError::LongName {
        link: link.clone(),
        found: name.len(),
        limit: ServiceName::max_len(),
    })
}

/// The topic of a service; `None` if it is not one of this domain.
pub(super) fn topic(domain_id: u16, service: &str) -> Option<Link> {
    let topic = service.strip_prefix(&prefix(domain_id)).filter(|name| name.starts_with('/'))?;
    format!("{}:{topic}", TransportKind::Shm).parse().ok()
}

fn prefix(domain_id: u16) -> String {
    match domain_id {
        0 => PREFIX.to_owned(),
        domain_id => format!("{PREFIX}{domain_id}:"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_service_has_its_domain_and_is_read_back_in_that_domain_only() {
        let link = Link::shm("/robot/particles");
        for (domain, expected) in [
            (0, "eddy/robot/particles"),
            (7, "eddy7:/robot/particles"),
            (232, "eddy232:/robot/particles"),
        ] {
            let name = service(domain, &link).unwrap();
            assert_eq!(name.as_str(), expected);
            for other in [0, 7, 23, 232] {
                let found = topic(other, &name);
                assert_eq!(found, (other == domain).then(|| link.clone()), "{name} in {other}");
            }
        }
        assert_eq!(topic(0, "eddy_other/a"), None);
    }

    #[test]
    fn a_topic_whose_service_has_too_long_a_name_is_refused_with_its_length() {
        let link = Link::shm(&format!("/{}", "a".repeat(300)));
        let message = service(7, &link).unwrap_err().to_string();
        assert!(
            message.ends_with(": found a name of 307 bytes, expected at most 255"),
            "{message}"
        );
    }
}
