//! The tools of a simulation: how they move, by keyframes or by hand, and what they are like at a frame.

use super::{MAX_SUBSTEPS, Simulation};
use crate::{
    error::MpmError,
    stability::TRAVEL,
    tool::{Motion, Pose, Tool, ToolLoad},
};
use eddy_frames::{
    Frame,
    tool::{ToolFrame, ToolState, Wrench},
};

impl Simulation {
    /// How each tool moves in the interval that runs next.
    pub(super) fn motions(&self) -> Vec<Motion> {
        if let Some(motions) = &self.by_hand {
            return motions.clone();
        }
        let [start, end] = [self.sequence.saturating_sub(1), self.sequence]
            .map(|sequence| sequence as f64 * self.interval());
        let motion = |tool: &Tool| Motion { start: tool.pose(start), end: tool.pose(end) };
        self.scene.tools.iter().map(motion).collect()
    }

    /// Moves the tools by hand, in place of their keyframes: each is in its pose at the next frame, and rests there until it is moved
    /// again. Before the first frame they are where the keyframes say.
    ///
    /// # Errors
    /// [`MpmError::Field`] for another number of poses than of tools, a number that is not finite, a pose before the first frame, and a
    /// way that is too long for the substeps; no tool is moved then.
    pub fn move_tools(&mut self, poses: &[Pose]) -> Result<(), MpmError> {
        let wrong = |field: String, found: String, expected: String| {
            Err(MpmError::Field { field, found, expected })
        };
        let tools = self.scene.tools.len();
        if poses.len() != tools || self.sequence == 0 {
            let (found, expected) = match self.sequence {
                0 => ("poses before the first frame".to_owned(), "poses after it".to_owned()),
                _ => (format!("{} poses", poses.len()), format!("{tools}, one for each tool")),
            };
            return wrong("tools".into(), found, expected);
        }
        let motions: Vec<Motion> = self
            .motions()
            .iter()
            .zip(poses)
            .map(|(motion, &end)| Motion { start: motion.start, end })
            .collect();
        let mut needed = self.substeps;
        for (index, (tool, motion)) in self.scene.tools.iter().zip(&motions).enumerate() {
            let Pose { position: [x, y], angle } = motion.end;
            if !(x.is_finite() && y.is_finite() && angle.is_finite()) {
                let found = format!("a pose of [{x}, {y}] at an angle of {angle}");
                return wrong(format!("tools[{index}]"), found, "finite numbers".into());
            }
            let way = motion.speed(tool.reach_in(self.scene.domain));
            let cells = f64::from(way / self.solver.settings().grid.dx);
            let most = self.scene.solver.substeps.unwrap_or(MAX_SUBSTEPS);
            let substeps = (cells / TRAVEL).ceil();
            if substeps > f64::from(most) {
                let found = format!("a way of {way} domain lengths in a frame");
                let expected = format!("at most half a cell in each of {most} substeps");
                return wrong(format!("tools[{index}]"), found, expected);
            }
            // The cast is exact: checked above.
            needed = needed.max(substeps as u32);
        }
        self.attempt = needed;
        self.by_hand = Some(motions);
        Ok(())
    }

    /// Where each tool is at the last frame.
    pub fn poses(&self) -> Vec<Pose> {
        self.moved.iter().map(|motion| motion.end).collect()
    }

    /// Where the tools are at a frame, which is the last one, and what matter has done to them in the interval before it.
    pub fn tool_frame(&self, frame: &Frame) -> ToolFrame {
        let interval = self.interval();
        let state = |&Motion { start, end }: &Motion| ToolState {
            pose: end,
            velocity: [0, 1].map(|k| per_second(end.position[k] - start.position[k], interval)),
            spin: per_second(end.angle - start.angle, interval),
        };
        let wrench = |load: &ToolLoad| Wrench {
            force: load.impulse.map(|impulse| impulse / interval),
            torque: load.angular / interval,
        };
        let wrenches = match frame.sequence {
            0 => Vec::new(),
            _ => self.loads().iter().map(wrench).collect(),
        };
        let states = self.moved.iter().map(state).collect();
        let Frame { stream, sequence, stamp, .. } = *frame;
        ToolFrame { stream, sequence, stamp, states, wrenches }
    }
}

/// The rate of a change in an interval of so many seconds.
fn per_second(change: f32, interval: f64) -> f32 {
    (f64::from(change) / interval) as f32
}
