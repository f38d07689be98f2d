//! An attacker on the node's own host as another user, admitted only by the access list and with the rights
//! granted there: a guest with names and one group, and visitors with names and any group.

use std::{thread, time::Duration};

use super::{
    super::{
        KNEE,
        together::{self, Together},
    },
    Happened, Scene, done,
};
use crate::{clients::hostile::VISITORS, role};
use sinew_testkit::{NodeProcess, numbers};

/// The node's cause for refusing a connection of a guest that connects too often.
const TOO_OFTEN: &str = "too many connections of a guest";
/// The node's cause for throttling a guest.
const TOO_FAST: &str = "guest too fast";
/// The node's cause for refusing a group membership.
const NOT_GRANTED: &str = "membership";

/// Maximum number of groups of a visitor: the share of a user.
const OF_VISITOR: u64 = 512;
/// Groups requested above that maximum.
const BEYOND: u64 = 256;
/// Duration of the robot's joint work once all visitors are in their groups. It gives the node time to
/// announce these groups to others.
const VISIT: Duration = Duration::from_millis(500);

/// The result, as the guest saw it.
struct Did {
    clients: u64,
    done: u64,
    granted: u64,
    refused: u64,
    /// Arrivals at barriers that were rejected because they exceed its share.
    beyond: u64,
}

/// Clients that join and leave groups.
pub(super) fn groups(scene: &Scene<'_>) -> Happened {
    let (_, happened) = attack(scene, "groups", "changes of memberships");
    Happened { refused: vec![(NOT_GRANTED, 1)], ..happened }
}

/// Clients that request as many groups as they may have and are admitted to none, and visitors in as many as
/// they may have.
pub(super) fn memberships(scene: &Scene<'_>) -> Happened {
    let together = together::begin(scene.robot);
    let mut visitors = [0, 1].map(|number| Visitor::start(scene, number));
    let guest = Guest::start(scene, "memberships");
    scene.rest(scene.lasts);
    // On a slow machine the scene may end before they are in all groups.
    let granted = visitors.each_mut().map(Visitor::granted);
    thread::sleep(VISIT);
    let together = together.end();
    let did = guest.end();
    visitors.into_iter().for_each(Visitor::end);
    let happened = judge_visits(granted, judge(&did, &together, "memberships asked for"));
    // At least one of the guest's own.
    let least = VISITORS.len() as u64 * BEYOND + 1;
    Happened { refused: vec![(NOT_GRANTED, least)], ..happened }
}

/// Clients that arrive at barriers.
pub(super) fn barriers(scene: &Scene<'_>) -> Happened {
    let (did, happened) = attack(scene, "barriers", "arrivals");
    judge_arrivals(&did, happened)
}

/// Clients that send to every application.
pub(super) fn messages(scene: &Scene<'_>) -> Happened {
    let (_, happened) = attack(scene, "messages", "messages to all");
    Happened { refused: vec![(TOO_FAST, 1)], ..happened }
}

/// Connections that are closed at once, and clients that leave at once.
pub(super) fn connections(scene: &Scene<'_>) -> Happened {
    let (_, happened) = attack(scene, "connections", "connections");
    // Otherwise the guest has not connected often enough to prove anything.
    Happened { refused: vec![(TOO_OFTEN, 1)], ..happened }
}

/// Runs this action of the guest until the scene is over, while two nodes of the robot do joint work that it
/// could disturb.
fn attack(scene: &Scene<'_>, does: &str, what: &'static str) -> (Did, Happened) {
    let together = together::begin(scene.robot);
    let guest = Guest::start(scene, does);
    scene.rest(scene.lasts);
    let together = together.end();
    let did = guest.end();
    let happened = judge(&did, &together, what);
    (did, happened)
}

/// The process of the guest.
struct Guest(NodeProcess);

impl Guest {
    fn start(scene: &Scene<'_>, does: &str) -> Self {
        let mut command = role("guest");
        command.arg(scene.robot.socket()).args([does, &scene.lasts.as_millis().to_string()]);
        Self(NodeProcess::start("guest", scene.hosts[KNEE].moved(&command)))
    }

    /// It ends by itself.
    fn end(mut self) -> Did {
        let code = self.0.wait_for_exit();
        assert_eq!(code, Some(0), "the guest's exit");
        let counts = self.0.output().last().map(|line| numbers(line)).unwrap_or_default();
        let [clients, done, granted, refused, beyond] = counts[..] else {
            panic!("the guest printed {counts:?}")
        };
        Did { clients, done, granted, refused, beyond }
    }
}

/// The process of a visitor.
struct Visitor(NodeProcess);

impl Visitor {
    fn start(scene: &Scene<'_>, number: usize) -> Self {
        let mut command = role("visitor");
        command.arg(scene.robot.socket()).arg(number.to_string());
        Self(NodeProcess::start("visitor", scene.hosts[KNEE].moved(&command)))
    }

    /// The number of its groups, as soon as it is in all that it may have.
    fn granted(&mut self) -> u64 {
        self.0.expect("").parse().expect("a number")
    }

    fn end(self) {
        let status = self.0.stop();
        assert!(status.success(), "a visitor ended with {status}");
    }
}

/// A violation is a visitor in more groups than the share of a user. With fewer groups the attack has
/// displaced nothing.
fn judge_visits(granted: [u64; 2], mut happened: Happened) -> Happened {
    for granted in granted.into_iter().filter(|granted| *granted > OF_VISITOR) {
        happened
            .let_in
            .push(format!("a visitor was let into {granted} groups, and {OF_VISITOR} are its share"));
    }
    for granted in granted.into_iter().filter(|granted| *granted < OF_VISITOR) {
        happened
            .broken
            .push(format!("a visitor was in {granted} groups only, of the {OF_VISITOR} that it may"));
    }
    let [one, other] = granted;
    happened.what +=
        &format!("; two visitors were in {one} and {other} groups at the lowest addresses meanwhile");
    happened
}

/// A guest without a rejection for its share has not come far enough to make barriers scarce.
fn judge_arrivals(did: &Did, mut happened: Happened) -> Happened {
    let Did { done, beyond, .. } = *did;
    if beyond == 0 {
        happened.broken.push(format!("none of the guest's {done} arrivals was answered as beyond its share"));
    }
    happened.what += &format!("; {beyond} arrivals were answered as beyond the guest's share");
    happened
}

/// Violations that count however short the attack is: a missed call, a barrier that does not open, or a guest
/// in a group that its list does not grant.
fn judge(did: &Did, together: &Together, what: &'static str) -> Happened {
    let Did { clients, done: count, granted, refused, beyond: _ } = *did;
    let Together { sent, received, met, failed, words } = together;
    let mut never = Vec::new();
    if received < sent {
        never.push(format!("{} of {sent} calls of hip to knee's group never came: {words}", sent - received));
    }
    if *failed > 0 {
        never.push(format!("{failed} times a barrier of hip and knee did not open: {words}"));
    }
    if granted > 0 {
        never.push(format!("the guest was let into {granted} groups that its list does not grant"));
    }
    let mut broken = Vec::new();
    if clients == 0 || count == 0 {
        broken.push(format!("the guest did nothing: {clients} clients, {count} {what}"));
    }
    if *sent == 0 || *met == 0 {
        broken.push(format!("hip and knee did nothing together: {sent} calls, {met} barriers"));
    }
    let words = format!(
        "{clients} clients of a guest, {count} {what}, {refused} connections refused or ended; asserted: each of hip's calls to knee's group \
         comes ({received} of {sent}), each barrier of both opens ({met}, {failed} did not), and the guest is in no group but its own ({granted})"
    );
    Happened { let_in: never, done: done(what, count), ..Happened::new(words, broken) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn judged(granted: u64, together: &Together) -> Happened {
        judge(&did(granted), together, "arrivals")
    }

    fn did(granted: u64) -> Did {
        Did { clients: 64, done: 1_000, granted, refused: 3, beyond: 0 }
    }

    #[test]
    fn single_missed_call_barrier_or_extra_group_is_reported() {
        let all = Together { sent: 100, received: 100, met: 9, ..Together::default() };
        assert!(judged(0, &all).let_in.is_empty() && judged(0, &all).broken.is_empty());
        let missed = Together { received: 99, ..all };
        assert!(judged(0, &missed).let_in[0].contains("1 of 100 calls"));
        let shut = Together { received: 100, failed: 1, words: "256 barriers".to_owned(), ..missed };
        assert!(judged(0, &shut).let_in[0].contains("did not open: 256 barriers"));
        let open = Together { failed: 0, ..shut };
        assert!(judged(1, &open).let_in[0].contains("let into 1 groups"));
    }

    #[test]
    fn idle_run_proves_nothing() {
        let nothing = judged(0, &Together::default());
        assert!(nothing.let_in.is_empty() && nothing.broken.len() == 1, "{:?}", nothing.broken);
    }
    #[test]
    fn arrivals_without_a_share_rejection_prove_nothing() {
        let arrived = |beyond| judge_arrivals(&Did { beyond, ..did(0) }, Happened::default());
        assert!(arrived(0).broken[0].contains("none of the guest's 1000 arrivals"));
        assert!(arrived(1).broken.is_empty());
    }

    #[test]
    fn visitors_must_have_exactly_their_share_of_groups() {
        let visited = |granted| judge_visits(granted, Happened::default());
        let just = visited([OF_VISITOR; 2]);
        assert!(just.broken.is_empty() && just.let_in.is_empty());
        let more = visited([OF_VISITOR, OF_VISITOR + 1]);
        assert!(more.broken.is_empty() && more.let_in[0].contains("let into 513 groups"));
        let less = visited([0, OF_VISITOR]);
        assert!(less.let_in.is_empty() && less.broken[0].contains("in 0 groups only"));
    }
}
