//! Liquids keep their area: where predicted particles are denser than a liquid can be, they are moved apart, as by the
//! pressure of an incompressible fluid (Kugelstadt et al. 2019, "Implicit density projection for volume conserving
//! liquids").
//!
//! Without it, the errors of a network accumulate until a pool loses a quarter of its area in a second.
//!
//! 1. Fill: the density of each node of a grid, 1 inside a body at rest.
//! 2. Solve: the pressure p with laplacian p = -rate (fill - limit) times the share of liquid where the fill exceeds the limit;
//!    p = 0 at the surface, dp/dn = 0 at walls, p >= 0.
//! 3. Shift: liquid particles move down the gradient of p, and their velocities change accordingly.
//!
//! The first two are one step, [`SOLVE`]: their loops over nodes are too short to share between threads. `pressure` has all three.

mod pressure;

use serde::{Deserialize, Serialize};

use super::{
    InFrame, Launch, Most, Network, Observed, Predicted, RuleOperation, WrongConstant,
    bodies::Bodies,
};
use eddy_threads::DisjointSlice;
use pressure::Pressure;

/// Constants of the rule that liquids keep their area: where predicted liquid is too dense, a pressure pushes it apart.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AreaRule {
    /// Cell width of the grid for the pressure (spacings at rest), 0.5 to 16.
    pub cell_width: f32,
    /// Fill of a node above which there is pressure; 1 inside a body at rest. In the ground truth, irregularly placed particles
    /// reach up to 1.25.
    pub fill_limit: f32,
    /// Fill of a node below which it is outside the surface and has no pressure; at most `fill_limit`.
    pub surface_fill: f32,
    /// Number of sweeps of the pressure solver, 1 to 1000.
    pub sweeps: usize,
    /// Factor of successive over-relaxation, above 0 and below 2.
    pub relaxation: f32,
    /// Largest shift of a particle per frame, along an axis (cells of this grid).
    pub longest_shift: f32,
    /// Share of the excess fill that is removed per frame, above 0 and at most 1; 1 where the key is absent. In the ground truth,
    /// jets that collide reach a fill of 4 and spread over many frames; a network's errors add far less in a frame.
    #[serde(default = "all_at_once", skip_serializing_if = "is_all_at_once")]
    pub rate: f32,
}

impl AreaRule {
    /// The rate of checkpoints without one.
    pub(crate) const ALL_AT_ONCE: f32 = 1.0;
}

fn all_at_once() -> f32 {
    AreaRule::ALL_AT_ONCE
}

/// Whether the rate is left out, so that checkpoints without one keep their digest.
fn is_all_at_once(rate: &f32) -> bool {
    *rate == all_at_once()
}

/// The pressure; one item.
const SOLVE: usize = 0;
/// The shift of liquid particles; an item is a block of [`PARTICLES`].
const SHIFT: usize = 1;
/// Particles per item of [`SHIFT`].
const PARTICLES: usize = 512;
/// Nodes outside the domain on each side: one for the stencils of particles, and one around all of them.
pub const MARGIN: usize = 2;
/// How far a particle at a wall fills beyond it (spacings at rest).
const BEYOND: f32 = 0.5;
/// Shared memory of a block that solves the pressure on a GPU, at most (bytes); with more nodes it is solved in global memory.
const SHARED: usize = 100 << 10;

impl RuleOperation for AreaRule {
    const STANDARD: Option<Self> = Some(Self {
        cell_width: 2.0,
        fill_limit: 1.25,
        surface_fill: 0.5,
        sweeps: 20,
        relaxation: 1.7,
        longest_shift: 0.5,
        rate: 0.2,
    });
    const DEVICE: &'static str = include_str!("device.cu");

    type Scratch = Option<Pressure>;
    type InFrame<'a> = Area<'a>;

    fn check(&self, _: &Network) -> Result<(), WrongConstant> {
        let Self { cell_width, fill_limit, surface_fill, relaxation, longest_shift, .. } = *self;
        // NaN is in none of these ranges.
        let positive = |x: f32| x > 0.0 && x.is_finite();
        let number = WrongConstant::unless::<f32>;
        number((0.5..=16.0).contains(&cell_width), "cell_width", cell_width, "0.5 to 16")?;
        number(positive(fill_limit), "fill_limit", fill_limit, "a positive number")?;
        let fits = surface_fill > 0.0 && surface_fill <= fill_limit;
        let expected = "above 0, at most rules.area.fill_limit";
        number(fits, "surface_fill", surface_fill, expected)?;
        WrongConstant::unless_sweeps(self.sweeps)?;
        let fits = relaxation > 0.0 && relaxation < 2.0;
        number(fits, "relaxation", relaxation, "above 0 and below 2")?;
        number(positive(longest_shift), "longest_shift", longest_shift, "a positive number")?;
        let fits = self.rate > 0.0 && self.rate <= 1.0;
        number(fits, "rate", self.rate, "above 0, at most 1")
    }

    fn steps(&self) -> usize {
        2
    }

    fn begin<'a>(&self, scratch: &'a mut Option<Pressure>, observed: &Observed<'a>) -> Area<'a> {
        let pressure = scratch.get_or_insert_with(|| Pressure::new(*self, observed.spacing));
        Area { pressure: DisjointSlice::new(std::slice::from_mut(pressure)) }
    }

    fn device_constants(&self, network: &Network) -> Vec<(&'static str, f32)> {
        vec![
            ("width", self.cell_width * network.spacing),
            ("fill_limit", self.fill_limit),
            ("surface_fill", self.surface_fill),
            ("relaxation", self.relaxation),
            ("longest_shift", self.longest_shift),
            ("rate", self.rate),
            // Area of a particle in a cell.
            ("share", 1.0 / (self.cell_width * self.cell_width)),
            ("beyond", BEYOND / self.cell_width),
            ("sweeps", self.sweeps as f32),
        ]
    }

    fn launches(&self, most: &Most) -> Vec<Launch> {
        let mut launches = vec![Launch::new("area_fill", most.particles)];
        let shared = 12 * most.area_nodes + 8;
        if shared <= SHARED {
            launches.push(Launch { block: 512, shared, ..Launch::new("area_solve", 512) });
        } else {
            launches.push(Launch::new("area_mark", most.area_nodes));
            launches.extend((0..2 * self.sweeps).map(|half| Launch {
                step: half % 2,
                ..Launch::new("area_sweep", most.area_nodes.div_ceil(2))
            }));
        }
        launches.push(Launch::new("area_shift", most.particles));
        launches
    }
}

/// The rule in one frame.
pub(crate) struct Area<'a> {
    pressure: DisjointSlice<'a, Pressure>,
}

impl InFrame for Area<'_> {
    fn items(&self, step: usize, observed: &Observed<'_>) -> usize {
        match step {
            SOLVE => 1,
            _ => observed.order.len().div_ceil(PARTICLES),
        }
    }

    #[inline(always)]
    fn run(
        &self,
        step: usize,
        item: usize,
        observed: &Observed<'_>,
        _: &Bodies,
        predicted: &Predicted<'_>,
    ) {
        let Observed { domain, ballistic, .. } = observed;
        let Predicted { position, velocity, material } = predicted;
        if step == SOLVE {
            // SAFETY: this step has one item, which only reads the predictions.
            let (pressure, position) =
                unsafe { (&mut self.pressure.part(0..1)[0], position.read(0..position.len())) };
            return pressure.solve(position, material, domain, ballistic);
        }
        debug_assert_eq!(step, SHIFT);
        let begin = item * PARTICLES;
        let own = begin..(begin + PARTICLES).min(position.len());
        // SAFETY: this step only reads the pressure, and only this item uses these particles.
        let (pressure, position, velocity) = unsafe {
            let pressure = &self.pressure.read(0..1)[0];
            (pressure, position.part(own.clone()), velocity.part(own.clone()))
        };
        pressure.apply(position, velocity, &material[own], ballistic);
    }
}
