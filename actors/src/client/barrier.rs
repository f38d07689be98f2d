//! Run-time barriers: several applications, on any nodes, go on together.

use std::{
    collections::VecDeque,
    future::Future,
    pin::Pin,
    task::{Context, Poll},
    time::Duration,
};

use actix::Actor;
use sinew_runtime::{
    app::AppContext,
    sender::{AskError, Reply, SendError, Sender},
    tid::{AppAddress, Tid},
    time::Time,
    wire::Message,
};

use super::{ApiError, AsyncEndpoint, Endpoint, form::at_once, link::Progress};
use crate::sync::{ArriveAtBarrier, BarrierAnswer, BarrierKind, LeaveBarrier, OnPartyLoss};

/// How much later than the barrier's own deadline its answer may come: the node says who is missing.
const SAYING: Duration = Duration::from_secs(2);
/// How long one waits at a barrier that says nothing else.
const WITHIN: Duration = Duration::from_secs(60);

/// A point at which several applications, on any nodes, wait for each other.
///
/// It has no owner and need not be made: it is there when somebody arrives. When all parties wait it opens for all of them, and
/// can be used again: the next round is its next generation. What is promised when a node dies meanwhile stands in
/// `docs/SEMANTICS.md`, "Barriers".
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
    /// The barrier of this name, 1 to 63 bytes, at which these parties meet. They are given as in `requires`: names, patterns, any
    /// of several, so many of them; all must be met by those who wait there. Whoever arrives must be one of them, and must name the
    /// same ones: with other parties it is another barrier.
    #[must_use]
    pub fn new<N: Into<String>>(name: impl Into<String>, parties: impl IntoIterator<Item = N>) -> Self {
        let parties = parties.into_iter().map(Into::into).collect();
        let (within, on_loss, kind) = (WITHIN, OnPartyLoss::default(), BarrierKind::default());
        Self { name: name.into(), parties, within, on_loss, kind }
    }

    /// The phase of this name, one word, that these parties come up in: to `meet` there says that one has reached it, and waits until all
    /// parties have. Who has reached it counts until its life ends. So who is started again goes on at once if the others are there, and
    /// nobody else is brought back. Whoever is no party can require it: `2 of *.drive at homed`.
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

    /// The barrier at which any `count` applications meet. Exactly so many should take part: with more, those that the others
    /// are not waiting for meet in the next generation.
    #[must_use]
    pub fn of(count: usize, name: impl Into<String>) -> Self {
        Self::new(name, [format!("{count} of *")])
    }

    /// How long one waits; whole milliseconds. Default: 60 s.
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

    /// Whether one goes on waiting when a named party is lost. Default: yes, it may come back.
    #[must_use]
    pub const fn on_loss(mut self, on_loss: OnPartyLoss) -> Self {
        self.on_loss = on_loss;
        self
    }

    /// Its name.
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

    /// How long the request itself may take.
    fn stall_timeout(&self) -> Duration {
        self.within.saturating_add(SAYING)
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

/// Why one does not wait at a barrier any more.
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
    /// Not all were there in time. The others go on waiting.
    #[error("the barrier '{barrier}' did not open in {waited:?}: {}", in_words(missing))]
    TimedOut {
        /// Its name.
        barrier: String,
        /// How long it was waited for.
        waited: Duration,
        /// Who is missing, and the last that is known of each.
        missing: Vec<(String, String)>,
    },
    /// A party was lost, and it was not to be waited for.
    #[error("a party of the barrier '{barrier}' was lost: {}", in_words(missing))]
    Lost {
        /// Its name.
        barrier: String,
        /// Who is missing, and the last that is known of each.
        missing: Vec<(String, String)>,
    },
    /// The node does not let it wait there.
    #[error("{0}")]
    Refused(String),
    /// The node was not asked.
    #[error("the node was not asked: {0}")]
    Send(#[from] SendError),
    /// The node has not answered.
    #[error("the node has not said what became of the barrier: {0}")]
    Ask(#[from] AskError),
    /// The node was not asked by an endpoint, or has not answered it.
    #[error("the node has not said what became of the barrier: {0}")]
    Api(#[from] ApiError),
}

fn in_words(missing: &[(String, String)]) -> String {
    let parts: Vec<String> = missing.iter().map(|(name, why)| format!("{name} is missing ({why})")).collect();
    parts.join(", ")
}

/// Whoever has a [`Sender`] can wait at a barrier.
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
    /// Arrives at the barrier and waits there; the future ends with the generation that opened. Dropped before, it leaves the
    /// barrier. In an actor: `context.spawn` or `context.wait` it.
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
#[must_use = "who does not wait for it leaves the barrier"]
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
            // Where the node does not take it, the wait there ends with its deadline or with this life.
            let _ = self.sender.send(to, &leave);
        }
    }
}

/// Waits that were given up, of which the node is not told yet: as many as barriers at which an application waits at once.
const LEAVES_MAX: usize = 16;

/// Waits of an endpoint that were given up. The node is told as soon as there is room for it, which nobody waits for.
#[derive(Debug, Default)]
pub(super) struct Leaves(VecDeque<LeaveBarrier>);

impl Leaves {
    pub(super) fn are_to_be_told(&self) -> bool {
        !self.0.is_empty()
    }

    fn add(&mut self, leave: LeaveBarrier) {
        if self.0.len() >= LEAVES_MAX {
            // The node lets nobody wait at more barriers than these.
            self.0.pop_front();
        }
        self.0.push_back(leave);
    }
}

/// A wait of an endpoint at a barrier. It leaves, unless its answer has come.
struct Arrival<'endpoint> {
    endpoint: &'endpoint mut Endpoint,
    barrier: &'endpoint str,
    is_answered: bool,
}

impl Drop for Arrival<'_> {
    fn drop(&mut self) {
        if !self.is_answered {
            let (barrier, correlation) = (self.barrier.to_owned(), Some(self.endpoint.asked));
            self.endpoint.leaves.add(LeaveBarrier { barrier, correlation });
            self.endpoint.tell_leaves();
        }
    }
}

impl Endpoint {
    /// Arrives at the barrier and waits there. Returns the generation that opened. Messages that come meanwhile wait to be
    /// received, as with [`ask`](super::MessageBuilder::ask).
    ///
    /// # Errors
    /// Not all were there in time, a party was lost, or the node did not let it wait.
    pub fn meet(&mut self, barrier: &Barrier) -> Result<u64, BarrierError> {
        let answer = at_once(self.await_opening(barrier))?;
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

    /// Tells the node which waits were given up, as far as there is room now.
    pub(super) fn tell_leaves(&mut self) {
        if self.ended.is_some() {
            // The connection has taken the waits with it.
            self.leaves.0.clear();
        }
        // Nothing else goes out while memory is lent.
        while self.lender.be_free().is_ok() && self.go_on() {
            let Some(leave) = self.leaves.0.front() else { return };
            let mut message = Message::typed(self.tid, Tid::new(self.tid.node, AppAddress::SYNC), leave);
            self.sequence += 1;
            (message.header.sequence, message.header.sent) = (self.sequence, Time::now());
            if let Some(message) = self.writer.send_in_place(message.into()) {
                match self.writer.begin(message) {
                    // What is being sent just now has the ring in hand: the next call tells it.
                    Ok(Progress::Full(_)) | Err(ApiError::LoanActive) => return,
                    Ok(Progress::Part(rest)) => self.rest = rest,
                    // An error shows itself again when the ring is read.
                    Ok(Progress::Whole) | Err(_) => {}
                }
            }
            self.leaves.0.pop_front();
        }
    }
}

impl AsyncEndpoint {
    /// Arrives at the barrier and waits there; see [`Endpoint::meet`]. If the future is dropped before, it leaves the barrier.
    ///
    /// # Errors
    /// Not all were there in time, a party was lost, or the node did not let it wait.
    pub async fn meet(&mut self, barrier: &Barrier) -> Result<u64, BarrierError> {
        let answer = self.endpoint.await_opening(barrier).await?;
        barrier.judge(answer)
    }
}
