//! How many streams are rolled out at the same time.

use eddy_dataset::{Trajectory, available_memory};
use eddy_inference::engine::Surrogate;

/// Number of threads that each roll out over one stream at a time: one per core; with a model on a device, which steps the
/// streams of threads that wait for it together, as many as it takes at once, if there is memory for their streams.
pub fn rollout_threads<'a>(
    models: impl IntoIterator<Item = &'a Surrogate>,
    streams: &[Trajectory],
) -> usize {
    let at_once = models.into_iter().map(Surrogate::streams_at_once).max().unwrap_or(1);
    let bytes = streams.iter().map(Trajectory::bytes).max().unwrap_or(0).max(1);
    let room = usize::try_from(available_memory() / 2 / bytes).unwrap_or(usize::MAX);
    at_once.min(streams.len()).min(room).max(rayon::current_num_threads())
}
