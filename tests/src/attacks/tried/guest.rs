//! Who is on the node's own host as another user, whom only the access list lets in, and has what that grants: a guest with names and
//! one group, and visitors with names and any group.

use std::{
    process::Command,
    sync::{
        Arc, Mutex, PoisonError,
        mpsc::{Receiver, sync_channel},
    },
    thread,
    time::Duration,
};

use super::{
    super::{
        KNEE,
        together::{self, Together},
    },
    Happened, Scene, done,
};
use crate::{
    DEADLINE,
    clients::{Performer, hostile::VISITORS},
};

/// What the node counts when it refuses a connection of a guest that comes too often.
const TOO_OFTEN: &str = "too many connections of a guest";
/// When what it sends has to wait.
const TOO_FAST: &str = "guest too fast";
/// And when it does not let one into a group.
const NOT_GRANTED: &str = "membership";

/// Groups that a visitor is in at most: the share of a user.
const OF_VISITOR: u64 = 512;
/// Those that it asks for beyond it.
const BEYOND: u64 = 256;
/// How long the robot's own do what they do when all visitors are in their groups: time for the node to tell others of these.
const VISIT: Duration = Duration::from_millis(500);

/// What it came to, as the guest saw it.
struct Did {
    clients: u64,
    done: u64,
    granted: u64,
    refused: u64,
    /// Arrivals at barriers that were answered as beyond its share.
    beyond: u64,
}

/// Clients that join and leave groups.
pub(super) fn groups(scene: &Scene<'_>) -> Happened {
    let (_, happened) = play(scene, "groups", "changes of memberships");
    Happened { refused: vec![(NOT_GRANTED, 1)], ..happened }
}

/// Clients that ask for as many groups as they may have and are let into none, and visitors that are in as many as they may.
pub(super) fn memberships(scene: &Scene<'_>) -> Happened {
    let together = together::begin(scene.robot);
    let visitors = [0, 1].map(|number| Visitor::start(scene, number));
    let guest = Guest::start(scene, "memberships");
    scene.rest(scene.lasts);
    // On a slow machine the scene may be over before they are.
    let granted = visitors.each_ref().map(Visitor::granted);
    thread::sleep(VISIT);
    let together = together.end();
    let did = guest.end();
    visitors.into_iter().for_each(Visitor::end);
    let happened = judge_visits(granted, judge(&did, &together, "memberships asked for"));
    // One of the guest's own at least.
    let least = VISITORS.len() as u64 * BEYOND + 1;
    Happened { refused: vec![(NOT_GRANTED, least)], ..happened }
}

/// Clients that arrive at barriers.
pub(super) fn barriers(scene: &Scene<'_>) -> Happened {
    let (did, happened) = play(scene, "barriers", "arrivals");
    judge_arrivals(&did, happened)
}

/// Clients that send to everybody.
pub(super) fn messages(scene: &Scene<'_>) -> Happened {
    let (_, happened) = play(scene, "messages", "messages to all");
    Happened { refused: vec![(TOO_FAST, 1)], ..happened }
}

/// Connections that are closed at once, and clients that leave at once.
pub(super) fn connections(scene: &Scene<'_>) -> Happened {
    let (_, happened) = play(scene, "connections", "connections");
    // Else it has not come often enough to show anything.
    Happened { refused: vec![(TOO_OFTEN, 1)], ..happened }
}

/// Has the guest do this until the scene is over, while two nodes of the robot do together what it could disturb.
fn play(scene: &Scene<'_>, does: &str, what: &'static str) -> (Did, Happened) {
    let together = together::begin(scene.robot);
    let guest = Guest::start(scene, does);
    scene.rest(scene.lasts);
    let together = together.end();
    let did = guest.end();
    let happened = judge(&did, &together, what);
    (did, happened)
}

/// The process of the guest, and what it says.
struct Guest {
    performer: Performer,
    said: Arc<Mutex<Vec<u64>>>,
}

impl Guest {
    fn start(scene: &Scene<'_>, does: &str) -> Self {
        let said: Arc<Mutex<Vec<u64>>> = Arc::default();
        let hears = said.clone();
        let mut command = Command::new(scene.program);
        command.args(["--role", "guest"]).arg(scene.robot.door());
        command.args([does, &scene.lasts.as_millis().to_string()]);
        let performer = Performer::start_command(scene.hosts[KNEE].moved(&command), "guest", move |line| {
            let numbers = line.split_whitespace().filter_map(|word| word.parse::<u64>().ok());
            hears.lock().unwrap_or_else(PoisonError::into_inner).extend(numbers.take(5));
        });
        Self { performer, said }
    }

    /// It ends by itself.
    fn end(self) -> Did {
        let status = self.performer.end();
        assert!(status.success(), "the guest ended with {status}");
        let said = self.said.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let [clients, done, granted, refused, beyond] = said[..] else { panic!("the guest said {said:?}") };
        Did { clients, done, granted, refused, beyond }
    }
}

/// The process of a visitor, and what it says.
struct Visitor {
    performer: Performer,
    answers: Receiver<String>,
}

impl Visitor {
    fn start(scene: &Scene<'_>, number: usize) -> Self {
        let (say, answers) = sync_channel(1);
        let mut command = Command::new(scene.program);
        command.args(["--role", "visitor"]).arg(scene.robot.door()).arg(number.to_string());
        let performer = Performer::start_command(scene.hosts[KNEE].moved(&command), "visitor", move |line| {
            // Nobody waits for it any more when the director is done.
            let _ = say.send(line.to_owned());
        });
        Self { performer, answers }
    }

    /// How many groups it is in, as soon as it is in all that it may.
    fn granted(&self) -> u64 {
        let line = self.answers.recv_timeout(DEADLINE).expect("a visitor says how many groups it is in");
        line.parse().expect("a number")
    }

    fn end(self) {
        let status = self.performer.end();
        assert!(status.success(), "a visitor ended with {status}");
    }
}

/// What must not be is that a visitor is in more groups than are the share of a user; with fewer, it has displaced nothing.
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

/// Whoever was refused nothing beyond its share has not come so far that barriers became few.
fn judge_arrivals(did: &Did, mut happened: Happened) -> Happened {
    let Did { done, beyond, .. } = *did;
    if beyond == 0 {
        happened.broken.push(format!("none of the guest's {done} arrivals was answered as beyond its share"));
    }
    happened.what += &format!("; {beyond} arrivals were answered as beyond the guest's share");
    happened
}

/// What must not be for however short a time is that a call is missed, a barrier does not open, or the guest is let into a group that its
/// list does not grant.
fn judge(did: &Did, together: &Together, what: &'static str) -> Happened {
    let Did { clients, done: count, granted, refused, beyond: _ } = *did;
    let Together { sent, heard, met, failed, words } = together;
    let mut never = Vec::new();
    if heard < sent {
        never.push(format!("{} of {sent} calls of hip to knee's group never came: {words}", sent - heard));
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
         comes ({heard} of {sent}), each barrier of both opens ({met}, {failed} did not), and the guest is in no group but its own ({granted})"
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
    fn one_call_that_is_missed_one_barrier_that_stays_shut_and_one_group_too_much_are_told() {
        let all = Together { sent: 100, heard: 100, met: 9, ..Together::default() };
        assert!(judged(0, &all).let_in.is_empty() && judged(0, &all).broken.is_empty());
        let missed = Together { heard: 99, ..all };
        assert!(judged(0, &missed).let_in[0].contains("1 of 100 calls"));
        let shut = Together { heard: 100, failed: 1, words: "256 barriers".to_owned(), ..missed };
        assert!(judged(0, &shut).let_in[0].contains("did not open: 256 barriers"));
        let open = Together { failed: 0, ..shut };
        assert!(judged(1, &open).let_in[0].contains("let into 1 groups"));
    }

    #[test]
    fn where_nobody_did_anything_nothing_is_shown() {
        let nothing = judged(0, &Together::default());
        assert!(nothing.let_in.is_empty() && nothing.broken.len() == 1, "{:?}", nothing.broken);
    }
    #[test]
    fn arrivals_of_which_none_was_refused_for_a_share_show_nothing() {
        let arrived = |beyond| judge_arrivals(&Did { beyond, ..did(0) }, Happened::default());
        assert!(arrived(0).broken[0].contains("none of the guest's 1000 arrivals"));
        assert!(arrived(1).broken.is_empty());
    }

    #[test]
    fn visitors_are_in_as_many_groups_as_are_their_share_no_more_and_no_less() {
        let visited = |granted| judge_visits(granted, Happened::default());
        let just = visited([OF_VISITOR; 2]);
        assert!(just.broken.is_empty() && just.let_in.is_empty());
        let more = visited([OF_VISITOR, OF_VISITOR + 1]);
        assert!(more.broken.is_empty() && more.let_in[0].contains("let into 513 groups"));
        let less = visited([0, OF_VISITOR]);
        assert!(less.let_in.is_empty() && less.broken[0].contains("in 0 groups only"));
    }
}
