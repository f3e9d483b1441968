//! Who may connect to the server, and how many.
//!
//! The server of Foxglove's SDK (0.30) takes any number of connections, from pages of any origin, and waits for a
//! request for ever. It therefore listens on an address of its own within this machine, and connections reach it
//! through this gate.

use std::{
    collections::BTreeMap,
    io::{self, Read as _, Write as _},
    net::{Shutdown, SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use crate::lock;
use eddy_frames::clock::Clock;

/// Maximum number of connections.
const MAX_CONNECTIONS: usize = 32;
/// How long a request's head may take.
const HEAD_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum size of a request's head (bytes).
const MAX_HEAD: usize = 8 << 10;
/// Timeout of the connection to the server, and of the one that wakes the gate.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(1);
/// Pause after a failed accept, for example without free file descriptors.
const RETRY: Duration = Duration::from_millis(100);

/// An open gate; closed, with all connections, when it is dropped.
pub(super) struct Gate {
    address: SocketAddr,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    server: SocketAddr,
    /// Origins that are allowed beside Foxglove's own.
    origins: Vec<String>,
    connections: Mutex<BTreeMap<u64, TcpStream>>,
    stop: AtomicBool,
}

impl Gate {
    /// Passes connections to `listener` on to `server`.
    pub(super) fn open(
        listener: TcpListener,
        server: SocketAddr,
        origins: Vec<String>,
    ) -> io::Result<Self> {
        let address = listener.local_addr()?;
        let (connections, stop) = Default::default();
        let shared = Arc::new(Shared { server, origins, connections, stop });
        let accepting = Arc::clone(&shared);
        let thread = thread::Builder::new()
            .name("foxglove gate".to_owned())
            .spawn(move || accept(&listener, &accepting))?;
        Ok(Self { address, shared, thread: Some(thread) })
    }

    pub(super) fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Gate {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        let mut address = self.address;
        if address.ip().is_unspecified() {
            address.set_ip(match address {
                SocketAddr::V4(_) => std::net::Ipv4Addr::LOCALHOST.into(),
                SocketAddr::V6(_) => std::net::Ipv6Addr::LOCALHOST.into(),
            });
        }
        // A gate that cannot be woken is left behind.
        if TcpStream::connect_timeout(&address, CONNECT_TIMEOUT).is_ok()
            && let Some(thread) = self.thread.take()
        {
            let _ = thread.join(); // a panic has been reported
        }
        for connection in lock(&self.shared.connections).values() {
            let _ = connection.shutdown(Shutdown::Both); // it may be closed already
        }
    }
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    for number in 0.. {
        let accepted = listener.accept();
        if shared.stop.load(Ordering::Relaxed) {
            return;
        }
        let outcome = accepted.and_then(|(viewer, _)| shared.begin(number, viewer));
        if let Err(error) = outcome {
            tracing::warn!("foxglove: {error}");
            thread::sleep(RETRY);
        }
    }
}

impl Shared {
    /// Starts the thread of a connection, unless there are too many.
    fn begin(self: &Arc<Self>, number: u64, mut viewer: TcpStream) -> io::Result<()> {
        let mut connections = lock(&self.connections);
        if connections.len() >= MAX_CONNECTIONS {
            let full = format!("{MAX_CONNECTIONS} viewers are connected, no more are accepted");
            viewer.set_nonblocking(true)?;
            // The head of a response fits into the empty buffer of a new connection.
            return refuse(&mut viewer, "503 Service Unavailable", &full);
        }
        connections.insert(number, viewer.try_clone()?);
        drop(connections);
        let shared = Arc::clone(self);
        let run = move || {
            if let Err(error) = shared.connect(viewer) {
                tracing::debug!("foxglove: {error}");
            }
            lock(&shared.connections).remove(&number);
        };
        thread::Builder::new().name("foxglove viewer".to_owned()).spawn(run)?;
        Ok(())
    }

    /// Checks the request of a connection and passes it on until one side closes it.
    fn connect(&self, mut viewer: TcpStream) -> io::Result<()> {
        let head = read_head(&mut viewer)?;
        if let Err(origin) = check(&head, &self.origins) {
            tracing::warn!(
                "foxglove: connection rejected: Origin: found {origin}, expected Foxglove's; \
                 allow it with --foxglove-origin {origin}"
            );
            return refuse(&mut viewer, "403 Forbidden", "this origin may not connect");
        }
        viewer.set_read_timeout(None)?;
        let mut server = TcpStream::connect_timeout(&self.server, CONNECT_TIMEOUT)?;
        server.set_nodelay(true)?;
        viewer.set_nodelay(true)?;
        server.write_all(&head)?;
        let (mut from, mut into) = (viewer.try_clone()?, server.try_clone()?);
        let requests =
            thread::Builder::new().name("foxglove viewer".to_owned()).spawn(move || {
                let copied = io::copy(&mut from, &mut into);
                // Ends the other direction.
                let _ = into.shutdown(Shutdown::Both);
                copied.map(drop)
            })?;
        let copied = io::copy(&mut server, &mut viewer);
        let _ = (viewer.shutdown(Shutdown::Both), server.shutdown(Shutdown::Both));
        let _ = requests.join(); // a panic has been reported
        copied.map(drop)
    }
}

/// Reads a request up to the empty line after its head, and whatever has arrived after it.
fn read_head(stream: &mut TcpStream) -> io::Result<Vec<u8>> {
    let (clock, mut head, mut part) = (Clock::start(), Vec::new(), [0; 1024]);
    while !head.windows(4).any(|end| end == b"\r\n\r\n") {
        let left = HEAD_TIMEOUT.saturating_sub(clock.now());
        if left.is_zero() || head.len() > MAX_HEAD {
            return Err(io::Error::other("the head of a request is too slow or too long"));
        }
        stream.set_read_timeout(Some(left))?;
        let read = stream.read(&mut part)?;
        if read == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        head.extend(&part[..read]);
    }
    Ok(head)
}

fn refuse(stream: &mut TcpStream, status: &str, reason: &str) -> io::Result<()> {
    let length = reason.len() + 1;
    write!(
        stream,
        "HTTP/1.1 {status}\r\nContent-Type: text/plain\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n{reason}\n"
    )?;
    stream.shutdown(Shutdown::Write)
}

/// Checks the origin of a request: programs send none, browsers that of the page.
fn check(head: &[u8], allowed: &[String]) -> Result<(), String> {
    let head = String::from_utf8_lossy(head);
    let lines = head.split("\r\n").take_while(|line| !line.is_empty());
    let origins = lines.skip(1).filter_map(|line| {
        let (name, value) = line.split_once(':')?;
        name.trim().eq_ignore_ascii_case("origin").then(|| value.trim().to_owned())
    });
    let is_allowed = |origin: &str| {
        is_foxglove(origin) || allowed.iter().any(|other| other.eq_ignore_ascii_case(origin))
    };
    let foreign = origins.into_iter().find(|origin| !is_allowed(origin));
    foreign.map_or(Ok(()), Err)
}

/// Whether this is Foxglove in a browser, or its desktop application.
fn is_foxglove(origin: &str) -> bool {
    let host = origin.strip_prefix("https://").map(str::to_ascii_lowercase);
    origin == "file://"
        || host.is_some_and(|host| host == "foxglove.dev" || host.ends_with(".foxglove.dev"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn verdict(fields: &str) -> Result<(), String> {
        let allowed = ["http://robot:8080".to_owned()];
        check(format!("GET / HTTP/1.1\r\nHost: a\r\n{fields}\r\n\r\n").as_bytes(), &allowed)
    }

    #[test]
    fn foxglove_programs_and_allowed_pages_may_connect() {
        for fields in [
            "Upgrade: websocket",
            "Origin: https://app.foxglove.dev",
            "origin:https://APP.foxglove.dev",
            "Origin: file://",
            "Origin: http://robot:8080",
        ] {
            assert_eq!(verdict(fields), Ok(()), "{fields}");
        }
    }

    #[test]
    fn other_pages_may_not() {
        for origin in [
            "https://evil.example",
            "http://app.foxglove.dev",
            "https://foxglove.dev.evil.example",
            "https://evilfoxglove.dev",
            "null",
            "http://robot:8081",
        ] {
            assert_eq!(verdict(&format!("Origin: {origin}")), Err(origin.to_owned()));
            let both = format!("Origin: https://app.foxglove.dev\r\nOrigin: {origin}");
            assert_eq!(verdict(&both), Err(origin.to_owned()));
        }
    }
}
