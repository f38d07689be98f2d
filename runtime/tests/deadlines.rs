//! Deadlines of a supervisor's on a machine that has no time: who was given no CPU is not declared dead for it.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

#[expect(dead_code, reason = "other tests and the benches need more of it")]
mod stage;

use std::{
    io::{BufRead, BufReader, Read},
    process::{Command, Stdio},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use actix::{Actor, Handler, Running};
use rustix::{
    process::{Pid, Signal, WaitId, WaitIdOptions, kill_process, waitid},
    time::{ClockId, clock_gettime},
};
use sinew_runtime::{
    app::{AppContext, AppSpec, Delivery},
    supervision::{ChildId, Place, Reason, Restart, SupervisorFact},
};
use stage::{DEADLINE, Number, Stage};

/// Where all of this is too much for the CPU.
const CROWDED: usize = 0;
/// Who have nothing better to do there.
const BURNERS: usize = 10;
/// What an actor has to compute. With the burners it takes eleven times as long.
const WORK: Duration = Duration::from_millis(40);
/// What it has for it.
const WITHIN: Duration = Duration::from_millis(100);

/// Threads that spin on the crowded CPU until this is dropped.
struct Burners(Arc<AtomicBool>, #[expect(dead_code, reason = "held")] MutexGuard<'static, ()>);

impl Burners {
    fn new() -> Self {
        // Those of one test at a time.
        static TURN: Mutex<()> = Mutex::new(());
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let over = Arc::new(AtomicBool::new(false));
        for _ in 0..BURNERS {
            let over = over.clone();
            std::thread::spawn(move || {
                Place::thread("burner").on_cpu(CROWDED).prepare();
                while !over.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        Self(over, turn)
    }
}

impl Drop for Burners {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

fn crowded() -> Place {
    Place::thread("crowded").on_cpu(CROWDED)
}

/// Computes for so much of the calling thread's own time.
fn work(time: Duration) {
    let used = || {
        let now = clock_gettime(ClockId::ThreadCPUTime);
        Duration::new(now.tv_sec as u64, now.tv_nsec as u32)
    };
    let until = used() + time;
    while used() < until {
        std::hint::spin_loop();
    }
}

/// When it works.
#[derive(Clone, Copy, PartialEq)]
enum When {
    Starting,
    Stopping,
}

struct Worker(When);

impl Actor for Worker {
    type Context = AppContext<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        if self.0 == When::Starting {
            work(WORK);
        }
    }

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        if self.0 == When::Stopping {
            work(WORK);
        }
        Running::Stop
    }
}

#[test]
fn a_start_has_its_time_though_others_take_the_cpu() {
    let _burners = Burners::new();
    let spec = AppSpec::new("worker", || Worker(When::Starting)).place(crowded()).start_within(WITHIN);
    let stage = Stage::start(vec![spec.into()]);
    assert!(matches!(stage.next_fact(), SupervisorFact::Starting(..)));
    assert_eq!(stage.next_fact(), SupervisorFact::Ready(ChildId(0)), "in its first life");
}

#[test]
fn a_stop_has_its_time_though_others_take_the_cpu() {
    let spec = AppSpec::new("worker", || Worker(When::Stopping)).place(crowded()).stop_within(WITHIN);
    let stage = Stage::start(vec![spec.into()]);
    stage.wait_ready(0);
    let _burners = Burners::new();
    stage.order_stop();
    assert_eq!(stage.wait_failed(0), Reason::Shutdown, "it stopped by itself");
}

/// Never ready.
struct Unready;

impl Actor for Unready {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        std::mem::forget(context.hold_ready());
    }
}

/// Spins until the flag is set, then works.
struct Busy(Arc<AtomicBool>);

impl Actor for Busy {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Number>> for Busy {
    type Result = ();

    fn handle(&mut self, _: Delivery<Number>, _: &mut Self::Context) {
        while !self.0.load(Ordering::Relaxed) {
            std::hint::spin_loop();
        }
        work(WORK * 2);
    }
}

#[test]
fn a_neighbour_that_computes_is_not_lost_because_others_take_the_cpu() {
    let taken = Arc::new(AtomicBool::new(false));
    let flag = taken.clone();
    let busy = AppSpec::new("busy", move || Busy(flag.clone())).handles::<Number>();
    let busy = busy.place(crowded()).progress_within(DEADLINE * 2);
    let unready = AppSpec::new("unready", || Unready).place(crowded()).start_within(Duration::from_secs(1));
    let stage = Stage::start(vec![busy.into(), unready.restart(Restart::Temporary).into()]);
    stage.wait_ready(0);
    stage.send(0, 13);
    while stage.next_fact() != SupervisorFact::Gone(ChildId(1), Reason::StartTimeout) {}
    // From here on its thread has 200 ms to let it go; its neighbour needs 80 ms of its own, and gets a part of the CPU only.
    let burners = Burners::new();
    taken.store(true, Ordering::Relaxed);
    let sender = &stage.senders[0];
    let after = sender.message(sender.tid(), &Number(14)).confirmed(DEADLINE).unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    assert_eq!(runtime.block_on(after), sinew_runtime::outcome::Outcome::Delivered);
    drop(burners);
    assert_eq!(stage.most_abandoned(), 0, "its thread was not given up");
}

const FROZEN: &str = "frozen_by_the_test_below";

/// Needs less than it has, unless it counts the time in which it was frozen.
struct Slow;

impl Actor for Slow {
    type Context = AppContext<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        println!("it starts");
        for _ in 0..20 {
            std::thread::sleep(Duration::from_millis(10)); // each of them, frozen or not
        }
    }
}

#[test]
#[ignore = "it runs in a process of its own, which is frozen"]
fn frozen_by_the_test_below() {
    let spec = AppSpec::new("slow", || Slow).own_thread().start_within(Duration::from_millis(600));
    let stage = Stage::start(vec![spec.into()]);
    assert!(matches!(stage.next_fact(), SupervisorFact::Starting(..)));
    assert_eq!(stage.next_fact(), SupervisorFact::Ready(ChildId(0)), "in its first life");
}

#[test]
fn a_start_has_its_time_though_its_whole_process_stood_still() {
    let mut frozen = Command::new(std::env::current_exe().unwrap());
    frozen.args(["--ignored", "--exact", FROZEN, "--nocapture"]).stdout(Stdio::piped());
    let mut frozen = frozen.spawn().unwrap();
    let mut said = BufReader::new(frozen.stdout.take().unwrap());
    let mut line = String::new();
    while !line.contains("it starts") {
        line.clear();
        assert!(said.read_line(&mut line).unwrap() > 0, "it ended before it began");
    }
    let pid = Pid::from_child(&frozen);
    kill_process(pid, Signal::STOP).unwrap();
    // Each of its threads stops when it comes to it, and only then it stands still.
    waitid(WaitId::Pid(pid), WaitIdOptions::STOPPED | WaitIdOptions::NOWAIT).unwrap().expect("it stops");
    std::thread::sleep(Duration::from_secs(2)); // what this test is about
    kill_process(pid, Signal::CONT).unwrap();
    said.read_to_string(&mut line).unwrap();
    assert!(frozen.wait().unwrap().success(), "{line}");
}
