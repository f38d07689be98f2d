//! Futures of a sender: the outcome of a confirmed message, or the reply to a request, each with its deadline.

use std::{
    marker::PhantomData,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, ready},
    time::Duration,
};

use super::AskError;
use crate::{
    clock::Sleep,
    outcome::{MemberOutcome, Outcome, Ticket},
    pending::{Settlement, Wait},
    router::Router,
    wire::Payload,
};

/// A request with a pending reply.
pub(super) struct Request {
    pub(super) router: Arc<Router>,
    pub(super) ticket: Ticket,
}

impl std::fmt::Debug for Request {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Request({:?})", self.ticket)
    }
}

/// A wait with its deadline, which counts from the send, on the sender's clock. The timer is created at the
/// first poll, by the runtime of the polling thread. On a thread without a runtime it is created by a shared
/// runtime for timers.
#[derive(Debug)]
pub(super) struct Deadline {
    wait: Wait,
    until: Sleep,
}

impl Deadline {
    pub(super) const fn new(wait: Wait, until: Sleep) -> Self {
        Self { wait, until }
    }

    /// Polls the wait. Returns its result, or `None` at the deadline.
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Option<Settlement>> {
        if let Poll::Ready(settlement) = self.wait.poll_settled(cx) {
            return Poll::Ready(Some(settlement));
        }
        // Without a timer the deadline cannot be detected, so the wait ends now.
        ready!(Pin::new(&mut self.until).poll(cx));
        Poll::Ready(None)
    }
}

/// The future outcome of a confirmed message. Any thread may poll it, with any executor. A tokio runtime that
/// polls it must have its time enabled.
///
/// # Examples
///
/// ```
/// use sinew::{message::{SendError, Sender}, prelude::*};
///
/// payload!("demo.home" => struct Home;);
///
/// /// Whether the knee has handled the command.
/// async fn home(sender: &Sender) -> Result<bool, SendError> {
///     let confirmation = sender.message("knee.drive", &Home).confirmed(Duration::from_secs(1))?;
///     Ok(confirmation.await == Outcome::Delivered)
/// }
/// ```
#[derive(Debug)]
#[must_use = "an outcome that is not read is no better than an unconfirmed send"]
pub struct Confirmation(Deadline);

impl Confirmation {
    pub(super) const fn new(deadline: Deadline) -> Self {
        Self(deadline)
    }
}

impl Future for Confirmation {
    type Output = Outcome;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Outcome> {
        Poll::Ready(match ready!(self.0.poll(cx)) {
            Some(Settlement::Outcome(outcome)) => outcome,
            Some(Settlement::Reply(_)) | None => Outcome::Unknown,
        })
    }
}

/// The future outcomes of a confirmed message to many, one for each member, in the order of their TIDs. Any
/// thread may poll it, with any executor. A tokio runtime that polls it must have its time enabled.
///
/// # Examples
///
/// ```
/// use sinew::{message::{SendError, Sender}, prelude::*};
///
/// payload!("demo.home" => struct Home;);
///
/// /// How many drives have handled the command.
/// async fn home(sender: &Sender) -> Result<usize, SendError> {
///     let drives = Tid::group("drives");
///     let members = sender.message(drives, &Home).confirmed_by_each(Duration::from_secs(1))?.await;
///     Ok(members.iter().filter(|member| member.outcome == Outcome::Delivered).count())
/// }
/// ```
#[derive(Debug)]
#[must_use = "outcomes that are not read are no better than an unconfirmed send"]
pub struct GroupConfirmation(Deadline);

impl GroupConfirmation {
    pub(super) const fn new(deadline: Deadline) -> Self {
        Self(deadline)
    }
}

impl Future for GroupConfirmation {
    type Output = Vec<MemberOutcome>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Vec<MemberOutcome>> {
        let last = match ready!(self.0.poll(cx)) {
            Some(Settlement::Outcome(outcome)) => Some(outcome),
            Some(Settlement::Reply(_)) | None => None,
        };
        Poll::Ready(self.0.wait.members(last))
    }
}

/// The future reply to a request. Any thread may poll it, with any executor. A tokio runtime that polls it
/// must have its time enabled.
///
/// Dropping it before it has ended cancels the request. A request that still waits for its handler is
/// cancelled, on any node. A handler that has begun can [detect](super::Sender::is_wanted) the cancellation.
///
/// # Examples
///
/// ```
/// use sinew::{message::{AskError, Sender}, prelude::*};
///
/// payload!("demo.ask_angle" => struct AskAngle;);
/// payload!("demo.angle" => struct Angle { degrees: f32 });
///
/// async fn knee_degrees(sender: &Sender) -> Result<f32, AskError> {
///     let reply = sender.message("knee", &AskAngle).ask::<Angle>(Duration::from_millis(50))?;
///     Ok(reply.await?.degrees)
/// }
/// ```
#[derive(Debug)]
#[must_use = "a reply that is not read need not be requested"]
pub struct Reply<R> {
    deadline: Deadline,
    within: Duration,
    /// `None` after the future has ended.
    request: Option<Request>,
    reply: PhantomData<fn() -> R>,
}

impl<R> Reply<R> {
    pub(super) const fn new(deadline: Deadline, within: Duration, request: Request) -> Self {
        Self { deadline, within, request: Some(request), reply: PhantomData }
    }

    /// Returns the number of the request: the `correlation` in its header, unique among the requests of its sender.
    #[must_use]
    pub const fn correlation(&self) -> u64 {
        self.deadline.wait.correlation()
    }
}

impl<R: Payload> Future for Reply<R> {
    type Output = Result<R, AskError>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let settled = ready!(self.deadline.poll(cx));
        // At its deadline the queued request expires without a cancellation.
        self.request = None;
        Poll::Ready(match settled {
            Some(Settlement::Reply(message)) => message.decode().map_err(AskError::from),
            Some(Settlement::Outcome(outcome)) => Err(AskError::Ended(outcome)),
            None => Err(AskError::Deadline(self.within)),
        })
    }
}

impl<R> Drop for Reply<R> {
    fn drop(&mut self) {
        let Some(Request { router, ticket }) = self.request.take() else { return };
        if self.deadline.wait.is_open() {
            router.cancel(ticket);
        }
    }
}
