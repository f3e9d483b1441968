//! Where the nodes of lattices should be in the coming frame.

/// Where the nodes of a stream's lattices will be in the coming frame, if nothing acts that they do not know.
#[derive(Debug, Default, PartialEq)]
pub struct Expected {
    /// Their positions, one body after the other, `[nodes of all bodies]` (domain lengths).
    pub positions: Vec<[f32; 2]>,
    /// The largest sum over a body's nodes of mass x squared distance from there with which its lattice moves it, `[bodies]` (a particle's mass x
    /// square of domain lengths); infinite where nothing is expected.
    pub most_errors: Vec<f32>,
}

impl Clone for Expected {
    fn clone(&self) -> Self {
        Self { positions: self.positions.clone(), most_errors: self.most_errors.clone() }
    }

    fn clone_from(&mut self, other: &Self) {
        self.positions.clone_from(&other.positions);
        self.most_errors.clone_from(&other.most_errors);
    }
}

impl Expected {
    /// Of a number of nodes and of bodies: nothing.
    pub(super) fn nothing(nodes: usize, bodies: usize) -> Self {
        let mut expected =
            Self { positions: vec![[0.0; 2]; nodes], most_errors: vec![0.0; bodies] };
        expected.forget();
        expected
    }

    /// Nothing is expected.
    pub fn forget(&mut self) {
        self.positions.fill([0.0; 2]);
        self.most_errors.fill(f32::INFINITY);
    }
}
