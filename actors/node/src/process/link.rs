//! Carries messages to the child from any thread. It outlives the child, as the mailbox does.
//!
//! The sender's own thread writes to the child's socket if the child has room and no message waits. Otherwise
//! the message stays in the mailbox, where classes and newest values apply.

use std::{
    sync::{
        Arc, Mutex, OnceLock,
        atomic::{AtomicU64, Ordering},
    },
    task::Waker,
};

use sinew_runtime::{
    app::DynApp,
    lock,
    mailbox::{Mailbox, RemoteReader},
    outcome::{self, MemberReport, Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::{MessageSink, SubmitError},
    sender::Sender,
    supervision::Launch,
    time::Time,
    wire::{Flags, Header, Kind, Message},
};
use sinew_session::outlet::{LinkNumber, OutletLimits, SocketWriter};
use tokio::{
    net::UnixStream,
    sync::{Notify, watch},
};

use super::{
    child_process::KillFlag,
    predecessor::Predecessor,
    protocol::{Disposition, Progress},
    supervision::{Hosted, supervise_process},
    window::{Remaining, Room, UnknownMessageError, Window},
};
use crate::NodeState;

/// Maximum number of outcomes, replies and orders that wait for the child's socket. If the queue is full, a
/// reply is rejected. An outcome is dropped, and its sender's deadline yields `Unknown`.
const CONTROL_QUEUE_MAX: usize = 2_048;

/// The node's end of an application in its own process.
pub(crate) struct Link {
    mailbox: Arc<Mailbox>,
    payload_max: usize,
    outlet: SocketWriter<Arc<UnixStream>>,
    present: Mutex<Option<CurrentChild>>,
    /// Number of the current process of this TID.
    processes: AtomicU64,
    predecessor: Arc<Predecessor>,
    /// Sequence of the last message of the TID before the current process.
    sequence_before: AtomicU64,
    /// Start of the current process's stalled turn, in nanoseconds; 0 if no turn is stalled.
    stalled: AtomicU64,
    /// The node's own sender of the TID.
    sender: OnceLock<Sender>,
}

/// Whether the node has read all data that a process wrote.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FinalRead {
    /// The process is dead, and its data is read.
    Complete,
    /// The process may still live, or has written unreadable data.
    Incomplete,
}

/// The current child.
struct CurrentChild {
    number: LinkNumber,
    reader: RemoteReader,
    window: Window,
    /// Counts the changes of the directory.
    directory: watch::Receiver<u64>,
    /// Number of changes that were sent to the child, ahead of all later messages.
    directory_sent: u64,
    held: Option<HeldMessage>,
    /// Notified when a message waits for the child to learn of changed names. Each child has its own: a
    /// waiter for a former child might no longer be polled, and would be notified first.
    names_needed: Arc<Notify>,
    kill_flag: KillFlag,
}

/// A message that arrived after changes of the directory that were not yet sent to the child. Its sender may
/// know of them, so the child must, too. It waits for one update at most, even if names change all the time.
/// The messages behind it in the mailbox wait, too.
struct HeldMessage {
    message: Message,
    /// Number of changes at its arrival.
    changes: u64,
}

impl CurrentChild {
    /// Returns whether the child was sent every change that a sender may know of by now.
    fn has_current_directory(&self) -> bool {
        *self.directory.borrow() == self.directory_sent
    }

    /// Holds a message until the child was sent all changes up to now.
    fn hold(&mut self, message: Message) {
        let changes = *self.directory.borrow();
        self.held = Some(HeldMessage { message, changes });
    }
}

impl Link {
    /// Creates the link of the application with this `mailbox`.
    pub(crate) fn new(state: &NodeState, mailbox: Arc<Mailbox>) -> Arc<Self> {
        let config = &state.ctx.config;
        let limits = OutletLimits {
            queue_capacity: config.mailbox_capacity,
            queue_bytes: config.mailbox_bytes,
            unconfirmed_max: config.mailbox_capacity,
            payload_max: config.payload_max,
        };
        Arc::new(Self {
            mailbox,
            payload_max: config.payload_max,
            outlet: SocketWriter::new(limits),
            present: Mutex::new(None),
            processes: AtomicU64::new(0),
            predecessor: Arc::default(),
            sequence_before: AtomicU64::new(0),
            stalled: AtomicU64::new(0),
            sender: OnceLock::new(),
        })
    }

    /// Returns the launch of the application's process, for each start. `sender` is the node's own sender of
    /// its TID.
    pub(crate) fn launch(self: &Arc<Self>, state: &Arc<NodeState>, sender: Sender, app: &DynApp) -> Launch {
        let hosted = Arc::new(Hosted {
            state: state.clone(),
            link: self.clone(),
            tid: self.sender.get_or_init(|| sender).tid(),
            name: app.name().to_owned(),
            progress_within: app.policy().progress_within,
        });
        Arc::new(move |ready| supervise_process(hosted.clone(), ready))
    }

    /// Starts a new process of this TID. Returns its number, from 1.
    pub(super) fn begin_process(&self) -> u64 {
        self.sequence_before.store(self.sequence(), Ordering::Relaxed);
        self.processes.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// Returns the last process of the TID, for the next one to wait for.
    pub(super) fn predecessor(&self) -> &Arc<Predecessor> {
        &self.predecessor
    }

    /// Stores this child's report on a stalled turn. Reports of a former child are ignored.
    pub(super) fn set_stalled(&self, number: LinkNumber, since: u64) {
        if lock(&self.present).as_ref().is_some_and(|present| present.number == number) {
            self.stalled.store(since, Ordering::Relaxed);
        }
    }

    /// Returns the start of the application's stalled turn, by the latest report of its process.
    pub(crate) fn stalled_since(&self) -> Option<Time> {
        let since = self.stalled.load(Ordering::Relaxed);
        (since != 0).then(|| Time::from_nanos(since))
    }

    /// Returns the sequence of the last message of the TID.
    pub(super) fn sequence(&self) -> u64 {
        self.sender.get().map_or(0, Sender::last_sequence)
    }

    /// Connects the process behind `socket`: messages go to it from now on, `welcome` first. `welcome`
    /// includes the first `sent` changes of the `directory`.
    pub(super) fn connect(
        &self,
        socket: Arc<UnixStream>,
        welcome: Message,
        (directory, sent): (watch::Receiver<u64>, u64),
        kill_flag: KillFlag,
    ) -> LinkNumber {
        // A former process may remain if its supervisor did not wait for its end.
        let former = lock(&self.present).take();
        // Without the lock, since a receiver of these outcomes may send to this very TID.
        self.end(former, FinalRead::Incomplete);
        let number = self.outlet.connect(socket, self.payload_max, Some(welcome));
        let (reader, window, names_needed) =
            (self.mailbox.attach_remote(), Window::default(), Arc::default());
        *lock(&self.present) = Some(CurrentChild {
            number,
            reader,
            window,
            directory,
            directory_sent: sent,
            held: None,
            names_needed,
            kill_flag,
        });
        self.hand_over_queued();
        number
    }

    /// Disconnects a process that is gone. Its current message has failed; messages that it did not take wait
    /// for the next process.
    pub(super) fn disconnect(&self, number: LinkNumber, final_read: FinalRead) {
        let child = lock(&self.present).take_if(|present| present.number == number);
        self.end(child, final_read);
    }

    fn end(&self, child: Option<CurrentChild>, final_read: FinalRead) {
        let Some(CurrentChild { number, reader, mut window, held, .. }) = child else { return };
        self.stalled.store(0, Ordering::Relaxed);
        self.outlet.disconnect(number);
        let Remaining { current, mut untouched } = window.end();
        let touched = match final_read {
            FinalRead::Complete => current.into_iter().collect(),
            // It is unknown which of them were handled, and none may be handled twice.
            FinalRead::Incomplete => {
                current.into_iter().chain(std::mem::take(&mut untouched)).collect::<Vec<_>>()
            }
        };
        untouched.extend(held.map(|held| held.message));
        reader.give_back(untouched);
        for mut message in touched {
            reader.settle(message.header.class, Outcome::Failed);
            message.settle(Outcome::Failed);
        }
    }

    /// Writes waiting data as the socket takes it. Resolves when the socket is broken.
    pub(super) async fn drain(&self, number: LinkNumber) -> std::io::Error {
        let drain = self.outlet.drain(number);
        tokio::pin!(drain);
        std::future::poll_fn(|cx| {
            let drained = drain.as_mut().poll(cx);
            // There may be room now for the held message, and for the mailbox.
            self.hand_over_held();
            drained
        })
        .await
    }

    /// Resolves when a message for this child waits for [`hand_over_held`](Self::hand_over_held). Never
    /// resolves for a former child.
    pub(super) async fn names_needed(&self, number: LinkNumber) {
        let is_it = |present: &&CurrentChild| present.number == number;
        let names_needed =
            lock(&self.present).as_ref().filter(is_it).map(|present| present.names_needed.clone());
        match names_needed {
            Some(names_needed) => names_needed.notified().await,
            None => std::future::pending().await,
        }
    }

    /// Records that the child was sent this number of changes, which was read before the changes were looked
    /// up. The caller calls it only after it has queued the update: otherwise messages of other threads would
    /// overtake the update. Updates of a former child are ignored.
    pub(super) fn directory_was_sent(&self, number: LinkNumber, changes: u64) {
        if let Some(present) = lock(&self.present).as_mut().filter(|present| present.number == number) {
            present.directory_sent = changes;
        }
    }

    /// Hands over the held message, if the child was sent all changes up to its arrival. It may have arrived
    /// after a further change, during the previous update; then it waits for the next one.
    pub(super) fn hand_over_held(&self) {
        // A killed child's message is given back when its link ends. Repeated notifications of it would use
        // up the thread's time.
        if let Some(present) = lock(&self.present).as_mut().filter(|present| !present.kill_flag.is_set())
            && let Some(held) = present.held.take()
        {
            if held.changes <= present.directory_sent {
                self.hand_over(present, held.message);
            } else {
                present.held = Some(held);
                present.names_needed.notify_one();
            }
        }
        self.hand_over_queued();
    }

    /// Applies the progress of the child. That of a former child is ignored, since its messages have ended
    /// with it.
    pub(super) fn handle_progress(
        &self,
        number: LinkNumber,
        progress: Progress,
    ) -> Result<(), UnknownMessageError> {
        let ended = match lock(&self.present).as_mut().filter(|present| present.number == number) {
            Some(present) => {
                let ended = present.window.apply(progress)?;
                if let Some((message, disposition)) = &ended {
                    match disposition {
                        Disposition::Ended(outcome) => present.reader.settle(message.header.class, *outcome),
                        Disposition::Superseded => present.reader.supersede(message.header.class),
                    }
                }
                ended
            }
            None => None,
        };
        // Settled without the lock, since a receiver of the outcome may send to this very TID.
        if let Some((mut message, Disposition::Ended(outcome))) = ended {
            self.report(&message, outcome);
            message.settle(outcome);
        }
        self.hand_over_queued();
        Ok(())
    }

    /// Reports a message that the child rejected to its sender, if no outcome was requested.
    fn report(&self, message: &Message, outcome: Outcome) {
        if let (Outcome::Rejected(why), Some(sender)) = (outcome, self.sender.get()) {
            sender.refused(&message.header, why);
        }
    }

    /// Sends a frame to this child, ahead of all messages, and to no later one. The thread of its supervisor
    /// may have hung, and continue after another thread has started the next child.
    ///
    /// # Errors
    /// The message, if the child is gone or does not read.
    pub(super) fn send_to(&self, number: LinkNumber, message: Message) -> Result<(), SubmitError> {
        self.outlet.submit_urgent_on(number, message, CONTROL_QUEUE_MAX)
    }

    /// Sends a frame to the current child, ahead of all messages.
    fn send(&self, message: Message) -> Result<(), SubmitError> {
        self.outlet.submit_urgent(message, CONTROL_QUEUE_MAX)
    }

    /// Returns the receipt of a message from the child; it sends the outcome to the child.
    pub(super) fn receipt(self: &Arc<Self>, ticket: Ticket) -> Receipt {
        Receipt::new(Arc::new(OutcomeSink(self.clone())), ticket)
    }

    /// Records that the TID has sent this message. Returns whether its sequence is plausible.
    pub(super) fn record_sent(&self, header: &Header) -> bool {
        let before = self.sequence_before.load(Ordering::Relaxed);
        self.sender.get().is_none_or(|sender| sender.count_on_from(header.sequence, before))
    }

    /// Hands over as many messages as the child has room for.
    fn hand_over_queued(&self) {
        let mut present = lock(&self.present);
        let Some(present) = &mut *present else { return };
        while !present.kill_flag.is_set() && present.held.is_none() && self.outlet.urgent_left() == 0 {
            let next = match present.window.room() {
                Room::Any => present.reader.take(),
                Room::Events => present.reader.take_event(),
                Room::EventsWithoutNode => present.reader.take_event_without_node(),
                Room::Nothing => None,
            };
            let Some(message) = next else { return };
            if present.has_current_directory() {
                self.hand_over(present, message);
            } else {
                present.hold(message);
                present.names_needed.notify_one();
            }
        }
    }

    /// Hands over a message to the child, or holds it until there is room. The writer of waiting data tries
    /// again.
    fn hand_over(&self, present: &mut CurrentChild, message: Message) {
        let copy = Message::new(message.header, message.payload.clone());
        match self.outlet.submit_urgent(copy, CONTROL_QUEUE_MAX) {
            Err(SubmitError { why: Rejection::QueueFull, .. }) => present.hold(message),
            // If the connection is broken, the message goes to the next process.
            Ok(()) | Err(_) => present.window.push(message),
        }
    }
}

impl MessageSink for Link {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        self.deliver(message, |mailbox, message| mailbox.submit(message))
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        self.deliver(message, |mailbox, message| mailbox.offer(message, room))
    }

    /// A message that was already handed over to the child is not cancelled.
    fn cancel(&self, ticket: Ticket) -> bool {
        self.mailbox.cancel(ticket)
    }
}

impl Link {
    /// Sends replies and outcomes to the child at once, and puts all other messages into the mailbox.
    fn deliver(
        &self,
        message: Message,
        put: impl FnOnce(&Mailbox, Message) -> Result<(), SubmitError>,
    ) -> Result<(), SubmitError> {
        let Header { flags, kind, .. } = message.header;
        if flags.has(Flags::REPLY) || (flags.has(Flags::OUTCOME) && kind == Kind::OUTCOME) {
            return match self.send(message) {
                // Its receiver no longer waits for it.
                Err(SubmitError { why: Rejection::Closed, .. }) => Ok(()),
                result => result,
            };
        }
        if kind.is_host() || matches!(kind, Kind::OUTCOME | Kind::MEMBERS) {
            // The child would take these for frames of the node.
            return Err(SubmitError::new(message, Rejection::UnknownKind));
        }
        put(&self.mailbox, message)?;
        self.hand_over_queued();
        Ok(())
    }
}

/// Sends the outcomes of the child's messages back to it.
struct OutcomeSink(Arc<Link>);

impl ReceiptSink for OutcomeSink {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        outcome::show(ticket, outcome);
        // An error means that the child is gone, or does not read; then its own deadline yields `Unknown`. A
        // later process of this TID uses other correlations.
        let _ = self.0.send(Message::outcome(ticket, outcome));
    }

    // spec: FRAME-7
    fn members(&self, ticket: Ticket, reports: &[MemberReport]) {
        outcome::show_members(ticket, reports);
        for frame in Message::members(ticket, reports, self.0.payload_max) {
            // An error has the same consequence, for these members.
            let _ = self.0.send(frame);
        }
    }
}

#[cfg(test)]
mod tests;
