//! Supervisors that fail: their children still stop, each within its limit, and each end is reported.

use std::{
    cell::RefCell,
    rc::Rc,
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Duration,
};

use actix::{Actor, AsyncContext, Context, Running};
use sinew_runtime::supervision::{
    ChildId, ChildSpec, Place, Policy, ReadyGate, Reason, Strategy, Supervisor, SupervisorFact, Threads,
    running_actor,
};

const DEADLINE: Duration = Duration::from_secs(20);
const OBEYS: ChildId = ChildId(1);
const REFUSES: ChildId = ChildId(2);

struct Child {
    answer: Running,
    written: SyncSender<&'static str>,
}

impl Actor for Child {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        // An actor without work would end by itself.
        context.run_interval(DEADLINE, |_, _| {});
    }

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        match self.answer {
            Running::Stop => self.written.send("stops").unwrap(),
            Running::Continue => {}
        }
        self.answer
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        self.written.send("is dropped").unwrap();
    }
}

fn child(id: ChildId, answer: Running, written: &SyncSender<&'static str>) -> ChildSpec {
    let written = written.clone();
    ChildSpec {
        id,
        name: id.to_string(),
        tid: None,
        policy: Policy { stop_within: Duration::from_millis(50), ..Policy::default() },
        place: Place::thread(id.to_string()),
        launch: Arc::new(move |ready: ReadyGate| {
            ready.reached();
            running_actor(Context::new().into_future(Child { answer, written: written.clone() }))
        }),
    }
}

/// A supervisor that panics when all its children are ready. Returns its later reports, and the children's
/// records.
fn fails(run: fn(Supervisor)) -> (Receiver<SupervisorFact>, Receiver<&'static str>) {
    let ((say, said), (write, written)) = (sync_channel(100), sync_channel(100));
    std::thread::spawn(move || {
        let system = actix::System::new();
        let children = vec![child(OBEYS, Running::Stop, &write), child(REFUSES, Running::Continue, &write)];
        let listener = move |fact| {
            assert!(fact != SupervisorFact::AllReady, "whoever listens panics");
            // After a failure of the test the receiver is gone.
            let _ = say.send(fact);
        };
        let threads = Rc::new(RefCell::new(Threads::default()));
        system.block_on(async move {
            let (supervisor, _) = Supervisor::new("test", Strategy::OneForOne, children, threads, listener);
            run(supervisor);
        });
        system.run().unwrap();
    });
    (said, written)
}

fn ends(said: &Receiver<SupervisorFact>) -> Vec<(ChildId, Reason)> {
    let mut ends = Vec::new();
    while ends.len() < 2 {
        if let SupervisorFact::Gone(id, reason) = said.recv_timeout(DEADLINE).expect("two ends are told") {
            ends.push((id, reason));
        }
    }
    ends
}

fn three_words(written: &Receiver<&'static str>) -> [&'static str; 3] {
    [(); 3].map(|()| written.recv_timeout(DEADLINE).expect("each ends"))
}

#[test]
fn children_of_a_panicked_supervisor_stop_and_are_reported() {
    let (said, written) = fails(|supervisor| {
        let ended = supervisor.oversee();
        actix::spawn(async move {
            let reason = ended.await;
            assert!(matches!(&reason, Reason::Panic(said) if said.contains("whoever listens panics")));
            actix::System::current().stop();
        });
    });
    let [(first, why), last] = ends(&said).try_into().unwrap();
    assert_eq!((first, last), (OBEYS, (REFUSES, Reason::Killed)));
    assert!(matches!(&why, Reason::GaveUp(why) if why.contains("its supervisor panicked: whoever listens")));
    assert_eq!(three_words(&written), ["stops", "is dropped", "is dropped"]);
    assert!(said.recv_timeout(DEADLINE).is_err(), "the overseer was told, and ended its program");
}

#[test]
fn children_of_a_dropped_supervisor_stop() {
    let (said, written) = fails(|supervisor| drop(supervisor.start()));
    let ends = ends(&said);
    assert_eq!(ends[0], (OBEYS, Reason::GaveUp("its supervisor was dropped".to_owned())));
    assert_eq!(ends[1], (REFUSES, Reason::Killed));
    assert_eq!(three_words(&written), ["stops", "is dropped", "is dropped"]);
    let last = said.recv_timeout(DEADLINE).expect("its own end is told");
    assert_eq!(last, SupervisorFact::Ended(Reason::GaveUp("its supervisor was dropped".to_owned())));
}
