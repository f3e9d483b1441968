//! What the live page costs who is looked at, and how many frames arrive at a browser that draws nothing.

use std::{
    io::{self, Read, Write},
    net::{SocketAddr, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::Duration,
};

use serde::Serialize;

use super::{Spread, particles};
use eddy_frames::{FrameView, clock::Clock};
use eddy_inference::checkpoint::{Checkpoint, CheckpointError};
use eddy_node::viewer::{Ahead, Comparison, Hub, NoControls, Program, Viewer, ViewerError};
use eddy_transport::ListenAddress;

/// What is measured.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Particles of a frame.
    pub particles: usize,
    /// Frames a second, each with its prediction.
    pub hertz: f64,
    /// How long (s).
    pub seconds: f64,
    /// Browsers that read at once.
    pub readers: usize,
    /// Browsers that never read.
    pub silent: usize,
}

/// What it took.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Timing {
    /// The time that handing over a frame and its prediction took.
    pub publish: Spread,
    /// Frames that were handed over (per second).
    pub published: f64,
    /// Frames that arrived at a reader (per second, the mean of all); no number without readers.
    pub arrived: f64,
    /// Bytes that arrived at a reader (per second).
    pub bytes: f64,
}

/// Why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The shipped checkpoint, whose gravity and walls the baselines have, cannot be read.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// There is no page.
    #[error(transparent)]
    Viewer(#[from] ViewerError),
    /// A reader failed.
    #[error("a reader: {0}")]
    Reader(#[from] io::Error),
}

/// Publishes to a page that so many look at, until `is_over`.
///
/// # Errors
/// [`BenchError`].
pub fn time(plan: &Plan, is_over: &dyn Fn() -> bool) -> Result<Timing, BenchError> {
    let hub = Arc::new(Hub::default());
    let comparison = Comparison::new(&Checkpoint::shipped()?.description);
    let viewer = Viewer::start(
        ListenAddress::loopback(0),
        Arc::clone(&hub),
        comparison,
        Program::default(),
        Arc::new(NoControls),
    )?;
    let address = viewer.address();
    let _silent =
        (0..plan.silent).map(|_| Reader::connect(address)).collect::<Result<Vec<_>, _>>()?;
    let readers =
        (0..plan.readers).map(|_| Reader::connect(address)).collect::<Result<Vec<_>, _>>()?;
    let (stop, counts) = (AtomicBool::new(false), [AtomicU64::new(0), AtomicU64::new(0)]);
    thread::scope(|scope| {
        let (stop, counts) = (&stop, &counts);
        let reading: Vec<_> = readers
            .into_iter()
            .map(|reader| scope.spawn(move || reader.read(stop, counts)))
            .collect();
        let (mut truth, mut predicted) =
            (particles::frame(plan.particles), particles::frame(plan.particles));
        let mut publish = Vec::new();
        let clock = Clock::start();
        for number in 0u32.. {
            let due = Duration::from_secs_f64(f64::from(number) / plan.hertz);
            thread::sleep(due.saturating_sub(clock.now()));
            if clock.now().as_secs_f64() > plan.seconds || is_over() {
                break;
            }
            truth.sequence = u64::from(number);
            predicted.sequence = truth.sequence + 1;
            let start = clock.now();
            let ahead = Ahead { source: truth.sequence, frames: 1, free: false };
            hub.predicted(&predicted, ahead);
            hub.observed(&FrameView::from(&truth));
            publish.push(clock.now() - start);
        }
        let seconds = clock.now().as_secs_f64();
        stop.store(true, Ordering::Relaxed);
        // Readers wait for bytes: the end of the page is the end of their wait.
        drop(viewer);
        for reader in reading {
            match reader.join() {
                Ok(outcome) => outcome?,
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        let each = |count: &AtomicU64| {
            count.load(Ordering::Relaxed) as f64 / plan.readers as f64 / seconds
        };
        Ok(Timing {
            published: publish.len() as f64 / seconds,
            publish: Spread::of(publish),
            arrived: each(&counts[0]),
            bytes: each(&counts[1]),
        })
    })
}

/// A browser that draws nothing, and says at once that it has.
struct Reader(TcpStream);

impl Reader {
    /// Connects as RFC 6455 has it.
    fn connect(address: SocketAddr) -> io::Result<Self> {
        let mut stream = TcpStream::connect(address)?;
        stream.set_nodelay(true)?;
        write!(
            stream,
            "GET /ws HTTP/1.1\r\nHost: {address}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
        )?;
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte)?;
            head.extend(byte);
        }
        if head.starts_with(b"HTTP/1.1 101") {
            return Ok(Self(stream));
        }
        Err(io::Error::other(String::from_utf8_lossy(&head).into_owned()))
    }

    /// Reads until the page ends. Counts frames, and their bytes, until `stop`.
    fn read(mut self, stop: &AtomicBool, counts: &[AtomicU64; 2]) -> io::Result<()> {
        let mut payload = Vec::new();
        loop {
            // An end without notice is one, too.
            let Ok(kind) = self.message(&mut payload) else { return Ok(()) };
            if kind == BINARY && !stop.load(Ordering::Relaxed) {
                counts[0].fetch_add(1, Ordering::Relaxed);
                counts[1].fetch_add(payload.len() as u64, Ordering::Relaxed);
                // Whoever was told the end does not listen any more.
                let _ = self.say(br#"{"drawn":1}"#);
            }
        }
    }

    /// One message of a server, which sends them whole and without a mask.
    fn message(&mut self, payload: &mut Vec<u8>) -> io::Result<u8> {
        let mut head = [0; 2];
        self.0.read_exact(&mut head)?;
        let length = match head[1] & 127 {
            126 => {
                let mut length = [0; 2];
                self.0.read_exact(&mut length)?;
                u64::from(u16::from_be_bytes(length))
            }
            127 => {
                let mut length = [0; 8];
                self.0.read_exact(&mut length)?;
                u64::from_be_bytes(length)
            }
            short => u64::from(short),
        };
        payload.resize(length as usize, 0);
        self.0.read_exact(payload)?;
        Ok(head[0] & 15)
    }

    /// Says something short, with a mask of zeros.
    fn say(&mut self, text: &[u8]) -> io::Result<()> {
        let head = [0x81, 0x80 | text.len() as u8, 0, 0, 0, 0];
        self.0.write_all(&[&head, text].concat())
    }
}

/// The opcode of a message of bytes.
const BINARY: u8 = 2;
