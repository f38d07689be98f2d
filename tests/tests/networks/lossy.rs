//! Two nodes between which datagrams are lost by chance: values of class Stream, newest wins and the last one comes, messages of class Control
//! once and in order, and nobody is taken for lost.

use std::{
    net::{SocketAddr, SocketAddrV4},
    num::NonZeroU32,
};

use sinew::message::Sender;
use sinew::prelude::*;
use sinew_tests::{
    DEADLINE, Log, all_run,
    proxy::{Door, Proxy, Side},
    puppet::{Order, Seen, Stage, Value, desk, wait},
    until,
};

/// Rounds, at the end of each of which nothing newer follows.
const ROUNDS: u64 = 30;
/// Values of a round, one a millisecond.
const VALUES: u64 = 50;
/// What a value's number is above: those of orders are below.
const ABOVE: u64 = 1 << 32;

/// The doors, each for connections and datagrams: to the first node's GNCL, to the second's, and to the second's NDL.
const TO_FIRST: [usize; 2] = [0, 1];
const TO_SECOND: [usize; 2] = [2, 3];
const TO_SECOND_NDL: usize = 4;

fn v4(address: SocketAddr) -> SocketAddrV4 {
    match address {
        SocketAddr::V4(address) => address,
        SocketAddr::V6(_) => panic!("{address} is of this host's loopback"),
    }
}

/// Doors at two ports that each are free for connections and for datagrams.
fn network(seed: u64) -> Proxy {
    let door = |side, port, datagrams| Door { side, listen: ([127, 0, 0, 1], port).into(), datagrams };
    until("two free ports", || {
        let [first, second] = [(); 2].map(|()| {
            let free = std::net::TcpListener::bind("127.0.0.1:0").expect("a port on loopback");
            free.local_addr().expect("it is bound").port()
        });
        let pair = |side, port| [door(side, port, false), door(side, port, true)];
        let doors =
            [pair(Side::Left, first), pair(Side::Right, second), [door(Side::Right, 0, true); 2]].concat();
        Proxy::start(&doors[..=TO_SECOND_NDL], seed).ok()
    })
}

/// Two nodes that reach each other over the network alone.
struct Pair {
    network: Proxy,
    sender: Sender,
    /// What the application of the second node has got.
    got: Log<Seen>,
    /// What both heard of each other.
    heard: [Log<Seen>; 2],
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
        let listener = |name| Stage::new().app(name);
        let ((sink, got), (second_hears, second_heard)) = (listener("sink"), listener("second hears"));
        let second = node("second", 2, TO_SECOND, Vec::new()).app(sink);
        let second = second.app(second_hears.handles::<NodeEvent>()).start().expect("a node");
        let at = |address: Option<SocketAddr>| address.expect("its layers are ready");
        network.lead(TO_SECOND_NDL, at(second.handle().ndl_address()));
        TO_SECOND.into_iter().for_each(|door| network.lead(door, at(second.handle().gncl_address())));
        let ((desk, key), (first_hears, first_heard)) = (desk("desk"), listener("first hears"));
        let first = node("first", 1, TO_FIRST, vec![network.address(TO_SECOND_NDL)]);
        let first = first.app(desk).app(first_hears.handles::<NodeEvent>().requires(["sink"]));
        let first = first.start().expect("a node");
        TO_FIRST.into_iter().for_each(|door| network.lead(door, at(first.handle().gncl_address())));
        all_run(&[&first, &second]);
        let heard = [first_heard, second_heard];
        Self { network, sender: key.sender(), got, heard, nodes: [first, second] }
    }

    fn lose_one_in(&self, count: u32) {
        for side in [Side::Left, Side::Right] {
            self.network.change(side, |faults| faults.one_loss_in = NonZeroU32::new(count));
        }
    }

    /// Sends a round of values, and an order with the first of them; returns when the last one has come.
    fn round(&self, round: u64) {
        let confirmation =
            self.sender.message("sink", &Order { number: round }).confirmed(DEADLINE).expect("it has room");
        let first = ABOVE + round * VALUES;
        for number in first..first + VALUES {
            self.sender.send("sink", &Value { number }).expect("the newest one has room");
            // The pace of a control loop.
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
    for heard in &pair.heard {
        assert!(!heard.all().iter().any(lost), "{:?}", heard.all());
    }
    // More than NDL alone says in that time.
    assert!(pair.network.counts().lost > 5, "values went by datagram: {:?}", pair.network.counts());
    let audit = pair.nodes[0].handle().audit(DEADLINE).expect("nobody else asks");
    assert_eq!(audit.missing(), 0, "{audit}");
}

#[test]
fn with_one_datagram_in_a_hundred_lost_the_newest_value_wins_and_the_last_one_comes() {
    values_arrive_where_one_is_lost_of(100);
}

#[test]
fn with_one_datagram_in_twenty_lost_the_newest_value_wins_and_the_last_one_comes() {
    values_arrive_where_one_is_lost_of(20);
}
