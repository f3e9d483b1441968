//! Requests that wait for who answers them, on another thread.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{SyncSender, sync_channel},
    },
    time::Duration,
};

use eddy_transport::Queue;

/// Requests that may wait.
const DEPTH: usize = 16;

/// The way to somebody who answers requests `R` with answers `A` when there is time for it.
#[derive(Debug)]
pub struct Requests<R, A> {
    waiting: Queue<Pending<R, A>>,
}

/// A request, and who waits for its answer.
#[derive(Debug)]
pub struct Pending<R, A> {
    request: R,
    asker: Option<Asker<A>>,
}

#[derive(Debug)]
struct Asker<A> {
    sender: SyncSender<A>,
    /// Raised once, by the asker who gives up or by who begins to answer.
    settled: Arc<AtomicBool>,
}

/// Tells the asker, if there is one who waits.
#[derive(Debug)]
pub struct Reply<A>(Option<SyncSender<A>>);

impl<R, A> Default for Requests<R, A> {
    fn default() -> Self {
        Self { waiting: Queue::new(DEPTH) }
    }
}

impl<R, A> Requests<R, A> {
    /// Asks, and waits `patience` for somebody to begin with it, then for the answer. `None` when nobody began, or
    /// there was no room for one more: then it is not done later. Also when who had begun ended without an answer.
    pub fn ask(&self, request: R, patience: Duration) -> Option<A> {
        let (sender, receiver) = sync_channel(1);
        let settled = Arc::new(AtomicBool::new(false));
        let asker = Some(Asker { sender, settled: Arc::clone(&settled) });
        self.waiting.push_or_wait(Pending { request, asker }, Duration::ZERO).ok()?;
        match receiver.recv_timeout(patience) {
            Ok(answer) => Some(answer),
            Err(_) if settled.swap(true, Ordering::AcqRel) => receiver.recv().ok(),
            Err(_) => None,
        }
    }

    /// The oldest request.
    pub fn next(&self) -> Option<Pending<R, A>> {
        self.waiting.pop(Duration::ZERO)
    }

    /// No more requests: who waits for an answer is told that there will be none.
    pub fn close(&self) {
        self.waiting.close();
    }
}

impl<R, A> Pending<R, A> {
    /// The request, and the way to tell what became of it; `None` when nobody waits for it any more.
    pub fn begin(self) -> Option<(R, Reply<A>)> {
        match self.asker {
            Some(asker) if asker.settled.swap(true, Ordering::AcqRel) => None,
            asker => Some((self.request, Reply(asker.map(|asker| asker.sender)))),
        }
    }
}

impl<R, A> From<R> for Pending<R, A> {
    /// A request of somebody who sees what becomes of it.
    fn from(request: R) -> Self {
        Self { request, asker: None }
    }
}

impl<A> Reply<A> {
    /// Tells who asked.
    pub fn send(self, answer: A) {
        // An asker whose request was begun waits until the answer comes; one may be gone with its thread.
        let _ = self.0.map(|asker| asker.send(answer));
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;

    const LONG: Duration = Duration::from_secs(60);

    fn first<R, A>(requests: &Requests<R, A>) -> Pending<R, A> {
        loop {
            if let Some(pending) = requests.next() {
                break pending;
            }
            thread::yield_now();
        }
    }

    #[test]
    fn who_asks_hears_the_answer() {
        let requests = Requests::default();
        thread::scope(|scope| {
            let asker = scope.spawn(|| requests.ask(2, LONG));
            let (request, reply) = first(&requests).begin().unwrap();
            assert_eq!(request, 2);
            reply.send(3);
            assert_eq!(asker.join().unwrap(), Some(3));
        });
    }

    #[test]
    fn who_ends_lets_nobody_wait() {
        let requests = Requests::<i32, i32>::default();
        thread::scope(|scope| {
            let asker = scope.spawn(|| requests.ask(1, LONG));
            requests.close();
            assert_eq!(asker.join().unwrap(), None);
        });
        assert_eq!(requests.ask(1, LONG), None);
    }

    #[test]
    fn a_request_that_was_given_up_is_not_begun() {
        let requests = Requests::<i32, i32>::default();
        assert_eq!(requests.ask(1, Duration::ZERO), None);
        assert!(requests.next().unwrap().begin().is_none());
    }

    #[test]
    fn what_is_done_is_told_however_late_and_what_is_not_told_is_not_done() {
        let requests = Requests::default();
        for pause in 0..20 {
            thread::scope(|scope| {
                let asker = scope.spawn(|| requests.ask(1, Duration::from_millis(2)));
                thread::sleep(Duration::from_micros(200 * pause));
                let answer = first(&requests).begin().map(|(request, reply)| {
                    thread::sleep(Duration::from_millis(5));
                    reply.send(request + 1);
                    2
                });
                assert_eq!(asker.join().unwrap(), answer);
            });
        }
    }
}
