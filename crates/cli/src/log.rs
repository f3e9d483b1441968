//! The log on standard error.

use tracing::Subscriber;
use tracing_subscriber::{EnvFilter, Layer, registry::LookupSpan};

use crate::terminal;

/// Writes what the filter lets through to standard error, above the status line.
pub fn logs<S>(filter: EnvFilter) -> impl Layer<S>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
{
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(|| terminal::Log)
        .with_ansi(terminal::has_colors())
        // It would panic when the reader of standard error is gone.
        .log_internal_errors(false);
    lines.with_filter(filter)
}
