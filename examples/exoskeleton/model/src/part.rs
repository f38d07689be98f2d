//! The parts of the robot that run, fail and return independently: one node each.

use std::fmt;
use std::str::FromStr;

use crate::joint::Joint;

/// A node of the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize)]
#[serde(into = "&'static str")]
pub enum Part {
    /// Phase estimation and coordination.
    Central,
    /// Sensor and drive of one joint.
    Joint(Joint),
}

impl Part {
    /// All nodes.
    pub const ALL: [Self; 4] =
        [Self::Central, Self::Joint(Joint::Hip), Self::Joint(Joint::Knee), Self::Joint(Joint::Ankle)];

    /// Lower-case name, as on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Central => "central",
            Self::Joint(joint) => joint.name(),
        }
    }
}

impl From<Part> for &'static str {
    fn from(part: Part) -> Self {
        part.name()
    }
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Part {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|part| part.name() == text)
            .ok_or_else(|| format!("`{text}` is no node; choose central, hip, knee or ankle"))
    }
}

/// A node to kill when a stride begins, as `NODE@STRIDE`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Kill {
    /// The node.
    pub part: Part,
    /// The stride, counted from 1, with the heel strike at which the node dies.
    pub stride: u32,
}

impl FromStr for Kill {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (part, stride) =
            text.split_once('@').ok_or_else(|| format!("`{text}` is not NODE@STRIDE, for example knee@8"))?;
        let stride: u32 = stride.parse().map_err(|_| format!("`{stride}` is no stride number"))?;
        if stride == 0 {
            return Err("strides count from 1".to_owned());
        }
        Ok(Self { part: part.parse()?, stride })
    }
}

impl fmt::Display for Kill {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.part, self.stride)
    }
}
