//! Run-time barriers: several applications, on any nodes, continue together.

use std::{
    collections::VecDeque,
    future::Future,
    pin::{Pin, pin},
    task::{Context, Poll},
    time::Duration,
};

use actix::Actor;
use sinew_model::barrier::{ArriveAtBarrier, BarrierAnswer, BarrierKind, LeaveBarrier, OnPartyLoss};
use sinew_runtime::{
    app::AppContext,
    sender::{AskError, Reply, SendError, Sender},
    tid::{AppAddress, Tid},
    time::Time,
    wire::Message,
};

use super::{ApiError, AsyncEndpoint, Endpoint, wait_mode::block_ready};

/// Time after the barrier's own deadline for its answer to arrive: the node reports the missing parties.
const ANSWER_GRACE: Duration = Duration::from_secs(2);
/// Default wait at a barrier.
const WITHIN: Duration = Duration::from_secs(60);

/// A point at which several applications, on any nodes, wait for each other.
///
/// A barrier has no owner and need not be created: it exists from the first arrival. When all parties wait,
/// it opens for all of them and can be used again: the next round is its next generation.
/// `docs/book/src/explanation/barriers.md` states the guarantees if a node is lost meanwhile.
///
/// # Examples
///
/// ```no_run
/// use sinew::{NodeApi, Registration, prelude::*, barrier::Barrier};
///
/// let node = NodeApi::connect("/run/sinew/hip.sock")?;
/// let mut calibration = node.register_transport_address(Registration::new().name("hip.calibration"))?;
/// let calibrated = Barrier::new("calibrated", ["hip.calibration", "knee.calibration", "2 of *.imu"]);
/// let generation = calibration.meet(&calibrated)?;
/// println!("all are calibrated, for the {generation}. time");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Barrier {
    name: String,
    parties: Vec<String>,
    within: Duration,
    on_loss: OnPartyLoss,
    kind: BarrierKind,
}

impl Barrier {
    /// Returns the barrier of this name, 1 to 63 bytes, at which these parties meet. The parties are given as
    /// in `requires`: names, patterns, any of several, counts; the waiting applications must meet all of
    /// them. Each arriving application must be one of the parties and must name the same ones: with other
    /// parties it is another barrier.
    #[must_use]
    pub fn new<N: Into<String>>(name: impl Into<String>, parties: impl IntoIterator<Item = N>) -> Self {
        let parties = parties.into_iter().map(Into::into).collect();
        let (within, on_loss, kind) = (WITHIN, OnPartyLoss::default(), BarrierKind::default());
        Self { name: name.into(), parties, within, on_loss, kind }
    }

    /// Returns the phase of this name, one word, that these parties enter together: `meet` announces that a
    /// party has reached the phase, and waits until all parties have. A party counts as arrived until its
    /// incarnation ends. So a restarted party continues at once if the others have arrived, and no other
    /// party is set back. An application that is no party can require the phase: `2 of *.drive at homed`.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// # use sinew::{barrier::{Barrier, Meet}, message::Sender};
    /// # async fn come_up(sender: Sender) -> Result<(), Box<dyn std::error::Error>> {
    /// # fn home() {}
    /// home();
    /// sender.meet(&Barrier::phase("homed", ["hip.drive", "knee.drive", "ankle.drive"])).await?;
    /// // All drives are homed: this one may arm its output.
    /// # Ok(())
    /// # }
    /// ```
    #[must_use]
    pub fn phase<N: Into<String>>(name: impl Into<String>, parties: impl IntoIterator<Item = N>) -> Self {
        Self { kind: BarrierKind::Phase, ..Self::new(name, parties) }
    }

    /// Returns the barrier at which any `count` applications meet. It opens when this many have arrived, for
    /// all that wait at that moment. With more applications than `count`, later ones meet in the next
    /// generation.
    #[must_use]
    pub fn of(count: usize, name: impl Into<String>) -> Self {
        Self::new(name, [format!("{count} of *")])
    }

    /// Sets how long an application waits; whole milliseconds. Default: 60 s.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{barrier::{Barrier, OnPartyLoss}, prelude::*};
    ///
    /// let calibrated = Barrier::new("calibrated", ["hip", "knee"])
    ///     .within(Duration::from_secs(5))
    ///     .on_loss(OnPartyLoss::Fail);
    /// ```
    #[must_use]
    pub const fn within(mut self, within: Duration) -> Self {
        self.within = within;
        self
    }

    /// Sets whether to continue the wait when a named party is lost. Default: yes, it may be restarted.
    #[must_use]
    pub const fn on_loss(mut self, on_loss: OnPartyLoss) -> Self {
        self.on_loss = on_loss;
        self
    }

    /// Returns the name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    fn request(&self) -> ArriveAtBarrier {
        ArriveAtBarrier {
            barrier: self.name.clone(),
            parties: self.parties.clone(),
            within_ms: u32::try_from(self.within.as_millis()).unwrap_or(u32::MAX),
            on_loss: self.on_loss,
            kind: self.kind,
        }
    }

    /// Returns how long the request itself may take.
    fn stall_timeout(&self) -> Duration {
        self.within.saturating_add(ANSWER_GRACE)
    }

    fn judge(&self, answer: BarrierAnswer) -> Result<u64, BarrierError> {
        let barrier = self.name.clone();
        match answer {
            BarrierAnswer::Opened { generation } => Ok(generation),
            BarrierAnswer::TimedOut { missing } => {
                Err(BarrierError::TimedOut { barrier, waited: self.within, missing })
            }
            BarrierAnswer::Lost { missing } => Err(BarrierError::Lost { barrier, missing }),
            BarrierAnswer::Refused { why } => Err(BarrierError::Refused(why)),
        }
    }
}

/// Why a wait at a barrier has ended without its opening.
///
/// # Examples
///
/// ```
/// use sinew::{Endpoint, barrier::{Barrier, BarrierError}};
///
/// fn calibrate_together(endpoint: &mut Endpoint, barrier: &Barrier) -> Result<bool, BarrierError> {
///     match endpoint.meet(barrier) {
///         Ok(_generation) => Ok(true),
///         Err(BarrierError::TimedOut { missing, .. }) => {
///             missing.iter().for_each(|(name, why)| eprintln!("{name} is missing: {why}"));
///             Ok(false)
///         }
///         Err(other) => Err(other),
///     }
/// }
/// ```
#[derive(Debug, thiserror::Error)]
pub enum BarrierError {
    /// Not all parties arrived in time. The other parties continue to wait.
    #[error("the barrier '{barrier}' did not open in {waited:?}: {}", describe_missing(missing))]
    TimedOut {
        /// The name of the barrier.
        barrier: String,
        /// How long the application waited.
        waited: Duration,
        /// The missing parties, and the last known state of each.
        missing: Vec<(String, String)>,
    },
    /// A party was lost, and the barrier does not wait for lost parties.
    #[error("a party of the barrier '{barrier}' was lost: {}", describe_missing(missing))]
    Lost {
        /// The name of the barrier.
        barrier: String,
        /// The missing parties, and the last known state of each.
        missing: Vec<(String, String)>,
    },
    /// The node does not allow the application to wait there.
    #[error("{0}")]
    Refused(String),
    /// The request was not sent to the node.
    #[error("the node was not asked: {0}")]
    Send(#[from] SendError),
    /// The node has not answered.
    #[error("the node did not report the outcome of the barrier: {0}")]
    Ask(#[from] AskError),
    /// An endpoint did not send the request to the node, or received no answer.
    #[error("the node did not report the outcome of the barrier: {0}")]
    Api(#[from] ApiError),
}

fn describe_missing(missing: &[(String, String)]) -> String {
    let parts: Vec<String> = missing.iter().map(|(name, why)| format!("{name} is missing ({why})")).collect();
    parts.join(", ")
}

/// An application with a [`Sender`] can wait at a barrier.
///
/// # Examples
///
/// ```
/// use sinew::{barrier::{Barrier, Meet}, prelude::*};
///
/// struct Hip { ready: bool }
///
/// impl Actor for Hip {
///     type Context = AppContext<Self>;
///     fn started(&mut self, ctx: &mut Self::Context) {
///         let meeting = ctx.meet(&Barrier::new("calibrated", ["hip", "knee"]));
///         ctx.spawn(meeting.into_actor(self).map(|met, hip, _| hip.ready = met.is_ok()));
///     }
/// }
/// ```
pub trait Meet {
    /// Arrives at the barrier and waits there; the future resolves with the generation that opened. Dropping
    /// it before that leaves the barrier. In an actor: `context.spawn` or `context.wait` it.
    fn meet(&self, barrier: &Barrier) -> Meeting;
}

impl Meet for Sender {
    fn meet(&self, barrier: &Barrier) -> Meeting {
        let to = Tid::new(self.tid().node, AppAddress::SYNC);
        let reply = self.message(to, &barrier.request()).ask(barrier.stall_timeout());
        Meeting { barrier: barrier.clone(), sender: self.clone(), wait: Wait::from(reply) }
    }
}

impl<A: Actor<Context = Self>> Meet for AppContext<A> {
    fn meet(&self, barrier: &Barrier) -> Meeting {
        self.sender().meet(barrier)
    }
}

/// A wait at a barrier; see [`Meet::meet`].
///
/// # Examples
///
/// ```
/// use sinew::{barrier::{Barrier, BarrierError, Meet}, message::Sender};
///
/// async fn go_on_together(sender: &Sender) -> Result<(), BarrierError> {
///     let generation = sender.meet(&Barrier::of(4, "step")).await?;
///     println!("step {generation}");
///     Ok(())
/// }
/// ```
#[must_use = "a wait that is dropped leaves the barrier"]
#[derive(Debug)]
pub struct Meeting {
    barrier: Barrier,
    sender: Sender,
    wait: Wait,
}

#[derive(Debug)]
enum Wait {
    Refused(Option<SendError>),
    For(Reply<BarrierAnswer>),
    Over,
}

impl From<Result<Reply<BarrierAnswer>, SendError>> for Wait {
    fn from(reply: Result<Reply<BarrierAnswer>, SendError>) -> Self {
        reply.map_or_else(|error| Self::Refused(Some(error)), Self::For)
    }
}

impl Future for Meeting {
    type Output = Result<u64, BarrierError>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let this = &mut *self;
        let result = match &mut this.wait {
            Wait::Refused(error) => {
                error.take().map_or(Poll::Pending, |error| Poll::Ready(Err(error.into())))
            }
            Wait::For(reply) => match Pin::new(reply).poll(cx) {
                Poll::Pending => Poll::Pending,
                Poll::Ready(answer) => Poll::Ready(
                    answer.map_err(BarrierError::from).and_then(|answer| this.barrier.judge(answer)),
                ),
            },
            Wait::Over => Poll::Pending,
        };
        if result.is_ready() {
            this.wait = Wait::Over;
        }
        result
    }
}

impl Drop for Meeting {
    fn drop(&mut self) {
        if let Wait::For(reply) = &self.wait {
            let to = Tid::new(self.sender.tid().node, AppAddress::SYNC);
            let barrier = self.barrier.name.clone();
            let leave = LeaveBarrier { barrier, correlation: Some(reply.correlation()) };
            // If the node does not accept it, the wait there ends with its deadline or with this incarnation.
            let _ = self.sender.send(to, &leave);
        }
    }
}

/// Maximum number of abandoned waits with a pending notification to the node: the number of barriers at which
/// an application can wait at once.
const LEAVES_MAX: usize = 16;

/// Abandoned waits of an endpoint. The node is notified as soon as there is room; no call waits for that.
#[derive(Debug, Default)]
pub(super) struct Leaves(VecDeque<LeaveBarrier>);

impl Leaves {
    pub(super) fn has_pending(&self) -> bool {
        !self.0.is_empty()
    }

    fn add(&mut self, leave: LeaveBarrier) {
        if self.0.len() >= LEAVES_MAX {
            // The node does not allow waits at more barriers than these.
            self.0.pop_front();
        }
        self.0.push_back(leave);
    }
}

/// A wait of an endpoint at a barrier. Dropping it leaves the barrier, unless the answer has arrived.
struct Arrival<'endpoint> {
    endpoint: &'endpoint mut Endpoint,
    barrier: &'endpoint str,
    is_answered: bool,
}

impl Drop for Arrival<'_> {
    fn drop(&mut self) {
        if !self.is_answered {
            let (barrier, correlation) = (self.barrier.to_owned(), Some(self.endpoint.requests.last));
            self.endpoint.leaves.add(LeaveBarrier { barrier, correlation });
            self.endpoint.send_leaves();
        }
    }
}

impl Endpoint {
    /// Arrives at the barrier and waits there. Returns the generation that opened. Messages that arrive
    /// meanwhile wait to be received, as with [`ask`](super::MessageBuilder::ask).
    ///
    /// # Errors
    /// Not all parties arrived in time, a party was lost, or the node did not allow the wait.
    pub fn meet(&mut self, barrier: &Barrier) -> Result<u64, BarrierError> {
        let answer = block_ready(pin!(self.await_opening(barrier)))?;
        barrier.judge(answer)
    }

    async fn await_opening(&mut self, barrier: &Barrier) -> Result<BarrierAnswer, ApiError> {
        let to = Tid::new(self.tid().node, AppAddress::SYNC);
        let request = Message::typed(self.tid(), to, &barrier.request());
        let mut arrival = Arrival { endpoint: self, barrier: barrier.name(), is_answered: false };
        let room = arrival.endpoint.stall_timeout();
        let reply = arrival.endpoint.await_reply(request.into(), room, barrier.stall_timeout()).await?;
        arrival.is_answered = true;
        Ok(reply.decode()?)
    }

    /// Notifies the node of abandoned waits, as far as there is room now.
    pub(super) fn send_leaves(&mut self) {
        if self.node.ended.is_some() {
            // The waits have ended with the connection.
            self.leaves.0.clear();
        }
        // Nothing else is sent while memory is lent.
        while self.lender.check_free().is_ok() && self.node.continue_writing() {
            let Some(leave) = self.leaves.0.front() else { return };
            let mut message = Message::typed(self.tid, Tid::new(self.tid.node, AppAddress::SYNC), leave);
            (message.header.sequence, message.header.sent) = (self.requests.next_message(), Time::now());
            if !self.node.try_write(message) {
                // The next call sends the notification.
                return;
            }
            self.leaves.0.pop_front();
        }
    }
}

impl AsyncEndpoint {
    /// Arrives at the barrier and waits there; see [`Endpoint::meet`]. Dropping the future before it resolves
    /// leaves the barrier.
    ///
    /// # Errors
    /// Not all parties arrived in time, a party was lost, or the node did not allow the wait.
    pub async fn meet(&mut self, barrier: &Barrier) -> Result<u64, BarrierError> {
        let answer = self.endpoint.await_opening(barrier).await?;
        barrier.judge(answer)
    }
}
