//! Selects topics by name and by pattern.

use regex::Regex;

/// Selects topics like the options of `ros2 bag record`.
#[derive(Clone, Debug, Default)]
pub struct TopicFilter {
    /// Topics with these names.
    pub names: Vec<String>,
    /// Topics with a name in which one of these patterns is found.
    pub regex: Vec<Regex>,
    /// Never topics with a name in which one of these patterns is found.
    pub exclude: Vec<Regex>,
    /// All topics, regardless of `names` and `regex`.
    pub all: bool,
}

impl TopicFilter {
    /// Whether no topic can be selected.
    pub fn is_empty(&self) -> bool {
        !self.all && self.names.is_empty() && self.regex.is_empty()
    }

    /// Whether a topic is selected.
    pub fn matches(&self, topic: &str) -> bool {
        let selected = self.all
            || self.names.iter().any(|name| name == topic)
            || self.regex.iter().any(|pattern| pattern.is_match(topic));
        selected && !self.exclude.iter().any(|pattern| pattern.is_match(topic))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_are_selected_by_name_or_pattern_unless_they_are_excluded() {
        let patterns =
            |texts: &[&str]| texts.iter().map(|text| Regex::new(text).unwrap()).collect();
        let filter = TopicFilter {
            names: vec!["/a".into()],
            regex: patterns(&["^/left/", "cloud$"]),
            exclude: patterns(&["status"]),
            all: false,
        };
        for topic in ["/a", "/left/b", "/c/cloud"] {
            assert!(filter.matches(topic), "{topic}");
        }
        for topic in ["/ab", "/right/left", "/left/status", "/cloud/c"] {
            assert!(!filter.matches(topic), "{topic}");
        }
        let all = TopicFilter { all: true, ..filter };
        assert!(all.matches("/ab") && !all.matches("/left/status"));
        assert!(!TopicFilter::default().matches("/a") && TopicFilter::default().is_empty());
    }
}
