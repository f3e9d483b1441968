//! Standard output and standard error of a program.

use std::{
    borrow::Cow,
    fmt,
    io::{self, ErrorKind, IsTerminal as _, Write},
    sync::{
        Mutex, MutexGuard, OnceLock, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
};

/// Columns of a line that is not written to a terminal, or to one that does not tell its size.
const DEFAULT_COLUMNS: usize = 80;

/// Returns to the first column and clears the line.
const CLEAR: &str = "\r\x1b[2K";

/// The status line at the bottom of the terminal; empty if there is none.
static STATUS: Mutex<String> = Mutex::new(String::new());
/// Whether the reader of standard output is gone.
static CLOSED: AtomicBool = AtomicBool::new(false);
/// The first failure of standard output for another reason.
static FAILURE: OnceLock<io::Error> = OnceLock::new();

/// Text as it may be shown on a terminal: control characters, which names in a bag or in a graph may have, are escaped as in JSON.
/// Line breaks and tabs stay.
fn printable(text: &str) -> Cow<'_, str> {
    escaped(text, |c| c.is_control() && !matches!(c, '\n' | '\t'))
}

/// Text as it may be shown on one line: as [`print()`] shows it, and with line breaks and tabs escaped.
pub fn on_one_line(text: &str) -> Cow<'_, str> {
    escaped(text, char::is_control)
}

fn escaped(text: &str, is_escaped: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&is_escaped) {
        return text.into();
    }
    let mut shown = String::with_capacity(text.len() + 5);
    for c in text.chars() {
        match is_escaped(c) {
            true => shown.push_str(&format!("\\u{:04x}", u32::from(c))),
            false => shown.push(c),
        }
    }
    shown.into()
}

/// Writes to standard error, whether or not somebody reads it.
pub fn print_error(text: fmt::Arguments<'_>) {
    let _ = io::stderr().lock().write_all(printable(&text.to_string()).as_bytes());
}

/// Writes whole lines to standard output, above the status line. Failures are remembered.
pub fn print(text: fmt::Arguments<'_>) {
    let text = text.to_string();
    let text = printable(&text);
    let status = lock();
    if status.is_empty() {
        if let Err(error) = io::stdout().lock().write_all(text.as_bytes()) {
            failed(error);
        }
    } else {
        write(format_args!("{CLEAR}{text}{status}"));
    }
}

/// Writes to standard output at once.
fn write(text: fmt::Arguments<'_>) {
    let mut output = io::stdout().lock();
    if let Err(error) = output.write_fmt(text).and_then(|()| output.flush()) {
        failed(error);
    }
}

/// Writes what is still in the buffer of standard output.
pub fn flush() {
    if let Err(error) = io::stdout().lock().flush() {
        failed(error);
    }
}

fn failed(error: io::Error) {
    match error.kind() {
        ErrorKind::BrokenPipe => CLOSED.store(true, Ordering::Relaxed),
        _ => _ = FAILURE.set(error),
    }
}

/// Whether the reader of standard output is gone, as behind `| head`.
pub fn is_closed() -> bool {
    CLOSED.load(Ordering::Relaxed)
}

/// Why something could not be printed, other than a closed pipe.
pub fn failure() -> Option<&'static io::Error> {
    flush();
    FAILURE.get()
}

/// Whether logs on standard error have colours: on a terminal, unless `NO_COLOR` is set.
pub fn has_colors() -> bool {
    #[expect(clippy::disallowed_methods, reason = "a setting of the terminal, not of the command")]
    let disabled = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    io::stderr().is_terminal() && !disabled
}

/// Columns of the terminal on standard output.
pub fn columns() -> usize {
    let size = rustix::termios::tcgetwinsize(io::stdout());
    let columns = size.map_or(0, |size| usize::from(size.ws_col));
    if columns == 0 { DEFAULT_COLUMNS } else { columns }
}

/// Shows a line at the bottom of the terminal on standard output; it replaces the one before. Lines that are printed or
/// logged meanwhile appear above it.
pub fn show_status(line: &str) {
    let mut status = lock();
    *status = on_one_line(line).into_owned();
    write(format_args!("{CLEAR}{status}"));
}

/// Removes the status line.
pub fn clear_status() {
    let mut status = lock();
    if !std::mem::take(&mut *status).is_empty() {
        write(format_args!("{CLEAR}"));
    }
}

fn lock() -> MutexGuard<'static, String> {
    STATUS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Standard error for logs, which moves the status line out of the way.
pub struct Log;

impl Write for Log {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let status = lock();
        if status.is_empty() {
            return io::stderr().write(bytes);
        }
        write(format_args!("{CLEAR}"));
        let written = io::stderr().write_all(bytes);
        write(format_args!("{status}"));
        written.map(|()| bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}

/// Joins the parts of a status line, leaving out the ones with the highest number that do not fit into `columns`; the
/// last column stays empty, as some terminals wrap after it. Parts are shown in the given order.
pub fn fit(parts: &[(u8, String)], separator: &str, columns: usize) -> String {
    let mut kept: Vec<&(u8, String)> = parts.iter().filter(|(_, text)| !text.is_empty()).collect();
    loop {
        let line = kept.iter().map(|(_, text)| text.as_str()).collect::<Vec<_>>().join(separator);
        if line.chars().count() < columns || kept.len() <= 1 {
            return line.chars().take(columns.saturating_sub(1)).collect();
        }
        let least = kept.iter().enumerate().max_by_key(|(place, (rank, _))| (*rank, *place));
        if let Some((place, _)) = least {
            kept.remove(place);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_shown_and_not_obeyed() {
        for (text, shown, line) in [
            ("/scan\t1\n", "/scan\t1\n", "/scan\\u00091\\u000a"),
            ("/\u{1b}[31mred", "/\\u001b[31mred", "/\\u001b[31mred"),
            ("\r\u{7f}\u{9b}2J", "\\u000d\\u007f\\u009b2J", "\\u000d\\u007f\\u009b2J"),
            ("/größe", "/größe", "/größe"),
        ] {
            assert_eq!((&*printable(text), &*on_one_line(text)), (shown, line));
        }
    }
}
