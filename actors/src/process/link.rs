//! Carries messages to the child from any thread; outlives the child as the mailbox does.
//!
//! The sender's own thread writes to the child's socket when the child has room and nothing waits. What it does not take
//! stays in the mailbox, where classes and newest values keep their meaning.

use std::sync::{
    Arc, Mutex, OnceLock,
    atomic::{AtomicU64, Ordering},
};

use bytes::Bytes;
use sinew_runtime::{
    app::DynApp,
    mailbox::{Lender, Mailbox},
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::{Outlet, Refused},
    supervision::Launch,
    tid::{NodeAddress, Tid},
    wire::{Flags, Header, Kind, Message},
};
use tokio::{net::UnixStream, sync::Notify};

use super::{
    life::{Hosted, process_life},
    window::{NoSuchMessage, Window},
    words::{Fate, Turn, WINDOW},
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
    node: NodeAddress,
    mailbox: Arc<Mailbox>,
    payload_max: usize,
    outlet: StreamOutlet<Arc<UnixStream>>,
    present: Mutex<Option<Present>>,
    /// Which process of this TID is the present one.
    lives: AtomicU64,
    /// Sequence of the last message that came from the TID.
    sequence: AtomicU64,
    /// A layer's message waits until the child knows what has changed.
    nudge: Notify,
    tid: OnceLock<Tid>,
}

/// The child that lives now.
struct Present {
    number: LinkNumber,
    lender: Lender,
    window: Window,
    /// A layer's message: names that changed go before it.
    held: Option<Message>,
}

impl Link {
    /// A link for the application whose messages wait in `mailbox`.
    pub(crate) fn new(stores: &Stores, mailbox: Arc<Mailbox>) -> Arc<Self> {
        let config = &stores.config;
        let limits = OutletLimits {
            queue_capacity: config.mailbox_capacity,
            unconfirmed_max: config.mailbox_capacity,
            payload_max: config.payload_max,
        };
        Arc::new(Self {
            node: stores.node,
            mailbox,
            payload_max: config.payload_max,
            outlet: StreamOutlet::new(limits),
            present: Mutex::new(None),
            lives: AtomicU64::new(0),
            sequence: AtomicU64::new(0),
            nudge: Notify::new(),
            tid: OnceLock::new(),
        })
    }

    /// How the application's process is started, each time anew.
    pub(crate) fn launch(self: &Arc<Self>, stores: &Arc<Stores>, tid: Tid, app: &DynApp) -> Launch {
        self.tid.get_or_init(|| tid);
        let hosted = Arc::new(Hosted {
            stores: stores.clone(),
            link: self.clone(),
            tid,
            name: app.name().to_owned(),
            requires: app.requires().to_vec(),
            progress_within: app.policy().progress_within,
        });
        Arc::new(move |ready| process_life(hosted.clone(), ready))
    }

    /// Which process of this TID the next one is, from 1.
    pub(super) fn begin_life(&self) -> u64 {
        self.lives.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// Sequence of the last message that came from the TID.
    pub(super) fn sequence(&self) -> u64 {
        self.sequence.load(Ordering::Relaxed)
    }

    /// Messages go to the process behind `socket` from now on, `welcome` first.
    pub(super) fn connect(&self, socket: Arc<UnixStream>, welcome: Message) -> LinkNumber {
        let number = self.outlet.connect(socket, self.payload_max, Some(welcome));
        let (window, held) = (Window::default(), None);
        *lock(&self.present) = Some(Present { number, lender: self.mailbox.lend(), window, held });
        self.pump();
        number
    }

    /// The process is gone: what was in its hand has failed, what it did not touch waits for the next one.
    pub(super) fn disconnect(&self, number: LinkNumber) {
        let Some(Present { lender, mut window, held, .. }) =
            lock(&self.present).take_if(|present| present.number == number)
        else {
            return;
        };
        self.outlet.disconnect(number);
        let mut left = window.end();
        left.untouched.extend(held);
        lender.give_back(left.untouched);
        if let Some(mut message) = left.in_hand {
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
            // There may be room now for what waits in the mailbox.
            self.pump();
            drained
        })
        .await
    }

    /// Resolves when a layer's message waits for [`hand_over_held`](Self::hand_over_held).
    pub(super) async fn nudged(&self) {
        self.nudge.notified().await;
    }

    /// The child knows all names' changes by now: a layer's message may go.
    pub(super) fn hand_over_held(&self) {
        if let Some(present) = &mut *lock(&self.present)
            && let Some(message) = present.held.take()
        {
            self.hand_over(present, message);
        }
        self.pump();
    }

    /// The child has made a step.
    pub(super) fn turn(&self, turn: Turn) -> Result<(), NoSuchMessage> {
        let ended = match &mut *lock(&self.present) {
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
            message.settle(outcome);
        }
        self.pump();
        Ok(())
    }

    /// Says something to the child ahead of all messages.
    pub(super) fn say(&self, message: Message) -> Result<(), Refused> {
        self.outlet.submit_urgent(message, EXPRESS_MAX)
    }

    /// What a message from the child carries so that the child learns what becomes of it.
    pub(super) fn receipt(self: &Arc<Self>, ticket: Ticket) -> Receipt {
        Receipt::new(Arc::new(OutcomeSink(self.clone())), ticket)
    }

    /// Notes that the TID has sent this message.
    pub(super) fn note(&self, header: &Header) {
        self.sequence.fetch_max(header.sequence, Ordering::Relaxed);
    }

    /// Hands over what the child has room for.
    fn pump(&self) {
        let mut present = lock(&self.present);
        let Some(present) = &mut *present else { return };
        while present.held.is_none() && present.window.len() < WINDOW && self.outlet.urgent_left() == 0 {
            let Some(message) = present.lender.take() else { return };
            let Tid { node, app } = message.header.source;
            if node == self.node && app.is_layer() {
                present.held = Some(message);
                self.nudge.notify_one();
            } else {
                self.hand_over(present, message);
            }
        }
    }

    fn hand_over(&self, present: &mut Present, message: Message) {
        let copy = Message::new(message.header, message.payload.clone());
        present.window.lend(message);
        // Not taken: the connection is broken, and the message goes to the next process.
        let _ = self.outlet.submit_urgent(copy, EXPRESS_MAX);
    }
}

impl Outlet for Link {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        let Header { flags, kind, .. } = message.header;
        if flags.has(Flags::REPLY) || (flags.has(Flags::OUTCOME) && kind == Kind::OUTCOME) {
            return match self.say(message) {
                // Nobody waits for it any more.
                Err(Refused { why: Rejection::Closed, .. }) => Ok(()),
                said => said,
            };
        }
        if kind.is_host() || kind == Kind::OUTCOME {
            // The child takes these for the node's own words.
            return Err(Refused::new(message, Rejection::UnknownKind));
        }
        self.mailbox.submit(message)?;
        self.pump();
        Ok(())
    }
}

/// Carries outcomes of the child's messages back to it.
struct OutcomeSink(Arc<Link>);

impl ReceiptSink for OutcomeSink {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        let mut header = Header::new(Kind::OUTCOME, ticket.destination, ticket.source);
        header.flags = Flags::OUTCOME;
        header.correlation = ticket.correlation;
        // Not taken: the child is gone, or does not read; its own deadline says `Unknown`. A later process of this TID
        // has other correlations.
        let _ = self.0.say(Message::new(header, Bytes::copy_from_slice(&[outcome.code()])));
    }
}
