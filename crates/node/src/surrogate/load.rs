//! What a running node has to do beside what it can do.

use std::time::Duration;

/// What the node has had to do.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Load {
    /// Frames since the start that reached the model.
    pub(super) received: u64,
    /// Frames since the start that were dropped before.
    pub(super) dropped: u64,
    /// Frames between the last two reports that reached the model.
    pub(super) frames: u64,
    /// Frames that arrived between them.
    pub(super) arrived: u64,
    /// Time that the model took for those that reached it.
    pub(super) busy: Duration,
    /// Time between the reports.
    pub(super) interval: Duration,
    /// Frames predicted ahead.
    pub(super) horizon: u32,
    /// Streams that the node keeps.
    pub(super) streams: usize,
    /// Threads that step one stream each; `None` on a GPU, which steps all at once.
    pub(super) threads: Option<usize>,
}

impl Load {
    /// Why frames were dropped, with what was measured, and what would help on a machine with this number of processors.
    pub(super) fn advice(&self, processors: usize) -> String {
        let &Self { horizon, streams, threads, .. } = self;
        let milliseconds = |time: Duration, frames: u64| {
            (frames > 0).then(|| 1e3 * time.as_secs_f64() / frames as f64)
        };
        let model = milliseconds(self.busy, self.frames);
        let source = milliseconds(self.interval, self.arrived);
        let Some((model, source)) = model.zip(source) else {
            return "input is faster than the model".to_owned();
        };
        let measured = format!(
            "model {model:.1} ms a frame for {}, source {source:.1} ms",
            eddy_frames::counted(horizon.into(), "frame") + " ahead"
        );
        if model <= source {
            return format!(
                "they arrive in bursts ({measured} on average); a longer `queue` bridges them, and --reliability block makes \
                 the source wait"
            );
        }
        let mut remedies = Vec::new();
        // Each frame ahead is a step of the network.
        let largest = (f64::from(horizon) * source / model).floor() as u32;
        match largest {
            0 => {}
            1.. => remedies.push(format!(
                "--horizon {largest} would keep up, as each frame ahead costs as much"
            )),
        }
        if let Some(threads) = threads.filter(|&threads| threads < streams.min(processors)) {
            remedies.push(format!(
                "more --threads step more of the {streams} streams at once ({threads} now)"
            ));
        }
        remedies.push("publish more slowly".to_owned());
        remedies.push("use fewer particles".to_owned());
        remedies.push("--reliability block makes the source wait".to_owned());
        format!("input is faster than the model ({measured}); {}", remedies.join(", or "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A second in which a source sends a frame every 16 ms and the model takes `busy` for each.
    fn load(busy: Duration, horizon: u32) -> Load {
        let interval = Duration::from_secs(1);
        let (frames, arrived) = (50, 62);
        let busy = busy * 50;
        let (streams, threads) = (1, Some(1));
        Load { frames, arrived, busy, interval, horizon, streams, threads, ..Load::default() }
    }

    #[test]
    fn a_horizon_that_keeps_up_is_named() {
        let advice = load(Duration::from_millis(20), 20).advice(8);
        let expected = "input is faster than the model (model 20.0 ms a frame for 20 frames ahead, source 16.1 ms); \
             --horizon 16 would keep up";
        assert!(advice.starts_with(expected), "{advice}");
        let advice = load(Duration::from_millis(20), 1).advice(8);
        assert!(advice.contains("for 1 frame ahead") && !advice.contains("--horizon"), "{advice}");
    }

    #[test]
    fn threads_are_advised_where_they_help() {
        let slow = load(Duration::from_millis(20), 1);
        assert!(!slow.advice(8).contains("--threads"), "one stream has one thread");
        let several = Load { streams: 3, ..slow };
        assert!(several.advice(8).contains("of the 3 streams at once (1 now)"));
        assert!(!several.advice(1).contains("--threads"), "there is no other processor");
        assert!(!Load { threads: None, ..several }.advice(8).contains("--threads"));
    }

    #[test]
    fn bursts_of_a_slow_source_are_no_reason_to_predict_less() {
        let advice = load(Duration::from_millis(5), 20).advice(8);
        assert!(advice.contains("bursts") && !advice.contains("--horizon"), "{advice}");
    }
}
