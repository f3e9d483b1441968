//! Velocities of all nodes: sums the patches of the chunks and applies gravity and walls.

use std::ops::Range;

use super::{
    super::{
        attractor::Attractor,
        grid::{GridShape, LEAST_OPEN, WALL_CELLS, at_walls, open_along},
        solver::SolverSettings,
        step::Step,
        tool::{Barriers, Loads},
        water::{LEAST_LIQUID, MAX_AREA, Settling},
    },
    chunk::Chunk,
    level::Work,
    simd::{LANES, Simd},
};

/// Velocities of `sides[0] * sides[1]` nodes and what liquids follow, row (x) by row.
#[derive(Clone, Debug)]
pub(super) struct Field {
    /// Velocities (domain lengths per s).
    pub(super) velocity: Vec<[f32; 2]>,
    /// Masses, in units of a particle's mass; with the law `settling` J.
    pub(super) liquid: Vec<f32>,
    /// Nodes along x and y.
    pub(super) sides: [usize; 2],
    /// Row stride (nodes).
    pub(super) stride: usize,
    /// Cells per domain length.
    pub(super) inverse_dx: f32,
    /// What tools have got from the nodes of each row (x).
    pub(super) loads: Vec<Loads>,
}

impl Field {
    /// A field at rest.
    pub(super) fn new(shape: GridShape) -> Self {
        let sides = shape.cells.map(|cells| cells as usize + 1);
        let stride = sides[1] + GROUP;
        let inverse_dx = 1.0 / shape.dx;
        let nodes = sides[0] * stride;
        Self {
            velocity: vec![[0.0; 2]; nodes],
            liquid: vec![0.0; nodes],
            sides,
            stride,
            inverse_dx,
            loads: vec![Loads::default(); sides[0]],
        }
    }

    /// Forgets what an earlier run has left, which may not be finite after an error.
    pub(super) fn clear(&mut self) {
        self.velocity.fill([0.0; 2]);
        self.liquid.fill(0.0);
    }
}

/// Read access to the nodes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Nodes<'a> {
    /// Velocities, row (x) by row (domain lengths per s).
    pub(super) velocity: &'a [[f32; 2]],
    /// Masses, in units of a particle's mass; with the law `settling` J.
    pub(super) liquid: &'a [f32],
    /// Row stride (nodes).
    pub(super) stride: usize,
}

impl<'a> Nodes<'a> {
    /// Velocities of four nodes in each row of the stencil with the lowest node `at`.
    #[inline(always)]
    pub(super) fn velocities(self, at: usize) -> [&'a [[f32; 2]; GROUP]; 3] {
        rows(self.velocity, at, self.stride)
    }

    /// As [`Nodes::velocities`], what liquids follow.
    #[inline(always)]
    pub(super) fn liquid(self, at: usize) -> [&'a [f32; GROUP]; 3] {
        rows(self.liquid, at, self.stride)
    }
}

#[inline(always)]
fn rows<T>(nodes: &[T], at: usize, stride: usize) -> [&[T; GROUP]; 3] {
    match (
        nodes[at..].first_chunk(),
        nodes[at + stride..].first_chunk(),
        nodes[at + 2 * stride..].first_chunk(),
    ) {
        (Some(a), Some(b), Some(c)) => [a, b, c],
        _ => unreachable!("the chunk checks that the stencil lies in the grid"),
    }
}

/// Forces and walls that act on the nodes in a substep.
#[derive(Clone, Debug)]
pub(super) struct Forces {
    /// Velocity bounds for rows at the lower wall, between the walls and at the upper wall.
    walls: [Walls; 3],
    /// Nodes along x and y.
    sides: [usize; 2],
    /// Coefficient of friction at the walls.
    friction: f32,
    /// Cell width (domain lengths).
    dx: f32,
    /// Length of the substep (s).
    dt: f32,
    /// Velocity along -y that gravity adds (domain lengths per s).
    fall: f32,
    attractor: Option<Attractor>,
    /// With the law `settling`.
    areas: Option<Areas>,
}

/// How the area of nodes relaxes towards their density.
#[derive(Clone, Debug)]
struct Areas {
    settling: Settling,
    /// Share of each node's kernel between the walls, by rows and by columns.
    open: [Vec<f32>; 2],
    /// Particles per cell in an undeformed body.
    particles_per_cell: f32,
}

impl Areas {
    fn new(sides: [usize; 2], step: &Step, settling: Settling) -> Self {
        let along = |side: usize| (0..side).map(|k| open_along(k, side)).collect();
        Self { settling, open: sides.map(along), particles_per_cell: step.particles_per_cell }
    }

    /// Writes J of the nodes `from..` of a row, as `Grid::update`.
    #[inline(always)]
    fn write<S: Simd>(
        &self,
        simd: S,
        row: usize,
        from: usize,
        sum: &Sum,
        open: &[f32],
        areas: &mut [f32],
    ) {
        let across = simd.splat(self.open[0][row]);
        let to = from + areas.len();
        let numbers = [&sum.mass, &sum.solid, &sum.area, open].map(|of| &of[from..to]);
        let (chunks, rest) = areas.as_chunks_mut::<LANES>();
        let [mass, solid, area, along] = numbers.map(|numbers| numbers.as_chunks::<LANES>().0);
        for (k, chunk) in chunks.iter_mut().enumerate() {
            let sums = [simd.load(&mass[k]), simd.load(&solid[k]), simd.load(&area[k])];
            simd.store(self.of_nodes(simd, sums, across * simd.load(&along[k])), chunk);
        }
        let mut last = [[0.0; LANES]; 4];
        for (last, numbers) in last.iter_mut().zip(numbers) {
            last[..rest.len()].copy_from_slice(&numbers[numbers.len() - rest.len()..]);
        }
        let [mass, solid, area, along] = &last;
        let sums = [simd.load(mass), simd.load(solid), simd.load(area)];
        let mut found = [0.0; LANES];
        simd.store(self.of_nodes(simd, sums, across * simd.load(along)), &mut found);
        rest.copy_from_slice(&found[..rest.len()]);
    }

    /// [`Settling::of_node`] with [`open_share`](super::super::grid::open_share), operation by operation.
    #[inline(always)]
    fn of_nodes<S: Simd>(
        &self,
        simd: S,
        [mass, solid, area]: [S::Lanes; 3],
        open: S::Lanes,
    ) -> S::Lanes {
        // J of a node without mass is read, with a weight of zero. No product of this mass is subnormal, which would be slow.
        let mass = simd.max(mass, 1e-20);
        let by_density = simd.splat(self.particles_per_cell) * simd.max(open, LEAST_OPEN) / mass;
        let by_density = simd.min(by_density, MAX_AREA);
        let liquid = mass - solid;
        let is_wet = simd.less(simd.splat(LEAST_LIQUID) * mass, liquid);
        let mean = simd.select(is_wet, area / liquid, simd.splat(1.0));
        mean + (by_density - mean) * simd.splat(self.settling.relaxing)
    }
}

/// Velocity bounds of separating slip walls at the nodes of a row.
#[derive(Clone, Debug)]
struct Walls {
    least: Vec<[f32; 2]>,
    most: Vec<[f32; 2]>,
}

impl Walls {
    /// The bounds of row `row` on a grid of this size, padded to whole groups.
    fn new(row: usize, [rows, columns]: [usize; 2]) -> Self {
        let least = |k: usize| if k < WALL_CELLS { 0.0 } else { f32::NEG_INFINITY };
        let most = |k: usize, side| if k + WALL_CELLS >= side { 0.0 } else { f32::INFINITY };
        let nodes = 0..columns + GROUP;
        Self {
            least: nodes.clone().map(|j| [least(row), least(j)]).collect(),
            most: nodes.map(|j| [most(row, rows), most(j, columns)]).collect(),
        }
    }
}

impl Forces {
    /// The forces in a simulation with these settings.
    pub(super) fn new(
        settings: &SolverSettings,
        step: &Step,
        attractor: Option<Attractor>,
    ) -> Self {
        let SolverSettings { grid: shape, dt, .. } = *settings;
        let sides = shape.cells.map(|cells| cells as usize + 1);
        let walls = [0, sides[0] / 2, sides[0] - 1].map(|row| Walls::new(row, sides));
        let areas = step.settling.map(|settling| Areas::new(sides, step, settling));
        let (dx, friction) = (shape.dx, step.wall_friction);
        Self { walls, sides, friction, dx, dt, fall: step.fall, attractor, areas }
    }

    /// Velocities of the nodes `from..to` of a row that are at walls with friction, or beside tools, as in `Grid::update`.
    fn touch(
        &self,
        row: usize,
        all: Range<usize>,
        sum: &Sum,
        near: Option<&Near<'_>>,
        loads: &mut Loads,
        velocity: &mut [[f32; 2]],
    ) {
        let [rows, columns] = self.sides;
        let at_wall = |index: usize, side: usize| index < WALL_CELLS || index + WALL_CELLS >= side;
        let rubs = |column| self.friction > 0.0 && (at_wall(row, rows) || at_wall(column, columns));
        // Tools do not meet nodes without mass.
        let beside =
            |column| near.filter(|near| near.columns.contains(&column) && sum.mass[column] > 0.0);
        let visited = match near {
            Some(near) if self.friction == 0.0 => near.columns.clone(),
            _ => all,
        };
        for column in visited.filter(|&column| rubs(column) || beside(column).is_some()) {
            let mass = sum.mass[column].max(f32::MIN_POSITIVE);
            let ([x, y], pull) = (sum.momentum[column], sum.pull[column]);
            let mut free = [x / mass + pull[0], y / mass - self.fall + pull[1]];
            if let Some(near) = beside(column) {
                let node = [row, column].map(|k| k as f32 * self.dx);
                free = near.barriers.beside(node, free, sum.mass[column], loads);
            }
            velocity[column] = at_walls(free, [row, column], self.sides, self.friction);
        }
    }

    /// The nodes of a row that are near tools, among `all`.
    fn near<'a>(&self, barriers: &'a Barriers, row: usize, all: Range<usize>) -> Option<Near<'a>> {
        let [lower, upper] = barriers.near_row(row as f32 * self.dx)?;
        // The casts saturate.
        let [first, last] = [lower, upper].map(|y| (y / self.dx) as usize);
        let columns =
            first.clamp(all.start, all.end)..last.saturating_add(1).clamp(all.start, all.end);
        (!columns.is_empty()).then_some(Near { barriers, columns })
    }

    /// Velocity that an attractor adds to the nodes of a row in a substep.
    fn pull(&self, attractor: &Attractor, row: usize, velocity: &mut [[f32; 2]]) {
        for (j, velocity) in velocity.iter_mut().enumerate() {
            let pull = attractor.acceleration([row as f32 * self.dx, j as f32 * self.dx]);
            *velocity = [self.dt * pull[0], self.dt * pull[1]];
        }
    }
}

/// The nodes of a row that are near tools.
struct Near<'a> {
    barriers: &'a Barriers,
    columns: Range<usize>,
}

/// The update of one row of the field from the patches that cover it.
pub(super) struct Update<'a> {
    pub(super) forces: &'a Forces,
    /// Index of the row.
    pub(super) row: usize,
    pub(super) chunks: &'a [Chunk],
    /// Velocities of the row's nodes.
    pub(super) velocity: &'a mut [[f32; 2]],
    /// What liquids follow at the row's nodes.
    pub(super) liquid: &'a mut [f32],
    /// Scratch buffer.
    pub(super) sum: &'a mut Sum,
    /// Tools, and what they have got from the nodes of the row.
    pub(super) barriers: &'a Barriers,
    pub(super) loads: &'a mut Loads,
}

impl Work for Update<'_> {
    type Output = ();

    /// Nodes without mass get a velocity too, but no particle is near enough to gather it.
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { forces, row, chunks, velocity, liquid, sum, barriers, loads } = self;
        let Some([from, to]) = sum.add_up(row, chunks, forces.areas.is_some()) else { return };
        let near = forces.near(barriers, row, from..to);
        match &forces.areas {
            Some(areas) => {
                let open = match &near {
                    Some(Near { barriers, columns }) => {
                        sum.open[from..to].copy_from_slice(&areas.open[1][from..to]);
                        for column in columns.clone().filter(|&column| sum.mass[column] > 0.0) {
                            let node = [row, column].map(|k| k as f32 * forces.dx);
                            sum.open[column] *= barriers.open(node);
                        }
                        &sum.open
                    }
                    None => &areas.open[1],
                };
                areas.write(simd, row, from, sum, open, &mut liquid[from..to]);
            }
            None => liquid[from..to].copy_from_slice(&sum.mass[from..to]),
        }
        if let Some(attractor) = &forces.attractor {
            forces.pull(attractor, row, &mut sum.pull);
        }
        let at_wall =
            usize::from(row >= WALL_CELLS) + usize::from(row + WALL_CELLS >= forces.sides[0]);
        let Walls { least, most } = &forces.walls[at_wall];
        let fall = simd.repeat(&[0.0, forces.fall]);
        let lightest = simd.splat_pairs(f32::MIN_POSITIVE);
        let fours = groups(&sum.momentum[from..])
            .zip(groups(&sum.mass[from..]))
            .zip(groups(&sum.pull[from..]))
            .zip(groups(&least[from..]))
            .zip(groups(&most[from..]))
            .zip(velocity[from..].as_chunks_mut().0)
            .take((to - from).div_ceil(GROUP));
        for (((((momentum, mass), pull), least), most), velocity) in fours {
            let mass = simd.max_pairs(simd.twice(simd.load_ones(mass)), lightest);
            // A division instead of a multiplication by the inverse, as in `Grid::update`.
            let free = simd.load_pairs(momentum) / mass - fall + simd.load_pairs(pull);
            let above = simd.max_pairs(simd.load_pairs(least), free);
            simd.store_pairs(simd.min_pairs(simd.load_pairs(most), above), velocity);
        }
        if forces.friction > 0.0 || near.is_some() {
            forces.touch(row, from..to, sum, near.as_ref(), loads, velocity);
        }
    }
}

/// Nodes per vector.
const GROUP: usize = 4;

/// The complete groups of a slice.
#[inline(always)]
fn groups<T>(nodes: &[T]) -> impl Iterator<Item = &[T; GROUP]> {
    nodes.as_chunks().0.iter()
}

/// Scratch buffer for the sum of the patches in one row.
#[derive(Clone, Debug)]
pub(super) struct Sum {
    momentum: Vec<[f32; 2]>,
    mass: Vec<f32>,
    /// With the law `settling`, of the solids.
    solid: Vec<f32>,
    /// Mass times J of the liquids, with the law `settling`.
    area: Vec<f32>,
    /// Velocity added by the attractor; zero without one.
    pull: Vec<[f32; 2]>,
    /// Beside tools, with the law `settling`: share of each node's kernel that is open along the row.
    open: Vec<f32>,
}

impl Sum {
    /// A buffer for rows of `nodes` nodes.
    pub(super) fn new(nodes: usize) -> Self {
        Self {
            momentum: vec![[0.0; 2]; nodes],
            mass: vec![0.0; nodes],
            solid: vec![0.0; nodes],
            area: vec![0.0; nodes],
            pull: vec![[0.0; 2]; nodes],
            open: vec![0.0; nodes],
        }
    }

    /// Sums the patches in row `i`, in the order of the chunks, and returns the range of covered nodes; `None` if no patch
    /// covers the row.
    #[inline(always)]
    fn add_up(&mut self, i: usize, chunks: &[Chunk], settling: bool) -> Option<[usize; 2]> {
        let covering = || chunks.iter().filter(|chunk| chunk.covers(i));
        let from = covering().map(|chunk| chunk.origin[1] as usize).min()?;
        let to = covering().map(|chunk| chunk.origin[1] as usize + chunk.nodes[1]).max()?;
        self.momentum[from..to].fill([0.0; 2]);
        self.mass[from..to].fill(0.0);
        for chunk in covering() {
            let (momentum, mass) = chunk.row(i);
            let start = chunk.origin[1] as usize;
            for (sum, more) in self.momentum[start..].iter_mut().zip(momentum) {
                *sum = [sum[0] + more[0], sum[1] + more[1]];
            }
            for (sum, more) in self.mass[start..].iter_mut().zip(mass) {
                *sum += more;
            }
        }
        if settling {
            self.solid[from..to].fill(0.0);
            self.area[from..to].fill(0.0);
            for chunk in covering() {
                let (solid, area) = chunk.settling_row(i);
                let start = chunk.origin[1] as usize;
                for (sums, more) in [(&mut self.solid, solid), (&mut self.area, area)] {
                    sums[start..].iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
                }
            }
        }
        Some([from, to])
    }
}
