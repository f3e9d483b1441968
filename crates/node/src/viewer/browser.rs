//! The WebSocket of one browser: what it is sent, and its commands.

use std::{sync::Arc, time::Duration};

use axum::{
    extract::{
        RawQuery, State,
        ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade, close_code},
    },
    http::{HeaderMap, StatusCode},
    response::{IntoResponse, Response},
};
use tokio::{sync::mpsc, time};

use super::{
    Controls, NoControls, PageCommand,
    mailbox::{Mailbox, Outgoing},
    protocol::{self, ClientMessage},
    server::{METRICS_INTERVAL, ServerState, ended},
};

/// Maximum number of browsers.
const MAX_BROWSERS: usize = 32;
/// Maximum number of frames sent to a page and not drawn yet: one under way while another is drawn.
const MAX_UNDRAWN: u32 = 2;
/// A browser that reads nothing for this long is disconnected.
const SEND_TIMEOUT: Duration = Duration::from_secs(20);
/// Maximum size of a message from a page (bytes).
const MAX_MESSAGE_SIZE: usize = 1024;
/// Commands of one page that may wait.
const QUEUED_COMMANDS: usize = 4;

/// Accepts a browser, unless there are too many.
pub(super) async fn connect(
    State(server): State<Arc<ServerState>>,
    RawQuery(query): RawQuery,
    headers: HeaderMap,
    upgrade: WebSocketUpgrade,
) -> Response {
    let may_control = server.token.as_ref().is_none_or(|token| {
        token.matches_cookies(&headers) || token.matches_query(query.as_deref()) == Some(true)
    });
    let Some(mailbox) = server.hub.join(MAX_BROWSERS) else {
        let full = format!("{MAX_BROWSERS} browsers are connected, no more are accepted\n");
        return (StatusCode::SERVICE_UNAVAILABLE, full).into_response();
    };
    let (commands, queued) = mpsc::channel(QUEUED_COMMANDS);
    // Ends after the connection, when its commands are executed.
    tokio::spawn(execute_all(Arc::clone(&server), Arc::clone(&mailbox), queued));
    let credit = MAX_UNDRAWN;
    let connection = Connection { server, mailbox, may_control, commands, credit, sent: 0 };
    let upgrade = upgrade.max_message_size(MAX_MESSAGE_SIZE).max_frame_size(MAX_MESSAGE_SIZE);
    upgrade.on_upgrade(move |socket| async move {
        let mut connection = connection;
        if let Err(error) = connection.run(socket).await {
            tracing::debug!("page: {error}");
        }
    })
}

/// The connection of one browser.
struct Connection {
    server: Arc<ServerState>,
    mailbox: Arc<Mailbox>,
    /// Whether it has the token.
    may_control: bool,
    /// Its commands, executed in order.
    commands: mpsc::Sender<PageCommand>,
    /// Frames that may be sent before it draws one.
    credit: u32,
    sent: u64,
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.server.hub.leave(&self.mailbox);
    }
}

impl Connection {
    /// Runs until the browser disconnects, stops reading, or the program ends.
    async fn run(&mut self, mut socket: WebSocket) -> Result<(), axum::Error> {
        let ServerState { info, controls, instance, .. } = &*self.server;
        let controls: &dyn Controls =
            if self.may_control { controls.as_ref() } else { &NoControls };
        let hello = protocol::hello(info, controls, instance);
        send(&mut socket, Message::text(hello)).await?;
        let mut stop = self.server.stop.clone();
        let mut metrics = time::interval(METRICS_INTERVAL);
        metrics.set_missed_tick_behavior(time::MissedTickBehavior::Delay);
        let mailbox = Arc::clone(&self.mailbox);
        loop {
            tokio::select! {
                received = socket.recv() => match received {
                    Some(Ok(Message::Text(text))) => self.receive(&text),
                    Some(Ok(Message::Close(_))) | None => return Ok(()),
                    Some(Ok(_)) => {}
                    Some(Err(error)) => return Err(error),
                },
                outgoing = mailbox.next(self.credit > 0) => match outgoing {
                    Outgoing::Text(text) => send(&mut socket, Message::text(text)).await?,
                    Outgoing::Frame(frame) => {
                        self.credit -= 1;
                        self.sent += 1;
                        send(&mut socket, Message::Binary(frame)).await?;
                    }
                },
                _ = metrics.tick() => {
                    let state = *self.server.controls_state();
                    let metrics = protocol::metrics(&self.server.hub, &mailbox, &state, self.sent);
                    send(&mut socket, Message::text(metrics)).await?;
                }
                _ = ended(&mut stop) => {
                    let reason = "the program ended".into();
                    let close = CloseFrame { code: close_code::AWAY, reason };
                    return send(&mut socket, Message::Close(Some(close))).await;
                }
            }
        }
    }

    fn receive(&mut self, text: &str) {
        match ClientMessage::parse(text) {
            Ok(ClientMessage::Drawn { drawn }) => {
                self.credit = self.credit.saturating_add(drawn).min(MAX_UNDRAWN);
            }
            Ok(ClientMessage::Select { select }) => {
                self.mailbox.select(select.and_then(|stream| stream.parse().ok()));
            }
            Ok(ClientMessage::Command(command)) if !self.may_control => {
                let reason = "not allowed: open the URL with the token that the program printed";
                let state = *self.server.controls_state();
                let outcome = protocol::outcome(&command, &Err(reason.to_owned()), &state);
                self.mailbox.put_text(outcome);
            }
            Ok(ClientMessage::Command(command)) => {
                if self.commands.try_send(command).is_err() {
                    let busy = Err("still busy with previous commands".to_owned());
                    let state = *self.server.controls_state();
                    self.mailbox.put_text(protocol::outcome(&command, &busy, &state));
                }
            }
            Err(error) => tracing::debug!("page: invalid message `{text}`: {error}"),
        }
    }
}

/// Executes the commands of one page in order and sends it the outcomes.
async fn execute_all(
    server: Arc<ServerState>,
    mailbox: Arc<Mailbox>,
    mut commands: mpsc::Receiver<PageCommand>,
) {
    while let Some(command) = commands.recv().await {
        let outcome = execute(&server, command).await;
        let state = *server.controls_state();
        mailbox.put_text(protocol::outcome(&command, &outcome, &state));
    }
}

async fn execute(server: &ServerState, command: PageCommand) -> Result<String, String> {
    let controls = Arc::clone(&server.controls);
    let is_available = match command {
        // One button for both.
        PageCommand::Resume => controls.available().contains(&"pause"),
        _ => controls.available().contains(&command.name()),
    };
    if !is_available {
        return Err(format!("{} is not available on this page", command.name()));
    }
    let outcome = tokio::task::spawn_blocking(move || controls.execute(command)).await;
    // Even a failed command may have changed something.
    server.refresh().await;
    outcome.unwrap_or_else(|_| Err("the command failed".to_owned()))
}

/// Sends a message; fails if the browser reads nothing for [`SEND_TIMEOUT`].
async fn send(socket: &mut WebSocket, message: Message) -> Result<(), axum::Error> {
    match time::timeout(SEND_TIMEOUT, socket.send(message)).await {
        Ok(outcome) => outcome,
        Err(late) => Err(axum::Error::new(late)),
    }
}
