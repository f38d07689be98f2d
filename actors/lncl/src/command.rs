//! Supervised commands: programs that the node starts, each with a name that only its own processes may register.
//!
//! ```text
//!   sender ── mailbox of the TID ── hand-over ── outlet of the client ── program
//! ```
//!
//! The TID, its name and its mailbox stay in the node from its start to its end. A process of the command connects like
//! any client and registers the name. It gets the TID of the command, and the messages that wait. What was not handed
//! over when the process ends waits for the next one.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    task::Waker,
};

use sinew_protocol::payload;
use sinew_runtime::{
    lock,
    mailbox::{Mailbox, RemoteReader},
    outcome::{Outcome, Rejection, Ticket},
    router::{MessageSink, SubmitError},
    tid::Tid,
    wire::{Flags, Kind, Message},
};
use sinew_session::book::ClientId;
use tokio::sync::watch;

/// The queue of a client to which a command hands its messages.
pub(crate) trait HandOver: MessageSink {
    /// Returns whether no message waits in the queue: each that was handed over has been written.
    fn is_free(&self) -> bool;

    /// Returns how far the client has read.
    fn reading(&self) -> Reading;

    /// Has the task of the connection hand over further messages soon.
    fn continue_later(&self);
}

/// Maximum number of messages that one call hands over. Otherwise a sender could have to hand over those of all others,
/// as long as they send.
const HAND_OVER_MAX: usize = 64;

/// How far a client has read its messages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Reading {
    /// A value that changes whenever the client reads. It has no other meaning.
    pub mark: (u64, u64),
    /// Bytes that it has not read; `None` if its connection cannot report them.
    pub unread: Option<u64>,
    /// Whether a message for the program is among the unread bytes, or waits for room.
    pub leaves_some: bool,
}

/// The signs of life of a command's process at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Signs {
    /// How far it has read.
    pub reading: Reading,
    /// The number of frames that it has sent.
    pub frames: u64,
}

/// Whether a process of a command is registered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Presence {
    /// None is.
    Absent,
    /// One is, and receives messages.
    Registered,
    /// One is, and has called `ready`.
    Ready,
}

/// Why a process may not have the name of a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ClaimError {
    /// The process is not in the process group of the command.
    #[error(
        "process {0} is none that the node started for it, or has left its process group; choose another name, or let the node start this program"
    )]
    Stray(i32),
    /// Another connection has it.
    #[error("its program is registered already; choose another name for a second address")]
    Taken,
    /// The registration has requirements.
    #[error(
        "the node started it when its requirements were ready; state them at the command (`requires`), not here"
    )]
    Requires,
    /// The registration asks for an address.
    #[error("its address is that of the command; state it there, not here")]
    Address,
}

/// The place of a command: its mailbox, and the process that may register its name.
pub struct CommandPort {
    name: String,
    mailbox: Arc<Mailbox>,
    awaits_ready: bool,
    state: Mutex<PortState>,
    presence: watch::Sender<Presence>,
    /// Frames of all its processes.
    frames: AtomicU64,
}

#[derive(Default)]
struct PortState {
    /// Number of the present process, from 1.
    process: u64,
    /// The process group of the present process; `None` while none runs.
    group: Option<i32>,
    /// The connection that has the name.
    holder: Option<ClientId>,
    /// Its queue, once messages flow.
    receiver: Option<Receiver>,
    /// Whether a thread hands over messages, and whether it has to look once more.
    is_handing_over: bool,
    is_more_to_hand_over: bool,
}

impl PortState {
    fn is_held_by(&self, id: ClientId) -> bool {
        self.holder == Some(id) && self.group.is_some()
    }
}

#[derive(Clone)]
struct Receiver {
    queue: Arc<dyn HandOver>,
    reader: Arc<RemoteReader>,
}

impl CommandPort {
    /// Creates the place of the command called `name`, with the mailbox of its TID. No process may have it yet.
    /// `awaits_ready`: its program has to call `ready`.
    pub fn new(name: impl Into<String>, mailbox: Arc<Mailbox>, awaits_ready: bool) -> Arc<Self> {
        let (state, frames) = (Mutex::default(), AtomicU64::new(0));
        let presence = watch::Sender::new(Presence::Absent);
        Arc::new(Self { name: name.into(), mailbox, awaits_ready, state, presence, frames })
    }

    /// Returns whether its program has to call `ready`.
    pub(crate) const fn awaits_ready(&self) -> bool {
        self.awaits_ready
    }

    /// Returns the name of the command.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns whether a process is registered, now and after each change.
    pub fn presence(&self) -> watch::Receiver<Presence> {
        self.presence.subscribe()
    }

    /// Rejects all messages from now on, with those that wait, or accepts them again.
    pub fn set_refusing(&self, refuses: bool) {
        if refuses { self.mailbox.refuse_while_down() } else { self.mailbox.accept_again() }
    }

    /// Lets the processes of this group register the name, and no others. Returns the number of the process, which
    /// leads the group.
    pub fn begin(&self, group: i32) -> u64 {
        let mut state = lock(&self.state);
        state.process += 1;
        state.group = Some(group);
        self.clear_holder(&mut state);
        state.process
    }

    /// Lets no process register the name, after the end of this one. Has no effect if another one has begun.
    pub fn end(&self, process: u64) {
        let mut state = lock(&self.state);
        if state.process == process {
            state.group = None;
            self.clear_holder(&mut state);
        }
    }

    /// Lets no process register the name, after the end of this one, and hands over nothing more. Resolves when the
    /// node has handled all that the process sent. LNCL may hang, so the caller needs a deadline.
    pub async fn retire(&self, process: u64) {
        let mut presence = self.presence();
        {
            let mut state = lock(&self.state);
            if state.process == process {
                (state.group, state.receiver) = (None, None);
                // Its connection drains what has arrived, and releases the name.
                self.presence.send_modify(|_| ());
            }
        }
        let is_left = || {
            let state = lock(&self.state);
            state.process == process && state.holder.is_some()
        };
        while is_left() && presence.changed().await.is_ok() {}
    }

    fn clear_holder(&self, state: &mut PortState) {
        (state.holder, state.receiver) = (None, None);
        self.presence.send_replace(Presence::Absent);
    }

    /// Gives the name to the connection `id`, of a process in this process group.
    ///
    /// # Errors
    /// The process is none of the command's, or one has the name.
    pub(crate) fn claim(&self, id: ClientId, pid: i32, group: Option<i32>) -> Result<(), ClaimError> {
        let mut state = lock(&self.state);
        if state.group.is_none() || state.group != group {
            return Err(ClaimError::Stray(pid));
        }
        if state.holder.is_some() {
            return Err(ClaimError::Taken);
        }
        state.holder = Some(id);
        Ok(())
    }

    /// Returns whether this connection has the name, and its process has not ended.
    pub(crate) fn is_held_by(&self, id: ClientId) -> bool {
        lock(&self.state).is_held_by(id)
    }

    /// Hands messages to the queue of this connection from now on. Returns whether it has the name.
    pub(crate) fn open(&self, id: ClientId, queue: Arc<dyn HandOver>) -> bool {
        {
            let mut state = lock(&self.state);
            if !state.is_held_by(id) {
                return false;
            }
            state.receiver = Some(Receiver { queue, reader: Arc::new(self.mailbox.attach_remote()) });
            self.presence.send_replace(Presence::Registered);
        }
        self.hand_over();
        true
    }

    /// Records that the program of this connection has called `ready`.
    pub(crate) fn ready(&self, id: ClientId) {
        let state = lock(&self.state);
        if state.is_held_by(id) {
            self.presence.send_replace(Presence::Ready);
        }
    }

    /// Takes the name from this connection, which has ended. Returns whether it had the name.
    pub(crate) fn release(&self, id: ClientId) -> bool {
        let mut state = lock(&self.state);
        let is_holder = state.holder == Some(id);
        if is_holder {
            self.clear_holder(&mut state);
        }
        is_holder
    }

    /// Resolves when this connection does not have the name any more: its process has ended, or was killed.
    pub(crate) async fn lost(&self, id: ClientId) {
        let mut presence = self.presence();
        // Each loss of the name is also a change of the presence.
        while self.is_held_by(id) && presence.changed().await.is_ok() {}
    }

    /// Takes the name from whichever connection has it: that ended with its LNCL.
    pub(crate) fn release_any(&self) {
        self.clear_holder(&mut lock(&self.state));
    }

    /// Counts a frame of the program: a sign of life. An outcome makes room for a further confirmed message.
    pub(crate) fn on_frame(&self) {
        self.frames.fetch_add(1, Ordering::Relaxed);
        self.hand_over();
    }

    /// Returns the signs of life of the registered process, or `None` if none is registered.
    pub fn signs(&self) -> Option<Signs> {
        let receiver = lock(&self.state).receiver.clone()?;
        Some(Signs { reading: receiver.queue.reading(), frames: self.frames.load(Ordering::Relaxed) })
    }

    /// Sends the program a frame without a meaning, an empty report of undelivered messages. A program that lives reads
    /// it. spec: LNCL-22
    pub fn probe(&self, own: Tid) {
        let receiver = lock(&self.state).receiver.clone();
        let report = payload::Undelivered { entries: Vec::new() };
        let probe = payload::frame(Kind::LNCL_UNDELIVERED, payload::lncl_of(own.node), own, &report);
        if let Some(receiver) = receiver {
            // A queue without room is a better sign than the probe: the program does not read.
            let _ = receiver.queue.submit(probe);
        }
    }

    /// Hands over as many messages as the program's connection takes. It stops where that has no room, and continues
    /// when the connection has written all. After [`HAND_OVER_MAX`] messages the task of the connection continues.
    pub(crate) fn hand_over(&self) {
        {
            let mut state = lock(&self.state);
            // One thread at a time, so that the order stays. It does not hold the lock meanwhile: a thread that is told
            // of an outcome may send to this very TID.
            state.is_more_to_hand_over = state.is_handing_over;
            if std::mem::replace(&mut state.is_handing_over, true) {
                return;
            }
        }
        let mut left = HAND_OVER_MAX;
        loop {
            let receiver = lock(&self.state).receiver.clone();
            if let Some(receiver) = receiver {
                receiver.take_up_to(&mut left);
            }
            // A call without room for a message counts, too.
            left = left.saturating_sub(1);
            let mut state = lock(&self.state);
            let is_more = std::mem::take(&mut state.is_more_to_hand_over);
            if left == 0 || !is_more {
                state.is_handing_over = false;
                // That of the present process, which may be another one by now.
                let receiver = state.receiver.clone().filter(|_| left == 0);
                drop(state);
                return receiver.into_iter().for_each(|receiver| receiver.queue.continue_later());
            }
        }
    }

    /// Sends replies and frames of the layers to the program at once, and puts all other messages into the mailbox.
    fn deliver(
        &self,
        message: Message,
        put: impl FnOnce(&Mailbox, Message) -> Result<(), SubmitError>,
    ) -> Result<(), SubmitError> {
        let is_reply = message.header.flags.has(Flags::REPLY);
        if !is_reply && message.header.kind.is_user() {
            put(&self.mailbox, message)?;
            self.hand_over();
            return Ok(());
        }
        let receiver = lock(&self.state).receiver.clone();
        match receiver {
            Some(receiver) => receiver.queue.submit(message),
            // Its receiver no longer waits for it.
            None if is_reply => Ok(()),
            None => Err(SubmitError::new(message, Rejection::Closed)),
        }
    }
}

impl Receiver {
    fn take_up_to(&self, left: &mut usize) {
        while *left > 0
            && self.queue.is_free()
            && let Some(message) = self.reader.take()
        {
            *left -= 1;
            let class = message.header.class;
            let Err(SubmitError { mut message, why }) = self.queue.submit(message) else {
                // From here on the connection knows where the message is.
                self.reader.settle(class, Outcome::Delivered);
                continue;
            };
            if matches!(why, Rejection::QueueFull | Rejection::Closed) {
                return self.reader.give_back(vec![message]);
            }
            self.reader.settle(class, Outcome::Rejected(why));
            message.settle(Outcome::Rejected(why));
        }
    }
}

impl MessageSink for CommandPort {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        self.deliver(message, |mailbox, message| mailbox.submit(message))
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        self.deliver(message, |mailbox, message| mailbox.offer(message, room))
    }

    fn cancel(&self, ticket: Ticket) -> bool {
        let receiver = lock(&self.state).receiver.clone();
        self.mailbox.cancel(ticket) || receiver.is_some_and(|receiver| receiver.queue.cancel(ticket))
    }
}

/// The commands of a node, by their names.
#[derive(Default)]
pub struct Commands(Mutex<BTreeMap<String, Arc<CommandPort>>>);

impl Commands {
    pub(crate) fn add(&self, port: Arc<CommandPort>) {
        lock(&self.0).insert(port.name.clone(), port);
    }

    pub(crate) fn remove(&self, name: &str) {
        lock(&self.0).remove(name);
    }

    /// Returns the command with this name.
    pub(crate) fn named(&self, name: &str) -> Option<Arc<CommandPort>> {
        lock(&self.0).get(name).cloned()
    }

    /// Takes all names from the connections that had them: they ended with their LNCL.
    pub(crate) fn release_all(&self) {
        self.all().iter().for_each(|port| port.release_any());
    }

    /// Hands over messages where others have expired, so that there is room again.
    pub(crate) fn hand_over(&self) {
        self.all().iter().for_each(|port| port.hand_over());
    }

    fn all(&self) -> Vec<Arc<CommandPort>> {
        lock(&self.0).values().cloned().collect()
    }
}

#[cfg(test)]
mod tests;
