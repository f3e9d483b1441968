//! Overhead of the live page, and the frame rate that a browser receives without drawing.

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
use eddy_node::viewer::{
    Comparison, Hub, NoControls, PageInfo, PredictionInfo, Viewer, ViewerError,
};
use eddy_transport::ListenAddress;

/// Parameters of the benchmark.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Particles of a frame.
    pub particles: usize,
    /// Frame rate (Hz), each frame with its prediction.
    pub hertz: f64,
    /// Duration (s).
    pub seconds: f64,
    /// Number of browsers that read.
    pub readers: usize,
    /// Number of browsers that never read.
    pub silent: usize,
}

/// Results of the benchmark.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Timing {
    /// Time to publish a frame and its prediction to the page.
    pub publish: Spread,
    /// Published frames per second.
    pub published: f64,
    /// Frames per second received by a reader (mean over readers); NaN without readers.
    pub arrived: f64,
    /// Bytes per second received by a reader.
    pub bytes: f64,
}

/// Why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The shipped checkpoint, which provides gravity and walls of the baselines, cannot be read.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The page cannot be served.
    #[error(transparent)]
    Viewer(#[from] ViewerError),
    /// A reader failed.
    #[error("a reader: {0}")]
    Reader(#[from] io::Error),
}

/// Publishes to a page with readers, until `is_over`.
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
        PageInfo::default(),
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
            let info = PredictionInfo { source: truth.sequence, horizon: 1, free_running: false };
            hub.predicted(&predicted, info);
            hub.observed(&FrameView::from(&truth));
            publish.push(clock.now() - start);
        }
        let seconds = clock.now().as_secs_f64();
        stop.store(true, Ordering::Relaxed);
        // Ends the connections that readers wait on.
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

/// A browser that acknowledges frames at once, without drawing.
struct Reader(TcpStream);

impl Reader {
    /// Connects as a WebSocket (RFC 6455).
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

    /// Reads until the page closes. Counts frames and bytes until `stop`.
    fn read(mut self, stop: &AtomicBool, counts: &[AtomicU64; 2]) -> io::Result<()> {
        let mut payload = Vec::new();
        loop {
            // The connection may also end without a close message.
            let Ok(kind) = self.message(&mut payload) else { return Ok(()) };
            if kind == BINARY && !stop.load(Ordering::Relaxed) {
                counts[0].fetch_add(1, Ordering::Relaxed);
                counts[1].fetch_add(payload.len() as u64, Ordering::Relaxed);
                // The page may have closed already.
                let _ = self.send(br#"{"drawn":1}"#);
            }
        }
    }

    /// One server message: unfragmented and unmasked.
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

    /// Sends a short message with a zero mask.
    fn send(&mut self, text: &[u8]) -> io::Result<()> {
        let head = [0x81, 0x80 | text.len() as u8, 0, 0, 0, 0];
        self.0.write_all(&[&head, text].concat())
    }
}

/// The opcode of binary messages.
const BINARY: u8 = 2;
