//! Messages that wait for room in a full queue, each with a deadline.

#[cfg(test)]
mod tests;

use std::{
    borrow::Borrow,
    fmt,
    pin::{Pin, pin},
    task::{Context, Poll, ready},
    time::Duration,
};

use tokio::task::coop::consume_budget;

use super::{
    Confirmation, Content, MessageBuilder, SendError, Sender, Via, awaiting::Deadline, builder::is_many,
};
use crate::{
    clock::Sleep,
    outcome::Rejection,
    pending::{Awaited, Wait},
    router::{RoomWait, SubmitError},
    tid::Tid,
    time::Time,
    wire::{Class, Message},
};

/// The reason why a message was not sent in time: the queue that had no room for it.
///
/// # Examples
///
/// ```
/// use sinew::message::{SendError, StalledError, StalledQueue};
///
/// /// Whether a block is skipped: the recorder is too slow, and the next block comes soon.
/// fn may_skip(error: &SendError) -> bool {
///     matches!(error, SendError::Stalled(StalledError { queue: StalledQueue::Application, .. }))
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StalledError {
    /// The destination of the message.
    pub destination: Tid,
    /// How long it waited: the time of [`room_within`](MessageBuilder::room_within), or its time to live.
    pub waited: Duration,
    /// The queue that had no room.
    pub queue: StalledQueue,
}

/// The first queue on the path of a message, for which its sender waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StalledQueue {
    /// The queue of an application of the same node.
    Application,
    /// The queue to the node of the destination.
    Peer,
    /// The queue of this process to its node.
    OwnNode,
}

impl std::error::Error for StalledError {}

impl fmt::Display for StalledError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { destination, waited, queue } = self;
        match queue {
            StalledQueue::Application => write!(
                f,
                "the queue of {destination} had no room within {waited:?}: it handles messages more slowly than they come; \
                 send less often, or raise `node.mailbox_capacity`"
            ),
            StalledQueue::Peer => write!(
                f,
                "the queue to the node of {destination} had no room within {waited:?}: the application, its node or the link \
                 takes messages more slowly than they come; `sinew why` shows which; send less often, or raise \
                 `gncl.queue_capacity`"
            ),
            StalledQueue::OwnNode => write!(
                f,
                "the queue to this process's node had no room within {waited:?} for a message to {destination}: the node is \
                 stopped or overloaded; send less often"
            ),
        }
    }
}

/// A message that waits for room: made by [`MessageBuilder::room_within`].
#[derive(Debug)]
#[must_use = "a message is sent by `send` or `confirmed`"]
pub struct RoomBuilder<V, C> {
    builder: MessageBuilder<V, C>,
    within: Duration,
}

impl<V, C> MessageBuilder<V, C> {
    /// Waits for room at most this long, if the first queue on the message's path is full. That is the queue of an
    /// application of the same node, or the queue to another node. Call it last, then
    /// [`send`](RoomBuilder::send) or [`confirmed`](RoomBuilder::confirmed). Both return futures: the actor
    /// handles other messages meanwhile. Endpoints of clients have the same call.
    ///
    /// This is the way to send a long series of messages: records, images, logs. A control loop sends the newest
    /// value instead and skips one that finds no room. A loop that tries again after a sleep wakes too often or too
    /// late; this one is woken once, when half of the queue is free.
    ///
    /// The age of the message counts from its first attempt. It waits no longer than its time to live.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{message::{SendError, Sender}, prelude::*};
    ///
    /// payload!("demo.block", Bulk => struct Block { samples: Vec<f32> });
    ///
    /// /// Sends a record as fast as the recorder takes it, in order.
    /// async fn send_record(sender: Sender, to: Tid, record: Vec<Block>) -> Result<(), SendError> {
    ///     for block in &record {
    ///         sender.message(to, block).room_within(Duration::from_secs(1)).send().await?;
    ///     }
    ///     Ok(())
    /// }
    ///
    /// struct Plate { record: Vec<Block> }
    ///
    /// impl Actor for Plate {
    ///     type Context = AppContext<Self>;
    ///     fn started(&mut self, ctx: &mut Self::Context) {
    ///         let Some(recorder) = ctx.resolve("recorder") else { return };
    ///         let sent = send_record(ctx.sender(), recorder, std::mem::take(&mut self.record));
    ///         ctx.spawn(sent.into_actor(self).map(|sent, _, _| if let Err(error) = sent {
    ///             eprintln!("the record has a gap: {error}");
    ///         }));
    ///     }
    /// }
    /// ```
    pub const fn room_within(self, within: Duration) -> RoomBuilder<V, C> {
        RoomBuilder { builder: self, within }
    }
}

impl<V: Via, C: Content> RoomBuilder<V, C> {
    /// Returns the message, and how long it waits.
    fn message(self) -> Result<(V, Message, Duration), SendError> {
        let Self { builder, within } = self;
        let (via, message) = builder.message()?;
        let header = &message.header;
        // A message to many has many queues. A newer value takes the place of one of class Stream, so that no older one
        // waits.
        if is_many(via.sender().absolute(header.destination)) || header.class == Class::Stream {
            return Err(Rejection::Unsupported.into());
        }
        Ok((via, message, within))
    }

    /// Sends by the sender that `own` makes of the builder's.
    pub(crate) fn send_by<S>(self, own: impl FnOnce(V) -> S) -> SendWhenRoom<S> {
        let waiting = self.message().map(|(via, message, within)| Waiting::new(own(via), message, within));
        SendWhenRoom(waiting.map_err(Some))
    }

    /// Same as [`send_by`](Self::send_by), with a confirmation.
    pub(crate) fn confirm_by<S>(
        self,
        outcome_within: Duration,
        own: impl FnOnce(V) -> S,
    ) -> ConfirmWhenRoom<S> {
        let waiting = self.message().and_then(|(via, mut message, within)| {
            let answer = via.sender().expect_answer(&mut message, Awaited::Outcome, outcome_within)?;
            Ok((Waiting::new(own(via), message, within), Some(answer)))
        });
        ConfirmWhenRoom(waiting.map_err(Some))
    }
}

impl<'a, C: Content> RoomBuilder<&'a Sender, C> {
    /// Sends the message when there is room, without a confirmation. Nothing is sent before the returned future is
    /// polled; it ends when a queue or a socket has accepted the message.
    ///
    /// Messages of one task arrive in their order if it awaits each. Of several tasks that wait for one queue, none
    /// has precedence.
    ///
    /// # Errors
    /// [`SendError::Stalled`]: there was no room in time. Other errors end the wait at once. The destination is not one
    /// application, or the message is of class Stream: [`Rejection::Unsupported`].
    ///
    /// # Cancel safety
    /// A dropped future has not sent the message.
    pub fn send(self) -> SendWhenRoom<&'a Sender> {
        self.send_by(|sender| sender)
    }

    /// Sends the message when there is room, and requests a confirmation. The returned future ends with the
    /// [`Confirmation`], which is the outcome as of [`MessageBuilder::confirmed`]. Its time `within` counts from the
    /// first attempt. The message lives no longer, so that `within` limits the wait for room as well.
    ///
    /// # Errors
    /// Those of [`send`](Self::send), and [`SendError::TooManyWaits`].
    ///
    /// # Cancel safety
    /// A dropped future has not sent the message.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{message::{SendError, Sender}, prelude::*};
    ///
    /// payload!("demo.page", Bulk => struct Page { bytes: Vec<u8> });
    ///
    /// async fn write(sender: &Sender, flash: Tid, page: &Page) -> Result<Outcome, SendError> {
    ///     let (room, outcome) = (Duration::from_millis(200), Duration::from_secs(1));
    ///     Ok(sender.message(flash, page).room_within(room).confirmed(outcome).await?.await)
    /// }
    /// ```
    pub fn confirmed(self, within: Duration) -> ConfirmWhenRoom<&'a Sender> {
        self.confirm_by(within, |sender| sender)
    }
}

/// The future of a message without a confirmation that waits for room: [`RoomBuilder::send`]. Any thread may poll it,
/// with any executor. A tokio runtime that polls it must have its time enabled.
#[derive(Debug)]
#[must_use = "the message is sent only while this is polled"]
pub struct SendWhenRoom<S>(Result<Waiting<S>, Option<SendError>>);

impl<S: Borrow<Sender> + Unpin> Future for SendWhenRoom<S> {
    type Output = Result<(), SendError>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        match &mut self.0 {
            Ok(waiting) => waiting.poll(cx).map(|sent| sent.map(drop)),
            Err(error) => poll_error(error),
        }
    }
}

/// The future of a confirmed message that waits for room: [`RoomBuilder::confirmed`]. Any thread may poll it, with any
/// executor. A tokio runtime that polls it must have its time enabled.
#[derive(Debug)]
#[must_use = "the message is sent only while this is polled"]
pub struct ConfirmWhenRoom<S>(Result<(Waiting<S>, OpenOutcome), Option<SendError>>);

/// The wait for an outcome, and its time limit; `None` once it is handed over.
type OpenOutcome = Option<(Wait, Duration)>;

impl<S: Borrow<Sender> + Unpin> Future for ConfirmWhenRoom<S> {
    type Output = Result<Confirmation, SendError>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let (waiting, answer) = match &mut self.0 {
            Ok(waiting) => waiting,
            Err(error) => return poll_error(error),
        };
        let sent = match ready!(waiting.poll(cx)) {
            Ok(sent) => sent,
            Err(error) => return Poll::Ready(Err(error)),
        };
        // Without it the future has ended before.
        let Some((wait, within)) = answer.take() else { return Poll::Pending };
        let sender: &Sender = waiting.sender.borrow();
        let until = sender.clock().sleep_until(sent + within);
        Poll::Ready(Ok(Confirmation::new(Deadline::new(wait, until))))
    }
}

/// Returns the error of a message that could not be made, once.
fn poll_error<T>(error: &mut Option<SendError>) -> Poll<Result<T, SendError>> {
    error.take().map_or(Poll::Pending, |error| Poll::Ready(Err(error)))
}

/// A message that is offered until its queue accepts it.
struct Waiting<S> {
    sender: S,
    /// The message; `None` after the end.
    message: Option<Message>,
    within: Duration,
    /// The deadline, and the place among the messages that wait, from the first full queue on.
    until: Option<(Sleep, RoomWait)>,
}

impl<S> fmt::Debug for Waiting<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let destination = self.message.as_ref().map(|message| message.header.destination);
        write!(f, "Waiting({destination:?}, {:?})", self.within)
    }
}

impl<S> Waiting<S> {
    const fn new(sender: S, message: Message, within: Duration) -> Self {
        Self { sender, message: Some(message), within, until: None }
    }
}

impl<S: Borrow<Sender>> Waiting<S> {
    /// Offers the message. Returns when it was sent: the time of the first attempt.
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Result<Time, SendError>> {
        // A task that always finds room gives way to others of its thread from time to time.
        ready!(pin!(consume_budget()).poll(cx));
        let Some(message) = self.message.take() else { return Poll::Pending };
        let sender: &Sender = self.sender.borrow();
        match sender.offer(message, cx) {
            Ok(sent) => Poll::Ready(Ok(sent)),
            Err(OfferError::Full(message)) => self.poll_deadline(message, cx),
            Err(OfferError::Refused(error)) => Poll::Ready(Err(error)),
        }
    }

    /// Keeps the message until its next offer, or makes the last attempt at the deadline.
    fn poll_deadline(&mut self, message: Message, cx: &mut Context<'_>) -> Poll<Result<Time, SendError>> {
        let sender: &Sender = self.sender.borrow();
        let header = &message.header;
        let waits = match header.time_to_live_us {
            0 => self.within,
            expires_after => self.within.min(Duration::from_micros(expires_after.into())),
        };
        if self.until.is_none() {
            let Some(place) = RoomWait::begin(&sender.shared.router) else {
                message.reject(Rejection::QueueFull);
                return Poll::Ready(Err(SendError::TooManyWaits));
            };
            self.until = Some((sender.clock().sleep_until(header.sent + waits), place));
        }
        if let Some((until, _)) = &mut self.until
            && Pin::new(until).poll(cx).is_pending()
        {
            self.message = Some(message);
            return Poll::Pending;
        }
        self.until = None;
        let (destination, sent) = (sender.absolute(header.destination), header.sent);
        // The last attempt is a send like any other: a refusal is counted by the queue, and seen by the tap.
        Poll::Ready(match sender.shared.router.send(message) {
            Ok(()) => Ok(sent),
            Err(Rejection::QueueFull) => {
                Err(StalledError { destination, waited: waits, queue: sender.queue_of(destination) }.into())
            }
            Err(why) => Err(why.into()),
        })
    }
}

/// The reason why an offer was not accepted.
enum OfferError {
    /// The queue is full; the task is woken when it has room.
    Full(Message),
    Refused(SendError),
}

impl Sender {
    /// Sends a message to one application, or returns it if the queue is full. Returns when it was first offered.
    fn offer(&self, mut message: Message, cx: &Context<'_>) -> Result<Time, OfferError> {
        if let Some((why, error)) = self.why_not_sent(&message) {
            message.reject(why);
            return Err(OfferError::Refused(error));
        }
        message.header.sequence = self.next_sequence();
        if message.header.sent == Time::ZERO {
            message.header.sent = self.now();
        }
        let sent = message.header.sent;
        match self.shared.router.send_or_keep(message, cx.waker()) {
            Ok(()) => Ok(sent),
            Err(SubmitError { message, why: Rejection::QueueFull }) => Err(OfferError::Full(message)),
            Err(refused) => {
                let why = refused.why;
                self.shared.router.refuse(refused);
                Err(OfferError::Refused(why.into()))
            }
        }
    }

    /// Returns the first queue on the path to `destination`.
    fn queue_of(&self, destination: Tid) -> StalledQueue {
        let router = &self.shared.router;
        if router.has_uplink() {
            StalledQueue::OwnNode
        } else if destination.node == router.node() {
            StalledQueue::Application
        } else {
            StalledQueue::Peer
        }
    }
}
