//! Deadlines of a supervisor on an overloaded machine: an actor without CPU time is not declared dead.

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

use sinew_runtime_tests::{DEADLINE, Number, Stage};

/// The overloaded CPU.
const CROWDED: usize = 0;
/// Number of threads that only use up its time.
const BURNERS: usize = 10;
/// The computing time of an actor. With the burners it takes eleven times as long.
const WORK: Duration = Duration::from_millis(40);
/// The time limit for it.
const WITHIN: Duration = Duration::from_millis(100);

/// Threads that spin on the crowded CPU until this is dropped.
struct Burners(Arc<AtomicBool>, #[expect(dead_code, reason = "held")] MutexGuard<'static, ()>);

impl Burners {
    fn new() -> Self {
        // One test at a time has burners.
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

/// Computes for this much of the calling thread's own CPU time.
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

/// The phase of the computation.
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
fn start_limit_excludes_time_without_cpu() {
    let _burners = Burners::new();
    let spec = AppSpec::new("worker", || Worker(When::Starting)).place(crowded()).start_within(WITHIN);
    let stage = Stage::start(vec![spec.into()]);
    assert!(matches!(stage.next_fact(), SupervisorFact::Starting(..)));
    assert_eq!(stage.next_fact(), SupervisorFact::Ready(ChildId(0)), "in its first life");
}

#[test]
fn stop_limit_excludes_time_without_cpu() {
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
fn computing_neighbour_without_cpu_is_not_abandoned() {
    let taken = Arc::new(AtomicBool::new(false));
    let flag = taken.clone();
    let busy = AppSpec::new("busy", move || Busy(flag.clone())).handles::<Number>();
    let busy = busy.place(crowded()).progress_within(DEADLINE * 2);
    let unready = AppSpec::new("unready", || Unready).place(crowded()).start_within(Duration::from_secs(1));
    let stage = Stage::start(vec![busy.into(), unready.restart(Restart::Temporary).into()]);
    stage.wait_ready(0);
    stage.send(0, 13);
    while stage.next_fact() != SupervisorFact::Gone(ChildId(1), Reason::StartTimeout) {}
    // From here on its thread has 200 ms to release it. Its neighbour needs 80 ms of CPU time, and gets only
    // a part of the CPU.
    let burners = Burners::new();
    taken.store(true, Ordering::Relaxed);
    let sender = &stage.senders[0];
    let after = sender.message(sender.tid(), &Number(14)).confirmed(DEADLINE).unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    assert_eq!(runtime.block_on(after), sinew_runtime::outcome::Outcome::Delivered);
    drop(burners);
    assert_eq!(stage.most_abandoned(), 0, "its thread was not given up");
}

const FROZEN: &str = "deadlines::frozen_by_the_test_below";

/// Needs less than its limit, unless the time in which it was frozen counts.
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
fn start_limit_excludes_time_frozen() {
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
    // Each thread stops on its own, and only after all have stopped the process stands still.
    waitid(WaitId::Pid(pid), WaitIdOptions::STOPPED | WaitIdOptions::NOWAIT).unwrap().expect("it stops");
    std::thread::sleep(Duration::from_secs(2)); // the freeze that is tested
    kill_process(pid, Signal::CONT).unwrap();
    said.read_to_string(&mut line).unwrap();
    assert!(frozen.wait().unwrap().success(), "{line}");
}
