//! Applications under a supervisor, without any layer: delivery, panics, hangs, protection, periods, watchdogs,
//! requests, stop.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

mod hangs;
mod inputs;
mod no_runtime;
mod orphans;
mod outcomes;
mod panics;
mod protection;
mod room;
mod turns;

use std::{
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    time::Duration,
};

use actix::{Actor, ActorContext, Handler, Running};
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    supervision::{ChildId, Place, Reason, SupervisorFact},
    wire::{Class, Payload},
};

use sinew_runtime_tests::{DEADLINE, Number, Stage};

#[derive(Serialize, Deserialize)]
struct Unheard;

impl Payload for Unheard {
    const NAME: &'static str = "test.unheard";
}

/// Records its messages; panics at 13 and rejects 99.
struct Scribe(SyncSender<u64>);

impl Actor for Scribe {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Number>> for Scribe {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, context: &mut Self::Context) {
        assert!(number.0 != 13, "thirteen");
        if number.0 == 99 {
            context.reject();
            return;
        }
        if number.reply_to().is_some() {
            context.reply(&number, &Number(number.0 * 2)).unwrap();
        }
        self.0.send(number.0).unwrap();
    }
}

fn scribe() -> (AppSpec<Scribe>, Receiver<u64>) {
    let (written, read) = sync_channel(1_000);
    (AppSpec::new("scribe", move || Scribe(written.clone())).handles::<Number>().own_thread(), read)
}

#[test]
fn messages_behind_a_panic_reach_the_next_instance() {
    let (spec, read) = scribe();
    let stage = Stage::start(vec![spec.into()]);
    stage.wait_ready(0);
    for number in [1, 13, 2, 3] {
        stage.senders[0].send(stage.senders[0].tid(), &Number(number)).unwrap();
    }
    let seen: Vec<_> = (0..3).map(|_| read.recv_timeout(DEADLINE).expect("a number")).collect();
    assert_eq!(seen, [1, 2, 3]);
    let tally = stage.mailboxes[0].tally(Class::Bulk);
    assert_eq!((tally.taken, tally.failed), (4, 1));
    stage.stop();
}

/// Needs three more periods after its stop order, like a drive that ramps its torque down.
struct Ramp {
    left: u32,
    down: SyncSender<()>,
}

impl Actor for Ramp {
    type Context = AppContext<Self>;

    fn stopping(&mut self, context: &mut Self::Context) -> Running {
        if self.left == 0 {
            return Running::Stop;
        }
        context.every(Duration::from_millis(1), |this, _, context| {
            this.left = this.left.saturating_sub(1);
            if this.left == 0 {
                this.down.try_send(()).ok();
                context.stop();
            }
        });
        Running::Continue
    }
}

#[test]
fn application_may_ramp_down_before_it_stops() {
    let (down, is_down) = sync_channel(1);
    let spec = AppSpec::new("drive", move || Ramp { left: 3, down: down.clone() });
    let stage = Stage::start(vec![spec.into()]);
    stage.wait_ready(0);
    stage.stop();
    is_down.recv_timeout(DEADLINE).expect("the ramp ended before the application did");
}

/// Never becomes ready.
struct Hesitant;

impl Actor for Hesitant {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        // The gate is dropped, so it is never reached.
        drop(context.hold_ready());
    }
}

#[test]
fn unready_app_does_not_affect_others_on_its_thread() {
    let (spec, read) = scribe();
    let place = Place::thread("shared");
    let hesitant =
        AppSpec::new("hesitant", || Hesitant).start_within(Duration::from_millis(20)).place(place.clone());
    let stage = Stage::start(vec![spec.place(place).into(), hesitant.into()]);
    stage.wait_ready(0);
    for _ in 0..2 {
        while stage.next_fact() != SupervisorFact::Failed(ChildId(1), Reason::StartTimeout) {}
    }
    stage.senders[0].send(stage.senders[0].tid(), &Number(1)).unwrap();
    assert_eq!(read.recv_timeout(DEADLINE), Ok(1));
    stage.stop();
}
