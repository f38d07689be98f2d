//! What can happen to a link.

use std::{fmt, str::FromStr};

/// What can happen to the link between the first node, which sends most, and the second.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Trouble {
    /// The connections are cut by RST.
    Cut,
    /// The connections are cut by FIN.
    Finish,
    /// GNCL panics on the first node.
    PanicSender,
    /// GNCL panics on the second.
    PanicReceiver,
    /// Nothing passes for some time, both ways.
    Stall,
    /// Nothing passes from the first to the second for some time; datagrams are lost.
    PartThere,
    /// Nothing passes from the second to the first for some time; datagrams are lost.
    PartBack,
    /// The second node's process is stopped for some time.
    Freeze,
    /// The second node's process is killed, and another one started.
    KillReceiver,
    /// The first node's process is killed, and another one started.
    KillSender,
    /// The wall clocks of both nodes are set a day on.
    ClockOn,
    /// They are set a day back.
    ClockBack,
}

impl Trouble {
    /// All of them, with their names.
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

    /// Whether it ends no node and lasts for no time, so that every message must arrive.
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
