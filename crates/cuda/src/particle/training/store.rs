//! Trajectories of any numbers of particles, with the rest shapes of their solids, in the memory of a device.

use eddy_inference::kernels::rest_shape::{self, RestShape};

use crate::{
    device::{Device, List, Pointer, count},
    error::Result,
    kernels::particle::nodes::Link,
    streams::Body,
    training::Window,
};

/// Links of a particle at most.
const MOST_LINKS: usize = 12;

/// Trajectories that a device reads.
pub struct Store {
    pub(super) bodies: List<Body>,
    /// Particles of each stream.
    pub(super) counts: List<u32>,
    /// `[streams, most]`.
    pub(super) material: List<u8>,
    /// The feature of each stream's stiffness.
    pub(super) stiffness: List<f32>,
    /// Where no particle of any stream has a rest shape, there are no links.
    pub(super) links: Option<Links>,
    /// First body of each stream, and the end of the last one.
    first: Vec<u64>,
    particles: Vec<usize>,
    most: usize,
}

/// Links of all streams, each as it is and mirrored.
pub(super) struct Links {
    /// First of each particle, `[2 streams, most + 1]`, and the links.
    own: (List<u32>, List<Link>),
    /// The same of the links to a particle, which name the ones that they are from.
    incoming: (List<u32>, List<Link>),
}

impl Links {
    pub(super) fn own(&self) -> (Pointer<u32>, Pointer<Link>) {
        (self.own.0.pointer(), self.own.1.pointer())
    }

    pub(super) fn incoming(&self) -> (Pointer<u32>, Pointer<Link>) {
        (self.incoming.0.pointer(), self.incoming.1.pointer())
    }
}

impl Store {
    /// Particles of the largest stream.
    pub(super) fn most(&self) -> usize {
        self.most
    }

    /// Whether a window of so many frames lies within its stream.
    pub(super) fn contains(&self, window: &Window, frames: usize) -> bool {
        let end = self.first.get(window.stream + 1);
        end.is_some_and(|&end| {
            let bodies = ((window.start + frames) * self.particles[window.stream]) as u64;
            self.first[window.stream] + bodies <= end
        })
    }

    /// The first body of a window.
    pub(super) fn first(&self, window: &Window) -> u64 {
        self.first[window.stream] + (window.start * self.particles[window.stream]) as u64
    }

    /// Memory that streams of these numbers of particles and frames take at most (bytes).
    pub fn bytes(streams: impl IntoIterator<Item = (usize, usize)>) -> u64 {
        let bytes = |(particles, frames): (usize, usize)| {
            // Links there and back, as they are and mirrored, and where they begin.
            particles * (frames * size_of::<Body>() + 4 * (MOST_LINKS * size_of::<Link>() + 4) + 1)
        };
        streams.into_iter().map(|stream| bytes(stream) as u64).sum()
    }
}

/// Copies streams to a device, frame by frame.
pub struct StoreWriter<'a> {
    device: &'a dyn Device,
    bodies: List<Body>,
    most: usize,
    particles: Vec<usize>,
    materials: Vec<u8>,
    stiffness: Vec<f32>,
    own: Lists,
    incoming: Lists,
    first: Vec<u64>,
    /// Bodies written so far.
    written: u64,
}

/// Links one behind the other, and where those of each particle begin.
#[derive(Default)]
struct Lists {
    first: Vec<u32>,
    links: Vec<Link>,
}

impl Lists {
    /// Adds the links of each particle of a stream; further particles, up to `most`, have none.
    fn add<'l>(&mut self, links: impl Iterator<Item = &'l [rest_shape::Link]>, most: usize) {
        let end = self.first.len() + most + 1;
        for own in links {
            self.first.push(count(self.links.len()));
            self.links.extend(own.iter().map(Link::from));
        }
        self.first.resize(end, count(self.links.len()));
    }
}

impl<'a> StoreWriter<'a> {
    /// Memory for so many bodies in all frames of all streams, of `most` particles at most.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call), as of all that follows.
    pub fn new(device: &'a dyn Device, most: usize, bodies: usize) -> Result<Self> {
        Ok(Self {
            device,
            bodies: List::new(device, bodies)?,
            most,
            particles: Vec::new(),
            materials: Vec::new(),
            stiffness: Vec::new(),
            own: Lists::default(),
            incoming: Lists::default(),
            first: Vec::new(),
            written: 0,
        })
    }

    /// Begins a stream of particles of these materials (by number), with their rest shapes as they are and mirrored, and the feature
    /// of its stiffness, which a network that is not conditioned on it does not read.
    ///
    /// # Panics
    /// With too many particles, or rest shapes of others.
    pub fn stream(&mut self, material: &[u8], rest: [&RestShape; 2], stiffness: f32) {
        assert!(material.len() <= self.most, "{} particles, at most {}", material.len(), self.most);
        self.first.push(self.written);
        self.particles.push(material.len());
        self.stiffness.push(stiffness);
        self.materials.extend_from_slice(material);
        self.materials.resize(self.particles.len() * self.most, 0);
        for rest in rest {
            assert_eq!(rest.len(), material.len(), "particles of a rest shape");
            let mut back = vec![Vec::new(); rest.len()];
            for particle in 0..rest.len() {
                for link in rest.links(particle) {
                    let from = rest_shape::Link { particle: count(particle), ..*link };
                    back[link.particle as usize].push(from);
                }
            }
            self.own.add((0..rest.len()).map(|particle| rest.links(particle)), self.most);
            self.incoming.add(back.iter().map(Vec::as_slice), self.most);
        }
    }

    /// Adds a frame of x, y, vx, vy to the last stream.
    ///
    /// # Errors
    /// As [`Self::new`].
    ///
    /// # Panics
    /// With another number of bodies, or more than there is memory for.
    pub fn frame(&mut self, bodies: &[[f32; 4]]) -> Result<()> {
        assert_eq!(Some(&bodies.len()), self.particles.last(), "bodies of a frame");
        let first = self.written as usize;
        self.written += bodies.len() as u64;
        self.device.write(&self.bodies, size_of::<Body>() * first, bytemuck::cast_slice(bodies))
    }

    /// The store.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn finish(mut self) -> Result<Store> {
        self.first.push(self.written);
        let counts: Vec<u32> = self.particles.iter().map(|&particles| count(particles)).collect();
        let lists = |Lists { first, links }: &Lists| -> Result<(List<u32>, List<Link>)> {
            Ok((List::of(self.device, first)?, List::of(self.device, links)?))
        };
        let links = match self.own.links.is_empty() {
            true => None,
            false => Some(Links { own: lists(&self.own)?, incoming: lists(&self.incoming)? }),
        };
        Ok(Store {
            counts: List::of(self.device, &counts)?,
            material: List::of(self.device, &self.materials)?,
            stiffness: List::of(self.device, &self.stiffness)?,
            links,
            bodies: self.bodies,
            first: self.first,
            particles: self.particles,
            most: self.most,
        })
    }
}
