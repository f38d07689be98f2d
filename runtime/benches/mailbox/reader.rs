//! The real-time actor that reads, with Sinew's mailbox or that of actix.

use std::{
    sync::{
        Arc, Mutex,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use actix::{Actor, ActorContext, Addr, AsyncContext, Context, Handler, Message};
use sinew_figures::Figures;
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    supervision::Place,
    time::Time,
};

use sinew_runtime_tests::{Number, Patience, Stage};

pub(super) const READER_CPU: usize = 0;
/// Ends the measurement: the reader answers with its figures.
const END: u64 = u64::MAX;
/// Holds the reader until it is released.
const HOLD: u64 = u64::MAX - 1;
/// Stops the reader: actix has no other way from outside.
const STOP: u64 = u64::MAX - 2;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Queue {
    Sinew,
    Actix,
}

impl Queue {
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Sinew => "sinew",
            Self::Actix => "actix",
        }
    }
}

/// The reader's figures.
pub(super) struct Seen {
    /// Ages of the timed messages, from sending to handling.
    pub(super) ages: Figures,
    pub(super) over_10_ms: u64,
    /// How late its periods of 1 ms were.
    pub(super) ticks: Figures,
}

impl Seen {
    fn new() -> Self {
        Self { ages: Figures::new(), over_10_ms: 0, ticks: Figures::new() }
    }
}

/// The handling of a number, common to both readers.
struct Work {
    seen: Seen,
    cost: Duration,
    answer: SyncSender<Seen>,
    gate: Arc<Mutex<Receiver<()>>>,
}

impl Work {
    /// Handles a number. Returns whether to stop.
    fn handle(&mut self, number: u64) -> bool {
        match number {
            END => {
                // The bench no longer listens when it gave up waiting.
                let _ = self.answer.try_send(std::mem::replace(&mut self.seen, Seen::new()));
            }
            HOLD => {
                let _ = self.gate.lock().unwrap().recv();
            }
            STOP => return true,
            0 => {
                let until = Time::now() + self.cost;
                while Time::now() < until {
                    std::hint::spin_loop();
                }
            }
            sent => {
                let age = Time::now().since(Time::from_nanos(sent));
                self.seen.ages.record(age);
                self.seen.over_10_ms += u64::from(age > Duration::from_millis(10));
            }
        }
        false
    }
}

const PERIOD: Duration = Duration::from_millis(1);

struct SinewReader(Work);

impl Actor for SinewReader {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        if !self.0.cost.is_zero() {
            context.every(PERIOD, |this, tick, _| this.0.seen.ticks.record(tick.lateness));
        }
    }
}

impl Handler<Delivery<Number>> for SinewReader {
    type Result = ();

    fn handle(&mut self, number: Delivery<Number>, _: &mut Self::Context) {
        self.0.handle(number.0);
    }
}

struct ActixReader {
    work: Work,
    due: Time,
    ended: SyncSender<()>,
}

impl Actor for ActixReader {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        if !self.work.cost.is_zero() {
            self.due = Time::now() + PERIOD;
            context.run_interval(PERIOD, |this, _| {
                let now = Time::now();
                this.work.seen.ticks.record(now.since(this.due));
                this.due = this.due + PERIOD;
            });
        }
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        let _ = self.ended.try_send(());
    }
}

struct Plain(u64);

impl Message for Plain {
    type Result = ();
}

impl Handler<Plain> for ActixReader {
    type Result = ();

    fn handle(&mut self, number: Plain, context: &mut Self::Context) {
        if self.work.handle(number.0) {
            context.stop();
        }
    }
}

enum Behind {
    Sinew(Stage),
    Actix { address: Addr<ActixReader>, ended: Receiver<()>, stop: SyncSender<()> },
}

/// A running reader.
pub(super) struct Reader {
    behind: Behind,
    answer: Receiver<Seen>,
    open: SyncSender<()>,
}

impl Reader {
    /// Starts a reader. `cost`: handling time of a message that is not timed.
    pub(super) fn start(queue: Queue, cost: Duration) -> Self {
        let (say, answer) = sync_channel(1);
        let (open, gate) = sync_channel(1);
        let gate = Arc::new(Mutex::new(gate));
        let work = move || Work { seen: Seen::new(), cost, answer: say.clone(), gate: gate.clone() };
        let place = Place::thread("reader").realtime(50).on_cpu(READER_CPU);
        let behind = match queue {
            Queue::Sinew => {
                let spec = AppSpec::new("reader", move || SinewReader(work())).handles::<Number>();
                // The bench holds it for a while and takes its CPU away: it must not be reported as hung.
                let spec = spec.place(place).progress_within(Duration::from_secs(60));
                let stage = Stage::start_with(vec![spec.into()], Patience::Endless);
                stage.wait_ready(0);
                Behind::Sinew(stage)
            }
            Queue::Actix => start_actix(place, work),
        };
        Self { behind, answer, open }
    }

    /// Sends a number; returns whether it was accepted.
    pub(super) fn sender(&self) -> Box<dyn Fn(u64) -> bool + Send> {
        match &self.behind {
            Behind::Sinew(stage) => {
                let sender = stage.senders[0].clone();
                Box::new(move |number| sender.send(sender.tid(), &Number(number)).is_ok())
            }
            Behind::Actix { address, .. } => {
                let address = address.clone();
                Box::new(move |number| {
                    #[expect(clippy::disallowed_methods, reason = "this is what is measured")]
                    address.do_send(Plain(number));
                    true
                })
            }
        }
    }

    /// Holds the reader: it handles no message until it [goes on](Self::go_on).
    pub(super) fn hold(&mut self) {
        assert!(self.sender()(HOLD), "the queue is empty");
    }

    pub(super) fn go_on(&self) {
        self.open.send(()).unwrap();
    }

    /// Ends the measurement, after all sent messages.
    pub(super) fn finish(self) -> Seen {
        let send = self.sender();
        while !send(END) {
            std::thread::sleep(Duration::from_millis(1));
        }
        let seen = self.answer.recv().unwrap();
        self.stop();
        seen
    }

    /// Stops it; returns how long that took.
    pub(super) fn stop(self) -> Duration {
        let send = self.sender();
        let ordered = Time::now();
        match self.behind {
            Behind::Sinew(stage) => {
                stage.stop();
                Time::now().since(ordered)
            }
            Behind::Actix { ended, stop, .. } => {
                send(STOP);
                ended.recv().unwrap();
                let took = Time::now().since(ordered);
                stop.send(()).unwrap();
                took
            }
        }
    }
}

fn start_actix(place: Place, work: impl Fn() -> Work + Send + 'static) -> Behind {
    let (give, given) = sync_channel(1);
    let (stop, stops) = sync_channel::<()>(1);
    let (say, ended) = sync_channel(1);
    std::thread::spawn(move || {
        // The same real-time thread with the same reactor, without Sinew.
        place.prepare();
        let system = actix::System::with_tokio_rt(|| {
            tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap()
        });
        system.block_on(async move {
            give.send(ActixReader { work: work(), due: Time::ZERO, ended: say }.start()).unwrap();
            let stopped = tokio::task::spawn_blocking(move || stops.recv());
            let _ = stopped.await;
        });
    });
    Behind::Actix { address: given.recv().unwrap(), ended, stop }
}
