//! Messages as YAML, like `ros2 topic echo`.

use eddy_messages::{TypeSupport, dynamic};

/// A message as YAML with at most `limit` items of each list (0: all); of types without a definition only the size.
pub fn message_text(support: &TypeSupport, bytes: &[u8], limit: usize) -> String {
    let name = &support.name;
    if support.schema.is_empty() {
        return format!("# {} bytes of {name}\n", bytes.len());
    }
    let value = dynamic::decode(support, bytes).map_err(|error| error.to_string());
    let yaml =
        value.and_then(|value| serde_saphyr::to_string(&value).map_err(|error| error.to_string()));
    match yaml {
        Ok(yaml) => shorten(&yaml, limit),
        Err(error) => format!("# not a {name}: {error}\n"),
    }
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
    use eddy_messages::{Clock, Message as _, RosString, cdr, type_support};

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
        let of = |name| type_support(name).unwrap();
        let word = cdr::encode(&RosString { data: "eddy".into() });
        assert_eq!(message_text(of(RosString::TYPE), &word, 0), "data: eddy\n");
        let mut black = vec![0; 20];
        black[1] = 1;
        let black = message_text(of("std_msgs/msg/ColorRGBA"), &black, 0);
        assert_eq!(black, "r: 0.0\ng: 0.0\nb: 0.0\na: 0.0\n");
        let foreign = TypeSupport::foreign("acme_msgs/msg/Imu", "");
        assert_eq!(message_text(&foreign, &[0; 7], 0), "# 7 bytes of acme_msgs/msg/Imu\n");
        let invalid = message_text(of(Clock::TYPE), &[0], 0);
        assert!(invalid.starts_with("# not a rosgraph_msgs/msg/Clock: "), "{invalid}");
    }
}
