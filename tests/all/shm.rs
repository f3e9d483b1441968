//! A node in shared memory, with peers that are killed.

use eddy_messages::{Message, ParticleFrame};
use eddy_transport::{Link, TransportOptions, Transports};

use crate::support::{Process, talking_eddy, unique, wait_for};

#[test]
fn a_node_goes_on_when_its_peers_are_killed() {
    let topics = unique("node");
    let link = |name: &str| -> Link { format!("shm:/{topics}/{name}").parse().unwrap() };
    let (input, output) = (link("particles"), link("prediction"));
    let mut node = talking_eddy();
    node.args(["node", "--input", &input.to_string(), "--output", &output.to_string()]);
    let mut node = Process::start_until(&mut node, "predicting");
    assert!(node.line("shm:/").contains(" uses 16.5 MB (1 publishers, 0 subscribers)"));
    let watch = Transports::new(TransportOptions::new("eddy_test"));
    let users = |link| watch.shared_memory(link, ParticleFrame::TYPE).unwrap().unwrap();
    // More often than a topic has room for either.
    for _ in 0..10 {
        let mut reader = talking_eddy();
        let mut reader = Process::start(reader.args(["topic", "echo", &output.to_string()]));
        let sample = concat!(env!("CARGO_MANIFEST_DIR"), "/bags/sample");
        let mut source = talking_eddy();
        source.args(["replay", sample, "--loop", "--reliability", "drop", "--to", "shm"]);
        source.args(["--remap", &format!("/particles:={}", input.topic)]);
        let source = Process::start_until(&mut source, "publishing");
        reader.line("header:");
        reader.kill();
        source.kill();
        wait_for("the dead are cleared away", || {
            let gone = users(&input).publishers == 0 && users(&output).subscribers == 0;
            gone.then_some(())
        });
        assert!(node.is_running());
    }
    node.interrupt();
    assert!(node.wait().success());
}
