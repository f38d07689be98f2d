//! Claims about verdicts, one per test.

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use sinew_runtime::{
    outcome::Rejection,
    router::{LocalRoute, MessageSink, Router, SubmitError, mismatches::Mismatches},
    wire::{Header, Message},
};

use sinew_schema::Shape;

use super::*;

const HERE: NodeAddress = NodeAddress::new(1);
const HIP: NodeAddress = NodeAddress::new(2);
const SOURCE: Tid = Tid::new(HIP, AppAddress::new(0x1000));
const KNEE: AppAddress = AppAddress::new(0x1001);
const KIND: Kind = Kind::named("demo.gains");

#[derive(Serialize, Deserialize)]
struct Gains {
    kp: f32,
}

#[derive(Serialize, Deserialize)]
struct WithDamping {
    kp: f32,
    kd: f32,
}

#[derive(Serialize, Deserialize)]
struct Renamed {
    gain: f32,
}

fn schema<T: Serialize + DeserializeOwned>() -> Schema {
    Schema::of::<T>().unwrap()
}

fn handled<T: Serialize + DeserializeOwned>() -> Handled {
    let schema = Structure::Declared(Arc::new(schema::<T>()));
    let (hash, policy) = (schema.hash(), MismatchPolicy::default());
    let (name, program) = ("knee.drive".to_owned(), Program::Node);
    Handled { app: KNEE, name, kind: KIND, hash, policy, is_protected: false, schema, program }
}

fn sent<T: Serialize + DeserializeOwned>() -> Sent {
    Sent { tid: SOURCE, name: "gait".into(), kind: KIND, hash: schema::<T>().hash(), here: None }
}

/// Returns the same type of an application of this node.
fn sent_here<T: Serialize + DeserializeOwned>(program: Program) -> Sent {
    let here = Some((Structure::Declared(Arc::new(schema::<T>())), program));
    Sent { tid: Tid::new(HERE, AppAddress::new(0x1002)), here, ..sent::<T>() }
}

const fn at(seconds: u64) -> Time {
    Time::from_nanos((1_000 + seconds) * 1_000_000_000)
}

/// A node that has the verdicts in its routing table.
struct Bench {
    verdicts: Verdicts,
    router: Router,
}

struct Taken;

impl MessageSink for Taken {
    fn submit(&self, _: Message) -> Result<(), SubmitError> {
        Ok(())
    }
}

/// Compares everything that can be compared.
fn judge(verdicts: &mut Verdicts) {
    for case in verdicts.cases() {
        verdicts.decide(&case, case.judge());
    }
}

impl Bench {
    /// Returns a node with an application that handles `H`. The node has the structure `S` of the sender.
    fn of<S: Serialize + DeserializeOwned, H: Serialize + DeserializeOwned>() -> Self {
        let (mut verdicts, router) = (Verdicts::default(), Router::new(HERE));
        router.set_local(KNEE, LocalRoute { sink: Arc::new(Taken), events: Arc::new([]) });
        let of = (KIND, schema::<S>().hash());
        assert_eq!(verdicts.declare(at(0), &[handled::<H>()], &[sent::<S>()]), [(HIP, of)]);
        verdicts.received(HIP, of, &schema::<S>().encode()).unwrap();
        judge(&mut verdicts);
        let bench = Self { verdicts, router };
        bench.install();
        bench
    }

    fn install(&self) {
        let table = self.verdicts.table();
        let table = (!table.is_empty()).then(|| Mismatches::new(table, Arc::new(|| {})));
        assert!(self.router.set_mismatches(table, self.router.route_changes()));
    }

    fn delivers(&self) -> Result<(), Rejection> {
        self.router
            .deliver(Message::new(Header::new(KIND, SOURCE, Tid::new(HERE, KNEE)), bytes::Bytes::new()))
    }

    fn told(&mut self, now: Time) -> Vec<(Treatment, u64)> {
        let due = self.verdicts.take_due(now);
        self.install();
        due.into_iter().map(|one| (one.judgement.treatment, one.seen)).collect()
    }
}

#[test]
fn equal_or_unknown_types_are_not_compared() {
    let mut verdicts = Verdicts::default();
    assert_eq!(verdicts.declare(at(0), &[handled::<Gains>()], &[sent::<Gains>()]), []);
    assert_eq!(verdicts.declare(at(0), &[], &[sent::<Renamed>()]), []);
    assert_eq!(verdicts.declare(at(0), &[handled::<Gains>()], &[]), []);
    assert!(verdicts.table().is_empty() && verdicts.next_wake().is_none());
}

#[test]
fn conflict_is_refused_and_reported_once_a_minute() {
    let mut bench = Bench::of::<Renamed, Gains>();
    assert_eq!(bench.told(at(1)), [], "no message has arrived");
    for _ in 0..3 {
        assert_eq!(bench.delivers(), Err(Rejection::Malformed));
    }
    assert_eq!(bench.told(at(1)), [(Treatment::Refused, 3)]);
    assert_eq!(bench.delivers(), Err(Rejection::Malformed));
    assert_eq!(bench.told(at(60)), [], "it is within a minute");
    assert_eq!(bench.verdicts.next_wake(), Some(at(61)));
    assert_eq!(bench.told(at(61)), [(Treatment::Refused, 4)]);
    assert_eq!(bench.told(at(200)), [], "no further message has arrived");
}

#[test]
fn accepted_addition_is_reported_once_and_then_costs_nothing() {
    let mut bench = Bench::of::<WithDamping, Gains>();
    assert_eq!(bench.delivers(), Ok(()));
    assert_eq!(bench.told(at(1)), [(Treatment::Accepted, 1)]);
    assert!(bench.verdicts.table().is_empty());
    assert_eq!((bench.delivers(), bench.told(at(100))), (Ok(()), Vec::new()));
    assert_eq!(bench.verdicts.disagreements().len(), 1);
}

#[test]
fn verdict_ends_with_the_declaration() {
    let mut bench = Bench::of::<Renamed, Gains>();
    assert_eq!(bench.delivers(), Err(Rejection::Malformed));
    assert_eq!(bench.verdicts.declare(at(1), &[handled::<Gains>()], &[]), []);
    bench.install();
    assert_eq!(bench.delivers(), Ok(()));
    assert!(bench.verdicts.fetched(HIP, (KIND, schema::<Renamed>().hash())).is_none());
}

#[test]
fn missing_structure_is_requested_again_after_two_seconds() {
    let mut verdicts = Verdicts::default();
    let mut declare = |now| verdicts.declare(now, &[handled::<Gains>()], &[sent::<Renamed>()]);
    let wanted = [(HIP, (KIND, schema::<Renamed>().hash()))];
    assert_eq!(declare(at(0)), wanted);
    assert_eq!(declare(at(1)), []);
    assert_eq!(declare(at(2)), wanted);
}

#[test]
fn only_the_requested_structure_of_its_node_counts() {
    let mut verdicts = Verdicts::default();
    let of = (KIND, schema::<Renamed>().hash());
    let bytes = schema::<Renamed>().encode();
    verdicts.received(HIP, of, &bytes).unwrap();
    assert!(verdicts.fetched(HIP, of).is_none(), "nobody asked");
    verdicts.declare(at(0), &[handled::<Gains>()], &[sent::<Renamed>()]);
    verdicts.received(NodeAddress::new(9), of, &bytes).unwrap();
    judge(&mut verdicts);
    assert!(verdicts.table().is_empty(), "another node was asked");
    assert!(verdicts.received(HIP, of, &schema::<WithDamping>().encode()).is_err());
    assert!(verdicts.received(HIP, of, &[0xff; 9]).is_err());
    judge(&mut verdicts);
    assert!(verdicts.table().is_empty());
    verdicts.received(HIP, of, &bytes).unwrap();
    judge(&mut verdicts);
    assert_eq!(verdicts.table().len(), 1);
}

#[test]
fn strict_type_is_refused_until_the_structure_is_there() {
    let mut verdicts = Verdicts::default();
    let strict = Handled { policy: MismatchPolicy::Refuse, ..handled::<Gains>() };
    verdicts.declare(at(0), std::slice::from_ref(&strict), &[sent::<WithDamping>()]);
    assert_eq!(verdicts.table().len(), 1, "it is refused at once");
    let router = Router::new(HERE);
    router.set_local(KNEE, LocalRoute { sink: Arc::new(Taken), events: Arc::new([]) });
    let mut bench = Bench { verdicts, router };
    bench.install();
    assert_eq!((bench.delivers(), bench.told(at(1))), (Err(Rejection::Malformed), Vec::new()));
    // An addition is refused too, and is logged.
    let of = (KIND, schema::<WithDamping>().hash());
    bench.verdicts.received(HIP, of, &schema::<WithDamping>().encode()).unwrap();
    judge(&mut bench.verdicts);
    bench.install();
    assert_eq!(bench.delivers(), Err(Rejection::Malformed));
    assert_eq!(bench.told(at(1)), [(Treatment::Refused, 1)]);
    // The declaration of the structure that the receiver has ends it.
    bench.verdicts.declare(at(2), &[strict], &[sent::<Gains>()]);
    bench.install();
    assert_eq!(bench.delivers(), Ok(()));
}

#[test]
fn structure_of_a_node_judges_its_own_messages_only() {
    let mut verdicts = Verdicts::default();
    let of = (KIND, schema::<Renamed>().hash());
    let foot = NodeAddress::new(3);
    let of_foot = Sent { tid: Tid::new(foot, AppAddress::new(0x1000)), ..sent::<Renamed>() };
    let both = [sent::<Renamed>(), of_foot.clone()];
    assert_eq!(verdicts.declare(at(0), &[handled::<Gains>()], &both), [(HIP, of), (foot, of)]);
    verdicts.received(HIP, of, &schema::<Renamed>().encode()).unwrap();
    judge(&mut verdicts);
    let judged: Vec<_> = verdicts.table().into_iter().map(|(path, _)| path.source.node).collect();
    assert_eq!(judged, [HIP]);
    // The structure of the one does not serve for the other at the next declaration either.
    assert_eq!(verdicts.declare(at(2), &[handled::<Gains>()], &both), [(foot, of)]);
    judge(&mut verdicts);
    assert!(verdicts.fetched(foot, of).is_none() && verdicts.table().len() == 1);
    verdicts.received(foot, of, &schema::<Renamed>().encode()).unwrap();
    judge(&mut verdicts);
    assert_eq!(verdicts.table().len(), 2);
}

/// A type that the application `n` of `node` sends, with a hash of its own.
fn one_of_many(node: NodeAddress, n: u32) -> Sent {
    Sent { tid: Tid::new(node, AppAddress::new(0x1000 + n)), hash: SchemaHash(n.into()), ..sent::<Renamed>() }
}

#[test]
fn no_node_takes_the_room_of_others() {
    let mut verdicts = Verdicts::default();
    let many: Vec<_> = (0..1_000).map(|n| one_of_many(HIP, n)).collect();
    let late = one_of_many(NodeAddress::new(3), 0);
    let all: Vec<_> = many.iter().chain([&late]).cloned().collect();
    let wanted = verdicts.declare(at(0), &[handled::<Gains>()], &all);
    assert_eq!(verdicts.pairs.len(), PATHS_OF_NODE_MAX + 1);
    assert_eq!(wanted.iter().filter(|(node, _)| *node == HIP).count(), ASKED_OF_NODE_MAX);
    assert!(wanted.contains(&(late.tid.node, (KIND, late.hash))));
    assert_eq!(verdicts.take_left_out(at(9)), None, "verdicts may make room");
    assert_eq!(verdicts.take_left_out(at(10)), Some(1_000 - PATHS_OF_NODE_MAX));
    verdicts.declare(at(1), &[handled::<Gains>()], &all);
    assert_eq!(verdicts.take_left_out(at(20)), None, "it is told once");
    // Structures that do not come hold up no other ones.
    let again = verdicts.declare(at(2), &[handled::<Gains>()], &all);
    let of_hip: BTreeSet<_> = again.iter().filter(|(node, _)| *node == HIP).collect();
    assert!(of_hip.len() == ASKED_OF_NODE_MAX && wanted.iter().all(|one| !of_hip.contains(one)));
    assert_eq!(verdicts.next_wake(), Some(at(4)), "those that wait for their turn wake nobody");
    // All nodes together.
    let of_many = (0..10).flat_map(|node| (0..60).map(move |n| one_of_many(NodeAddress::new(10 + node), n)));
    verdicts.declare(at(3), &[handled::<Gains>()], &of_many.collect::<Vec<_>>());
    assert_eq!(verdicts.pairs.len(), MISMATCHES_MAX);
}

#[test]
fn guests_take_no_room_of_others() {
    let count = PATHS_OF_NODE_MAX as u32;
    // Given: as many guests of this node as there is room, listed before another sender of it
    let here = || Some((Structure::Declared(Arc::new(schema::<Renamed>())), Program::Guest));
    let guests = (0..count).map(|n| Sent { here: here(), ..one_of_many(HERE, 0x100 + n) });
    let other = sent_here::<Renamed>(Program::Other);
    let senders: Vec<_> = guests.chain([other.clone()]).collect();
    let mut verdicts = Verdicts::default();
    verdicts.declare(at(0), &[handled::<Gains>()], &senders);
    let path = |source| TypedPath { source, target: KNEE, kind: KIND };
    assert!(verdicts.pairs.contains_key(&path(other.tid)) && verdicts.pairs.len() == PATHS_OF_NODE_MAX);
    // And: receivers, for a sender on another node
    let guest =
        |n| Handled { app: AppAddress::new(0x2000 + n), program: Program::Guest, ..handled::<Gains>() };
    let receivers: Vec<_> = (0..count).map(guest).chain([handled::<Gains>()]).collect();
    verdicts.declare(at(1), &receivers, &[sent::<Renamed>()]);
    assert!(verdicts.pairs.contains_key(&path(SOURCE)) && verdicts.pairs.len() == PATHS_OF_NODE_MAX);
}

/// Returns two structures that are the same on the wire: a part of them has another name.
fn same_on_the_wire() -> (Structure, Schema) {
    let named = |part: &str| {
        let parts = [(part.to_owned(), Shape::Struct(Vec::new()))];
        Schema { root: Shape::List(Box::new(Shape::Named(part.to_owned()))), types: parts.into() }
    };
    (Structure::Declared(Arc::new(named("Here"))), named("There"))
}

#[test]
fn paths_without_a_difference_take_no_room() {
    let (schema, there) = same_on_the_wire();
    let handled = Handled { hash: schema.hash(), schema, ..handled::<Gains>() };
    let of = (KIND, there.hash());
    let count = PATHS_OF_NODE_MAX as u32;
    let same: Vec<_> = (0..count).map(|n| Sent { hash: of.1, ..one_of_many(HIP, n) }).collect();
    let mut verdicts = Verdicts::default();
    assert_eq!(verdicts.declare(at(0), std::slice::from_ref(&handled), &same), [(HIP, of)]);
    verdicts.received(HIP, of, &there.encode()).unwrap();
    judge(&mut verdicts);
    assert!(verdicts.table().is_empty() && verdicts.disagreements().is_empty());
    let others = (0..count).map(|n| one_of_many(HIP, 0x1000 + n));
    let all: Vec<_> = same.into_iter().chain(others).collect();
    verdicts.declare(at(1), &[handled], &all);
    assert_eq!((verdicts.pairs.len(), verdicts.take_left_out(at(20))), (2 * PATHS_OF_NODE_MAX, None));
}

#[test]
fn verdict_without_a_difference_makes_room() {
    let (schema, of) = same_on_the_wire();
    let handled = Handled { hash: schema.hash(), schema, ..handled::<Gains>() };
    let count = PATHS_OF_NODE_MAX as u32 + 1;
    let same: Vec<_> = (0..count).map(|n| Sent { hash: of.hash(), ..one_of_many(HIP, n) }).collect();
    let mut verdicts = Verdicts::default();
    verdicts.declare(at(0), std::slice::from_ref(&handled), &same);
    verdicts.received(HIP, (KIND, of.hash()), &of.encode()).unwrap();
    assert_ne!(verdicts.next_wake(), Some(at(0)));
    judge(&mut verdicts);
    assert_eq!((verdicts.pairs.len(), verdicts.next_wake()), (PATHS_OF_NODE_MAX, Some(at(0))));
    verdicts.declare(at(1), &[handled], &same);
    judge(&mut verdicts);
    assert_eq!((verdicts.pairs.len(), verdicts.next_wake()), (count as usize, None));
}

#[test]
fn reports_to_one_node_are_spread_over_steps() {
    let mut verdicts = Verdicts::default();
    let of = (KIND, schema::<Renamed>().hash());
    let count = TOLD_AT_ONCE_MAX as u32 + 1;
    let all: Vec<_> = (0..count).map(|n| Sent { hash: of.1, ..one_of_many(HIP, n) }).collect();
    verdicts.declare(at(0), &[handled::<Gains>()], &all);
    verdicts.received(HIP, of, &schema::<Renamed>().encode()).unwrap();
    judge(&mut verdicts);
    let router = Router::new(HERE);
    router.set_local(KNEE, LocalRoute { sink: Arc::new(Taken), events: Arc::new([]) });
    let mut bench = Bench { verdicts, router };
    bench.install();
    for sent in &all {
        let header = Header::new(KIND, sent.tid, Tid::new(HERE, KNEE));
        assert!(bench.router.deliver(Message::new(header, bytes::Bytes::new())).is_err());
    }
    assert_eq!(bench.told(at(1)).len(), TOLD_AT_ONCE_MAX);
    assert_eq!(bench.verdicts.next_wake(), Some(at(1)));
    assert_eq!(bench.told(at(1)).len(), 1);
    assert_eq!(bench.verdicts.next_wake(), Some(at(61)));
}

#[test]
fn types_of_two_programs_of_one_node_are_compared() {
    let (knee, mut verdicts) = (handled::<Gains>(), Verdicts::default());
    // Two applications of the node's own program, of which one has the type under another name.
    assert!(
        verdicts
            .declare(at(0), std::slice::from_ref(&knee), &[sent_here::<Renamed>(Program::Node)])
            .is_empty()
    );
    assert!(verdicts.pairs.is_empty());
    let of_client = Handled { program: Program::Other, ..knee.clone() };
    for (handled, sender) in
        [(&knee, Program::Other), (&of_client, Program::Node), (&of_client, Program::Other)]
    {
        let mut verdicts = Verdicts::default();
        let sent = [sent_here::<Renamed>(sender)];
        // Nothing is fetched: both structures are there.
        assert!(verdicts.declare(at(0), std::slice::from_ref(handled), &sent).is_empty());
        judge(&mut verdicts);
        let treatments: Vec<_> = verdicts.disagreements().iter().map(|one| one.judgement.treatment).collect();
        assert_eq!((treatments, verdicts.table().len()), (vec![Treatment::Refused], 1));
    }
    let same = sent_here::<Gains>(Program::Other);
    verdicts.declare(at(1), &[knee], &[same]);
    assert!(verdicts.pairs.is_empty());
}
