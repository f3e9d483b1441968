//! What is found wrong with a file or a bag: the first of it, since one wrong byte may bring more than anyone
//! reads.

use std::{collections::VecDeque, path::Path};

use super::error::BagError;

/// So many faults are kept; the rest is counted.
const KEPT: usize = 10;

/// The first faults, and how many more there are.
#[derive(Clone, Debug)]
pub(super) struct Faults<F> {
    first: VecDeque<F>,
    further: u64,
}

impl<F> Default for Faults<F> {
    fn default() -> Self {
        Self { first: VecDeque::new(), further: 0 }
    }
}

impl<F> Faults<F> {
    pub(super) fn add(&mut self, fault: F) {
        if self.first.len() < KEPT {
            self.first.push_back(fault);
        } else {
            self.further += 1;
        }
    }

    /// Adds one that is told before the others.
    pub(super) fn add_first(&mut self, fault: F) {
        if self.first.len() == KEPT {
            self.first.pop_back();
            self.further += 1;
        }
        self.first.push_front(fault);
    }

    /// Adds some that are known by their number only.
    pub(super) fn add_further(&mut self, faults: u64) {
        self.further += faults;
    }

    /// Those that are kept.
    pub(super) fn first(&self) -> impl Iterator<Item = &F> {
        self.first.iter()
    }

    /// How many there are beside those that are kept.
    pub(super) fn further(&self) -> u64 {
        self.further
    }
}

impl Faults<BagError> {
    /// Takes the next of those that are kept; after the last one [`BagError::FurtherFaults`] of the bag at `path`,
    /// if there are more.
    pub(super) fn take_next(&mut self, path: &Path) -> Option<BagError> {
        self.first.pop_front().or_else(|| {
            let faults = std::mem::take(&mut self.further);
            (faults > 0).then(|| BagError::FurtherFaults { path: path.into(), faults })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_faults_are_told_then_how_many_more_there_are() {
        let path = Path::new("run7");
        let fault =
            |topic: usize| BagError::NoMessages { path: path.into(), topic: topic.to_string() };
        let mut faults = Faults::default();
        (0..KEPT + 3).for_each(|topic| faults.add(fault(topic)));
        faults.add_first(fault(99));
        faults.add_further(5);
        let told: Vec<String> =
            std::iter::from_fn(|| faults.take_next(path)).map(|fault| fault.to_string()).collect();
        let mut expected: Vec<_> = (0..KEPT - 1).map(|topic| fault(topic).to_string()).collect();
        expected.insert(0, fault(99).to_string());
        expected.push("run7: found 9 more faults, expected none".to_owned());
        assert_eq!(told, expected);
    }
}
