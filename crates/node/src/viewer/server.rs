//! HTTP, on a thread of its own.

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
    extract::{RawQuery, Request, State},
    http::{HeaderValue, StatusCode, header},
    middleware::{self, Next},
    response::{IntoResponse, Response},
    routing::get,
};
use tokio::{
    runtime,
    sync::{self, watch},
    time,
};

use super::{
    Comparison, ControlState, Controls, Hub, PageInfo, access, browser, composer, connections,
    prometheus, token::Token,
};
use eddy_frames::clock;
use eddy_transport::ListenAddress;

/// Interval between metrics messages.
pub(super) const METRICS_INTERVAL: Duration = Duration::from_millis(250);
/// How long shutdown waits for browsers to disconnect.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(300);

/// The page loads nothing from other sites, runs only its own scripts, and cannot be embedded.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
    img-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

const JAVASCRIPT: &str = "text/javascript; charset=utf-8";

/// Path, content type and content of each file.
const FILES: [(&str, &str, &str); 16] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("page/style.css")),
    ("/icon.svg", "image/svg+xml", include_str!("page/icon.svg")),
    ("/app.js", JAVASCRIPT, include_str!("page/app.js")),
    ("/camera.js", JAVASCRIPT, include_str!("page/camera.js")),
    ("/chart.js", JAVASCRIPT, include_str!("page/chart.js")),
    ("/frame.js", JAVASCRIPT, include_str!("page/frame.js")),
    ("/history.js", JAVASCRIPT, include_str!("page/history.js")),
    ("/keys.js", JAVASCRIPT, include_str!("page/keys.js")),
    ("/legend.js", JAVASCRIPT, include_str!("page/legend.js")),
    ("/link.js", JAVASCRIPT, include_str!("page/link.js")),
    ("/metrics.js", JAVASCRIPT, include_str!("page/metrics.js")),
    ("/painter.js", JAVASCRIPT, include_str!("page/painter.js")),
    ("/picture.js", JAVASCRIPT, include_str!("page/picture.js")),
    ("/scale.js", JAVASCRIPT, include_str!("page/scale.js")),
    ("/theme.js", JAVASCRIPT, include_str!("page/theme.js")),
];

/// Why the page cannot be served.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum ViewerError {
    /// The address cannot be listened on.
    #[error("{address}: cannot listen: {reason}; choose a free port, or 0 for any")]
    Listen { address: ListenAddress, reason: io::Error },
    /// There is no random number for the token.
    #[error("cannot read /dev/urandom: {0}")]
    Token(io::Error),
    /// A thread or timer cannot be created.
    #[error("cannot start the threads of the page: {0}")]
    Threads(io::Error),
}

/// Serves the page until dropped.
pub struct Viewer {
    address: SocketAddr,
    token: Option<Token>,
    stop: watch::Sender<bool>,
    stop_composer: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

/// Shared by all connections.
pub(super) struct ServerState {
    pub(super) hub: Arc<Hub>,
    pub(super) info: PageInfo,
    pub(super) controls: Arc<dyn Controls>,
    /// Needed for commands.
    pub(super) token: Option<Token>,
    /// The last known state of the controls.
    controls_state: Mutex<ControlState>,
    /// Held while it is refreshed, so that a newer state is not replaced by an older one.
    refreshing: sync::Mutex<()>,
    /// Identifies this run of the program.
    pub(super) instance: String,
    /// Host name of this machine.
    host_name: Option<String>,
    pub(super) stop: watch::Receiver<bool>,
}

impl Viewer {
    /// Serves the page on `address`, with the frames of `hub`.
    ///
    /// # Errors
    /// [`ViewerError`] when the address is in use or not an address of this machine.
    pub fn start(
        address: ListenAddress,
        hub: Arc<Hub>,
        comparison: Comparison,
        info: PageInfo,
        controls: Arc<dyn Controls>,
    ) -> Result<Self, ViewerError> {
        let failed = |reason| ViewerError::Listen { address, reason };
        let listener = TcpListener::bind(address.0).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let token = Token::for_address(address).map_err(ViewerError::Token)?;
        let runtime = runtime::Builder::new_current_thread()
            .enable_all()
            .max_blocking_threads(4)
            .build()
            .map_err(ViewerError::Threads)?;
        let (stop, stopped) = watch::channel(false);
        let stop_composer = Arc::new(AtomicBool::new(false));
        let server = Arc::new(ServerState {
            hub: Arc::clone(&hub),
            info,
            controls,
            token: token.clone(),
            controls_state: Mutex::default(),
            refreshing: sync::Mutex::default(),
            instance: format!("{}-{}", std::process::id(), clock::wall().0),
            host_name: sysinfo::System::host_name(),
            stop: stopped,
        });
        let spawn = |name: &str, work: Box<dyn FnOnce() + Send>| {
            thread::Builder::new().name(name.to_owned()).spawn(work).map_err(ViewerError::Threads)
        };
        let stopped = Arc::clone(&stop_composer);
        let mut viewer = Self { address, token, stop, stop_composer, threads: Vec::new() };
        let composer = move || composer::compose(&hub, &comparison, &stopped);
        viewer.threads.push(spawn("page composer", Box::new(composer))?);
        let serving = move || {
            if let Err(error) = runtime.block_on(serve(listener, server)) {
                tracing::error!("page: {error}");
            }
            // Without waiting for a command that waits for its node.
            runtime.shutdown_background();
        };
        viewer.threads.push(spawn("page server", Box::new(serving))?);
        Ok(viewer)
    }

    /// URL of the page, with the token that commands need if other machines can reach it.
    pub fn url(&self) -> String {
        let query = self.token.as_ref().map(Token::query).unwrap_or_default();
        format!("http://{}/{query}", self.address)
    }

    /// The address that the server listens on.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

/// Disconnects the browsers and joins the threads.
impl Drop for Viewer {
    fn drop(&mut self) {
        self.stop_composer.store(true, Ordering::Relaxed);
        let _ = self.stop.send(true);
        for thread in self.threads.drain(..) {
            let _ = thread.join(); // a panic has been reported
        }
    }
}

async fn serve(listener: TcpListener, server: Arc<ServerState>) -> io::Result<()> {
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let mut router =
        Router::new().route("/ws", get(browser::connect)).route("/metrics", get(metrics));
    for (path, kind, content) in FILES {
        router = match path {
            "/" => router.route(path, get(move |state, query| page(state, query, kind, content))),
            _ => router.route(path, get(move || async move { file(kind, content) })),
        };
    }
    let checked = middleware::from_fn_with_state(Arc::clone(&server), check);
    let app = router.layer(checked).with_state(Arc::clone(&server));
    tokio::spawn(refresh_controls(Arc::clone(&server)));
    let mut stop = server.stop.clone();
    tokio::select! {
        () = connections::serve(listener, app) => {}
        () = ended(&mut stop) => {}
    }
    let disconnected = async {
        while server.hub.is_watched() {
            time::sleep(Duration::from_millis(5)).await;
        }
    };
    // A browser that does not read cannot be told.
    let _ = time::timeout(CLOSE_TIMEOUT, disconnected).await;
    Ok(())
}

async fn check(State(server): State<Arc<ServerState>>, request: Request, next: Next) -> Response {
    match access::check(request.headers(), server.host_name.as_deref()) {
        Ok(()) => next.run(request).await,
        Err(forbidden) => {
            tracing::warn!("page: request rejected: {forbidden}");
            (StatusCode::FORBIDDEN, format!("{forbidden}\n")).into_response()
        }
    }
}

/// The page itself. A token in its URL moves into a cookie.
async fn page(
    State(server): State<Arc<ServerState>>,
    RawQuery(query): RawQuery,
    kind: &'static str,
    content: &'static str,
) -> Response {
    let token = server.token.as_ref();
    match token.and_then(|token| Some((token, token.matches_query(query.as_deref())?))) {
        None => file(kind, content),
        Some((token, true)) => {
            let mut response = file(kind, "");
            *response.status_mut() = StatusCode::SEE_OTHER;
            response.headers_mut().insert(header::LOCATION, HeaderValue::from_static("/"));
            response.headers_mut().insert(header::SET_COOKIE, token.set_cookie());
            response
        }
        Some((_, false)) => {
            let wrong = "invalid token: open the URL that the program printed\n";
            (StatusCode::FORBIDDEN, wrong).into_response()
        }
    }
}

/// Metrics for Prometheus.
async fn metrics(State(server): State<Arc<ServerState>>) -> Response {
    let content_type = [(header::CONTENT_TYPE, prometheus::CONTENT_TYPE)];
    (content_type, prometheus::render(&server.hub, &server.info)).into_response()
}

fn file(kind: &'static str, content: &'static str) -> Response {
    let fields = [
        (header::CONTENT_TYPE, kind),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        // Another version of the program has other files.
        (header::CACHE_CONTROL, "no-store"),
    ];
    let mut response = content.into_response();
    for (name, value) in fields {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

/// Refreshes the state of the controls while a browser is connected.
async fn refresh_controls(server: Arc<ServerState>) {
    let mut interval = time::interval(METRICS_INTERVAL);
    interval.set_missed_tick_behavior(time::MissedTickBehavior::Delay);
    loop {
        interval.tick().await;
        if server.hub.is_watched() {
            server.refresh().await;
        }
    }
}

impl ServerState {
    pub(super) async fn refresh(&self) {
        let _refreshing = self.refreshing.lock().await;
        let controls = Arc::clone(&self.controls);
        if let Ok(current) = tokio::task::spawn_blocking(move || controls.state()).await {
            let mut state = self.controls_state();
            *state = current.or(*state);
        }
    }

    pub(super) fn controls_state(&self) -> MutexGuard<'_, ControlState> {
        self.controls_state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Waits until the program ends.
pub(super) async fn ended(stop: &mut watch::Receiver<bool>) {
    // An error means that the sender is gone, and the program ends as well.
    let _ = stop.wait_for(|stop| *stop).await;
}
