//! Type names in DDS and in the keys of rmw_zenoh: `eddy_msgs/msg/ParticleFrame` is
//! `eddy_msgs::msg::dds_::ParticleFrame_`.

/// The DDS name of a ROS type.
pub fn dds_type(name: &str) -> String {
    match name.rsplit_once('/') {
        Some((path, last)) => format!("{}::dds_::{last}_", path.replace('/', "::")),
        None => name.to_owned(),
    }
}

/// The ROS name of a DDS type; `None` if it is not a type of ROS 2.
pub fn ros_type(name: &str) -> Option<String> {
    let (path, last) = name.strip_suffix('_')?.rsplit_once("::dds_::")?;
    Some(format!("{}/{last}", path.replace("::", "/")))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn types_have_the_dds_names_of_ros() {
        for (ros, dds) in [
            ("eddy_msgs/msg/ParticleFrame", "eddy_msgs::msg::dds_::ParticleFrame_"),
            ("std_msgs/msg/String", "std_msgs::msg::dds_::String_"),
            ("std_srvs/srv/Trigger_Request", "std_srvs::srv::dds_::Trigger_Request_"),
        ] {
            assert_eq!(dds_type(ros), dds);
        }
        assert_eq!(ros_type("HelloWorldData::Msg"), None);
    }

    proptest! {
        #[test]
        fn names_are_converted_back(
            package in "[a-z][a-z0-9_]{0,9}",
            kind in "msg|srv|action",
            name in "[A-Z][A-Za-z0-9_]{0,9}",
        ) {
            let ros = format!("{package}/{kind}/{name}");
            prop_assert_eq!(ros_type(&dds_type(&ros)), Some(ros));
        }
    }
}
