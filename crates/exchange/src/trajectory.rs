//! The arrays of one stream as read from a file, and the frames made of them.

use std::path::{Path, PathBuf};

use super::{arrays::Array, error::ExchangeError};
use eddy_bag::custom_data::{CustomData, Quantity};
use eddy_frames::{AnyDomain, Domain, Frame, Material, Stamp};
use eddy_messages::UnusableFrame;

/// Values that replace those of a file, or that a file does not have.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ImportOverrides {
    /// Time between two frames (s).
    pub dt: Option<f32>,
    /// Domain of the particles; the unit square or cube if the file has none and all particles are in it.
    pub domain: Option<AnyDomain>,
    /// Material of all particles.
    pub material: Option<Material>,
    /// Entries of `custom_data` in the metadata of each bag, among them stiffness and gravity.
    pub custom_data: CustomData,
}

/// Numbers of the materials in a file format, in the order of [`Material::ALL`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Types(pub(super) [u8; Material::COUNT]);

impl Types {
    /// The numbers of `eddy_msgs/msg/ParticleFrame`.
    pub(super) const EDDY: Self = Self([0, 1, 2, 3, 4]);

    pub(super) fn number(self, material: Material) -> u8 {
        self.0[material as usize]
    }

    fn material(self, number: i64) -> Option<Material> {
        Material::ALL.into_iter().find(|&material| i64::from(self.number(material)) == number)
    }

    fn describe(self) -> String {
        let names = Material::ALL
            .map(|material| format!("{} ({})", self.number(material), material.name()));
        format!("{}, or --material to say what all particles are", names.join(", "))
    }
}

/// Shape of positions.
pub(super) const POSITION: &str = "[frames, particles, 2 or 3]";

/// The arrays of one stream: `T` frames of `N` particles in `D` dimensions.
#[derive(Debug)]
pub(super) struct RawTrajectory {
    path: PathBuf,
    frames: usize,
    particles: usize,
    dimension: usize,
    /// `[T, N, D]`.
    position: Vec<f32>,
    /// `[T, N, D]`.
    pub(super) velocity: Option<Array<f32>>,
    /// `[N]`, `[T, N]` or `[]`, with the meaning of the numbers.
    pub(super) material: Option<(Array<i64>, Types)>,
    /// `[T]` (ns).
    pub(super) stamp: Option<Array<i64>>,
    /// `[T]`.
    pub(super) sequence: Option<Array<u64>>,
    /// Time between two frames (s).
    pub(super) dt: Option<f32>,
    pub(super) domain: Option<AnyDomain>,
    pub(super) stream: Option<u64>,
    /// What the file says of all matter, as entries of `custom_data`.
    stated: CustomData,
}

impl RawTrajectory {
    /// A trajectory of positions, `[T, N, D]`.
    pub(super) fn new(path: &Path, position: Array<f32>) -> Result<Self, ExchangeError> {
        let &[frames, particles, dimension @ (2 | 3)] = position.shape.as_slice() else {
            return Err(ExchangeError::Array {
                path: path.into(),
                array: "position".into(),
                found: format!("shape {:?}", position.shape),
                expected: POSITION.into(),
            });
        };
        if frames == 0 || particles == 0 {
            return Err(ExchangeError::Array {
                path: path.into(),
                array: "position".into(),
                found: format!("{frames} frames of {particles} particles"),
                expected: "at least one of each".into(),
            });
        }
        Ok(Self {
            path: path.into(),
            frames,
            particles,
            dimension,
            position: position.values,
            velocity: None,
            material: None,
            stamp: None,
            sequence: None,
            dt: None,
            domain: None,
            stream: None,
            stated: CustomData::new(),
        })
    }

    fn fault(&self, array: &str, found: String, expected: impl Into<String>) -> ExchangeError {
        let expected = expected.into();
        ExchangeError::Array { path: self.path.clone(), array: array.into(), found, expected }
    }

    /// The number in an array of length 1.
    pub(super) fn scalar<T: Copy>(
        &self,
        name: &str,
        array: Option<Array<T>>,
    ) -> Result<Option<T>, ExchangeError> {
        match array {
            None => Ok(None),
            Some(Array { values, .. }) if values.len() == 1 => Ok(Some(values[0])),
            Some(Array { shape, .. }) => {
                Err(self.fault(name, format!("shape {shape:?}"), "one number"))
            }
        }
    }

    /// Sets a quantity of all matter, one number in the array `name`; gravity may be a vector along y, too.
    pub(super) fn set_quantity(
        &mut self,
        quantity: Quantity,
        name: &str,
        array: Option<Array<f32>>,
    ) -> Result<(), ExchangeError> {
        let array = array.map(|array| match (quantity, array.values.as_slice()) {
            (Quantity::Gravity, &[0.0, along_y] | &[0.0, along_y, 0.0])
                if array.values.len() == self.dimension =>
            {
                Array { shape: vec![], values: vec![along_y] }
            }
            _ => array,
        });
        let Some(found) = self.scalar(name, array)? else { return Ok(()) };
        if !quantity.holds(found) {
            return Err(self.fault(name, found.to_string(), quantity.expected()));
        }
        self.stated.insert(quantity.key().to_owned(), found.to_string());
        Ok(())
    }

    /// Entries of `custom_data` for the bag: those of the file, and those of `overrides`, which take precedence.
    pub(super) fn custom_data(&self, overrides: &ImportOverrides) -> CustomData {
        self.stated.clone().into_iter().chain(overrides.custom_data.clone()).collect()
    }

    /// The domain, if both corners are there.
    pub(super) fn domain_of_corners(
        &self,
        lower: Option<Array<f32>>,
        upper: Option<Array<f32>>,
    ) -> Result<Option<AnyDomain>, ExchangeError> {
        let (Some(lower), Some(upper)) = (lower, upper) else { return Ok(None) };
        for (name, corner) in [("lower", &lower), ("upper", &upper)] {
            if corner.values.len() != self.dimension {
                let expected = format!("{} numbers as position has", self.dimension);
                return Err(self.fault(name, format!("{:?}", corner.values), expected));
            }
        }
        Ok(AnyDomain::of_corners(&lower.values, &upper.values))
    }

    /// Number of dimensions, 2 or 3.
    pub(super) fn dimension(&self) -> usize {
        self.dimension
    }

    pub(super) fn frames(&self) -> usize {
        self.frames
    }

    /// Calls `each` for every frame of this trajectory of `D` dimensions. `overrides` take precedence over the file; missing velocities are backward
    /// differences of the positions (forward for the first frame).
    ///
    /// # Errors
    /// [`ExchangeError::Array`] when an array is missing or has the wrong shape, [`ExchangeError::Frame`] when a
    /// frame cannot be used, and those of `each`.
    pub(super) fn frames_with<const D: usize>(
        self,
        stream: u64,
        overrides: &ImportOverrides,
        mut each: impl FnMut(Frame<D>) -> Result<(), ExchangeError>,
    ) -> Result<(), ExchangeError> {
        let dt = self.interval(overrides)?;
        let domain = self.domain(overrides)?;
        let all = [self.frames, self.particles, D];
        self.check_shape("velocity", self.velocity.as_ref(), &[&all])?;
        self.check_shape("stamp", self.stamp.as_ref(), &[&[self.frames]])?;
        self.check_shape("sequence", self.sequence.as_ref(), &[&[self.frames]])?;
        self.check_order("stamp", self.stamp.as_ref())?;
        self.check_order("sequence", self.sequence.as_ref())?;
        let position: &[[f32; D]] = self.position.as_chunks().0;
        for (index, now) in position.chunks_exact(self.particles).enumerate() {
            let velocity = match &self.velocity {
                Some(velocity) => {
                    let of_frame = index * self.particles..(index + 1) * self.particles;
                    velocity.values.as_chunks().0[of_frame].to_vec()
                }
                None => self.differences(index, dt)?,
            };
            let sequence = self.sequence.as_ref().map_or(index as u64, |array| array.values[index]);
            let stamp = match &self.stamp {
                Some(stamps) => Stamp(stamps.values[index]),
                None => Stamp(0).advance(dt, index as u32),
            };
            let material = self.materials(index, overrides)?;
            let frame =
                Frame::new(stream, sequence, stamp, dt, domain, now.to_vec(), velocity, material);
            let usable = frame.and_then(|frame| frame.check_plausible().map(|()| frame));
            each(usable.map_err(|reason| {
                let (path, reason) = (self.path.clone(), reason.into());
                ExchangeError::Frame(Box::new(UnusableFrame { path, stream, sequence, reason }))
            })?)?;
        }
        Ok(())
    }

    fn check_shape<T>(
        &self,
        name: &str,
        array: Option<&Array<T>>,
        shapes: &[&[usize]],
    ) -> Result<(), ExchangeError> {
        match array {
            Some(array) if !shapes.contains(&array.shape.as_slice()) => {
                let expected: Vec<String> =
                    shapes.iter().map(|shape| format!("{shape:?}")).collect();
                let expected = format!("{} as position has", expected.join(" or "));
                Err(self.fault(name, format!("shape {:?}", array.shape), expected))
            }
            _ => Ok(()),
        }
    }

    /// Checks that the numbers rise from frame to frame.
    fn check_order<T: Copy + Ord + ToString>(
        &self,
        name: &str,
        array: Option<&Array<T>>,
    ) -> Result<(), ExchangeError> {
        let pairs = array.map_or(&[][..], |array| array.values.as_slice()).windows(2);
        match pairs.enumerate().find(|(_, pair)| pair[1] <= pair[0]) {
            None => Ok(()),
            Some((frame, pair)) => Err(self.fault(
                &format!("{name}[{}]", frame + 1),
                pair[1].to_string(),
                format!("more than {}, of the frame before", pair[0].to_string()),
            )),
        }
    }

    fn interval(&self, overrides: &ImportOverrides) -> Result<f32, ExchangeError> {
        let by_stamps = || match self.stamp.as_ref()?.values.as_slice() {
            [first, second, ..] => Some(Stamp(second.checked_sub(*first)?).seconds() as f32),
            _ => None,
        };
        let dt = overrides.dt.or(self.dt).or_else(by_stamps);
        dt.ok_or_else(|| self.fault("dt", "none".into(), "one in the file, or --dt SECONDS"))
    }

    fn domain<const D: usize>(
        &self,
        overrides: &ImportOverrides,
    ) -> Result<Domain<D>, ExchangeError> {
        if let Some(domain) = overrides.domain.or(self.domain) {
            let expected = format!(
                "{D} dimensions as position has (lower and upper, bounds of metadata.json, --domain)"
            );
            return Domain::try_from(domain)
                .map_err(|_| self.fault("domain", domain.to_string(), expected));
        }
        let inside = |x: &f32| (0.0..=1.0).contains(x);
        match self.position.iter().find(|x| !inside(x)) {
            None => Ok(Domain { lower: [0.0; D], upper: [1.0; D] }),
            Some(x) => Err(self.fault(
                "domain",
                format!("none, and a coordinate {x} that is not from 0 to 1"),
                "lower and upper in the file, bounds in metadata.json, or in the plane --domain LEFT BOTTOM RIGHT TOP",
            )),
        }
    }

    fn differences<const D: usize>(
        &self,
        index: usize,
        dt: f32,
    ) -> Result<Vec<[f32; D]>, ExchangeError> {
        if self.frames < 2 {
            let expected = "velocities in the file, or at least two frames to take them from";
            return Err(self.fault("velocity", "none, and one frame".into(), expected));
        }
        let numbers = D * self.particles;
        let later = index.max(1) * numbers;
        let (before, after) = self.position[later - numbers..later + numbers].split_at(numbers);
        let velocity: Vec<f32> = before.iter().zip(after).map(|(a, b)| (b - a) / dt).collect();
        Ok(velocity.as_chunks().0.to_vec())
    }

    fn materials(
        &self,
        frame: usize,
        overrides: &ImportOverrides,
    ) -> Result<Vec<Material>, ExchangeError> {
        if let Some(material) = overrides.material {
            return Ok(vec![material; self.particles]);
        }
        let Some((array, types)) = &self.material else {
            let expected = "materials in the file, or --material to say what all particles are";
            return Err(self.fault("material", "none".into(), expected));
        };
        let (frames, particles) = (self.frames, self.particles);
        self.check_shape("material", Some(array), &[&[particles], &[frames, particles], &[]])?;
        let of_frame = match array.shape.len() {
            0 => return Ok(vec![self.material_of(array.values[0], *types)?; particles]),
            1 => &array.values[..],
            _ => &array.values[frame * particles..][..particles],
        };
        of_frame.iter().map(|&number| self.material_of(number, *types)).collect()
    }

    fn material_of(&self, number: i64, types: Types) -> Result<Material, ExchangeError> {
        let material = types.material(number);
        material.ok_or_else(|| self.fault("material", number.to_string(), types.describe()))
    }
}
