//! A terminal of its own for a program, as a user has one.

use std::{
    fs::File,
    io::{Read as _, Write as _},
    process::{Child, Command, ExitStatus, Stdio},
    sync::{Arc, Mutex},
    thread::{self, JoinHandle},
};

use rustix::{
    pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt},
    termios::{Winsize, tcsetwinsize},
};

use crate::support::wait_for;

/// The two ends of a terminal.
pub fn ends() -> (File, File) {
    let ours = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&ours).unwrap();
    unlockpt(&ours).unwrap();
    let name = ptsname(&ours, Vec::new()).unwrap();
    let theirs = File::options().read(true).write(true).open(name.to_str().unwrap()).unwrap();
    (File::from(ours), theirs)
}

/// `inner`, to be run by `setsid`, which gives it the terminal on its standard input as its own, as a shell does.
pub fn in_a_session(inner: &Command) -> Command {
    let mut command = Command::new("setsid");
    command.args(["--ctty", "--wait"]).arg(inner.get_program()).args(inner.get_args());
    command.envs(inner.get_envs().filter_map(|(name, value)| Some((name, value?))));
    command
}

/// A program on a terminal.
pub struct OnTerminal {
    keys: File,
    child: Child,
    shown: Arc<Mutex<Vec<u8>>>,
    reader: JoinHandle<()>,
}

impl OnTerminal {
    /// Starts `inner` on a terminal that is `columns` wide.
    pub fn start(inner: &Command, columns: u16) -> Self {
        let (ours, theirs) = ends();
        let size = Winsize { ws_row: 24, ws_col: columns, ws_xpixel: 0, ws_ypixel: 0 };
        tcsetwinsize(&theirs, size).unwrap();
        let end = || Stdio::from(theirs.try_clone().unwrap());
        let mut command = in_a_session(inner);
        command.env_remove("NO_COLOR").stdin(end()).stdout(end()).stderr(end());
        let child = command.spawn().unwrap();
        drop((command, theirs));
        let shown = Arc::new(Mutex::new(Vec::new()));
        let (terminal, kept) = (ours.try_clone().unwrap(), Arc::clone(&shown));
        let reader = thread::spawn(move || read_to_end(terminal, &kept));
        Self { keys: ours, child, shown, reader }
    }

    /// Everything that was written to the terminal.
    pub fn shown(&self) -> String {
        String::from_utf8_lossy(&self.shown.lock().unwrap()).into_owned()
    }

    /// Waits until this was written to the terminal, after the first `before` bytes. Returns the number of bytes so far.
    pub fn wait_for(&self, text: &str, before: usize) -> usize {
        wait_for(&format!("the terminal shows `{text}`"), || {
            let shown = self.shown();
            shown.get(before..).is_some_and(|new| new.contains(text)).then_some(shown.len())
        })
    }

    /// Presses keys.
    pub fn press(&mut self, keys: &[u8]) {
        self.keys.write_all(keys).unwrap();
    }

    /// Waits for the end of the program and for all that it has written.
    pub fn wait(&mut self) -> ExitStatus {
        let status = wait_for("the program ends", || self.child.try_wait().unwrap());
        wait_for("its terminal closes", || self.reader.is_finished().then_some(()));
        status
    }
}

impl Drop for OnTerminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Reads what is written to a terminal until nobody has its other end open.
///
/// Linux reports that end as an error, and now and then does so while the last lines are still on
/// their way (`n_tty_read` asks for input first and whether the other end is closed after that).
/// The read that follows returns them: only the second error in a row is the end.
pub fn read_to_end(mut terminal: File, kept: &Mutex<Vec<u8>>) {
    let mut bytes = [0; 4096];
    let mut errors = 0;
    while errors < 2 {
        match terminal.read(&mut bytes) {
            Ok(read @ 1..) => {
                errors = 0;
                kept.lock().unwrap().extend_from_slice(&bytes[..read]);
            }
            _ => errors += 1,
        }
    }
}

/// What was shown as separate lines, without colours: status lines overwrite each other.
pub fn lines(shown: &str) -> Vec<String> {
    let lines = shown.split(['\r', '\n']).map(without_escapes);
    lines.filter(|line| !line.is_empty()).collect()
}

fn without_escapes(line: &str) -> String {
    let mut parts = line.split('\x1b');
    let mut text = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        // A control sequence ends with a letter.
        text.push_str(
            part.split_once(|c: char| c.is_ascii_alphabetic()).map_or("", |(_, rest)| rest),
        );
    }
    text
}
