//! How an application ended.

use serde::{Deserialize, Serialize};
use sinew_runtime::{monitor::DownClass, supervision::Reason};

/// Maximum length of a reason in bytes.
pub const WHY_BYTES_MAX: usize = 256;

/// The cause of an end: a class for programs, a text for people.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cause {
    /// The class.
    pub class: DownClass,
    /// At most 256 bytes.
    why: String,
}

impl Cause {
    /// Returns a cause with this text, truncated to its maximum length.
    pub fn new(class: DownClass, why: impl Into<String>) -> Self {
        let mut why: String = why.into();
        why.truncate(why.floor_char_boundary(WHY_BYTES_MAX));
        Self { class, why }
    }

    /// Returns the text, truncated to its maximum length. The text from another node may exceed it.
    pub fn why(&self) -> &str {
        &self.why[..self.why.floor_char_boundary(WHY_BYTES_MAX)]
    }
}

impl From<&Reason> for Cause {
    fn from(reason: &Reason) -> Self {
        Self::new(DownClass::of(reason), reason.to_string())
    }
}
