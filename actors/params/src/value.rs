//! A value of a parameter.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

/// The largest whole number below which each one is a number with a fraction, too.
const EXACT_MAX: u64 = 1 << 53;

/// A value of a parameter, of any of the three types.
///
/// # Examples
///
/// ```
/// use sinew_params::Value;
///
/// assert_eq!("0.4".parse(), Ok(Value::Number(0.4)));
/// assert_eq!("4".parse(), Ok(Value::Integer(4)));
/// assert_eq!("true".parse(), Ok(Value::Flag(true)));
/// assert_eq!(Value::Number(4.0).to_string(), "4.0");
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Value {
    /// A number with a fraction.
    Number(f64),
    /// A whole number.
    Integer(i64),
    /// On or off.
    Flag(bool),
}

/// The reason why a text is no value. This is an error of the caller.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is no value: write a number as in 0.4, a whole number as in 4, or true or false")]
pub struct ValueError(String);

impl Value {
    /// Returns this as a number with a fraction, if that has exactly this value.
    pub(crate) fn as_number(self) -> Option<f64> {
        match self {
            Self::Number(number) => Some(number),
            Self::Integer(integer) if integer.unsigned_abs() <= EXACT_MAX => Some(integer as f64),
            Self::Integer(_) | Self::Flag(_) => None,
        }
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            // With its fraction, also if that is zero: the type is visible.
            Self::Number(number) => write!(f, "{number:?}"),
            Self::Integer(integer) => write!(f, "{integer}"),
            Self::Flag(flag) => write!(f, "{flag}"),
        }
    }
}

impl FromStr for Value {
    type Err = ValueError;

    fn from_str(text: &str) -> Result<Self, ValueError> {
        if let Ok(flag) = text.parse() {
            return Ok(Self::Flag(flag));
        }
        if let Ok(integer) = text.parse() {
            return Ok(Self::Integer(integer));
        }
        text.parse().map(Self::Number).map_err(|_| ValueError(text.chars().take(64).collect()))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn shown_value_is_read_as_the_same_one(number in any::<f64>(), integer in any::<i64>(), flag in any::<bool>()) {
            prop_assume!(!number.is_nan());
            for value in [Value::Number(number), Value::Integer(integer), Value::Flag(flag)] {
                prop_assert_eq!(value.to_string().parse::<Value>(), Ok(value));
            }
        }
    }

    #[test]
    fn invalid_text_is_refused_with_the_legal_forms() {
        let why = "fast".parse::<Value>().expect_err("it is a word");
        assert!(why.to_string().contains("'fast' is no value: write a number as in 0.4"), "{why}");
    }

    #[test]
    fn whole_number_is_accepted_only_if_exact() {
        assert_eq!(Value::Integer(4).as_number(), Some(4.0));
        assert_eq!(Value::Integer(i64::MAX).as_number(), None);
        assert_eq!(Value::Flag(true).as_number(), None);
    }
}
