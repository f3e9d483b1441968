//! HTTP and WebSocket on a thread of their own.

use std::{
    io,
    net::{SocketAddr, TcpListener},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use axum::{
    Router,
    extract::{
        Request, State as Shared,
        ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade, close_code},
    },
    http::{HeaderValue, StatusCode, header},
    middleware::{self, Next},
    response::{IntoResponse, Response},
    routing::get,
};
use tokio::{
    runtime,
    sync::{self, mpsc, watch},
    time,
};

use super::{
    Command, Comparison, Controls, Hub, Program, State, composer, gate,
    mailbox::{Mail, Mailbox},
    words::{self, Said},
};
use eddy_frames::clock;
use eddy_transport::ListenAddress;

/// Browsers at the same time.
const BROWSERS: usize = 32;
/// Frames that a page was sent and has not drawn yet: one on its way while another is drawn.
const UNDRAWN: u32 = 2;
/// A browser that reads nothing for so long is sent away.
const PATIENCE: Duration = Duration::from_secs(20);
/// Time between two figures.
const FIGURES: Duration = Duration::from_millis(250);
/// What a page may say at once (bytes).
const SAID: usize = 1024;
/// Commands of one page that wait while another of its own is done.
const COMMANDS: usize = 4;
/// How long the end waits for browsers to be told.
const FAREWELL: Duration = Duration::from_millis(300);

/// The page asks nobody else for anything, runs no other script, and is shown in no other page.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
    img-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// The files of the page: path, type, content.
const FILES: [(&str, &str, &str); 8] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("page/style.css")),
    ("/icon.svg", "image/svg+xml", include_str!("page/icon.svg")),
    ("/app.js", "text/javascript; charset=utf-8", include_str!("page/app.js")),
    ("/link.js", "text/javascript; charset=utf-8", include_str!("page/link.js")),
    ("/frame.js", "text/javascript; charset=utf-8", include_str!("page/frame.js")),
    ("/painter.js", "text/javascript; charset=utf-8", include_str!("page/painter.js")),
    ("/chart.js", "text/javascript; charset=utf-8", include_str!("page/chart.js")),
];

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    /// The address cannot be listened on.
    #[error("{address}: found {reason}, expected a free port of this machine (port 0 takes any)")]
    Listen {
        /// The address.
        address: ListenAddress,
        /// What the system said.
        reason: io::Error,
    },
    /// The system gave no thread, or no timer.
    #[error("the page's threads: {0}")]
    Threads(io::Error),
}

/// The page, as long as this lives.
pub struct Viewer {
    address: SocketAddr,
    stop: watch::Sender<bool>,
    composing: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

/// What every connection knows.
struct House {
    hub: Arc<Hub>,
    program: Program,
    controls: Arc<dyn Controls>,
    /// What the controls were last seen to be.
    state: Mutex<State>,
    /// Held while they are looked at: what was seen later is not replaced by what was seen before.
    looking: sync::Mutex<()>,
    /// This run of the program.
    instance: String,
    /// This machine's name.
    name: Option<String>,
    stop: watch::Receiver<bool>,
}

impl Viewer {
    /// Serves the page on `address`, showing what `hub` is given.
    ///
    /// # Errors
    /// [`ViewerError`] when the address is taken or none of this machine's.
    pub fn start(
        address: ListenAddress,
        hub: Arc<Hub>,
        comparison: Comparison,
        program: Program,
        controls: Arc<dyn Controls>,
    ) -> Result<Self, ViewerError> {
        let refused = |reason| ViewerError::Listen { address, reason };
        let listener = TcpListener::bind(address.0).map_err(refused)?;
        listener.set_nonblocking(true).map_err(refused)?;
        let address = listener.local_addr().map_err(refused)?;
        let runtime = runtime::Builder::new_current_thread()
            .enable_all()
            .max_blocking_threads(4)
            .build()
            .map_err(ViewerError::Threads)?;
        let (stop, stopped) = watch::channel(false);
        let composing = Arc::new(AtomicBool::new(false));
        let house = Arc::new(House {
            hub: Arc::clone(&hub),
            program,
            controls,
            state: Mutex::default(),
            looking: sync::Mutex::default(),
            instance: format!("{}-{}", std::process::id(), clock::wall().0),
            name: sysinfo::System::host_name(),
            stop: stopped,
        });
        let spawn = |name: &str, work: Box<dyn FnOnce() + Send>| {
            thread::Builder::new().name(name.to_owned()).spawn(work).map_err(ViewerError::Threads)
        };
        let ended = Arc::clone(&composing);
        let mut viewer = Self { address, stop, composing, threads: Vec::new() };
        let composer = move || composer::compose(&hub, &comparison, &ended);
        viewer.threads.push(spawn("page composer", Box::new(composer))?);
        let server = move || {
            if let Err(error) = runtime.block_on(serve(listener, house)) {
                tracing::error!("page: {error}");
            }
            // A control that waits for its node does not hold up the end.
            runtime.shutdown_background();
        };
        viewer.threads.push(spawn("page server", Box::new(server))?);
        Ok(viewer)
    }

    /// Where the page is.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// The address that it listens on.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

/// Tells the browsers, and ends.
impl Drop for Viewer {
    fn drop(&mut self) {
        self.composing.store(true, Ordering::Relaxed);
        let _ = self.stop.send(true);
        for thread in self.threads.drain(..) {
            // A panic there has been told already.
            let _ = thread.join();
        }
    }
}

async fn serve(listener: TcpListener, house: Arc<House>) -> io::Result<()> {
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let mut router = Router::new().route("/ws", get(connect));
    for (path, kind, content) in FILES {
        router = router.route(path, get(move || async move { file(kind, content) }));
    }
    let checked = middleware::from_fn_with_state(Arc::clone(&house), check);
    let app = router.layer(checked).with_state(Arc::clone(&house));
    tokio::spawn(look(Arc::clone(&house)));
    let mut stop = house.stop.clone();
    tokio::select! {
        outcome = axum::serve(listener, app) => outcome?,
        _ = ended(&mut stop) => {}
    }
    let told = async {
        while house.hub.is_watched() {
            time::sleep(Duration::from_millis(5)).await;
        }
    };
    // A browser that does not read is not told.
    let _ = time::timeout(FAREWELL, told).await;
    Ok(())
}

async fn check(Shared(house): Shared<Arc<House>>, request: Request, next: Next) -> Response {
    match gate::check(request.headers(), house.name.as_deref()) {
        Ok(()) => next.run(request).await,
        Err(refused) => {
            tracing::warn!("page: refused: {refused}");
            (StatusCode::FORBIDDEN, format!("{refused}\n")).into_response()
        }
    }
}

fn file(kind: &'static str, content: &'static str) -> Response {
    let fields = [
        (header::CONTENT_TYPE, kind),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        // The next version of the program has other files.
        (header::CACHE_CONTROL, "no-store"),
    ];
    let mut response = content.into_response();
    for (name, value) in fields {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

/// Keeps what is known of the controls fresh, while somebody looks.
async fn look(house: Arc<House>) {
    let mut interval = time::interval(FIGURES);
    interval.set_missed_tick_behavior(time::MissedTickBehavior::Delay);
    loop {
        interval.tick().await;
        if house.hub.is_watched() {
            house.refresh().await;
        }
    }
}

async fn connect(Shared(house): Shared<Arc<House>>, upgrade: WebSocketUpgrade) -> Response {
    let Some(mailbox) = house.hub.join(BROWSERS) else {
        let full = format!("found {BROWSERS} browsers, expected fewer\n");
        return (StatusCode::SERVICE_UNAVAILABLE, full).into_response();
    };
    let (commands, asked) = mpsc::channel(COMMANDS);
    // Ends with the visit, whose commands it still does.
    tokio::spawn(serve_commands(Arc::clone(&house), Arc::clone(&mailbox), asked));
    let visit = Visit { house, mailbox, commands, credit: UNDRAWN, sent: 0 };
    let upgrade = upgrade.max_message_size(SAID).max_frame_size(SAID);
    upgrade.on_upgrade(move |socket| async move {
        let mut visit = visit;
        if let Err(error) = visit.converse(socket).await {
            tracing::debug!("page: {error}");
        }
    })
}

/// One browser.
struct Visit {
    house: Arc<House>,
    mailbox: Arc<Mailbox>,
    /// What it asks for, to be done in this order.
    commands: mpsc::Sender<Command>,
    /// Frames that it may be sent before it has drawn one.
    credit: u32,
    sent: u64,
}

impl Drop for Visit {
    fn drop(&mut self) {
        self.house.hub.leave(&self.mailbox);
    }
}

impl Visit {
    /// Until the browser goes, does not read, or the program ends.
    async fn converse(&mut self, mut socket: WebSocket) -> Result<(), axum::Error> {
        let House { program, controls, instance, .. } = &*self.house;
        let hello = words::hello(program, controls.as_ref(), instance);
        send(&mut socket, Message::text(hello)).await?;
        let mut stop = self.house.stop.clone();
        let mut figures = time::interval(FIGURES);
        figures.set_missed_tick_behavior(time::MissedTickBehavior::Delay);
        let mailbox = Arc::clone(&self.mailbox);
        loop {
            tokio::select! {
                heard = socket.recv() => match heard {
                    Some(Ok(Message::Text(text))) => self.hear(&text),
                    Some(Ok(Message::Close(_))) | None => return Ok(()),
                    Some(Ok(_)) => {}
                    Some(Err(error)) => return Err(error),
                },
                mail = mailbox.next(self.credit > 0) => match mail {
                    Mail::Words(words) => send(&mut socket, Message::text(words)).await?,
                    Mail::Frame(frame) => {
                        self.credit -= 1;
                        self.sent += 1;
                        send(&mut socket, Message::Binary(frame)).await?;
                    }
                },
                _ = figures.tick() => {
                    let state = *self.house.state();
                    let figures = words::figures(&self.house.hub, &mailbox, &state, self.sent);
                    send(&mut socket, Message::text(figures)).await?;
                }
                _ = ended(&mut stop) => {
                    let reason = "the program ended".into();
                    let close = CloseFrame { code: close_code::AWAY, reason };
                    return send(&mut socket, Message::Close(Some(close))).await;
                }
            }
        }
    }

    fn hear(&mut self, text: &str) {
        match Said::parse(text) {
            Ok(Said::Drawn { drawn }) => {
                self.credit = self.credit.saturating_add(drawn).min(UNDRAWN);
            }
            Ok(Said::Select { select }) => {
                self.mailbox.select(select.and_then(|stream| stream.parse().ok()));
            }
            Ok(Said::Command(command)) => {
                if self.commands.try_send(command).is_err() {
                    let busy = Err("still busy with what was asked for before".to_owned());
                    let state = *self.house.state();
                    self.mailbox.say(words::outcome(&command, &busy, &state));
                }
            }
            Err(error) => tracing::debug!("page: found `{text}`, expected a command: {error}"),
        }
    }
}

/// Does what one page asks for, one after the other, and tells it.
async fn serve_commands(
    house: Arc<House>,
    mailbox: Arc<Mailbox>,
    mut asked: mpsc::Receiver<Command>,
) {
    while let Some(command) = asked.recv().await {
        let outcome = act(&house, command).await;
        let state = *house.state();
        mailbox.say(words::outcome(&command, &outcome, &state));
    }
}

async fn act(house: &House, command: Command) -> Result<String, String> {
    let controls = Arc::clone(&house.controls);
    let offered = match command {
        // One button, two words.
        Command::Resume => controls.offered().contains(&"pause"),
        _ => controls.offered().contains(&command.name()),
    };
    if !offered {
        let expected = controls.offered().join(", ");
        return Err(format!("found {}, expected one of {expected}", command.name()));
    }
    let acted = tokio::task::spawn_blocking(move || controls.act(command)).await;
    // Of what failed a part may be done.
    house.refresh().await;
    acted.unwrap_or_else(|_| Err("it could not be done".to_owned()))
}

impl House {
    async fn refresh(&self) {
        let _looking = self.looking.lock().await;
        let controls = Arc::clone(&self.controls);
        if let Ok(seen) = tokio::task::spawn_blocking(move || controls.state()).await {
            let mut state = self.state();
            *state = seen.or(*state);
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Waits until the program ends.
async fn ended(stop: &mut watch::Receiver<bool>) {
    // Without a sender it has ended, too.
    let _ = stop.wait_for(|stop| *stop).await;
}

/// Sends, but not to a browser that reads nothing.
async fn send(socket: &mut WebSocket, message: Message) -> Result<(), axum::Error> {
    match time::timeout(PATIENCE, socket.send(message)).await {
        Ok(outcome) => outcome,
        Err(late) => Err(axum::Error::new(late)),
    }
}
