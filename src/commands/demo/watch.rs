//! What the demo records and shows while it runs.

use std::{
    io::{Write, stdout},
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use anyhow::Context;

use super::{SCENE, live::Live};
use eddy_bag::{BagSummary, TopicId};
use eddy_frames::clock::{self, Clock};
use eddy_messages::{PredictionStatus, cdr};
use eddy_node::Recorder;
use eddy_transport::{Payload, Subscriber};

/// How long the watcher waits for a frame before it looks at everything else.
const PATIENCE: Duration = Duration::from_millis(20);

/// What is recorded and shown.
pub(super) struct Watch {
    pub(super) recorder: Option<Recorder>,
    pub(super) recorded: Option<BagSummary>,
    pub(super) truth: Recorded,
    pub(super) prediction: Recorded,
    pub(super) status: Recorded,
}

/// A topic that is recorded as it is received.
pub(super) struct Recorded {
    pub(super) subscriber: Box<dyn Subscriber>,
    pub(super) topic: TopicId,
}

impl Recorded {
    /// What comes; it is recorded if it belongs to the first scene.
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
    /// Records and compares until the truth has ended and nothing more comes.
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
        let mut printed = clock.now();
        loop {
            let ended = truth_ended.load(Ordering::Relaxed);
            self.predictions(&mut live)?;
            while let Some(payload) = self.status.receive(&mut self.recorder, Duration::ZERO)? {
                let status: PredictionStatus = cdr::decode(&payload.into_cdr())?;
                if status.stream != SCENE {
                    // What was predicted of the first scene was published before.
                    self.predictions(&mut live)?;
                    self.close()?;
                }
                live.status(status);
            }
            match self.truth.receive(&mut self.recorder, PATIENCE)? {
                Some(payload) => live.truth(payload.into_frame()?),
                None if ended => break,
                None => {}
            }
            if clock.now() - printed >= interval {
                printed = clock.now();
                printer.print(&live.line(printed));
            }
        }
        if matches!(printer, Printer::Line) {
            println!();
        }
        Ok(())
    }

    fn predictions(&mut self, live: &mut Live) -> anyhow::Result<()> {
        while let Some(payload) = self.prediction.receive(&mut self.recorder, Duration::ZERO)? {
            live.prediction(payload.into_frame()?);
        }
        Ok(())
    }

    /// Reads what still comes until those who publish have `ended`, and records it unless that has failed.
    pub(super) fn read_on(&mut self, records: bool, ended: impl Fn() -> bool) {
        if !records {
            self.recorder = None;
        }
        while !ended() {
            for topic in [&mut self.prediction, &mut self.status, &mut self.truth] {
                while let Ok(Some(_)) = topic.receive(&mut self.recorder, Duration::ZERO) {}
            }
            thread::sleep(PATIENCE);
        }
    }

    /// Closes the bag, if it is open.
    fn close(&mut self) -> anyhow::Result<()> {
        if let Some(recorder) = self.recorder.take() {
            self.recorded = Some(recorder.finish()?);
        }
        Ok(())
    }

    /// Records what the node published last, and closes the bag.
    pub(super) fn finish(mut self) -> anyhow::Result<BagSummary> {
        for topic in [&mut self.prediction, &mut self.status] {
            while topic.receive(&mut self.recorder, Duration::ZERO)?.is_some() {}
        }
        self.close()?;
        self.recorded.context("the bag was closed twice")
    }
}

/// How the live line is shown.
pub(super) enum Printer {
    /// One line of a terminal, again and again.
    Line,
    /// A new line every second.
    Lines { quiet: bool },
}

impl Printer {
    fn print(&self, line: &str) {
        match self {
            Self::Line => {
                print!("\r\x1b[2K{line}");
                // A terminal that went away is no reason to end.
                let _ = stdout().flush();
            }
            Self::Lines { quiet: false } => println!("{line}"),
            Self::Lines { quiet: true } => {}
        }
    }
}
