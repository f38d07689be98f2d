//! The supervisor's decisions, as a pure state machine: (history, now, event) to orders.
//!
//! Erlang/OTP's vocabulary and rules (stdlib, module `supervisor`): restart types, strategies, restart intensity over a
//! window, ordered start, stop in reverse order. Added to them: readiness (a child is started when those before it have
//! said Ready), a deadline on every wait, exponential back-off, and children that are held until they are released.
//!
//! After every [`handle`](Core::handle) the shell drains [`poll`](Core::poll) until nothing is left, then sleeps until
//! [`next_wake`](Core::next_wake). Every event carries the generation of the child that it speaks of; an event of an
//! earlier generation is ignored.

use std::{collections::VecDeque, time::Duration};

use crate::time::Time;

/// Who is restarted when one child fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Strategy {
    /// That child alone.
    OneForOne,
    /// That child and those started after it.
    RestForOne,
    /// All children.
    OneForAll,
}

/// When a child that ended is started again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Restart {
    /// Always.
    Permanent,
    /// Only if it failed.
    Transient,
    /// Never.
    Temporary,
}

/// How a child ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Reason {
    /// By itself, in order.
    Normal,
    /// Because it was told to.
    Shutdown,
    /// It panicked; what it said.
    Panic(String),
    /// It did not become ready in its time.
    StartTimeout,
    /// It did not come back in its progress budget; who says so, since when, and in what.
    Hung(String),
    /// It did not stop in its time.
    Killed,
    /// The thread under it ended.
    ThreadEnded,
    /// The process that it was ended; its exit code or the signal, in words.
    ProcessEnded(String),
    /// A supervisor gave up; why.
    GaveUp(String),
}

impl Reason {
    /// Whether this counts as a failure.
    #[must_use]
    pub const fn is_failure(&self) -> bool {
        !matches!(self, Self::Normal | Self::Shutdown)
    }
}

impl std::fmt::Display for Reason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Normal => f.write_str("ended by itself"),
            Self::Shutdown => f.write_str("was told to stop"),
            Self::Panic(said) => write!(f, "panicked: {said}"),
            Self::StartTimeout => f.write_str("did not become ready in its time"),
            Self::Hung(what) => write!(f, "hung: {what}"),
            Self::Killed => f.write_str("did not stop in its time"),
            Self::ThreadEnded => f.write_str("lost its thread"),
            Self::ProcessEnded(how) => write!(f, "its process ended: {how}"),
            Self::GaveUp(why) => f.write_str(why),
        }
    }
}

/// What a supervisor may do with a child.
#[derive(Clone, Debug)]
pub struct Policy {
    /// When it is started again. Default [`Restart::Permanent`].
    pub restart: Restart,
    /// Time to become ready. Default 10 s.
    pub start_within: Duration,
    /// Time to stop before it is abandoned. Default 500 ms.
    pub stop_within: Duration,
    /// First wait before a restart; doubles with each failure in a row. Default 1 ms.
    pub backoff_min: Duration,
    /// Longest wait before a restart. Default 2 s.
    pub backoff_max: Duration,
    /// Longest time that one turn (a handler, a timer, `started`) may take before the actor counts as hung. Default 1 s;
    /// `None`: it may take as long as it likes.
    pub progress_within: Option<Duration>,
    /// Whether it waits for its release before its first start and after each failure. Default no.
    pub held: bool,
}

impl Default for Policy {
    fn default() -> Self {
        Self {
            restart: Restart::Permanent,
            start_within: Duration::from_secs(10),
            stop_within: Duration::from_millis(500),
            backoff_min: Duration::from_millis(1),
            backoff_max: Duration::from_secs(2),
            progress_within: Some(Duration::from_secs(1)),
            held: false,
        }
    }
}

/// How many restarts are too many.
#[derive(Clone, Copy, Debug)]
pub struct Intensity {
    /// Restarts allowed in one window; one more and the supervisor gives up.
    pub restarts_max: usize,
    /// The window.
    pub window: Duration,
}

impl Default for Intensity {
    fn default() -> Self {
        Self { restarts_max: 5, window: Duration::from_secs(10) }
    }
}

/// Position of a child among its siblings: the order of start.
pub type ChildIndex = usize;
/// Which life of a child; 0 before its first.
pub type Generation = u64;

/// What a supervisor is told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Input {
    /// Start the children.
    Started,
    /// What this child requires is ready.
    Released(ChildIndex),
    /// This child takes messages.
    BecameReady(ChildIndex, Generation),
    /// This child does not come back: the reason says what it is in. Its life is taken.
    Hung(ChildIndex, Generation, Reason),
    /// This child is gone.
    Ended(ChildIndex, Generation, Reason),
    /// A deadline may have passed.
    TimePassed,
    /// Stop the children, last first.
    StopOrdered,
}

/// What a supervisor orders its shell to do, and what it says to others.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Order {
    /// Make a new instance of this child.
    Spawn(ChildIndex, Generation),
    /// Tell this child to stop.
    Stop(ChildIndex, Generation),
    /// Take this child's life without waiting for it.
    Abandon(ChildIndex, Generation),
    /// For others: this child failed.
    Failed(ChildIndex, Reason),
    /// For others: this child is ready.
    Ready(ChildIndex),
    /// For others: this child is gone and will not be started again.
    Gone(ChildIndex, Reason),
    /// For others: every child that is wanted and not held is ready. Said again after each restart.
    AllReady,
    /// For others: no child lives any more, and why. The last order.
    Ended(Reason),
}

/// Where a child is in its life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChildState {
    /// Does not live; waits for its turn, or for its release.
    Down,
    /// Failed; is started again at this time.
    BackingOff(Time),
    /// Lives, is not ready, has time until then.
    Starting(Time),
    /// Lives and is ready.
    Ready,
    /// Was told to stop, has time until then.
    Stopping(Time),
}

impl ChildState {
    const fn is_alive(self) -> bool {
        matches!(self, Self::Starting(_) | Self::Ready | Self::Stopping(_))
    }

    const fn deadline(self) -> Option<Time> {
        match self {
            Self::BackingOff(at) | Self::Starting(at) | Self::Stopping(at) => Some(at),
            Self::Down | Self::Ready => None,
        }
    }
}

#[derive(Debug)]
struct Child {
    policy: Policy,
    state: ChildState,
    generation: Generation,
    /// Should live.
    wanted: bool,
    /// What it requires is ready. Forgotten when it ends, for then its requirements are asked for again.
    released: bool,
    /// Lives, and must be replaced because a sibling failed.
    stale: bool,
    failures_in_a_row: u32,
    restarts: u64,
    ready_since: Time,
}

/// A supervisor's memory; see the [module](self).
#[derive(Debug)]
pub struct Core {
    strategy: Strategy,
    intensity: Intensity,
    children: Vec<Child>,
    restarts: VecDeque<Time>,
    /// Set once the children are to end.
    ending: Option<Reason>,
    ended: bool,
    said_all_ready: bool,
    orders: VecDeque<Order>,
}

impl Core {
    /// A supervisor of children with these policies, in the order of their start.
    #[must_use]
    pub fn new(strategy: Strategy, intensity: Intensity, policies: Vec<Policy>) -> Self {
        let children = policies.into_iter().map(Child::new).collect();
        Self {
            strategy,
            intensity,
            children,
            restarts: VecDeque::new(),
            ending: None,
            ended: false,
            said_all_ready: false,
            orders: VecDeque::new(),
        }
    }

    /// Takes an event. Then drain [`poll`](Self::poll).
    pub fn handle(&mut self, now: Time, input: Input) {
        if self.ended {
            return;
        }
        match input {
            Input::Started => self.children.iter_mut().for_each(|child| child.wanted = true),
            Input::StopOrdered => self.end(Reason::Shutdown),
            Input::Released(index) => self.released(index),
            Input::BecameReady(index, generation) => self.became_ready(now, index, generation),
            Input::Hung(index, generation, reason) => {
                if self.is_present(index, generation) {
                    self.orders.push_back(Order::Abandon(index, generation));
                    self.child_ended(now, index, reason);
                }
            }
            Input::Ended(index, generation, reason) => {
                if self.is_present(index, generation) {
                    self.child_ended(now, index, reason);
                }
            }
            Input::TimePassed => {}
        }
        self.expire(now);
        self.reconcile(now);
    }

    /// The next order, oldest first.
    pub fn poll(&mut self) -> Option<Order> {
        self.orders.pop_front()
    }

    /// When [`Input::TimePassed`] is due.
    #[must_use]
    pub fn next_wake(&self) -> Option<Time> {
        self.children.iter().filter_map(|child| child.state.deadline()).min()
    }

    /// Where a child is in its life, which life it is, and how often it was restarted.
    #[must_use]
    pub fn child(&self, index: ChildIndex) -> (ChildState, Generation, u64) {
        let child = &self.children[index];
        (child.state, child.generation, child.restarts)
    }

    fn is_present(&self, index: ChildIndex, generation: Generation) -> bool {
        self.children.get(index).is_some_and(|child| child.generation == generation && child.state.is_alive())
    }

    fn released(&mut self, index: ChildIndex) {
        if let Some(child) = self.children.get_mut(index) {
            child.released = true;
        }
    }

    fn became_ready(&mut self, now: Time, index: ChildIndex, generation: Generation) {
        if self.is_present(index, generation)
            && let ChildState::Starting(_) = self.children[index].state
        {
            self.children[index].state = ChildState::Ready;
            self.children[index].ready_since = now;
            self.orders.push_back(Order::Ready(index));
        }
    }

    /// Lets every wait end whose time is over.
    fn expire(&mut self, now: Time) {
        for index in 0..self.children.len() {
            let Child { state, generation, .. } = self.children[index];
            match state {
                ChildState::BackingOff(at) if at <= now => self.children[index].state = ChildState::Down,
                ChildState::Starting(until) if until <= now => {
                    self.orders.push_back(Order::Abandon(index, generation));
                    self.child_ended(now, index, Reason::StartTimeout);
                }
                ChildState::Stopping(until) if until <= now => {
                    self.orders.push_back(Order::Abandon(index, generation));
                    self.child_ended(now, index, Reason::Killed);
                }
                ChildState::BackingOff(_)
                | ChildState::Starting(_)
                | ChildState::Stopping(_)
                | ChildState::Down
                | ChildState::Ready => {}
            }
        }
    }

    fn child_ended(&mut self, now: Time, index: ChildIndex, reason: Reason) {
        let child = &mut self.children[index];
        let was_asked_to = matches!(child.state, ChildState::Stopping(_));
        child.state = ChildState::Down;
        child.released = false;
        self.said_all_ready = false;
        if was_asked_to {
            self.orders.push_back(Order::Failed(index, Reason::Shutdown));
            return;
        }
        let again = match child.policy.restart {
            Restart::Permanent => true,
            Restart::Transient => reason.is_failure(),
            Restart::Temporary => false,
        };
        if !again || !child.wanted {
            child.wanted = false;
            self.orders.push_back(Order::Gone(index, reason));
            return;
        }
        self.orders.push_back(Order::Failed(index, reason.clone()));
        self.restart(now, index, &reason);
    }

    fn restart(&mut self, now: Time, index: ChildIndex, reason: &Reason) {
        self.restarts.push_back(now);
        while self.restarts.front().is_some_and(|at| now.since(*at) > self.intensity.window) {
            self.restarts.pop_front();
        }
        if self.restarts.len() > self.intensity.restarts_max {
            let Intensity { restarts_max, window } = self.intensity;
            self.end(Reason::GaveUp(format!(
                "more than {restarts_max} restarts in {} s; the last child to fail {reason}",
                window.as_secs_f32()
            )));
            return;
        }
        let wait = self.children[index].next_backoff(now, self.intensity.window);
        self.children[index].state = ChildState::BackingOff(now + wait);
        self.children[index].restarts += 1;
        let others = match self.strategy {
            Strategy::OneForOne => 0..0,
            Strategy::RestForOne => index + 1..self.children.len(),
            Strategy::OneForAll => 0..self.children.len(),
        };
        for other in others.filter(|other| *other != index) {
            self.children[other].stale = self.children[other].state.is_alive();
        }
    }

    fn end(&mut self, why: Reason) {
        self.ending.get_or_insert(why);
        self.children.iter_mut().for_each(|child| child.wanted = false);
    }

    /// Brings the children nearer to what is wanted: stops first, then starts.
    fn reconcile(&mut self, now: Time) {
        if self.stop_the_last_unwanted(now) {
            return;
        }
        if let Some(why) = self.ending.clone() {
            self.ended = true;
            self.orders.push_back(Order::Ended(why));
            return;
        }
        self.start_in_order(now);
        let settled =
            |child: &Child| !child.wanted || child.state == ChildState::Ready || child.waits_for_release();
        if !self.said_all_ready && self.children.iter().any(|c| c.wanted) && self.children.iter().all(settled)
        {
            self.said_all_ready = true;
            self.orders.push_back(Order::AllReady);
        }
    }

    /// Stops one child at a time, last first. Returns whether one is still alive that should not be.
    fn stop_the_last_unwanted(&mut self, now: Time) -> bool {
        let unwanted = |child: &Child| child.state.is_alive() && (child.stale || !child.wanted);
        let Some(index) = self.children.iter().rposition(unwanted) else {
            // Stale children whose life ended are replaced by their next start.
            self.children.iter_mut().for_each(|child| child.stale = false);
            return false;
        };
        let child = &mut self.children[index];
        if !matches!(child.state, ChildState::Stopping(_)) {
            child.state = ChildState::Stopping(now + child.policy.stop_within);
            self.orders.push_back(Order::Stop(index, child.generation));
        }
        true
    }

    /// Starts whom it can: in order where the strategy ties children to those before them, else all at once.
    fn start_in_order(&mut self, now: Time) {
        let ordered = self.strategy != Strategy::OneForOne;
        for index in 0..self.children.len() {
            let child = &mut self.children[index];
            if child.wanted && child.state == ChildState::Down && !child.waits_for_release() {
                child.generation += 1;
                child.state = ChildState::Starting(now + child.policy.start_within);
                self.orders.push_back(Order::Spawn(index, child.generation));
            }
            if ordered && child.wanted && child.state != ChildState::Ready {
                return;
            }
        }
    }
}

impl Child {
    const fn new(policy: Policy) -> Self {
        Self {
            policy,
            state: ChildState::Down,
            generation: 0,
            wanted: false,
            released: false,
            stale: false,
            failures_in_a_row: 0,
            restarts: 0,
            ready_since: Time::ZERO,
        }
    }

    fn waits_for_release(&self) -> bool {
        self.state == ChildState::Down && self.policy.held && !self.released
    }

    /// The wait before the next start: doubled by each failure in a row, forgotten after a `healthy` life.
    fn next_backoff(&mut self, now: Time, healthy: Duration) -> Duration {
        if self.ready_since > Time::ZERO && now.since(self.ready_since) > healthy {
            self.failures_in_a_row = 0;
        }
        let doublings = self.failures_in_a_row.min(20);
        self.failures_in_a_row += 1;
        self.policy.backoff_min.saturating_mul(1 << doublings).min(self.policy.backoff_max)
    }
}
