//! The monitor core: which application monitors which target. It has no clock and no socket; it takes inputs
//! and returns outputs.
//!
//! After each [`Core::handle`] and [`Core::monitor`] the shell calls [`Core::poll`] until it returns `None`.
//! At [`Core::next_wake`] it passes [`Input::TimePassed`].

mod down_limiter;
mod watched;
mod watching;

use std::{borrow::Cow, collections::VecDeque, time::Duration};

use sinew_model::cause::Cause;
use sinew_runtime::{
    monitor::{Down, DownClass, MonitorError, MonitorId},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
};

use self::{
    down_limiter::DownLimiter,
    watched::{Owner, Watched},
    watching::Watching,
};
use super::protocol::{LifeState, Lives, Watch, watched_max};

/// Time between two WATCH lists to one node when nothing changes.
pub(super) const REPEAT: Duration = Duration::from_secs(2);
/// Minimum time between two WATCH lists to one node.
pub(super) const SPACING: Duration = Duration::from_millis(5);
/// Time after which a node counts as lost if its link is down and NDL never reported it.
pub(super) const ORPHAN: Duration = Duration::from_secs(10);
/// Maximum number of monitors of one application.
pub(super) const PER_WATCHER_MAX: usize = 256;
/// Time that each report of a missing application costs its watcher, after the first [`PER_WATCHER_MAX`]
/// reports.
pub(super) const MISSING_INTERVAL: Duration = Duration::from_millis(10);
/// Maximum number of monitors of a node.
pub(super) const MONITORS_MAX: usize = 4_096;

/// An event that the core handles.
#[derive(Clone, Debug)]
pub enum Input {
    /// An application of this node got its address.
    Started { app: AppAddress },
    /// A guest got its address. A guest is an application of another user that the access list permits.
    GuestStarted { app: AppAddress },
    /// A life of the application ended. The application is restarted, or is removed (`is_gone`).
    Ended { app: AppAddress, cause: Cause, is_gone: bool },
    /// NDL found a node.
    NodeFound { node: NodeAddress, incarnation: Incarnation },
    /// A node was lost, or left, with the reason.
    NodeLost { node: NodeAddress, incarnation: Incarnation, why: Cow<'static, str> },
    /// The link to a node is up.
    LinkUp { node: NodeAddress, incarnation: Incarnation },
    /// The link to a node is broken.
    LinkBroken { node: NodeAddress, incarnation: Incarnation },
    /// Another node sent the list of applications that it monitors here.
    Watch { from: NodeAddress, watch: Watch },
    /// Another node sent the states of applications that this node monitors there.
    Lives { from: NodeAddress, lives: Lives },
    /// The watcher's mailbox rejected the `Down`.
    DownRejected { watcher: AppAddress, down: Down },
    /// An application with a full mailbox has room again, or may have: a new shell begins with this.
    RoomMade,
    /// The time of [`Core::next_wake`] has been reached.
    TimePassed,
}

/// An action for the shell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Output {
    /// Send a `Down` to an application of this node.
    Notify { watcher: AppAddress, down: Down },
    /// Send to another node the list of applications that this node monitors there.
    Watch { to: NodeAddress, watch: Watch },
    /// Send to another node the states of applications that it monitors here.
    Lives { to: NodeAddress, lives: Lives },
}

/// A `Down` that is delayed or was rejected. It counts as a monitor.
#[derive(Debug)]
struct PendingDown {
    /// `None`: until an application has room again.
    until: Option<Time>,
    watcher: AppAddress,
    down: Down,
}

/// The monitors of a node, and the monitors of other nodes on its applications.
#[derive(Debug)]
pub struct Core {
    node: NodeAddress,
    incarnation: Incarnation,
    watched_max: usize,
    watched: Watched,
    watching: Watching,
    downs: DownLimiter,
    pending: Vec<PendingDown>,
    wake: Option<Time>,
    outputs: VecDeque<Output>,
}

impl Core {
    /// Returns a core without monitors for `node`. It tracks at most `nodes_max` other nodes; its frames have
    /// at most `frame_bytes_max` bytes.
    pub fn new(
        node: NodeAddress,
        incarnation: Incarnation,
        nodes_max: usize,
        frame_bytes_max: usize,
    ) -> Self {
        Self {
            node,
            incarnation,
            watched_max: watched_max(frame_bytes_max),
            watched: Watched::new(nodes_max),
            watching: Watching::new(nodes_max),
            downs: DownLimiter::new(),
            pending: Vec::new(),
            wake: None,
            outputs: VecDeque::new(),
        }
    }

    /// Sets a monitor of the local application `watcher` on the current life of `target`.
    ///
    /// # Errors
    /// Returns the reason if the monitor cannot be set; nothing changed.
    pub fn monitor(
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
                None => self.report_missing(id, &no_such_address(), now),
            }
            return Ok(id);
        }
        if self.watching.targets_on(target.node) >= self.watched_max && !self.watching.is_watched(target) {
            return Err(MonitorError::PeerFull(self.watched_max));
        }
        let id = self.watching.add(watcher, target, now);
        if !self.watching.make_due(target.node, now) {
            // spec: MON-2
            self.report_missing(id, &lost_node("its node is not known"), now);
        }
        self.publish(now);
        Ok(id)
    }

    /// Removes a monitor of `watcher`. Returns `false` if it does not exist, or if its `Down` was already
    /// sent.
    pub fn demonitor(&mut self, now: Time, watcher: AppAddress, id: MonitorId) -> bool {
        let before = self.pending.len();
        self.pending.retain(|pending| pending.watcher != watcher || pending.down.monitor != id);
        let target = self.watching.remove_of(watcher, id);
        if let Some(target) = target {
            self.watching.make_due(target.node, now);
            self.publish(now);
        }
        target.is_some() || self.pending.len() < before
    }

    /// Handles an input.
    pub fn handle(&mut self, now: Time, input: Input) {
        match input {
            Input::Started { app } => self.watched.started(now, app, Owner::Own),
            Input::GuestStarted { app } => self.watched.started(now, app, Owner::Guest),
            Input::Ended { app, cause, is_gone } => self.life_ended(now, app, &cause, is_gone),
            Input::NodeFound { node, incarnation } => {
                self.set_incarnation(node, incarnation);
                self.watching.found(node, incarnation);
            }
            Input::NodeLost { node, incarnation, why } => {
                self.end_all_on(node, Some(incarnation), &why);
                self.watched.forget_node(node, incarnation);
                self.watching.lost(node, incarnation);
            }
            Input::LinkUp { node, incarnation } => {
                self.set_incarnation(node, incarnation);
                self.watching.link_up(now, node, incarnation);
            }
            Input::LinkBroken { node, incarnation } => self.watching.link_broken(now, node, incarnation),
            Input::Watch { from, watch } => self.watch_received(now, from, watch),
            Input::Lives { from, lives } => self.lives_received(now, from, &lives),
            // A rejected `Down` is not sent again here. The caller is sending others, and its loop would not
            // terminate.
            Input::DownRejected { watcher, down } => return self.store_down(None, watcher, down),
            Input::RoomMade => self.send_pending(|until| until.is_none()),
            Input::TimePassed => {}
        }
        self.send_due(now);
        for node in self.watching.orphans(now) {
            self.end_all_on(node, None, "its link broke and was not restored");
        }
        self.publish(now);
    }

    /// Returns the next output. The caller repeats this until it returns `None`.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// Returns whether outputs are pending.
    pub fn has_outputs(&self) -> bool {
        !self.outputs.is_empty()
    }

    /// Returns the time of the next `Input::TimePassed`.
    pub fn next_wake(&self) -> Option<Time> {
        [self.wake, self.watching.next_due()].into_iter().flatten().min()
    }

    fn check_room(&self, watcher: AppAddress) -> Result<(), MonitorError> {
        // spec: MON-6
        let pending = self.pending.iter().filter(|pending| pending.watcher == watcher).count();
        if self.watching.count_of(watcher) + pending >= PER_WATCHER_MAX {
            return Err(MonitorError::TooMany(PER_WATCHER_MAX));
        }
        if self.watching.len() + self.pending.len() >= MONITORS_MAX {
            return Err(MonitorError::NodeFull(MONITORS_MAX));
        }
        Ok(())
    }

    fn life_ended(&mut self, now: Time, app: AppAddress, cause: &Cause, is_gone: bool) {
        let Some(life) = self.watched.ended(now, app, cause, is_gone) else { return };
        // spec: MON-5
        self.pending.retain(|pending| pending.watcher != app);
        self.downs.forget(app);
        for target in self.watching.remove_watcher(app) {
            self.watching.make_due(target.node, now);
        }
        for id in self.watching.of(Tid::new(self.node, app)) {
            self.end(id, cause);
        }
        sinew_runtime::log::trace!(%app, life, "a life ended");
        let state = self.watched.state(now, app);
        for to in self.watched.watchers_of(app) {
            self.send_lives(to, vec![state.clone()]);
        }
    }

    /// Records the current incarnation of `node`, and discards the state of an earlier incarnation.
    fn set_incarnation(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if let Some(former) = self.watching.earlier_incarnation(node, incarnation) {
            self.end_all_on(node, Some(former), "its node was restarted");
            self.watched.forget_node(node, former);
        }
    }

    fn end_all_on(&mut self, node: NodeAddress, incarnation: Option<Incarnation>, why: &str) {
        if incarnation.is_some_and(|incarnation| !self.watching.is_about(node, incarnation)) {
            return;
        }
        for id in self.watching.on(node) {
            self.end(id, &lost_node(why));
        }
    }

    fn end(&mut self, id: MonitorId, cause: &Cause) {
        if let Some((watcher, down)) = self.take_down(id, cause) {
            self.outputs.push_back(Output::Notify { watcher, down });
        }
    }

    /// Ends a monitor of a target that does not exist. The `Down` is rate-limited. A watcher that sets a new
    /// monitor on each `Down` would otherwise receive them endlessly, ahead of all messages.
    fn report_missing(&mut self, id: MonitorId, cause: &Cause, now: Time) {
        // spec: MON-8
        let Some((watcher, down)) = self.take_down(id, cause) else { return };
        match self.downs.next(watcher, now) {
            Some(until) => self.store_down(Some(until), watcher, down),
            None => self.outputs.push_back(Output::Notify { watcher, down }),
        }
    }

    fn take_down(&mut self, id: MonitorId, cause: &Cause) -> Option<(AppAddress, Down)> {
        let (watcher, tid) = self.watching.remove(id)?;
        Some((watcher, Down { monitor: id, tid, class: cause.class, why: cause.why().to_owned() }))
    }

    fn watch_received(&mut self, now: Time, from: NodeAddress, watch: Watch) {
        if self.watching.linked(from).is_some_and(|linked| linked != watch.incarnation) {
            return;
        }
        if let Some(apps) = self.watched.watch(from, watch) {
            let states = apps.into_iter().map(|app| self.watched.state(now, app)).collect();
            self.send_lives(from, states);
        }
    }

    fn send_lives(&mut self, to: NodeAddress, lives: Vec<LifeState>) {
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
                // The peer does not know yet that this application is not monitored any more.
                self.watching.make_due(from, now);
            }
            for id in monitors {
                if let Some(cause) = self.watching.evaluate(id, lives.version, state, now) {
                    match cause.class {
                        DownClass::NoSuchAddress => self.report_missing(id, &cause, now),
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

    fn store_down(&mut self, until: Option<Time>, watcher: AppAddress, down: Down) {
        self.pending.push(PendingDown { until, watcher, down });
        self.wake = [self.wake, until].into_iter().flatten().min();
    }

    fn send_due(&mut self, now: Time) {
        if self.wake.is_none_or(|wake| wake > now) {
            return;
        }
        self.send_pending(|until| until.is_some_and(|until| until <= now));
        self.wake = self.pending.iter().filter_map(|pending| pending.until).min();
    }

    /// Sends the pending `Down`s that `is_one` selects.
    fn send_pending(&mut self, is_one: impl Fn(Option<Time>) -> bool) {
        let due = self.pending.extract_if(.., |pending| is_one(pending.until));
        self.outputs.extend(due.map(|PendingDown { watcher, down, .. }| Output::Notify { watcher, down }));
    }

    fn publish(&mut self, now: Time) {
        for (to, version, apps) in self.watching.take_due(now) {
            let watch = Watch { incarnation: self.incarnation, version, apps };
            self.outputs.push_back(Output::Watch { to, watch });
        }
    }
}

fn no_such_address() -> Cause {
    Cause::new(DownClass::NoSuchAddress, "no application has this TID")
}

fn lost_node(why: &str) -> Cause {
    Cause::new(DownClass::NodeLost, why)
}
