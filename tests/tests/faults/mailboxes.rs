//! What becomes of messages while their application is away: kept, bounded, replaced, expired, and told.

use sinew::{
    message::{Rejection, SendError, Sender},
    prelude::*,
};
use sinew_tests::{
    DEADLINE, Ground, Log, all_run,
    puppet::{
        Job, Order, Seen, Stage, Value, desk, lives, numbers, outcome_of_job, send_jobs, wait,
        wait_for_numbers,
    },
    until,
};

/// A puppet that is away: it panicked, and what it requires is gone until [`Away::let_it_come_back`].
struct Away {
    ground: Ground,
    node: Node,
    sender: Sender,
    log: Log<Seen>,
    tid: Tid,
}

/// The application that the puppet requires; it ends at its first message and is not started again.
fn gate() -> AppSpec<sinew_tests::puppet::Puppet> {
    Stage::new().got(|_, context| context.stop()).app("gate").0.restart(Restart::Temporary)
}

impl Away {
    fn new(capacity: usize) -> Self {
        let ground = Ground::new();
        let ((puppet, log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
        let puppet = puppet.requires(["gate"]).handles::<RequirementEvent>();
        let node = ground.node("node").configure(|config| config.mailbox_capacity = capacity);
        let node = node.app(gate()).app(puppet).app(desk).start().expect("a node");
        all_run(&[&node]);
        let sender = key.sender();
        let tid = sender.resolve("puppet").expect("it is there");
        sender.send("gate", &Job { number: 1 }).expect("it has room");
        log.wait_for(Seen::Requirement(RequirementEvent::Lost { name: "gate".to_owned() }));
        node.handle().inject("puppet", sinew::fault::Fault::panic()).expect("it is there");
        log.wait_for(Seen::Dropped(1));
        until("it waits for what it requires", || {
            node.handle().waiting().iter().any(|waiting| waiting.application == "puppet").then_some(())
        });
        Self { ground, node, sender, log, tid }
    }

    /// The gate is opened on another node.
    #[must_use]
    fn let_it_come_back(&self) -> Node {
        let node = self.ground.node("other").app(gate()).start().expect("a node");
        all_run(&[&node]);
        node
    }
}

#[test]
fn messages_for_one_that_is_away_are_kept_in_order_behind_its_tid() {
    let away = Away::new(64);
    for number in 1..=20 {
        away.sender.send(away.tid, &Job { number }).expect("its mailbox is there");
    }
    let _other = away.let_it_come_back();
    assert_eq!(wait_for_numbers(&away.log, 20), (1..=20).collect::<Vec<_>>());
    assert_eq!(lives(&away.log), 2);
}

#[test]
fn the_mailbox_of_one_that_is_away_holds_its_bound_and_refuses_the_newest() {
    let away = Away::new(4);
    for number in 1..=4 {
        away.sender.send(away.tid, &Job { number }).expect("it has room");
    }
    for number in 5..=6 {
        let refused = away.sender.send(away.tid, &Job { number });
        assert!(matches!(refused, Err(SendError::Rejected(Rejection::QueueFull))), "{refused:?}");
    }
    away.sender.send(away.tid, &Order { number: 100 }).expect("each class has its own room");
    let _other = away.let_it_come_back();
    assert_eq!(wait_for_numbers(&away.log, 5), [100, 1, 2, 3, 4], "Control first, then Bulk in order");
    assert_eq!(outcome_of_job(&away.sender, "puppet", 7), Outcome::Delivered);
}

#[test]
fn of_a_stream_only_the_newest_value_waits_for_one_that_is_away() {
    let away = Away::new(64);
    for number in 1..=50 {
        away.sender.send(away.tid, &Value { number }).expect("it takes the place of the one before");
    }
    away.sender.send(away.tid, &Job { number: 99 }).expect("it has room");
    let _other = away.let_it_come_back();
    assert_eq!(wait_for_numbers(&away.log, 2), [50, 99]);
}

#[test]
fn what_expires_while_its_application_is_away_is_told_and_never_handled() {
    let away = Away::new(64);
    let sent = away.sender.message(away.tid, &Job { number: 1 }).confirmed(Duration::from_micros(1));
    let confirmation = sent.expect("it has room");
    let _other = away.let_it_come_back();
    assert_eq!(outcome_of_job(&away.sender, "puppet", 2), Outcome::Delivered);
    assert_eq!(numbers(&away.log.all()), [2], "the expired one is not among them");
    assert_eq!(wait(confirmation), Outcome::Expired);
}

#[test]
fn a_confirmed_message_to_one_that_is_away_is_delivered_when_it_is_back() {
    let away = Away::new(64);
    let confirmation =
        away.sender.message(away.tid, &Job { number: 1 }).confirmed(DEADLINE).expect("it has room");
    let _other = away.let_it_come_back();
    assert_eq!(wait(confirmation), Outcome::Delivered);
    away.log.wait_for(Seen::Got(2, 1));
}

#[test]
fn what_waits_for_one_that_never_comes_back_is_refused_when_its_node_stops() {
    let Away { node, sender, tid, log, .. } = Away::new(64);
    let confirmation = sender.message(tid, &Job { number: 1 }).confirmed(DEADLINE).expect("it has room");
    drop(node);
    assert_eq!(wait(confirmation), Outcome::Rejected(Rejection::Closed));
    assert!(numbers(&log.all()).is_empty(), "nobody was started for it");
}

#[test]
fn each_confirmed_message_through_many_panics_has_exactly_one_outcome_and_is_handled_at_most_once() {
    let stage = Stage::new().got(|puppet, _| assert!(puppet.number % 40 != 39, "now and then"));
    let ((puppet, log), (desk, key)) = (stage.app("puppet"), desk("desk"));
    let node = Ground::new().node("node").app(puppet).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    let sent: Vec<_> = (0..200)
        .map(|number| sender.message("puppet", &Job { number }).confirmed(DEADLINE).expect("room"))
        .collect();
    let outcomes = wait(async {
        let mut outcomes = Vec::new();
        for confirmation in sent {
            outcomes.push(confirmation.await);
        }
        outcomes
    });
    for (number, outcome) in outcomes.iter().enumerate() {
        let expected = if number % 40 == 39 { Outcome::Failed } else { Outcome::Delivered };
        assert_eq!(*outcome, expected, "message {number}");
    }
    assert_eq!(numbers(&log.all()), (0..200).collect::<Vec<_>>());
    log.wait_for(Seen::Started(6));
}

/// Asks, and hears the answer, unless it panicked in between.
#[test]
fn an_answer_to_a_life_that_is_over_disturbs_the_next_one_in_nothing() {
    let answering = Stage::new().app("oracle").0;
    let stage = Stage::new().started(|puppet, context| {
        if puppet.life == 1 {
            let asked =
                context.message("oracle", &Order { number: 7 }).ask::<Order>(DEADLINE).expect("it is sent");
            drop(asked);
            panic!("before the answer");
        }
    });
    let ((puppet, log), (desk, key)) = (stage.requires_oracle(), desk("desk"));
    let node = Ground::new().node("node").app(answering).app(puppet).app(desk).start().expect("a node");
    all_run(&[&node]);
    log.wait_for(Seen::Started(2));
    assert_eq!(outcome_of_job(&key.sender(), "puppet", 1), Outcome::Delivered);
    assert_eq!(numbers(&log.all()), [1], "the answer is no message of its own");
}

trait RequiresOracle {
    fn requires_oracle(self) -> (AppSpec<sinew_tests::puppet::Puppet>, Log<Seen>);
}

impl RequiresOracle for Stage {
    fn requires_oracle(self) -> (AppSpec<sinew_tests::puppet::Puppet>, Log<Seen>) {
        let (app, log) = self.app("puppet");
        (app.requires(["oracle"]), log)
    }
}

#[test]
fn a_sender_that_panics_leaves_what_it_sent_in_flight() {
    let stage = Stage::new().started(|puppet, context| {
        if puppet.life == 1 {
            for number in 1..=10 {
                context.send("sink", &Job { number }).expect("it has room");
            }
            panic!("after it has sent");
        }
    });
    let ((puppet, _), (sink, seen)) = (stage.app("puppet"), Stage::new().app("sink"));
    let node = Ground::new().node("node").app(sink).app(puppet.requires(["sink"])).start().expect("a node");
    assert_eq!(wait_for_numbers(&seen, 10), (1..=10).collect::<Vec<_>>());
    all_run(&[&node]);
    assert_eq!(numbers(&seen.all()).len(), 10, "and nothing twice");
}

#[test]
fn a_flood_while_its_application_panics_again_and_again_is_handled_or_refused_and_never_lost() {
    let stage = Stage::new().got(|puppet, _| assert!(puppet.number % 300 != 299, "now and then"));
    let ((puppet, log), (desk, key)) = (stage.app("puppet"), desk("desk"));
    let node = Ground::new().node("node").configure(|config| config.mailbox_capacity = 8);
    let node = node.app(puppet).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    let mut taken = Vec::new();
    for number in 0..1_500 {
        match sender.send("puppet", &Job { number }) {
            Ok(()) => taken.push(number),
            Err(SendError::Rejected(Rejection::QueueFull)) => {
                // The flood waits for its turn, as a sender that must not lose anything does.
                until("room", || sender.send("puppet", &Job { number }).ok());
                taken.push(number);
            }
            Err(error) => panic!("{error}"),
        }
    }
    send_jobs(&sender, "puppet", []);
    assert_eq!(wait_for_numbers(&log, taken.len()), taken);
    log.wait_for(Seen::Started(6));
}
