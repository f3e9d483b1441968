//! What tools do to particles from one frame to the next, for predictions without a solver.

use super::{Part, Pose, ToolState, Tools};

/// Distance from the surface at which particles end that would enter a tool (domain lengths).
const GAP: f32 = 1e-5;
/// How many surfaces a particle may meet in a frame: two in a corner, and again.
const SURFACES: usize = 4;

/// The tools of a stream on their way from one frame to the next, rigid and with constant velocity.
#[derive(Clone, Debug)]
pub struct Sweep(Vec<Swept>);

/// A tool on its way.
#[derive(Clone, Debug)]
struct Swept {
    /// Its parts at the second frame.
    parts: Vec<Part>,
    before: Pose,
    after: Pose,
    /// Velocity of its position (domain lengths per s).
    velocity: [f32; 2],
    /// Angular velocity (rad/s).
    spin: f32,
}

impl Sweep {
    /// From the states of all tools at one frame to those at another, `dt` later (s).
    pub fn new(tools: &Tools, before: &[ToolState], after: &[ToolState], dt: f32) -> Self {
        let swept = |((tool, before), after): ((&super::Tool, &ToolState), &ToolState)| {
            let (before, after) = (before.pose, after.pose.nearest_to(before.pose));
            let along = |axis: usize| (after.position[axis] - before.position[axis]) / dt;
            let (velocity, spin) = ([along(0), along(1)], (after.angle - before.angle) / dt);
            Swept { parts: tool.shape.posed(after), before, after, velocity, spin }
        };
        Self(tools.tools.iter().zip(before).zip(after).map(swept).collect())
    }

    /// Its mirror image about a vertical line with `sides` twice the x of its points.
    pub fn mirrored(mut self, sides: f32) -> Self {
        for tool in &mut self.0 {
            tool.parts = tool.parts.iter().map(|part| part.mirrored(sides)).collect();
            for pose in [&mut tool.before, &mut tool.after] {
                (pose.position[0], pose.angle) = (sides - pose.position[0], -pose.angle);
            }
            (tool.velocity[0], tool.spin) = (-tool.velocity[0], -tool.spin);
        }
        self
    }

    /// Stops a particle that would enter a tool on its way `from` a position to another: it ends beside the surface, and moves no longer
    /// into it.
    pub fn stop(&self, from: [f32; 2], to: &mut [f32; 2], velocity: &mut [f32; 2]) {
        for _ in 0..SURFACES {
            let end = *to;
            let entered = self.0.iter().flat_map(|tool| {
                // As seen from the tool.
                let from = tool.carried(from);
                let first = tool.parts.iter().filter_map(move |part| part.entered(from, end));
                first.map(move |(share, surface)| (share, surface, tool))
            });
            let first =
                entered.reduce(|first, other| if other.0 < first.0 { other } else { first });
            let Some((_, surface, tool)) = first else { return };
            let out = GAP - surface.distance(*to);
            let [u, v] = surface.normal;
            *to = [to[0] + out * u, to[1] + out * v];
            let [x, y] = tool.velocity_at(*to);
            let into = (velocity[0] - x) * u + (velocity[1] - y) * v;
            if into < 0.0 {
                *velocity = [velocity[0] - into * u, velocity[1] - into * v];
            }
        }
    }

    /// Moves a particle rigidly with the tool whose velocity there is nearest to its own, if that is nearer than zero.
    pub fn carry(&self, position: &mut [f32; 2], velocity: &mut [f32; 2]) {
        let speed = |[x, y]: [f32; 2]| x * x + y * y;
        let relative = |tool: &&Swept| {
            let [x, y] = tool.velocity_at(*position);
            speed([velocity[0] - x, velocity[1] - y])
        };
        let nearest = self.0.iter().min_by(|a, b| relative(a).total_cmp(&relative(b)));
        if let Some(tool) = nearest.filter(|tool| relative(tool) < speed(*velocity)) {
            *position = tool.carried(*position);
            *velocity = tool.velocity_at(*position);
        }
    }
}

impl Swept {
    /// Where a point is at the second frame that moves with the tool.
    fn carried(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        if self.after == self.before {
            return [x, y];
        }
        let ([x0, y0], [x1, y1]) = (self.before.position, self.after.position);
        let turn = Pose { angle: self.after.angle - self.before.angle, ..self.after };
        let ([cos, sin], (x, y)) = (turn.direction(), (x - x0, y - y0));
        [x1 + cos * x - sin * y, y1 + sin * x + cos * y]
    }

    /// Its velocity at a point at the second frame (domain lengths per s).
    fn velocity_at(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let [x0, y0] = self.after.position;
        [self.velocity[0] - self.spin * (y - y0), self.velocity[1] + self.spin * (x - x0)]
    }
}

#[cfg(test)]
mod tests {
    use super::{
        super::{Contact, Outline, Tool},
        *,
    };

    const DT: f32 = 0.5;

    /// A square blade of .2 around (.5, .5) that moves by `by` and turns.
    fn sweep(by: [f32; 2], turn: f32) -> Sweep {
        let shape = Outline::Rectangle { size: [0.2, 0.2] };
        let tool = Tool { name: "blade".into(), shape, contact: Contact::Slip };
        let state = |position, angle| {
            let pose = Pose { position, angle };
            ToolState { pose, velocity: [0.0; 2], spin: 0.0 }
        };
        let (before, after) = (state([0.5, 0.5], 0.0), state([0.5 + by[0], 0.5 + by[1]], turn));
        Sweep::new(&Tools { stream: 0, tools: vec![tool] }, &[before], &[after], DT)
    }

    fn near(found: [f32; 2], expected: [f32; 2]) -> bool {
        (0..2).all(|axis| (found[axis] - expected[axis]).abs() < 1e-4)
    }

    #[test]
    fn a_particle_stops_at_a_tool_and_slides_along_it() {
        let (mut to, mut velocity) = ([0.45, 0.55], [0.5, 0.2]);
        sweep([0.0; 2], 0.0).stop([0.2, 0.45], &mut to, &mut velocity);
        assert!(near(to, [0.4, 0.55]) && to[0] < 0.4, "{to:?}");
        assert_eq!(velocity, [0.0, 0.2]);
        let (mut past, mut velocity) = ([0.8, 0.55], [0.5, 0.2]);
        sweep([0.0; 2], 0.0).stop([0.2, 0.45], &mut past, &mut velocity);
        assert!(past[0] < 0.4, "nor does it pass through: {past:?}");
    }

    #[test]
    fn a_particle_that_a_tool_meets_is_pushed_with_the_speed_of_the_surface() {
        let (mut at, mut velocity) = ([0.7, 0.5], [0.0; 2]);
        sweep([0.3, 0.0], 0.0).stop([0.7, 0.5], &mut at, &mut velocity);
        assert!(near(at, [0.9, 0.5]) && near(velocity, [0.6, 0.0]), "{at:?} {velocity:?}");
    }

    #[test]
    fn the_mirror_image_of_tools_does_the_mirror_image_of_what_they_do() {
        let (sweep, mirror) = (sweep([0.2, 0.1], 0.4), |[x, y]: [f32; 2]| [1.1 - x, y]);
        let flip = |[x, y]: [f32; 2]| [-x, y];
        let from = [0.72, 0.45];
        let (mut to, mut velocity) = ([0.5, 0.52], [-0.4, 0.1]);
        let (mut other, mut reflected) = (mirror(to), flip(velocity));
        sweep.stop(from, &mut to, &mut velocity);
        assert!(!near(to, [0.5, 0.52]), "it is stopped");
        let mirrored = sweep.clone().mirrored(1.1);
        mirrored.stop(mirror(from), &mut other, &mut reflected);
        assert!(near(other, mirror(to)) && near(reflected, flip(velocity)));
        sweep.carry(&mut to, &mut velocity);
        mirrored.carry(&mut other, &mut reflected);
        assert!(near(other, mirror(to)) && near(reflected, flip(velocity)));
    }

    #[test]
    fn particles_are_carried_by_the_tool_that_they_move_with() {
        let moved = |by, turn, [mut position, mut velocity]: [[f32; 2]; 2]| {
            sweep(by, turn).carry(&mut position, &mut velocity);
            [position, velocity]
        };
        let [position, velocity] = moved([0.1, 0.0], 0.0, [[0.5, 0.7], [0.15, 0.0]]);
        assert!(near(position, [0.6, 0.7]) && near(velocity, [0.2, 0.0]));
        for rests in [[0.05, 0.0], [-0.2, 0.0], [0.0, 0.0]] {
            let state = [[0.5, 0.7], rests];
            assert_eq!(moved([0.1, 0.0], 0.0, state), state, "nearer to rest");
        }
        let quarter = std::f32::consts::FRAC_PI_2;
        let [position, _] = moved([0.0; 2], quarter, [[0.7, 0.5], [0.0, 0.6]]);
        assert!(near(position, [0.5, 0.7]), "it turns with the tool: {position:?}");
    }
}
