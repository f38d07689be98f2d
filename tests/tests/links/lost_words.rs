//! What becomes of messages to a node that is killed, as each form of the API tells its sender: an actor by a future and by a message, an
//! endpoint by the end of a call and of a task, and C. What had arrived there is `Unknown`, what never left is `PeerLost`.

use std::{
    collections::BTreeSet,
    fs,
    net::SocketAddr,
    path::{Path, PathBuf},
    thread,
};

use rustix::process::Signal;
use sinew::{Endpoint, NodeApi, Registration, audit::Place, client::Received, message::Sender, prelude::*};
use sinew_c::conformance::{self, Asked};
use sinew_runtime::wire::Message;
use sinew_tests::{
    DEADLINE, Ground, Log, OwnDirectory, Program, all_run, node_under_test,
    proxy::{Cut, Door, Proxy, Side},
    puppet::desk,
    until,
};

/// Beyond what the test waits for anything: an outcome that comes is no deadline's.
const WITHIN: Duration = DEADLINE.saturating_mul(10);

/// Doors of the network: to the sender's GNCL, and to nobody's.
const TO_HUB: usize = 0;
const TO_NOBODY: usize = 1;

/// Rounds: while the connection stands, and when it is broken.
const ARRIVES: u64 = 1;
const WAITS: u64 = 2;

const AWAITED: &str = "a future of an actor";
const TOLD: &str = "a message to an actor";
const ENDPOINT: &str = "an endpoint";
const TASK: &str = "an endpoint of a task";
const IN_C: &str = "an endpoint in C";
const FORMS: [&str; 5] = [AWAITED, TOLD, ENDPOINT, TASK, IN_C];

/// Sends from an endpoint of its own, through the node that listens there, and returns with the outcome.
type SendOne = fn(&Path, Tid, &Held) -> Outcome;
const BLOCKING: [(&str, SendOne); 3] = [(ENDPOINT, by_endpoint), (TASK, by_task), (IN_C, in_c)];

/// Of which round, in which form, what was told.
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
        context.message(to, &held(round, TOLD)).with_tag(round).confirmed(WITHIN).expect("it has room");
    }
}

impl Handler<SendOutcome> for Clerk {
    type Result = ();

    fn handle(&mut self, told: SendOutcome, _: &mut Self::Context) {
        self.0.write((told.tag, TOLD, told.outcome));
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

/// Two nodes, of which the hub, here, sends to an application of the other one, which takes what comes and says nothing of it. Their
/// connections pass the network, their datagrams do not.
struct Scenario {
    network: Proxy,
    desk: Sender,
    hub: Node,
    socket: PathBuf,
    ended: Log<Ended>,
    knee: Program,
    holder: Endpoint,
    to: Tid,
    // Last: removed when nobody uses it.
    _directory: OwnDirectory,
}

impl Scenario {
    fn start() -> Self {
        let (ground, directory) = (Ground::new(), OwnDirectory::new());
        let listen = SocketAddr::from(([127, 0, 0, 1], 0));
        let doors = [Side::Left, Side::Right].map(|side| Door { side, listen, datagrams: false });
        let network = Proxy::start(&doors, 1).expect("ports on loopback");
        let (knee, door) = (directory.join("knee.sock"), network.address(TO_NOBODY));
        let (program, holder) = start_knee(&ground, &directory, &knee, door);

        let (ended, socket) = (Log::default(), directory.join("hub.sock"));
        let (log, (desk, key)) = (ended.clone(), desk("desk"));
        let clerk = AppSpec::new("clerk", move || Clerk(log.clone())).handles::<Go>();
        let SocketAddr::V4(announced) = network.address(TO_HUB) else { panic!("its door is of IPv4") };
        // The higher address of both: while its own dials lead nowhere, it takes the other one's.
        let hub = ground.node("hub").address([127, 0, 0, 9]).configure(|config| {
            config.gncl.announce = Some(announced);
            config.lncl.socket = Some(socket.clone());
        });
        let hub = hub.app(clerk).app(desk).start().expect("a node");
        network.lead(TO_HUB, hub.handle().gncl_address().expect("its layers are ready"));
        all_run(&[&hub]);
        let to = until("the hub knows the holder", || hub.handle().resolve("holder"));
        let desk = key.sender();
        Self { network, desk, hub, socket, ended, knee: program, holder, to, _directory: directory }
    }

    /// Sends one in each form.
    fn send(&self, round: u64) {
        self.desk.send("clerk", &Go { round, to: self.to.bits() }).expect("it has room");
        for (form, send) in BLOCKING {
            let (socket, to, ended) = (self.socket.clone(), self.to, self.ended.clone());
            thread::spawn(move || ended.write((round, form, send(&socket, to, &held(round, form)))));
        }
    }

    /// One of each form, as the application of the other node has them in hand.
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

    /// The connections end, and there are no others; returns when the hub knows.
    fn cut(&self) {
        // A dial from now on is ended by the door that leads nowhere.
        self.network.lead(TO_HUB, self.network.address(TO_NOBODY));
        self.network.cut(Cut::Reset);
        until("no connection is open", || (self.network.counts().open == 0).then_some(()));
        until("what is sent to the lost connection waits", || {
            self.desk.send(self.to, &Probe {}).expect("it has room");
            self.hub.handle().traffic().iter().any(|traffic| traffic.waiting > 0).then_some(())
        });
    }

    /// Messages of applications that the hub has taken for the other node, sent or not.
    fn taken(&self) -> u64 {
        let entries = self.hub.handle().audit_here().entries;
        let to_knee = entries.iter().filter(|entry| matches!(entry.place, Place::ToNode { .. }));
        to_knee.map(|entry| entry.account.taken - entry.account.own).sum()
    }
}

/// The node that is killed, which is reached by its dials alone, and its application.
fn start_knee(
    ground: &Ground,
    directory: &OwnDirectory,
    socket: &Path,
    door: SocketAddr,
) -> (Program, Endpoint) {
    let path = directory.join("knee.toml");
    let text = format!(
        "[node]\nname = \"knee\"\naddress = \"127.0.0.2\"\n[lncl]\nsocket = \"{}\"\n[gncl]\nannounce = \"{door}\"\n\
         [ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
        socket.display(),
        ground.group
    );
    fs::write(&path, text).expect("the test's own directory");
    let mut knee = node_under_test(None, &path, &[]);
    knee.wait_for(&["up"]);
    let api = NodeApi::connect(socket).expect("the node is up");
    let registration = Registration::new().name("holder");
    (knee, api.register_transport_address(registration).expect("the name is free"))
}

#[test]
fn each_form_tells_of_a_killed_node_what_had_arrived_there_as_unknown_and_what_waited_as_lost() {
    // Given: of each form, one confirmed message that is in its receiver's hand,
    let mut scenario = Scenario::start();
    scenario.send(ARRIVES);
    let in_hand = scenario.take();
    // and one that came when the connection was broken, and the node still there as far as anybody knows
    scenario.cut();
    let before = scenario.taken();
    scenario.send(WAITS);
    let of_each = before + FORMS.len() as u64;
    until("the hub has taken one more of each form", || (scenario.taken() >= of_each).then_some(()));
    assert_eq!(scenario.ended.all(), [], "nobody has said anything of them");
    // When
    scenario.knee.signal(Signal::KILL);
    // Then
    let all = 2 * FORMS.len();
    let ended =
        scenario.ended.wait("an outcome of each", |ended| (ended.len() >= all).then(|| ended.to_vec()));
    for (round, outcome) in [(ARRIVES, Outcome::Unknown), (WAITS, Outcome::PeerLost)] {
        for form in FORMS {
            let told = ended.iter().filter(|(of, by, _)| (*of, *by) == (round, form));
            let told: Vec<_> = told.map(|(_, _, outcome)| *outcome).collect();
            assert_eq!(told, [outcome], "of round {round} to {form}; all of them: {ended:?}");
        }
    }
    drop(in_hand);
}
