//! Outcomes of messages to a node that is killed, in each form of the API: an actor by a future and by a
//! message, an endpoint by a blocking call and by an async task, and C. A message that had arrived there is
//! `Unknown`; a message that was never sent is `PeerLost`.

use std::{
    collections::BTreeSet,
    net::SocketAddr,
    path::{Path, PathBuf},
    thread,
};

use rustix::process::Signal;
use sinew::{Endpoint, NodeApi, Registration, audit::Place, client::Received, message::Sender, prelude::*};
use sinew_c::conformance::{self, Asked};
use sinew_runtime::wire::Message;
use sinew_testkit::{
    DEADLINE, Log, Loopback, NodeProcess, TestDirectory, all_run,
    network::{Cut, FaultyNetwork, Listener, Side},
    scripted::sender_app,
    until,
};
use sinew_tests::node_under_test;

/// Longer than any wait of the test: an outcome that arrives is not that of a deadline.
const WITHIN: Duration = DEADLINE.saturating_mul(10);

/// Listeners of the network: to the sender's GNCL, and to nowhere.
const TO_HUB: usize = 0;
const TO_NOBODY: usize = 1;

/// Rounds: while the connection is up, and when it is broken.
const ARRIVES: u64 = 1;
const WAITS: u64 = 2;

const AWAITED: &str = "a future of an actor";
const REPORTED: &str = "a message to an actor";
const ENDPOINT: &str = "an endpoint";
const TASK: &str = "an endpoint of a task";
const IN_C: &str = "an endpoint in C";
const FORMS: [&str; 5] = [AWAITED, REPORTED, ENDPOINT, TASK, IN_C];

/// Sends from an endpoint of its own, through the node at this socket, and returns the outcome.
type SendOne = fn(&Path, Tid, &Held) -> Outcome;
const BLOCKING: [(&str, SendOne); 3] = [(ENDPOINT, by_endpoint), (TASK, by_task), (IN_C, in_c)];

/// The round, the form, and the outcome.
type Ended = (u64, &'static str, Outcome);

payload!("lost_words.held" => struct Held { round: u64, form: String });
payload!("lost_words.go" => struct Go { round: u64, to: u64 });
payload!("lost_words.probe" => struct Probe {});

fn held(round: u64, form: &str) -> Held {
    Held { round, form: form.to_owned() }
}

/// Sends in both forms that an actor has.
struct Clerk(Log<Ended>);

impl Actor for Clerk {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Go>> for Clerk {
    type Result = ();

    fn handle(&mut self, go: Delivery<Go>, context: &mut Self::Context) {
        let (round, to) = (go.round, Tid::from_bits(go.to));
        let sent = context.message(to, &held(round, AWAITED)).confirmed(WITHIN).expect("it has room");
        let awaited = sent.into_actor(self).map(move |outcome, clerk: &mut Self, _: &mut _| {
            clerk.0.write((round, AWAITED, outcome));
        });
        context.spawn(awaited);
        context.message(to, &held(round, REPORTED)).with_tag(round).confirmed(WITHIN).expect("it has room");
    }
}

impl Handler<SendOutcome> for Clerk {
    type Result = ();

    fn handle(&mut self, outcome: SendOutcome, _: &mut Self::Context) {
        self.0.write((outcome.tag, REPORTED, outcome.outcome));
    }
}

fn by_endpoint(socket: &Path, to: Tid, held: &Held) -> Outcome {
    let api = NodeApi::connect(socket).expect("the node is up");
    let mut endpoint = api.register_transport_address(Registration::new()).expect("there is room for it");
    endpoint.message(to, held).confirmed(WITHIN).expect("the node takes it")
}

fn by_task(socket: &Path, to: Tid, held: &Held) -> Outcome {
    let reactor = tokio::runtime::Builder::new_current_thread().enable_all().build();
    reactor.expect("a reactor of this thread").block_on(async {
        let api = NodeApi::connect(socket).expect("the node is up");
        let registered = api.register_transport_address_async(Registration::new()).await;
        let mut endpoint = registered.expect("there is room for it");
        endpoint.message(to, held).confirmed(WITHIN).await.expect("the node takes it")
    })
}

fn in_c(socket: &Path, to: Tid, held: &Held) -> Outcome {
    /// `SINEW_CONTROL`.
    const CONTROL: i32 = 0;
    let registered = conformance::Endpoint::register(socket, &Asked::default());
    let mut endpoint = registered.expect("there is room for it");
    let payload = Message::typed(Tid::from_bits(endpoint.tid()), to, held).payload;
    let made = endpoint.create(to.bits(), Held::KIND.bits(), CONTROL, payload.len());
    let mut made = made.expect("it is short");
    made.copy_from_slice(&payload);
    let within = u64::try_from(WITHIN.as_nanos()).expect("it is some minutes");
    let code = endpoint.send_confirmed(made, within).expect("the node takes it");
    let code = u8::try_from(code as i32).expect("an outcome has the number that it has on the wire");
    Outcome::from_code(code).expect("it is one")
}

/// Two nodes. The hub, in this process, sends to an application of the other one, which receives messages and
/// does not settle them. The connections between them pass through the network, their datagrams do not.
struct Scenario {
    network: FaultyNetwork,
    sender_app: Sender,
    hub: Node,
    socket: PathBuf,
    ended: Log<Ended>,
    knee: NodeProcess,
    holder: Endpoint,
    to: Tid,
    // Last, so that it is removed after its users.
    _directory: TestDirectory,
}

impl Scenario {
    fn start() -> Self {
        let (loopback, directory) = (Loopback::new(), TestDirectory::new());
        let listen = SocketAddr::from(([127, 0, 0, 1], 0));
        let listeners = [Side::Left, Side::Right].map(|side| Listener { side, listen, datagrams: false });
        let network = FaultyNetwork::start(&listeners, 1).expect("ports on loopback");
        let (knee, listener) = (directory.join("knee.sock"), network.address(TO_NOBODY));
        let (program, holder) = start_knee(&loopback, &directory, &knee, listener);

        let (ended, socket) = (Log::default(), directory.join("hub.sock"));
        let (log, (sender_app, key)) = (ended.clone(), sender_app("sender"));
        let clerk = AppSpec::new("clerk", move || Clerk(log.clone())).handles::<Go>();
        let SocketAddr::V4(announced) = network.address(TO_HUB) else { panic!("its listener is of IPv4") };
        // The higher address of both: while its own dials lead nowhere, it accepts those of the other node.
        let hub = loopback.node("hub").address([127, 0, 0, 9]).configure(|config| {
            config.gncl.announce = Some(announced);
            config.lncl.socket = Some(socket.clone());
        });
        let hub = hub.app(clerk).app(sender_app).start().expect("a node");
        network.set_destination(TO_HUB, hub.handle().gncl_address().expect("its layers are ready"));
        all_run(&[&hub]);
        let to = until("the hub knows the holder", || hub.handle().resolve("holder"));
        let sender_app = key.sender();
        Self { network, sender_app, hub, socket, ended, knee: program, holder, to, _directory: directory }
    }

    /// Sends one message in each form.
    fn send(&self, round: u64) {
        self.sender_app.send("clerk", &Go { round, to: self.to.bits() }).expect("it has room");
        for (form, send) in BLOCKING {
            let (socket, to, ended) = (self.socket.clone(), self.to, self.ended.clone());
            thread::spawn(move || ended.write((round, form, send(&socket, to, &held(round, form)))));
        }
    }

    /// Returns one message of each form, as the application of the other node received them.
    fn take(&mut self) -> Vec<Received> {
        let mut in_hand = Vec::new();
        while in_hand.len() < FORMS.len() {
            let received = self.holder.receive(DEADLINE).expect("its node lives");
            let came = in_hand.len();
            in_hand.push(received.unwrap_or_else(|| {
                panic!("after {came} no message of {FORMS:?} has come to the holder within {DEADLINE:?}")
            }));
        }
        let read = |received: &Received| received.decode::<Held>().expect("nothing else was sent");
        let forms: BTreeSet<_> = in_hand.iter().map(|received| read(received).form).collect();
        assert_eq!(forms, BTreeSet::from(FORMS.map(str::to_owned)), "one of each");
        assert!(in_hand.iter().all(|received| read(received).round == ARRIVES));
        in_hand
    }

    /// Ends the connections and prevents new ones; returns when the hub has noticed.
    fn cut(&self) {
        // From now on the network to nowhere ends each dial.
        self.network.set_destination(TO_HUB, self.network.address(TO_NOBODY));
        self.network.cut(Cut::Reset);
        until("no connection is open", || (self.network.counts().open == 0).then_some(()));
        until("what is sent to the lost connection waits", || {
            self.sender_app.send(self.to, &Probe {}).expect("it has room");
            self.hub.handle().traffic().iter().any(|traffic| traffic.waiting > 0).then_some(())
        });
    }

    /// Messages of applications that the hub has accepted for the other node, sent or not.
    fn taken(&self) -> u64 {
        let entries = self.hub.handle().audit_here().entries;
        let to_knee = entries.iter().filter(|entry| matches!(entry.place, Place::ToNode { .. }));
        to_knee.map(|entry| entry.account.taken - entry.account.own).sum()
    }
}

/// The node to be killed, which is connected by its own dials only, and its application.
fn start_knee(
    loopback: &Loopback,
    directory: &TestDirectory,
    socket: &Path,
    listener: SocketAddr,
) -> (NodeProcess, Endpoint) {
    let text = format!(
        "[node]\nname = \"knee\"\naddress = \"127.0.0.2\"\n[lncl]\nsocket = \"{}\"\n[gncl]\nannounce = \"{listener}\"\n\
         [ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
        socket.display(),
        loopback.group
    );
    let path = directory.write("knee.toml", &text);
    let mut knee = node_under_test(None, &path, &[]);
    knee.wait_for(&["up"]);
    let api = NodeApi::connect(socket).expect("the node is up");
    let registration = Registration::new().name("holder");
    (knee, api.register_transport_address(registration).expect("the name is free"))
}

#[test]
fn outcome_tells_arrived_from_unsent_after_a_kill() {
    // Given: in each form, one confirmed message that its receiver holds,
    let mut scenario = Scenario::start();
    scenario.send(ARRIVES);
    let in_hand = scenario.take();
    // and one that was sent when the connection was broken and the node still counted as present
    scenario.cut();
    let before = scenario.taken();
    scenario.send(WAITS);
    let of_each = before + FORMS.len() as u64;
    until("the hub has taken one more of each form", || (scenario.taken() >= of_each).then_some(()));
    assert_eq!(scenario.ended.all(), [], "no outcome is reported");
    // When
    scenario.knee.signal(Signal::KILL);
    // Then
    let all = 2 * FORMS.len();
    let ended =
        scenario.ended.wait("an outcome of each", |ended| (ended.len() >= all).then(|| ended.to_vec()));
    for (round, outcome) in [(ARRIVES, Outcome::Unknown), (WAITS, Outcome::PeerLost)] {
        for form in FORMS {
            let outcomes = ended.iter().filter(|(of, by, _)| (*of, *by) == (round, form));
            let outcomes: Vec<_> = outcomes.map(|(_, _, outcome)| *outcome).collect();
            assert_eq!(outcomes, [outcome], "of round {round} to {form}; all of them: {ended:?}");
        }
    }
    drop(in_hand);
}
