//! What a node says of the run-time barriers that it knows: payload of `Kind::SYNC_ARRIVALS`, a MessagePack map.
//!
//! It is parsed once, here, and is legal afterwards: `docs/protocol/sync.md` has the fields and the bounds.

use std::collections::BTreeSet;

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    app::Requirement,
    tid::{AppAddress, Incarnation, NodeAddress},
};

use super::list::{Name, at_most};

/// Barriers that one node knows at most.
pub(crate) const BARRIERS_MAX: usize = 256;
/// Requirements that the parties of one barrier are, at most.
pub(crate) const PARTIES_MAX: usize = 64;
/// Bytes that the names of one barrier's parties have together, at most.
pub(crate) const PARTIES_BYTES_MAX: usize = 4_096;
/// Applications that wait at one barrier on one node, and that passed it together, at most.
pub(crate) const ARRIVALS_MAX: usize = 1_024;
/// Highest generation: whatever opens a million times a second gets there in 285 years.
pub(crate) const GENERATION_MAX: u64 = 1 << 53;

/// Every generation up to this is believed, by everybody: half of the room is left whoever said so.
pub(crate) const GENERATION_FREE_MAX: u64 = 1 << 52;
/// So much higher than that, or than what was heard first, may be what is heard later, besides one for each microsecond since: one that opens a
/// thousand times a second is there in 34 years, so that a node which was away takes over what it has missed.
pub(crate) const GENERATIONS_MISSED_MAX: u64 = 1 << 40;
/// Highest generation that is believed of a barrier of which nothing was heard before: whoever said more would take the rest.
pub(crate) const GENERATION_AT_FIRST_MAX: u64 = GENERATION_FREE_MAX + 2 * GENERATIONS_MISSED_MAX;

/// What a node says.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Arrivals {
    /// Which life of the node says so.
    pub(crate) incarnation: Incarnation,
    /// Counts the changes in that life, from 1.
    pub(crate) version: u64,
    /// The barriers that it knows.
    #[serde(deserialize_with = "at_most::<_, _, BARRIERS_MAX>")]
    pub(crate) barriers: Vec<BarrierSaid>,
}

/// What a node says of one barrier.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct BarrierSaid {
    /// Its name.
    pub(crate) name: Name,
    /// Who has to be there; with the name, what tells it from other barriers.
    #[serde(deserialize_with = "at_most::<_, _, PARTIES_MAX>")]
    pub(crate) parties: Vec<Requirement>,
    /// How often it has opened.
    pub(crate) generation: u64,
    /// Who passed it then.
    #[serde(default, deserialize_with = "at_most::<_, _, ARRIVALS_MAX>")]
    pub(crate) members: Vec<Member>,
    /// Who passed an earlier one, and whose node may not know it yet.
    #[serde(
        default,
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "at_most::<_, _, ARRIVALS_MAX>"
    )]
    pub(crate) earlier: Vec<Passed>,
    /// Who waits there on this node.
    #[serde(default, deserialize_with = "at_most::<_, _, ARRIVALS_MAX>")]
    pub(crate) arrivals: Vec<Arrival>,
}

/// One life of an application, as a party of barriers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) struct Member {
    /// Its node.
    pub(crate) node: NodeAddress,
    /// Which life of its node.
    pub(crate) incarnation: Incarnation,
    /// Which of the lives that have arrived somewhere in it.
    pub(crate) party: u64,
}

/// One life of an application has passed a barrier.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Passed {
    node: NodeAddress,
    incarnation: Incarnation,
    party: u64,
    /// Which generation, last.
    pub(crate) generation: u64,
}

impl Passed {
    pub(crate) const fn new(Member { node, incarnation, party }: Member, generation: u64) -> Self {
        Self { node, incarnation, party, generation }
    }

    pub(crate) const fn member(&self) -> Member {
        Member { node: self.node, incarnation: self.incarnation, party: self.party }
    }
}

/// Somebody waits.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Arrival {
    /// Which life of an application.
    pub(crate) party: u64,
    /// Its address.
    pub(crate) app: AppAddress,
    /// Its name, if it has one.
    #[serde(default)]
    pub(crate) name: Option<Name>,
    /// The generation behind which it waits: it waits for the next one.
    pub(crate) after: u64,
}

/// Why bytes are not what a node says of barriers. The peer is at fault; nothing changed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ArrivalsError {
    /// Not the MessagePack map, or outside of its bounds.
    #[error("this says nothing of barriers: {0}")]
    Malformed(#[from] rmp_serde::decode::Error),
    /// A barrier or a party twice, nobody to wait for, or a number beyond its range.
    #[error("the barrier {0}: {1}")]
    Wrong(Name, &'static str),
}

impl Arrivals {
    /// Reads what a peer says. Allocates no more than the legal bounds, whatever lengths the bytes claim.
    pub(crate) fn parse(bytes: &[u8]) -> Result<Self, ArrivalsError> {
        let said: Self = sinew_runtime::wire::decode(bytes)?;
        let mut known = BTreeSet::new();
        for barrier in &said.barriers {
            if let Some(why) = barrier.fault() {
                return Err(ArrivalsError::Wrong(barrier.name.clone(), why));
            }
            let parties: Vec<&str> = barrier.parties.iter().map(Requirement::as_str).collect();
            if !known.insert((&barrier.name, parties)) {
                return Err(ArrivalsError::Wrong(barrier.name.clone(), "stands in it twice"));
            }
        }
        Ok(said)
    }

    pub(crate) fn encode(&self) -> Bytes {
        rmp_serde::to_vec_named(self).expect("maps of numbers and texts into memory cannot fail").into()
    }
}

impl BarrierSaid {
    fn fault(&self) -> Option<&'static str> {
        let mut parties = BTreeSet::new();
        let mut arrivals = self.arrivals.iter();
        if let Some(why) = fault_of_parties(&self.parties) {
            Some(why)
        } else if self.generation > GENERATION_MAX {
            Some("its generation is beyond 2^53")
        } else if !self.earlier.iter().all(|passed| (1..self.generation).contains(&passed.generation)) {
            Some("somebody has passed a generation earlier than the last that is none")
        } else if arrivals.clone().any(|arrival| arrival.after > self.generation) {
            Some("somebody waits behind a generation that its node does not know")
        } else if arrivals.any(|arrival| !parties.insert(arrival.party)) {
            Some("one party waits there twice")
        } else {
            None
        }
    }
}

/// What is wrong with the parties of a barrier, in words.
pub(crate) fn fault_of_parties(parties: &[Requirement]) -> Option<&'static str> {
    if parties.is_empty() {
        Some("it has no parties; name who has to be there, or `3 of *` for any three")
    } else if parties.iter().map(|party| party.as_str().len()).sum::<usize>() > PARTIES_BYTES_MAX {
        Some("its parties have more than 4,096 bytes together; use patterns or counts")
    } else if parties.iter().any(|party| party.wait_max().is_some()) {
        Some("a party of a barrier has no wait limit: whoever waits has one for all")
    } else if parties.iter().any(|party| party.phase().is_some()) {
        Some("a party of a barrier is in no phase: whoever arrives is there")
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

    fn said(change: impl FnOnce(&mut BarrierSaid)) -> Vec<u8> {
        let mut barrier = BarrierSaid {
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
    fn what_is_said_is_read_back() {
        let bytes = said(|_| {});
        assert_eq!(Arrivals::parse(&bytes).unwrap().encode(), bytes);
    }

    #[test]
    fn as_many_parties_as_can_pass_together_are_no_fault() {
        assert!(fault_of_parties(&[Requirement::at_least(ARRIVALS_MAX, ["*"])]).is_none());
    }

    #[test]
    fn what_no_node_can_mean_is_refused() {
        let wrong: [fn(&mut BarrierSaid); 12] = [
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
            assert!(Arrivals::parse(&said(change)).is_err());
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..256)) {
            drop(Arrivals::parse(&bytes));
        }

        #[test]
        fn damaged_bytes_are_read_or_refused(at in 0usize..200, byte in any::<u8>()) {
            let mut bytes = said(|_| {});
            let length = bytes.len();
            bytes[at % length] = byte;
            drop(Arrivals::parse(&bytes));
        }
    }
}
