//! The steps of the demonstration that inject a fault.

use std::fmt;
use std::str::FromStr;

use serde::Serialize;

/// A step, by its number in the demonstration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(into = "u8")]
pub(crate) enum Step {
    /// 4: the process of the knee's drive is killed.
    KillDrive,
    /// 5: the process of the knee's drive hangs.
    HangDrive,
    /// 6: the knee's node is killed.
    PullNode,
    /// 7: the knee's node returns.
    ReturnNode,
    /// 8: the e-stop is pressed.
    EmergencyStop,
    /// 9: insane commands.
    InsaneCommands,
    /// 11: the central unit is killed.
    KillCentral,
    /// Also 6: the link of the knee's node is cut, on a robot with a host for each node.
    CutLink,
    /// Also 7: it is reconnected.
    JoinLink,
    /// 10: the network between the nodes loses and delays packets.
    RoughNetwork,
}

impl Step {
    /// The steps of a robot on one host, in order.
    pub(crate) const ALL: [Self; 7] = [
        Self::KillDrive,
        Self::HangDrive,
        Self::PullNode,
        Self::ReturnNode,
        Self::EmergencyStop,
        Self::InsaneCommands,
        Self::KillCentral,
    ];

    /// The steps of a robot with a host for each node.
    pub(crate) const ON_HOSTS: [Self; 2] = [Self::CutLink, Self::JoinLink];

    /// The steps of a robot with a network that can lose and delay packets.
    pub(crate) const ON_RADIO: [Self; 1] = [Self::RoughNetwork];

    /// A short description.
    #[must_use]
    pub(crate) const fn words(self) -> &'static str {
        match self {
            Self::KillDrive => "the process of the knee's drive is killed",
            Self::HangDrive => "the process of the knee's drive hangs",
            Self::PullNode => "the knee's node is pulled",
            Self::ReturnNode => "the knee's node returns",
            Self::EmergencyStop => "the e-stop is pressed",
            Self::InsaneCommands => "insane commands are given",
            Self::KillCentral => "the central unit is killed",
            Self::CutLink => "the link of the knee's node is cut",
            Self::JoinLink => "its link is joined again",
            Self::RoughNetwork => "the network of the nodes loses and delays packets",
        }
    }
}

impl From<Step> for u8 {
    fn from(step: Step) -> Self {
        match step {
            Step::KillDrive => 4,
            Step::HangDrive => 5,
            Step::PullNode | Step::CutLink => 6,
            Step::ReturnNode | Step::JoinLink => 7,
            Step::EmergencyStop => 8,
            Step::InsaneCommands => 9,
            Step::RoughNetwork => 10,
            Step::KillCentral => 11,
        }
    }
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        u8::from(*self).fmt(f)
    }
}

impl FromStr for Step {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|step| step.to_string() == text.trim())
            .ok_or_else(|| format!("`{text}` is no step here; choose from 4, 5, 6, 7, 8, 9, 11"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn step_round_trips_and_ten_is_for_another_robot() {
        for step in Step::ALL {
            assert_eq!(step.to_string().parse(), Ok(step));
        }
        for (step, same) in Step::ON_HOSTS.into_iter().zip([Step::PullNode, Step::ReturnNode]) {
            assert_eq!(step.to_string(), same.to_string());
        }
        assert!("10".parse::<Step>().is_err_and(|words| words.contains("11")));
    }
}
