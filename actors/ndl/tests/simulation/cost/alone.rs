//! One core alone in this process, among puppets that send queries and answers as nodes do.
//!
//! If a thousand cores share the memory of one process, each datagram finds the data of its core in no cache. On a host
//! of its own the core stays in the caches; so its cost is measured here.

use std::{
    hint::black_box,
    net::{Ipv4Addr, SocketAddr, SocketAddrV4},
    time::Duration,
};

use bytes::BytesMut;
use sinew_model::{config::NodeConfig, progress::Progress};
use sinew_ndl::{
    core::{Cast, Core, Input, Output, Place},
    datagram::{Announcement, Answer, Body, Claim, Datagram, encode},
};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::super::{network::node_address, world::on_the_cpu};

const PORT: u16 = 7_400;
/// Puppets that send queries at about the same time.
const AT_ONCE: usize = 16;
/// Time on the network for a round trip.
const ROUND_TRIP: Duration = Duration::from_micros(200);

fn at(node: usize) -> SocketAddr {
    (Ipv4Addr::from(node_address(node).bits()), PORT).into()
}

/// A datagram from a puppet to the core.
struct Coming {
    place: Place,
    cast: Cast,
    bytes: BytesMut,
}

/// The core, and all puppets.
pub(super) struct Alone {
    core: Core,
    puppets: Vec<Announcement>,
    now: Time,
    queries: u64,
    /// Time used by the core, including reading and writing datagrams.
    pub(super) in_core: Duration,
    /// The datagrams that it has read and written.
    pub(super) datagrams: u64,
}

impl Alone {
    /// Creates a core among this many nodes, including itself, that all know each other.
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
        let mut alone = Self { core, puppets, now, queries: 0, in_core: Duration::ZERO, datagrams: 0 };
        // The budget limits the number of strangers that are accepted per second.
        let is_known = (0..100).any(|_| {
            alone.play_a_period();
            alone.core.members(alone.now).len() == nodes - 1
        });
        assert!(is_known, "all are known within a hundred periods");
        (alone.in_core, alone.datagrams) = (Duration::ZERO, 0);
        alone
    }

    /// The core queries every puppet and receives the answers; then each puppet queries the core, and the group.
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
            let queries: Vec<_> = asking
                .flat_map(|puppet| [Cast::Unicast, Cast::Multicast].map(|cast| (puppet, cast)))
                .collect();
            let queries = queries.into_iter().map(|(puppet, cast)| self.query(puppet, cast)).collect();
            let ordered = self.reads(queries);
            self.answer(ordered);
        }
    }

    fn query(&mut self, puppet: usize, cast: Cast) -> Coming {
        self.queries += 1;
        let body = Body::Query(self.puppets[puppet].clone());
        let datagram = Datagram { correlation: self.queries, sent: self.now, body };
        let bytes = encode(&datagram, NodeAddress::ALL);
        Coming { place: Place { there: at(puppet + 1), here: at(0) }, cast, bytes }
    }

    /// Answers all queries of the core, including those that it sends meanwhile.
    fn answer(&mut self, mut ordered: Vec<Output>) {
        loop {
            let sent = self.now;
            let answers: Vec<Coming> = ordered
                .iter()
                .filter_map(|output| {
                    let Output::SendQuery { to, correlation } = *output else { return None };
                    let SocketAddr::V4(there) = to.there else { return None };
                    let puppet = (there.ip().to_bits() - node_address(1).bits()) as usize;
                    let answer = Answer {
                        announcement: self.puppets[puppet].clone(),
                        query_sent_ns: sent.as_nanos(),
                        query_received_ns: (sent + ROUND_TRIP / 2).as_nanos(),
                        progress: Progress::default(),
                    };
                    let answered = sent + ROUND_TRIP / 2;
                    let datagram = Datagram { correlation, sent: answered, body: Body::Answer(answer) };
                    let bytes = encode(&datagram, node_address(0));
                    Some(Coming { place: to, cast: Cast::Unicast, bytes })
                })
                .collect();
            if answers.is_empty() {
                return;
            }
            self.now = sent + ROUND_TRIP;
            ordered = self.reads(answers);
        }
    }

    fn reads(&mut self, coming: Vec<Coming>) -> Vec<Output> {
        self.datagrams += coming.len() as u64;
        self.takes(|core, now| {
            for Coming { place, cast, bytes } in &coming {
                core.receive(now, *place, *cast, bytes);
            }
        })
    }

    /// Runs the core, and the writes of the shell for it: all that is measured. A profiler finds it by this name.
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

    /// Writes an output as the shell does.
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
