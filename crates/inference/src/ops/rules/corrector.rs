//! The rules after any predictor.

use super::{
    Ballistic, Network, Observed, Predicted, Rules, Scratch, Stage, elastic::ExpectedNodes,
};
use crate::{
    checkpoint::Description,
    kernels::{
        lattice::{Expected, Lattices},
        nodes::{MIN_LEVELS, Nodes, Window},
        rest_shape::RestShape,
    },
};
use eddy_frames::{Domain, Frame};
use eddy_threads::DisjointSlice;

/// Applies the rules of a checkpoint after any predictor, on the caller's thread: for comparison, not for speed.
#[derive(Clone, Debug)]
pub struct Corrector {
    rules: Rules,
    stages: Vec<Stage>,
    ballistic: Ballistic,
    /// The domain in training.
    domain: Domain,
    /// Of the grid on which bodies are found (domain lengths).
    cell_width: f32,
    /// Distance between particles at rest (domain lengths).
    spacing: f32,
}

impl Corrector {
    /// The rules of the described network; a frame model has none.
    pub fn new(description: &Description) -> Self {
        let rules = description.rules;
        let Network { cell_width, spacing, .. } = Network::of(description);
        Self {
            stages: rules.stages(),
            rules,
            ballistic: Ballistic::new(description),
            domain: description.domain,
            cell_width,
            spacing,
        }
    }

    /// Corrects the prediction from the frame `before`, which has the same particles in the same order; `rest` is their rest
    /// shape, `lattices` those of its bodies of jelly, `expected` what they expect, of the stream's last frame first, then of this one.
    ///
    /// # Panics
    /// If they differ in the number of particles.
    pub fn correct(
        &self,
        (rest, lattices, expected): (&RestShape, &Lattices, &mut Expected),
        before: &Frame,
        predicted: &mut Frame,
    ) {
        if self.stages.is_empty() {
            return;
        }
        let particles = before.len();
        assert_eq!([rest.len(), predicted.len()], [particles; 2], "particles of the same stream");
        let of_bodies = lattices.body_of().len();
        assert!(lattices.is_empty() || of_bodies == particles, "lattices of the same stream");
        let Domain { lower, upper } = before.domain;
        let mut nodes = Nodes::default();
        let window = Window { particles: 0..particles, lower, upper };
        // Rules need the finest level only.
        nodes.rebuild(&before.position, &[window], self.cell_width, MIN_LEVELS);
        let order: Vec<u32> = (0..particles as u32).collect();
        let observed = Observed {
            position: &before.position,
            velocity: &before.velocity,
            nodes: &nodes,
            ballistic: self.ballistic.for_domain(&self.domain, &before.domain),
            domain: before.domain,
            spacing: self.spacing,
            rest,
            lattices,
            expected: ExpectedNodes::new(expected),
            order: &order,
        };
        let predicted = Predicted {
            position: DisjointSlice::new(&mut predicted.position),
            velocity: DisjointSlice::new(&mut predicted.velocity),
            material: &predicted.material,
        };
        let mut scratch = Scratch::default();
        let correction = self.rules.begin(&mut scratch, observed, predicted);
        for &stage in &self.stages {
            (0..correction.items(stage)).for_each(|item| correction.run(stage, item));
        }
    }
}
