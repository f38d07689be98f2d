//! Who watches whom, without clock and socket: facts in, orders out.
//!
//! After each [`Core::handle`] and [`Core::monitor`] the shell takes [`Core::poll`] until nothing is left, and comes back
//! with [`Input::TimePassed`] at [`Core::next_wake`].

mod pace;
mod watched;
mod watching;

use std::{borrow::Cow, collections::VecDeque, time::Duration};

use sinew_runtime::{
    monitor::{Down, DownClass, MonitorError, MonitorId},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
};

use self::{
    pace::Pace,
    watched::{Watched, Whose},
    watching::Watching,
};
use super::words::{Cause, LifeState, Lives, Watch, watched_max};

/// Time until a `Down` that was not taken is offered again.
pub(super) const RETRY: Duration = Duration::from_millis(10);
/// Time between two lists of whom we watch, to one node, when nothing changes.
pub(super) const REPEAT: Duration = Duration::from_secs(2);
/// Least time between two of them.
pub(super) const SPACING: Duration = Duration::from_millis(5);
/// Time after which a node that NDL never told of and whose link is down counts as lost.
pub(super) const ORPHAN: Duration = Duration::from_secs(10);
/// Monitors of one application at most.
pub(super) const PER_WATCHER_MAX: usize = 256;
/// Time that each answer "nobody is there" costs its watcher, once it had [`PER_WATCHER_MAX`] of them.
pub(super) const NOBODY_EVERY: Duration = Duration::from_millis(10);
/// Monitors of a node at most.
pub(super) const MONITORS_MAX: usize = 4_096;

/// What has happened.
#[derive(Clone, Debug)]
pub(crate) enum Input {
    /// An application of this node got its address.
    Began { app: AppAddress },
    /// The same of a guest: an application of a user whom the access list lets in.
    GuestBegan { app: AppAddress },
    /// A life of it has ended; another one follows, or it is gone.
    Ended { app: AppAddress, cause: Cause, is_gone: bool },
    /// NDL found a node.
    NodeFound { node: NodeAddress, incarnation: Incarnation },
    /// A node is lost, or left: why.
    NodeLost { node: NodeAddress, incarnation: Incarnation, why: Cow<'static, str> },
    /// Messages can flow to a node.
    LinkUp { node: NodeAddress, incarnation: Incarnation },
    /// They cannot any more.
    LinkBroken { node: NodeAddress, incarnation: Incarnation },
    /// Another node says whom it watches here.
    Watch { from: NodeAddress, watch: Watch },
    /// Another node says how those live whom we watch there.
    Lives { from: NodeAddress, lives: Lives },
    /// The watcher's mailbox was full.
    NotTaken { watcher: AppAddress, down: Down },
    /// The time of [`Core::next_wake`] has come.
    TimePassed,
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Output {
    /// Tell an application of this node.
    Tell { watcher: AppAddress, down: Down },
    /// Tell another node whom we watch there.
    Watch { to: NodeAddress, watch: Watch },
    /// Tell another node how those live whom it watches here.
    Lives { to: NodeAddress, lives: Lives },
}

/// A `Down` whose time has not come, or that was not taken. It counts as a monitor.
#[derive(Debug)]
struct Waiting {
    until: Time,
    watcher: AppAddress,
    down: Down,
}

/// The monitors of a node, and those of other nodes on its applications.
#[derive(Debug)]
pub(crate) struct Core {
    node: NodeAddress,
    incarnation: Incarnation,
    watched_max: usize,
    watched: Watched,
    watching: Watching,
    pace: Pace,
    waiting: Vec<Waiting>,
    wake: Option<Time>,
    outputs: VecDeque<Output>,
}

impl Core {
    /// The monitors of `node`, none yet. It knows at most `nodes_max` others; its words have at most `words_bytes_max`.
    pub(crate) fn new(
        node: NodeAddress,
        incarnation: Incarnation,
        nodes_max: usize,
        words_bytes_max: usize,
    ) -> Self {
        Self {
            node,
            incarnation,
            watched_max: watched_max(words_bytes_max),
            watched: Watched::new(nodes_max),
            watching: Watching::new(nodes_max),
            pace: Pace::default(),
            waiting: Vec::new(),
            wake: None,
            outputs: VecDeque::new(),
        }
    }

    /// Lets the application `watcher` of this node watch the present life of `target`.
    ///
    /// # Errors
    /// Why not; nothing changed.
    pub(crate) fn monitor(
        &mut self,
        now: Time,
        watcher: AppAddress,
        target: Tid,
    ) -> Result<MonitorId, MonitorError> {
        if !target.node.is_single() || !(target.app.is_fixed() || target.app.is_dynamic()) {
            return Err(MonitorError::NotOne(target));
        }
        self.check_room(watcher)?;
        if target.node == self.node {
            let id = self.watching.add(watcher, target, now);
            match self.watched.life_of(target.app) {
                // spec: MON-1
                Some(life) => self.watching.establish(id, life),
                None => self.answer_nobody(id, &nobody(), now),
            }
            return Ok(id);
        }
        if self.watching.targets_on(target.node) >= self.watched_max && !self.watching.is_watched(target) {
            return Err(MonitorError::PeerFull(self.watched_max));
        }
        let id = self.watching.add(watcher, target, now);
        if !self.watching.make_due(target.node, now) {
            // spec: MON-2
            self.answer_nobody(id, &lost_node("its node is not known"), now);
        }
        self.publish(now);
        Ok(id)
    }

    /// Ends a monitor of `watcher`. `false` if there is none, or if its `Down` was told already.
    pub(crate) fn demonitor(&mut self, now: Time, watcher: AppAddress, id: MonitorId) -> bool {
        let before = self.waiting.len();
        self.waiting.retain(|waiting| waiting.watcher != watcher || waiting.down.monitor != id);
        let target = self.watching.remove_of(watcher, id);
        if let Some(target) = target {
            self.watching.make_due(target.node, now);
            self.publish(now);
        }
        target.is_some() || self.waiting.len() < before
    }

    /// Takes in what has happened.
    pub(crate) fn handle(&mut self, now: Time, input: Input) {
        match input {
            Input::Began { app } => self.watched.began(now, app, Whose::Own),
            Input::GuestBegan { app } => self.watched.began(now, app, Whose::Guest),
            Input::Ended { app, cause, is_gone } => self.life_ended(now, app, &cause, is_gone),
            Input::NodeFound { node, incarnation } => {
                self.node_is(node, incarnation);
                self.watching.found(node, incarnation);
            }
            Input::NodeLost { node, incarnation, why } => {
                self.end_all_on(node, Some(incarnation), &why);
                self.watched.forget_node(node, incarnation);
                self.watching.lost(node, incarnation);
            }
            Input::LinkUp { node, incarnation } => {
                self.node_is(node, incarnation);
                self.watching.link_up(now, node, incarnation);
            }
            Input::LinkBroken { node, incarnation } => self.watching.link_broken(now, node, incarnation),
            Input::Watch { from, watch } => self.watch_received(now, from, watch),
            Input::Lives { from, lives } => self.lives_received(now, from, &lives),
            // Nothing is offered again here: others are being told, and whoever tells them would not come to an end.
            Input::NotTaken { watcher, down } => return self.keep(now + RETRY, watcher, down),
            Input::TimePassed => {}
        }
        self.tell_the_waiting(now);
        for node in self.watching.orphans(now) {
            self.end_all_on(node, None, "its link broke and was not made again");
        }
        self.publish(now);
    }

    /// The next thing to be done; take until there is none.
    pub(crate) fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// Whether there is something to be done.
    pub(crate) fn has_orders(&self) -> bool {
        !self.outputs.is_empty()
    }

    /// When to come back.
    pub(crate) fn next_wake(&self) -> Option<Time> {
        [self.wake, self.watching.next_due()].into_iter().flatten().min()
    }

    fn check_room(&self, watcher: AppAddress) -> Result<(), MonitorError> {
        // spec: MON-6
        let waiting = self.waiting.iter().filter(|waiting| waiting.watcher == watcher).count();
        if self.watching.count_of(watcher) + waiting >= PER_WATCHER_MAX {
            return Err(MonitorError::TooMany(PER_WATCHER_MAX));
        }
        if self.watching.len() + self.waiting.len() >= MONITORS_MAX {
            return Err(MonitorError::NodeFull(MONITORS_MAX));
        }
        Ok(())
    }

    fn life_ended(&mut self, now: Time, app: AppAddress, cause: &Cause, is_gone: bool) {
        let Some(life) = self.watched.ended(now, app, cause, is_gone) else { return };
        // spec: MON-5
        self.waiting.retain(|waiting| waiting.watcher != app);
        self.pace.forget(app);
        for target in self.watching.remove_watcher(app) {
            self.watching.make_due(target.node, now);
        }
        for id in self.watching.of(Tid::new(self.node, app)) {
            self.end(id, cause);
        }
        crate::log::trace!(%app, life, "a life ended");
        let state = self.watched.state(now, app);
        for to in self.watched.watchers_of(app) {
            self.say_lives(to, vec![state.clone()]);
        }
    }

    /// This life of `node` is there: what was said of another is over.
    fn node_is(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(former) = self.watching.former_life(node, incarnation) {
            self.end_all_on(node, Some(former), "its node was restarted");
            self.watched.forget_node(node, former);
        }
    }

    fn end_all_on(&mut self, node: NodeAddress, life: Option<Incarnation>, why: &str) {
        if life.is_some_and(|life| !self.watching.is_about(node, life)) {
            return;
        }
        for id in self.watching.on(node) {
            self.end(id, &lost_node(why));
        }
    }

    fn end(&mut self, id: MonitorId, cause: &Cause) {
        if let Some((watcher, down)) = self.take_down(id, cause) {
            self.outputs.push_back(Output::Tell { watcher, down });
        }
    }

    /// Ends a monitor that no life has to end for. Who sets the next one in each `Down` would be told without end, ahead of
    /// all messages: it is told at its pace.
    fn answer_nobody(&mut self, id: MonitorId, cause: &Cause, now: Time) {
        // spec: MON-8
        let Some((watcher, down)) = self.take_down(id, cause) else { return };
        match self.pace.next(watcher, now) {
            Some(until) => self.keep(until, watcher, down),
            None => self.outputs.push_back(Output::Tell { watcher, down }),
        }
    }

    fn take_down(&mut self, id: MonitorId, cause: &Cause) -> Option<(AppAddress, Down)> {
        let (watcher, tid) = self.watching.remove(id)?;
        Some((watcher, Down { monitor: id, tid, class: cause.class, why: cause.why().to_owned() }))
    }

    fn watch_received(&mut self, now: Time, from: NodeAddress, watch: Watch) {
        if self.watching.linked(from).is_some_and(|life| life != watch.incarnation) {
            return;
        }
        if let Some(apps) = self.watched.watch(from, watch) {
            let states = apps.into_iter().map(|app| self.watched.state(now, app)).collect();
            self.say_lives(from, states);
        }
    }

    fn say_lives(&mut self, to: NodeAddress, lives: Vec<LifeState>) {
        let version = self.watched.next_version();
        let lives = Lives { incarnation: self.incarnation, version, lives };
        self.outputs.push_back(Output::Lives { to, lives });
    }

    fn lives_received(&mut self, now: Time, from: NodeAddress, lives: &Lives) {
        if self.watching.linked(from) != Some(lives.incarnation) {
            return;
        }
        for state in &lives.lives {
            let monitors = self.watching.of(Tid::new(from, state.app));
            if monitors.is_empty() {
                // It does not know yet that we do not watch this one any more.
                self.watching.make_due(from, now);
            }
            for id in monitors {
                if let Some(cause) = self.watching.judge(id, lives.version, state, now) {
                    match cause.class {
                        DownClass::NoSuchAddress => self.answer_nobody(id, &cause, now),
                        DownClass::Normal
                        | DownClass::Shutdown
                        | DownClass::Panic
                        | DownClass::Hung
                        | DownClass::Killed
                        | DownClass::ProcessEnded
                        | DownClass::NodeLost => self.end(id, &cause),
                    }
                    self.watching.make_due(from, now);
                }
            }
        }
    }

    fn keep(&mut self, until: Time, watcher: AppAddress, down: Down) {
        self.waiting.push(Waiting { until, watcher, down });
        self.wake = Some(self.wake.map_or(until, |wake| wake.min(until)));
    }

    fn tell_the_waiting(&mut self, now: Time) {
        if self.wake.is_none_or(|wake| wake > now) {
            return;
        }
        let due = self.waiting.extract_if(.., |waiting| waiting.until <= now);
        self.outputs.extend(due.map(|Waiting { watcher, down, .. }| Output::Tell { watcher, down }));
        self.wake = self.waiting.iter().map(|waiting| waiting.until).min();
    }

    fn publish(&mut self, now: Time) {
        for (to, version, apps) in self.watching.take_due(now) {
            let watch = Watch { incarnation: self.incarnation, version, apps };
            self.outputs.push_back(Output::Watch { to, watch });
        }
    }
}

fn nobody() -> Cause {
    Cause::new(DownClass::NoSuchAddress, "no application has this TID")
}

fn lost_node(why: &str) -> Cause {
    Cause::new(DownClass::NodeLost, why)
}
