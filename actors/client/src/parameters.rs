//! Parameters of an endpoint: its program serves them in its own loop.

use std::{fmt, pin::pin, sync::Arc, time::Duration};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    parameters::{
        AskParameters, OwnPart, ParameterError, ParameterList, ParameterOutcome, ParameterVote, Parameters,
        SetParameters, TICK_WITHIN, Tuner,
    },
    tid::Tid,
    time::Time,
    wire::Payload,
};

use super::{
    ApiError, AsyncEndpoint, Endpoint, Received, Registration,
    builder::{SendTerms, Value},
    wait_mode::block_ready,
};

/// The parameters of an endpoint, which `params!` has made, and the sets that wait for its loop.
///
/// The program hands each received message to [`serve`](Self::serve), and calls [`tick`](Self::tick) at the begin of
/// each turn of its loop. `sinew param` lists and sets the parameters then, alone or in a transaction, as those of an
/// application in a node: see [`AppSpec::params`](sinew_runtime::app::AppSpec::params). Neither call waits for a
/// requester. A program that takes part in transactions receives at least every 20 ms: it agrees in these calls.
///
/// # Examples
///
/// ```no_run
/// use std::time::Duration;
///
/// use sinew::{NodeApi, Registration, client::EndpointParameters, params};
///
/// params! {
///     /// How the camera exposes.
///     struct Exposure {
///         /// Time of one exposure.
///         time: f64 = 5.0, unit "ms", range 0.1..=20.0;
///     }
/// }
///
/// let (exposure, period) = (Exposure::new(), Duration::from_millis(20));
/// let node = NodeApi::connect("/run/sinew/knee.sock")?;
/// let camera = Registration::new().name("camera").serves_parameters();
/// let mut camera = node.register_transport_address(camera)?;
/// let mut parameters = EndpointParameters::new(&mut camera, &exposure, period);
/// for _ in 0..1_000 {
///     parameters.tick(&mut camera);
///     println!("expose for {} ms", exposure.time.get());
///     if let Some(received) = camera.receive(period)?
///         && let Some(other) = parameters.serve(&mut camera, received)
///     {
///         println!("a message of kind {}", other.kind());
///     }
/// }
/// # Ok::<(), sinew::client::ApiError>(())
/// ```
pub struct EndpointParameters {
    tuner: Tuner<Option<Received>>,
    period: Duration,
    ticks: u64,
    /// The replies that are not sent yet.
    replies: Vec<(Received, Answer)>,
}

/// Sends without a wait for room.
const AT_ONCE: SendTerms = SendTerms { room_within: Some(Duration::ZERO), ..SendTerms::PLAIN };

enum Answer {
    List(ParameterList),
    Outcome(ParameterOutcome),
}

impl fmt::Debug for EndpointParameters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "EndpointParameters({} ticks of {:?})", self.ticks, self.period)
    }
}

impl Registration {
    /// Declares that the application has parameters, which its program serves by [`EndpointParameters`]:
    /// `sinew param list` finds it then. This takes five of the 64 types.
    #[must_use]
    pub fn serves_parameters(self) -> Self {
        self.handles::<AskParameters>()
            .handles::<SetParameters>()
            .handles::<ParameterVote>()
            .sends::<ParameterList>()
            .sends::<ParameterOutcome>()
    }
}

const fn since_origin(time: Time) -> Duration {
    Duration::from_nanos(time.as_nanos())
}

impl EndpointParameters {
    /// Creates the parameters of an endpoint. `period` is that of its loop: a value with a slope moves by at most two
    /// periods in one tick. With a `period` of zero there is no loop: sets are applied by [`serve`](Self::serve) and
    /// [`tick`](Self::tick), between two messages, and parameters with a slope cannot be set.
    ///
    /// Parameters that are not declared with `keep` get their defaults. From now on the endpoint makes no automatic
    /// direct link: the node decides which senders may set parameters. No other object may have the same parameters.
    pub fn new<P: Parameters>(endpoint: &mut Endpoint, parameters: &Arc<P>, period: Duration) -> Self {
        endpoint.direct.keep_to_node();
        let tuner = Tuner::new(parameters.clone(), since_origin(Time::now()));
        Self { tuner, period, ticks: 0, replies: Vec::new() }
    }

    /// Creates the parameters of an asynchronous endpoint, like [`new`](Self::new).
    pub fn new_async<P: Parameters>(
        endpoint: &mut AsyncEndpoint,
        parameters: &Arc<P>,
        period: Duration,
    ) -> Self {
        Self::new(&mut endpoint.endpoint, parameters, period)
    }

    /// Handles a received message, if it is about parameters. Returns each other one, for the program.
    pub fn serve(&mut self, endpoint: &mut Endpoint, received: Received) -> Option<Received> {
        let other = self.take(endpoint.tid(), received, Time::now());
        block_ready(pin!(self.flush(endpoint)));
        other
    }

    /// Applies the sets that wait, moves values with a slope, and takes the steps of a transaction. Call it at the
    /// begin of each turn of the loop: all parameters that the turn reads belong together then.
    pub fn tick(&mut self, endpoint: &mut Endpoint) {
        self.turn(Time::now());
        block_ready(pin!(self.flush(endpoint)));
    }

    /// Handles a received message of an asynchronous endpoint, like [`serve`](Self::serve).
    pub async fn serve_async(
        &mut self,
        endpoint: &mut AsyncEndpoint,
        received: Received,
    ) -> Option<Received> {
        let other = self.take(endpoint.tid(), received, Time::now());
        self.flush(&mut endpoint.endpoint).await;
        other
    }

    /// Begins a turn of the loop of an asynchronous endpoint, like [`tick`](Self::tick).
    pub async fn tick_async(&mut self, endpoint: &mut AsyncEndpoint) {
        self.turn(Time::now());
        self.flush(&mut endpoint.endpoint).await;
    }

    fn has_ticks(&self) -> bool {
        !self.period.is_zero()
    }

    fn turn(&mut self, now: Time) {
        let tick = if self.has_ticks() {
            self.ticks += 1;
            self.ticks
        } else {
            0
        };
        let Self { tuner, replies, period, .. } = self;
        tuner.tick((tick, *period), since_origin(now), |request, outcome| {
            replies.extend(request.map(|request| (request, Answer::Outcome(outcome))));
        });
    }

    fn take(&mut self, own: Tid, received: Received, now: Time) -> Option<Received> {
        let kind = received.kind();
        if kind == AskParameters::KIND {
            if received.wants_reply() {
                let list = self.tuner.list(self.has_ticks());
                self.replies.push((received, Answer::List(list)));
            } else {
                received.settle(Outcome::Rejected(Rejection::Unsupported));
            }
        } else if kind == ParameterVote::KIND {
            // A message that is dropped after a failed decoding is reported as malformed.
            if let Ok(vote) = received.decode() {
                self.tuner.on_vote(since_origin(now), received.source().bits(), vote);
            }
        } else if kind == SetParameters::KIND {
            if let Ok(set) = received.decode() {
                self.set(own, &set, received, now);
            }
        } else {
            return Some(received);
        }
        None
    }

    fn set(&mut self, own: Tid, set: &SetParameters, request: Received, now: Time) {
        let (has_ticks, at) = (self.has_ticks(), since_origin(now));
        match set {
            SetParameters::Prepare(transaction) => {
                let sent = request.sent().map(since_origin).zip(request.age_error());
                let prepared =
                    self.tuner.prepare(transaction, OwnPart { tid: own.bits(), has_ticks }, sent, at);
                self.answer(request, prepared);
            }
            SetParameters::Conclude(id) => {
                let outcome = self.tuner.outcome_of(*id, at);
                self.answer(request, Ok(outcome));
            }
            SetParameters::Values(_) | SetParameters::Undo => {
                let until = request.expiry().min(now + TICK_WITHIN);
                let is_asked = request.wants_reply();
                let (asked, unasked) = if is_asked { (Some(request), None) } else { (None, Some(request)) };
                match self.tuner.stage(set, (asked, since_origin(until)), has_ticks) {
                    Ok(()) if !has_ticks => self.turn(now),
                    Ok(()) => {}
                    Err((asked, why)) => {
                        if let Some(request) = asked.or(unasked) {
                            self.answer(request, Err(why));
                        }
                    }
                }
            }
        }
    }

    /// Keeps the reply to a request until it is sent.
    fn answer(&mut self, request: Received, outcome: Result<ParameterOutcome, ParameterError>) {
        match outcome {
            Err(_) if !request.wants_reply() => request.settle(Outcome::Rejected(Rejection::ByHandler)),
            _ if !request.wants_reply() => {}
            outcome => {
                let outcome = outcome.unwrap_or_else(|why| ParameterOutcome::from(&why));
                self.replies.push((request, Answer::Outcome(outcome)));
            }
        }
    }

    /// Sends what waits, without a wait for room: a requester that has ended gets no reply, and a vote is repeated.
    async fn flush(&mut self, endpoint: &mut Endpoint) {
        let now = Time::now();
        let Self { tuner, replies, .. } = self;
        tuner.expire(since_origin(now), |request, outcome| {
            replies.extend(request.map(|request| (request, Answer::Outcome(outcome))));
        });
        if !self.has_ticks() {
            // Agreed values apply between two messages.
            self.turn(now);
        }
        for (request, answer) in self.replies.drain(..) {
            let to = request.source();
            let _: Result<(), ApiError> = match &answer {
                Answer::List(list) => endpoint.reply_as(&request, Value::new(to, list), AT_ONCE).await,
                Answer::Outcome(outcome) => {
                    endpoint.reply_as(&request, Value::new(to, outcome), AT_ONCE).await
                }
            };
        }
        while let Some((to, vote)) = self.tuner.take_vote() {
            let _ = endpoint.send_as(Value::new(Tid::from_bits(to), &vote), AT_ONCE).await;
        }
    }
}
