//! A frame that is read where its publisher wrote it.

use std::{
    fmt,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
};

use iceoryx2::{prelude::ZeroCopySend, sample::Sample};

use super::{
    layout::{self, FrameHeader, SharedParticle},
    service::Ipc,
};
use crate::Payload;
use eddy_frames::{Frame, FrameView, InvalidFrame};
use eddy_messages::{FrameCdr as _, cdr};

/// A frame in the memory of its publisher, which is returned when this is dropped.
///
/// Publishers must not write to it meanwhile. A publisher that does corrupts the numbers of this frame, and nothing
/// else.
pub struct SharedFrame {
    sample: FrameSample,
    /// As received.
    header: FrameHeader,
    checked: bool,
    /// After the sample, so that the sample is returned before the loan ends.
    _loan: Loan,
}

impl SharedFrame {
    pub(super) fn new(sample: FrameSample, loan: Loan) -> Self {
        let header = *sample.user_header();
        Self { sample, header, checked: false, _loan: loan }
    }

    /// The unchecked stream id.
    pub(crate) fn stream(&self) -> u64 {
        self.header.stream
    }

    /// Checks the frame, once.
    pub(crate) fn check(&mut self) -> Result<(), InvalidFrame> {
        if !self.checked {
            self.read().check()?;
            self.checked = true;
        }
        Ok(())
    }

    /// The frame; `None` before [`SharedFrame::check`].
    pub(crate) fn view(&self) -> Option<FrameView<'_>> {
        self.checked.then(|| self.read())
    }

    fn read(&self) -> FrameView<'_> {
        layout::view(&self.header, layout::particles(self.sample.payload()))
    }

    /// A checked copy.
    pub(crate) fn to_frame(&self) -> Result<Frame, InvalidFrame> {
        to_frame(&self.sample)
    }

    /// The message, also if it is not a valid frame.
    pub(crate) fn to_cdr(&self) -> Vec<u8> {
        to_cdr(&self.sample)
    }

    /// A copy in the memory of the process.
    pub(crate) fn copy(&self) -> Payload {
        copy(&self.sample)
    }

    /// Size in memory (bytes).
    pub(crate) fn size(&self) -> usize {
        size_of_val(self.sample.payload())
    }
}

impl fmt::Debug for SharedFrame {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.read().fmt(formatter)
    }
}

/// A frame as it is received.
pub(super) type FrameSample<const D: usize = 2> = Sample<Ipc, [SharedParticle<D>], FrameHeader<D>>;

/// A copy: a frame, or bytes if it is not a valid frame.
pub(super) fn copy(sample: &FrameSample) -> Payload {
    to_frame(sample).map_or_else(|_| Payload::Cdr(to_cdr(sample)), Payload::Frame)
}

fn to_frame(sample: &FrameSample) -> Result<Frame, InvalidFrame> {
    layout::frame(sample.user_header(), layout::particles(sample.payload()))
}

/// The message, also if it is not a valid frame.
pub(super) fn to_cdr<const D: usize>(sample: &FrameSample<D>) -> Vec<u8>
where
    SharedParticle<D>: ZeroCopySend,
    FrameHeader<D>: ZeroCopySend,
{
    let (header, particles) = (sample.user_header(), layout::particles(sample.payload()));
    match layout::frame(header, particles) {
        Ok(frame) => frame.to_cdr(),
        Err(_) => cdr::encode(&layout::message(header, particles)),
    }
}

/// Counts the samples that a subscriber has lent out.
#[derive(Clone, Debug, Default)]
pub(super) struct LoanCounter(Arc<AtomicUsize>);

/// A sample that is lent out.
pub(super) struct Loan(LoanCounter);

impl LoanCounter {
    /// A loan, unless `most` samples are lent out.
    pub(super) fn lend(&self, most: usize) -> Option<Loan> {
        // Only the subscriber increments.
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
