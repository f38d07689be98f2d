//! Two cores, and connections between them with each delay drawn from a seed.

use std::fmt::Write;

use super::*;

pub(super) fn millis(millis: u64) -> Time {
    Time::from_nanos(millis * 1_000_000)
}

/// A fault.
#[derive(Clone, Debug)]
pub(super) enum Mishap {
    /// One of the present connections breaks; both ends notice at different times.
    CutOne(u64),
    /// One of the present connections carries nothing any more, and only the dialler notices.
    HalfOpen(u64),
    /// GNCL of this node is restarted; its sockets close.
    LayerRestarts(usize),
    /// The node is restarted, in a new incarnation.
    NodeRestarts(usize),
    /// NDL of this node loses the other node for a while.
    NodeLostAndFound(usize),
}

pub(super) struct Node {
    core: Core,
    incarnation: u64,
    pub(super) facts: Vec<LinkFact>,
    /// The end of a pipe for each connection.
    ends: BTreeMap<ConnectionId, usize>,
    /// The instance of the core: messages in flight to a former one are void.
    instance: u64,
    /// The incarnation of the other node that NDL here has lost and not found again.
    lost: Option<Incarnation>,
}

struct Pipe {
    /// The connection at each node, after it has one.
    ends: [Option<ConnectionId>; 2],
    dialler: usize,
    carries: bool,
    /// The arrival time of the last bytes in flight to each node: a pipe keeps the order.
    last: [Time; 2],
}

enum Event {
    Input {
        node: usize,
        instance: u64,
        input: Input,
    },
    /// Data arrives at the present or future end of a pipe at `node`.
    Arrives {
        node: usize,
        pipe: usize,
        what: Parcel,
    },
}

#[derive(Clone)]
enum Parcel {
    Accept,
    Connected,
    Hello(Introduction),
    Welcome(Introduction),
    Refusal(Refusal),
    Ping,
    Pong,
    End,
}

pub(super) struct World {
    pub(super) nodes: [Node; 2],
    now: Time,
    pipes: Vec<Pipe>,
    events: BTreeMap<(Time, u64), Event>,
    posted: u64,
    random: u64,
    delay_max_us: u64,
    /// The addresses of the other node that each node is given.
    pub(super) addresses: Vec<SocketAddr>,
    story: String,
}

const ADDRESSES: [NodeAddress; 2] = [LOW, HIGH];

impl World {
    pub(super) fn new(seed: u64, delay_max_us: u64) -> Self {
        let node = |n: usize| Node {
            core: Core::new(settings(ADDRESSES[n], 1), seed ^ n as u64),
            incarnation: 1,
            facts: Vec::new(),
            ends: BTreeMap::new(),
            instance: 0,
            lost: None,
        };
        Self {
            nodes: [node(0), node(1)],
            now: Time::ZERO,
            pipes: Vec::new(),
            events: BTreeMap::new(),
            posted: 0,
            random: seed,
            delay_max_us,
            addresses: vec![address()],
            story: String::new(),
        }
    }

    pub(super) fn story(&self) -> &str {
        &self.story
    }

    pub(super) fn find_each_other_at(&mut self, at: [Time; 2]) {
        for (node, at) in at.into_iter().enumerate() {
            self.told_found(node, at);
        }
    }

    pub(super) fn strike(&mut self, mishap: Mishap) {
        let _ = writeln!(self.story, "{:?} {mishap:?}", self.now);
        match mishap {
            Mishap::CutOne(which) => {
                if let Some(pipe) = self.some_pipe(which) {
                    self.cut(pipe);
                }
            }
            Mishap::HalfOpen(which) => {
                if let Some(pipe) = self.some_pipe(which) {
                    self.pipes[pipe].carries = false;
                    let dialler = self.pipes[pipe].dialler;
                    self.post(self.now, Event::Arrives { node: dialler, pipe, what: Parcel::End });
                }
            }
            Mishap::LayerRestarts(node) => self.restart(node),
            Mishap::NodeRestarts(node) => self.restart_node(node),
            Mishap::NodeLostAndFound(node) => {
                let other = 1 - node;
                let lost = Input::NodeLost {
                    node: ADDRESSES[other],
                    incarnation: Incarnation(self.nodes[other].incarnation),
                };
                self.input(node, lost);
                let at = self.now + self.delay() * 10;
                self.told_found(node, at);
            }
        }
    }

    fn restart_node(&mut self, node: usize) {
        let (other, old) = (1 - node, self.nodes[node].incarnation);
        self.nodes[node].incarnation += 1;
        self.nodes[node].lost = None;
        self.restart(node);
        // The other's NDL may be notified of it before or after the first HELLO.
        let (instance, at) = (self.nodes[other].instance, self.now + self.delay() * 3);
        let lost = Input::NodeLost { node: ADDRESSES[node], incarnation: Incarnation(old) };
        self.post(at, Event::Input { node: other, instance, input: lost });
        self.told_found(other, at);
    }

    fn restart(&mut self, node: usize) {
        let ends = std::mem::take(&mut self.nodes[node].ends);
        for pipe in ends.into_values() {
            self.pipes[pipe].ends[node] = None;
            self.send_to(1 - node, pipe, Parcel::End);
        }
        let seed = self.draw();
        let restarted = &mut self.nodes[node];
        restarted.instance += 1;
        restarted.core = Core::new(settings(ADDRESSES[node], restarted.incarnation), seed);
        // Connections of a former instance have other names.
        restarted.core.opened = restarted.instance << 32;
        if let Some(incarnation) = restarted.lost {
            self.input(node, Input::NodeLost { node: ADDRESSES[1 - node], incarnation });
        }
        let at = self.now + self.delay() * 3;
        self.told_found(node, at);
    }

    fn told_found(&mut self, node: usize, at: Time) {
        let other = 1 - node;
        let incarnation = Incarnation(self.nodes[other].incarnation);
        let addresses = self.addresses.clone();
        let input = Input::NodeFound { node: ADDRESSES[other], incarnation, addresses };
        let instance = self.nodes[node].instance;
        self.post(at, Event::Input { node, instance, input });
    }

    fn some_pipe(&self, which: u64) -> Option<usize> {
        let open: Vec<_> =
            (0..self.pipes.len()).filter(|p| self.pipes[*p].ends.iter().any(Option::is_some)).collect();
        open.get(which as usize % open.len().max(1)).copied()
    }

    fn cut(&mut self, pipe: usize) {
        self.pipes[pipe].carries = false;
        for node in 0..2 {
            let at = self.now + self.delay();
            self.post(at, Event::Arrives { node, pipe, what: Parcel::End });
        }
    }

    pub(super) fn run_until(&mut self, end: Time) {
        loop {
            let event = self.events.first_key_value().map(|((at, _), _)| *at);
            let wakes = [0, 1].map(|n| self.nodes[n].core.next_wake());
            let next = wakes.into_iter().chain([event]).flatten().min();
            let Some(next) = next.filter(|at| *at <= end) else { break };
            self.now = self.now.max(next);
            if event == Some(next) {
                let (_, event) = self.events.pop_first().expect("was seen");
                self.happen(event);
                continue;
            }
            for (node, wake) in wakes.into_iter().enumerate() {
                if wake == Some(next) {
                    self.input(node, Input::TimePassed);
                }
            }
        }
        self.now = end;
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Input { node, instance, input } => {
                if instance == self.nodes[node].instance {
                    self.input(node, input);
                }
            }
            Event::Arrives { node, pipe, what } => self.arrive(node, pipe, what),
        }
    }

    fn arrive(&mut self, node: usize, pipe: usize, what: Parcel) {
        if matches!(what, Parcel::Accept) {
            let connection = self.nodes[node].core.open();
            self.pipes[pipe].ends[node] = Some(connection);
            self.nodes[node].ends.insert(connection, pipe);
            return self.input(node, Input::Accepted(connection, SOMEWHERE));
        }
        let Some(connection) = self.pipes[pipe].ends[node] else { return };
        if !self.pipes[pipe].carries && !matches!(what, Parcel::End) {
            return;
        }
        let input = match what {
            Parcel::Accept => return,
            Parcel::Connected => Input::Connected(connection),
            Parcel::Hello(hello) => Input::HelloReceived(connection, hello),
            Parcel::Welcome(welcome) => Input::WelcomeReceived(connection, welcome),
            Parcel::Refusal(refusal) => Input::RefusalReceived(connection, refusal),
            Parcel::Ping => Input::PingReceived(connection),
            Parcel::Pong => Input::PongReceived(connection),
            Parcel::End => {
                self.drop_end(node, connection);
                Input::Ended(connection)
            }
        };
        self.input(node, input);
    }

    fn input(&mut self, node: usize, input: Input) {
        let _ = writeln!(self.story, "{:?} {node} <- {input:?}", self.now);
        self.note_what_ndl_says(node, &input);
        self.nodes[node].core.handle(self.now, input);
        while let Some(output) = self.nodes[node].core.poll() {
            let _ = writeln!(self.story, "{:?} {node} -> {output:?}", self.now);
            self.obey(node, output);
        }
    }

    fn note_what_ndl_says(&mut self, node: usize, input: &Input) {
        let lost = &mut self.nodes[node].lost;
        if let Input::NodeLost { incarnation, .. } = input {
            *lost = Some(*incarnation).max(*lost);
        }
        if let Input::NodeFound { incarnation, .. } = input
            && lost.is_some_and(|lost| *incarnation >= lost)
        {
            *lost = None;
        }
    }

    fn obey(&mut self, node: usize, output: Output) {
        match output {
            Output::Dial { connection, address: to } if to == address() => self.dial(node, connection),
            // Nothing answers there.
            Output::Dial { .. } => {}
            Output::SendHello(connection, hello) => self.send(node, connection, Parcel::Hello(hello)),
            Output::Attach(attach) => {
                // spec: GNCL-7
                let is_lost = self.nodes[node].lost.is_some_and(|lost| attach.incarnation <= lost);
                assert!(
                    !is_lost,
                    "nothing is linked between an incarnation's loss and its finding: {}",
                    self.story
                );
                if let Some(welcome) = attach.welcome {
                    self.send(node, attach.connection, Parcel::Welcome(welcome));
                }
            }
            Output::Refuse(connection, refusal) => {
                self.send(node, connection, Parcel::Refusal(refusal));
                self.send(node, connection, Parcel::End);
            }
            Output::Close(connection) => {
                self.send(node, connection, Parcel::End);
                self.drop_end(node, connection);
            }
            Output::SendPing(_, lane) => self.send_on_link(node, lane, Parcel::Ping),
            Output::SendPong(_, lane) => self.send_on_link(node, lane, Parcel::Pong),
            Output::Fact(fact) => self.nodes[node].facts.push(fact),
            Output::Detach { .. }
            | Output::SendGoodbye(_)
            | Output::Forget(_)
            | Output::Silent(_)
            | Output::Count { .. } => {}
        }
    }

    fn dial(&mut self, node: usize, connection: ConnectionId) {
        let pipe = self.pipes.len();
        let mut ends = [None; 2];
        ends[node] = Some(connection);
        let accepted = self.now + self.delay();
        let mut last = [accepted; 2];
        last[node] = self.now + self.delay();
        self.pipes.push(Pipe { ends, dialler: node, carries: true, last });
        self.nodes[node].ends.insert(connection, pipe);
        self.post(accepted, Event::Arrives { node: 1 - node, pipe, what: Parcel::Accept });
        self.post(last[node], Event::Arrives { node, pipe, what: Parcel::Connected });
    }

    fn send_on_link(&mut self, node: usize, lane: Lane, what: Parcel) {
        if let Some(connection) = self.connection(node, lane) {
            self.send(node, connection, what);
        }
    }

    fn connection(&self, node: usize, lane: Lane) -> Option<ConnectionId> {
        let mut link = self.nodes[node].core.peers.get(&ADDRESSES[1 - node])?.link?;
        link.connection_of(lane)
    }

    fn send(&mut self, node: usize, connection: ConnectionId, what: Parcel) {
        if let Some(pipe) = self.nodes[node].ends.get(&connection).copied() {
            self.send_to(1 - node, pipe, what);
        }
    }

    fn send_to(&mut self, node: usize, pipe: usize, what: Parcel) {
        let at = (self.now + self.delay()).max(self.pipes[pipe].last[node]);
        self.pipes[pipe].last[node] = at;
        self.post(at, Event::Arrives { node, pipe, what });
    }

    fn drop_end(&mut self, node: usize, connection: ConnectionId) {
        if let Some(pipe) = self.nodes[node].ends.remove(&connection) {
            self.pipes[pipe].ends[node] = None;
        }
    }

    fn post(&mut self, at: Time, event: Event) {
        self.posted += 1;
        self.events.insert((at, self.posted), event);
    }

    fn delay(&mut self) -> Duration {
        let delay = self.draw() % self.delay_max_us;
        Duration::from_micros(delay)
    }

    fn draw(&mut self) -> u64 {
        self.random =
            self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        self.random >> 33
    }

    /// Returns whether both have a link.
    pub(super) fn is_linked(&self) -> bool {
        self.nodes.iter().all(|node| node.core.peers.values().any(|peer| peer.link.is_some()))
    }

    /// Checks that both have the same link with its two further connections, and nothing else.
    pub(super) fn agreed_link(&self) -> Result<(), String> {
        for lane in Lane::ALL {
            let pipes = [0, 1].map(|n| {
                let node = &self.nodes[n];
                let connection = self.connection(n, lane)?;
                (node.core.connections.len() == 3).then(|| node.ends.get(&connection).copied())?
            });
            match pipes {
                [Some(a), Some(b)] if a == b => {}
                other => return Err(format!("{lane:?} on pipes {other:?}")),
            }
        }
        Ok(())
    }
}
