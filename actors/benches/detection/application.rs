//! Kills an application that runs in its own process, and measures the time until another application of its
//! node is notified.

use std::{
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    thread,
    time::Duration,
};

use fastrand::Rng;
use rustix::process::{Pid, Signal, kill_process};
use sinew::{
    events::{Down, DownClass},
    prelude::*,
};
use sinew_figures::{Alone, Figures};

use crate::{nodes::At, observer::DEADLINE, trials::SETTLED};

/// Bound on the time until the notification.
const BOUND: Duration = Duration::from_millis(5);
/// The watching application.
const OBSERVER: &str = "observer";

payload!("detection.me" =>
    /// Sent by each incarnation of the application.
    struct Me {
        /// Its process.
        pid: u32,
    }
);

/// The killed application.
struct Killed;

impl Actor for Killed {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        context.send(OBSERVER, &Me { pid: std::process::id() }).expect("it is there, and has room");
    }
}

/// An event of the watching application.
enum Heard {
    Life(u32),
    Down(Time, DownClass),
}

struct Watch(SyncSender<Heard>);

impl Actor for Watch {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Me>> for Watch {
    type Result = ();

    fn handle(&mut self, me: Delivery<Me>, context: &mut Self::Context) {
        context.monitor(me.source).expect("it has room for one");
        self.0.try_send(Heard::Life(me.payload.pid)).expect("one in each trial");
    }
}

impl Handler<Delivery<Down>> for Watch {
    type Result = ();

    fn handle(&mut self, down: Delivery<Down>, _: &mut Self::Context) {
        self.0.try_send(Heard::Down(Time::now(), down.payload.class)).expect("one in each trial");
    }
}

/// Kills the application `trials` times. Returns whether all trials went well. The application's process is
/// this program, started again: it runs up to the start of the node.
pub(crate) fn measure(case: &str, trials: u32, seed: u64) -> bool {
    let (tell, heard) = sync_channel(16);
    let watch =
        AppSpec::new(OBSERVER, move || Watch(tell.clone())).handles::<Me>().handles::<Down>().own_thread();
    let killed = AppSpec::new("killed", || Killed).requires([OBSERVER]).own_process();
    let node = At::loopback().node("one").app(watch).app(killed).configure(|config| {
        // Unlimited restarts, without delay.
        (config.supervision.app_restarts_max, config.supervision.app_window) =
            (1_000_000, Duration::from_millis(1));
    });
    let _node = node.start().expect("a node");
    let (mut chance, mut seen, mut right, mut in_time) = (Rng::with_seed(seed), Figures::new(), 0, 0);
    for _ in 0..trials {
        let pid = life(&heard);
        // The application has settled, and the kill comes at a random moment.
        thread::sleep(SETTLED.mul_f64(1.0 + chance.f64()));
        let began = Time::now();
        kill_process(pid, Signal::KILL).expect("it lives");
        let (at, class) = down(&heard);
        let after = at.since(began);
        seen.record(after);
        right += u64::from(class == DownClass::ProcessEnded);
        in_time += u64::from(after <= BOUND);
    }
    let bound_us = u64::try_from(BOUND.as_micros()).expect("some milliseconds");
    let counts = [("right", right), ("bound_us", bound_us), ("in_time", in_time), ("seed", seed)];
    Alone { bench: "detection", case, figure: "act to event", seen: &seen, counts: &counts }.report();
    true
}

fn life(heard: &Receiver<Heard>) -> Pid {
    match heard.recv_timeout(DEADLINE) {
        Ok(Heard::Life(pid)) => i32::try_from(pid).ok().and_then(Pid::from_raw).expect("a process id"),
        Ok(Heard::Down(_, class)) => panic!("told of an end ({class:?}) where a life was to begin"),
        Err(_) => panic!("the application did not start within {DEADLINE:?}"),
    }
}

fn down(heard: &Receiver<Heard>) -> (Time, DownClass) {
    match heard.recv_timeout(DEADLINE) {
        Ok(Heard::Down(at, class)) => (at, class),
        Ok(Heard::Life(_)) => panic!("told of a new life, and not of the end of the one before it"),
        Err(_) => panic!("the end of the application was not told within {DEADLINE:?}"),
    }
}
