//! The outcomes of sends, and the replies to requests.

use std::sync::mpsc::{SyncSender, sync_channel};

use actix::{Actor, AsyncContext, Handler, fut::WrapFuture};
use sinew_runtime::{
    app::{AppContext, AppSpec, SendOutcome},
    outcome::{Outcome, Rejection},
    sender::SendError,
    tid::Tid,
    wire::Kind,
};

use sinew_runtime_tests::{DEADLINE, Number, Stage, tid};

use super::{Unheard, scribe, turns::Overrun};

/// Sends as ordered and records the outcomes.
struct Requester {
    to: Tid,
    written: SyncSender<String>,
}

impl Actor for Requester {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let (sender, to, written) = (context.sender(), self.to, self.written.clone());
        let story = async move {
            for number in [7, 13, 99] {
                let outcome = sender.message(to, &Number(number)).confirmed(DEADLINE).unwrap().await;
                written.send(format!("{outcome:?}")).unwrap();
            }
            let unheard = sender.message(to, &Unheard).confirmed(DEADLINE).unwrap().await;
            assert_eq!(unheard, Outcome::Rejected(Rejection::UnknownKind));
            let reply = sender.message(to, &Number(21)).ask::<Number>(DEADLINE).unwrap().await;
            written.send(format!("{}", reply.unwrap().0)).unwrap();
        };
        context.spawn(story.into_actor(self));
    }
}

#[test]
fn confirmed_sends_have_one_outcome_and_requests_a_reply() {
    let (spec, _read) = scribe();
    let (written, told) = sync_channel(10);
    let to = tid(0);
    let requester = AppSpec::new("requester", move || Requester { to, written: written.clone() });
    let stage = Stage::start(vec![spec.into(), requester.into()]);
    let told: Vec<_> = (0..4).map(|_| told.recv_timeout(DEADLINE).expect("an outcome")).collect();
    assert_eq!(told, ["Delivered", "Failed", "Rejected(ByHandler)", "42"]);
    stage.stop();
}

/// Sends three numbers to each of two applications, and records their outcomes.
struct Clerk {
    to: [Tid; 2],
    written: SyncSender<(u64, Outcome)>,
}

impl Actor for Clerk {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        for (tag, number) in [7, 13, 99].into_iter().enumerate() {
            context.message(self.to[0], &Number(number)).with_tag(tag as u64).confirmed(DEADLINE).unwrap();
        }
        let nobody = context.message(self.to[1], &Number(1)).with_tag(3).confirmed(DEADLINE);
        assert!(nobody.is_err(), "nobody takes it, and nobody tells of it");
    }
}

impl Handler<SendOutcome> for Clerk {
    type Result = ();

    fn handle(&mut self, told: SendOutcome, _: &mut Self::Context) {
        self.written.send((told.tag, told.outcome)).unwrap();
    }
}

#[test]
fn outcomes_arrive_as_messages_once_each() {
    let (spec, _read) = scribe();
    let (written, told) = sync_channel(10);
    let to = [0, 7].map(tid);
    let clerk = AppSpec::new("clerk", move || Clerk { to, written: written.clone() });
    let stage = Stage::start(vec![spec.into(), clerk.into()]);
    let mut seen: Vec<_> = (0..3).map(|_| told.recv_timeout(DEADLINE).expect("an outcome")).collect();
    seen.sort_by_key(|(tag, _)| *tag);
    let outcomes = [Outcome::Delivered, Outcome::Failed, Outcome::Rejected(Rejection::ByHandler)];
    assert_eq!(seen, [(0, outcomes[0]), (1, outcomes[1]), (2, outcomes[2])]);
    stage.stop();
    assert!(told.try_recv().is_err(), "each is told once");
}

#[test]
fn application_cannot_send_as_a_layer() {
    let (say, heard) = sync_channel(100);
    let spec = AppSpec::new("overrun", move || Overrun(say.clone())).handles::<Number>();
    let stage = Stage::start(vec![spec.into()]);
    stage.wait_ready(0);
    let sender = &stage.senders[0];
    let forged = sender.create_message(sender.tid(), Kind::NDL_LEAVE, 3).unwrap();
    assert!(matches!(sender.loaned(forged).send(), Err(SendError::NotYours(Kind::NDL_LEAVE))));
    // And: its own messages are still sent
    sender.send(sender.tid(), &Number(1)).unwrap();
    assert_eq!(heard.recv_timeout(DEADLINE), Ok(1));
    stage.stop();
}
