//! What holding wills promises, one claim a test.

use std::sync::Arc;

use bytes::Bytes;
use sinew_runtime::{
    app::{Heir, LastWill, Will},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Class, Header, Kind, Message},
};

use super::{
    Core, Input,
    core::{Output, REPEAT},
    feed, receive,
    words::{HeldWill, PAYLOAD_MAX, Testament, WILLS_MAX},
};
use crate::{
    config::NodeConfig,
    stores::{Stores, lock},
};

const THERE: NodeAddress = NodeAddress::new(0x7f00_0002);
const LIFE: Incarnation = Incarnation(5);
const NEXT_LIFE: Incarnation = Incarnation(6);
const UP: Input = Input::LinkUp { node: THERE, incarnation: LIFE };
const LOST: Input = Input::NodeLost { node: THERE, incarnation: LIFE };

fn app(index: u32) -> AppAddress {
    AppAddress::fixed(index).unwrap()
}

fn will(length: usize) -> Will {
    Will {
        heir: Heir::Name("drive".to_owned()),
        kind: Kind::named("stop"),
        class: Class::Control,
        payload: Bytes::from(vec![0; length]),
        when: LastWill::OnDeath,
    }
}

fn held() -> HeldWill {
    HeldWill::new(app(0), &will(3)).unwrap()
}

fn told(incarnation: Incarnation, version: u64) -> Input {
    Input::Told { from: THERE, testament: Testament { incarnation, version, wills: vec![held()] } }
}

/// What a node says whose application has one will.
pub(crate) fn said(incarnation: Incarnation, app: AppAddress, will: &Will) -> Message {
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
        Self { core: Core::new(LIFE, 4, 1 << 20), now: Time::from_nanos(1_000_000_000) }
    }

    fn hears(&mut self, input: Input) -> Vec<Output> {
        self.core.handle(self.now, input);
        std::iter::from_fn(|| self.core.poll()).collect()
    }
}

fn executed(outputs: &[Output]) -> usize {
    outputs.iter().filter(|output| matches!(output, Output::Execute { .. })).count()
}

// spec: WILL-2
#[test]
fn a_lost_nodes_wills_are_executed_once_for_each_loss_and_those_of_one_that_left_not() {
    let mut bench = Bench::new();
    bench.hears(UP);
    bench.hears(told(LIFE, 1));
    let former = Input::NodeLost { node: THERE, incarnation: Incarnation(4) };
    assert_eq!(executed(&bench.hears(former)), 0);
    assert_eq!(executed(&bench.hears(LOST)), 1);
    assert_eq!(executed(&bench.hears(LOST)), 0);
    // It was only frozen, and is lost again.
    bench.hears(told(LIFE, 2));
    assert_eq!(executed(&bench.hears(LOST)), 1);
    bench.hears(told(LIFE, 3));
    assert_eq!(executed(&bench.hears(Input::NodeLeft { node: THERE, incarnation: LIFE })), 0);
    assert_eq!(executed(&bench.hears(LOST)), 0);
}

// spec: WILL-2
#[test]
fn wills_of_a_node_that_gives_up_are_executed_when_its_link_breaks_and_not_when_it_says_goodbye() {
    let gives_up = Input::GaveUp { node: THERE, incarnation: LIFE };
    let left = Input::NodeLeft { node: THERE, incarnation: LIFE };
    let broken = Input::LinkBroken { node: THERE, incarnation: LIFE };
    for (then, count) in [(vec![left, broken.clone()], 0), (vec![broken.clone()], 1)] {
        let mut bench = Bench::new();
        bench.hears(UP);
        bench.hears(told(LIFE, 1));
        assert_eq!(executed(&bench.hears(gives_up.clone())), 0);
        assert_eq!(then.into_iter().map(|input| executed(&bench.hears(input))).sum::<usize>(), count);
    }
    // And: of a node whose link broke before, nothing else tells what became of its wills
    let mut bench = Bench::new();
    bench.hears(UP);
    bench.hears(told(LIFE, 1));
    bench.hears(broken);
    assert_eq!(executed(&bench.hears(gives_up)), 1);
}

// spec: WILL-5
#[test]
fn the_wills_of_a_node_whose_certificate_is_revoked_are_not_executed() {
    let revoked = || Input::Revoked { node: THERE, incarnation: LIFE };
    for end in [LOST, Input::LinkUp { node: THERE, incarnation: NEXT_LIFE }, told(NEXT_LIFE, 1)] {
        let mut bench = Bench::new();
        bench.hears(UP);
        bench.hears(told(LIFE, 1));
        assert_eq!(executed(&bench.hears(revoked())), 0);
        assert_eq!(executed(&bench.hears(end)), 0);
    }
    // Those of the next life, which has other keys, are.
    let mut bench = Bench::new();
    bench.hears(told(NEXT_LIFE, 1));
    bench.hears(revoked());
    assert_eq!(executed(&bench.hears(Input::NodeLost { node: THERE, incarnation: NEXT_LIFE })), 1);
}

// spec: WILL-6
#[test]
fn a_list_of_another_life_than_the_linked_one_is_refused_in_words_and_has_none_executed() {
    let stores = Stores::for_test(NodeConfig::new("hip"), LIFE);
    let said = |life| said(Incarnation(life), app(0), &will(3));
    assert!(receive(&stores, THERE, &said(5)).is_err(), "nobody is linked");
    feed(&stores, UP);
    receive(&stores, THERE, &said(5)).expect("of the life that is linked");
    // When: it says that it is in ever later lives
    for life in [4, 6, 7, u64::MAX] {
        let refused = receive(&stores, THERE, &said(life)).expect_err("of another life");
        assert!(refused.contains("another life"), "{refused}");
    }
    // Then: the list of its life is held still, and no other
    let mut core = lock(&stores.wills);
    let mut executed_at = |end| {
        core.handle(Time::now(), end);
        let outputs: Vec<_> = std::iter::from_fn(|| core.poll()).collect();
        executed(&outputs)
    };
    assert_eq!(executed_at(LOST), 1);
    assert_eq!(executed_at(Input::NodeLost { node: THERE, incarnation: Incarnation(u64::MAX) }), 0);
}

#[test]
fn who_leaves_wills_without_end_has_so_many_lines_in_the_log_and_no_more() {
    let stores = Stores::for_test(NodeConfig::new("hip"), LIFE);
    // Nobody is there who takes them.
    let heir = Heir::Tid(Tid::new(stores.node, app(1)));
    let held = HeldWill::new(app(0), &Will { heir, ..will(3) }).expect("one that others hold");
    for life in [5, 6, 7] {
        let (node, incarnation) = (THERE, Incarnation(life));
        let testament = Testament { incarnation, version: 1, wills: vec![held.clone(); WILLS_MAX] };
        feed(&stores, Input::Told { from: node, testament });
        feed(&stores, Input::NodeLost { node, incarnation });
    }
    let quotas = &stores.log_quotas;
    for quota in [&quotas.wills, &quotas.wills_not_taken] {
        assert_ne!(quota.take(&THERE, Time::now()), Some(0), "some were left out");
    }
}

// spec: WILL-2
#[test]
fn that_a_double_of_a_node_is_gone_executes_the_wills_of_no_other_life_of_it() {
    let mut bench = Bench::new();
    bench.hears(UP);
    bench.hears(told(LIFE, 1));
    let double = |incarnation| Input::WasNobody { node: THERE, incarnation };
    assert_eq!(executed(&bench.hears(double(NEXT_LIFE))), 0, "it lives");
    assert_eq!(executed(&bench.hears(double(LIFE))), 1);
}

// spec: WILL-3
#[test]
fn a_new_life_of_a_node_executes_the_wills_of_the_old_one_once_whoever_says_so_first() {
    for news in [Input::LinkUp { node: THERE, incarnation: NEXT_LIFE }, told(NEXT_LIFE, 1)] {
        let mut bench = Bench::new();
        bench.hears(UP);
        bench.hears(told(LIFE, 7));
        assert_eq!(executed(&bench.hears(news.clone())), 1, "{news:?}");
        assert_eq!(executed(&bench.hears(LOST)), 0, "{news:?}");
    }
}

#[test]
fn a_cut_link_executes_nothing_and_an_older_list_changes_nothing() {
    let mut bench = Bench::new();
    bench.hears(UP);
    bench.hears(told(LIFE, 2));
    let empty = Testament { incarnation: LIFE, version: 1, wills: Vec::new() };
    bench.hears(Input::Told { from: THERE, testament: empty });
    assert_eq!(executed(&bench.hears(Input::LinkBroken { node: THERE, incarnation: LIFE })), 0);
    assert_eq!(executed(&bench.hears(LOST)), 1);
}

// spec: WILL-1, WILL-4
#[test]
fn the_wills_of_those_who_live_are_told_at_each_change_and_again_within_bounds() {
    let mut bench = Bench::new();
    assert_eq!(bench.hears(UP), [], "there are none");
    let wills: Arc<[Will]> = Arc::new([will(3), will(PAYLOAD_MAX + 1)]);
    let lives = bench.hears(Input::Lives { app: app(0), wills: wills.clone() });
    let list = |version, wills| {
        [Output::Tell { to: THERE, testament: Testament { incarnation: LIFE, version, wills }, left_out: 0 }]
    };
    assert_eq!(lives, list(1, vec![held()]));
    bench.now = bench.now + REPEAT;
    assert_eq!(bench.hears(Input::TimePassed), list(2, vec![held()]));
    bench.now = bench.now + REPEAT / 2;
    assert_eq!(bench.hears(Input::Ended { app: app(0) }), list(3, Vec::new()));
    bench.now = bench.now + REPEAT * 2;
    assert_eq!(bench.hears(Input::TimePassed), []);
    for index in 0..WILLS_MAX as u32 + 1 {
        bench.hears(Input::Lives { app: app(index), wills: wills.clone() });
    }
    bench.now = bench.now + REPEAT;
    let Some(Output::Tell { testament, .. }) = bench.hears(Input::TimePassed).pop() else { panic!("a list") };
    assert_eq!(testament.wills.len(), WILLS_MAX);
}

// spec: WILL-4
#[test]
fn wills_that_are_too_long_together_for_one_word_stay_at_home_but_for_those_that_fit() {
    let mut core = Core::new(LIFE, 4, 3_000);
    let now = Time::from_nanos(1_000_000_000);
    core.handle(now, UP);
    let wills: Arc<[Will]> = (0..5).map(|_| will(PAYLOAD_MAX)).chain([will(3)]).collect();
    core.handle(now, Input::Lives { app: app(0), wills });
    let Some(Output::Tell { testament, left_out, .. }) = core.poll() else { panic!("it is told") };
    assert_eq!((testament.wills.len(), left_out), (3, 3));
    assert!(rmp_serde::to_vec_named(&testament).unwrap().len() <= 3_000);
}
