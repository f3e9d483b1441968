//! `docs/src/how-to/secure_zenoh.json5` as it stands there: who has no certificate, no password or no permission gets
//! nothing through.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use eddy_bag::{BagReader, BagWriter, WriterOptions};
use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, DnType, IsCa, KeyPair};
use tempfile::TempDir;

use crate::support::{Process, free_port, talking_eddy, unique};

const FRAMES: i64 = 40;

/// The files that the example names, and changes of it for several processes.
struct Place {
    folder: TempDir,
    example: String,
    topic: String,
}

impl Place {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: String| fs::write(folder.path().join(name), text).unwrap();
        let [authority, stranger] = [authority("eddy"), authority("stranger")];
        write("ca.pem", authority.pem());
        for (name, issuer) in [("", &authority), ("strange_", &stranger)] {
            let (certificate, key) = certificate(issuer);
            write(&format!("{name}certificate.pem"), certificate);
            write(&format!("{name}key.pem"), key);
        }
        write("users.txt", "robot:change me\n".to_owned());
        let topic = format!("/{}", unique("secure"));
        let example =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/src/how-to/secure_zenoh.json5");
        let example = fs::read_to_string(example)
            .unwrap()
            .replace("/etc/eddy", folder.path().to_str().unwrap())
            .replace("0/particles/**", &format!("0{topic}/**"));
        Self { folder, example, topic }
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// A configuration for a process that listens there and connects there.
    fn configuration(&self, listen: u16, connect: u16, changes: &[(&str, &str)]) -> PathBuf {
        let mut text = self.example.clone();
        // With what is around them: the digits of one may be part of another port.
        let ports = [(r#":7460""#, listen), (r#":7461""#, connect)];
        let ports = ports.map(|(from, to)| (from, format!(r#":{to}""#)));
        let ports = ports.iter().map(|(from, to)| (*from, to.as_str()));
        for (from, to) in ports.chain(changes.iter().copied()) {
            assert!(text.contains(from), "{from}");
            text = text.replace(from, to);
        }
        let file = self.at(&format!("{listen}.json5"));
        fs::write(&file, text).unwrap();
        file
    }

    /// Records a topic until all frames are there.
    fn recorder(&self, name: &str, topic: &str, configuration: &Path) -> Process {
        let mut command = eddy(configuration);
        command.args(["record", &format!("zenoh:{topic}"), "--output"]).arg(self.at(name));
        let frames = FRAMES.to_string();
        command.args(["--max-messages", &frames]);
        Process::start_until(&mut command, "recording")
    }

    fn recorded(&self, name: &str) -> u64 {
        BagReader::open(&self.at(name)).unwrap().message_count()
    }

    /// Plays frames again and again, on the topic and on another one that no rule allows.
    fn player(&self, configuration: &Path) -> Command {
        let bag = self.at("truth");
        let mut writer = BagWriter::create(&bag, WriterOptions::default()).unwrap();
        let topics = ["/particles", "/forbidden"]
            .map(|topic| writer.topic(topic, ParticleFrame::TYPE).unwrap());
        for number in 0..FRAMES {
            let frame = frame(number as u64);
            for topic in topics {
                writer.write(topic, frame.stamp, frame.stamp, &frame.to_cdr()).unwrap();
            }
        }
        writer.finish().unwrap();
        let mut command = eddy(configuration);
        command.arg("replay").arg(bag).args(["--to", "zenoh", "--loop"]);
        command.args(["--remap", &format!("/particles:={}", self.topic)]);
        command.args(["--remap", &format!("/forbidden:={}_forbidden", self.topic)]);
        command
    }
}

fn eddy(configuration: &Path) -> Command {
    let mut command = talking_eddy();
    command.env("ZENOH_SESSION_CONFIG_URI", configuration).env("ROS_DOMAIN_ID", "0");
    command.env_remove("ZENOH_CONFIG_OVERRIDE");
    command
}

fn frame(sequence: u64) -> Frame {
    Frame {
        stream: 0,
        sequence,
        stamp: Stamp(sequence as i64 * 16_000_000),
        dt: 0.016,
        domain: Domain::UNIT,
        position: vec![[0.5, 0.5]],
        velocity: vec![[0.0, -1.0]],
        material: vec![Material::Snow],
    }
}

fn authority(name: &str) -> CertifiedIssuer<'static, KeyPair> {
    let mut params = CertificateParams::default();
    params.distinguished_name.push(DnType::CommonName, name);
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap()
}

/// A certificate for this machine, and its key.
fn certificate(issuer: &CertifiedIssuer<'static, KeyPair>) -> (String, String) {
    let key = KeyPair::generate().unwrap();
    let names = vec!["localhost".to_owned(), "127.0.0.1".to_owned()];
    let mut params = CertificateParams::new(names).unwrap();
    params.distinguished_name.push(DnType::CommonName, "robot");
    let certificate = params.signed_by(&key, issuer).unwrap();
    (certificate.pem(), key.serialize_pem())
}

#[test]
fn frames_pass_among_those_who_show_certificate_and_password_and_nobody_else_gets_one() {
    let place = Place::new();
    let ports: [u16; 7] = std::array::from_fn(|_| free_port());
    let [player, ..] = ports;
    let intruders: [(&str, &[(&str, &str)]); 4] = [
        ("wrong_password", &[("change me", "guess")]),
        (
            "without_certificate",
            &[("connect_", "// connect_"), ("enable_mtls: true", "enable_mtls: false")],
        ),
        (
            "strange_certificate",
            &[("/certificate.pem", "/strange_certificate.pem"), ("/key.pem", "/strange_key.pem")],
        ),
        (
            "without_tls",
            &[("\"tls/", "\"tcp/"), ("protocols: [\"tls\"]", "protocols: [\"tcp\", \"tls\"]")],
        ),
    ];
    // Who comes later meets a player that plays already: at its first try, before the allowed one has its frames.
    let nobody = free_port();
    let mut playing = Process::start_until(
        &mut place.player(&place.configuration(player, nobody, &[])),
        "publishing",
    );
    let mut recorders: Vec<_> = intruders
        .iter()
        .zip(&ports[1..])
        .map(|((name, changes), port)| {
            let configuration = place.configuration(*port, player, changes);
            (*name, place.recorder(name, &place.topic, &configuration))
        })
        .collect();
    // One who may be here, but not on that topic.
    let allowed = place.configuration(ports[5], player, &[]);
    let forbidden = format!("{}_forbidden", place.topic);
    recorders.push(("forbidden", place.recorder("forbidden", &forbidden, &allowed)));

    // Started as the others were, it gets what they did not.
    let allowed = place.configuration(ports[6], player, &[]);
    let mut recorder = place.recorder("allowed", &place.topic, &allowed);
    assert!(recorder.wait().success());
    assert_eq!(place.recorded("allowed"), FRAMES as u64);
    let frames = BagReader::open(&place.at("allowed")).unwrap();
    let frames: Vec<_> = frames.frames(&place.topic).unwrap().map(Result::unwrap).collect();
    assert!(frames.iter().all(|found| *found == frame(found.sequence)));

    assert!(playing.is_running());
    for (name, mut recorder) in recorders {
        assert!(recorder.is_running(), "{name} has its frames");
        recorder.interrupt();
        // The forbidden topic is found, and none of its frames; the others find no topic.
        let expected = i32::from(name != "forbidden");
        assert_eq!(recorder.wait().code(), Some(expected), "{name}");
        assert_eq!(place.recorded(name), 0, "{name}");
    }
    playing.interrupt();
    playing.wait();
}

#[test]
fn who_connects_asks_for_a_certificate_and_not_for_a_password() {
    let place = Place::new();
    let [nobody, player, guessing, strange, plain] = [(); 5].map(|()| free_port());
    type Replacements = [(&'static str, &'static str)];
    let listeners: [(&str, u16, &Replacements); 3] = [
        ("guessing", guessing, &[("change me", "guess")]),
        (
            "strange",
            strange,
            &[("/certificate.pem", "/strange_certificate.pem"), ("/key.pem", "/strange_key.pem")],
        ),
        (
            "plain",
            plain,
            &[("\"tls/", "\"tcp/"), ("protocols: [\"tls\"]", "protocols: [\"tcp\", \"tls\"]")],
        ),
    ];
    let mut recorders: Vec<_> = listeners
        .into_iter()
        .map(|(name, port, changes)| {
            let configuration = place.configuration(port, nobody, changes);
            (name, place.recorder(name, &place.topic, &configuration))
        })
        .collect();
    // It connects to all of them.
    let all = format!(
        r#""tls/127.0.0.1:{strange}", "tls/127.0.0.1:{plain}", "tls/127.0.0.1:{guessing}""#
    );
    let one = format!(r#""tls/127.0.0.1:{guessing}""#);
    let configuration = place.configuration(player, guessing, &[(&one, &all)]);
    let mut playing = Process::start_until(&mut place.player(&configuration), "publishing");

    // The password of who listens is not asked for.
    let (_, mut guessed) = recorders.remove(0);
    assert!(guessed.wait().success());
    assert_eq!(place.recorded("guessing"), FRAMES as u64);
    assert!(playing.is_running());
    for (name, mut recorder) in recorders {
        assert!(recorder.is_running(), "{name} has its frames");
        recorder.interrupt();
        assert_eq!(recorder.wait().code(), Some(1), "{name}: the topic was not found");
        assert_eq!(place.recorded(name), 0, "{name}");
    }
    playing.interrupt();
    playing.wait();
}
