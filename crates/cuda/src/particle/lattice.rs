//! The lattices of jelly where the kernels read them.

#![expect(unsafe_code, reason = "structs that the device reads")]

use std::ops::Range;

use eddy_inference::kernels::lattice::{Elasticity, Lattice, Point, Share, SurfacePart};

use crate::{
    device::Address,
    error::{CudaError, Result},
};

/// Threads of a block, which has a frame of a stream: of the kernels.
pub(super) const ELASTIC_THREADS: usize = 512;

/// Nodes of a body at most: its fit has a dense matrix on a device.
pub(super) const MOST_NODES: usize = 2048;

/// `struct Lattice` of the kernels.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(super) struct DeviceLattice {
    lists: [u64; 11],
    particles: u32,
    nodes: u32,
    points: u32,
    parts: u32,
    lame: [f32; 2],
    viscosity: f32,
    wall_distance: f32,
    wall_stiffness: f32,
    rebound: f32,
    contact_distance: f32,
    contact_stiffness: f32,
    contact_viscosity: f32,
    steps: u32,
}
const _: () = assert!(size_of::<DeviceLattice>() == 8 * 11 + 4 * 14);
// SAFETY: numbers without padding between them, as the size shows.
unsafe impl bytemuck::Zeroable for DeviceLattice {}
// SAFETY: as above.
unsafe impl bytemuck::Pod for DeviceLattice {}

/// A lattice, and where its lists are among others, in numbers of 4 bytes.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Placed {
    lists: [usize; 11],
    elasticity: Elasticity,
    particles: usize,
    pub(super) nodes: usize,
    points: usize,
    parts: usize,
}

impl Placed {
    /// Appends the lists of a lattice to `words`, as integers and the bits of numbers.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`] with a body of more than [`MOST_NODES`] nodes.
    pub(super) fn append(lattice: &Lattice, words: &mut Vec<u32>) -> Result<Self> {
        let (nodes, points) = (lattice.inverse_mass().len(), lattice.points().len());
        let largest = lattice.normal_equations().iter().map(|band| band.nodes().len()).max();
        if let Some(largest) = largest.filter(|&nodes| nodes > MOST_NODES) {
            let setting = format!("a body of jelly with {largest} nodes of its lattice");
            let expected = "at most 2048 on a GPU, which are about 25,000 particles of E = 1e3, more of stiffer";
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
        let mut bodies = Vec::new();
        let mut inverse = Vec::new();
        for band in lattice.normal_equations() {
            let nodes = band.nodes();
            let body = [nodes.start as u32, nodes.len() as u32, inverse.len() as u32];
            bodies.extend(nodes.flat_map(|_| body));
            inverse.extend(bits(&band.inverse()));
        }
        let body = |&Range { start, end }: &Range<u32>| (start..end).map(move |_| [start, end]);
        let parts = lattice.surface().iter().zip(lattice.surfaces().iter().flat_map(body));
        let share = |&Share { index, weight }: &Share| [index, weight.to_bits()];
        let mut list = |list: &mut dyn Iterator<Item = u32>| {
            let at = words.len();
            words.extend(list);
            at
        };
        let lists = [
            list(&mut lattice.rows().iter().copied()),
            list(&mut lattice.corners().as_flattened().iter().flat_map(share)),
            list(&mut firsts(&samples)),
            list(&mut samples.iter().flatten().flat_map(share)),
            list(&mut bodies.into_iter()),
            list(&mut inverse.into_iter()),
            list(&mut bits(lattice.inverse_mass())),
            list(&mut firsts(&incident)),
            list(&mut incident.iter().flatten().copied()),
            list(&mut lattice.points().iter().flat_map(numbers_of_point)),
            list(&mut parts.flat_map(numbers_of_part)),
        ];
        let (elasticity, particles) = (*lattice.elasticity(), lattice.rows().len());
        Ok(Self { lists, elasticity, particles, nodes, points, parts: lattice.surface().len() })
    }

    /// Numbers of 4 bytes that the kernels need beside the nodes: forces of points and parts on four nodes each, positions and velocities of
    /// parts.
    pub(super) fn forces(&self) -> usize {
        8 * self.points + 12 * self.parts
    }

    /// As the kernels have it, where the lists begin at `words`.
    pub(super) fn on_device(&self, words: Address) -> DeviceLattice {
        let Elasticity { lame, viscosity, wall_distance, wall_stiffness, rebound, .. } =
            self.elasticity;
        let Elasticity { contact, steps, .. } = self.elasticity;
        DeviceLattice {
            lists: self.lists.map(|list| words.plus(list).0),
            particles: self.particles as u32,
            nodes: self.nodes as u32,
            points: self.points as u32,
            parts: self.parts as u32,
            lame,
            viscosity,
            wall_distance,
            wall_stiffness,
            rebound,
            contact_distance: contact.distance,
            contact_stiffness: contact.stiffness,
            contact_viscosity: contact.viscosity,
            steps: steps as u32,
        }
    }
}

fn bits(numbers: &[f32]) -> impl Iterator<Item = u32> {
    numbers.iter().map(|number| number.to_bits())
}

/// The first item of each list, if they lie one behind the other, and the end of the last.
fn firsts<T>(lists: &[Vec<T>]) -> impl Iterator<Item = u32> {
    let mut end = 0;
    let ends = lists.iter().map(move |list| {
        end += list.len() as u32;
        end
    });
    std::iter::once(0).chain(ends)
}

/// `struct LatticePoint` of the kernels.
fn numbers_of_point(point: &Point) -> impl Iterator<Item = u32> {
    let Point { nodes, gradients, particles, width } = *point;
    let numbers = gradients.into_iter().flatten().chain([particles, width]);
    nodes.into_iter().chain(numbers.map(f32::to_bits))
}

/// `struct LatticePart` of the kernels.
fn numbers_of_part((part, body): (&SurfacePart, [u32; 2])) -> impl Iterator<Item = u32> {
    let SurfacePart { nodes, weights, particles } = *part;
    let numbers = weights.into_iter().chain([particles]);
    nodes.into_iter().chain(numbers.map(f32::to_bits)).chain(body)
}
