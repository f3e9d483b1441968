//! Accepts connections and limits their number and duration.

use std::{collections::VecDeque, mem, pin::pin, time::Duration};

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::{
    rt::{TokioIo, TokioTimer},
    service::TowerToHyperService,
};
use tokio::{
    net::{TcpListener, TcpStream},
    task::AbortHandle,
    time,
};

/// Maximum number of connections. WebSockets do not count: they have their own limit.
const MAX_CONNECTIONS: usize = 64;
/// How long the head of a request may take, and how long a connection may wait for the next one.
const HEAD_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum age of a connection, even if its client has not read the response.
const MAX_AGE: Duration = Duration::from_secs(60);
/// Maximum size of the head of a request (bytes).
const MAX_HEAD: usize = 16 << 10;
/// Pause after a failed accept, for example without free file descriptors.
const RETRY: Duration = Duration::from_millis(100);

/// Serves `app` to every connection, for ever. Beyond [`MAX_CONNECTIONS`], a new connection replaces the oldest one, so
/// that requests that are never completed do not lock others out.
pub(super) async fn serve(listener: TcpListener, app: Router) {
    let mut open = VecDeque::<AbortHandle>::new();
    let mut warned = false;
    loop {
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::warn!("page: cannot accept a connection: {error}");
                time::sleep(RETRY).await;
                continue;
            }
        };
        open.retain(|connection| !connection.is_finished());
        if open.len() >= MAX_CONNECTIONS
            && let Some(oldest) = open.pop_front()
        {
            oldest.abort();
            if !mem::replace(&mut warned, true) {
                tracing::warn!(
                    "page: more than {MAX_CONNECTIONS} connections; the oldest are closed"
                );
            }
        }
        let app = app.clone();
        let connection = tokio::spawn(async move {
            if let Err(error) = connection(stream, app).await {
                tracing::debug!("page: {error}");
            }
        });
        open.push_back(connection.abort_handle());
    }
}

/// Serves one connection until it is closed or becomes a WebSocket.
async fn connection(stream: TcpStream, app: Router) -> Result<(), hyper::Error> {
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_TIMEOUT)
        .max_buf_size(MAX_HEAD)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(app))
        .with_upgrades();
    let mut connection = pin!(connection);
    tokio::select! {
        outcome = connection.as_mut() => return outcome,
        () = time::sleep(MAX_AGE) => connection.as_mut().graceful_shutdown(),
    }
    time::timeout(HEAD_TIMEOUT, connection).await.unwrap_or(Ok(()))
}
