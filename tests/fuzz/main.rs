//! Hostile bytes, the short run: every input of the corpus, then changed ones for some seconds.
//!
//! `EDDY_FUZZ_SECONDS` says how long for each kind (2 by default), `EDDY_FUZZ_SEED` where it starts. The
//! input that is being read lies in `fuzz_<kind>.last` of cargo's folder for temporary files, so that one
//! that ends the process can be looked at. `README.md` beside this file tells of the long run.
#![expect(clippy::unwrap_used, reason = "a test that cannot go on fails")]
#![expect(clippy::disallowed_methods, reason = "tests wait for other processes, with deadlines")]
#![expect(unsafe_code, reason = "an allocator that counts")]

mod change;
mod seeds;
mod targets;

use std::{
    alloc::{GlobalAlloc, Layout, System},
    fs,
    path::{Path, PathBuf},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicU64, AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use change::Changer;
use eddy_inference::checkpoint::Architecture;
use targets::TARGETS;

/// Memory that reading an input may take at the same time (bytes), and as a multiple of its length; of MCAP
/// files, what zstd can make of a byte, twice.
const MEMORY: usize = 64 << 20;
const MEMORY_FACTOR: usize = 64;
const COMPRESSED_FACTOR: usize = 1 << 16;
/// Time that reading an input may take on a machine that does other things as well.
const PATIENCE: Duration = Duration::from_secs(10);
/// Longest changed input (bytes).
const LONGEST: usize = 1 << 14;

/// Counts the memory that is in use.
struct Counting;

static USED: AtomicUsize = AtomicUsize::new(0);
static MOST: AtomicUsize = AtomicUsize::new(0);

fn took(size: usize) {
    let used = USED.fetch_add(size, Ordering::Relaxed) + size;
    MOST.fetch_max(used, Ordering::Relaxed);
}

// SAFETY: every call goes to the system's allocator as it is.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        took(layout.size());
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        took(layout.size());
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        took(size);
        USED.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        USED.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn corpus(target: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/corpus").join(target)
}

/// The inputs of the corpus, sorted by name.
fn inputs(target: &str) -> Vec<Vec<u8>> {
    let mut files: Vec<_> =
        fs::read_dir(corpus(target)).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files.iter().map(|file| fs::read(file).unwrap()).collect()
}

fn setting(name: &str) -> Option<u64> {
    Some(std::env::var(name).ok()?.parse().expect("a whole number"))
}

/// Reads inputs and holds each to its bounds.
struct Reader<'a> {
    name: &'a str,
    last: PathBuf,
}

impl<'a> Reader<'a> {
    fn new(name: &'a str) -> Self {
        let last = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("fuzz_{name}.last"));
        Self { name, last }
    }

    fn read(&self, input: &[u8]) {
        let name = self.name;
        fs::write(&self.last, input).unwrap();
        let before = USED.load(Ordering::Relaxed);
        MOST.store(before, Ordering::Relaxed);
        STARTED.store(now(), Ordering::Relaxed);
        let start = Instant::now();
        targets::read(name, input);
        STARTED.store(0, Ordering::Relaxed);
        let (took, last) = (start.elapsed(), self.last.display());
        assert!(took < PATIENCE, "{name}: {last} took {took:?}");
        let memory = MOST.load(Ordering::Relaxed).saturating_sub(before);
        let factor = if name == "mcap" { COMPRESSED_FACTOR } else { MEMORY_FACTOR };
        let most = MEMORY + factor * input.len();
        assert!(memory <= most, "{name}: {last} took {memory} bytes, expected at most {most}");
    }
}

/// When the input that is being read was begun (ms); 0 between two of them.
static STARTED: AtomicU64 = AtomicU64::new(0);

fn now() -> u64 {
    static START: std::sync::OnceLock<Instant> = std::sync::OnceLock::new();
    1 + START.get_or_init(Instant::now).elapsed().as_millis() as u64
}

/// Ends the process when an input keeps it busy for good, which no assertion after it would notice.
fn watch() {
    static WATCHING: std::sync::Once = std::sync::Once::new();
    WATCHING.call_once(|| {
        thread::spawn(|| {
            loop {
                thread::sleep(Duration::from_millis(500));
                let started = STARTED.load(Ordering::Relaxed);
                if started > 0 && now() - started > 2 * PATIENCE.as_millis() as u64 {
                    println!("an input is not read to its end; see fuzz_*.last");
                    std::process::abort();
                }
            }
        });
    });
}

/// One at a time: memory is counted for the whole process.
static TURN: Mutex<()> = Mutex::new(());

fn reads_whatever_comes(name: &str) {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    watch();
    let reader = Reader::new(name);
    let corpus = inputs(name);
    assert!(!corpus.is_empty());
    corpus.iter().for_each(|input| reader.read(input));
    let seconds = Duration::from_secs(setting("EDDY_FUZZ_SECONDS").unwrap_or(2));
    let mut changer = Changer::new(setting("EDDY_FUZZ_SEED").unwrap_or(1), corpus);
    let start = Instant::now();
    let mut inputs = 0_u64;
    while start.elapsed() < seconds {
        reader.read(&changer.next(LONGEST));
        inputs += 1;
    }
    println!("{name}: {inputs} changed inputs");
}

/// A test for each kind.
macro_rules! targets {
    ($($test:ident: $name:literal,)*) => {
        $(#[test]
        fn $test() {
            reads_whatever_comes($name);
        })*

        #[test]
        fn every_kind_of_input_is_read_here() {
            let here = [$($name),*];
            let all: Vec<_> = TARGETS.iter().map(|(name, _)| *name).collect();
            assert_eq!(here.as_slice(), all);
        }
    };
}

targets! {
    messages_in_cdr_are_read_whatever_they_are: "cdr",
    mcap_files_are_read_and_recovered_whatever_they_are: "mcap",
    metadata_is_read_whatever_it_is: "metadata",
    attachments_are_read_whatever_they_are: "attachment",
    names_are_read_whatever_they_are: "names",
    samples_in_shared_memory_are_read_whatever_they_are: "shm",
    checkpoints_are_read_whatever_they_are: "checkpoint",
    settings_are_read_whatever_they_are: "toml",
    scenes_are_read_whatever_they_are: "scene",
}

#[test]
fn the_corpus_has_networks_of_every_architecture() {
    let inputs = inputs("checkpoint");
    for architecture in [Architecture::Frame, Architecture::Particle] {
        let said = format!("architecture = \"{}\"", architecture.name());
        let has = |input: &Vec<u8>| String::from_utf8_lossy(input).contains(&said);
        assert!(inputs.iter().any(has), "{said}");
    }
}
