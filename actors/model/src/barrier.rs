//! The payloads of run-time barriers: requests of applications and their answers. Any process can use these
//! kinds.

use serde::{Deserialize, Serialize};
use sinew_runtime::wire::Payload;

use crate::directory::Absence;

/// The arrival of the sender at a barrier of its own node, where it waits. This is a request to the
/// node's sync manager (`node/2`); the reply is a [`BarrierAnswer`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ArriveAtBarrier {
    /// The barrier's name, 1 to 63 bytes.
    pub barrier: String,
    /// The required parties, as in `requires`: names, patterns, alternatives and counts; at most 64,
    /// without wait limits. All applications that meet must list the same parties.
    pub parties: Vec<String>,
    /// The maximum wait in milliseconds.
    pub within_ms: u32,
    /// The behaviour when a party is lost.
    pub on_loss: OnPartyLoss,
    /// Whether the applications meet at the barrier, or start in phases.
    #[serde(default)]
    pub kind: BarrierKind,
}

impl Payload for ArriveAtBarrier {
    const NAME: &'static str = "sinew.barrier.arrive";
}

/// The condition under which the waiting applications continue.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum BarrierKind {
    /// All parties wait at the same time. The barrier opens again for each round.
    #[default]
    Meeting,
    /// All parties have reached the barrier in their current incarnations. A party counts until its incarnation
    /// ends, also while it continues. A restarted application therefore does not require the others to return.
    Phase,
}

/// The end of the sender's wait at a barrier. This message has no reply.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LeaveBarrier {
    /// The barrier's name.
    pub barrier: String,
    /// The `correlation` of the request to end; the wait of a later request continues. Without it, every wait of
    /// the sender at the barrier ends.
    #[serde(default)]
    pub correlation: Option<u64>,
}

impl Payload for LeaveBarrier {
    const NAME: &'static str = "sinew.barrier.leave";
}

/// The result of a wait at a barrier.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum BarrierAnswer {
    /// All parties have arrived.
    Opened {
        /// The number of openings of this barrier that its members know. All members receive the same
        /// number.
        generation: u64,
    },
    /// The wait timed out before the barrier opened. Other waits there continue.
    TimedOut {
        /// The missing parties, and the last known state of each.
        missing: Vec<(String, String)>,
    },
    /// A party was lost, and this application does not wait for its return.
    Lost {
        /// The missing parties, and the last known state of each.
        missing: Vec<(String, String)>,
    },
    /// The node rejected the wait: the request is wrong, or there is no room.
    Refused {
        /// The reason in words.
        why: String,
    },
}

impl Payload for BarrierAnswer {
    const NAME: &'static str = "sinew.barrier.answer";
}

/// The behaviour of a waiting application when a party of one name fails or is stopped, or its node is lost.
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
    /// The wait continues: the party may return and arrive.
    #[default]
    Wait,
    /// The wait ends 50 ms after this node detects the loss, with [`BarrierAnswer::Lost`].
    Fail,
}

/// A run-time barrier at which an application waits, as this node knows it.
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
    /// The required parties.
    pub parties: Vec<String>,
    /// The condition under which the waiting applications continue.
    pub kind: BarrierKind,
    /// The number of openings that this node knows; 0 for a phase.
    pub generation: u64,
    /// Applications of this node that wait there: name or address, and the duration.
    pub waiting: Vec<(String, std::time::Duration)>,
    /// The missing parties, since when, and the last known state of each. If a party waits at another barrier
    /// for an application that waits here, the state says so.
    pub missing: Vec<Absence>,
}
