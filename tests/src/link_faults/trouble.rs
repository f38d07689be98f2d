//! The kinds of link faults.

use std::{fmt, str::FromStr};

/// A fault of the link between the first node, which sends most, and the second.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Trouble {
    /// Cuts the connections by RST.
    Cut,
    /// Cuts the connections by FIN.
    Finish,
    /// Makes GNCL panic on the first node.
    PanicSender,
    /// Makes GNCL panic on the second node.
    PanicReceiver,
    /// Blocks both directions for some time.
    Stall,
    /// Blocks the direction from the first to the second for some time; datagrams are lost.
    PartThere,
    /// Blocks the direction from the second to the first for some time; datagrams are lost.
    PartBack,
    /// Stops the second node's process for some time.
    Freeze,
    /// Kills the second node's process, and starts another one.
    KillReceiver,
    /// Kills the first node's process, and starts another one.
    KillSender,
    /// Sets the wall clocks of both nodes a day forward.
    ClockOn,
    /// Sets them a day back.
    ClockBack,
}

impl Trouble {
    /// All variants, with their names.
    pub const ALL: [(&'static str, Self); 12] = [
        ("cut", Self::Cut),
        ("finish", Self::Finish),
        ("panic-sender", Self::PanicSender),
        ("panic-receiver", Self::PanicReceiver),
        ("stall", Self::Stall),
        ("part-there", Self::PartThere),
        ("part-back", Self::PartBack),
        ("freeze", Self::Freeze),
        ("kill-receiver", Self::KillReceiver),
        ("kill-sender", Self::KillSender),
        ("clock-on", Self::ClockOn),
        ("clock-back", Self::ClockBack),
    ];

    /// Returns whether it ends no node and is instantaneous, so that every message must arrive.
    #[must_use]
    pub const fn is_short(self) -> bool {
        match self {
            Self::Cut
            | Self::Finish
            | Self::PanicSender
            | Self::PanicReceiver
            | Self::ClockOn
            | Self::ClockBack => true,
            Self::Stall
            | Self::PartThere
            | Self::PartBack
            | Self::Freeze
            | Self::KillReceiver
            | Self::KillSender => false,
        }
    }
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (name, _) = Self::ALL.into_iter().find(|(_, trouble)| trouble == self).expect("all are there");
        f.pad(name)
    }
}

impl FromStr for Trouble {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|(name, _)| *name == text);
        let names = || Self::ALL.map(|(name, _)| name).join(", ");
        found.map(|(_, trouble)| trouble).ok_or_else(|| format!("{text:?} is none of {}", names()))
    }
}
