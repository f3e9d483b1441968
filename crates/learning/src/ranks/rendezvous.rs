//! Processes find each other at rank 0, which checks that all are about to train the same.

use std::{
    io,
    net::{IpAddr, TcpListener, TcpStream, ToSocketAddrs as _},
    thread,
    time::Duration,
};

use eddy_frames::clock::Clock;

use super::{Process, RankError, message::Message};

/// Longest wait for the greeting of a process that has connected.
const GREETING: Duration = Duration::from_secs(5);
/// Interval at which rank 0 looks for new connections.
const POLL: Duration = Duration::from_millis(5);
/// Interval between attempts to reach rank 0.
const RETRY: Duration = Duration::from_millis(100);

/// What processes of a run have in common, by name, in the order in which differences are reported.
pub(super) type Facts = [(String, String)];

/// Another process.
pub(super) struct Member {
    pub(super) rank: usize,
    /// Its host and number there.
    pub(super) name: String,
    pub(super) stream: TcpStream,
}

impl Member {
    /// As in messages: `rank 1 (host, process 7)`.
    pub(super) fn who(&self) -> String {
        who(self.rank, &self.name)
    }
}

pub(super) fn who(rank: usize, name: &str) -> String {
    format!("rank {rank} ({name})")
}

/// The port of rank 0: on this host only if the others are here too.
pub(super) fn listen(process: &Process) -> Result<TcpListener, RankError> {
    let (address, port) = (process.address.as_str(), process.port);
    let is_here = address == "localhost"
        || address.parse().is_ok_and(|address: IpAddr| address.is_loopback());
    let listener = if is_here {
        TcpListener::bind((address, port))
    } else {
        // The name of this host may have another address here than elsewhere. A system without IPv6 has the second.
        TcpListener::bind(("::", port)).or_else(|_| TcpListener::bind(("0.0.0.0", port)))
    };
    listener.map_err(|reason| RankError::Listen {
        address: format!("{address}:{port}"),
        reason: reason.to_string(),
    })
}

/// Rank 0: waits for the others, and lets them begin when all are there with the same facts. In the order of their ranks.
pub(super) fn lead(
    listener: &TcpListener,
    process: &Process,
    name: &str,
    facts: &Facts,
    deadline: Duration,
) -> Result<Vec<Member>, RankError> {
    let mut greetings = Vec::new();
    let gathered = gather(listener, process, deadline, &mut greetings);
    // A difference explains more than a process that is missing.
    let differs =
        greetings.iter().find_map(|(member, found)| compare(&member.who(), found, facts).err());
    let outcome = differs.map_or(gathered, Err);
    let answer = match &outcome {
        Ok(()) => Message::Welcome { name: name.to_owned() },
        Err(error) => Message::Refused { reason: error.to_string() },
    };
    let mut members: Vec<Member> = greetings.into_iter().map(|(member, _)| member).collect();
    for member in &mut members {
        // One that is lost by now is found to be so later.
        let _ = answer.send(&mut member.stream);
    }
    members.sort_by_key(|member| member.rank);
    outcome.map(|()| members)
}

/// Another process with its facts.
type Greeting = (Member, Vec<(String, String)>);

/// Adds processes to `greetings` until all are there.
fn gather(
    listener: &TcpListener,
    process: &Process,
    deadline: Duration,
    greetings: &mut Vec<Greeting>,
) -> Result<(), RankError> {
    let clock = Clock::start();
    listener.set_nonblocking(true).map_err(|error| RankError::system(&error))?;
    while greetings.len() + 1 < process.count {
        if clock.now() >= deadline {
            let is_there = |rank: &usize| greetings.iter().any(|(member, _)| member.rank == *rank);
            let missing = (1..process.count).filter(|rank| !is_there(rank));
            return Err(RankError::Missing {
                address: format!("{}:{}", process.address, process.port),
                deadline,
                found: greetings.len() + 1,
                expected: process.count,
                variable: process.count_variable,
                missing: missing.map(|rank| rank.to_string()).collect::<Vec<_>>().join(", "),
            });
        }
        let Ok((stream, from)) = listener.accept() else {
            thread::sleep(POLL);
            continue;
        };
        let greeting = match greet(stream) {
            Ok(greeting) => greeting,
            Err(error) => {
                tracing::warn!("a connection from {from} is not of a process of this run: {error}");
                continue;
            }
        };
        let (who, rank) = (greeting.0.who(), greeting.0.rank);
        let twin = greetings.iter().find(|(known, _)| known.rank == rank);
        let twin = twin.map(|(known, _)| format!(", which {} has", known.name));
        greetings.push(greeting);
        if rank == 0 || rank >= process.count || twin.is_some() {
            let found = format!("{rank}{}", twin.unwrap_or_default());
            let expected = format!("a rank of its own from 1 to {}", process.count - 1);
            return Err(RankError::Rank { who, found, expected });
        }
    }
    Ok(())
}

/// Takes the greeting of a process.
fn greet(mut stream: TcpStream) -> io::Result<Greeting> {
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(GREETING))?;
    match Message::receive(&mut stream)? {
        Message::Hello { rank, name, facts } => Ok((Member { rank, name, stream }, facts)),
        other => Err(io::Error::other(format!("found {other:?}, expected a greeting"))),
    }
}

/// The first difference of facts.
fn compare(who: &str, found: &Facts, expected: &Facts) -> Result<(), RankError> {
    let nothing = || "nothing".to_owned();
    let value = |facts: &Facts, field: &str| {
        facts
            .iter()
            .find(|(name, _)| name == field)
            .map_or_else(nothing, |(_, value)| value.clone())
    };
    for (field, _) in expected.iter().chain(found) {
        let (found, expected) = (value(found, field), value(expected, field));
        if found != expected {
            return Err(RankError::Differs {
                who: who.to_owned(),
                field: field.clone(),
                found,
                expected,
            });
        }
    }
    Ok(())
}

/// Any other rank: connects to rank 0 and waits until all are there.
pub(super) fn follow(
    process: &Process,
    name: &str,
    facts: &Facts,
    deadline: Duration,
) -> Result<Member, RankError> {
    let no_answer = |reason: String| RankError::NoAnswer {
        rank: process.rank,
        address: format!("{}:{}", process.address, process.port),
        deadline,
        reason,
    };
    let mut stream = connect(process, deadline).map_err(no_answer)?;
    let hello = Message::Hello { rank: process.rank, name: name.to_owned(), facts: facts.to_vec() };
    let answer = (|| {
        stream.set_nodelay(true)?;
        // Rank 0 may have begun to wait just now.
        stream.set_read_timeout(Some(deadline + GREETING))?;
        hello.send(&mut stream)?;
        Message::receive(&mut stream)
    })();
    match answer {
        Ok(Message::Welcome { name }) => Ok(Member { rank: 0, name, stream }),
        Ok(Message::Refused { reason }) => Err(RankError::Refused { reason }),
        Ok(other) => Err(no_answer(format!("found {other:?}, expected a welcome"))),
        Err(error) => Err(no_answer(format!("connected, then: {error}"))),
    }
}

/// A connection to rank 0, which may start to listen later.
fn connect(process: &Process, deadline: Duration) -> Result<TcpStream, String> {
    let clock = Clock::start();
    loop {
        let reason = match (process.address.as_str(), process.port).to_socket_addrs() {
            Err(error) => error.to_string(),
            Ok(addresses) => {
                let mut reason = "the name has no address".to_owned();
                for address in addresses {
                    let left = deadline.saturating_sub(clock.now()).max(RETRY);
                    match TcpStream::connect_timeout(&address, left) {
                        Ok(stream) => return Ok(stream),
                        Err(error) => reason = error.to_string(),
                    }
                }
                reason
            }
        };
        if clock.now() + RETRY > deadline {
            return Err(reason);
        }
        thread::sleep(RETRY);
    }
}
