//! Which topics are wanted, by name and by pattern.

use regex::Regex;

/// Which topics are wanted: as rosbag2's recorder takes them.
#[derive(Clone, Debug, Default)]
pub struct TopicChoice {
    /// These.
    pub names: Vec<String>,
    /// And all in whose name one of these is found.
    pub regex: Vec<Regex>,
    /// But none in whose name one of these is found.
    pub exclude: Vec<Regex>,
    /// Those that neither `names` nor `regex` ask for, too.
    pub all: bool,
}

impl TopicChoice {
    /// Whether no topic can be wanted.
    pub fn is_empty(&self) -> bool {
        !self.all && self.names.is_empty() && self.regex.is_empty()
    }

    /// Whether a topic is wanted.
    pub fn wants(&self, topic: &str) -> bool {
        let asked_for = self.all
            || self.names.iter().any(|name| name == topic)
            || self.regex.iter().any(|pattern| pattern.is_match(topic));
        asked_for && !self.exclude.iter().any(|pattern| pattern.is_match(topic))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_are_wanted_by_name_or_pattern_unless_they_are_excluded() {
        let patterns =
            |words: &[&str]| words.iter().map(|word| Regex::new(word).unwrap()).collect();
        let choice = TopicChoice {
            names: vec!["/a".into()],
            regex: patterns(&["^/left/", "cloud$"]),
            exclude: patterns(&["status"]),
            all: false,
        };
        for topic in ["/a", "/left/b", "/c/cloud"] {
            assert!(choice.wants(topic), "{topic}");
        }
        for topic in ["/ab", "/right/left", "/left/status", "/cloud/c"] {
            assert!(!choice.wants(topic), "{topic}");
        }
        let all = TopicChoice { all: true, ..choice };
        assert!(all.wants("/ab") && !all.wants("/left/status"));
        assert!(!TopicChoice::default().wants("/a") && TopicChoice::default().is_empty());
    }
}
