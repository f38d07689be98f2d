//! The guarantees of held wills, one claim per test.

use std::sync::Arc;

use bytes::Bytes;
use sinew_model::{config::NodeConfig, ports::testing::PlayedLinks};
use sinew_runtime::{
    app::{LastWill, Will, WillRecipient},
    lock,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Class, Header, Kind, Message},
};

use super::{
    Core, Input,
    core::{Output, REPEAT},
    feed,
    protocol::{HeldWill, PAYLOAD_MAX, Testament, WILLS_MAX},
    receive,
};
use crate::State;

const THERE: NodeAddress = NodeAddress::new(0x7f00_0002);
const INCARNATION: Incarnation = Incarnation(5);
const NEXT_INCARNATION: Incarnation = Incarnation(6);
const UP: Input = Input::LinkUp { node: THERE, incarnation: INCARNATION };
const LOST: Input = Input::NodeLost { node: THERE, incarnation: INCARNATION };

fn app(index: u32) -> AppAddress {
    AppAddress::fixed(index).unwrap()
}

fn will(length: usize) -> Will {
    Will {
        recipient: WillRecipient::Name("drive".to_owned()),
        kind: Kind::named("stop"),
        class: Class::Control,
        payload: Bytes::from(vec![0; length]),
        when: LastWill::OnDeath,
    }
}

fn held() -> HeldWill {
    HeldWill::new(app(0), &will(3)).unwrap()
}

fn received(incarnation: Incarnation, version: u64) -> Input {
    Input::TestamentReceived {
        from: THERE,
        testament: Testament { incarnation, version, wills: vec![held()] },
    }
}

/// The message of a node with one application that has one will.
fn message(incarnation: Incarnation, app: AppAddress, will: &Will) -> Message {
    let wills = vec![HeldWill::new(app, will).expect("one that others hold")];
    let payload =
        rmp_serde::to_vec_named(&Testament { incarnation, version: 1, wills }).expect("it is plain");
    Message::new(Header::new(Kind::SYNC_WILLS, Tid::NONE, Tid::NONE), payload.into())
}

struct Bench {
    core: Core,
    now: Time,
}

impl Bench {
    fn new() -> Self {
        Self { core: Core::new(INCARNATION, 4, 1 << 20), now: Time::from_nanos(1_000_000_000) }
    }

    fn handle(&mut self, input: Input) -> Vec<Output> {
        self.core.handle(self.now, input);
        std::iter::from_fn(|| self.core.poll()).collect()
    }
}

fn executed(outputs: &[Output]) -> usize {
    outputs.iter().filter(|output| matches!(output, Output::Execute { .. })).count()
}

// spec: WILL-2
#[test]
fn wills_run_once_per_loss_and_not_after_leave() {
    let mut bench = Bench::new();
    bench.handle(UP);
    bench.handle(received(INCARNATION, 1));
    let former = Input::NodeLost { node: THERE, incarnation: Incarnation(4) };
    assert_eq!(executed(&bench.handle(former)), 0);
    assert_eq!(executed(&bench.handle(LOST)), 1);
    assert_eq!(executed(&bench.handle(LOST)), 0);
    // It was only frozen, and is lost again.
    bench.handle(received(INCARNATION, 2));
    assert_eq!(executed(&bench.handle(LOST)), 1);
    bench.handle(received(INCARNATION, 3));
    assert_eq!(executed(&bench.handle(Input::NodeLeft { node: THERE, incarnation: INCARNATION })), 0);
    assert_eq!(executed(&bench.handle(LOST)), 0);
}

// spec: WILL-2
#[test]
fn wills_of_quitting_node_run_only_without_goodbye() {
    let gives_up = Input::GaveUp { node: THERE, incarnation: INCARNATION };
    let left = Input::NodeLeft { node: THERE, incarnation: INCARNATION };
    let broken = Input::LinkBroken { node: THERE, incarnation: INCARNATION };
    for (then, count) in [(vec![left, broken.clone()], 0), (vec![broken.clone()], 1)] {
        let mut bench = Bench::new();
        bench.handle(UP);
        bench.handle(received(INCARNATION, 1));
        assert_eq!(executed(&bench.handle(gives_up.clone())), 0);
        assert_eq!(then.into_iter().map(|input| executed(&bench.handle(input))).sum::<usize>(), count);
    }
    // And: if the link broke before, no other event decides on its wills
    let mut bench = Bench::new();
    bench.handle(UP);
    bench.handle(received(INCARNATION, 1));
    bench.handle(broken);
    assert_eq!(executed(&bench.handle(gives_up)), 1);
}

// spec: WILL-5
#[test]
fn wills_of_revoked_node_are_not_executed() {
    let revoked = || Input::Revoked { node: THERE, incarnation: INCARNATION };
    for end in
        [LOST, Input::LinkUp { node: THERE, incarnation: NEXT_INCARNATION }, received(NEXT_INCARNATION, 1)]
    {
        let mut bench = Bench::new();
        bench.handle(UP);
        bench.handle(received(INCARNATION, 1));
        assert_eq!(executed(&bench.handle(revoked())), 0);
        assert_eq!(executed(&bench.handle(end)), 0);
    }
    // Wills of the next incarnation, which has other keys, are executed.
    let mut bench = Bench::new();
    bench.handle(received(NEXT_INCARNATION, 1));
    bench.handle(revoked());
    assert_eq!(executed(&bench.handle(Input::NodeLost { node: THERE, incarnation: NEXT_INCARNATION })), 1);
}

// spec: WILL-6
#[test]
fn list_of_another_incarnation_is_rejected() {
    let state = State::for_test(NodeConfig::new("hip"), INCARNATION);
    let list = |number| message(Incarnation(number), app(0), &will(3));
    assert!(receive(&state, THERE, &list(5)).is_err(), "no node is linked");
    feed(&state, UP);
    receive(&state, THERE, &list(5)).expect("of the linked incarnation");
    // When: it claims ever later incarnations
    for number in [4, 6, 7, u64::MAX] {
        let refused = receive(&state, THERE, &list(number)).expect_err("of another incarnation");
        assert!(refused.contains("another incarnation"), "{refused}");
    }
    // Then: only the list of its own incarnation is still held
    let mut core = lock(&state.wills);
    let mut executed_at = |end| {
        core.handle(Time::now(), end);
        let outputs: Vec<_> = std::iter::from_fn(|| core.poll()).collect();
        executed(&outputs)
    };
    assert_eq!(executed_at(LOST), 1);
    assert_eq!(executed_at(Input::NodeLost { node: THERE, incarnation: Incarnation(u64::MAX) }), 0);
}

fn with_links(links: &Arc<PlayedLinks>) -> Arc<State> {
    let state = State::for_test(NodeConfig::new("hip"), INCARNATION);
    state.ctx.ports.connect_links(&(links.clone() as Arc<_>));
    state
}

fn held_of(state: &State, incarnation: Incarnation) -> usize {
    let mut core = lock(&state.wills);
    core.handle(Time::now(), Input::NodeLost { node: THERE, incarnation });
    executed(&std::iter::from_fn(|| core.poll()).collect::<Vec<_>>())
}

// spec: WILL-5
#[test]
fn wills_of_a_revoked_node_are_dropped() {
    let proven = Some(INCARNATION);
    let links = Arc::new(PlayedLinks { linked: proven, authenticated: proven, ..PlayedLinks::default() });
    let state = with_links(&links);
    receive(&state, THERE, &message(INCARNATION, app(0), &will(3)))
        .expect("of the authenticated incarnation");
    // Wills of a future incarnation would outlive it.
    assert!(
        receive(&state, THERE, &message(NEXT_INCARNATION, app(0), &will(3))).is_err(),
        "another incarnation is linked"
    );
    // When: it is revoked, and sends them again all the same
    lock(&links.revoked).push((THERE, INCARNATION));
    receive(&state, THERE, &message(INCARNATION, app(0), &will(3))).expect("a legal one");
    // Then
    assert_eq!(held_of(&state, INCARNATION), 0);
}

// spec: WILL-6
#[test]
fn wills_of_another_incarnation_are_rejected_without_keys_too() {
    let links = Arc::new(PlayedLinks { linked: Some(INCARNATION), ..PlayedLinks::default() });
    let state = with_links(&links);
    receive(&state, THERE, &message(INCARNATION, app(0), &will(3))).expect("of the linked incarnation");
    // When: lists of ever later incarnations arrive on one link
    for number in 6..15 {
        let list = message(Incarnation(number), app(0), &will(3));
        assert!(receive(&state, THERE, &list).is_err(), "of another incarnation: {number}");
    }
    // Then: only that of its own incarnation is held
    assert_eq!(held_of(&state, INCARNATION), 1);
    assert_eq!((6..15).map(|number| held_of(&state, Incarnation(number))).sum::<usize>(), 0);
}

#[test]
fn log_lines_per_node_are_limited() {
    let state = State::for_test(NodeConfig::new("hip"), INCARNATION);
    // No recipient exists.
    let recipient = WillRecipient::Tid(Tid::new(state.ctx.node, app(1)));
    let held = HeldWill::new(app(0), &Will { recipient, ..will(3) }).expect("one that others hold");
    for number in [5, 6, 7] {
        let (node, incarnation) = (THERE, Incarnation(number));
        let testament = Testament { incarnation, version: 1, wills: vec![held.clone(); WILLS_MAX] };
        feed(&state, Input::TestamentReceived { from: node, testament });
        feed(&state, Input::NodeLost { node, incarnation });
    }
    let quotas = &state.ctx.log_quotas;
    for quota in [&quotas.wills, &quotas.wills_not_taken] {
        assert_ne!(quota.take(&THERE, Time::now()), Some(0), "some were left out");
    }
}

// spec: WILL-2
#[test]
fn end_of_duplicate_node_runs_no_other_wills() {
    let mut bench = Bench::new();
    bench.handle(UP);
    bench.handle(received(INCARNATION, 1));
    let duplicate = |incarnation| Input::Duplicate { node: THERE, incarnation };
    assert_eq!(executed(&bench.handle(duplicate(NEXT_INCARNATION))), 0, "the node runs");
    assert_eq!(executed(&bench.handle(duplicate(INCARNATION))), 1);
}

// spec: WILL-3
#[test]
fn new_incarnation_runs_wills_of_the_old_one_once() {
    for input in [Input::LinkUp { node: THERE, incarnation: NEXT_INCARNATION }, received(NEXT_INCARNATION, 1)]
    {
        let mut bench = Bench::new();
        bench.handle(UP);
        bench.handle(received(INCARNATION, 7));
        assert_eq!(executed(&bench.handle(input.clone())), 1, "{input:?}");
        assert_eq!(executed(&bench.handle(LOST)), 0, "{input:?}");
    }
}

#[test]
fn cut_link_and_older_list_have_no_effect() {
    let mut bench = Bench::new();
    bench.handle(UP);
    bench.handle(received(INCARNATION, 2));
    let empty = Testament { incarnation: INCARNATION, version: 1, wills: Vec::new() };
    bench.handle(Input::TestamentReceived { from: THERE, testament: empty });
    assert_eq!(executed(&bench.handle(Input::LinkBroken { node: THERE, incarnation: INCARNATION })), 0);
    assert_eq!(executed(&bench.handle(LOST)), 1);
}

// spec: WILL-1, WILL-4
#[test]
fn wills_are_sent_on_change_and_periodically() {
    let mut bench = Bench::new();
    assert_eq!(bench.handle(UP), [], "there are none");
    let wills: Arc<[Will]> = Arc::new([will(3), will(PAYLOAD_MAX + 1)]);
    let outputs = bench.handle(Input::Ready { app: app(0), wills: wills.clone() });
    let list = |version, wills| {
        [Output::Publish {
            to: THERE,
            testament: Testament { incarnation: INCARNATION, version, wills },
            left_out: 0,
        }]
    };
    assert_eq!(outputs, list(1, vec![held()]));
    bench.now = bench.now + REPEAT;
    assert_eq!(bench.handle(Input::TimePassed), list(2, vec![held()]));
    bench.now = bench.now + REPEAT / 2;
    assert_eq!(bench.handle(Input::Ended { app: app(0) }), list(3, Vec::new()));
    bench.now = bench.now + REPEAT * 2;
    assert_eq!(bench.handle(Input::TimePassed), []);
    for index in 0..WILLS_MAX as u32 + 1 {
        bench.handle(Input::Ready { app: app(index), wills: wills.clone() });
    }
    bench.now = bench.now + REPEAT;
    let Some(Output::Publish { testament, .. }) = bench.handle(Input::TimePassed).pop() else {
        panic!("a list")
    };
    assert_eq!(testament.wills.len(), WILLS_MAX);
}

// spec: WILL-4
#[test]
fn only_wills_that_fit_in_one_frame_are_sent() {
    let mut core = Core::new(INCARNATION, 4, 3_000);
    let now = Time::from_nanos(1_000_000_000);
    core.handle(now, UP);
    let wills: Arc<[Will]> = (0..5).map(|_| will(PAYLOAD_MAX)).chain([will(3)]).collect();
    core.handle(now, Input::Ready { app: app(0), wills });
    let Some(Output::Publish { testament, left_out, .. }) = core.poll() else { panic!("it is sent") };
    assert_eq!((testament.wills.len(), left_out), (3, 3));
    assert!(rmp_serde::to_vec_named(&testament).unwrap().len() <= 3_000);
}
