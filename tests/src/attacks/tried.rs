//! The attacks on a node, one file each.

mod client;
mod connections;
mod credentials;
mod datagrams;
mod garbage;
mod guest;
mod handshakes;
mod slow_loris;
mod sources;

pub(super) use datagrams::{NOT_OURS, Recording, listen};

use std::collections::BTreeMap;

use super::{
    Attack, Happened, Scene,
    intruder::Intruder,
    keys::{KNEE, SPARE},
};

/// File descriptor limit of a node that is to run out of them: some 40 are its own.
const FEW: u32 = 96;

/// Common properties of most attacks.
const COMMON: Attack = Attack {
    name: "",
    tried: "",
    descriptors: None,
    records: false,
    others_come: false,
    inside: false,
    guests: false,
    intruder: None,
    own: SPARE,
    run: |_| Happened::new(String::new(), Vec::new()),
    goes_on: None,
};

/// Common properties of the attacks by guests.
const OF_GUEST: Attack = Attack { inside: true, guests: true, own: KNEE, ..COMMON };

/// The number of actions of one kind.
fn done(what: &'static str, count: u64) -> BTreeMap<&'static str, u64> {
    BTreeMap::from([(what, count)])
}

/// All attacks, the quietest first.
pub(super) const ATTACKS: &[Attack] = &[
    Attack {
        name: "wrong-authority",
        tried: "a whole node, and handshakes by hand, with certificates of another authority of the same project name",
        intruder: Some(Intruder::OfOthers),
        run: credentials::wrong_authority,
        ..COMMON
    },
    Attack {
        name: "no-certificate",
        tried: "a whole node without keys, handshakes of TLS without a certificate, and HELLO without TLS",
        intruder: Some(Intruder::WithoutKeys),
        run: credentials::none,
        ..COMMON
    },
    Attack {
        name: "stolen-certificate",
        tried: "a node's own certificate with HELLO of hip, of knee; a revoked one with its own HELLO",
        run: credentials::stolen,
        ..COMMON
    },
    Attack {
        name: "datagrams",
        tried: "all that three nodes said in discovery, to the group and to each other, sent again: of lives that are over, of those that last; \
                with a bit changed; and made up",
        records: true,
        others_come: true,
        run: datagrams::replayed_and_forged,
        ..COMMON
    },
    Attack {
        name: "forged-sources",
        tried: "on a link of its own, a stolen node sends messages in the name of hip and of knee",
        run: sources::forged,
        ..COMMON
    },
    Attack {
        name: "connections",
        tried: "up to 10,000 connections that say nothing",
        others_come: true,
        run: connections::ten_thousand,
        ..COMMON
    },
    Attack {
        name: "handshakes",
        tried: "as many beginnings of handshakes of TLS as go, none ended",
        others_come: true,
        run: handshakes::begun,
        ..COMMON
    },
    Attack {
        name: "slow-loris",
        tried: "256 connections that send a byte of a right handshake each 100 ms, and come again; 48 that are to be closed",
        others_come: true,
        run: slow_loris::drip,
        goes_on: Some(slow_loris::drip_from_many),
        ..COMMON
    },
    Attack {
        name: "garbage",
        tried: "random bytes by TCP and UDP as fast as they go",
        others_come: true,
        run: garbage::pour,
        ..COMMON
    },
    Attack {
        name: "local-client",
        tried: "hostile clients at the node's own door, in all ways that there are (`hostile_client`)",
        inside: true,
        own: KNEE,
        run: client::at_the_door,
        ..COMMON
    },
    Attack {
        name: "guest-groups",
        tried: "up to 64 clients of another user, whom the access list grants names and one group, join and leave that and others as fast as they can",
        run: guest::groups,
        ..OF_GUEST
    },
    Attack {
        name: "guest-memberships",
        tried: "the same user's clients ask to be in 256 groups each, at the lowest addresses, and those of two further users, whom the list grants all groups, \
                are in as many as they may, 512 each, while hip sends to a group of knee's at a high one",
        run: guest::memberships,
        ..OF_GUEST
    },
    Attack {
        name: "guest-barriers",
        tried: "the same user's clients arrive at barriers, each of another name, and wait a millisecond, while hip and knee meet at new ones of their own",
        run: guest::barriers,
        ..OF_GUEST
    },
    Attack {
        name: "guest-messages",
        tried: "the same user's clients send 1000 bytes to every application of every node, as fast as they can",
        run: guest::messages,
        ..OF_GUEST
    },
    Attack {
        name: "guest-connections",
        tried: "the same user connects and closes, and registers and leaves, as often as it can",
        run: guest::connections,
        ..OF_GUEST
    },
    Attack {
        name: "descriptors",
        tried: "connections that say nothing, to a node that has 96 descriptors and allows 1024 strangers",
        descriptors: Some(FEW),
        others_come: true,
        run: connections::until_none_are_left,
        ..COMMON
    },
];
