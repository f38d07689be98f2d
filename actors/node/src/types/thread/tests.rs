//! A node with a peer that sends or handles a type in another version, step by step, without the thread.

use std::sync::Mutex;

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use sinew_model::{
    config::NodeConfig,
    facts::{AppFact, DeclaredTypes, LinkFact, TypeDeclaration, User},
    ports::AppTypes as _,
};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery, DynApp},
    router::{LocalRoute, MessageSink, SubmitError},
    tid::Incarnation,
    wire::{Payload, PayloadType, decode},
};
use sinew_sync::{
    FrameHandler, Input, Name,
    list::{Entry, List},
};

use super::*;
use crate::types::{FRAMES_OF_NODE_MAX, Frames};

const PEER: NodeAddress = NodeAddress::new(0x7f00_0009);
const INCARNATION: Incarnation = Incarnation(5);
const KNEE: AppAddress = AppAddress::new(0x1001);
const GAIT: AppAddress = AppAddress::new(0x1002);

#[derive(Serialize, Deserialize)]
struct Gains {
    kp: f32,
}

impl Payload for Gains {
    const NAME: &'static str = "test.thread.gains";
}

/// The same type in another program.
#[derive(Serialize, Deserialize)]
struct Renamed {
    gain: f32,
}

impl Payload for Renamed {
    const NAME: &'static str = "test.thread.gains";
}

struct Knee;

impl actix::Actor for Knee {
    type Context = AppContext<Self>;
}

impl actix::Handler<Delivery<Gains>> for Knee {
    type Result = ();
    fn handle(&mut self, _: Delivery<Gains>, _: &mut Self::Context) {}
}

/// Keeps the frames for the peer.
#[derive(Default)]
struct Sink(Mutex<Vec<(Kind, Bytes)>>);

impl MessageSink for Sink {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        lock(&self.0).push((message.header.kind, message.payload));
        Ok(())
    }
}

struct Bench {
    state: Arc<NodeState>,
    comparing: Comparing,
    peer: Arc<Sink>,
}

impl Bench {
    /// Returns a node with a linked peer.
    fn new() -> Self {
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let (peer, local) = (Arc::new(Sink::default()), Arc::new(Sink::default()));
        state.ctx.router.set_peer(PEER, peer.clone());
        state.ctx.router.set_local(KNEE, LocalRoute { sink: local, events: Arc::new([]) });
        let comparing = Comparing {
            state: Arc::downgrade(&state),
            wake: state.types.wake.clone(),
            changes: state.ctx.directory_changes.subscribe(),
            lists: BTreeMap::new(),
            installed: (Vec::new(), 0),
            answered: BTreeMap::new(),
        };
        let bench = Self { state, comparing, peer };
        bench.input(Input::LinkChanged(LinkFact::LinkUp { node: PEER, incarnation: INCARNATION }));
        bench
    }

    fn input(&self, input: Input) {
        lock(&self.state.sync.core).handle(Time::now(), input);
    }

    /// Registers an application of this node with these types, in the table of types and in the directory.
    fn registers(&self, app: AppAddress, name: &str, handles: &[PayloadType], sends: &[PayloadType]) {
        self.state.types.register(app, handles, sends);
        self.input(Input::AppChanged(AppFact::own_registered(app, Some(name.to_owned()), Vec::new())));
        let hash = |one: &PayloadType| (one.kind(), one.schema().unwrap().hash());
        let types = DeclaredTypes {
            handles: handles.iter().map(hash).collect(),
            sends: sends.iter().map(hash).collect(),
        };
        self.input(Input::AppChanged(AppFact::Types { app, types }));
    }

    /// The peer lists an application with these types.
    fn peer_lists(&self, app: AppAddress, types: DeclaredTypes) {
        let entry = Entry {
            name: Name::try_from("gait".to_owned()).unwrap(),
            app,
            ready: true,
            ended: None,
            phases: Vec::new(),
            requires: Vec::new(),
            kinds: Vec::new(),
            handles: types.handles,
            sends: types.sends,
        };
        let list = List { incarnation: INCARNATION, version: 1, entries: vec![entry], groups: Vec::new() };
        self.input(Input::ListReceived { from: PEER, payload: list.encode_within(usize::MAX, 0).0 });
    }

    fn peer_sends<T: Serialize>(&self, kind: Kind, frame: &T) -> Result<(), String> {
        let (source, to) =
            (Tid::new(PEER, AppAddress::SYNC), Tid::new(self.state.ctx.node, AppAddress::SYNC));
        let message = Message::new(Header::new(kind, source, to), encode(frame));
        Frames(Arc::downgrade(&self.state)).receive(PEER, &message)
    }

    /// Runs a step. Returns the frames that it has sent to the peer.
    fn steps(&mut self) -> Vec<(Kind, Bytes)> {
        let state = self.state.clone();
        self.comparing.step(&state);
        std::mem::take(&mut *lock(&self.peer.0))
    }

    fn delivers(&self) -> Result<(), Rejection> {
        let to = Tid::new(self.state.ctx.node, KNEE);
        self.state
            .ctx
            .router
            .deliver(Message::new(Header::new(Gains::KIND, Tid::new(PEER, GAIT), to), Bytes::new()))
    }

    fn faults(&self) -> u64 {
        let by_cause = self.state.ctx.refusals.by_cause();
        by_cause.into_iter().find(|(cause, _)| *cause == "types").map_or(0, |(_, count)| count)
    }
}

/// Returns both versions of the type.
fn versions() -> (PayloadType, PayloadType) {
    let app: DynApp = AppSpec::new("knee", || Knee).handles::<Gains>().sends::<Renamed>().into();
    (app.types()[0], app.sends()[0])
}

fn declared(sends: PayloadType) -> DeclaredTypes {
    let sends = vec![(sends.kind(), sends.schema().unwrap().hash())];
    DeclaredTypes { sends, ..DeclaredTypes::default() }
}

#[test]
fn differing_type_is_fetched_refused_and_reported() {
    let (gains, renamed) = versions();
    let mut bench = Bench::new();
    bench.registers(KNEE, "knee", &[gains], &[]);
    bench.peer_lists(GAIT, declared(renamed));
    // The structure is requested, and messages pass until it is there.
    let sent = bench.steps();
    let [(Kind::SYNC_SCHEMA_ASK, question)] = &sent[..] else { panic!("{sent:?}") };
    let hash = renamed.schema().unwrap().hash();
    assert_eq!(decode::<SchemaQuestion>(question).unwrap(), SchemaQuestion { kind: Gains::KIND, hash });
    assert_eq!(bench.delivers(), Ok(()));
    // With the structure they are refused, and the peer is told once.
    let schema = renamed.schema().unwrap().schema().encode();
    bench.peer_sends(Kind::SYNC_SCHEMA, &SchemaAnswer { kind: Gains::KIND, hash, schema }).unwrap();
    assert_eq!(bench.steps(), []);
    assert_eq!(bench.delivers(), Err(Rejection::Malformed));
    let sent = bench.steps();
    let [(Kind::SYNC_MISMATCH, report)] = &sent[..] else { panic!("{sent:?}") };
    let report: MismatchReport = decode(report).unwrap();
    assert_eq!((report.source, report.target, report.seen, report.refused), (GAIT, KNEE, 1, true));
    assert_eq!(report.schema, gains.schema().unwrap().schema().encode());
    assert_eq!(bench.delivers(), Err(Rejection::Malformed));
    assert_eq!((bench.steps(), bench.faults()), (Vec::new(), 0));
    // The peer's next incarnation has declared nothing yet. Its first message comes before the directory learns of it.
    bench.state.ctx.router.set_peer(PEER, Arc::new(Sink::default()));
    assert_eq!(bench.delivers(), Ok(()));
    bench.input(Input::LinkChanged(LinkFact::LinkBroken { node: PEER, incarnation: INCARNATION }));
    bench.input(Input::LinkChanged(LinkFact::LinkUp { node: PEER, incarnation: Incarnation(6) }));
    assert_eq!((bench.steps(), bench.delivers()), (Vec::new(), Ok(())));
}

#[test]
fn question_and_report_of_the_peer_are_answered() {
    let (gains, renamed) = versions();
    let mut bench = Bench::new();
    bench.registers(GAIT, "gait", &[], &[renamed]);
    let hash = renamed.schema().unwrap().hash();
    let question = SchemaQuestion { kind: Gains::KIND, hash };
    bench.peer_sends(Kind::SYNC_SCHEMA_ASK, &question).unwrap();
    let sent = bench.steps();
    let [(Kind::SYNC_SCHEMA, answer)] = &sent[..] else { panic!("{sent:?}") };
    let schema = renamed.schema().unwrap().schema().encode();
    assert_eq!(decode::<SchemaAnswer>(answer).unwrap(), SchemaAnswer { kind: Gains::KIND, hash, schema });
    let report = MismatchReport {
        source: GAIT,
        target: KNEE,
        kind: Gains::KIND,
        hash: gains.schema().unwrap().hash(),
        policy: "accept-additions".to_owned(),
        refused: true,
        seen: 1,
        schema: gains.schema().unwrap().schema().encode(),
    };
    // The clock of the test does not reach the end of the pause.
    bench.comparing.answered.values_mut().for_each(|at| *at = Time::now() + Duration::from_secs(3_600));
    // A report on a type that the peer does not list as handled is refused. So is an early repetition of a question.
    bench.peer_sends(Kind::SYNC_MISMATCH, &report).unwrap();
    bench.peer_sends(Kind::SYNC_SCHEMA_ASK, &question).unwrap();
    assert_eq!((bench.steps(), bench.faults()), (Vec::new(), 2));
    let handles = vec![(Gains::KIND, report.hash)];
    bench.peer_lists(KNEE, DeclaredTypes { handles, ..DeclaredTypes::default() });
    bench.peer_sends(Kind::SYNC_MISMATCH, &report).unwrap();
    assert_eq!((bench.steps(), bench.faults()), (Vec::new(), 2));
    let reports = lock(&bench.state.types.reported).reports();
    assert_eq!((reports.len(), reports[0].judgement.treatment), (1, Treatment::Refused));
    // An unknown structure, and a report on an application that does not send the type, are faults of the peer.
    bench
        .peer_sends(
            Kind::SYNC_SCHEMA_ASK,
            &SchemaQuestion { hash: sinew_runtime::wire::SchemaHash(1), ..question },
        )
        .unwrap();
    bench.peer_sends(Kind::SYNC_MISMATCH, &MismatchReport { source: KNEE, ..report }).unwrap();
    assert_eq!((bench.steps(), bench.faults()), (Vec::new(), 4));
}

#[test]
fn frames_of_one_node_leave_room_for_others() {
    let bench = Bench::new();
    let question = SchemaQuestion { kind: Gains::KIND, hash: sinew_runtime::wire::SchemaHash(1) };
    for _ in 0..FRAMES_OF_NODE_MAX {
        bench.peer_sends(Kind::SYNC_SCHEMA_ASK, &question).unwrap();
    }
    let refused = bench.peer_sends(Kind::SYNC_SCHEMA_ASK, &question);
    assert!(refused.is_err_and(|why| why.contains("of it that wait")));
    let mut header = Header::new(Kind::SYNC_SCHEMA_ASK, Tid::NONE, Tid::NONE);
    header.class = Class::Bulk;
    let message = Message::new(header, encode(&question));
    Frames(Arc::downgrade(&bench.state)).receive(NodeAddress::new(0x7f00_000a), &message).unwrap();
}

/// Returns the declaration of a client that sends the type.
fn declaration(sends: PayloadType) -> TypeDeclaration {
    let (kind, policy) = (sends.kind(), sends.mismatch().word().to_owned());
    let schema = sends.schema().unwrap().schema().encode();
    TypeDeclaration { kind, handles: false, sends: true, policy, protected: false, schema }
}

#[test]
fn type_is_compared_within_node_until_its_client_ends() {
    let (gains, renamed) = versions();
    let mut bench = Bench::new();
    bench.registers(KNEE, "knee", &[gains], &[]);
    bench.input(Input::AppChanged(AppFact::own_registered(GAIT, Some("gait".to_owned()), Vec::new())));
    bench.state.declare(GAIT, User::Own, declaration(renamed)).unwrap();
    bench.input(Input::AppChanged(AppFact::Types { app: GAIT, types: declared(renamed) }));
    // Both structures are here: nothing is fetched, and no frame is sent to another node.
    assert_eq!(bench.steps(), []);
    let node = bench.state.ctx.node;
    let state = bench.state.clone();
    let send = || {
        let header = Header::new(Gains::KIND, Tid::new(node, GAIT), Tid::new(node, KNEE));
        state.ctx.router.send(Message::new(header, Bytes::new()))
    };
    assert_eq!(send(), Err(Rejection::Malformed));
    assert_eq!(bench.steps(), []);
    let [one] = &lock(&bench.state.types.verdicts).disagreements()[..] else { panic!("there is one") };
    let words = "field `gain` (f32) at the sender seems to be `kp` (f32) at the receiver";
    assert_eq!(
        (&*one.source, &*one.target, &one.judgement.differences[..]),
        ("gait", "knee", &[words.to_owned()][..])
    );
    // The directory learns later than the table of types that the client has ended.
    bench.state.forget(GAIT);
    bench.state.ctx.router.remove_local(GAIT);
    assert_eq!(send(), Ok(()));
    assert_eq!((bench.steps(), send(), bench.faults()), (Vec::new(), Ok(()), 0));
}

#[test]
fn question_for_the_structure_of_a_client_is_answered() {
    // No Rust type of this process has the name.
    let (gains, _) = versions();
    let (kind, traced) = (Kind::named("test.thread.of_client"), gains.schema().unwrap());
    let (bytes, hash) = (traced.schema().encode(), traced.hash());
    let mut bench = Bench::new();
    let declaration = TypeDeclaration { kind, ..declaration(gains) };
    bench.state.declare(GAIT, User::Guest(1_001), declaration.clone()).unwrap();
    bench.peer_sends(Kind::SYNC_SCHEMA_ASK, &SchemaQuestion { kind, hash }).unwrap();
    let sent = bench.steps();
    let [(Kind::SYNC_SCHEMA, answer)] = &sent[..] else { panic!("{sent:?}") };
    assert_eq!(decode::<SchemaAnswer>(answer).unwrap(), SchemaAnswer { kind, hash, schema: bytes.clone() });
    // A recorder gets no structure of a guest: it would apply to messages of other applications, too.
    assert_eq!(bench.state.types.schema_of(kind), None);
    bench.state.forget(GAIT);
    bench.state.declare(GAIT, User::Own, declaration).unwrap();
    assert_eq!(bench.state.types.schema_of(kind), Some(bytes));
    bench.state.forget(GAIT);
    assert_eq!(bench.state.types.schema_of(kind), None);
}
