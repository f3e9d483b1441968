//! Names of the services of a topic: `eddy<topic>`, in a ROS domain other than 0 `eddy<domain>:<topic>`. Frames of three dimensions have one
//! of their own, `eddy<topic>:3`: a service has one type, and whoever reads a topic need not know which frames will come.

use iceoryx2::prelude::ServiceName;

use crate::{Link, TransportError, TransportKind};

const PREFIX: &str = "eddy";

/// What the name of the service for frames of three dimensions ends in; topics have no colon.
const SPACE: &str = ":3";

/// The service of a topic.
pub(super) fn service(domain_id: u16, link: &Link) -> Result<ServiceName, TransportError> {
    named(link, format!("{}{}", prefix(domain_id), link.topic))
}

/// The service of its frames of three dimensions.
pub(super) fn service_in_space(domain_id: u16, link: &Link) -> Result<ServiceName, TransportError> {
    named(link, format!("{}{}{SPACE}", prefix(domain_id), link.topic))
}

fn named(link: &Link, name: String) -> Result<ServiceName, TransportError> {
    ServiceName::new(&name).map_err(|_| TransportError::LongName {
        link: link.clone(),
        found: name.len(),
        limit: ServiceName::max_len(),
    })
}

/// The topic of a service, which has frames of three dimensions or other messages; `None` if it is not one of this domain.
pub(super) fn topic(domain_id: u16, service: &str, in_space: bool) -> Option<Link> {
    let topic = service.strip_prefix(&prefix(domain_id)).filter(|name| name.starts_with('/'))?;
    let topic = if in_space { topic.strip_suffix(SPACE)? } else { topic };
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
                let found = topic(other, &name, false);
                assert_eq!(found, (other == domain).then(|| link.clone()), "{name} in {other}");
            }
            let space = service_in_space(domain, &link).unwrap();
            assert_eq!(space.as_str(), format!("{expected}:3"));
            assert_eq!(topic(domain, &space, true), Some(link.clone()));
            assert_eq!(topic(domain, &space, false), None, "topics have no colon");
        }
        assert_eq!(topic(0, "eddy_other/a", false), None);
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
