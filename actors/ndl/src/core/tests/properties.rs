//! Properties that hold for any input.

use std::{
    collections::BTreeMap,
    net::{IpAddr, Ipv4Addr, SocketAddr},
};

use proptest::prelude::*;
use sinew_model::facts::{LinkFact, MembershipFact};
use sinew_runtime::{tid::Incarnation, time::Time};

use super::{
    scenarios::stranger,
    world::{Spec, ms, udp},
};
use crate::{
    core::{Cast, Core, Input, Output, Place, Query, RememberedPeer, Source, contact::Role},
    datagram::{Announcement, Answer},
};

/// This node's addresses.
const PATHS: [SocketAddr; 2] = [path(0), path(1)];

const fn path(network: u8) -> SocketAddr {
    SocketAddr::new(IpAddr::V4(Ipv4Addr::new(10, network, 0, 9)), 1_000)
}

/// Anything that can reach a core, in any order.
fn any_input() -> impl Strategy<Value = (u64, Input)> {
    let place = || {
        (1u16..6, 0..2u16)
            .prop_map(|(there, here)| Place { there: udp(there), here: PATHS[usize::from(here)] })
    };
    let ndl = proptest::collection::vec((Just(0x0a00_0001), 1_001..1_006_u16), 0..4);
    let announcement =
        (1u32..6, 0u64..4, 0u64..4, ndl).prop_map(|(address, incarnation, boot_nonce, ndl)| Announcement {
            incarnation: Incarnation(incarnation),
            boot_nonce,
            ndl,
            ..stranger(address)
        });
    let input = (place(), announcement, 0..8, any::<bool>()).prop_map(|(from, announcement, what, flag)| {
        let Announcement { node, incarnation, .. } = announcement;
        match what {
            0 => {
                let cast = if flag { Cast::Unicast } else { Cast::Multicast };
                Input::QueryReceived(Query { from, cast, correlation: 1, sent: Time::ZERO, announcement })
            }
            1 | 2 => {
                let answer = Answer {
                    announcement,
                    query_sent_ns: 0,
                    query_received_ns: 0,
                    progress: Default::default(),
                };
                Input::AnswerReceived { from, correlation: 0, sent: Time::ZERO, answer }
            }
            3 => Input::LeaveReceived { from, leave: announcement.into() },
            4 => Input::AddressNamed { source: Source::Mdns, address: from.there },
            5 if flag => Input::Link(LinkFact::LinkBroken { node, incarnation }),
            5 => Input::Link(LinkFact::DialRefused { node, incarnation }),
            7 => Input::PeersRemembered(vec![RememberedPeer { address: from.there, node, unanswered: 7 }]),
            6 if flag => Input::HintReceived { node, incarnation, at: Time::from_nanos(1) },
            _ => Input::TimePassed,
        }
    });
    (0u64..700, input)
}

/// Turns an answer into one to a query that was really sent, if there is one.
fn to_a_question(core: &Core, mut input: Input) -> Input {
    if let Input::AnswerReceived { from, correlation, .. } = &mut input
        && let Some(question) = core.contacts.get(from).and_then(|contact| contact.queries.newest())
    {
        *correlation = question.correlation;
    }
    input
}

proptest! {
    /// For any inputs, layers receive each incarnation once, found before lost; tables agree; the bounds hold.
    #[test]
    fn facts_alternate_and_tables_agree(inputs in proptest::collection::vec(any_input(), 1..200)) {
        let mut core = Spec { nodes_max: 3, ..Spec::of(1) }.core(99);
        let mut now = Time::from_nanos(1_000_000_000);
        core.start(now, &PATHS);
        let mut there = BTreeMap::new();
        for (gap, input) in inputs {
            now = now + ms(gap);
            let input = to_a_question(&core, input);
            if gap < 20 {
                // An address is removed, and returns.
                core.use_paths(now, &PATHS[..gap as usize % 3]);
            }
            core.handle(now, input);
            while let Some(output) = core.poll() {
                match output {
                    Output::Fact(MembershipFact::NodeFound { node, incarnation, .. }) => {
                        prop_assert_eq!(there.insert(node, incarnation), None);
                    }
                    Output::Fact(MembershipFact::NodeLost { node, incarnation, .. }) => {
                        prop_assert_eq!(there.remove(&node), Some(incarnation));
                    }
                    Output::AddressTaken { .. } => {
                        core.start(now, &PATHS);
                    }
                    Output::SendQuery { .. } | Output::SendMulticastQuery { .. } | Output::SendAnswer { .. }
                    | Output::SendLeave { .. } | Output::Event { .. } | Output::ClockMeasured { .. }
                    | Output::Moved { .. } | Output::Forgotten { .. } | Output::Collision { .. } | Output::Stalled { .. } | Output::Probe { .. }
                    | Output::RequestLiveness { .. } => {}
                }
            }
            prop_assert!(core.members.keys().eq(there.keys()));
            prop_assert!(core.members.len() <= 3 && core.departed.len() <= 3 && core.contacts.len() <= 3 + 3 * 2 * 8 * 2);
            // This asserts that they are counted right.
            prop_assert!(core.contacts.candidates() <= core.contacts.len());
            prop_assert!(core.contacts.keys().all(|place| core.paths().contains(&place.here)));
            prop_assert!(core.conflicts.keys().all(|node| core.members.contains_key(node)));
            prop_assert!(core.members.keys().all(|node| !core.departed.contains_key(node)));
            for (node, member) in core.members.iter() {
                for place in member.routes.places() {
                    let role = core.contacts.get(&place).map(|contact| contact.role);
                    prop_assert_eq!(role, Some(Role::Member(*node)));
                }
            }
            prop_assert!(core.next_wake().is_some());
        }
    }
}
