//! Single decisions of the core.

use super::*;

pub(super) const NODES: [u32; 3] = [1, 2, 3];
const HOLD: Duration = Duration::from_secs(1);

pub(super) fn address(node: u32) -> NodeAddress {
    NodeAddress::new(node)
}

pub(super) fn person(node: u32) -> Tid {
    Tid::new(address(node), AppAddress::new(0x1001))
}

pub(super) fn own(node: u32) -> Own {
    let name = format!("node {node}");
    Own {
        node: address(node),
        incarnation: Incarnation(1),
        name,
        has_lived: false,
        hold: HOLD,
        on_lost: None,
    }
}

fn at(millis: u64) -> Time {
    Time::from_nanos(millis * 1_000_000)
}

fn seen(node: u32, lost: Option<&str>) -> SeenNode {
    SeenNode {
        node: address(node),
        incarnation: Incarnation(1),
        name: format!("node {node}"),
        lost: lost.map(str::to_owned),
    }
}

fn outputs_of(source: u32) -> StoppedOutputs {
    let (watchdog, sources) = (Duration::from_millis(60), BTreeSet::from([address(source)]));
    StoppedOutputs { outputs: 1, watchdog, sources }
}

fn orders(core: &mut Core) -> Vec<Output> {
    std::iter::from_fn(|| core.poll()).collect()
}

fn latches(orders: &[Output]) -> Vec<StopState> {
    let latch = |order: &Output| if let Output::SetLatch(state) = order { Some(*state) } else { None };
    orders.iter().filter_map(latch).collect()
}

fn frames(orders: Vec<Output>) -> Vec<(NodeAddress, Frame)> {
    let sent = |order| if let Output::Send(to, frame) = order { Some((to, *frame)) } else { None };
    orders.into_iter().filter_map(sent).collect()
}

fn press(core: &mut Core, now: Time) {
    core.handle(now, Input::Pressed { by: person(1), reason: LeaveReason::of("a test") });
}

/// Hands the newest frame of `from` to `to`.
fn exchange(now: Time, from: &Core, to: &mut Core) {
    let operators = NODES.map(person).into();
    let frame = from.frame(false);
    to.handle(now, Input::FrameReceived { from: from.own.node, frame, operators });
}

fn released(node: u32) -> Core {
    let mut core = Core::new(own(node), Stops::default(), at(0));
    core.handle(at(1_000), Input::NodesSeen(Vec::new()));
    assert_eq!(latches(&orders(&mut core)), [StopState::Held, StopState::Released]);
    core
}

// spec: STOP-6
#[test]
fn lone_node_is_held_and_then_released() {
    let mut core = Core::new(own(1), Stops::default(), at(0));
    assert_eq!(latches(&orders(&mut core)), [StopState::Held]);
    core.handle(at(999), Input::NodesSeen(Vec::new()));
    assert_eq!(core.hold_ends(), at(1_000));
    // Time alone does not tell that there are no others.
    core.handle(at(9_000), Input::TimePassed);
    assert_eq!(latches(&orders(&mut core)), []);
    core.handle(at(9_001), Input::NodesSeen(Vec::new()));
    assert_eq!(latches(&orders(&mut core)), [StopState::Released]);
}

// spec: STOP-6
#[test]
fn node_is_held_until_present_nodes_have_answered() {
    let (mut core, other) = (released(1), released(2));
    core.handle(at(1_500), Input::NodesSeen(vec![seen(2, None)]));
    assert_eq!(latches(&orders(&mut core)), [StopState::Held]);
    assert!(core.report().nodes[0].note.contains("node 2"), "{:?}", core.report());
    assert!(core.next_wake() > Some(at(1_500)), "it waits for a message, and does not look all the time");
    exchange(at(1_600), &other, &mut core);
    assert_eq!(latches(&orders(&mut core)), [StopState::Released]);
}

// spec: STOP-6
#[test]
fn restarted_and_returning_nodes_come_up_stopped() {
    let (mut core, mut other) = (Core::new(own(1), Stops::default(), at(5_000)), released(2));
    press(&mut other, at(2_000));
    core.handle(at(5_010), Input::NodesSeen(vec![seen(2, None)]));
    exchange(at(5_020), &other, &mut core);
    assert_eq!(latches(&orders(&mut core)), [StopState::Held, StopState::Stopped]);
    // One that was away
    let mut away = released(3);
    exchange(at(1_100), &released(2), &mut away);
    away.handle(at(1_200), Input::NodesSeen(vec![seen(2, Some("silent"))]));
    orders(&mut away);
    away.handle(at(6_000), Input::NodesSeen(vec![seen(2, None)]));
    assert_eq!(latches(&orders(&mut away)), [StopState::Held], "no output can be armed before it has heard");
    exchange(at(6_001), &other, &mut away);
    assert_eq!(latches(&orders(&mut away)), [StopState::Stopped]);
}

#[test]
fn missed_stop_makes_outputs_safe_on_return() {
    let (mut core, mut away) = (released(1), released(2));
    press(&mut core, at(2_000));
    core.handle(at(3_000), Input::Released { by: person(1) });
    exchange(at(4_000), &core, &mut away);
    assert!(orders(&mut away).contains(&Output::PassStop));
    // A node that starts has no output yet that was live during it.
    let mut fresh = Core::new(own(3), Stops::default(), at(3_500));
    exchange(at(4_000), &core, &mut fresh);
    assert!(!orders(&mut fresh).contains(&Output::PassStop));
    // One that was killed in it, before the press was on its disk, had one.
    let killed = Own { has_lived: true, ..own(4) };
    let mut killed = Core::new(killed, Stops::default(), at(3_500));
    exchange(at(4_000), &core, &mut killed);
    assert!(orders(&mut killed).contains(&Output::PassStop));
}

// spec: STOP-7
#[test]
fn kept_press_stops_the_next_life() {
    let mut before = released(1);
    press(&mut before, at(2_000));
    let mut core = Core::new(own(1), before.stops().clone(), at(0));
    assert_eq!(latches(&orders(&mut core)), [StopState::Stopped]);
}

// spec: STOP-4
#[test]
fn press_is_repeated_until_it_is_confirmed() {
    let (mut core, mut other) = (released(1), released(2));
    core.handle(at(1_500), Input::NodesSeen(vec![seen(2, None)]));
    exchange(at(1_500), &other, &mut core);
    orders(&mut core);
    press(&mut core, at(2_000));
    let sent = orders(&mut core);
    assert_eq!(sent[0], Output::SetLatch(StopState::Stopped), "before any state is sent");
    assert_eq!(frames(sent).len(), 1);
    assert_eq!(core.next_wake(), Some(at(2_020)));
    core.handle(at(2_020), Input::TimePassed);
    let again = frames(orders(&mut core));
    assert!(again.len() == 1 && again[0].1.wants_state);
    // The other one has it, and then confirms
    exchange(at(2_030), &core, &mut other);
    exchange(at(2_031), &other, &mut core);
    assert!(!core.is_confirmed());
    other.handle(at(2_032), Input::OutputsSeen(StoppedOutputs::default(), 0));
    exchange(at(2_033), &other, &mut core);
    core.handle(at(2_034), Input::OutputsSeen(StoppedOutputs::default(), 0));
    assert!(core.is_confirmed());
    let report = core.report();
    assert!(report.is_confirmed() && report.nodes[1].confirmed_us == Some(33_000), "{report:?}");
    orders(&mut core);
    core.handle(at(2_100), Input::TimePassed);
    orders(&mut core);
    assert!(core.next_wake() >= Some(at(3_000)), "it is refreshed, and not repeated");
}

#[test]
fn node_that_starts_confirms_only_after_the_hold() {
    let mut core = Core::new(own(1), Stops::default(), at(0));
    press(&mut core, at(100));
    core.handle(at(101), Input::OutputsSeen(StoppedOutputs::default(), 0));
    let report = core.report();
    assert!(!core.is_confirmed() && !report.is_confirmed(), "{report:?}");
    assert!(report.nodes[0].note.contains("just started"), "{report:?}");
    core.handle(at(1_000), Input::NodesSeen(Vec::new()));
    assert!(core.is_confirmed() && core.report().is_confirmed());
}

// spec: STOP-5
#[test]
fn node_with_a_live_output_does_not_confirm() {
    let (mut core, mut other) = (released(1), released(2));
    exchange(at(1_500), &other, &mut core);
    press(&mut core, at(2_000));
    core.handle(at(2_000), Input::OutputsSeen(StoppedOutputs::default(), 0));
    exchange(at(2_001), &core, &mut other);
    other.handle(at(2_002), Input::OutputsSeen(outputs_of(2), 1));
    exchange(at(2_003), &other, &mut core);
    let report = core.report();
    assert!(!core.is_confirmed() && report.nodes[1].bound_us.is_none(), "{report:?}");
    assert!(report.nodes[1].note.contains("not safe"), "{report:?}");
}

// spec: STOP-5
#[test]
fn output_that_fails_later_takes_the_confirmation_back() {
    let mut core = released(1);
    press(&mut core, at(2_000));
    let mut see = |millis, not_safe| {
        core.handle(at(millis), Input::OutputsSeen(StoppedOutputs::default(), not_safe));
        core.is_confirmed()
    };
    assert!(see(2_001, 0));
    assert!(!see(2_002, 1));
    assert!(see(2_003, 0));
}

#[test]
fn watchdogs_bound_a_node_that_is_cut_off() {
    let mut core = released(1);
    let hear = |core: &mut Core, outputs: StoppedOutputs, on_lost| {
        let mut other = Core::new(Own { on_lost, ..own(2) }, Stops::default(), at(0));
        other.handle(at(1_400), Input::OutputsSeen(outputs, 1));
        exchange(at(1_500), &other, core);
        core.handle(at(1_600), Input::NodesSeen(vec![seen(2, Some("silent"))]));
        press(core, at(2_000));
        core.handle(at(2_000), Input::OutputsSeen(StoppedOutputs::default(), 0));
        core.report().nodes[1].clone()
    };
    // Its sender is on this node, which is stopped
    let node = hear(&mut core, outputs_of(1), None);
    assert_eq!((node.confirmed_us, node.bound_us), (None, Some(60_000)), "{node:?}");
    // Its sender is on itself
    let node = hear(&mut released(1), outputs_of(2), None);
    assert!(node.bound_us.is_none() && node.note.contains("stop.on_lost"), "{node:?}");
    let node = hear(&mut released(1), outputs_of(2), Some(Duration::from_secs(2)));
    assert_eq!(node.bound_us, Some(2_000_000), "{node:?}");
    // That one is present, and may have lost nothing
    let mut core = released(1);
    let _ = hear(&mut core, outputs_of(2), Some(Duration::from_secs(2)));
    core.handle(at(2_100), Input::NodesSeen(vec![seen(2, None)]));
    let own = Own { on_lost: Some(Duration::from_secs(2)), ..own(2) };
    let mut present = Core::new(own, Stops::default(), at(0));
    present.handle(at(2_100), Input::OutputsSeen(outputs_of(2), 1));
    exchange(at(2_101), &present, &mut core);
    assert_eq!(core.report().nodes[1].bound_us, None, "{:?}", core.report());
    // It has no output
    let node = hear(&mut released(1), StoppedOutputs::default(), None);
    assert_eq!(node.bound_us, Some(0), "{node:?}");
    // Nothing is known
    let mut core = released(1);
    core.handle(at(1_600), Input::NodesSeen(vec![seen(2, Some("silent"))]));
    press(&mut core, at(2_000));
    assert!(core.report().nodes[1].note.contains("by hand"), "{:?}", core.report());
}

#[test]
fn other_nodes_learn_of_new_outputs_at_once() {
    let mut core = released(1);
    exchange(at(1_500), &released(2), &mut core);
    core.handle(at(1_501), Input::TimePassed);
    orders(&mut core);
    core.handle(at(1_502), Input::OutputsSeen(outputs_of(2), 0));
    let sent = frames(orders(&mut core));
    assert!(sent.len() == 1 && sent[0].1.outputs == 1, "{sent:?}");
    core.handle(at(1_503), Input::OutputsSeen(outputs_of(2), 0));
    assert!(frames(orders(&mut core)).is_empty());
}

// spec: STOP-3
#[test]
fn release_of_no_operator_is_not_taken() {
    let (mut core, mut other) = (released(1), released(2));
    press(&mut core, at(2_000));
    exchange(at(2_001), &core, &mut other);
    core.handle(at(2_002), Input::Released { by: person(1) });
    assert!(!core.is_stopped());
    let refused =
        Input::FrameReceived { from: address(1), frame: core.frame(false), operators: BTreeSet::new() };
    other.handle(at(2_003), refused);
    assert!(other.is_stopped());
    exchange(at(2_004), &other, &mut core);
    assert!(!core.is_stopped() && !core.is_released_everywhere());
    exchange(at(2_005), &core, &mut other);
    exchange(at(2_006), &other, &mut core);
    assert!(!other.is_stopped() && core.is_released_everywhere());
}

// spec: STOP-10
#[test]
fn loss_of_a_node_presses_where_that_is_set() {
    for on_lost in [None, Some(Duration::from_secs(2))] {
        let mut core = Core::new(Own { on_lost, ..own(1) }, Stops::default(), at(0));
        exchange(at(1_500), &released(2), &mut core);
        core.handle(at(1_600), Input::NodesSeen(vec![seen(2, None)]));
        core.handle(at(2_000), Input::NodesSeen(vec![seen(2, Some("silent"))]));
        assert_eq!(core.is_stopped(), on_lost.is_some());
    }
    // A node that has said farewell is no loss
    let mut core = Core::new(Own { on_lost: Some(HOLD), ..own(1) }, Stops::default(), at(0));
    exchange(at(1_500), &released(2), &mut core);
    core.handle(at(2_000), Input::NodesSeen(Vec::new()));
    assert!(!core.is_stopped() && core.report().nodes.len() == 1);
}
