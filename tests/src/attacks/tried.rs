//! What is done to a node, one file each.

mod client;
mod connections;
mod credentials;
mod datagrams;
mod garbage;
mod handshakes;
mod slow_loris;
mod sources;

use super::{
    Attack, Happened, Scene,
    keys::{KNEE, SPARE},
};

/// Descriptors of a node that is to run out of them: some 40 are its own.
const FEW: u32 = 96;

/// All of them, the quietest first.
pub(super) const ATTACKS: &[Attack] = &[
    Attack {
        name: "wrong-authority",
        tried: "a whole node, and handshakes by hand, with certificates of another authority of the same project name",
        descriptors: None,
        others_come: false,
        own: SPARE,
        run: credentials::wrong_authority,
    },
    Attack {
        name: "no-certificate",
        tried: "handshakes of TLS without a certificate, and HELLO without TLS",
        descriptors: None,
        others_come: false,
        own: SPARE,
        run: credentials::none,
    },
    Attack {
        name: "stolen-certificate",
        tried: "a node's own certificate with HELLO of hip, of knee; a revoked one with its own HELLO",
        descriptors: None,
        others_come: false,
        own: SPARE,
        run: credentials::stolen,
    },
    Attack {
        name: "datagrams",
        tried: "recorded datagrams of discovery sent again, and with a bit changed, and made up",
        descriptors: None,
        others_come: true,
        own: SPARE,
        run: datagrams::replayed_and_forged,
    },
    Attack {
        name: "forged-sources",
        tried: "on a link of its own, a stolen node sends messages in the name of hip and of knee",
        descriptors: None,
        others_come: false,
        own: SPARE,
        run: sources::forged,
    },
    Attack {
        name: "connections",
        tried: "10,000 connections that say nothing",
        descriptors: None,
        others_come: true,
        own: SPARE,
        run: connections::ten_thousand,
    },
    Attack {
        name: "handshakes",
        tried: "as many beginnings of handshakes of TLS as go, none ended",
        descriptors: None,
        others_come: true,
        own: SPARE,
        run: handshakes::begun,
    },
    Attack {
        name: "slow-loris",
        tried: "256 connections that send a byte of a right handshake each 100 ms, and come again",
        descriptors: None,
        others_come: true,
        own: SPARE,
        run: slow_loris::drip,
    },
    Attack {
        name: "garbage",
        tried: "random bytes by TCP and UDP as fast as they go",
        descriptors: None,
        others_come: true,
        own: SPARE,
        run: garbage::pour,
    },
    Attack {
        name: "local-client",
        tried: "hostile clients at the node's own door, in all ways that there are (`hostile_client`)",
        descriptors: None,
        others_come: false,
        own: KNEE,
        run: client::at_the_door,
    },
    Attack {
        name: "descriptors",
        tried: "connections that say nothing, to a node that has 96 descriptors",
        descriptors: Some(FEW),
        others_come: true,
        own: SPARE,
        run: connections::ten_thousand,
    },
];
