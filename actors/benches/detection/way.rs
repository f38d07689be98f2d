//! The ways in which a node leaves, and the expected events at the others.

use std::time::Duration;

use sinew::events::{LossReason, NodeEvent, Trouble};

use crate::{setting::Setting, subject::SUBJECT};

/// An act on a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    Kill,
    Leave,
    Stop,
    LinkDown,
    SilentCut,
    Stall(Turn),
    Restart(Ports),
}

/// The behaviour of a handler that does not return.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Turn {
    /// Keeps its CPU.
    Spins,
    /// Waits for something.
    Sleeps,
}

/// The ports of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ports {
    /// Chosen by the system, for each incarnation again.
    Any,
    /// The same ones for every incarnation.
    Same,
}

impl Ports {
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Any => "any",
            Self::Same => "same",
        }
    }

    pub(crate) fn named(name: &str) -> Self {
        let found = [Self::Any, Self::Same].into_iter().find(|ports| ports.name() == name);
        found.expect("a name that this program wrote itself")
    }
}

impl Way {
    pub(crate) const ALL: [Self; 9] = [
        Self::Kill,
        Self::Leave,
        Self::Stop,
        Self::LinkDown,
        Self::SilentCut,
        Self::Stall(Turn::Spins),
        Self::Stall(Turn::Sleeps),
        Self::Restart(Ports::Any),
        Self::Restart(Ports::Same),
    ];

    /// The name as part of the names of cases.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Kill => "kill",
            Self::Leave => "leave",
            Self::Stop => "stop",
            Self::LinkDown => "link_down",
            Self::SilentCut => "silent_cut",
            Self::Stall(Turn::Spins) => "stall_busy",
            Self::Stall(Turn::Sleeps) => "stall_asleep",
            Self::Restart(Ports::Any) => "restart",
            Self::Restart(Ports::Same) => "restart_same_ports",
        }
    }

    /// The ports of the subject of the act.
    pub(crate) const fn ports(self) -> Ports {
        if let Self::Restart(ports) = self { ports } else { Ports::Any }
    }

    /// Whether the first event is correct.
    pub(crate) fn is_told_by(self, event: &NodeEvent) -> bool {
        match (self, event) {
            (Self::Stall(_), NodeEvent::AppStalled { app_name, trouble, .. }) => {
                app_name == SUBJECT && *trouble == Trouble::Stalled
            }
            (Self::Restart(_), NodeEvent::NodeRestarted { .. }) => true,
            (_, NodeEvent::NodeLost { why, .. }) => self.loss_reasons().contains(why),
            _ => false,
        }
    }

    const fn loss_reasons(self) -> &'static [LossReason] {
        match self {
            Self::Kill | Self::Restart(_) => &[LossReason::Crashed],
            Self::Leave => &[LossReason::Left],
            Self::Stop => &[LossReason::Hung],
            Self::LinkDown | Self::SilentCut => &[LossReason::LinkDown],
            Self::Stall(_) => &[],
        }
    }

    /// Whether this event reports the end of the condition.
    pub(crate) const fn is_ended_by(self, event: &NodeEvent) -> bool {
        match self {
            Self::Kill | Self::Leave | Self::Restart(_) => matches!(event, NodeEvent::NodeRestarted { .. }),
            Self::Stop | Self::LinkDown | Self::SilentCut => matches!(event, NodeEvent::NodeFound { .. }),
            Self::Stall(_) => matches!(event, NodeEvent::AppResumed { .. }),
        }
    }

    /// Bound on the report of the act.
    pub(crate) fn bound(self, setting: Setting) -> Duration {
        if let Self::Stall(_) = self { setting.stall_bound() } else { setting.loss_bound() }
    }
}
