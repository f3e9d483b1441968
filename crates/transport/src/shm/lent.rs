//! A frame that is read where its publisher wrote it.

use std::{
    fmt,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
};

use iceoryx2::sample::Sample;

use super::{
    layout::{self, FrameHeader, SharedParticle},
    service::Ipc,
};
use crate::Payload;
use eddy_frames::{Frame, FrameView, InvalidFrame};
use eddy_messages::cdr;

/// A frame in the memory of its publisher, which gets it back when this is dropped.
///
/// Who publishes has promised not to write there meanwhile. One that does nevertheless spoils the numbers
/// it has sent, and nothing else.
pub struct SharedFrame {
    sample: FrameSample,
    /// As it was when it came.
    header: FrameHeader,
    checked: bool,
    /// Behind the sample: what is counted as given back has been given back.
    _loan: Loan,
}

impl SharedFrame {
    pub(super) fn new(sample: FrameSample, loan: Loan) -> Self {
        let header = *sample.user_header();
        Self { sample, header, checked: false, _loan: loan }
    }

    /// The stream it says it is of.
    pub(crate) fn stream(&self) -> u64 {
        self.header.stream
    }

    /// Checks it, once.
    pub(crate) fn check(&mut self) -> Result<(), InvalidFrame> {
        if !self.checked {
            self.read().check()?;
            self.checked = true;
        }
        Ok(())
    }

    /// The frame, if it was found to be one.
    pub(crate) fn view(&self) -> Option<FrameView<'_>> {
        self.checked.then(|| self.read())
    }

    fn read(&self) -> FrameView<'_> {
        layout::view(&self.header, layout::particles(self.sample.payload()))
    }

    /// A frame of its own.
    pub(crate) fn to_frame(&self) -> Result<Frame, InvalidFrame> {
        to_frame(&self.sample)
    }

    /// The message it is, frame or not.
    pub(crate) fn to_cdr(&self) -> Vec<u8> {
        to_cdr(&self.sample)
    }

    /// The same in memory of its own.
    pub(crate) fn copy(&self) -> Payload {
        copy(&self.sample)
    }

    /// The memory it takes (bytes).
    pub(crate) fn size(&self) -> usize {
        size_of_val(self.sample.payload())
    }
}

impl fmt::Debug for SharedFrame {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.read().fmt(formatter)
    }
}

type FrameSample = Sample<Ipc, [SharedParticle], FrameHeader>;

/// A frame of its own, or bytes if it is none.
pub(super) fn copy(sample: &FrameSample) -> Payload {
    to_frame(sample).map_or_else(|_| Payload::Cdr(to_cdr(sample)), Payload::Frame)
}

fn to_frame(sample: &FrameSample) -> Result<Frame, InvalidFrame> {
    layout::frame(sample.user_header(), layout::particles(sample.payload()))
}

fn to_cdr(sample: &FrameSample) -> Vec<u8> {
    cdr::encode(&layout::message(sample.user_header(), layout::particles(sample.payload())))
}

/// How many samples a reader has lent out.
#[derive(Clone, Debug, Default)]
pub(super) struct Ledger(Arc<AtomicUsize>);

/// One of them.
pub(super) struct Loan(Ledger);

impl Ledger {
    /// A loan, unless `most` are out.
    pub(super) fn lend(&self, most: usize) -> Option<Loan> {
        // Only the reader counts up.
        let out = self.0.load(Ordering::Acquire);
        (out < most).then(|| {
            self.0.fetch_add(1, Ordering::Relaxed);
            Loan(self.clone())
        })
    }
}

impl Drop for Loan {
    fn drop(&mut self) {
        self.0.0.fetch_sub(1, Ordering::Release);
    }
}
