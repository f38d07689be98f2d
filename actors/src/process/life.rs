//! The child under supervision, as its supervisor's guard sees it: started, listened to, stopped, killed.

mod signs;

use std::{
    io,
    pin::Pin,
    rc::Rc,
    sync::Arc,
    task::{Context, Poll},
    time::Duration,
};

use rustix::net::Shutdown;
use sinew_runtime::{
    outcome::{Rejection, Ticket},
    supervision::{self, Life, ReadyGate, Reason},
    tid::Tid,
    time::Time,
    wire::{Flags, FrameError, Header, Kind, Message},
};
use tokio::{
    net::UnixStream,
    sync::{Notify, watch},
    time::Instant,
};

use self::signs::Watch;
use super::{
    held::Process,
    link::{LastWords, Link},
    names::KnownNames,
    spawn::{self, Started},
    words::{self, Beat, Ending, Look, Names, Turn, WORDS_BYTES_MAX, Welcome},
};
use crate::{
    lncl::{
        self, Reader, payload,
        session::{Order, Session},
    },
    outlet::LinkNumber,
    stores::Stores,
    undelivered::{Entry, is_fault},
};

/// Time that a process has to end once it has said that it does, or was killed.
const ENDING: Duration = Duration::from_secs(1);
/// Time that a killed process has to end while a thread of the node's waits for it that ends itself. It takes a fraction of a
/// millisecond; what takes longer has much memory to give back, or hangs in the kernel.
const DYING: Duration = Duration::from_millis(20);
/// Time until a child that does not read is told again of the names that there was no room for.
const NAMES_AGAIN: Duration = Duration::from_millis(20);
/// Numbers of waits for each process of a TID: more than it can use up.
const WAITS_PER_LIFE: u64 = 1 << 40;

/// An application that is hosted in a process of its own.
pub(super) struct Hosted {
    pub(super) stores: Arc<Stores>,
    pub(super) link: Arc<Link>,
    pub(super) tid: Tid,
    pub(super) name: String,
    pub(super) progress_within: Option<Duration>,
}

/// One process of it, to be guarded.
pub(super) fn process_life(hosted: Arc<Hosted>, ready: ReadyGate) -> Box<dyn Life> {
    let stop = Rc::new(Notify::new());
    Box::new(ProcessLife { run: Box::pin(run(hosted, ready, stop.clone())), stop })
}

struct ProcessLife {
    run: Pin<Box<dyn Future<Output = Reason>>>,
    stop: Rc<Notify>,
}

impl Life for ProcessLife {
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Reason> {
        self.run.as_mut().poll(cx)
    }

    fn stop(&mut self) {
        self.stop.notify_one();
    }

    fn terminate(&mut self) {
        // Dropping it kills the process; no code of the actor's is in this one.
    }
}

async fn run(hosted: Arc<Hosted>, ready: ReadyGate, stop: Rc<Notify>) -> Reason {
    // A stop is not for the process before to end.
    let started = tokio::select! {
        started = start(&hosted) => started,
        () = stop.notified() => return Reason::Shutdown,
    };
    let (group, socket) = match started {
        Ok(started) => started.keep(),
        Err(why) => return Reason::ProcessEnded(format!("it could not be started: {why}")),
    };
    let pid = group.leader();
    let process = match Process::new(group) {
        Ok(process) => process,
        Err(why) => return Reason::ProcessEnded(format!("it could not be watched: {why}")),
    };
    crate::log::debug!(app = hosted.name, pid = pid.as_raw_nonzero(), "a process was started");
    match Child::new(hosted, Rc::new(process), ready, socket) {
        Ok(mut child) => child.accompany(&stop).await,
        Err(why) => Reason::ProcessEnded(format!("it could not be listened to: {why}")),
    }
}

/// Starts the process, as soon as the one before has ended.
async fn start(hosted: &Hosted) -> Result<Started, String> {
    let predecessor = hosted.link.predecessor();
    let ended = predecessor.has_ended(&hosted.name).await;
    ended.map_err(|cause| format!("nobody can say whether its former process has ended: {cause}"))?;
    spawn::start(hosted.variable(), predecessor.clone()).await
}

impl Hosted {
    fn variable(&self) -> String {
        let parent = std::process::id();
        let node = self.stores.node.bits();
        // No name has a line's end in it.
        format!("{parent}\n{node}\n{}\n{}", self.stores.config.name, self.name)
    }
}

/// The other end of the sockets, as long as the process lives.
struct Child {
    hosted: Arc<Hosted>,
    process: Rc<Process>,
    is_buried: bool,
    ready: Option<ReadyGate>,
    stream: Arc<UnixStream>,
    reader: Reader,
    session: Session,
    names: KnownNames,
    /// When it is told again what there was no room for.
    names_again: Option<Instant>,
    /// The last word to it found no room.
    is_deaf: bool,
    /// Changes of the directory since the names in the welcome were looked up.
    changes: watch::Receiver<u64>,
    number: LinkNumber,
    said: Option<Reason>,
    heard: Option<Instant>,
}

impl Drop for Child {
    fn drop(&mut self) {
        if self.is_buried {
            return;
        }
        self.process.kill();
        // Fenced, its supervisor does not wait for its end: it was not ready, or did not stop, in its time. What it still says
        // counts no more. This thread goes on with others; whoever comes next waits.
        let is_dead = !supervision::is_fenced() && self.process.ends_at_once(DYING);
        self.bury(is_dead);
    }
}

/// What ended the listening.
enum Silence {
    /// The process has ended, in words.
    Ended(String),
    /// It has closed its connection.
    Closed,
    /// It is at fault.
    Fault(Reason),
}

impl Child {
    fn new(
        hosted: Arc<Hosted>,
        process: Rc<Process>,
        ready: ReadyGate,
        socket: std::os::unix::net::UnixStream,
    ) -> io::Result<Self> {
        socket.set_nonblocking(true)?;
        let stream = Arc::new(UnixStream::from_std(socket)?);
        let (tid, node) = (hosted.tid, payload::lncl_of(hosted.tid.node));
        // Before the names are looked up: a change in between is told twice and not never.
        let changes = hosted.stores.directory_changes.subscribe();
        let directory = changes.clone();
        let told = *directory.borrow();
        let mut names = KnownNames::default();
        let known = names.changes(&hosted.stores).unwrap_or_default();
        let welcome = Welcome {
            tid: tid.bits(),
            first_wait: hosted.link.begin_life() * WAITS_PER_LIFE,
            sequence: hosted.link.sequence(),
            beat_us: hosted.progress_within.map_or(0, |within| in_micros(within / 4).max(1)),
            names: known,
        };
        let welcome = words::frame(Kind::HOST_WELCOME, node, tid, &welcome);
        let number = hosted.link.connect(stream.clone(), welcome, (directory, told), process.doom());
        let mut session = Session::new();
        session.released(tid);
        let reader = Reader::new(hosted.stores.config.payload_max.max(WORDS_BYTES_MAX));
        let ready = Some(ready);
        Ok(Self {
            hosted,
            process,
            is_buried: false,
            ready,
            stream,
            reader,
            session,
            names,
            names_again: None,
            is_deaf: false,
            changes,
            number,
            said: None,
            heard: None,
        })
    }

    /// Stays with the process until it has ended, and says how.
    async fn accompany(&mut self, stop: &Notify) -> Reason {
        let process = self.process.clone();
        let silence = self.listen(&process, stop).await;
        let mut words = match &silence {
            Silence::Ended(words) => Some(words.clone()),
            Silence::Closed => process.ends_within(ENDING).await,
            Silence::Fault(_) => None,
        };
        if words.is_none() {
            process.kill();
            // The next process finds this one's devices and ports free.
            words = process.ends_within(ENDING).await;
        }
        self.bury(words.is_some());
        let words = words.unwrap_or_else(|| "it was killed and has not ended yet".to_owned());
        match silence {
            Silence::Fault(reason) => reason,
            Silence::Ended(_) | Silence::Closed => self.said.take().unwrap_or(Reason::ProcessEnded(words)),
        }
    }

    async fn listen(&mut self, process: &Process, stop: &Notify) -> Silence {
        let link = self.hosted.link.clone();
        let drain = link.drain(self.number);
        let ended = process.ended();
        tokio::pin!(drain, ended);
        let mut drained = false;
        let mut changes = self.changes.clone();
        let mut watch = Watch::new(self.hosted.progress_within);
        loop {
            tokio::select! {
                frame = self.reader.next(&self.stream) => match frame {
                    Ok(Some(message)) => {
                        if let Err(fault) = self.obey(message) {
                            return Silence::Fault(fault);
                        }
                    }
                    // A reset says that it died with words of ours unread.
                    Ok(None) | Err(FrameError::Io(_)) => return Silence::Closed,
                    Err(cause @ (FrameError::Header(_) | FrameError::TooLong { .. })) => {
                        return Silence::Fault(Reason::ProcessEnded(format!("it was killed: {cause}")));
                    }
                },
                // Its last words are there already.
                _ = &mut drain, if !drained => drained = true,
                words = &mut ended => return Silence::Ended(words),
                () = stop.notified() => {
                    self.say(words::bare(Kind::HOST_STOP, Tid::NONE, self.hosted.tid));
                }
                () = link.nudged(self.number), if self.names_again.is_none() => {
                    self.tell_names();
                    self.hand_over_held();
                }
                () = changed(&mut changes) => {
                    self.tell_names();
                    self.hand_over_held();
                }
                () = due(self.names_again) => {
                    self.tell_names();
                    self.hand_over_held();
                }
                now = watch.tick() => {
                    if let Some(reason) = watch.judge(now, &mut self.heard) {
                        return Silence::Fault(reason);
                    }
                }
            }
        }
    }

    /// What it said before it ended counts.
    fn bury(&mut self, is_dead: bool) {
        self.is_buried = true;
        // Fenced, it is known as dead already: late words of it would come behind its will, or between its successor's.
        let last_words = if is_dead && !supervision::is_fenced() && self.hear_the_rest() {
            LastWords::Heard
        } else {
            LastWords::Unheard
        };
        self.hosted.link.disconnect(self.number, last_words);
    }

    /// Returns whether all of it could be read.
    fn hear_the_rest(&mut self) -> bool {
        // What it has started may hold the socket and write on: nothing more comes of it, so that this ends. It fails where nobody holds it.
        let _ = rustix::net::shutdown(&self.stream, Shutdown::Read);
        loop {
            match self.reader.next_of_the_dead(&self.stream) {
                Ok(None) => return true,
                Ok(Some(message)) => {
                    if self.obey(message).is_err() {
                        return false;
                    }
                }
                Err(_) => return false,
            }
        }
    }

    fn obey(&mut self, message: Message) -> Result<(), Reason> {
        self.heard = Some(Instant::now());
        let fault = |what: &dyn std::fmt::Display| Reason::ProcessEnded(format!("it was killed: {what}"));
        match message.header.kind {
            Kind::HOST_BEAT => {
                let Beat { stalled_since } =
                    payload::read(&message.payload).map_err(|error| fault(&error))?;
                self.hosted.link.set_stalled(self.number, stalled_since);
            }
            Kind::HOST_TURN => {
                let turn = Turn::read(&message).ok_or_else(|| fault(&"it sent a turn that is none"))?;
                self.hosted.link.turn(self.number, turn).map_err(|error| fault(&error))?;
            }
            Kind::HOST_READY => {
                if let Some(ready) = self.ready.take() {
                    ready.reached();
                }
            }
            Kind::HOST_ENDED => {
                let ending: Ending = payload::read(&message.payload).map_err(|error| fault(&error))?;
                self.said = Some(ending.into());
            }
            Kind::HOST_HUNG => {
                let ending: Ending = payload::read(&message.payload).map_err(|error| fault(&error))?;
                return Err(ending.into());
            }
            Kind::HOST_LOOK => {
                let Look { name } = payload::read(&message.payload).map_err(|error| fault(&error))?;
                let before = self.names.clone();
                let names = self.names.look(&self.hosted.stores, name.clone());
                if !self.tell(&names, before) {
                    self.names.owe(name);
                    self.names_again = Some(Instant::now() + NAMES_AGAIN);
                }
            }
            // Not an enum of ours: an open set of numbers.
            _ => return self.obey_like_a_client(message).map_err(|what| fault(&what)),
        }
        Ok(())
    }

    /// What an application of any other process may say, too.
    fn obey_like_a_client(&mut self, message: Message) -> Result<(), String> {
        let Hosted { stores, tid, .. } = &*self.hosted;
        match self.session.handle(message) {
            Order::Route(message) if self.hosted.link.note(&message.header) => self.route(message),
            Order::Route(message) => {
                return Err(format!("its message number {} is out of reach", message.header.sequence));
            }
            Order::SetMember { group, member, .. } => lncl::set_member(stores, tid.app, group, member),
            Order::RefuseMessage { message, why } => {
                let detail =
                    format!("{tid} sent {} to {}: {why}", message.header.kind, message.header.destination);
                stores.refusals.count(Time::now(), "message of a hosted application", &detail);
            }
            Order::Tell { outcome, .. } => {
                stores.refusals.count(
                    Time::now(),
                    "membership of a hosted application",
                    &format!("{tid}: {outcome:?}"),
                );
            }
            Order::End(violation) => return Err(violation.to_string()),
            Order::Register(_)
            | Order::Settle { .. }
            | Order::Resolve { .. }
            | Order::Introduce { .. }
            | Order::Switch { .. }
            | Order::Unregister => {
                return Err("it said what only a client of LNCL says".to_owned());
            }
        }
        Ok(())
    }

    fn route(&self, mut message: Message) {
        let Hosted { stores, tid, link, .. } = &*self.hosted;
        let destination = stores.router.absolute(message.header.destination);
        let is_confirmed = message.header.flags.has(Flags::CONFIRM);
        if is_confirmed {
            let correlation = message.header.correlation;
            message.receipt = Some(link.receipt(Ticket { source: *tid, destination, correlation }));
        }
        let header = Header { source: *tid, destination, ..message.header };
        if let Err(why) = stores.router.send(message)
            && !is_confirmed
            && is_fault(destination, why)
        {
            // The source of a confirmed message knows.
            let (detail, now) = (format!("from {tid} to {destination}: {why}"), Time::now());
            stores.refusals.count(now, "unconfirmed message not taken", &detail);
            stores.undelivered.count(now, Entry::of(&header, why, 1, now));
        }
    }

    /// What waits for the child to know the directory waits on while it cannot be told: to be asked again and again would take its thread's
    /// whole time.
    fn hand_over_held(&self) {
        if self.names_again.is_none() {
            self.hosted.link.hand_over_held();
        }
    }

    /// Tells the child what has changed of the directory. A child that has not read for so long that no more
    /// can wait for it is told a while later.
    fn tell_names(&mut self) {
        let seen = *self.hosted.stores.directory_changes.borrow();
        let before = self.names.clone();
        let is_told = match self.names.changes(&self.hosted.stores) {
            Some(changes) => self.tell(&changes, before),
            None => true,
        };
        self.names_again = (!is_told).then(|| Instant::now() + NAMES_AGAIN);
        if is_told {
            self.hosted.link.directory_is_told(self.number, seen);
        }
    }

    /// Returns whether the child hears it. If not, it knows what it knew `before`.
    fn tell(&mut self, names: &Names, before: KnownNames) -> bool {
        let node = payload::lncl_of(self.hosted.tid.node);
        let is_heard = self.say(words::frame(Kind::HOST_NAMES, node, self.hosted.tid, names));
        if !is_heard {
            self.names = before;
        }
        is_heard
    }

    /// Returns whether the child hears it once it reads, or never will hear anything.
    fn say(&mut self, message: Message) -> bool {
        match self.hosted.link.say_to(self.number, message) {
            // Closed: it is about to end.
            Ok(()) | Err(sinew_runtime::router::Refused { why: Rejection::Closed, .. }) => {
                self.is_deaf = false;
                true
            }
            Err(refused) => {
                // Once each time, however often it is tried again.
                if !std::mem::replace(&mut self.is_deaf, true) {
                    let detail = format!("{} does not read its socket: {}", self.hosted.tid, refused.why);
                    let refusals = &self.hosted.stores.refusals;
                    refusals.count(Time::now(), "hosted application does not listen", &detail);
                }
                false
            }
        }
    }
}

/// Resolves at that time, or never.
async fn due(at: Option<Instant>) {
    match at {
        Some(at) => tokio::time::sleep_until(at).await,
        None => std::future::pending().await,
    }
}

/// Resolves when the directory may have changed.
async fn changed(changes: &mut watch::Receiver<u64>) {
    if changes.changed().await.is_err() {
        // The stores outlive this.
        std::future::pending().await
    }
}

fn in_micros(time: Duration) -> u64 {
    u64::try_from(time.as_micros()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests;
