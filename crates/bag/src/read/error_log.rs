//! A bounded list of errors: one wrong byte may cause more errors than anyone reads.

use std::{collections::VecDeque, path::Path};

use crate::error::BagError;

/// Maximum number of errors kept; further errors are only counted.
const MAX_ERRORS: usize = 10;

/// The first errors and the number of the others.
#[derive(Clone, Debug)]
pub(crate) struct ErrorLog<E> {
    first: VecDeque<E>,
    omitted: u64,
}

impl<E> Default for ErrorLog<E> {
    fn default() -> Self {
        Self { first: VecDeque::new(), omitted: 0 }
    }
}

impl<E> ErrorLog<E> {
    pub(crate) fn push(&mut self, error: E) {
        if self.first.len() < MAX_ERRORS {
            self.first.push_back(error);
        } else {
            self.omitted += 1;
        }
    }

    /// Adds an error before the others.
    pub(super) fn push_front(&mut self, error: E) {
        if self.first.len() == MAX_ERRORS {
            self.first.pop_back();
            self.omitted += 1;
        }
        self.first.push_front(error);
    }

    /// Adds errors that are only counted.
    pub(crate) fn omit(&mut self, errors: u64) {
        self.omitted += errors;
    }

    /// The errors that are kept.
    pub(super) fn iter(&self) -> impl Iterator<Item = &E> {
        self.first.iter()
    }

    /// The number of errors that are not kept.
    pub(super) fn omitted(&self) -> u64 {
        self.omitted
    }
}

impl ErrorLog<BagError> {
    /// Removes the next error that is kept, then [`BagError::MoreErrors`] of the bag at `path` if errors were
    /// omitted.
    pub(crate) fn pop(&mut self, path: &Path) -> Option<BagError> {
        self.first.pop_front().or_else(|| {
            let count = std::mem::take(&mut self.omitted);
            (count > 0).then(|| BagError::MoreErrors { path: path.into(), count })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_errors_come_before_the_number_of_the_others() {
        let path = Path::new("run7");
        let error =
            |topic: usize| BagError::NoMessages { path: path.into(), topic: topic.to_string() };
        let mut errors = ErrorLog::default();
        (0..MAX_ERRORS + 3).for_each(|topic| errors.push(error(topic)));
        errors.push_front(error(99));
        errors.omit(5);
        let found: Vec<String> =
            std::iter::from_fn(|| errors.pop(path)).map(|error| error.to_string()).collect();
        let mut expected: Vec<_> =
            (0..MAX_ERRORS - 1).map(|topic| error(topic).to_string()).collect();
        expected.insert(0, error(99).to_string());
        expected.push("run7: 9 more errors, not listed".to_owned());
        assert_eq!(found, expected);
    }
}
