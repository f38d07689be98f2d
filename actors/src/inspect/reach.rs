//! Whom a message to many reaches at this node, and what the access list says of each.
//!
//! The routing table says it by the same way as that by which a message goes, and nothing is sent for it. spec: INSPECT-8

use std::sync::Arc;

use sinew_runtime::{
    outcome::Rejection,
    tid::{AppAddress, Tid},
    wire::Message,
};

use super::{
    access::verdicts,
    reports::{AskGroups, AskReach, REACHED_MAX, ReachReport, Reached},
};
use crate::stores::Stores;

/// Whom a message reaches that is sent to many, and what the list says of each. spec: INSPECT-8
pub(super) fn reached(stores: &Arc<Stores>, question: &Message) -> Result<ReachReport, Rejection> {
    let AskReach { source, to } = question.decode().map_err(|_| Rejection::Malformed)?;
    if to == AppAddress::NONE || to.is_layer() {
        return Err(Rejection::NoSuchApplication);
    }
    let access = stores.access.get();
    // Nobody gets what it sends to many.
    let mut members: Vec<_> =
        stores.router.members(to).into_iter().map(|app| Tid::new(stores.node, app)).collect();
    members.retain(|app| *app != source);
    let left_out = members.len().saturating_sub(REACHED_MAX) as u64;
    let group = to.is_group().then_some(to);
    let reached = members.into_iter().take(REACHED_MAX).map(|app| {
        let of_list = access.map(|access| verdicts(access, (source, app), group));
        Reached { to, app, verdicts: of_list.unwrap_or_default() }
    });
    Ok(ReachReport { is_given: access.is_some(), reached: reached.collect(), left_out })
}

/// By which groups a message reaches an application otherwise than by itself. spec: INSPECT-8
pub(super) fn by_groups(stores: &Arc<Stores>, question: &Message) -> Result<ReachReport, Rejection> {
    let AskGroups { source, member } = question.decode().map_err(|_| Rejection::Malformed)?;
    if member.node != stores.node || !member.is_single() || member.app.is_layer() {
        return Err(Rejection::NoSuchApplication);
    }
    let Some(access) = stores.access.get() else {
        return Ok(ReachReport { is_given: false, reached: Vec::new(), left_out: 0 });
    };
    let alone = verdicts(access, (source, member), None);
    // The table has them in the order of their addresses. Of a group that no rule names the list says the same as of the member alone.
    let named = access.groups_in_rules();
    let of_group =
        |to: AppAddress| Reached { to, app: member, verdicts: verdicts(access, (source, member), Some(to)) };
    let mut groups = stores.router.groups();
    // Nobody gets what it sends to many.
    groups.retain(|group| {
        source != member && named.contains(group) && stores.router.is_member(*group, member.app)
    });
    let mut groups = groups.into_iter();
    let differing = groups.by_ref().map(of_group).filter(|by| by.verdicts != alone);
    let reached: Vec<_> = differing.take(REACHED_MAX).collect();
    // What is said of these is not looked up any more.
    let left_out = groups.len() as u64;
    Ok(ReachReport { is_given: true, reached, left_out })
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, sync_channel};

    use sinew_runtime::{
        router::LocalRoute,
        tid::{Incarnation, NodeAddress},
        time::Time,
        wire::Payload,
    };

    use super::*;
    use crate::{
        access::Access,
        config::NodeConfig,
        inspect::{
            inspector::Inbox,
            watches::{Watches, Ways},
        },
    };

    const HIP: Tid = Tid::new(NodeAddress::new(0x0a00_0001), AppAddress::new(0x1001));
    const RULES: &str = "[[rule]]\nfrom = ['*']\nto = ['*/1001']\n\
                         [[rule]]\nname = 'told'\nfrom = ['*']\ngroups = ['drives']\n";

    /// A node with two applications, both of which are in `drives` and in `others`.
    struct Bench {
        stores: Arc<Stores>,
        inboxes: Vec<Receiver<Message>>,
    }

    impl Bench {
        fn new() -> Self {
            let mut config = NodeConfig::new("knee");
            config.address = Some(NodeAddress::new(0x0a00_0002));
            let stores = Stores::for_test(config, Incarnation(1));
            let mut inboxes = Vec::new();
            for number in [1, 2] {
                let (put, inbox) = sync_channel(8);
                let app = AppAddress::new(0x1000 + number);
                let route = LocalRoute { outlet: Arc::new(Inbox(put)), events: Arc::new([]) };
                stores.router.set_local(app, route);
                for group in ["others", "drives"] {
                    stores.router.set_member(AppAddress::group(group), app, true);
                }
                inboxes.push(inbox);
            }
            Self { stores, inboxes }
        }

        fn tid(&self, number: u32) -> Tid {
            Tid::new(self.stores.node, AppAddress::new(0x1000 + number))
        }

        fn reached(&self, source: Tid, to: AppAddress) -> ReachReport {
            reached(&self.stores, &asked(&AskReach { source, to })).expect("it is a question")
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
    fn whom_a_message_to_a_group_reaches_is_told_with_the_rule_for_each_and_nobody_gets_one() {
        // Given
        let bench = Bench::new();
        Access::in_test(&bench.stores, RULES);
        let mut watches = Watches::default();
        let watched = (HIP, bench.tid(1));
        let ways = Ways { received: true, sent: true };
        let (_, tap) = watches.fetch(Time::ZERO, watched, ways, 1_024);
        bench.stores.router.set_tap(tap.expect("a new one"));
        // When, then
        let said = |to| bench.reached(HIP, to).reached.iter().map(by).collect::<Vec<_>>();
        let [first, second] = [bench.tid(1), bench.tid(2)];
        let open = "rule 1 (line 1)".to_owned();
        let expected = [(first, true, open.clone()), (second, true, "rule 2 'told' (line 4)".to_owned())];
        assert_eq!(said(AppAddress::group("drives")), expected);
        let shut = "no rule allows it".to_owned();
        let alone = [(first, true, open.clone()), (second, false, shut)];
        assert_eq!(said(AppAddress::group("others")), alone);
        assert_eq!(said(AppAddress::ALL), alone, "a group's rule is not about everybody");
        assert_eq!(said(first.app), [(first, true, open)]);
        assert_eq!(said(AppAddress::group("nobody")), []);
        // And: who sends is not among those who get it
        let own = bench.reached(second, AppAddress::group("drives"));
        assert_eq!(own.reached.iter().map(|one| one.app).collect::<Vec<_>>(), [first]);
        // And: it came to nobody, was counted nowhere, and no watch saw it
        assert!(bench.inboxes.iter().all(|inbox| inbox.try_recv().is_err()));
        assert_eq!((bench.stores.router.refused(), bench.stores.refusals.of("access list")), (0, 0));
        let (fetched, _) = watches.fetch(Time::ZERO, watched, ways, 1_024);
        assert_eq!(fetched.expect("it is there").sights.len(), 0);
    }

    // spec: INSPECT-8
    #[test]
    fn groups_of_an_application_are_told_where_their_rules_say_something_else_than_of_it_alone() {
        let bench = Bench::new();
        let of = |member| by_groups(&bench.stores, &asked(&AskGroups { source: HIP, member }));
        let none = ReachReport { is_given: false, reached: Vec::new(), left_out: 0 };
        assert_eq!(of(bench.tid(2)), Ok(none), "without a list everything may come");
        Access::in_test(&bench.stores, RULES);
        let said = of(bench.tid(2)).expect("an application").reached;
        assert_eq!(said.iter().map(|one| one.to).collect::<Vec<_>>(), [AppAddress::group("drives")]);
        assert_eq!(by(&said[0]), (bench.tid(2), true, "rule 2 'told' (line 4)".to_owned()));
        assert_eq!(of(bench.tid(1)).expect("an application").reached, [], "the first rule counts either way");
        assert_eq!(of(HIP), Err(Rejection::NoSuchApplication));
    }

    // spec: INSPECT-8
    #[test]
    fn of_many_groups_those_that_have_room_are_told_and_the_others_that_rules_name_are_counted() {
        // Given: an application in 300 groups that rules name, and in others
        let bench = Bench::new();
        let member = bench.tid(2);
        let rule = |first: u32| {
            let names: Vec<_> = (first..first + 60).map(|number| format!("'g{number}'")).collect();
            format!("[[rule]]\nfrom = ['*']\ngroups = [{}]\n", names.join(", "))
        };
        let rules: Vec<_> = (0..5).map(|number| rule(number * 60)).collect();
        Access::in_test(&bench.stores, &rules.concat());
        for number in 0..400 {
            bench.stores.router.set_member(AppAddress::group(&format!("g{number}")), member.app, true);
        }
        // When
        let said = by_groups(&bench.stores, &asked(&AskGroups { source: HIP, member }));
        // Then
        let said = said.expect("an application");
        assert_eq!((said.reached.len(), said.left_out), (REACHED_MAX, 300 - REACHED_MAX as u64));
    }

    // spec: INSPECT-8
    #[test]
    fn layers_are_not_many_and_without_a_list_members_are_told_all_the_same() {
        let bench = Bench::new();
        for to in [AppAddress::NONE, AppAddress::INSPECT] {
            let refused = reached(&bench.stores, &asked(&AskReach { source: HIP, to }));
            assert_eq!(refused, Err(Rejection::NoSuchApplication));
        }
        let said = bench.reached(HIP, AppAddress::group("drives"));
        assert!(!said.is_given && said.reached.iter().all(|one| one.verdicts.is_empty()), "{said:?}");
        assert_eq!(said.reached.iter().map(|one| one.app).collect::<Vec<_>>(), [bench.tid(1), bench.tid(2)]);
    }
}
