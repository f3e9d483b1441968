//! Requests to a thread that answers them when it has time.

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

/// Carries requests `Q` to a thread that answers with `R`.
#[derive(Debug)]
pub struct RequestChannel<Q, R> {
    waiting: Queue<PendingRequest<Q, R>>,
}

/// A request that nobody has accepted yet.
#[derive(Debug)]
pub struct PendingRequest<Q, R> {
    request: Q,
    caller: Option<Caller<R>>,
}

#[derive(Debug)]
struct Caller<R> {
    sender: SyncSender<R>,
    /// Raised once: by the caller on timeout, or by the thread that accepts the request.
    settled: Arc<AtomicBool>,
}

/// Sends the response to the caller, if there is one.
#[derive(Debug)]
pub struct Responder<R>(Option<SyncSender<R>>);

impl<Q, R> Default for RequestChannel<Q, R> {
    fn default() -> Self {
        Self { waiting: Queue::new(DEPTH) }
    }
}

impl<Q, R> RequestChannel<Q, R> {
    /// Sends a request, waits `timeout` for it to be accepted, then for the response. `None` when it was not accepted
    /// in time or the channel was full, and then it is not carried out later; also when the thread that accepted it
    /// ended without a response.
    pub fn call(&self, request: Q, timeout: Duration) -> Option<R> {
        let (sender, receiver) = sync_channel(1);
        let settled = Arc::new(AtomicBool::new(false));
        let caller = Some(Caller { sender, settled: Arc::clone(&settled) });
        self.waiting.push_or_wait(PendingRequest { request, caller }, Duration::ZERO).ok()?;
        match receiver.recv_timeout(timeout) {
            Ok(response) => Some(response),
            Err(_) if settled.swap(true, Ordering::AcqRel) => receiver.recv().ok(),
            Err(_) => None,
        }
    }

    /// The oldest request.
    pub fn next(&self) -> Option<PendingRequest<Q, R>> {
        self.waiting.pop(Duration::ZERO)
    }

    /// Rejects all requests, now and later: their callers return at once.
    pub fn close(&self) {
        self.waiting.close();
    }
}

impl<Q, R> PendingRequest<Q, R> {
    /// The request, and where to send the response; `None` when its caller has given up.
    pub fn accept(self) -> Option<(Q, Responder<R>)> {
        match self.caller {
            Some(caller) if caller.settled.swap(true, Ordering::AcqRel) => None,
            caller => Some((self.request, Responder(caller.map(|caller| caller.sender)))),
        }
    }
}

impl<Q, R> From<Q> for PendingRequest<Q, R> {
    /// A request without a caller, such as a key press.
    fn from(request: Q) -> Self {
        Self { request, caller: None }
    }
}

impl<R> Responder<R> {
    /// Sends the response.
    pub fn send(self, response: R) {
        // A caller whose request was accepted waits for the response, unless its thread has ended.
        let _ = self.0.map(|caller| caller.send(response));
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;

    const LONG: Duration = Duration::from_secs(60);

    fn first<Q, R>(requests: &RequestChannel<Q, R>) -> PendingRequest<Q, R> {
        loop {
            if let Some(pending) = requests.next() {
                break pending;
            }
            thread::yield_now();
        }
    }

    #[test]
    fn a_caller_receives_the_response() {
        let requests = RequestChannel::default();
        thread::scope(|scope| {
            let caller = scope.spawn(|| requests.call(2, LONG));
            let (request, responder) = first(&requests).accept().unwrap();
            assert_eq!(request, 2);
            responder.send(3);
            assert_eq!(caller.join().unwrap(), Some(3));
        });
    }

    #[test]
    fn closing_releases_all_callers() {
        let requests = RequestChannel::<i32, i32>::default();
        thread::scope(|scope| {
            let caller = scope.spawn(|| requests.call(1, LONG));
            requests.close();
            assert_eq!(caller.join().unwrap(), None);
        });
        assert_eq!(requests.call(1, LONG), None);
    }

    #[test]
    fn a_request_that_timed_out_is_not_accepted() {
        let requests = RequestChannel::<i32, i32>::default();
        assert_eq!(requests.call(1, Duration::ZERO), None);
        assert!(requests.next().unwrap().accept().is_none());
    }

    #[test]
    fn a_request_is_carried_out_exactly_when_its_caller_gets_a_response() {
        let requests = RequestChannel::default();
        for pause in 0..20 {
            thread::scope(|scope| {
                let caller = scope.spawn(|| requests.call(1, Duration::from_millis(2)));
                thread::sleep(Duration::from_micros(200 * pause));
                let response = first(&requests).accept().map(|(request, responder)| {
                    thread::sleep(Duration::from_millis(5));
                    responder.send(request + 1);
                    2
                });
                assert_eq!(caller.join().unwrap(), response);
            });
        }
    }
}
