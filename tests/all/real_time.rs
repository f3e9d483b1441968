//! Processors, priority and memory of a node.

use std::{fs, process::Stdio};

use crate::support::{Process, World, fail, talking_eddy};

/// Starts a node with `options`. Its process once it runs, or what it said instead.
fn node(world: &World, options: &[&str]) -> Result<Process, String> {
    let [input, output] = ["particles", "prediction"].map(|name| world.link("shm", name));
    let said = world.folder.path().join("said");
    let mut command = talking_eddy();
    command.args(["node", "--input", &input.to_string(), "--output", &output.to_string()]);
    command.args(options).stderr(Stdio::from(fs::File::create(&said).unwrap()));
    let mut process = Process::start(&mut command);
    let started = crate::support::wait_for("the node runs or fails", || {
        let maps = fs::read_to_string(format!("/proc/{}/maps", process.id())).unwrap_or_default();
        let threads = fs::read_dir(format!("/proc/{}/task", process.id()));
        // It has opened its topics, and receives.
        if maps.contains("iox2") && threads.is_ok_and(|threads| threads.count() > 2) {
            return Some(true);
        }
        (!process.is_running()).then_some(false)
    });
    if !started {
        return Err(fs::read_to_string(said).unwrap());
    }
    // All topics are open.
    process.line("predicting");
    Ok(process)
}

/// A field of a file in `/proc` of every thread.
fn of_threads(process: &Process, file: &str, field: impl Fn(&str) -> String) -> Vec<String> {
    let threads = fs::read_dir(format!("/proc/{}/task", process.id())).unwrap();
    let text = |thread: fs::DirEntry| fs::read_to_string(thread.path().join(file)).ok();
    threads.filter_map(|thread| text(thread.unwrap())).map(|text| field(&text)).collect()
}

fn line(text: &str, name: &str) -> String {
    text.lines().find_map(|line| line.strip_prefix(name)).unwrap().trim().to_owned()
}

#[test]
fn all_threads_of_a_node_run_on_the_given_processor() {
    let world = World::new("cpu");
    let allowed = fs::read_to_string("/proc/self/status").unwrap();
    let allowed = line(&allowed, "Cpus_allowed_list:");
    // The first of those that this process may use.
    let first = allowed.split(['-', ',']).next().unwrap();
    let node = node(&world, &["--cpu", first]).unwrap();
    let found = of_threads(&node, "status", |status| line(status, "Cpus_allowed_list:"));
    assert!(found.len() > 1 && found.iter().all(|cpus| cpus == first), "{found:?}");
}

#[test]
fn a_processor_that_cannot_be_had_is_named() {
    let message = fail(1, ["node", "--cpu", "1022-1023"]);
    assert!(message.contains("--cpu: found [1022, 1023], expected some of the"), "{message}");
    for cpus in ["", "a", "3-1", "4096", "1,,2"] {
        let message = fail(2, ["node", "--cpu", cpus]);
        assert!(message.contains("expected numbers from 0 to 1023 and ranges"), "{message}");
    }
}

/// Depends on the rights of who runs it: either the threads have the priority, or the message says which right is missing.
#[test]
fn all_threads_of_a_node_have_the_given_priority_or_the_missing_right_is_named() {
    let world = World::new("priority");
    match node(&world, &["--priority", "7"]) {
        Ok(node) => {
            // Fields 40 and 41 of the line, after the name in parentheses.
            let found = of_threads(&node, "stat", |stat| {
                let fields: Vec<_> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
                fields[37..39].join(" ")
            });
            // SCHED_FIFO is 1.
            assert!(found.len() > 1 && found.iter().all(|field| field == "7 1"), "{found:?}");
        }
        Err(said) => {
            let expected = "--priority: found 7, expected at most 0, the limit of this process";
            assert!(said.contains(expected) && said.contains("CAP_SYS_NICE"), "{said}");
        }
    }
}

/// As above.
#[test]
fn the_memory_of_a_node_is_locked_or_the_missing_right_is_named() {
    let world = World::new("memory");
    match node(&world, &["--lock-memory"]) {
        Ok(node) => {
            let status = fs::read_to_string(format!("/proc/{}/status", node.id())).unwrap();
            let locked = line(&status, "VmLck:");
            let kilobytes: u64 = locked.trim_end_matches(" kB").parse().unwrap();
            assert!(kilobytes > 10_000, "{locked}");
        }
        Err(said) => {
            let expected = "--lock-memory: this process may lock";
            assert!(said.contains(expected) && said.contains("CAP_IPC_LOCK"), "{said}");
        }
    }
}
