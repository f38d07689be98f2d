//! Members of several nodes, each with an outcome, and their reports in any order.

use proptest::prelude::*;

use super::*;
use crate::outcome::Rejection;

const HERE: NodeAddress = NodeAddress::new(1);
const GROUP: Tid = Tid::new(NodeAddress::ALL, AppAddress::group("legs"));

fn member(node: u32, app: u32) -> Tid {
    Tid::new(NodeAddress::new(node), AppAddress::new(0x1000 + app))
}

/// The outcome of a member's copy: settled and reported, or no report arrives.
fn fates() -> impl Strategy<Value = Option<Outcome>> {
    prop_oneof![
        Just(Some(Outcome::Delivered)),
        Just(Some(Outcome::Failed)),
        Just(Some(Outcome::Expired)),
        Just(Some(Outcome::Rejected(Rejection::UnknownKind))),
        Just(None),
    ]
}

/// Another node: its members, whether their list arrived, and the outcome of its copy, if one arrived.
#[derive(Clone, Debug)]
struct Node {
    members: Vec<Option<Outcome>>,
    is_listed: bool,
    end: Option<Outcome>,
}

fn nodes() -> impl Strategy<Value = Vec<Node>> {
    let ends = prop_oneof![
        Just(Some(Outcome::Delivered)),
        Just(Some(Outcome::Unknown)),
        Just(Some(Outcome::PeerLost)),
        Just(None),
    ];
    let node = (proptest::collection::vec(fates(), 0..5), any::<bool>(), ends)
        .prop_map(|(members, is_listed, end)| Node { members, is_listed, end });
    proptest::collection::vec(node, 0..4)
}

impl Node {
    /// The reports about it, which arrive in any order once all nodes are known.
    fn reports(&self, node: u32) -> Vec<MemberReport> {
        let address = NodeAddress::new(node);
        let mut reports = Vec::new();
        if self.is_listed {
            for (app, fate) in (0..).zip(&self.members) {
                reports.push(MemberReport::of_member(member(node, app), MemberState::Pending));
                let settled = fate.map(MemberState::Settled);
                reports.extend(settled.map(|state| MemberReport::of_member(member(node, app), state)));
            }
            reports.push(MemberReport::of_node(address, MemberState::Listed));
        }
        let end = self.end.map(MemberState::Settled);
        reports.extend(end.map(|state| MemberReport::of_node(address, state)));
        reports
    }

    /// Its entries at the end, if the message as a whole has no other outcome.
    fn expected(&self, node: u32) -> Vec<MemberOutcome> {
        let rest = self.end.filter(|end| *end != Outcome::Delivered).unwrap_or(Outcome::Unknown);
        if self.is_listed {
            let members = (0..).zip(&self.members);
            let entry = |(app, fate): (u32, &Option<Outcome>)| MemberOutcome {
                tid: member(node, app),
                outcome: fate.unwrap_or(rest),
            };
            members.map(entry).collect()
        } else {
            vec![MemberOutcome { tid: Tid::new(NodeAddress::new(node), GROUP.app), outcome: rest }]
        }
    }

    fn is_over(&self) -> bool {
        let has_lost = self.end.is_some_and(|end| end != Outcome::Delivered);
        let is_known = self.is_listed || self.end.is_some();
        is_known && (!self.is_listed || has_lost || self.members.iter().all(Option::is_some))
    }
}

proptest! {
    #[test]
    fn each_member_has_one_entry_for_any_report_order(
        nodes in nodes(),
        order in any::<u64>(),
        doubled in any::<bool>(),
    ) {
        // Given: this node and others have copies
        let mut table = MemberTable::new(GROUP, HERE);
        let others = 2..2 + nodes.len() as u32;
        for node in others.clone() {
            table.note(&[MemberReport::of_node(NodeAddress::new(node), MemberState::Pending)]);
        }
        table.note(&[MemberReport::of_node(HERE, MemberState::Listed)]);
        // When: their reports arrive in this order
        let mut reports: Vec<_> = others.clone().zip(&nodes).flat_map(|(at, node)| node.reports(at)).collect();
        let mut random = order;
        for at in (1..reports.len()).rev() {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            reports.swap(at, (random >> 33) as usize % (at + 1));
        }
        reports.iter().for_each(|report| table.note(std::slice::from_ref(report)));
        if doubled {
            table.note(&reports);
        }
        // Then
        prop_assert_eq!(table.is_complete(), nodes.iter().all(Node::is_over));
        let expected: Vec<_> = others.zip(&nodes).flat_map(|(at, node)| node.expected(at)).collect();
        prop_assert_eq!(table.finish(None), expected);
    }

    #[test]
    fn reports_round_trip(all in proptest::collection::vec((any::<u64>(), any::<u8>()), 1..=REPORTS_MAX)) {
        let bytes: Vec<u8> = all.iter().flat_map(|(tid, code)| {
            let mut one = tid.to_le_bytes().to_vec();
            one.push(*code);
            one
        }).collect();
        let known = MemberReport::decode(&bytes).expect("whole reports");
        prop_assume!(!known.is_empty());
        prop_assert_eq!(MemberReport::decode(&MemberReport::encode(&known)), Some(known));
    }

    #[test]
    fn any_bytes_are_bounded_reports_or_none(bytes in proptest::collection::vec(any::<u8>(), 0..2_000)) {
        let is_right = !bytes.is_empty() && bytes.len() % EACH == 0 && bytes.len() <= REPORTS_MAX * EACH;
        let read = MemberReport::decode(&bytes);
        prop_assert_eq!(read.is_some(), is_right);
        let mut table = MemberTable::bounded(GROUP, HERE, 8);
        table.note(&read.unwrap_or_default());
        prop_assert!(table.finish(None).len() <= 8);
    }
}

#[test]
fn group_without_members_gives_an_empty_list() {
    let mut table = MemberTable::new(GROUP, HERE);
    assert!(!table.is_complete());
    table.note(&[MemberReport::of_node(HERE, MemberState::Listed)]);
    assert!(table.is_complete());
    assert_eq!(table.finish(Some(Outcome::Delivered)), []);
}

#[test]
fn message_without_reports_has_one_entry() {
    for (last, outcome) in [
        (None, Outcome::Unknown),
        (Some(Outcome::Unknown), Outcome::Unknown),
        (Some(Outcome::Rejected(Rejection::TooManyMembers)), Outcome::Rejected(Rejection::TooManyMembers)),
    ] {
        let table = MemberTable::new(GROUP, HERE);
        assert_eq!(table.finish(last), [MemberOutcome { tid: GROUP, outcome }]);
    }
}

#[test]
fn message_to_one_application_has_its_outcome() {
    let table = MemberTable::new(member(2, 1), HERE);
    let entry = MemberOutcome { tid: member(2, 1), outcome: Outcome::Delivered };
    assert_eq!(table.finish(Some(Outcome::Delivered)), [entry]);
}

#[test]
fn members_beyond_the_bound_are_unknown_by_their_node() {
    let mut table = MemberTable::bounded(GROUP, HERE, 3);
    let delivered = |app| MemberReport::of_member(member(1, app), MemberState::Settled(Outcome::Delivered));
    table.note(&[delivered(1), delivered(2), delivered(3), MemberReport::of_node(HERE, MemberState::Listed)]);
    assert!(table.is_complete());
    let entry = |tid, outcome| MemberOutcome { tid, outcome };
    assert_eq!(
        table.finish(Some(Outcome::Delivered)),
        [
            entry(member(1, 1), Outcome::Delivered),
            entry(member(1, 2), Outcome::Delivered),
            entry(GROUP, Outcome::Unknown),
        ]
    );
}

#[test]
fn node_without_a_copy_has_no_reports() {
    let mut table = MemberTable::new(GROUP, HERE);
    table.note(&[
        MemberReport::of_member(member(7, 1), MemberState::Settled(Outcome::Delivered)),
        MemberReport::of_node(NodeAddress::new(7), MemberState::Settled(Outcome::Delivered)),
        MemberReport::of_node(HERE, MemberState::Listed),
    ]);
    assert_eq!(table.finish(None), []);
}

#[test]
fn documentation_shows_the_bytes_of_two_reports() {
    let page = include_str!("../../../../docs/protocol/frame.md");
    let shown = page.split_once("```members").expect("the block begins").1;
    let shown = shown.split_once("```").expect("the block ends").0;
    let bytes = shown.lines().map(|line| line.split("  ").next().unwrap_or_default());
    let bytes: Vec<u8> = bytes
        .flat_map(str::split_whitespace)
        .map(|byte| u8::from_str_radix(byte, 16).expect("two hexadecimal digits"))
        .collect();
    let tid = "10.0.0.8/1002".parse().expect("a TID");
    let listed = MemberReport::of_node("10.0.0.8".parse().expect("an address"), MemberState::Listed);
    let pending = MemberReport::of_member(tid, MemberState::Pending);
    assert_eq!(MemberReport::decode(&bytes), Some(vec![pending, listed]));
}
