//! Fuzzing of the core: arbitrary handshake payloads, and arbitrary histories of connections and peers.

use std::collections::BTreeSet;

use sinew_runtime::fuzzing::{Script, is_read_as_written};

use super::*;

const STRANGERS_MAX: usize = 3;
const PEERS_MAX: usize = 4;
/// Maximum number of addresses of a peer that are dialled at once, as many as its announcement may have.
const ADDRESSES: usize = 3;

/// A peer that NDL finds is dialled, sends WELCOME and PING, and its connection ends.
pub const A_LINK: &[u8] = &[0, 1, 1, 1, 2, 4, 0, 6, 0, 1, 1, 1, 0, 0, 31, 11, 0, 3, 1, 12, 0, 15, 9, 15, 200];

pub fn handshakes() -> Vec<Vec<u8>> {
    let hello = Introduction { peer: ours().node, node: NodeAddress::new(2), ..ours() };
    let refusal = RefusalError::TooLate.to_refusal();
    vec![write(&hello).to_vec(), write(&refusal).to_vec()]
}

pub fn handshake(bytes: &[u8]) -> bool {
    if let Err(decline) = read::<Introduction>(bytes) {
        assert_eq!(decline.cause(), "violation");
    }
    if let Ok(hello) = read::<Introduction>(bytes) {
        for come in [Input::HelloReceived, Input::WelcomeReceived] {
            let mut core = Core::new(settings(), 7);
            let stranger = core.open();
            core.handle(Time::ZERO, Input::Accepted(stranger, IpAddr::from([10, 0, 0, 9])));
            core.handle(Time::ZERO, come(stranger, hello.clone()));
            while core.poll().is_some() {}
        }
    }
    if let Ok(refusal) = read::<Refusal>(bytes) {
        let mut core = Core::new(settings(), 7);
        let stranger = core.open();
        core.handle(Time::ZERO, Input::Accepted(stranger, IpAddr::from([10, 0, 0, 9])));
        core.handle(Time::ZERO, Input::RefusalReceived(stranger, refusal));
        while core.poll().is_some() {}
    }
    let is_hello = is_read_as_written::<Introduction>(bytes);
    is_read_as_written::<Refusal>(bytes) || is_hello
}

fn ours() -> Introduction {
    Introduction {
        project: "exo".to_owned(),
        node: NodeAddress::new(5),
        name: "knee".to_owned(),
        incarnation: Incarnation(9),
        peer: NodeAddress::HERE,
        dial: 0,
        payload_max: 1 << 20,
        answers_max: 8_192,
        features: [CLASSES, CANCEL, GUARD, OUTCOMES, OUTCOME_RUNS, DATAGRAMS, UNDELIVERED]
            .map(str::to_owned)
            .into(),
        lane: Lane::Control,
        link: 0,
        datagrams_made: 0,
    }
}

fn settings() -> Settings {
    Settings {
        ours: ours(),
        handshake: Duration::from_millis(100),
        redial_min: Duration::from_millis(10),
        redial_max: Duration::from_secs(1),
        strangers_max: STRANGERS_MAX,
        peers_max: PEERS_MAX,
        ping_period: Duration::from_millis(100),
        idle_ping_delay: Duration::from_secs(1),
        pings_missed_max: 3,
        healthy: Duration::from_secs(1),
        orphan: Duration::from_secs(1),
        connections_authenticate: false,
    }
}

/// Plays a history. Returns whether any link was established in it.
pub fn links(script: &[u8]) -> bool {
    let mut play = Play {
        script: Script::new(script),
        core: Core::new(settings(), 7),
        now: Time::from_nanos(1_000_000_000),
        connections: Vec::new(),
        over: BTreeSet::new(),
        has_linked: false,
    };
    while !play.script.is_over() {
        let input = play.input();
        play.core.handle(play.now, input);
        play.check();
    }
    play.has_linked
}

struct Play<'a> {
    script: Script<'a>,
    core: Core,
    now: Time,
    /// All connections that were opened, the latest last.
    connections: Vec<ConnectionId>,
    /// Connections that are closed and forgotten.
    over: BTreeSet<ConnectionId>,
    has_linked: bool,
}

impl Play<'_> {
    fn input(&mut self) -> Input {
        match self.script.byte() % 17 {
            0 => {
                let (node, incarnation) = self.node_incarnation();
                let port = u16::from(self.script.byte());
                let count = 1 + usize::from(self.script.byte()) % ADDRESSES;
                let address = |at: usize| SocketAddr::from(([10, 0, 0, at as u8], port));
                Input::NodeFound { node, incarnation, addresses: (0..count).map(address).collect() }
            }
            1 => self.of_incarnation(|node, incarnation| Input::NodeLost { node, incarnation }),
            2 => self.of_incarnation(|node, incarnation| Input::NodeDisowned { node, incarnation }),
            3 => self.of_incarnation(|node, incarnation| Input::NodeLeaves { node, incarnation }),
            4 => Input::Connected(self.connection()),
            5 => {
                let refused = self.script.byte() & 1 == 1;
                Input::DialFailed { connection: self.connection(), refused }
            }
            6 => Input::WelcomeReceived(self.connection(), self.introduction()),
            7 => Input::HelloReceived(self.connection(), self.introduction()),
            8 => {
                let refusal = Refusal { cause: "duplicate".to_owned(), sentence: "no".to_owned() };
                Input::RefusalReceived(self.connection(), refusal)
            }
            9 => Input::FramesReceived(self.connection(), self.now),
            10 => Input::TrafficSeen(self.connection()),
            11 => Input::PingReceived(self.connection()),
            12 => Input::Ended(self.connection()),
            13 => match self.script.byte() % 8 {
                0 => Input::LeaveRequested { undelivered_to: vec![self.node_incarnation().0] },
                1 => Input::Starved,
                2 => Input::PongReceived(self.connection()),
                3 => Input::GoodbyeReceived(self.connection()),
                4 => Input::Violated(self.connection(), RefusalError::TooLate),
                5 => self.of_incarnation(|node, incarnation| Input::Restored { node, incarnation }),
                _ => self.pass(Duration::from_secs(5)),
            },
            14 => {
                let stranger = self.core.open();
                self.connections.push(stranger);
                Input::Accepted(stranger, IpAddr::from([10, 0, 0, stranger.0 as u8 % 4]))
            }
            15 => {
                let millis = self.script.byte();
                self.pass(Duration::from_millis(millis.into()))
            }
            _ => {
                // The shell does the same: it sleeps until there is something to do.
                let wake = self.core.next_wake().unwrap_or(self.now);
                self.now = self.now.max(wake);
                Input::TimePassed
            }
        }
    }

    fn pass(&mut self, time: Duration) -> Input {
        self.now = self.now + time;
        Input::TimePassed
    }

    fn node_incarnation(&mut self) -> (NodeAddress, Incarnation) {
        let node = match self.script.byte() % 8 {
            7 => NodeAddress::ALL,
            number => NodeAddress::new(number.into()),
        };
        (node, Incarnation(self.script.number()))
    }

    fn of_incarnation(&mut self, input: impl FnOnce(NodeAddress, Incarnation) -> Input) -> Input {
        let (node, incarnation) = self.node_incarnation();
        input(node, incarnation)
    }

    /// Returns one of the opened connections, counted from the latest. A shell reports no input about a
    /// connection that it was ordered to close.
    fn connection(&mut self) -> ConnectionId {
        let back = usize::from(self.script.byte());
        let at = self.connections.len().checked_sub(1 + back % self.connections.len().max(1));
        let connection = at.map_or(ConnectionId(0), |at| self.connections[at]);
        if self.over.contains(&connection) { ConnectionId(0) } else { connection }
    }

    fn introduction(&mut self) -> Introduction {
        let (node, incarnation) = self.node_incarnation();
        let (dial, link, bits) = (self.script.number(), self.script.byte(), self.script.byte());
        let abilities =
            [CLASSES, CANCEL, GUARD, OUTCOMES, DATAGRAMS, UNDELIVERED, OUTCOME_RUNS].into_iter().enumerate();
        let has = |at: usize| bits & (1 << at) != 0;
        // A peer knows the number of an established link.
        let number = self.core.peers.get(&node).and_then(|peer| peer.link).map(|link| link.dial);
        Introduction {
            node,
            incarnation,
            dial,
            link: number.filter(|_| link < 0x80).unwrap_or_else(|| link.into()),
            peer: if has(7) { node } else { ours().node },
            lane: Lane::ALL[usize::from(bits >> 5) % Lane::ALL.len()],
            features: abilities.filter(|(at, _)| has(*at)).map(|(_, ability)| ability.to_owned()).collect(),
            ..ours()
        }
    }

    /// Checks the invariants after each input.
    fn check(&mut self) {
        let mut orders = 0;
        while let Some(order) = self.core.poll() {
            orders += 1;
            match order {
                Output::Dial { connection, .. } => self.connections.push(connection),
                Output::Close(connection) => {
                    self.over.insert(connection);
                }
                Output::Attach(attach) => {
                    self.has_linked = true;
                    let is_known = self.connections.contains(&attach.connection);
                    assert!(is_known && !self.over.contains(&attach.connection), "{attach:?}");
                    assert!(attach.node.is_single() && attach.node != ours().node, "{attach:?}");
                }
                Output::SendHello(connection, _) => assert!(!self.over.contains(&connection)),
                Output::Detach { .. }
                | Output::Refuse(..)
                | Output::SendPing(..)
                | Output::SendPong(..)
                | Output::SendGoodbye(_)
                | Output::Forget(_)
                | Output::Silent(_)
                | Output::Fact(_)
                | Output::Count { .. } => {}
            }
        }
        // Each peer has a link or a dial, and two connections beside a link.
        let connections_max = STRANGERS_MAX + PEERS_MAX * (ADDRESSES + 3);
        assert!(orders <= 16 * connections_max, "{orders} orders for one input");
        assert!(self.core.peers.len() <= PEERS_MAX, "{} peers", self.core.peers.len());
        let strange = |stage| matches!(stage, Stage::Stranger | Stage::Leaving);
        let strangers = self.core.connections.values().filter(|held| strange(held.stage)).count();
        assert!(strangers <= STRANGERS_MAX, "{strangers} strangers");
        let latest = self.now + settings().handshake;
        for stranger in self.core.connections.values().filter(|held| strange(held.stage)) {
            assert!(stranger.deadline <= latest, "a stranger may stay until {:?}", stranger.deadline);
        }
        assert!(
            self.core.connections.len() <= connections_max,
            "{} connections",
            self.core.connections.len()
        );
        for peer in self.core.peers.values() {
            if let Some(link) = &peer.link {
                assert!(self.core.connections.contains_key(&link.connection), "a link without a connection");
            }
        }
    }
}
