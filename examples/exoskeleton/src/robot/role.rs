//! The processes of the robot: four nodes and the plant.

use std::fmt;
use std::str::FromStr;

use exoskeleton_model::part::Part;

/// A process of the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// A node.
    Node(Part),
    /// The simulation of hardware and person.
    Plant,
}

impl Role {
    /// All processes.
    pub const ALL: [Self; 5] = [
        Self::Node(Part::ALL[0]),
        Self::Node(Part::ALL[1]),
        Self::Node(Part::ALL[2]),
        Self::Node(Part::ALL[3]),
        Self::Plant,
    ];

    /// Lower-case name, as on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Node(part) => part.name(),
            Self::Plant => "plant",
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Role {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|role| role.name() == text).ok_or_else(|| {
            format!("`{text}` is no part of the robot; choose central, hip, knee, ankle or plant")
        })
    }
}
