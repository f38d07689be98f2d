//! What an application says at a run-time barrier, and what it is told; by these kinds any process can do it.

use serde::{Deserialize, Serialize};

use super::facts::Absence;
use crate::payload;

payload!("sinew.barrier.arrive" =>
    /// Its sender has arrived at a barrier of its own node, and waits there. A request to the node's sync manager (`node/2`);
    /// [`BarrierAnswer`] answers.
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub struct ArriveAtBarrier {
        /// The barrier's name, 1 to 63 bytes.
        pub barrier: String,
        /// Who has to be there, as in `requires`: names, patterns, any of several, so many of them; at most 64, without wait limits.
        /// The same for all that meet.
        pub parties: Vec<String>,
        /// How long it waits, in milliseconds.
        pub within_ms: u32,
        /// What it does when a party is lost.
        pub on_loss: OnPartyLoss,
        /// Whether they meet there, or come up in phases.
        #[serde(default)]
        pub kind: BarrierKind,
    }
);

/// When those who wait at a barrier go on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum BarrierKind {
    /// When all of them wait at the same time. It opens again for each round.
    #[default]
    Meeting,
    /// When all of them have reached it in their present lives. Whoever has counts until its life ends, also while it does
    /// something else: one that is started again does not bring the others back.
    Phase,
}

payload!("sinew.barrier.leave" =>
    /// Its sender waits there no more. Nothing answers.
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub struct LeaveBarrier {
        /// The barrier's name.
        pub barrier: String,
        /// The `correlation` of the request that is given up; a later one goes on waiting. Without it any wait there is over.
        #[serde(default)]
        pub correlation: Option<u64>,
    }
);

payload!("sinew.barrier.answer" =>
    /// What became of a wait at a barrier.
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub enum BarrierAnswer {
        /// All parties have arrived.
        Opened {
            /// How often this barrier has opened, as far as those who met know: the same number for all of them.
            generation: u64,
        },
        /// The time was over first. Whoever waits still goes on waiting.
        TimedOut {
            /// Who is missing, and the last that is known of each.
            missing: Vec<(String, String)>,
        },
        /// A party was lost, and this application wanted to be told so instead of waiting for its return.
        Lost {
            /// Who is missing, and the last that is known of each.
            missing: Vec<(String, String)>,
        },
        /// The node does not let it wait there: what it asked for is wrong, or there is no room.
        Refused {
            /// Why, in words.
            why: String,
        },
    }
);

/// What whoever waits at a barrier does when a party that it asks for by its name has failed, was stopped, or its node is lost.
///
/// # Examples
///
/// ```
/// use sinew::barrier::{Barrier, OnPartyLoss};
///
/// // A knee that fails does not come back in time for this step.
/// let step = Barrier::new("step", ["hip", "knee"]).on_loss(OnPartyLoss::Fail);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum OnPartyLoss {
    /// It goes on waiting: the party may come back and arrive.
    #[default]
    Wait,
    /// It waits no more, 50 ms after the loss was known here: [`BarrierAnswer::Lost`].
    Fail,
}

/// A run-time barrier at which somebody waits, as this node sees it.
///
/// # Examples
///
/// ```
/// use sinew::{NodeHandle, barrier::BarrierStatus};
///
/// fn show(handle: &NodeHandle) {
///     for BarrierStatus { barrier, missing, .. } in handle.barriers() {
///         missing.iter().for_each(|absence| println!("{barrier} waits for {absence}"));
///     }
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BarrierStatus {
    /// The barrier's name.
    pub barrier: String,
    /// Who has to be there.
    pub parties: Vec<String>,
    /// When those who wait there go on.
    pub kind: BarrierKind,
    /// How often it has opened, as far as is known here; of a phase 0.
    pub generation: u64,
    /// Applications of this node that wait there: name or address, and for how long.
    pub waiting: Vec<(String, std::time::Duration)>,
    /// Who is missing, since when, and the last that is known of each; of one that waits at another barrier for somebody who waits here, that.
    pub missing: Vec<Absence>,
}
