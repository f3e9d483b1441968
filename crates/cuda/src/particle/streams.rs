//! A particle model on a device, as the streaming engine uses it.

use std::{
    any::Any,
    sync::{Arc, Mutex, MutexGuard},
};

use eddy_inference::engine::{Accelerator, DeviceState, DeviceStep, ModelError, StreamStart};

use super::{
    inference::{Inference, MOST_STREAMS},
    stream::Memory,
};
use crate::error::{CudaError, Result};

/// A particle model on a device, as the streaming engine uses it. Steps from several threads follow each other. After a
/// failure of the device every step fails with it.
#[derive(Clone)]
pub struct Streams(Arc<Mutex<Shared>>);

struct Shared {
    inference: Inference,
    failure: Option<String>,
}

impl Streams {
    /// Of a network on a device.
    pub fn new(inference: Inference) -> Self {
        Self(Arc::new(Mutex::new(Shared { inference, failure: None })))
    }

    fn shared(&self) -> MutexGuard<'_, Shared> {
        self.0.lock().unwrap_or_else(|broken| broken.into_inner())
    }

    /// Runs `work`, unless the device has failed; keeps its failure.
    fn attempt<T>(
        &self,
        work: impl FnOnce(&mut Inference) -> Result<T>,
    ) -> std::result::Result<T, ModelError> {
        let Shared { inference, failure } = &mut *self.shared();
        if failure.is_none() {
            match work(inference) {
                Ok(value) => return Ok(value),
                // Nothing is lost but this state or step: other streams go on.
                Err(reason @ CudaError::Memory { .. }) => {
                    return Err(ModelError::Device(reason.to_string()));
                }
                Err(reason) => *failure = Some(reason.to_string()),
            }
        }
        Err(ModelError::Device(failure.clone().unwrap_or_default()))
    }
}

impl Accelerator for Streams {
    fn streams(&self) -> usize {
        MOST_STREAMS
    }

    fn start(
        &self,
        stream: &StreamStart<'_>,
    ) -> std::result::Result<Box<dyn DeviceState>, ModelError> {
        let memory = self.attempt(|inference| inference.memory(stream))?;
        Ok(Box::new(State { owner: self.clone(), memory: Ok(memory) }))
    }

    fn step(&self, steps: &mut [DeviceStep<'_>]) -> std::result::Result<(), ModelError> {
        let mut rows = Vec::with_capacity(steps.len());
        for DeviceStep { state, frame, next } in steps {
            let memory = memory_of(&**state);
            let memory = memory.map_err(|reason| ModelError::Device(reason.to_owned()))?;
            rows.push((memory, *frame, &mut **next));
        }
        let mut rows = rows.as_mut_slice();
        while !rows.is_empty() {
            let streams = rows.iter().map(|(memory, frame, _)| (*memory, &frame.domain));
            let count = self.shared().inference.batch(streams);
            let (now, later) = rows.split_at_mut(count);
            match self.attempt(|inference| inference.step(now)) {
                Err(reason) if now.len() == 1 => return Err(reason),
                // Too large together, perhaps, but not one by one.
                Err(_) => {
                    for one in now.chunks_mut(1) {
                        self.attempt(|inference| inference.step(one))?;
                    }
                }
                Ok(()) => {}
            }
            rows = later;
        }
        Ok(())
    }
}

/// The state of a stream on a device, or why it could not be copied.
struct State {
    owner: Streams,
    memory: std::result::Result<Memory, String>,
}

impl Drop for State {
    /// Gives the memory back between steps: a step may be about to be recorded.
    fn drop(&mut self) {
        let memory = std::mem::replace(&mut self.memory, Err(String::new()));
        let _alone = self.owner.shared();
        drop(memory);
    }
}

fn memory_of(state: &dyn DeviceState) -> std::result::Result<&Memory, &str> {
    let state: &dyn Any = state;
    let state = state.downcast_ref::<State>();
    let memory = state.map(|state| state.memory.as_ref().map_err(String::as_str));
    memory.unwrap_or(Err("the state of another device"))
}

impl State {
    /// A copy of a state's memory.
    fn copy_of(&self, other: &dyn DeviceState) -> std::result::Result<Memory, String> {
        let memory = memory_of(other)?;
        self.owner.attempt(|_| memory.duplicate()).map_err(|reason| reason.to_string())
    }
}

impl DeviceState for State {
    fn duplicate(&self) -> Box<dyn DeviceState> {
        Box::new(Self { owner: self.owner.clone(), memory: self.copy_of(self) })
    }

    fn copy_from(&mut self, other: &dyn DeviceState) {
        let copied = match (&self.memory, memory_of(other)) {
            (Ok(to), Ok(from)) if to.resembles(from) => self.owner.attempt(|_| to.copy_from(from)),
            _ => {
                let copy = self.copy_of(other);
                let before = std::mem::replace(&mut self.memory, copy);
                let _alone = self.owner.shared();
                drop(before);
                return;
            }
        };
        if let Err(reason) = copied {
            self.memory = Err(reason.to_string());
        }
    }

    fn forget(&mut self) {
        if let Ok(memory) = &self.memory
            && let Err(reason) = self.owner.attempt(|_| memory.clear())
        {
            self.memory = Err(reason.to_string());
        }
    }

    fn numbers(&self) -> Vec<f32> {
        let memory = self.memory.as_ref().ok();
        memory.and_then(|memory| self.owner.attempt(|_| memory.numbers()).ok()).unwrap_or_default()
    }
}
