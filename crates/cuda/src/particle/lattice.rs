//! The lattices of jelly, and the law of its impulses, where the kernels read them.

#![expect(unsafe_code, reason = "structs that the device reads")]

use std::ops::Range;

use eddy_inference::{
    checkpoint::Description,
    engine::Ballistic,
    kernels::lattice::{Lattice, Point, Share},
};

use crate::{
    device::{Address, Buffer, Device},
    error::{CudaError, Result},
};

/// Threads of a block, which has a frame of a stream: of the kernels.
pub(super) const ELASTIC_THREADS: usize = 512;

/// Numbers of 4 bytes of scratch for each point.
pub(super) const POINT_SCRATCH: usize = 12;

/// Nodes of a body at most: its fit has a dense matrix on a device.
pub(super) const MOST_NODES: usize = 2048;

/// `struct Elasticity` of the kernels.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(super) struct Elasticity {
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
const _: () = assert!(size_of::<Elasticity>() == 4 * 10);
// SAFETY: numbers without padding between them, as the size shows.
unsafe impl bytemuck::Zeroable for Elasticity {}
// SAFETY: as above.
unsafe impl bytemuck::Pod for Elasticity {}

impl Elasticity {
    /// Of the described network; none if it sees matter as it is.
    fn new(description: &Description) -> Option<Self> {
        let (options, grid) = (description.elastic?, description.grid.as_ref()?);
        let elasticity = options.elasticity(&Ballistic::new(description), grid.spacing);
        Some(Self {
            lame: elasticity.lame,
            viscosity: elasticity.viscosity,
            wall_stiffness: elasticity.wall_stiffness,
            rebound: elasticity.rebound,
            contact_distance: elasticity.contact.distance,
            contact_stiffness: elasticity.contact.stiffness,
            contact_viscosity: elasticity.contact.viscosity,
            wall_distance: options.wall_distance * grid.spacing,
            steps: elasticity.steps as u32,
        })
    }

    /// The same in the memory of a device.
    pub(super) fn on_device(
        device: &dyn Device,
        description: &Description,
    ) -> Result<Option<Buffer>> {
        let Some(law) = Self::new(description) else { return Ok(None) };
        let buffer = device.allocate(size_of::<Self>())?;
        device.write(&buffer, 0, bytemuck::bytes_of(&law))?;
        Ok(Some(buffer))
    }
}

/// `struct Lattice` of the kernels.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(super) struct DeviceLattice {
    lists: [u64; 11],
    particles: u32,
    nodes: u32,
    points: u32,
    surface: u32,
}
const _: () = assert!(size_of::<DeviceLattice>() == 8 * 11 + 4 * 4);
// SAFETY: integers without padding between them, as the size shows.
unsafe impl bytemuck::Zeroable for DeviceLattice {}
// SAFETY: as above.
unsafe impl bytemuck::Pod for DeviceLattice {}

/// Where the lists of a lattice are among others, in numbers of 4 bytes.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Placed {
    lists: [usize; 11],
    particles: usize,
    pub(super) nodes: usize,
    pub(super) points: usize,
    surface: usize,
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
            let expected = "at most 2048 on a GPU, which are about 25,000 particles";
            return Err(CudaError::Unsupported { setting, expected });
        }
        let mut samples = vec![Vec::new(); nodes];
        for (&index, corners) in lattice.rows().iter().zip(lattice.corners()) {
            for share in corners {
                samples[share.index as usize].push(Share { index, ..*share });
            }
        }
        let mut incident = vec![Vec::new(); nodes];
        for (number, point) in lattice.points().iter().enumerate() {
            for (corner, &node) in point.nodes.iter().enumerate() {
                incident[node as usize].push((4 * number + corner) as u32);
            }
        }
        let mut bodies = Vec::new();
        let mut inverse = Vec::new();
        for band in lattice.normal_equations() {
            let nodes = band.nodes();
            let body = [nodes.start as u32, nodes.len() as u32, inverse.len() as u32];
            bodies.extend(nodes.flat_map(|_| body));
            inverse.extend(bits(&band.inverse()));
        }
        // Nothing is near the only body.
        let bodies_of_surface = match lattice.surfaces() {
            [_] => &[],
            surfaces => surfaces,
        };
        let mut surface = Vec::new();
        for Range { start, end } in bodies_of_surface {
            let of_body = &lattice.surface()[*start as usize..*end as usize];
            surface.extend(of_body.iter().map(|&point| [point, *start, *end]));
        }
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
            list(&mut lattice.points().iter().flat_map(numbers)),
            list(&mut surface.iter().flatten().copied()),
        ];
        let (particles, surface) = (lattice.rows().len(), surface.len());
        Ok(Self { lists, particles, nodes, points, surface })
    }

    /// As the kernels have it, where the lists begin at `words`.
    pub(super) fn on_device(&self, words: Address) -> DeviceLattice {
        DeviceLattice {
            lists: self.lists.map(|list| words.plus(list).0),
            particles: self.particles as u32,
            nodes: self.nodes as u32,
            points: self.points as u32,
            surface: self.surface as u32,
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
fn numbers(point: &Point) -> impl Iterator<Item = u32> {
    let Point { nodes, weights, gradients, particles, width } = *point;
    let numbers =
        weights.into_iter().chain(gradients.into_iter().flatten()).chain([particles, width]);
    nodes.into_iter().chain(numbers.map(f32::to_bits))
}
