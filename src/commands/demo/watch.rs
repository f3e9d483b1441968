//! Records and compares while the demo runs.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use anyhow::Context;

use super::{SCENE, live::Live, scenes::name};
use eddy_bag::{BagSummary, TopicId};
use eddy_cli::terminal;
use eddy_frames::clock::{self, Clock};
use eddy_messages::{PredictionStatus, cdr};
use eddy_node::Recorder;
use eddy_transport::{Payload, Subscriber};

/// Longest wait for a frame.
const MAX_WAIT: Duration = Duration::from_millis(20);

pub(super) struct Watch {
    pub(super) recorder: Option<Recorder>,
    pub(super) recorded: Option<BagSummary>,
    pub(super) truth: Recorded,
    pub(super) prediction: Recorded,
    pub(super) status: Recorded,
    /// Tools, if the scenes have some: what they are, and where.
    pub(super) tools: Vec<Recorded>,
}

/// A topic that is recorded as it is received.
pub(super) struct Recorded {
    pub(super) subscriber: Box<dyn Subscriber>,
    pub(super) topic: TopicId,
}

impl Recorded {
    /// Receives a message and records it if it belongs to the first scene.
    fn receive(
        &mut self,
        recorder: &mut Option<Recorder>,
        timeout: Duration,
    ) -> anyhow::Result<Option<Payload>> {
        let payload = self.subscriber.receive(timeout)?;
        if let (Some(payload), Some(recorder)) = (&payload, recorder)
            && payload.stream().is_none_or(|stream| stream == SCENE)
        {
            recorder.on_message(self.topic, payload.clone(), clock::wall())?;
            recorder.on_tick(clock::wall())?;
        }
        Ok(payload)
    }
}

impl Watch {
    /// Records and compares until the simulation has ended and all frames are received.
    pub(super) fn run(
        &mut self,
        mut live: Live,
        truth_ended: &AtomicBool,
        printer: Printer,
    ) -> anyhow::Result<()> {
        let clock = Clock::start();
        let interval = match printer {
            Printer::Line => Duration::from_millis(200),
            Printer::Lines { .. } => Duration::from_secs(1),
        };
        let (mut printed, mut named) = (clock.now(), None);
        loop {
            let ended = truth_ended.load(Ordering::Relaxed);
            self.tools()?;
            self.predictions(&mut live)?;
            while let Some(payload) = self.status.receive(&mut self.recorder, Duration::ZERO)? {
                let status: PredictionStatus = cdr::decode(&payload.into_cdr())?;
                if status.stream != SCENE {
                    // All predictions of the first scene were published before this status.
                    self.predictions(&mut live)?;
                    self.close()?;
                }
                live.status(status);
            }
            match self.truth.receive(&mut self.recorder, MAX_WAIT)? {
                Some(payload) => {
                    let frame = payload.into_frame()?;
                    if named.replace(frame.stream) != Some(frame.stream) {
                        printer.announce(&name(&frame));
                    }
                    live.truth(frame);
                }
                None if ended => break,
                None => {}
            }
            if clock.now() - printed >= interval {
                printed = clock.now();
                printer.print(&live.line(printed, printer.columns()));
            }
        }
        terminal::clear_status();
        Ok(())
    }

    fn tools(&mut self) -> anyhow::Result<()> {
        for topic in &mut self.tools {
            while topic.receive(&mut self.recorder, Duration::ZERO)?.is_some() {}
        }
        Ok(())
    }

    fn predictions(&mut self, live: &mut Live) -> anyhow::Result<()> {
        while let Some(payload) = self.prediction.receive(&mut self.recorder, Duration::ZERO)? {
            live.prediction(payload.into_frame()?);
        }
        Ok(())
    }

    /// Receives until the publishers have ended, so that they do not block; records unless recording has failed.
    pub(super) fn drain(&mut self, records: bool, ended: impl Fn() -> bool) {
        if !records {
            self.recorder = None;
        }
        while !ended() {
            let frames = [&mut self.prediction, &mut self.status, &mut self.truth];
            for topic in frames.into_iter().chain(&mut self.tools) {
                while let Ok(Some(_)) = topic.receive(&mut self.recorder, Duration::ZERO) {}
            }
            thread::sleep(MAX_WAIT);
        }
    }

    /// Closes the bag, if it is open.
    fn close(&mut self) -> anyhow::Result<()> {
        if let Some(recorder) = self.recorder.take() {
            self.recorded = Some(recorder.finish()?);
        }
        Ok(())
    }

    /// Records the last messages of the node and closes the bag.
    pub(super) fn finish(mut self) -> anyhow::Result<BagSummary> {
        for topic in [&mut self.prediction, &mut self.status] {
            while topic.receive(&mut self.recorder, Duration::ZERO)?.is_some() {}
        }
        self.tools()?;
        self.close()?;
        self.recorded.context("the bag was closed twice")
    }
}

/// Where the live line is printed.
pub(super) enum Printer {
    /// One line of a terminal, overwritten.
    Line,
    /// A new line every second.
    Lines { quiet: bool },
}

impl Printer {
    /// Columns of a line.
    fn columns(&self) -> usize {
        match self {
            Self::Line => terminal::columns(),
            Self::Lines { .. } => usize::MAX,
        }
    }

    /// Prints a line that stays.
    fn announce(&self, line: &str) {
        if !matches!(self, Self::Lines { quiet: true }) {
            println!("{line}");
        }
    }

    fn print(&self, line: &str) {
        match self {
            Self::Line => terminal::show_status(line),
            Self::Lines { quiet: false } => println!("{line}"),
            Self::Lines { quiet: true } => {}
        }
    }
}
