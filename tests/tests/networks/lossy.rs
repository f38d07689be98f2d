//! Two nodes with random datagram loss between them. Of class Stream the newest value wins and the last one
//! arrives. Messages of class Control arrive once and in order. No node counts as lost.

use std::{
    net::{SocketAddr, SocketAddrV4},
    num::NonZeroU32,
};

use sinew::message::Sender;
use sinew::prelude::*;
use sinew_testkit::{
    DEADLINE, Log, all_run,
    network::{FaultyNetwork, Listener, Side},
    scripted::{Order, Script, Seen, Value, sender_app, wait},
    until,
};

/// Rounds; after the last value of each there is a pause without newer ones.
const ROUNDS: u64 = 30;
/// Values of a round, one each millisecond.
const VALUES: u64 = 50;
/// Numbers of values are above this, those of orders below.
const ABOVE: u64 = 1 << 32;

/// The proxies, each for connections and datagrams: to the first node's GNCL, to the second's, and to the
/// second's NDL.
const TO_FIRST: [usize; 2] = [0, 1];
const TO_SECOND: [usize; 2] = [2, 3];
const TO_SECOND_NDL: usize = 4;

fn v4(address: SocketAddr) -> SocketAddrV4 {
    match address {
        SocketAddr::V4(address) => address,
        SocketAddr::V6(_) => panic!("{address} is of this host's loopback"),
    }
}

/// Proxies at two ports, each of which is free for connections and for datagrams.
fn network(seed: u64) -> FaultyNetwork {
    let listener =
        |side, port, datagrams| Listener { side, listen: ([127, 0, 0, 1], port).into(), datagrams };
    until("two free ports", || {
        let [first, second] = [(); 2].map(|()| {
            let free = std::net::TcpListener::bind("127.0.0.1:0").expect("a port on loopback");
            free.local_addr().expect("it is bound").port()
        });
        let pair = |side, port| [listener(side, port, false), listener(side, port, true)];
        let listeners =
            [pair(Side::Left, first), pair(Side::Right, second), [listener(Side::Right, 0, true); 2]]
                .concat();
        FaultyNetwork::start(&listeners[..=TO_SECOND_NDL], seed).ok()
    })
}

/// Two nodes that reach each other only over this network.
struct Pair {
    network: FaultyNetwork,
    sender: Sender,
    /// Messages that the application of the second node received.
    got: Log<Seen>,
    /// Events that each node received about the other.
    seen: [Log<Seen>; 2],
    nodes: [Node; 2],
}

impl Pair {
    fn start(seed: u64) -> Self {
        let network = network(seed);
        let node = |name: &str, number: u8, [announce, _]: [usize; 2], seeds: Vec<SocketAddr>| {
            Node::builder(name).address([127, 0, 0, number]).configure(|config| {
                config.project = "lossy".to_owned();
                config.gncl.announce = Some(v4(network.address(announce)));
                (config.ndl.multicast, config.ndl.mdns_port) = (None, None);
                config.ndl.seeds = seeds.into_iter().map(Into::into).collect();
            })
        };
        let listener = |name| Script::new().app(name);
        let ((sink, got), (second_hears, second_seen)) = (listener("sink"), listener("second hears"));
        let second = node("second", 2, TO_SECOND, Vec::new()).app(sink);
        let second = second.app(second_hears.handles::<NodeEvent>()).start().expect("a node");
        let at = |address: Option<SocketAddr>| address.expect("its layers are ready");
        network.set_destination(TO_SECOND_NDL, at(second.handle().ndl_address()));
        TO_SECOND
            .into_iter()
            .for_each(|listener| network.set_destination(listener, at(second.handle().gncl_address())));
        let ((sender_app, key), (first_hears, first_seen)) = (sender_app("sender"), listener("first hears"));
        let first = node("first", 1, TO_FIRST, vec![network.address(TO_SECOND_NDL)]);
        let first = first.app(sender_app).app(first_hears.handles::<NodeEvent>().requires(["sink"]));
        let first = first.start().expect("a node");
        TO_FIRST
            .into_iter()
            .for_each(|listener| network.set_destination(listener, at(first.handle().gncl_address())));
        all_run(&[&first, &second]);
        let seen = [first_seen, second_seen];
        Self { network, sender: key.sender(), got, seen, nodes: [first, second] }
    }

    fn lose_one_in(&self, count: u32) {
        for side in [Side::Left, Side::Right] {
            self.network.change(side, |faults| faults.one_loss_in = NonZeroU32::new(count));
        }
    }

    /// Sends a round of values, and an order with the first of them; returns when the last one has arrived.
    fn round(&self, round: u64) {
        let confirmation =
            self.sender.message("sink", &Order { number: round }).confirmed(DEADLINE).expect("it has room");
        let first = ABOVE + round * VALUES;
        for number in first..first + VALUES {
            self.sender.send("sink", &Value { number }).expect("the newest one has room");
            // The rate of a control loop.
            std::thread::sleep(Duration::from_millis(1));
        }
        self.got.wait_for(Seen::Got(1, first + VALUES - 1));
        assert_eq!(wait(confirmation), Outcome::Delivered, "of {round}");
    }

    fn numbers(&self) -> Vec<u64> {
        let number = |seen: &Seen| if let Seen::Got(1, number) = seen { Some(*number) } else { None };
        self.got.all().iter().filter_map(number).collect()
    }
}

fn values_arrive_where_one_is_lost_of(count: u32) {
    let pair = Pair::start(u64::from(count));
    pair.lose_one_in(count);
    (0..ROUNDS).for_each(|round| pair.round(round));
    let (values, orders): (Vec<_>, Vec<_>) = pair.numbers().into_iter().partition(|number| *number >= ABOVE);
    assert!(
        values.is_sorted_by(|before, next| before < next),
        "an older one follows a newer one: {values:?}"
    );
    assert_eq!(orders, (0..ROUNDS).collect::<Vec<_>>(), "once and in order");
    let lost = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::NodeLost { .. }));
    for seen in &pair.seen {
        assert!(!seen.all().iter().any(lost), "{:?}", seen.all());
    }
    // More than NDL alone sends in that time.
    assert!(pair.network.counts().lost > 5, "values went by datagram: {:?}", pair.network.counts());
    let audit = pair.nodes[0].handle().audit(DEADLINE).expect("nobody else asks");
    assert_eq!(audit.missing(), 0, "{audit}");
}

#[test]
fn one_percent_loss_keeps_the_newest_value() {
    values_arrive_where_one_is_lost_of(100);
}

#[test]
fn five_percent_loss_keeps_the_newest_value() {
    values_arrive_where_one_is_lost_of(20);
}
