//! The applications that a message to many reaches at this node, and the access list's verdict on each.
//!
//! The routing table computes it with the same code that delivers a message, and nothing is sent. spec:
//! INSPECT-8

use std::sync::Arc;

use sinew_runtime::{
    outcome::Rejection,
    tid::{AppAddress, Tid},
    wire::Message,
};

use super::{
    access::verdicts,
    reports::{AskGroups, AskReach, GROUPS_OF_APPS_MAX, GroupReport, REACHED_MAX, ReachReport, Reached},
};
use crate::NodeState;

/// Returns the applications that a message to many reaches, and the list's verdict on each. spec: INSPECT-8
pub(super) fn reached(state: &Arc<NodeState>, question: &Message) -> Result<ReachReport, Rejection> {
    let AskReach { source, to } = question.decode().map_err(|_| Rejection::Malformed)?;
    if to == AppAddress::NONE || to.is_layer() {
        return Err(Rejection::NoSuchApplication);
    }
    let access = state.security.access.get();
    // An application does not receive its own message to many.
    let mut members: Vec<_> =
        state.ctx.router.members(to).into_iter().map(|app| Tid::new(state.ctx.node, app)).collect();
    members.retain(|app| *app != source);
    let left_out = members.len().saturating_sub(REACHED_MAX) as u64;
    let group = to.is_group().then_some(to);
    let reached = members.into_iter().take(REACHED_MAX).map(|app| {
        let of_list = access.map(|access| verdicts(access, (source, app), group));
        Reached { to, app, verdicts: of_list.unwrap_or_default() }
    });
    Ok(ReachReport { is_given: access.is_some(), reached: reached.collect(), left_out })
}

/// Returns the groups for which the list's verdict differs from that on messages to the application alone.
/// spec: INSPECT-8
pub(super) fn by_groups(state: &Arc<NodeState>, question: &Message) -> Result<ReachReport, Rejection> {
    let AskGroups { source, member } = question.decode().map_err(|_| Rejection::Malformed)?;
    if member.node != state.ctx.node || !member.is_single() || member.app.is_layer() {
        return Err(Rejection::NoSuchApplication);
    }
    let Some(access) = state.security.access.get() else {
        return Ok(ReachReport { is_given: false, reached: Vec::new(), left_out: 0 });
    };
    let alone = verdicts(access, (source, member), None);
    // The table lists them in the order of their addresses. For a group without a rule, the list's verdict is
    // the same as for the member alone.
    let named = access.groups_in_rules();
    let of_group =
        |to: AppAddress| Reached { to, app: member, verdicts: verdicts(access, (source, member), Some(to)) };
    let mut groups = state.ctx.router.groups();
    // An application does not receive its own message to many.
    groups.retain(|group| {
        source != member && named.contains(group) && state.ctx.router.is_member(*group, member.app)
    });
    let mut groups = groups.into_iter();
    let differing = groups.by_ref().map(of_group).filter(|by| by.verdicts != alone);
    let reached: Vec<_> = differing.take(REACHED_MAX).collect();
    // The verdicts on these are not computed any more.
    let left_out = groups.len() as u64;
    Ok(ReachReport { is_given: true, reached, left_out })
}

/// Returns the groups with members on this node, and the number of further ones that do not fit. spec:
/// INSPECT-3
pub(super) fn groups(state: &NodeState) -> (Vec<GroupReport>, u64) {
    let all = state.ctx.router.groups_with_members();
    let left_out = all.len().saturating_sub(GROUPS_OF_APPS_MAX) as u64;
    let report = |(group, members): (AppAddress, Arc<[AppAddress]>)| GroupReport {
        group,
        members: members.len() as u64,
    };
    (all.into_iter().take(GROUPS_OF_APPS_MAX).map(report).collect(), left_out)
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, sync_channel};

    use sinew_runtime::{
        router::{LocalRoute, tap::TapOf},
        tid::{Incarnation, NodeAddress},
        time::Time,
        wire::Payload,
    };

    use super::*;
    use crate::inspect::{
        inspector::Inbox,
        watches::{Directions, Watches},
    };
    use sinew_model::config::NodeConfig;

    const HIP: Tid = Tid::new(NodeAddress::new(0x0a00_0001), AppAddress::new(0x1001));
    const RULES: &str = "[[rule]]\nfrom = ['*']\nto = ['*/1001']\n\
                         [[rule]]\nname = 'told'\nfrom = ['*']\ngroups = ['drives']\n";

    /// A node with two applications, both of them in `drives` and in `others`.
    struct Bench {
        state: Arc<NodeState>,
        inboxes: Vec<Receiver<Message>>,
    }

    impl Bench {
        fn new() -> Self {
            let mut config = NodeConfig::new("knee");
            config.address = Some(NodeAddress::new(0x0a00_0002));
            let state = NodeState::for_test(config, Incarnation(1));
            let mut inboxes = Vec::new();
            for number in [1, 2] {
                let (put, inbox) = sync_channel(8);
                let app = AppAddress::new(0x1000 + number);
                let route = LocalRoute { sink: Arc::new(Inbox(put)), events: Arc::new([]) };
                state.ctx.router.set_local(app, route);
                for group in ["others", "drives"] {
                    state.ctx.router.set_member(AppAddress::group(group), app, true);
                }
                inboxes.push(inbox);
            }
            Self { state, inboxes }
        }

        fn tid(&self, number: u32) -> Tid {
            Tid::new(self.state.ctx.node, AppAddress::new(0x1000 + number))
        }

        fn reached(&self, source: Tid, to: AppAddress) -> ReachReport {
            reached(&self.state, &asked(&AskReach { source, to })).expect("it is a question")
        }
    }

    fn asked<P: Payload>(question: &P) -> Message {
        Message::typed(Tid::NONE, Tid::NONE, question)
    }

    fn by(one: &Reached) -> (Tid, bool, String) {
        let verdict = one.verdicts.first().expect("there is a list");
        let rule = verdict.why.split(", for ").next().expect("a text");
        (one.app, verdict.is_allowed, rule.to_owned())
    }

    // spec: INSPECT-8
    #[test]
    fn reached_members_are_reported_with_their_rules() {
        // Given
        let bench = Bench::new();
        bench.state.security.access_in_test(&bench.state.ctx, RULES);
        let mut watches = Watches::default();
        let watched = (HIP, bench.tid(1));
        let directions = Directions { received: true, sent: true };
        let (_, tap) = watches.fetch(Time::ZERO, watched, directions, 1_024);
        bench.state.ctx.router.set_tap(TapOf::Watches, tap.expect("a new one"));
        // When, then
        let deciders = |to| bench.reached(HIP, to).reached.iter().map(by).collect::<Vec<_>>();
        let [first, second] = [bench.tid(1), bench.tid(2)];
        let open = "rule 1 (line 1)".to_owned();
        let expected = [(first, true, open.clone()), (second, true, "rule 2 'told' (line 4)".to_owned())];
        assert_eq!(deciders(AppAddress::group("drives")), expected);
        let shut = "no rule allows it".to_owned();
        let alone = [(first, true, open.clone()), (second, false, shut)];
        assert_eq!(deciders(AppAddress::group("others")), alone);
        assert_eq!(deciders(AppAddress::ALL), alone, "a group's rule is not about everybody");
        assert_eq!(deciders(first.app), [(first, true, open)]);
        assert_eq!(deciders(AppAddress::group("nobody")), []);
        // And: the sender is not among the receivers
        let own = bench.reached(second, AppAddress::group("drives"));
        assert_eq!(own.reached.iter().map(|one| one.app).collect::<Vec<_>>(), [first]);
        // And: no application received it, no counter changed, and no watch saw it
        assert!(bench.inboxes.iter().all(|inbox| inbox.try_recv().is_err()));
        assert_eq!((bench.state.ctx.router.refused(), bench.state.ctx.refusals.of("access list")), (0, 0));
        let (fetched, _) = watches.fetch(Time::ZERO, watched, directions, 1_024);
        assert_eq!(fetched.expect("it is there").messages.len(), 0);
    }

    // spec: INSPECT-8
    #[test]
    fn groups_with_a_different_verdict_are_reported() {
        let bench = Bench::new();
        let of = |member| by_groups(&bench.state, &asked(&AskGroups { source: HIP, member }));
        let none = ReachReport { is_given: false, reached: Vec::new(), left_out: 0 };
        assert_eq!(of(bench.tid(2)), Ok(none), "without a list everything may come");
        bench.state.security.access_in_test(&bench.state.ctx, RULES);
        let answer = of(bench.tid(2)).expect("an application").reached;
        assert_eq!(answer.iter().map(|one| one.to).collect::<Vec<_>>(), [AppAddress::group("drives")]);
        assert_eq!(by(&answer[0]), (bench.tid(2), true, "rule 2 'told' (line 4)".to_owned()));
        assert_eq!(of(bench.tid(1)).expect("an application").reached, [], "the first rule counts either way");
        assert_eq!(of(HIP), Err(Rejection::NoSuchApplication));
    }

    // spec: INSPECT-8
    #[test]
    fn groups_beyond_the_bound_are_counted() {
        // Given: an application in 300 groups that the rules name, and in others
        let bench = Bench::new();
        let member = bench.tid(2);
        let rule = |first: u32| {
            let names: Vec<_> = (first..first + 60).map(|number| format!("'g{number}'")).collect();
            format!("[[rule]]\nfrom = ['*']\ngroups = [{}]\n", names.join(", "))
        };
        let rules: Vec<_> = (0..5).map(|number| rule(number * 60)).collect();
        bench.state.security.access_in_test(&bench.state.ctx, &rules.concat());
        for number in 0..400 {
            bench.state.ctx.router.set_member(AppAddress::group(&format!("g{number}")), member.app, true);
        }
        // When
        let answer = by_groups(&bench.state, &asked(&AskGroups { source: HIP, member }));
        // Then
        let answer = answer.expect("an application");
        assert_eq!((answer.reached.len(), answer.left_out), (REACHED_MAX, 300 - REACHED_MAX as u64));
    }

    // spec: INSPECT-3
    #[test]
    fn groups_are_reported_with_member_counts() {
        let bench = Bench::new();
        let (mut answer, left_out) = groups(&bench.state);
        let mut expected =
            ["drives", "others"].map(|name| GroupReport { group: AppAddress::group(name), members: 2 });
        answer.sort_by_key(|one| one.group);
        expected.sort_by_key(|one| one.group);
        assert_eq!((&answer[..], left_out), (&expected[..], 0));
        for number in 0..GROUPS_OF_APPS_MAX {
            let group = AppAddress::group(&format!("g{number}"));
            bench.state.ctx.router.set_member(group, bench.tid(1).app, true);
        }
        let (answer, left_out) = groups(&bench.state);
        assert_eq!((answer.len(), left_out), (GROUPS_OF_APPS_MAX, 2));
    }

    // spec: INSPECT-8
    #[test]
    fn layers_are_no_group_and_members_need_no_list() {
        let bench = Bench::new();
        for to in [AppAddress::NONE, AppAddress::INSPECT] {
            let refused = reached(&bench.state, &asked(&AskReach { source: HIP, to }));
            assert_eq!(refused, Err(Rejection::NoSuchApplication));
        }
        let answer = bench.reached(HIP, AppAddress::group("drives"));
        assert!(!answer.is_given && answer.reached.iter().all(|one| one.verdicts.is_empty()), "{answer:?}");
        assert_eq!(
            answer.reached.iter().map(|one| one.app).collect::<Vec<_>>(),
            [bench.tid(1), bench.tid(2)]
        );
    }
}
