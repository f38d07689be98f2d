//! The questions about messages to many, and what answers them.

use serde::{Deserialize, Serialize};
use sinew_runtime::tid::{AppAddress, Tid};

use super::{AccessVerdict, Report, access::CLASSES, halve};
use crate::{payload, sync::at_most};

/// Applications, or groups, in one answer about a message to many at most.
pub const REACHED_MAX: usize = 256;

payload!("sinew.inspect.reach" =>
    /// Which applications of yours does a message from this one to many reach, and may it? [`ReachReport`] answers. Nothing is sent to them.
    #[derive(Clone, Copy, Debug)]
    pub struct AskReach {
        /// Who would send.
        pub source: Tid,
        /// To whom on each node: a group, every application ([`AppAddress::ALL`]), or the one at an address.
        pub to: AppAddress,
    }
);

payload!("sinew.inspect.groups" =>
    /// Of which groups is this application of yours a member, where your access list says something else of messages to the group than of
    /// those to it alone? [`ReachReport`] answers.
    #[derive(Clone, Copy, Debug)]
    pub struct AskGroups {
        /// Who would send.
        pub source: Tid,
        /// The application of the node that is asked, which would get it.
        pub member: Tid,
    }
);

payload!("sinew.inspect.reach_report" =>
    /// Whom messages to many reach at a node, and what its access list says of that.
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub struct ReachReport {
        /// Whether the node has a list; without one everything is allowed.
        pub is_given: bool,
        /// In the order of their addresses; the one who would send gets nothing of it, and is not among them.
        #[serde(deserialize_with = "at_most::<_, _, REACHED_MAX>")]
        pub reached: Vec<Reached>,
        /// Further ones that had no room; of groups, those that a rule names, whatever it says of them.
        pub left_out: u64,
    }
);

/// An application that gets what is sent to many, if the list lets it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reached {
    /// To whom it is sent: a group that it is a member of, every application, or its address on each node.
    pub to: AppAddress,
    /// The application.
    pub app: Tid,
    /// For each class, if there is a list.
    #[serde(deserialize_with = "at_most::<_, _, CLASSES>")]
    pub verdicts: Vec<AccessVerdict>,
}

impl Report for ReachReport {
    fn halve(&mut self) -> bool {
        halve(&mut self.reached, &mut self.left_out)
    }
}
