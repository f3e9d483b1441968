//! Definitions of the types of recorded topics.

use std::{
    borrow::Cow,
    collections::HashMap,
    fs,
    path::PathBuf,
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use eddy_bag::QosOverrides;
use eddy_frames::clock::Clock;
use eddy_messages::{InvalidDefinition, TypeSupport, built_in_text};
use eddy_transport::{SeenTopic, Subscriber, TransportError, Transports};

/// How long the publisher of a type may take to tell its definition.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(2);
/// How long publishers are asked again that do not tell it: those that have just started may not offer the service yet.
const ASKING_TIME: Duration = Duration::from_secs(3);
/// Interval between questions.
const ASKING_INTERVAL: Duration = Duration::from_millis(100);

/// A topic that is subscribed to.
pub struct OpenTopic {
    /// Where it was found.
    pub topic: SeenTopic,
    /// Receives its messages.
    pub subscriber: Box<dyn Subscriber>,
}

/// Subscribes to topics, and finds the definitions of their types.
pub struct TopicOpener {
    transports: Transports,
    definitions: Definitions,
    overrides: QosOverrides,
}

impl TopicOpener {
    /// `prefixes`: installations of ROS 2, as in `AMENT_PREFIX_PATH`. `overrides`: QoS to request, by topic.
    pub fn new(transports: Transports, prefixes: Vec<PathBuf>, overrides: QosOverrides) -> Self {
        Self { transports, definitions: Definitions::new(prefixes), overrides }
    }

    /// The transports of the topics.
    pub fn transports(&self) -> &Transports {
        &self.transports
    }

    /// Subscribes to a topic.
    ///
    /// # Errors
    /// [`TransportError`] when it cannot be subscribed to.
    pub fn open(&self, topic: SeenTopic) -> Result<OpenTopic, TransportError> {
        let requested = self.overrides.get(&topic.link.topic).copied();
        let support = topic.type_support();
        let subscriber = self.transports.requesting_subscriber(&topic.link, &support, requested)?;
        Ok(OpenTopic { topic, subscriber })
    }

    /// The type of a topic; without a definition, and with a warning, if none is found. Takes a few seconds if publishers do
    /// not answer, less once `stop` is raised.
    pub fn type_of(&self, topic: &SeenTopic, stop: &AtomicBool) -> TypeSupport {
        let known = topic.type_support();
        let mut support = match known.schema.is_empty() {
            true => self.definitions.of(topic, &self.transports, stop),
            false => known,
        };
        if support.name.contains("/srv/") {
            // rosbags (0.11) takes `srv` in the name of a type for a folder, does not find the type under its hash, and
            // refuses the whole bag. The hash follows from the definition.
            support.hash.clear();
        }
        support
    }
}

/// Finds definitions of types that are not built in.
struct Definitions {
    prefixes: Vec<PathBuf>,
    /// By name and type hash; without a definition if none was found.
    found: Mutex<HashMap<(String, Option<String>), TypeSupport>>,
}

impl Definitions {
    fn new(prefixes: Vec<PathBuf>) -> Self {
        Self { prefixes, found: Mutex::default() }
    }

    /// The type of a topic: from an installation of ROS 2, or from the topic's publisher. Without a definition, and with
    /// a warning, if neither has one.
    fn of(&self, topic: &SeenTopic, transports: &Transports, stop: &AtomicBool) -> TypeSupport {
        let key = (topic.type_name.clone(), topic.hash.clone());
        // A panic in another thread leaves it consistent: every change is one insertion.
        let found = || self.found.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = found().get(&key) {
            return known.clone();
        }
        let support = self.search(topic, transports, stop);
        found().insert(key, support.clone());
        support
    }

    fn search(&self, topic: &SeenTopic, transports: &Transports, stop: &AtomicBool) -> TypeSupport {
        let SeenTopic { link, type_name, hash, .. } = topic;
        let hash = hash.as_deref().unwrap_or_default();
        let mut reasons = Vec::new();
        match self.installed(type_name).and_then(|support| support.checked(type_name, hash)) {
            Ok(support) => return support,
            Err(InvalidDefinition::Missing { type_name, of }) if type_name == of => {}
            Err(error) => reasons.push(error.to_string()),
        }
        match ask(topic, transports, stop) {
            Ok(Some(support)) => return support,
            Ok(None) if hash.is_empty() => {
                reasons.push("its publisher announces no type hash".to_owned());
            }
            Ok(None) => reasons.push("its publisher does not tell it".to_owned()),
            Err(error) => reasons.push(error.to_string()),
        }
        tracing::warn!(
            "{link}: no definition of {type_name} ({}), without which its messages are bytes that cannot be decoded. \
             AMENT_PREFIX_PATH may name an installation with this type",
            reasons.join("; ")
        );
        TypeSupport::foreign(type_name, hash)
    }

    /// The definition in the installations of ROS 2: `share/<package>/msg/<name>.msg`.
    fn installed(&self, type_name: &str) -> Result<TypeSupport, InvalidDefinition> {
        let text_of = |of: &str| {
            let file = format!("share/{of}.msg");
            let mut files = self.prefixes.iter().map(|prefix| prefix.join(&file));
            let installed = files.find_map(|path| fs::read_to_string(path).ok()).map(Cow::Owned);
            // Installations of single packages lack the standard ones.
            installed.or_else(|| built_in_text(of).map(Cow::Borrowed))
        };
        TypeSupport::from_texts(type_name, &text_of)
    }
}

/// The type as the topic's publishers define it; `None` if they do not tell, also when they are asked again.
fn ask(
    topic: &SeenTopic,
    transports: &Transports,
    stop: &AtomicBool,
) -> Result<Option<TypeSupport>, TransportError> {
    let clock = Clock::start();
    loop {
        let told = transports.described_type(topic, ANSWER_TIMEOUT)?;
        let is_over = clock.now() >= ASKING_TIME || stop.load(Ordering::Relaxed);
        if told.is_some() || topic.hash.is_none() || is_over {
            return Ok(told);
        }
        thread::sleep(ASKING_INTERVAL);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_transport::{Link, TransportOptions};

    /// An installation with the type `acme_msgs/msg/Probe`.
    fn installation() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let msg = folder.path().join("share/acme_msgs/msg");
        fs::create_dir_all(&msg).unwrap();
        fs::write(msg.join("Probe.msg"), "# A probe.\nTip tip\nfloat64 x\n").unwrap();
        fs::write(msg.join("Tip.msg"), "float32[3] position # m\n").unwrap();
        folder
    }

    fn topic(hash: Option<&str>) -> SeenTopic {
        let topic = SeenTopic::new(Link::memory("/probe"), "acme_msgs/msg/Probe".to_owned());
        SeenTopic { hash: hash.map(str::to_owned), ..topic }
    }

    #[test]
    fn definitions_are_found_in_installations_of_ros() {
        let folder = installation();
        let transports = Transports::new(TransportOptions::new("definitions"));
        let prefixes = vec!["/nowhere".into(), folder.path().to_owned()];
        let opener = TopicOpener::new(transports.clone(), prefixes, QosOverrides::new());
        // Nobody answers: asked once.
        let type_of = |topic: &SeenTopic| opener.type_of(topic, &AtomicBool::new(true));
        let support = type_of(&topic(None));
        let separator = "=".repeat(80);
        let expected = format!(
            "# A probe.\nTip tip\nfloat64 x\n\n{separator}\nMSG: acme_msgs/Tip\nfloat32[3] position # m\n"
        );
        assert_eq!(support.schema, expected);
        assert_eq!(type_of(&topic(Some(&support.hash))).schema, expected);

        let other = format!("RIHS01_{}", "0".repeat(64));
        let unknown = type_of(&topic(Some(&other)));
        assert_eq!((unknown.schema, unknown.hash), (String::new(), other));
    }
}
