//! The solver against analytic and experimental references, through the public interface.
//!
//! | check | reference | tolerance |
//! |---|---|---|
//! | `elastic`: a bar rings | T = 4 L / c, c^2 = E / (1 - nu^2) / rho | 3 %, falling with the cell width |
//! | `water`: a column at rest | p = rho g (H - y) | 5 % of rho g H, RMS |
//! | `water`: vortices decay | amplitude exp(-2 nu k^2 t), Taylor and Green 1937 | 5 % of the rate |
//! | `water`: the front of a broken dam | Martin and Moyce 1952, table 2, but for the delay of their dam | times 5 %, speed 10 % |
//! | the same | Ritter 1892: at most 2 sqrt(g H) | bound |
//! | `water`: a pool after a splash | its density is 1 | 5 % |
//! | `water`: energy, also of viscous water | does not grow | 1 %, viscous 0.1 % |
//! | `water`: separates | without tension it keeps its speed | 10 % of its speed |
//! | `rope`: hangs | strain rho g L / 2E' in the mean | 1 % of its length, one piece |
//! | `rope`: swings, is dropped, meets others | tension of a few weights, about 1 % | 2 %, 3 %; one piece |
//! | `water`: a pool rests | speed as it lands; weight above in rows of cells; area | a tenth; 10 %, deviation 30 %; 2 % |
//! | `snow`: packs | stretch in its clamp (Stomakhin et al. 2013); one heap | 1e-6; 95 % of the particles |
//! | `sand`: a column collapses | run-out 1.2 a L0, Lajeunesse et al. 2005 | .6 to 1.1 of it; at rest |
//! | `tools`: momentum | of matter and tools: gravity's | 4e-3 lengths/s of all matter |
//! | `tools`: a piston; a gate | the weight above; rho g d^2 / 2 | 5 % |
//! | `tools`: a block on an incline | g (sin - mu cos), 0 below | 5 % of g sin; creep .02 lengths/s |
//! | `tools`: a thin box, shaken | nothing leaves it | none |
//! | `tools`: a thin cup at rest, shaken, poured | 1,000,000 particles beside its walls, times substeps | none passes |
//! | `jelly`: returns to its shape | sides of its second moments; mean of abs(F - R) | 3 %; 0.05 |
//!
//! Unit tests beside the code cover spline weights (`spline`), mass, momentum, free fall and energy of the other
//! materials (`solver`), rotation, frame indifference, stress as the derivative of the energy
//! (`constitutive`, `water`) and the stability limit (`stability`, `simulation`).
#![expect(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod elastic;
mod jelly;
mod rope;
mod sand;
mod snow;
mod thrown;
mod tools;
mod water;

use eddy_frames::Material;
use eddy_mpm::{GRAVITY, GridShape, Materials, Particle, Solver, SolverSettings, minimum_substeps};

/// Interval for which the number of substeps is chosen (s).
const INTERVAL: f64 = 0.016;

/// Settings with the longest stable substep for this material at speeds up to 5 domain lengths per second. Particles are
/// half a cell apart.
fn settings(grid: GridShape, material: Material, materials: Materials) -> SolverSettings {
    let (substeps, _) = minimum_substeps(&[material], &materials, grid.dx, 5.0, INTERVAL);
    let dt = (INTERVAL / f64::from(substeps)) as f32;
    SolverSettings { grid, spacing: 0.5 * grid.dx, materials, dt, gravity: GRAVITY, threads: 1 }
}

/// A rectangle of `columns` x `rows` particles at rest, column by column from its lower left corner.
fn block(
    corner: [f32; 2],
    [columns, rows]: [usize; 2],
    spacing: f32,
    material: Material,
) -> Vec<Particle> {
    let place = |axis: usize, k: usize| corner[axis] + (k as f32 + 0.5) * spacing;
    (0..columns * rows)
        .map(|k| Particle::at_rest([place(0, k / rows), place(1, k % rows)], material))
        .collect()
}

/// Advances by about `seconds`.
fn run_for(solver: &mut Solver, seconds: f32) {
    solver.run((seconds / solver.settings().dt).round() as u32).unwrap();
}

/// Number of particles of the largest connected piece, with gaps of at most `link`.
fn largest_piece(particles: &[Particle], link: f32) -> usize {
    let near = |a: &Particle, b: &Particle| {
        let [dx, dy] = [0, 1].map(|axis| a.position[axis] - b.position[axis]);
        dx * dx + dy * dy <= link * link
    };
    let mut unseen: Vec<&Particle> = particles.iter().collect();
    let mut largest = 0;
    while let Some(first) = unseen.pop() {
        let mut piece = vec![first];
        let mut seen = 0;
        while let Some(&from) = piece.get(seen) {
            let (found, rest) = unseen.into_iter().partition(|particle| near(from, particle));
            unseen = rest;
            piece.extend::<Vec<_>>(found);
            seen += 1;
        }
        largest = largest.max(piece.len());
    }
    largest
}

/// `|F - R|` of a particle: the deviation of its deformation from a rotation.
fn strain(particle: &Particle) -> f32 {
    let f = particle.deformation;
    let (cos, sin) = (f.xx + f.yy, f.yx - f.xy);
    let length = cos.hypot(sin);
    let (cos, sin) = (cos / length, sin / length);
    let parts = [f.xx - cos, f.xy + sin, f.yx - sin, f.yy - cos];
    parts.iter().map(|part| part * part).sum::<f32>().sqrt()
}

/// Extent of the particles along an axis (domain lengths).
fn extent(particles: &[Particle], axis: usize) -> f32 {
    let along = || particles.iter().map(|particle| particle.position[axis]);
    along().fold(f32::MIN, f32::max) - along().fold(f32::MAX, f32::min)
}

/// Long and short side of the rectangle with the second moments of these particles (domain lengths), independent of its
/// rotation.
fn sides(particles: &[Particle]) -> [f64; 2] {
    let count = particles.len() as f64;
    let along = |axis: usize| particles.iter().map(move |p| f64::from(p.position[axis]));
    let mean = [0, 1].map(|axis| along(axis).sum::<f64>() / count);
    let moment = |a: usize, b: usize| {
        along(a).zip(along(b)).map(|(x, y)| (x - mean[a]) * (y - mean[b])).sum::<f64>() / count
    };
    let (xx, xy, yy) = (moment(0, 0), moment(0, 1), moment(1, 1));
    let (middle, spread) = (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy));
    [middle + spread, middle - spread].map(|moment| (12.0 * moment).sqrt())
}

#[test]
fn pieces_are_counted_over_gaps() {
    let mut particles = block([0.3, 0.3], [4, 2], 0.01, Material::Rope);
    assert_eq!(largest_piece(&particles, 0.011), 8);
    particles[0].position[0] -= 0.1;
    assert_eq!(largest_piece(&particles, 0.011), 7);
}
