//! Which frames a network can predict.

use super::ModelError;
use crate::checkpoint::{Description, GridOptions, Normalization};
use eddy_frames::{Domain, FrameView};

/// Largest accepted distance between a stream's domain corners and the checkpoint's (domain lengths).
const DOMAIN_TOLERANCE: f32 = 1e-6;

/// Largest accepted number of cells per particle; a filled domain has less than one.
const MAX_CELLS_PER_PARTICLE: usize = 64;

/// Number of cells that is always accepted: their cost is negligible.
const FREE_CELLS: usize = 1 << 20;

/// Largest accepted velocity, relative to the largest in training.
const SPEED_FACTOR: f32 = 2.0;

/// Checks that a network can predict such a frame: on the data it is to be trained on, before anything is allocated for them, and on every
/// frame that it observes.
///
/// # Errors
/// [`ModelError`] if it cannot: a material or interval it was not trained on, another number of particles or another
/// domain (frame model), a domain with no space between its walls or far too large for its particles (particle
/// model), a state that no simulation has ([`FrameView::check_plausible`]), particles much faster than any in training.
pub fn fits<'a>(
    description: &Description,
    frame: impl Into<FrameView<'a>>,
) -> Result<(), ModelError> {
    let frame = frame.into();
    let particles = frame.particles;
    let Description { sizes, materials, dt, domain, .. } = description;
    if let Some(expected) = sizes.particles
        && expected != particles.len()
    {
        return Err(ModelError::Particles { found: particles.len(), expected });
    }
    let mut kinds = particles.materials().enumerate();
    if let Some((particle, found)) = kinds.find(|(_, kind)| !materials.contains(kind)) {
        let expected: Vec<_> = materials.iter().map(|m| m.name()).collect();
        let (found, expected) = (found.name(), expected.join(", "));
        return Err(ModelError::Material { particle, found, expected });
    }
    if !description.has_interval(frame.dt) {
        return Err(ModelError::Interval { found: frame.dt, expected: *dt });
    }
    match &description.grid {
        None => same_domain(&frame.domain, domain)?,
        Some(GridOptions { cell_width, .. }) => {
            fits_domain(&frame.domain, description, *cell_width, particles.len())?;
        }
    }
    frame.check_plausible()?;
    has_learned_speeds(&frame, &description.normalization)
}

/// Checks that the domain is the one the frame model was trained in.
fn same_domain(found: &Domain, expected: &Domain) -> Result<(), ModelError> {
    let apart = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).abs().max((a[1] - b[1]).abs());
    let distance = apart(found.lower, expected.lower).max(apart(found.upper, expected.upper));
    // Written so that NaN is rejected.
    if distance <= DOMAIN_TOLERANCE {
        return Ok(());
    }
    Err(ModelError::Domain { found: *found, expected: *expected })
}

/// Checks that the particle model can work in a domain: of any size, but not almost empty.
fn fits_domain(
    found: &Domain,
    description: &Description,
    cell_width: f32,
    particles: usize,
) -> Result<(), ModelError> {
    let Description { domain, normalization, .. } = description;
    let thickness: [f32; 2] = std::array::from_fn(|axis| {
        let lower = normalization.minimum[axis] - domain.lower[axis];
        lower + domain.upper[axis] - normalization.maximum[axis]
    });
    let extent = found.extent();
    if !(0..2).all(|axis| extent[axis] > thickness[axis].max(0.0)) {
        return Err(ModelError::Narrow { found: *found, expected: thickness });
    }
    let cells = (extent[0] / cell_width) * (extent[1] / cell_width);
    let most = particles.saturating_mul(MAX_CELLS_PER_PARTICLE).max(FREE_CELLS);
    if cells <= most as f32 {
        return Ok(());
    }
    Err(ModelError::Wide { found: *found, cells, cell_width, most })
}

/// Checks that velocities have the units of the training data.
fn has_learned_speeds(frame: &FrameView<'_>, trained: &Normalization) -> Result<(), ModelError> {
    let Normalization { minimum, maximum, .. } = trained;
    let learned =
        minimum[2..].iter().chain(&maximum[2..]).fold(0.0f32, |most, v| most.max(v.abs()));
    let expected = SPEED_FACTOR * learned;
    let speed = |particle| {
        let (_, [vx, vy]) = frame.particles.motion(particle);
        vx.abs().max(vy.abs())
    };
    // Without a branch per particle: nearly always, there is nothing to find.
    let particles = 0..frame.particles.len();
    if !particles.clone().fold(false, |fast, particle| fast | (speed(particle) > expected)) {
        return Ok(());
    }
    let particle = particles.clone().find(|&particle| speed(particle) > expected).unwrap_or(0);
    Err(ModelError::Fast { particle, found: speed(particle), expected })
}
