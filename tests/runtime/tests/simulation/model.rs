//! OTP's rules, implemented a second time and directly: the required orders of a supervisor after each event.
//! Slow and plain; it shares only the vocabulary with the core. Each rule cites the manual of stdlib's
//! `supervisor`, or is marked as one of Sinew's own.

mod child;

use std::time::Duration;

use sinew_runtime::{
    supervision::core::{
        AutoShutdown, ChildCommandError, ChildId, Command, Flags, Generation, Input, Order, Policy, Reason,
        Restart, Strategy,
    },
    time::Time,
};

use self::child::{Child, Fate, Pid, child_is_significant};

/// The rules as a machine that predicts orders.
pub(super) struct Model {
    flags: Flags,
    children: Vec<Child>,
    /// The times of all counted restarts.
    counted: Vec<Time>,
    lost: Vec<Time>,
    abandoned: Vec<(ChildId, Generation)>,
    started: bool,
    ending: Option<End>,
    ended: bool,
    settled: bool,
    expected: Vec<Order>,
}

/// Why all children must end. The text of giving up is not predicted.
#[derive(Clone, Copy, Debug, PartialEq)]
enum End {
    Shutdown,
    GaveUp,
}

/// "A permanent child process is always restarted. A temporary child process is never restarted. A transient
/// child process is restarted only if it terminates abnormally, that is, with an exit reason other than
/// normal, shutdown, or {shutdown,Term}."
fn is_restarted(restart: Restart, reason: &Reason) -> bool {
    match (restart, reason) {
        (Restart::Permanent, _) => true,
        (Restart::Temporary, _) | (Restart::Transient, Reason::Normal | Reason::Shutdown) => false,
        (
            Restart::Transient,
            Reason::Panic(_)
            | Reason::StartTimeout
            | Reason::StartFailed(_)
            | Reason::Hung(_)
            | Reason::Killed
            | Reason::ThreadEnded
            | Reason::ProcessEnded(_)
            | Reason::RequirementLost(_)
            | Reason::GaveUp(_),
        ) => true,
    }
}

/// "one_for_one: only that process is restarted. rest_for_one: the rest of the child processes (those after it in start
/// order) are terminated; then it and all after it are restarted. one_for_all: all others are terminated, then all are
/// restarted."
fn goes_with(strategy: Strategy, failed: usize, other: usize) -> bool {
    match strategy {
        Strategy::OneForOne => false,
        Strategy::RestForOne => other > failed,
        Strategy::OneForAll => other != failed,
    }
}

/// "If more than MaxR restarts occur within MaxT seconds, the supervisor terminates all the child processes
/// and then itself."
fn too_many(times: &[Time], max: usize, window: Duration) -> bool {
    let now = *times.last().expect("the one that was just counted");
    times.iter().filter(|at| now.since(**at) <= window).count() > max
}

impl Model {
    pub(super) fn new(flags: Flags, children: Vec<(ChildId, Policy)>) -> Self {
        let mut model = Self {
            flags,
            children: Vec::new(),
            counted: Vec::new(),
            lost: Vec::new(),
            abandoned: Vec::new(),
            started: false,
            ending: None,
            ended: false,
            settled: false,
            expected: Vec::new(),
        };
        children.into_iter().for_each(|(id, policy)| model.append(id, policy, Pid::Undefined));
        model
    }

    fn append(&mut self, id: ChildId, policy: Policy, pid: Pid) {
        let (fate, up_since) = (None, None);
        let child =
            Child { id, policy, pid, generation: 0, released: false, fate, asked: 0, in_a_row: 0, up_since };
        self.children.push(child);
    }

    /// Returns the required orders of the supervisor. `restart_at`: the announced time of a child's restart;
    /// this function checks that it is within the limits of the back-off.
    pub(super) fn step(
        &mut self,
        now: Time,
        input: &Input,
        restart_at: &dyn Fn(ChildId) -> Option<Time>,
    ) -> Vec<Order> {
        if self.ended {
            if let Some((command, id)) = input.command() {
                self.emit(Order::Refused(command, id, ChildCommandError::Ending));
            }
            return std::mem::take(&mut self.expected);
        }
        self.apply(now, input, restart_at);
        if let Input::DeadlineExtended(..) = input {
            return std::mem::take(&mut self.expected);
        }
        self.expire(now, restart_at);
        self.act(now);
        std::mem::take(&mut self.expected)
    }

    fn apply(&mut self, now: Time, input: &Input, restart_at: &dyn Fn(ChildId) -> Option<Time>) {
        if let Some((command, id)) = input.command() {
            return self.execute(command, id, input);
        }
        match input {
            Input::Started => {
                if !self.started && self.ending.is_none() {
                    self.children.iter_mut().for_each(|child| child.pid = Pid::Due);
                }
                self.started = true;
            }
            Input::StopOrdered => self.finish(End::Shutdown),
            Input::Released(id) => {
                self.children.iter_mut().filter(|c| c.id == *id).for_each(|c| c.released = true);
            }
            Input::BecameReady(id, generation) => {
                let found = self.children.iter_mut().find(|c| c.id == *id);
                if let Some(child) = found
                    && let Pid::Starting(current, _) = child.pid
                    && current == *generation
                {
                    (child.pid, child.up_since) = (Pid::Up(current), Some(now));
                    self.emit(Order::Ready(*id));
                }
            }
            Input::Hung(id, generation, reason) => {
                if let Some(index) = self.index(*id, *generation) {
                    self.abandon(now, index, reason, restart_at);
                }
            }
            Input::Ended(id, generation, reason) => match self.index(*id, *generation) {
                Some(index) => self.exit(now, index, reason, restart_at),
                None => self.abandoned.retain(|abandoned| *abandoned != (*id, *generation)),
            },
            // Sinew: a deadline is extended by the time without a CPU.
            Input::DeadlineExtended(id, generation, until) => {
                if let Some(index) = self.index(*id, *generation)
                    && let Pid::Starting(_, at) | Pid::Stopping(_, at) = &mut self.children[index].pid
                {
                    *at = (*at).max(*until);
                }
            }
            Input::TimePassed
            | Input::AddChild(..)
            | Input::TerminateChild(_)
            | Input::RestartChild(_)
            | Input::DeleteChild(_) => {}
        }
    }

    fn index(&self, id: ChildId, generation: Generation) -> Option<usize> {
        self.children.iter().position(|child| child.id == id && child.alive() == Some(generation))
    }

    fn emit(&mut self, order: Order) {
        self.expected.push(order);
    }

    /// Sinew: every wait has a deadline; the first late child in order comes first.
    fn expire(&mut self, now: Time, restart_at: &dyn Fn(ChildId) -> Option<Time>) {
        loop {
            let late = self.children.iter().position(|child| match child.pid {
                Pid::Restarting(at) | Pid::Starting(_, at) | Pid::Stopping(_, at) => at <= now,
                Pid::Undefined | Pid::Due | Pid::Up(_) => false,
            });
            let Some(index) = late else { return };
            match self.children[index].pid {
                Pid::Starting(..) => self.abandon(now, index, &Reason::StartTimeout, restart_at),
                Pid::Stopping(..) => self.abandon(now, index, &Reason::Killed, restart_at),
                Pid::Undefined | Pid::Due | Pid::Restarting(_) | Pid::Up(_) => {
                    self.children[index].pid = Pid::Due;
                }
            }
        }
    }

    /// Sinew: an abandoned incarnation keeps its thread until it releases it; if too many do, the supervisor
    /// gives up.
    fn abandon(
        &mut self,
        now: Time,
        index: usize,
        reason: &Reason,
        restart_at: &dyn Fn(ChildId) -> Option<Time>,
    ) {
        let child = &self.children[index];
        let abandoned = (child.id, child.alive().expect("only the living are abandoned"));
        self.emit(Order::Abandon(abandoned.0, abandoned.1));
        self.abandoned.push(abandoned);
        self.exit(now, index, reason, restart_at);
        if self.abandoned.len() > self.flags.abandoned_max {
            self.finish(End::GaveUp);
        }
    }

    /// OTP's `handle_info({'EXIT', Pid, Reason})`.
    fn exit(
        &mut self,
        now: Time,
        index: usize,
        reason: &Reason,
        restart_at: &dyn Fn(ChildId) -> Option<Time>,
    ) {
        self.settled = false;
        let child = &mut self.children[index];
        child.released = false;
        let (id, restart) = (child.id, child.policy.restart);
        if let Some(fate) = child.fate.take() {
            return self.exit_as_ordered(index, fate, reason);
        }
        if let Reason::RequirementLost(_) = reason {
            // Sinew: it did not fail, and waits for its release again.
            child.pid = Pid::Due;
            return self.emit(Order::Failed(id, reason.clone()));
        }
        child.pid = Pid::Undefined;
        if is_restarted(restart, reason) {
            self.emit(Order::Failed(id, reason.clone()));
            return self.restart(now, index, reason, restart_at);
        }
        self.emit(Order::Gone(id, reason.clone()));
        let significant = child_is_significant(&self.children[index]);
        self.drop_if_temporary(index);
        if significant {
            self.auto_shutdown();
        }
    }

    /// "a temporary child process is never restarted (even when the supervisor's restart strategy is rest_for_one or
    /// one_for_all and a sibling's death causes the temporary process to be terminated)"
    fn exit_as_ordered(&mut self, index: usize, fate: Fate, reason: &Reason) {
        let reported = if *reason == Reason::Normal { Reason::Shutdown } else { reason.clone() };
        let child = &mut self.children[index];
        let (id, asked) = (child.id, std::mem::take(&mut child.asked));
        let again = fate == Fate::StartAgain && child.policy.restart != Restart::Temporary;
        child.pid = if again { Pid::Due } else { Pid::Undefined };
        if again || self.ending.is_some() {
            self.emit(Order::Failed(id, reported));
        } else {
            self.emit(Order::Gone(id, reported));
            self.drop_if_temporary(index);
        }
        (0..asked).for_each(|_| self.emit(Order::Done(Command::Terminate, id)));
    }

    /// "if it is a temporary child process, the child specification is deleted"
    fn drop_if_temporary(&mut self, index: usize) {
        if self.children[index].policy.restart == Restart::Temporary {
            let child = self.children.remove(index);
            self.emit(Order::Deleted(child.id));
        }
    }

    fn restart(
        &mut self,
        now: Time,
        index: usize,
        reason: &Reason,
        restart_at: &dyn Fn(ChildId) -> Option<Time>,
    ) {
        let intensity = self.flags.intensity;
        // Sinew: a child that lost its thread is not at fault; such restarts have a limit of their own.
        let (times, max) = match reason {
            Reason::ThreadEnded => (&mut self.lost, intensity.losses_max),
            Reason::Normal
            | Reason::Shutdown
            | Reason::Panic(_)
            | Reason::StartTimeout
            | Reason::StartFailed(_)
            | Reason::Hung(_)
            | Reason::Killed
            | Reason::ProcessEnded(_)
            | Reason::RequirementLost(_)
            | Reason::GaveUp(_) => (&mut self.counted, intensity.restarts_max),
        };
        times.push(now);
        if too_many(times, max, intensity.window) {
            return self.finish(End::GaveUp);
        }
        let wait = self.children[index].longest_wait(now, intensity.window);
        let at = restart_at(self.children[index].id).unwrap_or(now + wait);
        assert!(at <= now + wait, "back-off longer than {wait:?}");
        assert!(at >= now + wait * 3 / 4, "back-off shorter than three quarters of {wait:?}");
        self.children[index].pid = Pid::Restarting(at);
        for other in 0..self.children.len() {
            if goes_with(self.flags.strategy, index, other) {
                self.children[other].go_with_the_group();
            }
        }
    }

    /// "any_significant: the supervisor automatically shuts itself down when any significant child
    /// terminates, that is, when a transient significant child terminates normally or when a temporary
    /// significant child terminates normally or abnormally. all_significant: when all significant children
    /// have terminated."
    fn auto_shutdown(&mut self) {
        let over = match self.flags.auto_shutdown {
            AutoShutdown::Never => false,
            AutoShutdown::AnySignificant => true,
            AutoShutdown::AllSignificant => {
                self.children.iter().filter(|child| child_is_significant(child)).all(|child| !child.works())
            }
        };
        if over {
            self.finish(End::Shutdown);
        }
    }

    fn finish(&mut self, end: End) {
        self.ending.get_or_insert(end);
        for child in &mut self.children {
            match child.alive() {
                Some(_) => child.fate = Some(Fate::StayDown),
                None => child.pid = Pid::Undefined,
            }
        }
    }

    fn execute(&mut self, command: Command, id: ChildId, input: &Input) {
        let found = self.children.iter().position(|child| child.id == id);
        let refusal = match (command, found) {
            _ if self.ending.is_some() => Some(ChildCommandError::Ending),
            (Command::Add, Some(_)) => Some(ChildCommandError::Present),
            (Command::Add, None) => None,
            (Command::Terminate | Command::Restart | Command::Delete, None) => {
                Some(ChildCommandError::Unknown)
            }
            (Command::Terminate, Some(_)) => None,
            // "{error, running}", "{error, restarting}"
            (Command::Restart | Command::Delete, Some(index)) => match self.children[index].pid {
                Pid::Undefined => None,
                Pid::Restarting(_) => Some(ChildCommandError::Restarting),
                Pid::Due | Pid::Starting(..) | Pid::Up(_) | Pid::Stopping(..) => {
                    Some(ChildCommandError::Running)
                }
            },
        };
        if let Some(refusal) = refusal {
            return self.emit(Order::Refused(command, id, refusal));
        }
        let pid = if self.started { Pid::Due } else { Pid::Undefined };
        match (input, found) {
            (Input::AddChild(_, policy), _) => self.append(id, policy.clone(), pid),
            (Input::TerminateChild(_), Some(index)) => return self.terminate(index),
            (Input::RestartChild(_), Some(index)) => self.children[index].pid = Pid::Due,
            (Input::DeleteChild(_), Some(index)) => {
                self.children.remove(index);
                self.emit(Order::Deleted(id));
            }
            other => unreachable!("{other:?} was refused"),
        }
        self.settled &= command == Command::Delete;
        self.emit(Order::Done(command, id));
    }

    /// "the process, if any, is terminated and, unless it is a temporary child, the child specification is kept"
    fn terminate(&mut self, index: usize) {
        let child = &mut self.children[index];
        let id = child.id;
        match child.pid {
            Pid::Starting(..) | Pid::Up(_) | Pid::Stopping(..) => {
                child.asked += 1;
                child.fate = Some(Fate::StayDown);
                return;
            }
            Pid::Due | Pid::Restarting(_) => self.emit(Order::Gone(id, Reason::Shutdown)),
            Pid::Undefined => {}
        }
        self.children[index].pid = Pid::Undefined;
        self.drop_if_temporary(index);
        self.emit(Order::Done(Command::Terminate, id));
    }

    /// "When the supervisor terminates children, it does so in reverse start order"; it starts them in start order.
    fn act(&mut self, now: Time) {
        let together = self.flags.strategy != Strategy::OneForOne;
        let mut blocked = false;
        for index in (0..self.children.len()).rev() {
            let child = &mut self.children[index];
            // A group is stopped one by one; single children stop as soon as ordered.
            let waits = blocked && (together || self.ending.is_some());
            let (Some(_), Some(generation)) = (child.fate, child.alive()) else { continue };
            if !waits && !matches!(child.pid, Pid::Stopping(..)) {
                child.pid = Pid::Stopping(generation, now + child.policy.stop_within);
                let order = Order::Stop(child.id, generation);
                self.emit(order);
            }
            blocked = true;
        }
        if blocked && (together || self.ending.is_some()) {
            return;
        }
        match self.ending {
            Some(end) => {
                self.ended = true;
                let words = String::new();
                self.emit(Order::Ended(if end == End::Shutdown {
                    Reason::Shutdown
                } else {
                    Reason::GaveUp(words)
                }));
            }
            None if self.started => self.start_who_is_due(now, together),
            None => {}
        }
    }

    fn start_who_is_due(&mut self, now: Time, together: bool) {
        for index in 0..self.children.len() {
            let child = &mut self.children[index];
            if child.pid == Pid::Due && !child.held_back() {
                child.generation += 1;
                child.pid = Pid::Starting(child.generation, now + child.policy.start_within);
                let order = Order::Spawn(child.id, child.generation);
                self.emit(order);
            }
            let child = &self.children[index];
            if together && !matches!(child.pid, Pid::Up(_) | Pid::Undefined) {
                break;
            }
        }
        let rests = |child: &Child| matches!(child.pid, Pid::Up(_) | Pid::Undefined);
        let leaves = |child: &Child| child.fate == Some(Fate::StayDown);
        if !self.settled && self.children.iter().all(|child| rests(child) || leaves(child)) {
            self.settled = true;
            self.emit(Order::AllReady);
        }
    }

    /// Whether it has reported its end.
    pub(super) fn is_ended(&self) -> bool {
        self.ended
    }
}
