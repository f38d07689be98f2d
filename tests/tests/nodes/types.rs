//! Types that two nodes have in different versions: which messages pass, and the words in the log of each node.

use std::{
    path::Path,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
};

use sinew::{
    Endpoint, MismatchPolicy, NodeApi, Registration,
    inspect::{AskMismatches, AskSchemas, MismatchReport, MismatchesReport, SchemasReport},
    message::{Kind, Rejection, SendError, Sender},
    prelude::*,
    serde::{Deserialize, Serialize},
};
use sinew_runtime::log::{LogObserver, observe, tracing::Level};
use sinew_testkit::{
    DEADLINE, Loopback, TestDirectory, all_run,
    scripted::{sender_app, wait},
    until,
};

/// The types of the hip's program.
mod sent {
    use super::*;
    payload!("types.gains" => pub(super) struct Gains { pub kp: f32, pub kd: f32 });
    payload!("types.limit" => pub(super) struct Limit { pub torque: f32 });
    payload!("types.counter" => pub(super) struct Counter { pub value: u32 });
    payload!("types.declared" => pub(super) struct Declared { pub torque: f32 });
    payload!("types.strict" => pub(super) struct Strict { pub torque: f32, pub until: u32 });
    payload!("types.turn" => pub(super) struct Turn { pub angle: Degrees });

    #[derive(Serialize, Deserialize)]
    #[serde(crate = "sinew::serde")]
    pub(super) struct Degrees(pub f32);
}

/// The same types in the knee's program: one has a field less, one has a renamed field, one has a text for a number,
/// one has another unit.
mod handled {
    use super::*;
    payload!("types.gains" => pub(super) struct Gains { pub kp: f32 });
    payload!("types.limit" => pub(super) struct Limit { pub newton_metres: f32 });
    payload!("types.counter" => pub(super) struct Counter { pub value: String });
    payload!("types.declared" => pub(super) struct Declared { pub newton_metres: f32 });
    payload!("types.turn" => pub(super) struct Turn { pub angle: Radians });

    #[derive(Serialize, Deserialize)]
    #[serde(crate = "sinew::serde")]
    pub(super) struct Radians(pub f32);

    /// The decoder accepts a message with one more field, and the policy does not.
    #[derive(Serialize, Deserialize)]
    #[serde(crate = "sinew::serde")]
    pub(super) struct Strict {
        pub torque: f32,
    }

    impl Payload for Strict {
        const NAME: &'static str = "types.strict";
        const MISMATCH: MismatchPolicy = MismatchPolicy::Refuse;
    }
}

/// Counts the messages that its handlers get.
struct Knee(Arc<AtomicU64>);

impl Actor for Knee {
    type Context = AppContext<Self>;
}

macro_rules! counted {
    ($($payload:ident)*) => {
        $(impl Handler<Delivery<handled::$payload>> for Knee {
            type Result = ();
            fn handle(&mut self, _: Delivery<handled::$payload>, _: &mut Self::Context) {
                self.0.fetch_add(1, Ordering::Relaxed);
            }
        })*
    };
}

counted!(Gains Limit Counter Declared Strict Turn);

fn knee(handled: &Arc<AtomicU64>) -> AppSpec<Knee> {
    let handled = handled.clone();
    AppSpec::new("knee", move || Knee(handled.clone()))
        .handles::<handled::Gains>()
        .handles::<handled::Limit>()
        .handles::<handled::Counter>()
        .handles::<handled::Declared>()
        .handles::<handled::Strict>()
        .handles::<handled::Turn>()
}

/// The lines of the log about types, of all nodes of this process.
#[derive(Default)]
struct Lines(Mutex<Vec<String>>);

impl LogObserver for Lines {
    fn wrote(&self, _: Level, target: &str, text: &str) {
        if target == "sinew::types" {
            self.0.lock().expect("no writer panics").push(text.to_owned());
        }
    }
}

impl Lines {
    /// Returns the line of the receiver's node about a type, or that of the sender's node.
    fn of(&self, name: &str, is_receiver: bool) -> Option<String> {
        let lines = self.0.lock().expect("no writer panics");
        let is_it = |line: &&String| {
            let (target, source) = line.split_once(&format!(" messages of {name} from "))?;
            let own = if is_receiver { target } else { source };
            own.contains("of this node").then_some(())
        };
        lines.iter().find(|line| is_it(line).is_some()).cloned()
    }
}

fn outcome<P: Payload>(sender: &Sender, value: &P) -> Outcome {
    wait(sender.message("knee", value).confirmed(DEADLINE).expect("its node takes it"))
}

/// Asks the inspection of a node.
fn ask<Q: Payload, R: Payload>(sender: &Sender, node: NodeAddress, question: &Q) -> R {
    let inspection = Tid::new(node, AppAddress::INSPECT);
    let reply = sender.message(inspection, question).ask::<R>(DEADLINE).expect("the node takes it");
    wait(reply).expect("the node answers")
}

fn mismatches(sender: &Sender, node: NodeAddress) -> Vec<MismatchReport> {
    ask::<AskMismatches, MismatchesReport>(sender, node, &AskMismatches {}).mismatches
}

#[test]
fn both_nodes_say_in_words_what_differs() {
    // Given: two nodes, and three types that differ
    let lines = Arc::new(Lines::default());
    let observer: Arc<dyn LogObserver> = lines.clone();
    assert!(observe(&observer), "there is room for one observer");
    let (loopback, handled, (gait, probe)) = (Loopback::new(), Arc::default(), sender_app("gait"));
    let hip = loopback.node("hip").app(gait).start().expect("a node");
    let other = loopback.node("knee").app(knee(&handled)).start().expect("a node");
    all_run(&[&hip, &other]);
    let sender = probe.sender();
    until("the knee is known", || sender.resolve("knee"));
    // When: messages come until both sides have logged all three
    let names = ["types.gains", "types.limit", "types.counter"];
    let mut sent = 0;
    until("each side has logged each type", || {
        let outcomes = [
            outcome(&sender, &sent::Gains { kp: 1.0, kd: 0.1 }),
            outcome(&sender, &sent::Limit { torque: 9.0 }),
            outcome(&sender, &sent::Counter { value: 7 }),
        ];
        let malformed = Outcome::Rejected(Rejection::Malformed);
        assert_eq!(outcomes, [Outcome::Delivered, malformed, malformed]);
        sent += 1;
        let is_logged = |name: &&str| lines.of(name, true).is_some() && lines.of(name, false).is_some();
        names.iter().all(is_logged).then_some(())
    });
    // Then: the words of both sides
    assert_eq!(handled.load(Ordering::Relaxed), sent, "only the messages with one more field are handled");
    let differences = [
        ("types.gains", "accepts", "field `kd` is missing at the receiver"),
        (
            "types.limit",
            "refuses",
            "field `torque` (f32) at the sender seems to be `newton_metres` (f32) at the receiver",
        ),
        ("types.counter", "refuses", "`value` is u32 at the sender and text at the receiver"),
    ];
    for (name, verb, difference) in differences {
        for is_receiver in [true, false] {
            let line = lines.of(name, is_receiver).expect("it was logged");
            for part in ["knee (", "gait (", verb, difference, "accept-additions"] {
                assert!(line.contains(part), "{part} in {line}");
            }
        }
    }
    // And: the answers of both nodes to `sinew why` and `sinew schema`
    for node in [hip.handle().address(), other.handle().address()] {
        let of_both = mismatches(&sender, node);
        for (name, verb, difference) in differences {
            let found = of_both.iter().find(|one| one.kind == Kind::named(name));
            let found = found.unwrap_or_else(|| panic!("{name} of {node}: {of_both:#?}"));
            assert_eq!((found.source.name.as_str(), found.target.name.as_str()), ("gait", "knee"));
            let treatment = if verb == "accepts" { "accepted" } else { "refused" };
            assert_eq!(
                (found.treatment.as_str(), &found.differences[..]),
                (treatment, &[difference.to_owned()][..])
            );
        }
        let question = AskSchemas { kind: Kind::named("types.limit") };
        let report: SchemasReport = ask(&sender, node, &question);
        assert_eq!(report.schemas.len(), 2, "{report:#?}");
    }
}

#[test]
fn other_unit_is_refused_and_named_by_both_nodes() {
    // Given: two nodes, and a type with another unit, which the decoder accepts
    let (loopback, handled, (gait, probe)) = (Loopback::new(), Arc::default(), sender_app("unit.gait"));
    let hip = loopback.node("hip").app(gait).start().expect("a node");
    let other = loopback.node("knee").app(knee(&handled)).start().expect("a node");
    all_run(&[&hip, &other]);
    let sender = probe.sender();
    until("the knee is known", || sender.resolve("knee"));
    // When: messages come until the nodes have compared the type
    let turn = sent::Turn { angle: sent::Degrees(90.0) };
    let malformed = Outcome::Rejected(Rejection::Malformed);
    until("a message is refused", || (outcome(&sender, &turn) == malformed).then_some(()));
    // Then: no further one is handled
    let before = handled.load(Ordering::Relaxed);
    assert_eq!(outcome(&sender, &turn), malformed);
    assert_eq!(handled.load(Ordering::Relaxed), before);
    // And: both nodes name the units
    for node in [hip.handle().address(), other.handle().address()] {
        let found = until("the node knows the difference", || {
            let of_turn = |one: &MismatchReport| one.name.as_deref() == Some("types.turn");
            mismatches(&sender, node).into_iter().find(of_turn)
        });
        assert_eq!(found.treatment, "refused");
        assert_eq!(found.differences, ["`angle` is in Degrees at the sender and Radians at the receiver"]);
    }
}

#[test]
fn declared_type_is_compared_before_its_first_message() {
    let (loopback, handled) = (Loopback::new(), Arc::default());
    let (desk, probe) = sender_app("desk");
    let gait = AppSpec::new("gait", || Gait).sends::<sent::Declared>();
    let hip = loopback.node("hip").app(gait).app(desk).start().expect("a node");
    let other = loopback.node("knee").app(knee(&handled)).start().expect("a node");
    all_run(&[&hip, &other]);
    let sender = probe.sender();
    until("the knee is known", || sender.resolve("knee"));
    let there = other.handle().address();
    let refused = until("the knee's node knows that the types differ", || {
        mismatches(&sender, there).into_iter().find(|one| one.source.name == "gait")
    });
    assert_eq!((refused.treatment.as_str(), refused.seen), ("refused", 0));
    assert_eq!(refused.name.as_deref(), Some("types.declared"));
    assert_eq!(handled.load(Ordering::Relaxed), 0);
}

#[test]
fn addition_is_refused_where_the_policy_says_so() {
    let (loopback, handled) = (Loopback::new(), Arc::<AtomicU64>::default());
    let (gait, probe) = sender_app("strict.gait");
    let hip = loopback.node("hip").app(gait).start().expect("a node");
    let other = loopback.node("knee").app(knee(&handled)).start().expect("a node");
    all_run(&[&hip, &other]);
    let sender = probe.sender();
    until("the knee is known", || sender.resolve("knee"));
    let send = || outcome(&sender, &sent::Strict { torque: 9.0, until: 3 });
    // The first messages declare the type: the decoder reads them.
    let malformed = Outcome::Rejected(Rejection::Malformed);
    until("the node refuses the type", || (send() == malformed).then_some(()));
    let so_far = handled.load(Ordering::Relaxed);
    for _ in 0..10 {
        assert_eq!(send(), malformed);
    }
    assert_eq!(handled.load(Ordering::Relaxed), so_far, "no refused message is handled");
    let there = other.handle().address();
    let refused = until("the difference is known", || {
        mismatches(&sender, there).into_iter().find(|one| one.kind == Kind::named("types.strict"))
    });
    assert_eq!((refused.treatment.as_str(), refused.policy.as_str()), ("refused", "refuse"));
    assert_eq!(refused.differences, ["field `until` is missing at the receiver"]);
}

/// Declares a type, and sends nothing.
struct Gait;

impl Actor for Gait {
    type Context = AppContext<Self>;
}

/// Registers a client of a node that sends one type, and handles one, each in another version than the node's
/// applications.
fn client(socket: &Path) -> Endpoint {
    let api = NodeApi::connect(socket).expect("its socket");
    let registration = Registration::new()
        .name("client.gait")
        .sends::<sent::Limit>()
        .handles::<handled::Declared>()
        .requires(["knee"])
        .deadline(DEADLINE);
    api.register_transport_address(registration).expect("the knee is there")
}

/// Asks the inspection of a node through a client.
fn ask_as<Q: Payload, R: Payload>(client: &mut Endpoint, node: NodeAddress, question: &Q) -> R {
    client.message(Tid::new(node, AppAddress::INSPECT), question).ask(DEADLINE).expect("the node answers")
}

#[test]
fn client_is_refused_in_words_by_each_node() {
    for is_of_same_node in [true, false] {
        // Given: a client, and the application that handles its type with a renamed field
        let (loopback, directory, handled) = (Loopback::new(), TestDirectory::new(), Arc::default());
        let socket = directory.join("hip.sock");
        let path = socket.clone();
        let hip = loopback.node("hip").configure(move |config| config.lncl.socket = Some(path));
        let (hip, other) = if is_of_same_node {
            (hip.app(knee(&handled)).start().expect("a node"), None)
        } else {
            let other = loopback.node("knee").app(knee(&handled)).start().expect("a node");
            (hip.start().expect("a node"), Some(other))
        };
        all_run(&[&hip]);
        let mut client = client(&socket);
        let knee = client.resolve("knee", DEADLINE).expect("the node answers").expect("it is required");
        let nodes = [Some(hip.handle().address()), other.as_ref().map(|node| node.handle().address())];
        for node in nodes.into_iter().flatten() {
            // When: it sends. Then: the answers of both nodes to `sinew why` name the difference and both ends
            let found = until("the node knows the difference", || {
                // The decoder refuses the first messages, too.
                let outcome = client.message(knee, &sent::Limit { torque: 9.0 }).confirmed(DEADLINE);
                let malformed = Outcome::Rejected(Rejection::Malformed);
                assert_eq!(outcome.expect("the node takes it"), malformed);
                let report: MismatchesReport = ask_as(&mut client, node, &AskMismatches {});
                let of_limit =
                    |one: &MismatchReport| one.name.as_deref() == Some("types.limit") && one.seen > 0;
                report.mismatches.into_iter().find(of_limit)
            });
            assert_eq!((&*found.source.name, &*found.target.name), ("client.gait", "knee"));
            assert_eq!((&*found.treatment, &*found.policy), ("refused", "accept-additions"));
            let words =
                "field `torque` (f32) at the sender seems to be `newton_metres` (f32) at the receiver";
            assert_eq!(found.differences, [words]);
            // And: `sinew schema` has both structures
            let question = AskSchemas { kind: Kind::named("types.limit") };
            let report: SchemasReport = ask_as(&mut client, node, &question);
            assert!(report.schemas.iter().filter(|one| one.schema.is_some()).count() == 2, "{report:#?}");
        }
        assert_eq!(handled.load(Ordering::Relaxed), 0, "no message is handled");
    }
}

#[test]
fn application_is_refused_by_the_declaration_of_a_client() {
    let (loopback, directory, handled) = (Loopback::new(), TestDirectory::new(), Arc::default());
    let socket = directory.join("hip.sock");
    let path = socket.clone();
    let (gait, probe) = sender_app("gait");
    let hip = loopback.node("hip").configure(move |config| config.lncl.socket = Some(path));
    let hip = hip.app(gait).app(knee(&handled)).start().expect("a node");
    all_run(&[&hip]);
    let client = client(&socket);
    let sender = probe.sender();
    let declared = sent::Declared { torque: 9.0 };
    until("the message for the client is refused", || {
        // The client takes no message: only the routing table answers, at once.
        match sender.message(client.tid(), &declared).confirmed(Duration::from_millis(50)) {
            Err(SendError::Rejected(Rejection::Malformed)) => Some(()),
            Err(why) => panic!("another refusal: {why}"),
            Ok(receipt) => {
                wait(receipt);
                None
            }
        }
    });
    // When: the client has ended. Then: nothing of it is left for the next owner of its address.
    let (node, tid) = (hip.handle().address(), client.tid());
    drop(client);
    until("its types are forgotten", || {
        let left = mismatches(&sender, node).into_iter().any(|one| one.target.tid == tid);
        (!left).then_some(())
    });
}
