//! The declaration of a parameter.

use crate::value::Value;

/// Maximum number of parameters of one application.
pub const PARAMETERS_MAX: usize = 64;
/// Maximum length of a parameter's name in bytes, as for any other name.
pub const NAME_BYTES_MAX: usize = 63;

/// The declaration of a parameter: name, unit, default, range and description.
///
/// `params!` makes it, and checks it when the program is compiled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Descriptor {
    /// The name, unique within its application.
    pub name: &'static str,
    /// The lines of the doc comment.
    pub description: &'static str,
    /// The unit, as in "Nm"; "1" for a share or a count, "" for a flag.
    pub unit: &'static str,
    /// Type, default and range.
    pub domain: Domain,
    /// Whether the value survives a restart of its application.
    pub keep: bool,
}

/// The type of a parameter, its default and its range. Both ends of a range are legal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Domain {
    /// A number with a fraction.
    Number {
        /// The value at the start.
        default: f64,
        /// The least legal value.
        min: f64,
        /// The greatest legal value.
        max: f64,
        /// Maximum change in a second, in the parameter's unit; `None`: a new value applies at once.
        slope_per_s: Option<f64>,
    },
    /// A whole number.
    Integer {
        /// The value at the start.
        default: i64,
        /// The least legal value.
        min: i64,
        /// The greatest legal value.
        max: i64,
    },
    /// On or off.
    Flag {
        /// The value at the start.
        default: bool,
    },
}

impl Descriptor {
    /// Returns the value at the start.
    #[must_use]
    pub const fn default(&self) -> Value {
        match self.domain {
            Domain::Number { default, .. } => Value::Number(default),
            Domain::Integer { default, .. } => Value::Integer(default),
            Domain::Flag { default } => Value::Flag(default),
        }
    }

    /// Returns the least and the greatest legal value; `None` for a flag.
    #[must_use]
    pub const fn range(&self) -> Option<(Value, Value)> {
        match self.domain {
            Domain::Number { min, max, .. } => Some((Value::Number(min), Value::Number(max))),
            Domain::Integer { min, max, .. } => Some((Value::Integer(min), Value::Integer(max))),
            Domain::Flag { .. } => None,
        }
    }

    /// Returns the maximum change in a second, in the parameter's unit; `None`: a new value applies at once.
    #[must_use]
    pub const fn slope_per_s(&self) -> Option<f64> {
        match self.domain {
            Domain::Number { slope_per_s, .. } => slope_per_s,
            Domain::Integer { .. } | Domain::Flag { .. } => None,
        }
    }

    /// Returns the description on one line.
    #[must_use]
    pub fn description(&self) -> String {
        self.description.split_whitespace().collect::<Vec<_>>().join(" ")
    }

    /// Returns the reason why this declaration is not legal: the name is too long, the default is outside of its range,
    /// or the slope is not positive. `None`: it is legal.
    #[must_use]
    pub const fn fault(&self) -> Option<&'static str> {
        const OUT_OF_RANGE: &str = "the default of a parameter is in its range";
        if self.name.len() > NAME_BYTES_MAX {
            return Some("the name of a parameter has at most 63 bytes");
        }
        match self.domain {
            Domain::Number { min, max, .. } if !(min.is_finite() && max.is_finite()) => {
                Some("both ends of a range are finite numbers")
            }
            // False for NaN.
            Domain::Number { default, min, max, .. } if !(min <= default && default <= max) => {
                Some(OUT_OF_RANGE)
            }
            Domain::Number { slope_per_s: Some(slope), .. } if !(slope.is_finite() && slope > 0.0) => {
                Some("a slope is greater than zero, in units per second")
            }
            Domain::Integer { default, min, max } if !(min <= default && default <= max) => {
                Some(OUT_OF_RANGE)
            }
            Domain::Number { .. } | Domain::Integer { .. } | Domain::Flag { .. } => None,
        }
    }

    pub(crate) fn value_of(&self, bits: u64) -> Value {
        match self.domain {
            Domain::Number { .. } => Value::Number(f64::from_bits(bits)),
            Domain::Integer { .. } => Value::Integer(bits.cast_signed()),
            Domain::Flag { .. } => Value::Flag(bits != 0),
        }
    }
}

/// Checks the declarations of one application. `params!` calls it when the program is compiled.
///
/// # Panics
/// There are too many, or one is not legal: see [`Descriptor::fault`].
pub const fn check(descriptors: &[Descriptor]) {
    assert!(descriptors.len() <= PARAMETERS_MAX, "an application has at most 64 parameters");
    let mut at = 0;
    while at < descriptors.len() {
        if let Some(why) = descriptors[at].fault() {
            panic!("{}", why);
        }
        at += 1;
    }
}
