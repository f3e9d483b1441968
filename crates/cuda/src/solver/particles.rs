//! Particles in pinned memory of the host, as the device's lists.

#![expect(unsafe_code, reason = "pinned memory")]

use std::ops::Range;

use eddy_mpm::{Matrix2, Particle, Solver};
use eddy_threads::{DisjointSlice, Task, ThreadPool};

use super::layout::NUMBERS;
use crate::{
    device::{Device, HostBuffer},
    error::Result,
    streams::copy_threads,
};

/// Particles that a thread copies at a time, at most.
const PART: usize = 1 << 14;
/// Parts from which on several threads copy.
const WORTH_THREADS: usize = 4;
/// Threads that copy, at most.
const COPY_THREADS: usize = 16;

/// `State` of the kernels in the memory of the host: lists of all scenes' particles, in the order of the solvers.
pub(super) struct HostParticles {
    memory: HostBuffer,
    /// Length of the lists.
    length: usize,
    threads: ThreadPool,
}

/// A part of the lists.
struct Lists<'a> {
    position: &'a mut [[f32; 2]],
    velocity: &'a mut [[f32; 2]],
    affine: &'a mut [[f32; 4]],
    deformation: &'a mut [[f32; 4]],
    plastic: &'a mut [f32],
    material: &'a mut [u32],
}

impl HostParticles {
    /// Room for so many.
    pub(super) fn new(device: &dyn Device, length: usize) -> Result<Self> {
        let memory = device.allocate_host(NUMBERS * length * size_of::<f32>())?;
        Ok(Self { memory, length, threads: copy_threads(None, COPY_THREADS) })
    }

    /// All lists, one after the other.
    pub(super) fn bytes(&self) -> &[u8] {
        // SAFETY: the device is given no address of this memory: it is copied from and to.
        unsafe { self.memory.view() }
    }

    /// The same, to be written to.
    pub(super) fn bytes_mut(&mut self) -> &mut [u8] {
        // SAFETY: as above.
        unsafe { self.memory.slice() }
    }

    /// Length of the lists.
    pub(super) fn length(&self) -> usize {
        self.length
    }

    /// Writes the particles of these solvers.
    pub(super) fn write(&mut self, solvers: &[&Solver]) {
        let n = self.length;
        // SAFETY: as in `bytes`.
        let all: &mut [f32] = unsafe { self.memory.slice() };
        let (position, rest) = all.split_at_mut(2 * n);
        let (velocity, rest) = rest.split_at_mut(2 * n);
        let (affine, rest) = rest.split_at_mut(4 * n);
        let (deformation, rest) = rest.split_at_mut(4 * n);
        let (plastic, rest) = rest.split_at_mut(n);
        let mut lists = Lists {
            position: position.as_chunks_mut().0,
            velocity: velocity.as_chunks_mut().0,
            affine: affine.as_chunks_mut().0,
            deformation: deformation.as_chunks_mut().0,
            plastic,
            material: bytemuck::cast_slice_mut(&mut rest[..n]),
        };
        let parts = solvers.iter().flat_map(|solver| solver.particles().chunks(PART));
        let parts = parts.map(|part| (lists.take(part.len()), part)).collect();
        copy_parts(&mut self.threads, parts, |(to, from)| to.write(from));
    }

    /// Copies the particles to these solvers; their materials stay.
    pub(super) fn read(&mut self, solvers: &mut [&mut Solver]) {
        let n = self.length;
        // SAFETY: as in `bytes`.
        let all: &[f32] = unsafe { self.memory.view() };
        let parts = solvers.iter_mut().flat_map(|solver| solver.particles_mut().chunks_mut(PART));
        let mut end = 0;
        let parts = parts.map(|part| {
            end += part.len();
            (end - part.len()..end, part)
        });
        copy_parts(&mut self.threads, parts.collect(), |(from, to)| read(all, n, from, to));
    }
}

/// Copies all parts, on several threads if they are many.
fn copy_parts<T: Send + Sync>(
    threads: &mut ThreadPool,
    mut parts: Vec<T>,
    copy: impl Fn(&mut T) + Sync,
) {
    let (count, parts) = (parts.len(), DisjointSlice::new(&mut parts));
    threads.run([count], count < WORTH_THREADS, &|Task { item, .. }| {
        // SAFETY: each item runs once.
        copy(&mut unsafe { parts.part(item..item + 1) }[0]);
    });
}

/// Copies the particles at these places of lists of length `n`, one after the other in `all`.
fn read(all: &[f32], n: usize, places: &Range<usize>, particles: &mut [Particle]) {
    let list = |first: usize, width: usize| {
        &all[first * n + width * places.start..first * n + width * places.end]
    };
    let pairs = |first: usize| list(first, 2).as_chunks::<2>().0;
    let matrices = |first: usize| list(first, 4).as_chunks::<4>().0;
    let matrix = |&[xx, xy, yx, yy]: &[f32; 4]| Matrix2::new(xx, xy, yx, yy);
    let states = pairs(0)
        .iter()
        .zip(pairs(2))
        .zip(matrices(4))
        .zip(matrices(8))
        .zip(list(12, 1))
        .zip(particles);
    for (((((position, velocity), affine), deformation), plastic), particle) in states {
        particle.position = *position;
        particle.velocity = *velocity;
        particle.affine = matrix(affine);
        particle.deformation = matrix(deformation);
        particle.plastic = *plastic;
    }
}

impl<'a> Lists<'a> {
    /// Splits the first so many off.
    fn take(&mut self, count: usize) -> Lists<'a> {
        fn first<'a, T>(list: &mut &'a mut [T], count: usize) -> &'a mut [T] {
            let (first, rest) = std::mem::take(list).split_at_mut(count);
            *list = rest;
            first
        }
        Lists {
            position: first(&mut self.position, count),
            velocity: first(&mut self.velocity, count),
            affine: first(&mut self.affine, count),
            deformation: first(&mut self.deformation, count),
            plastic: first(&mut self.plastic, count),
            material: first(&mut self.material, count),
        }
    }

    fn write(&mut self, particles: &[Particle]) {
        let numbers = |matrix: Matrix2| [matrix.xx, matrix.xy, matrix.yx, matrix.yy];
        for (k, particle) in particles.iter().enumerate() {
            self.position[k] = particle.position;
            self.velocity[k] = particle.velocity;
            self.affine[k] = numbers(particle.affine);
            self.deformation[k] = numbers(particle.deformation);
            self.plastic[k] = particle.plastic;
            self.material[k] = particle.material as u32;
        }
    }
}
