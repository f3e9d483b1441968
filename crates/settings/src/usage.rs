//! Wrong usage that is found after the command line was parsed.

use std::{error::Error, fmt};

/// Arguments that are wrong whatever the files and the machine: the program ends with exit code 2, as for errors that
/// the parser of the command line finds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Usage(String);

impl Usage {
    /// Wrong usage. The message names the option, the value found and the value expected.
    pub fn new(message: impl fmt::Display) -> Self {
        Self(message.to_string())
    }

    /// Checks a condition on the arguments.
    ///
    /// # Errors
    /// Wrong usage with this message if the condition does not hold.
    pub fn unless(condition: bool, message: impl fmt::Display) -> Result<(), Self> {
        if condition { Ok(()) } else { Err(Self::new(message)) }
    }
}

/// Returns [`Usage`](crate::usage::Usage) from the function if a condition on the arguments does not hold.
#[macro_export]
macro_rules! ensure_usage {
    ($condition:expr, $($message:tt)+) => {
        $crate::usage::Usage::unless($condition, format_args!($($message)+))?
    };
}

impl fmt::Display for Usage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl Error for Usage {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_condition_that_does_not_hold_is_wrong_usage() {
        let message = "--horizon: found 0, expected at least 1 frame";
        assert_eq!(Usage::unless(true, message), Ok(()));
        assert_eq!(Usage::unless(false, message).unwrap_err().to_string(), message);
    }
}
