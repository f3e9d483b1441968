//! The constants of the solver's kernels, the table of scenes, and where each one's particles, tiles and nodes are.

use eddy_frames::Material;
use eddy_mpm::{Attractor, CONSTANTS, GridShape, Interval, Settling, Solver, SolverSettings, Step};

use crate::kernels::{
    Program,
    solver::solver::{CELLS, NODE_SUMS, PATCH_NODES, Scene, Status, TILE, Tile},
};

/// Numbers of a patch: the sums of its nodes.
pub(super) const PATCH_NUMBERS: usize = NODE_SUMS * PATCH_NODES;
/// Numbers of a particle's state, `State` of the kernels.
pub(super) const NUMBERS: usize = 14;

/// What the kernels are compiled for: nothing that differs from scene to scene.
#[derive(Clone, Copy, Debug, Default)]
pub struct Constants;

impl Program for Constants {
    fn source(&self) -> String {
        [include_str!("../base.cu"), include_str!("solver.cu")].concat()
    }

    fn definitions(&self) -> Vec<(&'static str, usize)> {
        let materials = [
            ("LIQUID", Material::Liquid),
            ("SNOW", Material::Snow),
            ("JELLY", Material::Jelly),
            ("ROPE", Material::Rope),
            ("SAND", Material::Sand),
        ];
        let materials = materials.map(|(name, material)| (name, material as usize));
        let numbers = CONSTANTS.map(|(name, number)| (name, number.to_bits() as usize));
        let count = ("MATERIALS", Material::COUNT);
        materials.into_iter().chain([count]).chain(numbers).collect()
    }
}

impl Scene {
    /// Sets what the scene with these settings runs next.
    fn set(&mut self, settings: &SolverSettings, interval: &Interval) {
        self.substeps = interval.substeps;
        let step = Step::of(&SolverSettings { dt: interval.dt, ..*settings });
        (self.dt, self.impulse) = (step.dt, step.impulse);
        if let Some(Settling { relaxing, following }) = step.settling {
            (self.settling, self.relaxing, self.following) = (1, relaxing, following);
        }
        // Velocities are summed as integers. A power of two, so that scaling does not round.
        let cells_per_substep = step.dt * step.inverse_dx;
        self.unit = f32::from_bits(cells_per_substep.to_bits() & 0x7f80_0000);
        self.attracted = u32::from(interval.attractor.is_some());
        if let Some(Attractor { centre, strength, period, .. }) = interval.attractor {
            (self.centre, self.strength) = (centre, strength);
            self.period = period.unwrap_or(0.0);
        }
    }
}

/// Where all scenes are, side by side.
#[derive(Clone, Debug, Default)]
pub(super) struct Layout {
    /// Of each scene.
    pub(super) scenes: Vec<Scene>,
    settings: Vec<SolverSettings>,
    /// Particles of all scenes.
    pub(super) particles: usize,
    /// Particles of the largest one.
    pub(super) largest: usize,
    /// Of all scenes.
    pub(super) tiles: Vec<Tile>,
    /// Nodes of all scenes.
    pub(super) nodes: usize,
}

impl Layout {
    /// Of these solvers.
    pub(super) fn of(solvers: &[&Solver]) -> Self {
        let mut layout = Self::default();
        for solver in solvers {
            layout.add(solver.settings(), solver.particles().len());
        }
        layout
    }

    fn add(&mut self, settings: &SolverSettings, particles: usize) {
        let SolverSettings { grid: GridShape { cells, .. }, gravity, .. } = *settings;
        let step = Step::of(settings);
        let sides = cells.map(|cells| cells + 1);
        let tiles = sides.map(|side| side.div_ceil(TILE as u32));
        let scene = self.scenes.len() as u32;
        self.settings.push(*settings);
        self.scenes.push(Scene {
            first: self.particles as u32,
            particles: particles as u32,
            first_tile: self.tiles.len() as u32,
            tiles,
            first_node: self.nodes as u32,
            sides,
            cells,
            substeps: 0,
            dx: step.dx,
            inverse_dx: step.inverse_dx,
            dt: 0.0,
            gravity,
            impulse: 0.0,
            per_cell: step.particles_per_cell,
            mu: step.moduli.lame.mu,
            lambda: step.moduli.lame.lambda,
            viscosity: step.moduli.viscosity,
            water: u32::from(step.moduli.law.is_water()),
            settling: 0,
            relaxing: 0.0,
            following: 0.0,
            unit: 0.0,
            attracted: 0,
            centre: [0.0; 2],
            strength: 0.0,
            period: 0.0,
            friction: step.wall_friction,
            sand_slope: step.moduli.sand_slope,
        });
        self.particles += particles;
        self.largest = self.largest.max(particles);
        let places = (0..tiles[0]).flat_map(|x| (0..tiles[1]).map(move |y| Tile { scene, x, y }));
        self.tiles.extend(places);
        self.nodes += sides[0] as usize * sides[1] as usize;
    }

    /// Sets what each scene runs next.
    pub(super) fn set(&mut self, intervals: &[Interval]) {
        for ((scene, settings), interval) in
            self.scenes.iter_mut().zip(&self.settings).zip(intervals)
        {
            scene.set(settings, interval);
        }
    }

    /// Tiles that can have particles at once.
    pub(super) fn most_active(&self) -> usize {
        self.tiles.len().min(self.particles)
    }

    /// Memory of the device that these scenes take (bytes).
    pub(super) fn bytes(&self) -> u64 {
        let lists = 2 * NUMBERS + 3;
        let per_scene = size_of::<Scene>() + 2 * size_of::<Status>() + 3 * size_of::<u32>();
        let numbers = [
            (self.particles, 4 * lists),
            // Place, first and last particle, slot, two lists; counts of its cells.
            (self.tiles.len(), size_of::<Tile>() + (5 + CELLS) * size_of::<u32>()),
            (self.most_active(), size_of::<i64>() * PATCH_NUMBERS),
            (self.nodes, size_of::<[f32; 4]>()),
            (self.scenes.len(), per_scene),
        ];
        numbers.iter().map(|&(count, bytes)| count as u64 * bytes as u64).sum()
    }
}
