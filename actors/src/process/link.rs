//! Carries messages to the child from any thread; outlives the child as the mailbox does.
//!
//! The sender's own thread writes to the child's socket when the child has room and nothing waits. What it does not take
//! stays in the mailbox, where classes and newest values keep their meaning.

use std::{
    sync::{
        Arc, Mutex, OnceLock,
        atomic::{AtomicU64, Ordering},
    },
    task::Waker,
};

use sinew_runtime::{
    app::DynApp,
    mailbox::{Lender, Mailbox},
    outcome::{MemberReport, Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::{Outlet, Refused},
    sender::Sender,
    supervision::Launch,
    time::Time,
    wire::{Flags, Header, Kind, Message},
};
use tokio::{
    net::UnixStream,
    sync::{Notify, watch},
};

use super::{
    held::Doom,
    life::{Hosted, process_life},
    predecessor::Predecessor,
    window::{Left, NoSuchMessage, Room, Window},
    words::{Fate, Turn},
};
use crate::{
    outlet::{LinkNumber, OutletLimits, StreamOutlet},
    stores::{Stores, lock},
};

/// Outcomes, replies and orders that wait for the child's socket at most. When full: a reply is refused, an outcome is
/// not told, and its sender's deadline says `Unknown`.
const EXPRESS_MAX: usize = 2_048;

/// The node's end of an application that is in a process of its own.
pub(crate) struct Link {
    mailbox: Arc<Mailbox>,
    payload_max: usize,
    outlet: StreamOutlet<Arc<UnixStream>>,
    present: Mutex<Option<Present>>,
    /// Which process of this TID is the present one.
    lives: AtomicU64,
    predecessor: Arc<Predecessor>,
    /// Sequence of the last message that came from the TID before that one.
    began: AtomicU64,
    /// Since when the present process's application is in one turn that lasts too long, in nanoseconds; 0: it is in none.
    stalled: AtomicU64,
    /// The node's own sending side of the TID.
    sender: OnceLock<Sender>,
}

/// Whether the node knows all that a process has said.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LastWords {
    /// It is dead, and what it had written is read.
    Heard,
    /// It may not be dead yet, or has written what nobody can read.
    Unheard,
}

/// The child that lives now.
struct Present {
    number: LinkNumber,
    lender: Lender,
    window: Window,
    /// Counts the changes of the directory.
    directory: watch::Receiver<u64>,
    /// So many of them the child has been told of, ahead of all that is handed over from then on.
    told: u64,
    held: Option<Held>,
    /// A message waits until the child knows which names have changed. Of this child alone: who waits for a former one may not be polled
    /// any more, and would be told first.
    nudge: Arc<Notify>,
    doom: Doom,
}

/// A message that came behind changes that the child has not been told of: its sender may know of them, so the child must. It waits for one
/// telling at most, however often names go on changing, and what is behind it in the mailbox waits with it.
struct Held {
    message: Message,
    /// So many changes there were when it came.
    changes: u64,
}

impl Present {
    /// Whether the child has been told of every change that a sender may know of by now.
    fn knows_directory(&self) -> bool {
        *self.directory.borrow() == self.told
    }

    /// Keeps a message until the child has been told of all that has changed by now.
    fn hold(&mut self, message: Message) {
        let changes = *self.directory.borrow();
        self.held = Some(Held { message, changes });
    }
}

impl Link {
    /// A link for the application whose messages wait in `mailbox`.
    pub(crate) fn new(stores: &Stores, mailbox: Arc<Mailbox>) -> Arc<Self> {
        let config = &stores.config;
        let limits = OutletLimits {
            queue_capacity: config.mailbox_capacity,
            queue_bytes: config.mailbox_bytes,
            unconfirmed_max: config.mailbox_capacity,
            payload_max: config.payload_max,
        };
        Arc::new(Self {
            mailbox,
            payload_max: config.payload_max,
            outlet: StreamOutlet::new(limits),
            present: Mutex::new(None),
            lives: AtomicU64::new(0),
            predecessor: Arc::default(),
            began: AtomicU64::new(0),
            stalled: AtomicU64::new(0),
            sender: OnceLock::new(),
        })
    }

    /// How the application's process is started, each time anew. `sender` is the node's own sending side of its TID.
    pub(crate) fn launch(self: &Arc<Self>, stores: &Arc<Stores>, sender: Sender, app: &DynApp) -> Launch {
        let hosted = Arc::new(Hosted {
            stores: stores.clone(),
            link: self.clone(),
            tid: self.sender.get_or_init(|| sender).tid(),
            name: app.name().to_owned(),
            progress_within: app.policy().progress_within,
        });
        Arc::new(move |ready| process_life(hosted.clone(), ready))
    }

    /// Which process of this TID the next one is, from 1.
    pub(super) fn begin_life(&self) -> u64 {
        self.began.store(self.sequence(), Ordering::Relaxed);
        self.lives.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// The last process of the TID, for the next one to wait for.
    pub(super) fn predecessor(&self) -> &Arc<Predecessor> {
        &self.predecessor
    }

    /// What this child says of its application's turn. What a former one says counts for nothing.
    pub(super) fn set_stalled(&self, number: LinkNumber, since: u64) {
        if lock(&self.present).as_ref().is_some_and(|present| present.number == number) {
            self.stalled.store(since, Ordering::Relaxed);
        }
    }

    /// Since when the application is in one turn that lasts too long, as its process has said last.
    pub(crate) fn stalled_since(&self) -> Option<Time> {
        let since = self.stalled.load(Ordering::Relaxed);
        (since != 0).then(|| Time::from_nanos(since))
    }

    /// Sequence of the last message that came from the TID.
    pub(super) fn sequence(&self) -> u64 {
        self.sender.get().map_or(0, Sender::last_sequence)
    }

    /// Messages go to the process behind `socket` from now on, `welcome` first, which tells of the `told` first changes of the
    /// `directory`.
    pub(super) fn connect(
        &self,
        socket: Arc<UnixStream>,
        welcome: Message,
        (directory, told): (watch::Receiver<u64>, u64),
        doom: Doom,
    ) -> LinkNumber {
        // A former process whose supervisor did not wait for its end.
        let former = lock(&self.present).take();
        // Without the lock, because whoever is told may send to this very TID.
        self.end(former, LastWords::Unheard);
        let number = self.outlet.connect(socket, self.payload_max, Some(welcome));
        let (lender, window, nudge) = (self.mailbox.lend(), Window::default(), Arc::default());
        *lock(&self.present) =
            Some(Present { number, lender, window, directory, told, held: None, nudge, doom });
        self.pump();
        number
    }

    /// The process is gone. What was in its hand has failed; what it did not touch waits for the next one.
    pub(super) fn disconnect(&self, number: LinkNumber, last_words: LastWords) {
        let gone = lock(&self.present).take_if(|present| present.number == number);
        self.end(gone, last_words);
    }

    fn end(&self, gone: Option<Present>, last_words: LastWords) {
        let Some(Present { number, lender, mut window, held, .. }) = gone else { return };
        self.stalled.store(0, Ordering::Relaxed);
        self.outlet.disconnect(number);
        let Left { in_hand, mut untouched } = window.end();
        let touched = match last_words {
            LastWords::Heard => in_hand.into_iter().collect(),
            // Nobody can say which of them it has handled; none is handled twice.
            LastWords::Unheard => {
                in_hand.into_iter().chain(std::mem::take(&mut untouched)).collect::<Vec<_>>()
            }
        };
        untouched.extend(held.map(|held| held.message));
        lender.give_back(untouched);
        for mut message in touched {
            lender.settle(message.header.class, Outcome::Failed);
            message.settle(Outcome::Failed);
        }
    }

    /// Writes what waits whenever the socket takes it; resolves when it takes nothing any more.
    pub(super) async fn drain(&self, number: LinkNumber) -> std::io::Error {
        let drain = self.outlet.drain(number);
        tokio::pin!(drain);
        std::future::poll_fn(|cx| {
            let drained = drain.as_mut().poll(cx);
            // There may be room now for what is held, and for what waits in the mailbox.
            self.hand_over_held();
            drained
        })
        .await
    }

    /// Resolves when a message for this child waits for [`hand_over_held`](Self::hand_over_held); never for a former one.
    pub(super) async fn nudged(&self, number: LinkNumber) {
        let is_it = |present: &&Present| present.number == number;
        let nudge = lock(&self.present).as_ref().filter(is_it).map(|present| present.nudge.clone());
        match nudge {
            Some(nudge) => nudge.notified().await,
            None => std::future::pending().await,
        }
    }

    /// The child has been told of so many changes, counted before it was looked what has changed. Said when the words are on their
    /// way and not before: what another thread sends meanwhile would overtake them.
    /// What a former child was told counts for nothing.
    pub(super) fn directory_is_told(&self, number: LinkNumber, changes: u64) {
        if let Some(present) = lock(&self.present).as_mut().filter(|present| present.number == number) {
            present.told = changes;
        }
    }

    /// The message that waits may go, if the child knows all that had changed when it came. It may have come, behind a further
    /// change, while the child was told of the one before: then it waits for the next time.
    pub(super) fn hand_over_held(&self) {
        // Of one that is killed it is given back when its link ends; to be told again and again that it waits would take its thread's whole time.
        if let Some(present) = lock(&self.present).as_mut().filter(|present| !present.doom.has_come())
            && let Some(held) = present.held.take()
        {
            if held.changes <= present.told {
                self.hand_over(present, held.message);
            } else {
                present.held = Some(held);
                present.nudge.notify_one();
            }
        }
        self.pump();
    }

    /// The child has made a step. One of a former child, whose messages have ended with it, counts for nothing.
    pub(super) fn turn(&self, number: LinkNumber, turn: Turn) -> Result<(), NoSuchMessage> {
        let ended = match lock(&self.present).as_mut().filter(|present| present.number == number) {
            Some(present) => {
                let ended = present.window.turn(turn)?;
                if let Some((message, fate)) = &ended {
                    match fate {
                        Fate::Ended(outcome) => present.lender.settle(message.header.class, *outcome),
                        Fate::Superseded => present.lender.supersede(message.header.class),
                    }
                }
                ended
            }
            None => None,
        };
        // Told without the lock, because whoever is told may send to this very TID.
        if let Some((mut message, Fate::Ended(outcome))) = ended {
            self.report(&message, outcome);
            message.settle(outcome);
        }
        self.pump();
        Ok(())
    }

    /// The child refused a message: its sender is told, if it did not ask.
    fn report(&self, message: &Message, outcome: Outcome) {
        if let (Outcome::Rejected(why), Some(sender)) = (outcome, self.sender.get()) {
            sender.refused(&message.header, why);
        }
    }

    /// Says something to this child, and to none after it, ahead of all messages: its supervisor's thread may have hung, and come back when
    /// another one has started the next.
    ///
    /// # Errors
    /// The message: the child is gone, or does not read.
    pub(super) fn say_to(&self, number: LinkNumber, message: Message) -> Result<(), Refused> {
        self.outlet.submit_urgent_on(number, message, EXPRESS_MAX)
    }

    /// Says something to whichever child there is ahead of all messages.
    fn say(&self, message: Message) -> Result<(), Refused> {
        self.outlet.submit_urgent(message, EXPRESS_MAX)
    }

    /// What a message from the child carries so that the child learns what becomes of it.
    pub(super) fn receipt(self: &Arc<Self>, ticket: Ticket) -> Receipt {
        Receipt::new(Arc::new(OutcomeSink(self.clone())), ticket)
    }

    /// Notes that the TID has sent this message. Returns whether its number can be true.
    pub(super) fn note(&self, header: &Header) -> bool {
        let began = self.began.load(Ordering::Relaxed);
        self.sender.get().is_none_or(|sender| sender.count_on_from(header.sequence, began))
    }

    /// Hands over what the child has room for.
    fn pump(&self) {
        let mut present = lock(&self.present);
        let Some(present) = &mut *present else { return };
        while !present.doom.has_come() && present.held.is_none() && self.outlet.urgent_left() == 0 {
            let next = match present.window.room() {
                Room::Any => present.lender.take(),
                Room::Events => present.lender.take_event(),
                Room::EventsAboutNobody => present.lender.take_event_about_nobody(),
                Room::Nothing => None,
            };
            let Some(message) = next else { return };
            if present.knows_directory() {
                self.hand_over(present, message);
            } else {
                present.hold(message);
                present.nudge.notify_one();
            }
        }
    }

    /// Hands it to the child, or holds it until there is room: who writes what waits tries again.
    fn hand_over(&self, present: &mut Present, message: Message) {
        let copy = Message::new(message.header, message.payload.clone());
        match self.outlet.submit_urgent(copy, EXPRESS_MAX) {
            Err(Refused { why: Rejection::QueueFull, .. }) => present.hold(message),
            // Or the connection is broken, and the message goes to the next process.
            Ok(()) | Err(_) => present.window.lend(message),
        }
    }
}

impl Outlet for Link {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        self.take(message, |mailbox, message| mailbox.submit(message))
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), Refused> {
        self.take(message, |mailbox, message| mailbox.offer(message, room))
    }

    /// What the child has been lent already it handles.
    fn cancel(&self, ticket: Ticket) -> bool {
        self.mailbox.cancel(ticket)
    }
}

impl Link {
    /// Says to the child at once what it waits for, and has its mailbox take all else.
    fn take(
        &self,
        message: Message,
        put: impl FnOnce(&Mailbox, Message) -> Result<(), Refused>,
    ) -> Result<(), Refused> {
        let Header { flags, kind, .. } = message.header;
        if flags.has(Flags::REPLY) || (flags.has(Flags::OUTCOME) && kind == Kind::OUTCOME) {
            return match self.say(message) {
                // Nobody waits for it any more.
                Err(Refused { why: Rejection::Closed, .. }) => Ok(()),
                said => said,
            };
        }
        if kind.is_host() || matches!(kind, Kind::OUTCOME | Kind::MEMBERS) {
            // The child takes these for the node's own words.
            return Err(Refused::new(message, Rejection::UnknownKind));
        }
        put(&self.mailbox, message)?;
        self.pump();
        Ok(())
    }
}

/// Carries outcomes of the child's messages back to it.
struct OutcomeSink(Arc<Link>);

impl ReceiptSink for OutcomeSink {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        // Not taken: the child is gone, or does not read; its own deadline says `Unknown`. A later process of this TID
        // has other correlations.
        let _ = self.0.say(Message::outcome(ticket, outcome));
    }

    // spec: FRAME-7
    fn members(&self, ticket: Ticket, reports: &[MemberReport]) {
        for frame in Message::members(ticket, reports, self.0.payload_max) {
            // Not taken: as above, of these members.
            let _ = self.0.say(frame);
        }
    }
}

#[cfg(test)]
mod tests;
