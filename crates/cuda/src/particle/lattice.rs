//! The lattices of jelly where the kernels read them.

use eddy_inference::kernels::lattice::{self, Elasticity, Lattices, Point, Share, SurfacePart};

use crate::{
    device::{Device, List, Pointer, count},
    error::{CudaError, Result},
    kernels::particle::elastic::{Lattice, LatticePart, LatticePoint, LatticeShare},
};

/// Nodes of a body at most: its fit has a dense matrix on a device.
const MOST_NODES: usize = 2048;

/// Largest error of the nodes where there is no limit, as in the kernels.
const NOTHING_EXPECTED: f32 = 3.4e38;

/// What the memory of a stream's lattices depends on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct LatticeSize {
    pub(super) bodies: usize,
    /// Nodes of all bodies.
    pub(super) nodes: usize,
    /// Numbers of 4 bytes of the forces of all bodies.
    pub(super) forces: usize,
}

/// The lattices of a stream on a device.
pub(super) struct DeviceLattices {
    /// Of each body.
    table: List<Lattice>,
    lists: List<u32>,
    pub(super) size: LatticeSize,
}

impl DeviceLattices {
    /// None without a body.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`] with a body of more than 2,048 nodes; what the driver reports.
    pub(super) fn new(device: &dyn Device, lattices: &Lattices) -> Result<Option<Self>> {
        let bodies = lattices.bodies();
        if bodies.is_empty() {
            return Ok(None);
        }
        // The list of the particles' bodies is the first one.
        let mut words = lattices.body_of().to_vec();
        let (mut table, mut size) = (Vec::new(), LatticeSize::default());
        for body in bodies {
            let lists = append(body, &mut words)?;
            table.push((body, lists, size));
            size.bodies += 1;
            size.nodes += body.inverse_mass().len();
            size.forces += 8 * (body.points().len() + body.surface().len());
        }
        let lists = List::of(device, &words)?;
        let on_device =
            |&(body, places, before): &_| on_device(body, places, before, lists.pointer());
        let rows: Vec<_> = table.iter().map(on_device).collect();
        Ok(Some(Self { table: List::of(device, &rows)?, lists, size }))
    }

    /// Of the table, and of the number of each particle's body.
    pub(super) fn pointers(&self) -> (Pointer<Lattice>, Pointer<u32>) {
        (self.table.pointer(), self.lists.pointer())
    }
}

/// Appends the lists of a lattice to `words`, as integers and the bits of numbers; returns where they begin.
fn append(lattice: &lattice::Lattice, words: &mut Vec<u32>) -> Result<[usize; 10]> {
    let nodes = lattice.inverse_mass().len();
    if nodes > MOST_NODES {
        let setting = format!("a body of jelly with {nodes} nodes of its lattice");
        let expected =
            "at most 2048 on a GPU, which are about 25,000 particles of E = 1e3, more of stiffer";
        return Err(CudaError::Unsupported { setting, expected });
    }
    let mut samples = vec![Vec::new(); nodes];
    for (&index, corners) in lattice.rows().iter().zip(lattice.corners()) {
        for share in corners {
            samples[share.index as usize].push(Share { index, ..*share });
        }
    }
    let mut incident = vec![Vec::new(); nodes];
    let of_points = lattice.points().iter().map(|point| point.nodes);
    let of_parts = lattice.surface().iter().map(|part| part.nodes);
    for (force, node) in (0..).zip(of_points.chain(of_parts).flatten()) {
        incident[node as usize].push(force);
    }
    let share = |&Share { index, weight }: &Share| LatticeShare { index, weight };
    let point = |&Point { nodes, gradients, particles, width }: &Point| LatticePoint {
        nodes,
        gradients,
        particles,
        width,
    };
    let part = |&SurfacePart { nodes, weights, particles }: &SurfacePart| LatticePart {
        nodes,
        weights,
        particles,
    };
    let corners = lattice.corners().as_flattened().iter().map(share);
    let samples_first = firsts(&samples);
    let samples = samples.iter().flatten().map(share);
    Ok([
        push(words, lattice.rows().iter().copied()),
        push(words, corners),
        push(words, samples_first),
        push(words, samples),
        push(words, lattice.normal_equations().inverse().into_iter()),
        push(words, lattice.inverse_mass().iter().copied()),
        push(words, firsts(&incident)),
        push(words, incident.iter().flatten().copied()),
        push(words, lattice.points().iter().map(point)),
        push(words, lattice.surface().iter().map(part)),
    ])
}

/// Appends a list; returns where it begins.
fn push<T: bytemuck::Pod>(words: &mut Vec<u32>, list: impl Iterator<Item = T>) -> usize {
    // Pairs of numbers are aligned.
    words.resize(words.len().next_multiple_of(2), 0);
    let at = words.len();
    for item in list {
        words.extend_from_slice(bytemuck::cast_slice(&[item]));
    }
    at
}

/// As the kernels have it, where the lists begin at `words` and its scratch memory behind that of the bodies `before`.
fn on_device(
    lattice: &lattice::Lattice,
    lists: [usize; 10],
    before: LatticeSize,
    words: Pointer<u32>,
) -> Lattice {
    let Elasticity { lame, viscosity, wall_distance, wall_stiffness, .. } = *lattice.elasticity();
    let Elasticity { rebound, clear_distance, most_stretch, .. } = *lattice.elasticity();
    let Elasticity { most_error, small_error, steps, .. } = *lattice.elasticity();
    let [
        rows,
        corners,
        sample_first,
        samples,
        inverse,
        inverse_mass,
        incident_first,
        incident,
        points,
        parts,
    ] = lists.map(|list| words.plus(list));
    let [mu, lambda] = lame;
    Lattice {
        rows,
        corners: corners.cast(),
        sample_first,
        samples: samples.cast(),
        inverse: inverse.cast(),
        inverse_mass: inverse_mass.cast(),
        incident_first,
        incident,
        points: points.cast(),
        parts: parts.cast(),
        particle_count: count(lattice.rows().len()),
        node_count: count(lattice.inverse_mass().len()),
        point_count: count(lattice.points().len()),
        part_count: count(lattice.surface().len()),
        first_node: count(before.nodes),
        first_force: count(before.forces),
        mu,
        lambda,
        viscosity,
        wall_distance,
        wall_stiffness,
        rebound,
        clear_distance,
        most_stretch,
        most_error: most_error.min(NOTHING_EXPECTED),
        small_error,
        steps: count(steps),
        unused: 0,
    }
}

/// The first item of each list, if they lie one behind the other, and the end of the last.
fn firsts<T>(lists: &[Vec<T>]) -> impl Iterator<Item = u32> {
    let mut end = 0;
    let ends = lists.iter().map(move |list| {
        end += count::<u32>(list.len());
        end
    });
    std::iter::once(0).chain(ends)
}
