//! The published state of the run-time barriers that a node knows: payload of `Kind::SYNC_ARRIVALS`, a
//! MessagePack map.
//!
//! The parser here checks all bounds once: `docs/protocol/sync.md` has the fields and the bounds.

use std::collections::BTreeSet;

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;
use sinew_runtime::{
    app::Requirement,
    tid::{AppAddress, Incarnation, NodeAddress},
};

use super::list::Name;

/// Maximum number of barriers that one node knows.
pub const BARRIERS_MAX: usize = 256;
/// Maximum number of requirements that are the parties of one barrier.
pub const PARTIES_MAX: usize = 64;
/// Maximum size of the names of one barrier's parties together, in bytes.
pub const PARTIES_BYTES_MAX: usize = 4_096;
/// Maximum number of applications that wait at one barrier on one node, and that pass it together.
pub const ARRIVALS_MAX: usize = 1_024;
/// Highest generation. A barrier that opens a million times a second reaches it in 285 years.
pub const GENERATION_MAX: u64 = 1 << 53;

/// Every node accepts each generation up to this one. Half of the range therefore remains after any wrong
/// generation.
pub const GENERATION_FREE_MAX: u64 = 1 << 52;
/// Maximum distance of a generation above `GENERATION_FREE_MAX`, or above the first received one. The limit
/// grows by one for each microsecond since. A barrier that opens a thousand times a second takes 34 years for
/// this distance. A node that was away can therefore accept the generations that it missed.
pub const GENERATIONS_MISSED_MAX: u64 = 1 << 40;
/// Highest generation that is accepted for a barrier without an earlier one. A higher one would exhaust the
/// range.
pub const GENERATION_AT_FIRST_MAX: u64 = GENERATION_FREE_MAX + 2 * GENERATIONS_MISSED_MAX;

/// The state that a node publishes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Arrivals {
    /// The incarnation of the node.
    pub incarnation: Incarnation,
    /// Counter of the changes in that incarnation, from 1.
    pub version: u64,
    /// The barriers that the node knows.
    #[serde(deserialize_with = "at_most::<_, _, BARRIERS_MAX>")]
    pub barriers: Vec<PublishedBarrier>,
}

/// The published state of one barrier.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PublishedBarrier {
    /// The barrier's name.
    pub name: Name,
    /// The required parties. With the name, they identify the barrier.
    #[serde(deserialize_with = "at_most::<_, _, PARTIES_MAX>")]
    pub parties: Vec<Requirement>,
    /// The number of openings.
    pub generation: u64,
    /// The members of the last generation.
    #[serde(default, deserialize_with = "at_most::<_, _, ARRIVALS_MAX>")]
    pub members: Vec<Member>,
    /// The members of earlier generations that their nodes may not know yet.
    #[serde(
        default,
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "at_most::<_, _, ARRIVALS_MAX>"
    )]
    pub earlier: Vec<Passed>,
    /// The applications of this node that wait at the barrier.
    #[serde(default, deserialize_with = "at_most::<_, _, ARRIVALS_MAX>")]
    pub arrivals: Vec<Arrival>,
}

/// One life of an application, as a party of barriers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Member {
    /// The node of the application.
    pub node: NodeAddress,
    /// The incarnation of the node.
    pub incarnation: Incarnation,
    /// The number of the life among the lives of that incarnation that have arrived at a barrier.
    pub party: u64,
}

/// The last generation that one life of an application has passed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Passed {
    node: NodeAddress,
    incarnation: Incarnation,
    party: u64,
    /// The generation.
    pub generation: u64,
}

impl Passed {
    pub const fn new(Member { node, incarnation, party }: Member, generation: u64) -> Self {
        Self { node, incarnation, party, generation }
    }

    pub const fn member(&self) -> Member {
        Member { node: self.node, incarnation: self.incarnation, party: self.party }
    }
}

/// A waiting application.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Arrival {
    /// The party number of the application's life.
    pub party: u64,
    /// The application's address.
    pub app: AppAddress,
    /// The application's name, if it has one.
    #[serde(default)]
    pub name: Option<Name>,
    /// The generation behind which the application waits: it waits for the next one.
    pub after: u64,
}

/// The error of a malformed barrier frame. The peer is at fault; nothing changed.
#[derive(Debug, thiserror::Error)]
pub enum ArrivalsError {
    /// The bytes are not the MessagePack map, or exceed its bounds.
    #[error("this is not a barrier frame: {0}")]
    Malformed(#[from] rmp_serde::decode::Error),
    /// A barrier or a party occurs twice, there are no parties, or a number is out of range.
    #[error("the barrier {0}: {1}")]
    Wrong(Name, &'static str),
}

impl Arrivals {
    /// Parses the barrier frame of a peer. Allocates at most the legal bounds, even if the bytes claim larger
    /// lengths.
    pub fn parse(bytes: &[u8]) -> Result<Self, ArrivalsError> {
        let frame: Self = sinew_runtime::wire::decode(bytes)?;
        let mut known = BTreeSet::new();
        for barrier in &frame.barriers {
            if let Some(why) = barrier.fault() {
                return Err(ArrivalsError::Wrong(barrier.name.clone(), why));
            }
            let parties: Vec<&str> = barrier.parties.iter().map(Requirement::as_str).collect();
            if !known.insert((&barrier.name, parties)) {
                return Err(ArrivalsError::Wrong(barrier.name.clone(), "occurs twice"));
            }
        }
        Ok(frame)
    }

    pub fn encode(&self) -> Bytes {
        rmp_serde::to_vec_named(self).expect("maps of numbers and texts into memory cannot fail").into()
    }
}

impl PublishedBarrier {
    fn fault(&self) -> Option<&'static str> {
        let mut parties = BTreeSet::new();
        let mut arrivals = self.arrivals.iter();
        if let Some(why) = fault_of_parties(&self.parties) {
            Some(why)
        } else if self.generation > GENERATION_MAX {
            Some("its generation is beyond 2^53")
        } else if !self.earlier.iter().all(|passed| (1..self.generation).contains(&passed.generation)) {
            Some("a member has passed a generation that is not earlier than the last one")
        } else if arrivals.clone().any(|arrival| arrival.after > self.generation) {
            Some("an application waits behind a generation that its node does not know")
        } else if arrivals.any(|arrival| !parties.insert(arrival.party)) {
            Some("one party waits there twice")
        } else {
            None
        }
    }
}

/// Returns the description of the fault in the parties of a barrier.
pub fn fault_of_parties(parties: &[Requirement]) -> Option<&'static str> {
    if parties.is_empty() {
        Some("it has no parties; name the applications that must arrive, or `3 of *` for any three")
    } else if parties.iter().map(|party| party.as_str().len()).sum::<usize>() > PARTIES_BYTES_MAX {
        Some("its parties have more than 4,096 bytes together; use patterns or counts")
    } else if parties.iter().any(|party| party.wait_max().is_some()) {
        Some("a party of a barrier has no wait limit: the wait itself has one")
    } else if parties.iter().any(|party| party.phase().is_some()) {
        Some("a party of a barrier has no phase: it is present when it arrives")
    } else if parties.iter().map(Requirement::count).sum::<usize>() > ARRIVALS_MAX {
        Some(
            "its parties are more than 1,024 applications together, which is the limit; use several barriers",
        )
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn passed(generation: u64) -> Passed {
        Passed::new(Member { node: NodeAddress::new(1), incarnation: Incarnation(2), party: 4 }, generation)
    }

    fn encoded(change: impl FnOnce(&mut PublishedBarrier)) -> Vec<u8> {
        let mut barrier = PublishedBarrier {
            name: Name::try_from("calibrated".to_owned()).unwrap(),
            parties: vec![Requirement::name("hip"), Requirement::at_least(2, ["*.drive"])],
            generation: 3,
            members: vec![Member { node: NodeAddress::new(1), incarnation: Incarnation(2), party: 3 }],
            earlier: vec![passed(2)],
            arrivals: vec![Arrival { party: 1, app: AppAddress::new(0x1000), name: None, after: 3 }],
        };
        change(&mut barrier);
        Arrivals { incarnation: Incarnation(1), version: 1, barriers: vec![barrier] }.encode().to_vec()
    }

    #[test]
    fn encoded_arrivals_decode_to_the_same() {
        let bytes = encoded(|_| {});
        assert_eq!(Arrivals::parse(&bytes).unwrap().encode(), bytes);
    }

    #[test]
    fn largest_simultaneous_opening_is_valid() {
        assert!(fault_of_parties(&[Requirement::at_least(ARRIVALS_MAX, ["*"])]).is_none());
    }

    #[test]
    fn impossible_arrivals_are_rejected() {
        let wrong: [fn(&mut PublishedBarrier); 12] = [
            |barrier| barrier.parties.clear(),
            |barrier| barrier.parties.push("camera ?1s".parse().unwrap()),
            |barrier| barrier.parties.push(Requirement::at_least(ARRIVALS_MAX - 2, ["*"])),
            |barrier| barrier.parties.push("camera at homed".parse().unwrap()),
            |barrier| barrier.generation = u64::MAX,
            |barrier| {
                let party = |number| Requirement::any([format!("{number:a>63}"), format!("{number:b>63}")]);
                barrier.parties.extend((0..32).map(party));
            },
            |barrier| barrier.generation = 2,
            |barrier| barrier.arrivals.push(barrier.arrivals[0].clone()),
            |barrier| barrier.earlier = vec![passed(0)],
            |barrier| barrier.earlier = vec![passed(3)],
            |barrier| barrier.earlier = vec![passed(1); ARRIVALS_MAX + 1],
            |barrier| barrier.members = vec![barrier.members[0]; ARRIVALS_MAX + 1],
        ];
        for change in wrong {
            assert!(Arrivals::parse(&encoded(change)).is_err());
        }
    }

    proptest! {
        #[test]
        fn any_bytes_decode_or_are_rejected(bytes in proptest::collection::vec(any::<u8>(), 0..256)) {
            drop(Arrivals::parse(&bytes));
        }

        #[test]
        fn damaged_bytes_decode_or_are_rejected(at in 0usize..200, byte in any::<u8>()) {
            let mut bytes = encoded(|_| {});
            let length = bytes.len();
            bytes[at % length] = byte;
            drop(Arrivals::parse(&bytes));
        }
    }
}
