//! One core alone in this process, among puppets that ask and answer as nodes do.
//!
//! Where a thousand cores share the memory of one process, each datagram finds another one's in no cache. On a host of its own a core is
//! what the caches hold; so its cost is taken here.

use std::{
    hint::black_box,
    net::{Ipv4Addr, SocketAddr, SocketAddrV4},
    time::Duration,
};

use bytes::BytesMut;
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::super::world::{node_address, on_the_cpu};
use crate::{
    config::NodeConfig,
    ndl::{
        Progress,
        core::{Core, Input, Output, Place, Way},
        datagram::{Announcement, Answer, Body, Claim, Datagram, encode},
    },
};

const PORT: u16 = 7_400;
/// Puppets that ask at about the same time.
const AT_ONCE: usize = 16;
/// Time on the network, there and back.
const ROUND_TRIP: Duration = Duration::from_micros(200);

fn at(node: usize) -> SocketAddr {
    (Ipv4Addr::from(node_address(node).bits()), PORT).into()
}

/// What comes to the core from a puppet.
struct Coming {
    place: Place,
    way: Way,
    bytes: BytesMut,
}

/// The core, and all others.
pub(super) struct Alone {
    core: Core,
    puppets: Vec<Announcement>,
    now: Time,
    questions: u64,
    /// Time that the core has taken, reading and writing of datagrams included.
    pub(super) in_core: Duration,
    /// Those that it has read and written.
    pub(super) datagrams: u64,
}

impl Alone {
    /// A core among so many nodes, itself included, that all know each other.
    pub(super) fn among(nodes: usize, period: Duration) -> Self {
        let mut config = NodeConfig::new("node-0");
        (config.ndl.period, config.ndl.nodes_max) = (period, 64.max(nodes + 16));
        let mut core = Core::new(&config, node_address(0), Incarnation(1), 1, 1);
        core.announce_gncl((vec![SocketAddrV4::new(Ipv4Addr::from(node_address(0).bits()), 5_000)], None));
        let puppet = |node: usize| Announcement {
            project: config.project.clone(),
            node: node_address(node),
            name: format!("node-{node}"),
            incarnation: Incarnation(node as u64 + 1),
            boot_nonce: node as u64 + 1,
            gncl_ip: node_address(node).bits(),
            gncl_port: 5_000,
            period_us: core.announcement().period_us,
            gncl_further: Vec::new(),
            ndl: Vec::new(),
            ndl6: Vec::new(),
            gncl_port6: 0,
            claim: Claim::Held,
        };
        let puppets = (1..nodes).map(puppet).collect();
        let now = Time::from_nanos(1_000_000_000_000);
        core.start(now, &[at(0)]);
        let mut alone = Self { core, puppets, now, questions: 0, in_core: Duration::ZERO, datagrams: 0 };
        // No more strangers are listened to in a second than have a budget.
        let is_known = (0..100).any(|_| {
            alone.play_a_period();
            alone.core.members(alone.now).len() == nodes - 1
        });
        assert!(is_known, "all are known within a hundred periods");
        (alone.in_core, alone.datagrams) = (Duration::ZERO, 0);
        alone
    }

    /// The core asks everybody and has the answers; then each puppet asks it, and the group.
    pub(super) fn play_a_period(&mut self) {
        let begun = self.core.next_wake().expect("it runs");
        self.now = begun;
        let ordered = self.takes(|core, now| core.handle(now, Input::TimePassed));
        self.answer(ordered);
        let period = Duration::from_micros(self.core.announcement().period_us.into());
        let groups = u32::try_from(self.puppets.len().div_ceil(AT_ONCE)).expect("few nodes");
        for (group, first) in (0_u32..).zip((0..self.puppets.len()).step_by(AT_ONCE)) {
            self.now = begun + period / 10 + period * 8 / 10 * group / groups;
            let asking = first..self.puppets.len().min(first + AT_ONCE);
            let asked: Vec<_> =
                asking.flat_map(|puppet| [Way::Unicast, Way::Multicast].map(|way| (puppet, way))).collect();
            let asked = asked.into_iter().map(|(puppet, way)| self.question(puppet, way)).collect();
            let ordered = self.reads(asked);
            self.answer(ordered);
        }
    }

    fn question(&mut self, puppet: usize, way: Way) -> Coming {
        self.questions += 1;
        let body = Body::Query(self.puppets[puppet].clone());
        let datagram = Datagram { correlation: self.questions, sent: self.now, body };
        let bytes = encode(&datagram, NodeAddress::ALL);
        Coming { place: Place { there: at(puppet + 1), here: at(0) }, way, bytes }
    }

    /// All that the core asked is answered, and what it asks then.
    fn answer(&mut self, mut ordered: Vec<Output>) {
        loop {
            let asked = self.now;
            let answers: Vec<Coming> = ordered
                .iter()
                .filter_map(|output| {
                    let Output::SendQuery { to, correlation } = *output else { return None };
                    let SocketAddr::V4(there) = to.there else { return None };
                    let puppet = (there.ip().to_bits() - node_address(1).bits()) as usize;
                    let answer = Answer {
                        announcement: self.puppets[puppet].clone(),
                        query_sent_ns: asked.as_nanos(),
                        query_received_ns: (asked + ROUND_TRIP / 2).as_nanos(),
                        progress: Progress::default(),
                    };
                    let sent = asked + ROUND_TRIP / 2;
                    let datagram = Datagram { correlation, sent, body: Body::Answer(answer) };
                    let bytes = encode(&datagram, node_address(0));
                    Some(Coming { place: to, way: Way::Unicast, bytes })
                })
                .collect();
            if answers.is_empty() {
                return;
            }
            self.now = asked + ROUND_TRIP;
            ordered = self.reads(answers);
        }
    }

    fn reads(&mut self, coming: Vec<Coming>) -> Vec<Output> {
        self.datagrams += coming.len() as u64;
        self.takes(|core, now| {
            for Coming { place, way, bytes } in &coming {
                core.receive(now, *place, *way, bytes);
            }
        })
    }

    /// What the core does, and what the shell writes for it: all that is counted. By this name a profiler finds it.
    #[inline(never)]
    fn takes(&mut self, act: impl FnOnce(&mut Core, Time)) -> Vec<Output> {
        let began = on_the_cpu();
        act(&mut self.core, self.now);
        let ordered: Vec<Output> = std::iter::from_fn(|| self.core.poll()).collect();
        for output in &ordered {
            self.datagrams += u64::from(self.writes(output));
        }
        self.in_core += on_the_cpu().saturating_sub(began);
        ordered
    }

    /// As the shell does.
    fn writes(&self, output: &Output) -> bool {
        let me = self.core.announcement();
        let (body, to, correlation) = if let Output::SendQuery { correlation, .. }
        | Output::SendMulticastQuery { correlation, .. } = *output
        {
            (Body::Query(me.clone()), NodeAddress::ALL, correlation)
        } else if let Output::SendAnswer { node, correlation, query_sent, query_received, .. } = *output {
            let (query_sent_ns, query_received_ns) = (query_sent.as_nanos(), query_received.as_nanos());
            let progress = self.core.progress().clone();
            let answer = Answer { announcement: me.clone(), query_sent_ns, query_received_ns, progress };
            (Body::Answer(answer), node, correlation)
        } else {
            return false;
        };
        black_box(encode(&Datagram { correlation, sent: self.now, body }, to));
        true
    }
}
