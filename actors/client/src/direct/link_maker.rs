//! Makes the memory of direct links on a thread of its own, so that no caller waits for it.
//!
//! To allocate, offer and map the rings of a link takes some 100 us. A control loop must not spend them between two of
//! its cycles. So an endpoint submits a [`Task`] and takes its result in one of its next calls. Until then the messages
//! go through the node.

use std::{
    io,
    os::unix::net::UnixStream,
    panic::{AssertUnwindSafe, catch_unwind},
    process,
    sync::{
        Arc, Mutex, OnceLock, PoisonError,
        mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
    },
    thread,
};

use sinew_protocol::ring::{self as rings, Exchange, ExchangeError};
use sinew_shm::{Descriptors, PassError, Received, WaitSet, set_descriptors};

use super::{
    RING_BYTES_MAX, Terms,
    budget::{Budget, Share},
    descriptors,
    peer_fd::{LocalHalf, ReceivedCopies, UnusedRings},
};
use crate::{
    link::{LinkOptions, Writer},
    routes::LinkNumber,
};

/// Maximum number of tasks that wait, all endpoints of a process together: a full mesh of some dozens of endpoints in
/// one process asks for as many links at once. A further link is asked for later.
const TASKS_MAX: usize = 256;

/// The maker of this process.
static PROCESS: LinkMaker = LinkMaker { tasks: OnceLock::new() };

struct LinkMaker {
    /// The id of the process with the thread, and the thread's queue; `None` if it could not be started.
    tasks: OnceLock<(u32, Option<SyncSender<Job>>)>,
}

/// One step of the setup of a link.
pub(super) enum Task {
    /// Makes this side's half, and offers it to the peer.
    Offer(Arc<UnixStream>),
    /// Takes the peer's half, makes and offers this side's, and joins both.
    Connect(Arc<UnixStream>),
    /// Takes the half of a peer that has accepted this side's, and joins both.
    Accept(Arc<UnixStream>, Box<(LocalHalf, Share)>),
}

/// The result of a task.
pub(super) enum Made {
    Half(LocalHalf, Share),
    Rings(UnusedRings, Share),
}

/// What a task needs to know of its endpoint.
struct Settings {
    ring_bytes: usize,
    options: LinkOptions,
    budget: &'static Budget,
}

struct Job {
    number: LinkNumber,
    task: Task,
    settings: Settings,
    results: Arc<Results>,
    wake: Wake,
}

/// A result, and its link.
type Finished = (LinkNumber, Result<Made, ExchangeError>);

/// The results that an endpoint has not taken yet: at most one for each task that it has submitted.
#[derive(Default)]
struct Results(Mutex<Vec<Finished>>);

/// Wakes the thread or the task of an endpoint.
struct Wake {
    set: Option<WaitSet>,
    writer: Arc<Writer>,
}

/// The submitted tasks of an endpoint.
#[derive(Default)]
pub(super) struct LinkTasks {
    results: Arc<Results>,
    /// Tasks with a result that was not taken.
    pending: usize,
}

/// The unvalidated half of a link that a peer has passed.
struct PeerHalf {
    received: Received,
    copies: ReceivedCopies,
}

impl LinkTasks {
    /// Submits a task. If too many wait, or if this process has no such thread, returns it.
    pub(super) fn submit(
        &mut self,
        number: LinkNumber,
        task: Task,
        terms: &Terms,
        writer: &Arc<Writer>,
    ) -> Result<(), Task> {
        let Some(maker) = PROCESS.tasks() else { return Err(task) };
        let wake = Wake { set: terms.options.set().cloned(), writer: writer.clone() };
        let results = self.results.clone();
        let job = Job { number, task, settings: Settings::of(terms), results, wake };
        maker.try_send(job).map_err(|refused| match refused {
            TrySendError::Full(job) | TrySendError::Disconnected(job) => job.task,
        })?;
        self.pending += 1;
        Ok(())
    }

    /// Runs a task on the calling thread. Its result is taken as if the maker had run it.
    pub(super) fn run_here(&mut self, number: LinkNumber, task: Task, terms: &Terms) {
        self.results.push(number, task.run(&Settings::of(terms)));
        self.pending += 1;
    }

    pub(super) const fn is_empty(&self) -> bool {
        self.pending == 0
    }

    /// Returns the result of a task that has ended. Never waits.
    pub(super) fn next(&mut self) -> Option<Finished> {
        if self.is_empty() {
            return None;
        }
        // If the maker has the lock, it wakes this endpoint afterwards.
        let finished = self.results.0.try_lock().ok()?.pop()?;
        self.pending -= 1;
        Some(finished)
    }
}

impl Results {
    fn push(&self, number: LinkNumber, made: Result<Made, ExchangeError>) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push((number, made));
    }
}

impl Wake {
    fn wake(&self) {
        match &self.set {
            Some(set) => set.wake(),
            None => self.writer.wake_task(),
        }
    }
}

impl Settings {
    fn of(terms: &Terms) -> Self {
        Self { ring_bytes: terms.ring_bytes, options: terms.options.clone(), budget: terms.budget }
    }

    fn offer(&self, socket: &UnixStream) -> Result<(LocalHalf, Share), ExchangeError> {
        let share = self.budget.take(self.ring_bytes).ok_or(ExchangeError::Budget)?;
        let [own, theirs] = [self.ring_bytes, RING_BYTES_MAX].map(rings::capacity);
        let (exchange, offer) = Exchange::prepare_for(own, self.options.bell.clone(), theirs)?;
        offer.send(socket)?;
        Ok((LocalHalf::new(exchange), share))
    }
}

impl LinkMaker {
    /// Returns the queue of the thread, which is started at the first call.
    fn tasks(&self) -> Option<&SyncSender<Job>> {
        let start = || {
            let (sender, jobs) = sync_channel(TASKS_MAX);
            let thread = thread::Builder::new().name("sinew-links".to_owned());
            let tasks = match thread.spawn(move || run(&jobs)) {
                Ok(_) => Some(sender),
                Err(why) => {
                    sinew_runtime::log::here!(warn: %why, "no thread for the memory of direct links: messages go through the node");
                    None
                }
            };
            (process::id(), tasks)
        };
        let (owner, tasks) = self.tasks.get_or_init(start);
        // The child of a fork has a copy of the queue, and no thread.
        tasks.as_ref().filter(|_| *owner == process::id())
    }
}

/// Runs for as long as the process.
fn run(jobs: &Receiver<Job>) {
    for Job { number, task, settings, results, wake } in jobs {
        let made = catch_unwind(AssertUnwindSafe(|| task.run(&settings)));
        results.push(number, made.unwrap_or(Err(ExchangeError::Fault)));
        wake.wake();
    }
}

impl Task {
    fn run(self, settings: &Settings) -> Result<Made, ExchangeError> {
        match self {
            Self::Offer(socket) => settings.offer(&socket).map(|(half, share)| Made::Half(half, share)),
            Self::Connect(socket) => {
                let theirs = PeerHalf::take(&socket)?;
                let (half, share) = settings.offer(&socket)?;
                Ok(Made::Rings(theirs.join(half)?, share))
            }
            Self::Accept(socket, ours) => {
                let theirs = PeerHalf::take(&socket)?;
                let (half, share) = *ours;
                Ok(Made::Rings(theirs.join(half)?, share))
            }
        }
    }
}

impl PeerHalf {
    /// Receives the half. The peer can pass nothing more over `socket` from then on, if the system supports
    /// that.
    fn take(socket: &Arc<UnixStream>) -> Result<Self, ExchangeError> {
        let mut received = Exchange::take(socket).map_err(|error| {
            let is_there = !matches!(
                &error,
                ExchangeError::Pass(PassError::System(cause)) if cause.kind() == io::ErrorKind::WouldBlock
            );
            if is_there { error } else { ExchangeError::Missing }
        })?;
        let _ = set_descriptors(socket, Descriptors::Refused);
        let copies = ReceivedCopies::of(&mut received, socket);
        let theirs = Self { received, copies };
        if descriptors::holds_data(socket) { Err(ExchangeError::Stray) } else { Ok(theirs) }
    }

    fn join(self, ours: LocalHalf) -> Result<UnusedRings, ExchangeError> {
        // Dropped in the other order: the copies last.
        let Self { received, copies } = self;
        let rings = ours.join(received.into_offer()?)?;
        copies.release();
        Ok(rings)
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::{os::fd::AsFd, sync::mpsc::sync_channel};

    use rustix::io::Errno;
    use sinew_shm::{BellKind, OFFER_BYTES};

    use super::*;
    use sinew_lncl::{
        slow_close::{self, SlowClose},
        testing::WATCHDOG,
    };

    #[test]
    fn receiver_does_not_close_descriptor_passed_as_offer() {
        // Given: a peer that passes a descriptor with a blocking close, and keeps no copy.
        let (ours, theirs) = UnixStream::pair().unwrap();
        ours.set_nonblocking(true).unwrap();
        let mut slow = SlowClose::new();
        let passed = slow.ours.take().expect("it is passed once");
        slow_close::pass(&theirs, &[0; OFFER_BYTES], passed).unwrap();
        // When: it is taken and refused.
        let (report, reported) = sync_channel(1);
        thread::spawn(move || {
            let ours = Arc::new(ours);
            let PeerHalf { received, copies } = PeerHalf::take(&ours).map_err(|why| why.to_string()).unwrap();
            let is_refused = received.into_offer().is_err();
            drop(copies);
            // The test has ended if this comes too late.
            let _ = report.send(is_refused);
        });
        // Then:
        assert_eq!(reported.recv_timeout(WATCHDOG), Ok(true));
        slow.release();
    }

    /// Sends the offer of a ring, with its descriptors.
    fn offer_to(socket: &UnixStream) {
        let (_, offer) = Exchange::prepare(rings::capacity(4_096), BellKind::Futex).expect("a ring");
        offer.send(socket).expect("it comes");
    }

    fn pass(socket: &UnixStream, descriptor: impl AsFd) -> Result<usize, Errno> {
        slow_close::pass(socket, &[1], descriptor)
    }

    // spec: LNCL-18
    #[test]
    fn descriptor_after_offer_is_refused() {
        // Given: two peers with offers; one of them passes an additional descriptor.
        let [(ours, theirs), (stray_ours, stray_theirs)] = [(); 2].map(|()| UnixStream::pair().unwrap());
        for socket in [&theirs, &stray_theirs] {
            offer_to(socket);
        }
        pass(&stray_theirs, &ours).unwrap();
        // Then: a descriptor that is already there ends the meeting, and a later one is refused if the system
        // can do that.
        assert!(matches!(PeerHalf::take(&Arc::new(stray_ours)), Err(ExchangeError::Stray)));
        let is_supported = set_descriptors(&ours, Descriptors::Taken).is_ok();
        let ours = Arc::new(ours);
        PeerHalf::take(&ours).map_err(|why| why.to_string()).unwrap().copies.release();
        assert_eq!(pass(&theirs, &theirs).err(), is_supported.then_some(Errno::PERM));
    }
}
