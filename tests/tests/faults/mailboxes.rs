//! Messages for an application that is down: kept, bounded, replaced, expired, and reported.

use sinew::{
    message::{Rejection, SendError, Sender},
    prelude::*,
};
use sinew_testkit::{
    DEADLINE, Log, Loopback, all_run,
    scripted::{
        Job, Order, Script, Seen, Value, incarnations, numbers, outcome_of_job, send_jobs, sender_app, wait,
        wait_for_numbers,
    },
    until,
};

use super::perform;

/// A scripted application that is down: it panicked, and its requirement is gone until
/// [`Away::let_it_come_back`].
struct Away {
    loopback: Loopback,
    node: Node,
    sender: Sender,
    log: Log<Seen>,
    tid: Tid,
}

/// The application that the scripted application requires; it ends at its first message and is not restarted.
fn gate() -> AppSpec<sinew_testkit::scripted::ScriptedApp> {
    Script::new().got(|_, context| context.stop()).app("gate").0.restart(Restart::Temporary)
}

impl Away {
    fn new(capacity: usize) -> Self {
        let loopback = Loopback::new();
        let ((scripted, log), (sender_app, key)) = (Script::new().app("scripted"), sender_app("sender"));
        let scripted = scripted.requires(["gate"]).handles::<RequirementEvent>();
        let node = loopback.node("node").configure(|config| config.mailbox_capacity = capacity);
        let node = node.app(gate()).app(scripted).app(sender_app).start().expect("a node");
        all_run(&[&node]);
        let sender = key.sender();
        let tid = sender.resolve("scripted").expect("it is there");
        sender.send("gate", &Job { number: 1 }).expect("it has room");
        log.wait_for(Seen::Requirement(RequirementEvent::Lost { name: "gate".to_owned() }));
        node.handle().inject("scripted", sinew::fault::Fault::panic()).expect("it is there");
        log.wait_for(Seen::Dropped(1));
        until("it waits for what it requires", || {
            node.handle().waiting().iter().any(|waiting| waiting.application == "scripted").then_some(())
        });
        Self { loopback, node, sender, log, tid }
    }

    /// Opens the gate on another node.
    #[must_use]
    fn let_it_come_back(&self) -> Node {
        let node = self.loopback.node("other").app(gate()).start().expect("a node");
        all_run(&[&node]);
        node
    }
}

#[test]
fn messages_are_kept_in_order_behind_the_tid() {
    let away = Away::new(64);
    for number in 1..=20 {
        away.sender.send(away.tid, &Job { number }).expect("its mailbox is there");
    }
    let last = away.sender.message(away.tid, &Job { number: 21 }).confirmed(DEADLINE).expect("it has room");
    let _other = away.let_it_come_back();
    assert_eq!(wait(last), Outcome::Delivered);
    assert_eq!(wait_for_numbers(&away.log, 21), (1..=21).collect::<Vec<_>>());
    assert_eq!(incarnations(&away.log), 2);
}

#[test]
fn full_mailbox_rejects_the_newest_messages() {
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
    assert_eq!(outcome_of_job(&away.sender, "scripted", 7), Outcome::Delivered);
}

#[test]
fn only_the_newest_stream_value_waits() {
    let away = Away::new(64);
    for number in 1..=50 {
        away.sender.send(away.tid, &Value { number }).expect("it takes the place of the one before");
    }
    away.sender.send(away.tid, &Job { number: 99 }).expect("it has room");
    let _other = away.let_it_come_back();
    assert_eq!(wait_for_numbers(&away.log, 2), [50, 99]);
}

#[test]
fn expired_message_is_reported_and_not_handled() {
    let away = Away::new(64);
    let sent = away.sender.message(away.tid, &Job { number: 1 }).confirmed(Duration::from_micros(1));
    let confirmation = sent.expect("it has room");
    let _other = away.let_it_come_back();
    assert_eq!(outcome_of_job(&away.sender, "scripted", 2), Outcome::Delivered);
    assert_eq!(numbers(&away.log.all()), [2], "the expired one is not among them");
    assert_eq!(wait(confirmation), Outcome::Expired);
}

#[test]
fn queued_messages_are_rejected_at_node_stop() {
    let Away { node, sender, tid, log, .. } = Away::new(64);
    let confirmation = sender.message(tid, &Job { number: 1 }).confirmed(DEADLINE).expect("it has room");
    drop(node);
    assert_eq!(wait(confirmation), Outcome::Rejected(Rejection::Closed));
    assert!(numbers(&log.all()).is_empty(), "nobody was started for it");
}

#[test]
fn confirmed_messages_have_one_outcome_through_panics() {
    let script = Script::new().got(|scripted, _| assert!(scripted.number % 40 != 39, "now and then"));
    let (node, sender, log) = perform(script, |app| app);
    all_run(&[&node]);
    let sent: Vec<_> = (0..200)
        .map(|number| sender.message("scripted", &Job { number }).confirmed(DEADLINE).expect("room"))
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

/// Sends a request, and records the reply unless it panicked in between.
#[test]
fn late_reply_does_not_disturb_the_next_incarnation() {
    let answering = Script::new().app("oracle").0;
    let script = Script::new().started(|scripted, context| {
        if scripted.incarnation == 1 {
            let asked =
                context.message("oracle", &Order { number: 7 }).ask::<Order>(DEADLINE).expect("it is sent");
            drop(asked);
            panic!("before the answer");
        }
    });
    let ((scripted, log), (sender_app, key)) = (script.requires_oracle(), sender_app("sender"));
    let node =
        Loopback::new().node("node").app(answering).app(scripted).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    log.wait_for(Seen::Started(2));
    assert_eq!(outcome_of_job(&key.sender(), "scripted", 1), Outcome::Delivered);
    assert_eq!(numbers(&log.all()), [1], "the answer is no message of its own");
}

trait RequiresOracle {
    fn requires_oracle(self) -> (AppSpec<sinew_testkit::scripted::ScriptedApp>, Log<Seen>);
}

impl RequiresOracle for Script {
    fn requires_oracle(self) -> (AppSpec<sinew_testkit::scripted::ScriptedApp>, Log<Seen>) {
        let (app, log) = self.app("scripted");
        (app.requires(["oracle"]), log)
    }
}

#[test]
fn messages_in_flight_outlive_their_sender() {
    let script = Script::new().started(|scripted, context| {
        if scripted.incarnation == 1 {
            for number in 1..=10 {
                context.send("sink", &Job { number }).expect("it has room");
            }
            panic!("after it has sent");
        }
    });
    let ((scripted, _), (sink, seen)) = (script.app("scripted"), Script::new().app("sink"));
    let node =
        Loopback::new().node("node").app(sink).app(scripted.requires(["sink"])).start().expect("a node");
    assert_eq!(wait_for_numbers(&seen, 10), (1..=10).collect::<Vec<_>>());
    all_run(&[&node]);
    assert_eq!(numbers(&seen.all()).len(), 10, "and nothing twice");
}

#[test]
fn flood_through_panics_loses_no_message() {
    let script = Script::new().got(|scripted, _| assert!(scripted.number % 300 != 299, "now and then"));
    let ((scripted, log), (sender_app, key)) = (script.app("scripted"), sender_app("sender"));
    let node = Loopback::new().node("node").configure(|config| config.mailbox_capacity = 8);
    let node = node.app(scripted).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    let mut taken = Vec::new();
    for number in 0..1_500 {
        match sender.send("scripted", &Job { number }) {
            Ok(()) => taken.push(number),
            Err(SendError::Rejected(Rejection::QueueFull)) => {
                // The flood waits for room, like a sender that must not lose messages.
                until("room", || sender.send("scripted", &Job { number }).ok());
                taken.push(number);
            }
            Err(error) => panic!("{error}"),
        }
    }
    send_jobs(&sender, "scripted", []);
    assert_eq!(wait_for_numbers(&log, taken.len()), taken);
    log.wait_for(Seen::Started(6));
}
