//! Messages as YAML, like `ros2 topic echo`.

use eddy_messages::{
    Clock, DiagnosticArray, Message, ParameterEvent, ParticleFrame, PointCloud2, PredictionStatus,
    RosString, cdr,
};

/// A message as YAML with at most `limit` items of each list (0: all); of unknown types only the size.
pub fn message_text(type_name: &str, bytes: &[u8], limit: usize) -> String {
    let yaml = match type_name {
        ParticleFrame::TYPE => yaml::<ParticleFrame>(bytes),
        PredictionStatus::TYPE => yaml::<PredictionStatus>(bytes),
        DiagnosticArray::TYPE => yaml::<DiagnosticArray>(bytes),
        Clock::TYPE => yaml::<Clock>(bytes),
        ParameterEvent::TYPE => yaml::<ParameterEvent>(bytes),
        PointCloud2::TYPE => yaml::<PointCloud2>(bytes),
        RosString::TYPE => yaml::<RosString>(bytes),
        _ => return format!("# {} bytes of {type_name}\n", bytes.len()),
    };
    match yaml {
        Ok(yaml) => shorten(&yaml, limit),
        Err(error) => format!("# not a {type_name}: {error}\n"),
    }
}

fn yaml<M: Message>(bytes: &[u8]) -> Result<String, String> {
    let message = cdr::decode::<M>(bytes).map_err(|error| error.to_string())?;
    serde_saphyr::to_string(&message).map_err(|error| error.to_string())
}

/// Keeps `limit` numbers or words of each list and adds their count; all if `limit` is 0.
fn shorten(yaml: &str, limit: usize) -> String {
    let mut text = String::new();
    let (mut count, mut indent) = (0, "");
    for line in yaml.lines().chain([""]) {
        let bare = line.trim_start();
        let is_item = bare
            .strip_prefix("- ")
            .is_some_and(|item| !item.contains(": ") && !item.ends_with(':'));
        if is_item {
            count += 1;
            indent = &line[..line.len() - bare.len()];
        } else {
            if limit > 0 && count > limit {
                text.push_str(&format!("{indent}- ... of {count}\n"));
            }
            count = 0;
        }
        if !line.is_empty() && (!is_item || limit == 0 || count <= limit) {
            text.push_str(line);
            text.push('\n');
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lists_are_cut_with_their_length() {
        let yaml = "a:\n- 1\n- 2\n- 3\nb:\n  - x\nc: 5\n";
        assert_eq!(shorten(yaml, 2), "a:\n- 1\n- 2\n- ... of 3\nb:\n  - x\nc: 5\n");
        assert_eq!(shorten(yaml, 0), yaml);
    }

    #[test]
    fn lists_of_maps_are_kept() {
        let yaml = "values:\n- key: a\n  value: 1\n- key: b\n  value: 2\n";
        assert_eq!(shorten(yaml, 1), yaml);
    }

    #[test]
    fn messages_are_yaml_and_other_bytes_are_described() {
        let word = cdr::encode(&RosString { data: "eddy".into() });
        assert_eq!(message_text(RosString::TYPE, &word, 0), "data: eddy\n");
        assert_eq!(
            message_text("acme_msgs/msg/Imu", &[0; 7], 0),
            "# 7 bytes of acme_msgs/msg/Imu\n"
        );
        let invalid = message_text(Clock::TYPE, &[0], 0);
        assert!(invalid.starts_with("# not a rosgraph_msgs/msg/Clock: "), "{invalid}");
    }
}
