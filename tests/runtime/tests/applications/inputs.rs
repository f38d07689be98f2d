//! Input watchdogs, by arrival and by age, beside a periodic timer.

use std::{
    sync::{
        Arc,
        mpsc::{SyncSender, sync_channel},
    },
    time::Duration,
};

use actix::{Actor, Handler, Running};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery, InputCriterion, InputTimeout},
    time::Time,
    wire::{Message, Payload},
};

use sinew_runtime_tests::{DEADLINE, Number, Stage};

/// How long a watcher waits for numbers: an actor without a CPU for a while ticks five times before.
const SILENCE: Duration = Duration::from_millis(500);

/// Ticks each millisecond, and waits for numbers that do not arrive.
struct Watcher(SyncSender<&'static str>);

impl Actor for Watcher {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.every(Duration::from_millis(1), |this, tick, _| {
            if tick.number == 5 {
                this.0.send("five ticks").unwrap();
            }
        });
        context.watch_input::<Number>(None, SILENCE, |this, silence, _| {
            assert!(silence.silent >= SILENCE);
            this.0.send("silence").unwrap();
        });
    }

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        self.0.send("stopping").unwrap();
        Running::Stop
    }
}

impl Handler<Delivery<Number>> for Watcher {
    type Result = ();

    fn handle(&mut self, _: Delivery<Number>, _: &mut Self::Context) {
        self.0.send("number").unwrap();
    }
}

#[test]
fn periods_tick_and_each_silence_is_reported_once() {
    let (say, heard) = sync_channel(100);
    let spec = AppSpec::new("watcher", move || Watcher(say.clone())).handles::<Number>();
    let stage = Stage::start(vec![spec.into()]);
    let next = || heard.recv_timeout(DEADLINE).expect("the watcher says something");
    assert_eq!([next(), next()], ["five ticks", "silence"]);
    stage.senders[0].send(stage.senders[0].tid(), &Number(1)).unwrap();
    assert_eq!([next(), next()], ["number", "silence"], "the next silence is a new one");
    stage.stop();
    assert_eq!(next(), "stopping");
}

/// Reports the input timeouts of the watchdog by age, and of the one by arrival.
struct Judge(SyncSender<InputTimeout>);

impl Actor for Judge {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.watch_input::<Number>(None, SILENCE, |this, timeout, _| this.0.send(timeout).unwrap());
        context.watch_input_age::<Number>(None, SILENCE, |this, timeout, _| this.0.send(timeout).unwrap());
    }
}

impl Handler<Delivery<Number>> for Judge {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, _: &mut Self::Context) {
        assert!(number.is_older_than(SILENCE) && !number.is_older_than(DEADLINE), "{:?}", number.age);
    }
}

#[test]
fn late_values_trip_a_watchdog_by_age() {
    let (say, heard) = sync_channel(100);
    let stage =
        Stage::start(vec![AppSpec::new("judge", move || Judge(say.clone())).handles::<Number>().into()]);
    let to = stage.senders[0].tid();
    // If the machine stalls for so long that no value arrives, the other watchdog trips, too.
    let timeout = loop {
        let mut late = Message::typed(to, to, &Number(1));
        late.header.sent = Time::now() - 2 * SILENCE;
        stage.router.send(late).unwrap();
        match heard.recv_timeout(Duration::from_millis(1)) {
            Ok(timeout) if timeout.criterion == InputCriterion::Age => break timeout,
            Ok(_) | Err(_) => {}
        }
    };
    assert_eq!((timeout.kind, timeout.limit), (Number::KIND, SILENCE));
    assert!(timeout.is_silent() || timeout.age > Some(2 * SILENCE), "{timeout:?}");
    stage.stop();
}

#[test]
fn undecodable_bytes_do_not_feed_the_input_watchdog() {
    let (say, heard) = sync_channel(100);
    let spec = AppSpec::new("watcher", move || Watcher(say.clone())).handles::<Number>();
    let stage = Stage::start(vec![spec.into()]);
    stage.wait_ready(0);
    let (sender, stop) = (stage.senders[0].clone(), Arc::new(std::sync::atomic::AtomicBool::new(false)));
    let rubbish = {
        let stop = stop.clone();
        std::thread::spawn(move || {
            while !stop.load(std::sync::atomic::Ordering::Relaxed) {
                let mut garbage = sender.create_message(sender.tid(), Number::KIND, 3).unwrap();
                garbage.fill(0xc1); // the one byte that MessagePack never uses
                // If the actor has no CPU for a while, its mailbox is full.
                let _ = sender.loaned(garbage).send();
                std::thread::sleep(Duration::from_millis(1)); // the rate of the invalid messages
            }
        })
    };
    while heard.recv_timeout(DEADLINE).expect("the watcher says something") != "silence" {}
    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    rubbish.join().unwrap();
    stage.stop();
}
