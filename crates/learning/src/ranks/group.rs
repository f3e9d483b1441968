//! Open connections between processes: rank 0 decides for all, and everyone learns when one is lost.
//!
//! Each process has connections to rank 0 only, which passes on what it learns. A thread for each connection reads it;
//! another one sends signs of life, so that a host that vanishes is noticed too.

use std::{
    collections::VecDeque,
    io,
    net::{Shutdown, TcpStream},
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread,
    time::Duration,
};

use super::{
    ProcessOptions, RankError,
    message::Message,
    rendezvous::{self, Member},
};

/// How long processes wait for each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timing {
    /// For all to be there.
    pub deadline: Duration,
    /// Interval of signs of life.
    pub alive: Duration,
    /// Time without a sign of life after which a process counts as lost.
    pub silence: Duration,
    /// For this process to come back from a library after another one was lost. It then has as long as `deadline` to
    /// save the last epoch.
    pub abandon: Duration,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            deadline: Duration::from_secs(60),
            alive: Duration::from_secs(5),
            silence: Duration::from_secs(30),
            abandon: Duration::from_secs(10),
        }
    }
}

/// The processes of a run, seen from one of them.
pub struct Group {
    leads: bool,
    connections: Arc<[Connection]>,
    shared: Arc<Shared>,
}

/// A connection for writing.
struct Connection {
    who: String,
    stream: Mutex<TcpStream>,
}

impl Connection {
    /// A failure is noticed by the thread that reads.
    fn send(&self, message: &Message) {
        let _ = message.send(&mut *lock(&self.stream));
    }
}

/// What the threads share.
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    timing: Timing,
    abandon: &'static (dyn Fn(&str) + Sync),
}

#[derive(Default)]
struct State {
    /// What rank 0 has said, oldest first.
    words: VecDeque<String>,
    /// Whether another process has asked to stop.
    asked: bool,
    /// The first process that was lost or has ended with an error.
    gone: Option<RankError>,
    /// Called when a process is lost.
    on_gone: Option<Box<dyn FnOnce() + Send>>,
    /// Whether the training knows of it.
    noticed: bool,
    /// Whether the run is over for this process.
    closed: bool,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Group {
    /// Finds the other processes of the run; returns when all are there, with the same `facts`.
    ///
    /// # Errors
    /// [`RankError`]: rank 0 cannot listen or be reached, a process is missing after the deadline or differs.
    pub fn join(
        options: &ProcessOptions<'_>,
        facts: &[(String, String)],
    ) -> Result<Self, RankError> {
        let ProcessOptions { process, timing, .. } = *options;
        let name = name();
        let members = if process.leads() {
            let listener = rendezvous::listen(process)?;
            rendezvous::lead(&listener, process, &name, facts, timing.deadline)?
        } else {
            vec![rendezvous::follow(process, &name, facts, timing.deadline)?]
        };
        Self::of(options, members).map_err(|error| RankError::system(&error))
    }

    fn of(options: &ProcessOptions<'_>, members: Vec<Member>) -> io::Result<Self> {
        let &ProcessOptions { process, timing, abandon } = options;
        let (mut connections, mut readers) = (Vec::new(), Vec::new());
        for member in members {
            member.stream.set_read_timeout(Some(timing.silence))?;
            member.stream.set_write_timeout(Some(timing.silence))?;
            readers.push(member.stream.try_clone()?);
            let who = member.who();
            connections.push(Connection { who, stream: Mutex::new(member.stream) });
        }
        let connections: Arc<[Connection]> = connections.into();
        let state = Mutex::new(State::default());
        let shared = Arc::new(Shared { state, changed: Condvar::new(), timing, abandon });
        for (number, stream) in readers.into_iter().enumerate() {
            let (connections, shared) = (connections.clone(), shared.clone());
            let read = move || shared.read(stream, number, &connections);
            thread::Builder::new().name("rank reader".to_owned()).spawn(read)?;
        }
        let (signs_of, signs_to) = (shared.clone(), connections.clone());
        let signs = move || signs_of.show_signs_of_life(&signs_to);
        thread::Builder::new().name("rank alive".to_owned()).spawn(signs)?;
        Ok(Self { leads: process.leads(), connections, shared })
    }

    /// Whether this is rank 0.
    pub fn leads(&self) -> bool {
        self.leads
    }

    /// Rank 0: tells all others.
    pub fn tell(&self, word: &str) {
        let word = Message::Word { word: word.to_owned() };
        self.connections.iter().for_each(|connection| connection.send(&word));
    }

    /// Any other rank: what rank 0 says next.
    ///
    /// # Errors
    /// [`RankError::Lost`], [`RankError::Failed`].
    pub fn hear(&self) -> Result<String, RankError> {
        let waits = |state: &mut State| state.words.is_empty() && state.gone.is_none();
        let mut state = self
            .shared
            .changed
            .wait_while(lock(&self.shared.state), waits)
            .unwrap_or_else(PoisonError::into_inner);
        match (state.words.pop_front(), state.gone.clone()) {
            (Some(word), _) => Ok(word),
            (None, Some(error)) => {
                state.noticed = true;
                drop(state);
                self.shared.changed.notify_all();
                Err(error)
            }
            (None, None) => unreachable!("there is a word or an error"),
        }
    }

    /// Any other rank: asks rank 0 to stop.
    pub fn ask_to_stop(&self) {
        self.connections.iter().for_each(|connection| connection.send(&Message::Stop));
    }

    /// Rank 0: whether another one has asked to stop.
    pub fn asked_to_stop(&self) -> bool {
        lock(&self.shared.state).asked
    }

    /// Calls `hook` on a thread of its own when another process is lost: it ends this one's waiting for it.
    pub fn on_gone(&self, hook: impl FnOnce() + Send + 'static) {
        let mut state = lock(&self.shared.state);
        if state.gone.is_some() {
            drop(state);
            hook();
        } else {
            state.on_gone = Some(Box::new(hook));
        }
    }

    /// The process that was lost or has ended, if any, which may become known within `patience`.
    pub fn gone(&self, patience: Duration) -> Option<RankError> {
        let state = lock(&self.shared.state);
        let (mut state, _) = self
            .shared
            .changed
            .wait_timeout_while(state, patience, |state| state.gone.is_none())
            .unwrap_or_else(PoisonError::into_inner);
        state.noticed |= state.gone.is_some();
        let gone = state.gone.clone();
        drop(state);
        self.shared.changed.notify_all();
        gone
    }

    /// Tells the others that this process ends with an error.
    pub fn fail(&self, reason: &str) {
        let failed = Message::Failed { reason: reason.to_owned() };
        self.connections.iter().for_each(|connection| connection.send(&failed));
    }

    /// The run is over: others may end now.
    pub fn finish(&self) {
        lock(&self.shared.state).closed = true;
        self.shared.changed.notify_all();
        self.connections.iter().for_each(|connection| connection.send(&Message::Bye));
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        lock(&self.shared.state).closed = true;
        self.shared.changed.notify_all();
        for connection in &*self.connections {
            // What was sent before still arrives.
            let _ = lock(&connection.stream).shutdown(Shutdown::Write);
        }
    }
}

impl Shared {
    /// Takes messages of a connection until its end.
    fn read(&self, mut stream: TcpStream, number: usize, connections: &[Connection]) {
        let who = || connections[number].who.clone();
        let error = loop {
            match Message::receive(&mut stream) {
                Ok(Message::Alive) => {}
                Ok(Message::Word { word }) => {
                    lock(&self.state).words.push_back(word);
                    self.changed.notify_all();
                }
                Ok(Message::Stop) => lock(&self.state).asked = true,
                Ok(Message::Bye) => return,
                Ok(Message::Failed { reason }) => break RankError::Failed { who: who(), reason },
                Ok(Message::Gone { who, reason: Some(reason) }) => {
                    break RankError::Failed { who, reason };
                }
                Ok(Message::Gone { who, reason: None }) => break RankError::Lost { who },
                Ok(_) | Err(_) => break RankError::Lost { who: who() },
            }
        };
        let mut state = lock(&self.state);
        if state.closed || state.gone.is_some() {
            return;
        }
        state.gone = Some(error.clone());
        let hook = state.on_gone.take();
        drop(state);
        self.changed.notify_all();
        let gone = match &error {
            RankError::Failed { who, reason } => {
                Message::Gone { who: who.clone(), reason: Some(reason.clone()) }
            }
            _ => Message::Gone { who: who(), reason: None },
        };
        // Only rank 0 has other connections.
        for (other, connection) in connections.iter().enumerate() {
            if other != number {
                connection.send(&gone);
            }
        }
        if let Some(hook) = hook {
            // On a thread of its own: a library may not come back from it.
            let _ = thread::Builder::new().name("rank lost".to_owned()).spawn(hook);
        }
        let waiting = |state: &mut State| !state.noticed && !state.closed;
        // Once the training knows of it, it saves the last epoch, and frees what is on the GPU.
        let saving = |state: &mut State| !state.closed;
        if self.outlasts(self.timing.abandon, waiting)
            || self.outlasts(self.timing.deadline, saving)
        {
            (self.abandon)(&format!(
                "{error}; continue from the last epoch that was saved with --resume"
            ));
        }
    }

    /// Waits until a condition no longer holds; whether it still does after `limit`.
    fn outlasts(&self, limit: Duration, condition: impl FnMut(&mut State) -> bool) -> bool {
        let waited = self.changed.wait_timeout_while(lock(&self.state), limit, condition);
        waited.unwrap_or_else(PoisonError::into_inner).1.timed_out()
    }

    fn show_signs_of_life(&self, connections: &[Connection]) {
        loop {
            let open = |state: &mut State| !state.closed;
            let (state, _) = self
                .changed
                .wait_timeout_while(lock(&self.state), self.timing.alive, open)
                .unwrap_or_else(PoisonError::into_inner);
            if state.closed {
                return;
            }
            drop(state);
            connections.iter().for_each(|connection| connection.send(&Message::Alive));
        }
    }
}

/// The host and number of this process.
fn name() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let host = if host.trim().is_empty() { "unknown host" } else { host.trim() };
    format!("{host}, process {}", std::process::id())
}

#[cfg(test)]
mod tests {
    use super::{super::Process, *};
    use std::{
        io::Write as _,
        net::TcpListener,
        sync::atomic::{AtomicBool, Ordering},
    };

    /// Nobody waits long in tests, and a busy machine is not taken for a lost one.
    const TIMING: Timing = Timing {
        deadline: Duration::from_secs(20),
        alive: Duration::from_millis(20),
        silence: Duration::from_secs(2),
        abandon: Duration::from_secs(20),
    };

    fn never(sentence: &str) {
        panic!("abandoned: {sentence}");
    }

    /// Processes of a run of `count`, at a port that is free.
    fn processes(count: usize) -> Vec<Process> {
        let port = TcpListener::bind(("127.0.0.1", 0)).unwrap().local_addr().unwrap().port();
        let process = |rank| Process {
            rank,
            count,
            local_rank: rank,
            address: "127.0.0.1".to_owned(),
            port,
            count_variable: "WORLD_SIZE",
        };
        (0..count).map(process).collect()
    }

    fn facts(data: &str) -> Vec<(String, String)> {
        vec![("program".to_owned(), "eddy".to_owned()), ("data".to_owned(), data.to_owned())]
    }

    fn join(process: &Process, data: &str, timing: Timing) -> Result<Group, RankError> {
        Group::join(&ProcessOptions { process, timing, abandon: &never }, &facts(data))
    }

    /// Groups of all ranks, each on a thread.
    fn groups(data: &[&str], timing: Timing) -> Vec<Result<Group, RankError>> {
        let processes = processes(data.len());
        thread::scope(|scope| {
            let pairs = processes.iter().zip(data);
            // Rank 0 comes last: the others wait for it.
            let threads: Vec<_> = pairs
                .map(|(process, data)| {
                    scope.spawn(move || {
                        if process.leads() {
                            thread::sleep(Duration::from_millis(150));
                        }
                        join(process, data, timing)
                    })
                })
                .collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect()
        })
    }

    fn all(data: &[&str], timing: Timing) -> Vec<Group> {
        groups(data, timing).into_iter().map(Result::unwrap).collect()
    }

    #[test]
    fn rank_0_tells_all_others_and_hears_that_one_wants_to_stop() {
        let groups = all(&["a", "a", "a"], TIMING);
        groups[0].tell("first");
        groups[0].tell("second");
        for group in &groups[1..] {
            assert_eq!(group.hear().unwrap(), "first");
            assert_eq!(group.hear().unwrap(), "second");
        }
        assert!(!groups[0].asked_to_stop());
        groups[2].ask_to_stop();
        while !groups[0].asked_to_stop() {
            thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn connections_that_are_quiet_for_long_stay_open() {
        let groups = all(&["a", "a"], TIMING);
        thread::sleep(3 * TIMING.silence);
        groups[0].tell("still here");
        assert_eq!(groups[1].hear().unwrap(), "still here");
        assert_eq!(groups[0].gone(Duration::ZERO), None);
    }

    #[test]
    fn processes_with_other_data_are_refused_by_name() {
        let outcomes = groups(&["a", "a", "b"], TIMING);
        let errors: Vec<_> =
            outcomes.into_iter().map(|outcome| outcome.err().unwrap().to_string()).collect();
        let sentence = &errors[0];
        assert!(sentence.starts_with("rank 2 ("), "{sentence}");
        assert!(sentence.ends_with("): data: found b, expected a as in rank 0"), "{sentence}");
        for other in &errors[1..] {
            assert_eq!(*other, format!("rank 0 ended the rendezvous: {sentence}"));
        }
    }

    #[test]
    fn a_rank_that_is_there_twice_is_refused() {
        let mut processes = processes(3);
        processes[2].rank = 1;
        let outcomes: Vec<_> = thread::scope(|scope| {
            let join = |process| scope.spawn(move || join(process, "a", TIMING).err().unwrap());
            let threads: Vec<_> = processes.iter().map(join).collect();
            threads.into_iter().map(|thread| thread.join().unwrap().to_string()).collect()
        });
        let [who, expected] = [&outcomes[0], "expected a rank of its own from 1 to 2"];
        assert!(who.starts_with("rank 1 (") && who.contains("): rank: found 1, which "), "{who}");
        assert!(who.ends_with(expected), "{who}");
    }

    #[test]
    fn missing_processes_are_named_after_the_deadline() {
        let timing = Timing { deadline: Duration::from_secs(2), ..TIMING };
        let processes = processes(4);
        let errors: Vec<_> = thread::scope(|scope| {
            let join = |rank: usize| {
                let process = &processes[rank];
                scope.spawn(move || join(process, "a", timing).err().unwrap())
            };
            let threads = [join(0), join(2)];
            threads.into_iter().map(|thread| thread.join().unwrap().to_string()).collect()
        });
        let address = format!("127.0.0.1:{}", processes[0].port);
        let expected = format!(
            "rank 0 waited 2 s at {address}: found 2 of 4 processes (WORLD_SIZE), missing rank 1, 3"
        );
        assert_eq!(errors[0], expected);
        assert_eq!(errors[1], format!("rank 0 ended the rendezvous: {expected}"));
    }

    #[test]
    fn a_process_without_rank_0_says_where_it_looked() {
        let timing = Timing { deadline: Duration::from_millis(300), ..TIMING };
        let processes = processes(2);
        let error = join(&processes[1], "a", timing).err().unwrap().to_string();
        let address = format!("127.0.0.1:{}", processes[0].port);
        assert!(
            error.starts_with(&format!("rank 1 found no rank 0 at {address} within 0.3 s: ")),
            "{error}"
        );
    }

    #[test]
    fn strangers_that_connect_are_ignored() {
        let processes = processes(2);
        let (lead, follow) = thread::scope(|scope| {
            let lead = scope.spawn(|| join(&processes[0], "a", TIMING));
            let mut stranger = loop {
                match TcpStream::connect(("127.0.0.1", processes[0].port)) {
                    Ok(stream) => break stream,
                    Err(_) => thread::sleep(Duration::from_millis(10)),
                }
            };
            stranger.write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
            let follow = join(&processes[1], "a", TIMING);
            (lead.join().unwrap(), follow)
        });
        lead.unwrap().tell("go");
        assert_eq!(follow.unwrap().hear().unwrap(), "go");
    }

    #[test]
    fn all_learn_the_name_of_a_process_that_is_lost() {
        let mut groups = all(&["a", "a", "a"], TIMING);
        let called = Arc::new(AtomicBool::new(false));
        let flag = called.clone();
        groups[0].on_gone(move || flag.store(true, Ordering::SeqCst));
        drop(groups.remove(1));
        let lost = groups[0].gone(Duration::from_secs(10)).unwrap().to_string();
        assert!(lost.starts_with("rank 1 (") && lost.ends_with(") was lost"), "{lost}");
        assert_eq!(groups[1].hear().unwrap_err().to_string(), lost);
        while !called.load(Ordering::SeqCst) {
            thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn a_process_that_gives_no_sign_of_life_is_lost() {
        let quiet = Timing { alive: Duration::from_secs(60), ..TIMING };
        let processes = processes(2);
        let (lead, _follow) = thread::scope(|scope| {
            let lead = scope.spawn(|| join(&processes[0], "a", TIMING));
            let follow = join(&processes[1], "a", quiet);
            (lead.join().unwrap().unwrap(), follow)
        });
        assert_eq!(lead.gone(Duration::ZERO), None);
        let lost = lead.gone(20 * TIMING.silence).unwrap().to_string();
        assert!(lost.starts_with("rank 1 ("), "{lost}");
    }

    #[test]
    fn all_learn_why_a_process_has_ended() {
        let groups = all(&["a", "a", "a"], TIMING);
        groups[1].fail("GPU 1: no memory");
        for group in [&groups[0], &groups[2]] {
            let ended = group.gone(Duration::from_secs(10)).unwrap().to_string();
            assert!(
                ended.starts_with("rank 1 (") && ended.ends_with(") ended: GPU 1: no memory"),
                "{ended}"
            );
        }
    }

    #[test]
    fn nobody_is_lost_at_the_end_of_a_run() {
        let groups = all(&["a", "a", "a"], TIMING);
        groups[0].tell("over");
        for group in &groups[1..] {
            assert_eq!(group.hear().unwrap(), "over");
            group.finish();
        }
        let mut groups = groups.into_iter();
        let lead = groups.next().unwrap();
        groups.for_each(drop);
        assert_eq!(lead.gone(Duration::from_millis(300)), None);
    }

    #[test]
    fn a_process_that_does_not_come_back_is_abandoned() {
        static SENTENCE: Mutex<String> = Mutex::new(String::new());
        let processes = processes(2);
        let timing = Timing { abandon: Duration::from_millis(50), ..TIMING };
        let lead = thread::scope(|scope| {
            let lead = scope.spawn(|| {
                let abandon = &|sentence: &str| sentence.clone_into(&mut lock(&SENTENCE));
                let options = ProcessOptions { process: &processes[0], timing, abandon };
                Group::join(&options, &facts("a")).unwrap()
            });
            drop(join(&processes[1], "a", TIMING).unwrap());
            lead.join().unwrap()
        });
        for _ in 0..1000 {
            if !lock(&SENTENCE).is_empty() {
                break;
            }
            thread::sleep(Duration::from_millis(10));
        }
        assert!(lock(&SENTENCE).contains("was lost; continue from"), "{}", lock(&SENTENCE));
        drop(lead);
    }
}
