//! A folder that starts like a clone of the repository, and a shell in it.

use std::{
    fs::{self, File},
    io::Read as _,
    os::unix::fs::symlink,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    thread,
    time::{Duration, Instant},
};

use tempfile::TempDir;

use super::{follow::root, short::short};
use crate::{
    programs,
    support::{domain, free_port},
};

/// Programs besides those of eddy that pages may use.
const SHELL: &[&str] = &["cat", "cp", "ls", "mkdir", "rm", "source"];

/// Time limit of a command.
const DEADLINE: Duration = Duration::from_secs(120);

/// Settings that make an epoch short.
const QUICK: &str = "\
unroll = [{ share = 1.0, frames = 2 }]
windows.per_epoch = 16
windows.batch = 8
validation.horizon = 5
validation.starts = 1
";

/// A folder that starts like a clone of the repository, and a shell in it.
pub struct World {
    folder: TempDir,
    domain: u16,
    ports: [u16; 2],
    started: usize,
}

/// A running command.
struct Running {
    line: String,
    child: Child,
    output: PathBuf,
}

/// Settings that make a study short.
const STUDY: &str = "\
seeds = [1]
cores = ['mingru', 'mlp']
activations = ['elu']
step_seconds = 0.01
step_frames = [2]
data.scenes = 3
data.duration = 0.6
training.epochs = 1
training.network.hidden = 16
training.windows.batch = 4
training.windows.per_epoch = 4
dense.epochs = 1
dense.per_epoch = 32
evaluation.horizon = 5
evaluation.starts = 1
";

impl World {
    /// A folder with the files of a clone, and the programs in the path.
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        for name in ["bags/sample", "checkpoints/particle-mingru", "launch_configs"] {
            copy(&root().join(name), &folder.path().join(name));
        }
        // In place of one that PyTorch has made.
        let shipped = root().join("checkpoints/particle-mingru");
        copy(&shipped, &folder.path().join("checkpoints/elsewhere"));
        fs::create_dir(folder.path().join(".bin")).unwrap();
        for program in programs() {
            let name = program.file_name().unwrap();
            symlink(&program, folder.path().join(".bin").join(name)).unwrap();
        }
        let ports = [free_port(), free_port()];
        let world = Self { folder, domain: domain(), ports, started: 0 };
        world.save("quick.toml", QUICK);
        world.save("study.toml", STUDY);
        world.shrink();
        world
    }

    /// Makes settings files short, as [`short`] makes commands.
    fn shrink(&self) {
        for entry in fs::read_dir(self.at("launch_configs/train")).unwrap() {
            let file = entry.unwrap().path();
            let mut table: toml::Table = fs::read_to_string(&file).unwrap().parse().unwrap();
            let quick: toml::Table = QUICK.parse().unwrap();
            for (key, value) in quick {
                match (table.get_mut(&key), value) {
                    (Some(toml::Value::Table(there)), toml::Value::Table(new)) => there.extend(new),
                    (_, value) => drop(table.insert(key, value)),
                }
            }
            fs::write(&file, table.to_string()).unwrap();
        }
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes a file that a page tells its reader to save.
    pub fn save(&self, name: &str, text: &str) {
        let path = self.at(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    /// Runs commands one after the other; endless ones are interrupted.
    pub fn one_after_another(&mut self, place: &str, lines: &[String]) {
        for line in lines {
            let mut running = self.start(place, line);
            if endless(line) {
                wait(place, "prints something", &mut running, |running| !running.said().is_empty());
                running.interrupt();
            }
            running.ends_well(place);
        }
    }

    /// Runs commands in parallel until the last one has ended, then interrupts the others.
    pub fn together(&mut self, place: &str, lines: &[String]) {
        let mut running: Vec<_> = lines.iter().map(|line| self.start(place, line)).collect();
        let Some(mut last) = running.pop() else { return };
        if endless(&last.line) {
            wait(place, "has begun", &mut last, |last| last.has_begun());
            last.interrupt();
        }
        last.ends_well(place);
        while let Some(mut other) = running.pop() {
            wait(place, "prints something", &mut other, |other| {
                !other.said().is_empty() || other.child.try_wait().unwrap().is_some()
            });
            if other.child.try_wait().unwrap().is_none() {
                other.interrupt();
            }
            other.ends_well(place);
        }
    }

    /// Starts a command.
    fn start(&mut self, place: &str, line: &str) -> Running {
        let cheap = self.cheaper(line);
        let program = cheap.split(' ').find(|word| !word.contains('=')).unwrap_or_default();
        assert!(
            self.at(".bin").join(program).exists() || SHELL.contains(&program),
            "{place}: `{line}`: found {program}, expected a program of this package, one of {SHELL:?}, or a block with skip=\"REASON\""
        );
        self.started += 1;
        let output = self.at(&format!(".output{}", self.started));
        let file = File::create(&output).unwrap();
        let path = std::env::var("PATH").unwrap();
        let mut bash = Command::new("bash");
        bash.args(["-c", &cheap]).current_dir(self.folder.path());
        bash.env("PATH", format!("{}:{path}", self.at(".bin").display()));
        bash.env("HOME", self.folder.path()).env("ROS_DOMAIN_ID", self.domain.to_string());
        bash.stdin(Stdio::null()).stdout(file.try_clone().unwrap()).stderr(file);
        Running { line: cheap, child: bash.spawn().unwrap(), output }
    }

    fn cheaper(&self, line: &str) -> String {
        let [port, other_port] = self.ports.map(|port| port.to_string());
        short(line).replace("{port}", &port).replace("{other_port}", &other_port)
    }
}

impl Running {
    /// Its output so far.
    fn said(&self) -> String {
        let mut said = Vec::new();
        File::open(&self.output).unwrap().read_to_end(&mut said).unwrap();
        String::from_utf8_lossy(&said).into_owned()
    }

    /// Whether it prints something; a recorder, whether it records a topic, and every link that it was given.
    fn has_begun(&self) -> bool {
        let said = self.said();
        let records = self.line.starts_with("eddy record");
        let links = self.line.split(' ').filter(|word| records && word.contains(":/"));
        !said.is_empty()
            && (!records || said.contains(":/"))
            && links.into_iter().all(|link| said.contains(&format!("recording {link}")))
    }

    /// Interrupts it like Ctrl-C; bash replaces itself by a single command.
    fn interrupt(&self) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").args(["-INT", &id]).status().unwrap().success());
    }

    fn ends_well(&mut self, place: &str) {
        wait(place, "ends", self, |running| running.child.try_wait().unwrap().is_some());
        let status = self.child.wait().unwrap();
        assert!(status.success(), "{place}: `{}`: {status}\n{}", self.line, self.said());
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn wait(
    place: &str,
    what: &str,
    running: &mut Running,
    mut done: impl FnMut(&mut Running) -> bool,
) {
    let start = Instant::now();
    while !done(running) {
        let late = start.elapsed() > DEADLINE;
        assert!(!late, "{place}: waited until `{}` {what}:\n{}", running.line, running.said());
        thread::sleep(Duration::from_millis(20));
    }
}

/// Whether a command runs until it is interrupted.
fn endless(line: &str) -> bool {
    let has = |word: &str| line.split(' ').any(|other| other == word);
    let bounded = ["--stop-after", "--max-messages", "--count", "--duration", "--help"];
    let lasting = has("node") && !has("bench")
        || has("record")
        || has("tools")
        || has("echo")
        || has("hz")
        || has("replay") && has("--loop");
    lasting && !bounded.into_iter().any(has)
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        if entry.path().is_dir() {
            copy(&entry.path(), &to.join(entry.file_name()));
        } else {
            fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
        }
    }
}
