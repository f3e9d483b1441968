//! File descriptors: what a transport needs is known before, and too few are an error instead of a panic of a library.

use std::{
    env, fs,
    process::{Command, Output},
};

use eddy_messages::{FrameCdr as _, Message as _, ParticleFrame, RosString};
use eddy_transport::{Link, Reliability, TransportKind, Transports};

use super::{domain, in_space, link, options};

const VARIABLE: &str = "EDDY_TEST_DESCRIPTORS";
/// The most that a test opens.
const MOST: usize = 40;

/// Runs [`child`] with this limit of descriptors, soft and hard.
fn run(limit: u32, task: &str, link: &Link) -> Output {
    let options = options();
    let ports = &options.zenoh.ports;
    let task = format!("{task} {link} {} {} {}", ports.start(), ports.end(), domain());
    let output = Command::new("sh")
        .args(["-c", r#"ulimit -n "$1" && shift && exec "$@""#, "sh", &limit.to_string()])
        .arg(env::current_exe().unwrap())
        .args(["--ignored", "--exact", "descriptors::child", "--nocapture", "--test-threads=1"])
        .env(VARIABLE, task)
        .output()
        .unwrap();
    println!("{}", String::from_utf8_lossy(&output.stdout));
    output
}

fn transports() -> impl Iterator<Item = TransportKind> {
    [TransportKind::Shm, TransportKind::Zenoh, TransportKind::Dds].into_iter()
}

/// Prints, with `--nocapture`, how many descriptors were opened.
#[test]
fn what_is_reserved_suffices() {
    for transport in transports() {
        for side in ["publishers", "subscribers", "frame_publishers", "frame_subscribers"] {
            let output = run(400, side, &link(transport.name()));
            let error = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{transport} {side}: {error}");
        }
    }
}

#[test]
fn too_few_for_a_transport_are_an_error_with_the_numbers() {
    for transport in transports() {
        let link = link(transport.name());
        let output = run(16, "refused", &link);
        let (said, error) = (output.stdout, output.stderr);
        assert!(output.status.success(), "{transport}: {}", String::from_utf8_lossy(&error));
        let said = String::from_utf8_lossy(&said).into_owned();
        assert!(said.contains(&format!("{link}/0: needs ")), "{said}");
        assert!(said.contains("open of 16, the most that this process may open"), "{said}");
    }
}

fn open() -> usize {
    fs::read_dir("/proc/self/fd").unwrap().count() - 1
}

#[test]
#[ignore = "the process that other tests start; does nothing by itself"]
fn child() {
    let Ok(task) = env::var(VARIABLE) else { return };
    let words: Vec<&str> = task.split(' ').collect();
    let [role, link, start, end, domain] = words[..] else { panic!("{VARIABLE}={task}") };
    let link: Link = link.parse().unwrap();
    let mut options = options();
    options.zenoh.ports = start.parse().unwrap()..=end.parse().unwrap();
    options.domain_id = domain.parse().unwrap();
    let transports = Transports::new(options);
    let topic = |number: usize| link.with_topic(&format!("{}/{number}", link.topic));
    let of_frames = role.starts_with("frame_");
    let type_name = if of_frames { ParticleFrame::TYPE } else { RosString::TYPE };
    let publisher = |number| transports.publisher(&topic(number), type_name, Reliability::Block);
    let subscriber = |number| transports.subscriber(&topic(number), type_name);
    if role == "refused" {
        println!("{}", publisher(0).err().unwrap());
        println!("{}", subscriber(0).err().unwrap());
        println!("{}", transports.topics(link.transport).err().unwrap());
        return;
    }
    let before = open();
    let may = |number: usize| {
        let types = vec![type_name; number];
        let of: [&[&str]; 2] =
            if role.ends_with("publishers") { [&types, &[]] } else { [&[], &types] };
        transports.reserve(link.transport, of[0], of[1]).is_ok()
    };
    let number = (1..=MOST).take_while(|&number| may(number)).last().expect("one is possible");
    let (mut publishers, mut subscribers, mut first) = (Vec::new(), Vec::new(), 0);
    for number in 0..number {
        if role.ends_with("subscribers") {
            subscribers.push(subscriber(number).unwrap());
        } else {
            let mut publisher = publisher(number).unwrap();
            if of_frames {
                // What a publisher opens at most: for frames of either dimension.
                publisher.publish_cdr(&in_space(0, 1).to_cdr()).unwrap();
            }
            publishers.push(publisher);
        }
        if number == 0 {
            first = open() - before;
        }
    }
    let all = open() - before;
    println!("{link}: {number} {role}: {all} descriptors, {first} with the first");
}
