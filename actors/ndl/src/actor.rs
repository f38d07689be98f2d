//! The shell around the membership core: sockets, timer, mDNS, and the connections to other layers.

mod announcing;
mod delivery;
mod leave;
mod mdns_presence;
mod paths;
mod progress;
mod receiving;
mod remembered_peers;

use std::{
    cell::RefCell,
    collections::BTreeSet,
    future::poll_fn,
    hash::{BuildHasher, RandomState},
    io,
    net::{SocketAddr, SocketAddrV6},
    rc::Rc,
    sync::{Arc, MutexGuard, PoisonError, atomic::Ordering},
    task::Poll,
};

use actix::{Actor, ActorContext, AsyncContext, Context, StreamHandler, WrapFuture};
use futures_util::{StreamExt as _, stream::FuturesUnordered};
use sinew_runtime::{
    alarm::Alarm,
    lock,
    remedy::{Wanted, may_come_later, remedy},
    supervision::ReadyGate,
    tid::{Incarnation, NodeAddress},
    time::Time,
};
use tokio::sync::{Notify, mpsc};

pub use self::leave::send_leaves;
use sinew_model::{
    address::LocalAddress, config::NodeConfig, events::LayerReport, ports::NodeIncarnation,
    refusals::Refusals,
};

use self::{
    announcing::announced,
    paths::{Paths, Reader},
    progress::NextRequest,
    receiving::ReadLimiter,
};
use super::{
    Event, check_period,
    core::{Core, Epoch, Input, Output, Place},
    datagram::{Answer, Body, Datagram, Leave, encode},
    interfaces::{self, Usable},
    probe::{PROBES_MAX, Probe},
};
use crate::State;

/// Creates the core of a node that has just started, without members, for the node's state.
pub fn new_core(config: &NodeConfig, node: NodeAddress, incarnation: Incarnation) -> Core {
    // The standard library seeds its hashers from the system's random source.
    let draw = |name: &str| RandomState::new().hash_one(name);
    let secret = u128::from(draw("upper")) << 64 | u128::from(draw("lower"));
    Core::new(config, node, incarnation, draw("boot nonce"), secret)
}

/// The Node Discovery Layer.
pub struct NdlActor {
    state: Arc<State>,
    ready: Option<ReadyGate>,
    shell: Option<Rc<Shell>>,
}

impl NdlActor {
    /// Creates an instance that continues with the members in the state.
    pub const fn new(state: Arc<State>, ready: ReadyGate) -> Self {
        Self { state, ready: Some(ready), shell: None }
    }

    /// Opens the sockets, and starts the discovery.
    ///
    /// # Errors
    /// Returns the system's error with its remedy.
    fn begin(&mut self, ctx: &mut Context<Self>) -> Result<(), String> {
        let (shell, readers) = Shell::bind(self.state.clone())?;
        let shell = Rc::new(shell);
        for reader in readers {
            let reading = shell.reading(reader);
            let reading = reading.map_err(|error| {
                let remedy = remedy(Wanted::Descriptor, &error);
                format!("NDL's socket cannot be watched: {error}; {remedy}")
            })?;
            ctx.spawn(reading.into_actor(self));
        }
        // Sends the first queries.
        shell.execute_outputs();
        let chosen = &self.state.ctx.config.ndl.interface;
        let only = if chosen.are_ipv4_addresses() && chosen.iter().count() == 1 {
            shell.paths.here().first().copied()
        } else {
            None
        };
        if let Some(here) = only {
            // The only path is open, and no path is added or removed.
            ctx.spawn(mdns_presence::keep_mdns(shell.clone(), here).into_actor(self));
        } else {
            let news = (!chosen.are_ipv4_addresses()).then(|| interfaces::watch(chosen.clone()));
            let news = news.transpose().map_err(|error| {
                let remedy = remedy(Wanted::Thread, &error);
                format!("NDL has no thread to see interfaces with: {error}; {remedy}")
            })?;
            ctx.spawn(paths::keep_paths(shell.clone(), news).into_actor(self));
        }
        if let Some(probes) = shell.probes.borrow_mut().take() {
            ctx.spawn(probe_hosts(shell.clone(), probes).into_actor(self));
        }
        ctx.spawn(remembered_peers::keep(shell.clone()).into_actor(self));
        ctx.spawn(progress::watch(shell.clone()).into_actor(self));
        if let Some(links) = self.state.ctx.ports.links() {
            ctx.spawn(links.deliver_held_events().into_actor(self));
        }
        // The reactor's own sleep has ticks of a millisecond. It made each check late by one to two, and each
        // loss twice as much.
        let alarm = Alarm::new().map_err(|error| {
            let remedy = remedy(Wanted::Descriptor, &error);
            format!("NDL gets no timer of the kernel's (timerfd): {error}; {remedy}")
        })?;
        ctx.spawn(keep_time(shell.clone(), alarm).into_actor(self));
        ctx.spawn(delivery::offer_later(shell.clone()).into_actor(self));
        ctx.spawn(delivery::deliver_node_events(shell.clone()).into_actor(self));
        self.shell = Some(shell);
        if let Some(ready) = self.ready.take() {
            ready.reached();
        }
        Ok(())
    }
}

impl Actor for NdlActor {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.add_stream(self.state.ctx.event_queues.ndl.attach_keeping(Clone::clone));
        if let Err(why) = self.begin(ctx) {
            self.state.ctx.cannot_start(why);
        }
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        // Only when the node stops: a layer that is restarted must not look like a node that left.
        if let Some(shell) = &self.shell
            && self.state.ctx.stopping.load(Ordering::Acquire)
        {
            shell.feed(|core, now| core.handle(now, Input::Stopping));
            lock(&self.state.sockets).close_all();
        }
    }
}

impl StreamHandler<Event> for NdlActor {
    fn handle(&mut self, event: Event, _: &mut Self::Context) {
        let input = match event {
            Event::Link(fact) => Input::Link(fact),
            Event::App(fact) => {
                delivery::forget_events(&self.state, &fact);
                Input::AppChanged(fact)
            }
        };
        if let Some(shell) = &self.shell {
            shell.feed(|core, now| core.handle(now, input));
        }
        self.state.ctx.app_backlogs.offer_to_ndl(&self.state.ctx.event_queues);
    }

    fn finished(&mut self, ctx: &mut Self::Context) {
        // A later instance reads the event queue now.
        ctx.stop();
    }
}

/// The state shared by the tasks of one instance.
struct Shell {
    state: Arc<State>,
    epoch: Epoch,
    paths: Paths,
    /// Notifies the timer that the core's next wake has changed.
    rewind: Notify,
    /// Notified when the remembered peers have changed.
    remembered_changed: Notify,
    /// Notified when a layer had no room for an event.
    has_pending: Notify,
    refusals: Arc<Refusals>,
    /// Hosts to probe. A probe that does not fit is dropped.
    to_probe: mpsc::Sender<Probe>,
    /// The receiving end, until the probing task takes it.
    probes: RefCell<Option<mpsc::Receiver<Probe>>>,
    /// Rate limit for the reads of all sockets together.
    reads: RefCell<ReadLimiter>,
    /// When the root is asked next.
    next_request: NextRequest,
}

impl Shell {
    /// Binds the sockets, and starts the core. Returns the sockets to read.
    fn bind(state: Arc<State>) -> Result<(Self, Vec<Reader>), String> {
        if state.ctx.listens.first.get().is_none() {
            return Err("NDL has no GNCL to announce: start GNCL before NDL".to_owned());
        }
        let (chosen, port, paths) =
            (&state.ctx.config.ndl.interface, state.ctx.config.ndl.port, Paths::default());
        let addresses: Vec<_> = chosen.addresses().map(LocalAddress::from).collect();
        let (readers, unopened) = paths.open(&state, &addresses);
        // A missing address may appear later. If there are several, each may be opened later, after any error.
        let is_final = |error: &io::Error| chosen.iter().count() == 1 && !may_come_later(error);
        if let Some((_, error)) = unopened.first().filter(|(_, error)| is_final(error)) {
            let remedy = remedy(Wanted::Port("ndl.port"), error);
            return Err(format!("NDL cannot use UDP {chosen}:{port}: {error}; {remedy}"));
        }
        // Read before the core's links are updated: later changes of GNCL are in NDL's event queue.
        let links = links(&state);
        let epoch = {
            let mut core = lock_core(&state);
            core.check_links(Time::now(), |node, incarnation| links.contains(&(node, incarnation)));
            let expected: Vec<_> = addresses.iter().map(|local| local.at(0)).collect();
            core.announce_gncl(announced(&state, &expected));
            core.use_seeds(Time::now(), seeds(&state, None));
            core.start(Time::now(), &paths.here())
        };
        let (rewind, has_pending, refusals) = (Notify::new(), Notify::new(), state.ctx.refusals.clone());
        let (to_probe, probes) = mpsc::channel(PROBES_MAX);
        let (probes, reads) = (RefCell::new(Some(probes)), RefCell::new(ReadLimiter::new()));
        let (remembered_changed, next_request) =
            (Notify::new(), NextRequest::new(check_period(&state.ctx.config.ndl)));
        let shell = Self {
            state,
            epoch,
            paths,
            rewind,
            remembered_changed,
            has_pending,
            refusals,
            to_probe,
            probes,
            reads,
            next_request,
        };
        Ok((shell, readers))
    }

    /// Gives the core an input and executes its outputs. Returns `false` if a later instance has taken over.
    fn feed(&self, input: impl FnOnce(&mut Core, Time)) -> bool {
        let (wake_moved, remembered_changed) = {
            let mut core = lock_core(&self.state);
            if !core.is_current(self.epoch) {
                return false;
            }
            let (wake, changes) = (core.next_wake(), core.remembered_changes());
            input(&mut core, Time::now());
            (core.next_wake() != wake, core.remembered_changes() != changes)
        };
        self.execute_outputs();
        if wake_moved {
            self.rewind.notify_one();
        }
        if remembered_changed {
            self.remembered_changed.notify_one();
        }
        true
    }

    fn execute_outputs(&self) {
        loop {
            // The lock is not held while an output is executed.
            let Some(output) = self.next_output() else { return };
            self.execute(output);
        }
    }

    fn execute(&self, output: Output) {
        match output {
            Output::SendQuery { to, correlation } => self.send_query(to, correlation),
            Output::SendMulticastQuery { from, correlation } => {
                let groups = super::socket::Groups::from(&self.state.ctx.config.ndl);
                for here in from {
                    if let Some(there) = groups.of(here.ip()) {
                        self.send_query(Place { there, here }, correlation);
                    }
                }
            }
            Output::SendAnswer { to, node, correlation, query_sent, query_received } => {
                let (announcement, progress) = {
                    let core = lock_core(&self.state);
                    (core.announcement().clone(), core.progress().clone())
                };
                let (query_sent_ns, query_received_ns) = (query_sent.as_nanos(), query_received.as_nanos());
                let answer = Answer { announcement, query_sent_ns, query_received_ns, progress };
                self.send(to, node, correlation, Body::Answer(answer));
            }
            Output::SendLeave { to, node } => {
                let gave_up = self.state.ctx.gave_up.get().cloned();
                self.send(to, node, 0, Body::Leave(Leave { announcement: self.me(), gave_up }));
            }
            Output::Probe { node, incarnation, to, within, requested } => {
                self.request_liveness((node, incarnation));
                // If too many nodes are silent at once, the fault is not in their hosts.
                let _ = self.to_probe.try_send(Probe { node, incarnation, to, within, requested });
            }
            Output::RequestLiveness { node, incarnation } => {
                self.request_liveness((node, incarnation));
            }
            Output::Fact(fact) => self.report_fact(&fact),
            Output::Moved { node, gncl, .. } => self.report_move(node, &gncl),
            Output::Forgotten { node, incarnation } => {
                sinew_runtime::log::warn!(%node, life = %incarnation, "the node is present in an earlier incarnation than this one: its clock went back");
                self.offer_to_layers();
            }
            Output::Event { to, event } => self.notify_application(to, event),
            Output::ClockMeasured { node, incarnation, offset } => {
                self.state.ctx.clocks.set(node, incarnation, offset);
            }
            Output::Collision { node, holder, newcomer } => sinew_runtime::log::error!(
                "node address {node} is used twice: by {holder}, and by {newcomer}, which is rejected; give one of \
                 them another `address`"
            ),
            Output::AddressTaken { holder } => self.end_node(format!(
                "node address {} is used already by '{}' at {}; give this node another `node.address`, or \
                 end the other one",
                self.state.ctx.node, holder.name, holder.at
            )),
            Output::Stalled { late } => sinew_runtime::log::warn!(
                late_ms = late.as_millis(),
                "this node did not run for {} ms: its process was stopped, or had no CPU; of such cycles only one in four counts missed answers of others",
                late.as_millis()
            ),
        }
    }

    /// Ends the node. The root ends it without a retry, because a later instance would find the same conflict.
    // spec: NDL-5.5
    fn end_node(&self, words: String) {
        let root = &self.state.ctx.root;
        // If the root's event queue is full, the supervisor notifies the root after restarts.
        if let Err(LayerReport::AddressTaken(words)) = root.report(LayerReport::AddressTaken(words))
            && !root.has_ended()
        {
            panic!("{words}");
        }
    }

    fn request_liveness(&self, incarnation: NodeIncarnation) {
        if let Some(links) = self.state.ctx.ports.links() {
            links.request_liveness(incarnation);
        }
    }

    fn me(&self) -> super::datagram::Announcement {
        lock_core(&self.state).announcement().clone()
    }

    fn send_query(&self, to: Place, correlation: u64) {
        self.send(to, NodeAddress::ALL, correlation, Body::Query(self.me()));
    }

    fn send(&self, to: Place, node: NodeAddress, correlation: u64, body: Body) {
        // The send time is taken last: the time between it and the network counts as network time.
        let mut bytes = encode(&Datagram { correlation, sent: Time::now(), body }, node);
        if let Some(secured) = self.state.security.secured.get() {
            secured.seal(&mut bytes);
        }
        if let Err(error) = self.paths.send(to.here, &bytes, to.there) {
            let what = format_args!("from {} to {}: {error}", to.here, to.there);
            self.refusals.count(Time::now(), "NDL datagram not sent", &what);
        }
    }
}

pub(super) fn lock_core(state: &State) -> MutexGuard<'_, Core> {
    state.core.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the incarnations of nodes with an established connection.
fn links(state: &State) -> BTreeSet<(NodeAddress, Incarnation)> {
    state.ctx.ports.links().map_or_else(BTreeSet::new, |links| links.connected())
}

/// Returns GNCL's last receipts from the members in doubt. The locks of NDL and of GNCL are never held together.
fn liveness_hints(state: &State) -> Vec<Input> {
    let Some(links) = state.ctx.ports.links() else { return Vec::new() };
    let in_doubt = lock_core(state).in_doubt();
    let hint = |(node, incarnation)| {
        let at = links.last_alive((node, incarnation))?;
        Some(Input::HintReceived { node, incarnation, at })
    };
    in_doubt.into_iter().filter_map(hint).collect()
}

/// Returns the seeds to query. A seed on the link of a missing interface waits for the interface. If
/// interfaces are not watched, or the zone does not apply, the seed is queried from everywhere.
fn seeds(state: &State, usable: Option<&Usable>) -> Vec<SocketAddr> {
    let seeds = state.ctx.config.ndl.seeds.iter().filter_map(|seed| {
        let (SocketAddr::V6(at), Some(zone)) = (seed.address, &seed.zone) else { return Some(seed.address) };
        if !at.ip().is_unicast_link_local() || state.ctx.config.ndl.interface.are_ipv4_addresses() {
            return Some(seed.address);
        }
        let numbers = &usable?.numbers;
        let is_number = |number: &u32| numbers.values().any(|known| known == number);
        let number = numbers.get(zone).copied().or_else(|| zone.parse().ok().filter(is_number))?;
        Some(SocketAddrV6::new(*at.ip(), at.port(), 0, number).into())
    });
    seeds.collect()
}

/// Probes many hosts at once.
async fn probe_hosts(shell: Rc<Shell>, mut requests: mpsc::Receiver<Probe>) {
    let mut under_way = FuturesUnordered::new();
    loop {
        tokio::select! {
            Some(probe) = requests.recv(), if under_way.len() < PROBES_MAX => under_way.push(probe.run()),
            Some(probed) = under_way.next() => {
                if !shell.feed(|core, now| core.handle(now, probed)) {
                    return;
                }
            }
            // Unreachable while the shell holds the other end.
            else => return,
        }
    }
}

async fn keep_time(shell: Rc<Shell>, mut alarm: Alarm) {
    loop {
        let wake = lock_core(&shell.state).next_wake();
        let next = [wake, shell.next_request.due()].into_iter().flatten().min();
        tokio::select! {
            () = reached(&mut alarm, next) => {}
            () = shell.rewind.notified() => continue,
        }
        let now = Time::now();
        shell.next_request.time_passed(now);
        if wake.is_none_or(|wake| now < wake) {
            continue;
        }
        let hints = liveness_hints(&shell.state);
        let time_passed = |core: &mut Core, now| {
            hints.into_iter().for_each(|hint| core.handle(now, hint));
            core.handle(now, Input::TimePassed);
        };
        if !shell.feed(time_passed) {
            return;
        }
    }
}

/// Waits until this time. With `None` it never ends.
async fn reached(alarm: &mut Alarm, at: Option<Time>) {
    poll_fn(|context| {
        if at.is_some_and(|at| Time::now() >= at) {
            return Poll::Ready(());
        }
        alarm.wake_at(at, context).expect("a timer that was made takes a time");
        Poll::Pending
    })
    .await;
}

/// Binds the sockets as a start does, and returns the error text.
#[cfg(test)]
pub(super) fn start_words(state: Arc<State>) -> Result<(), String> {
    Shell::bind(state).map(drop)
}
