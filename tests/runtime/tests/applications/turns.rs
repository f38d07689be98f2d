//! Turns of an application that has more messages or timers than time.

use std::{
    sync::mpsc::{SyncSender, sync_channel},
    time::Duration,
};

use actix::{Actor, Handler};
use sinew_runtime::app::{AppContext, AppSpec, Delivery};

use sinew_runtime_tests::{DEADLINE, Number, Stage};

/// A backlog of slow messages beside a period.
struct Busy {
    handled: u64,
    say: SyncSender<u64>,
}

impl Actor for Busy {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_millis(1), |this, tick, _| {
            if tick.number == 1 {
                this.say.send(this.handled).unwrap();
            }
        });
    }
}

impl Handler<Delivery<Number>> for Busy {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, context: &mut Self::Context) {
        self.handled += 1;
        // Keeps its mailbox from running empty.
        context.send(context.tid(), &number.payload).unwrap();
    }
}

#[test]
fn endless_backlog_starves_neither_periods_nor_stop() {
    let (say, heard) = sync_channel(1);
    let spec = AppSpec::new("busy", move || Busy { handled: 0, say: say.clone() }).handles::<Number>();
    let stage = Stage::start(vec![spec.into()]);
    stage.wait_ready(0);
    stage.senders[0].send(stage.senders[0].tid(), &Number(1)).unwrap();
    heard.recv_timeout(DEADLINE).expect("a tick in the middle of the backlog");
    assert_eq!(stage.router.refused(), 0);
    stage.stop();
}

/// Each turn of its period takes longer than the period.
pub(super) struct Overrun(pub(super) SyncSender<u64>);

impl Actor for Overrun {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_micros(100), |_, _, _| {
            let until = std::time::Instant::now() + Duration::from_micros(300);
            while std::time::Instant::now() < until {
                std::hint::spin_loop();
            }
        });
    }
}

impl Handler<Delivery<Number>> for Overrun {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, _: &mut Self::Context) {
        self.0.send(number.0).unwrap();
    }
}

#[test]
fn handler_that_overruns_its_period_does_not_block_messages() {
    let (say, heard) = sync_channel(10);
    let spec = AppSpec::new("overrun", move || Overrun(say.clone())).handles::<Number>();
    let stage = Stage::start(vec![spec.into()]);
    stage.wait_ready(0);
    for number in 0..10 {
        stage.senders[0].send(stage.senders[0].tid(), &Number(number)).unwrap();
    }
    for number in 0..10 {
        assert_eq!(heard.recv_timeout(DEADLINE), Ok(number));
    }
    stage.stop();
}
