//! A number of a payload, and its conversion to the types of C.

use super::ReadError;

/// A number in the type in which it was sent.
#[derive(Clone, Copy)]
pub(super) enum Number {
    Unsigned(u64),
    Signed(i64),
    Single(f32),
    Double(f64),
}

/// Integers to 2^53 are exact in a double, to 2^24 in a float (IEEE 754).
const EXACT_IN_DOUBLE: u64 = 1 << 53;
const EXACT_IN_FLOAT: u64 = 1 << 24;

impl Number {
    pub(super) fn integer<T: TryFrom<u64> + TryFrom<i64>>(self, expected: &str) -> Result<T, ReadError> {
        let fits = match self {
            Self::Unsigned(value) => T::try_from(value).ok(),
            Self::Signed(value) => T::try_from(value).ok(),
            Self::Single(_) | Self::Double(_) => None,
        };
        fits.ok_or_else(|| ReadError::payload(format!("expected {expected}, found {}", self.description())))
    }

    pub(super) fn float(self) -> Result<f32, ReadError> {
        let refused = || Err(ReadError::payload(format!("expected float, found {}", self.description())));
        match self {
            Self::Single(value) => Ok(value),
            // Rounded to the nearest, but not to infinity.
            Self::Double(value) if value.is_finite() && (value as f32).is_infinite() => refused(),
            Self::Double(value) => Ok(value as f32),
            Self::Unsigned(value) if value <= EXACT_IN_FLOAT => Ok(value as f32),
            Self::Signed(value) if value.unsigned_abs() <= EXACT_IN_FLOAT => Ok(value as f32),
            Self::Unsigned(_) | Self::Signed(_) => refused(),
        }
    }

    pub(super) fn double(self) -> Result<f64, ReadError> {
        match self {
            Self::Single(value) => Ok(f64::from(value)),
            Self::Double(value) => Ok(value),
            Self::Unsigned(value) if value <= EXACT_IN_DOUBLE => Ok(value as f64),
            Self::Signed(value) if value.unsigned_abs() <= EXACT_IN_DOUBLE => Ok(value as f64),
            Self::Unsigned(_) | Self::Signed(_) => {
                Err(ReadError::payload(format!("expected double, found {}", self.description())))
            }
        }
    }

    fn description(self) -> String {
        match self {
            Self::Unsigned(value) => format!("the integer {value}"),
            Self::Signed(value) => format!("the integer {value}"),
            Self::Single(value) => format!("the float {value:?}"),
            Self::Double(value) => format!("the float {value:?}"),
        }
    }
}
