//! The thin shell around the membership core: sockets, timer, mDNS, and the ways to other layers.

mod announcing;
mod goodbye;
mod memory;
mod paths;
mod receiving;
mod speaking;
mod telling;

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
    time::Duration,
};

use actix::{Actor, ActorContext, AsyncContext, Context, StreamHandler, WrapFuture};
use futures_util::{StreamExt as _, stream::FuturesUnordered};
use sinew_runtime::{
    alarm::Alarm,
    remedy::{Wanted, may_come_later, remedy},
    supervision::ReadyGate,
    tid::{Incarnation, NodeAddress},
    time::Time,
};
use tokio::sync::{Notify, mpsc, oneshot};

pub(crate) use self::goodbye::say_goodbye;
use self::{
    announcing::announced,
    paths::{Paths, Reader},
    receiving::Pace,
};
use super::{
    Event,
    address::LocalAddress,
    core::{Core, Epoch, Input, Output, Place},
    datagram::{Answer, Body, Datagram, Leave, encode},
    interfaces::{self, Usable},
    look_period,
    probe::{PROBES_MAX, Probe},
    progress::{Progress, RootWatch},
};
use crate::{
    aftermath,
    config::NodeConfig,
    gncl, node,
    refusals::Refusals,
    stores::{self, Stores},
};

/// The core of a node that has just been started: it knows nobody. For the node's stores.
pub(crate) fn new_core(config: &NodeConfig, node: NodeAddress, incarnation: Incarnation) -> Core {
    // The standard library's hasher keys come from the system's random source.
    let draw = |what: &str| RandomState::new().hash_one(what);
    let secret = u128::from(draw("upper")) << 64 | u128::from(draw("lower"));
    Core::new(config, node, incarnation, draw("boot nonce"), secret)
}

/// The Node Discovery Layer.
pub(crate) struct NdlActor {
    stores: Arc<Stores>,
    ready: Option<ReadyGate>,
    shell: Option<Rc<Shell>>,
}

impl NdlActor {
    /// A new instance; it goes on with the members that the stores hold.
    pub(crate) const fn new(stores: Arc<Stores>, ready: ReadyGate) -> Self {
        Self { stores, ready: Some(ready), shell: None }
    }
}

impl Actor for NdlActor {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.add_stream(self.stores.posts.ndl.attach_keeping(Clone::clone));
        let (shell, readers) = Shell::bind(self.stores.clone()).unwrap_or_else(|words| give_up(&words));
        let shell = Rc::new(shell);
        for reader in readers {
            let reading = shell.reading(reader);
            let reading =
                reading.unwrap_or_else(|error| give_up(&format!("NDL's socket cannot be watched: {error}")));
            ctx.spawn(reading.into_actor(self));
        }
        // The first queries leave here.
        shell.carry_out();
        let chosen = &self.stores.config.ndl.interface;
        let only = if chosen.are_ipv4_addresses() && chosen.iter().count() == 1 {
            shell.paths.here().first().copied()
        } else {
            None
        };
        if let Some(here) = only {
            // It is open, and nothing comes and goes.
            ctx.spawn(speaking::speak_mdns(shell.clone(), here).into_actor(self));
        } else {
            let news = (!chosen.are_ipv4_addresses()).then(|| interfaces::watch(chosen.clone()));
            let news = news.transpose().unwrap_or_else(|error| {
                let remedy = remedy(Wanted::Thread, &error);
                give_up(&format!("NDL has no thread to see interfaces with: {error}; {remedy}"))
            });
            ctx.spawn(paths::keep_paths(shell.clone(), news).into_actor(self));
        }
        if let Some(probes) = shell.probes.borrow_mut().take() {
            ctx.spawn(try_hosts(shell.clone(), probes).into_actor(self));
        }
        ctx.spawn(memory::keep(shell.clone()).into_actor(self));
        ctx.spawn(watch_progress(shell.clone()).into_actor(self));
        ctx.spawn(aftermath::carry_on(self.stores.clone()).into_actor(self));
        ctx.spawn(keep_time(shell.clone()).into_actor(self));
        ctx.spawn(telling::tell_again(shell.clone()).into_actor(self));
        self.shell = Some(shell);
        if let Some(ready) = self.ready.take() {
            ready.reached();
        }
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        // Only when the node stops: a layer that is started anew must not look like a node that went.
        if let Some(shell) = &self.shell
            && self.stores.stopping.load(Ordering::Acquire)
        {
            shell.feed(|core, now| core.handle(now, Input::Stopping));
            stores::lock(&self.stores.ndl_sockets).close_all();
        }
    }
}

impl StreamHandler<Event> for NdlActor {
    fn handle(&mut self, event: Event, _: &mut Self::Context) {
        let input = match event {
            Event::Link(fact) => Input::Link(fact),
            Event::App(fact) => Input::AppChanged(fact),
        };
        if let Some(shell) = &self.shell {
            shell.feed(|core, now| core.handle(now, input));
        }
        self.stores.untold_of_apps.offer_to_ndl(&self.stores.posts);
    }

    fn finished(&mut self, ctx: &mut Self::Context) {
        // A later instance reads the post now.
        ctx.stop();
    }
}

/// The start fails: the supervisor reports these words, and tries again within its limit.
fn give_up(words: &str) -> ! {
    crate::log::error!("{words}");
    panic!("{words}");
}

/// What the tasks of one instance share.
struct Shell {
    stores: Arc<Stores>,
    epoch: Epoch,
    paths: Paths,
    /// The core's next wake is not the one that the timer sleeps for.
    rewind: Notify,
    /// A layer had no room for what it was to be told.
    untold: Notify,
    refusals: Arc<Refusals>,
    /// Hosts to be tried; one too many is not.
    to_probe: mpsc::Sender<Probe>,
    /// Until the task that tries them has it.
    probes: RefCell<Option<mpsc::Receiver<Probe>>>,
    /// How fast its sockets are read, all together.
    pace: RefCell<Pace>,
}

impl Shell {
    /// Binds the sockets, and starts the core; what is to be read is returned.
    fn bind(stores: Arc<Stores>) -> Result<(Self, Vec<Reader>), String> {
        if stores.gncl_listen.get().is_none() {
            return Err("NDL has no GNCL to announce: start GNCL before NDL".to_owned());
        }
        let (chosen, port, paths) = (&stores.config.ndl.interface, stores.config.ndl.port, Paths::default());
        let addresses: Vec<_> = chosen.addresses().map(LocalAddress::from).collect();
        let (readers, unopened) = paths.open(&stores, &addresses);
        // An address that this host does not have may come later; of several each may be opened later, whatever the error.
        let is_final = |error: &io::Error| chosen.iter().count() == 1 && !may_come_later(error);
        if let Some((_, error)) = unopened.first().filter(|(_, error)| is_final(error)) {
            let remedy = remedy(Wanted::Port("ndl.port"), error);
            return Err(format!("NDL cannot use UDP {chosen}:{port}: {error}; {remedy}"));
        }
        // Before the core is looked at: what GNCL changes from now on is in NDL's post.
        let links = links(&stores);
        let epoch = {
            let mut core = lock(&stores);
            core.look_at_links(Time::now(), |node, incarnation| links.contains(&(node, incarnation)));
            let expected: Vec<_> = addresses.iter().map(|local| local.at(0)).collect();
            core.announce_gncl(announced(&stores, &expected));
            core.use_seeds(Time::now(), seeds(&stores, None));
            core.start(Time::now(), &paths.here())
        };
        let (rewind, untold, refusals) = (Notify::new(), Notify::new(), stores.refusals.clone());
        let (to_probe, probes) = mpsc::channel(PROBES_MAX);
        let (probes, pace) = (RefCell::new(Some(probes)), RefCell::new(Pace::new(Time::now())));
        Ok((Self { stores, epoch, paths, rewind, untold, refusals, to_probe, probes, pace }, readers))
    }

    /// Gives the core an input and does what it says; `false` when a later instance has taken over.
    fn feed(&self, input: impl FnOnce(&mut Core, Time)) -> bool {
        let wake_moved = {
            let mut core = lock(&self.stores);
            if !core.is_current(self.epoch) {
                return false;
            }
            let before = core.next_wake();
            input(&mut core, Time::now());
            core.next_wake() != before
        };
        self.carry_out();
        if wake_moved {
            self.rewind.notify_one();
        }
        true
    }

    fn carry_out(&self) {
        loop {
            // The lock is not held while an order is carried out.
            let Some(output) = self.next_order() else { return };
            self.obey(output);
        }
    }

    fn obey(&self, output: Output) {
        match output {
            Output::SendQuery { to, correlation } => self.send_query(to, correlation),
            Output::SendMulticastQuery { from, correlation } => {
                let groups = self.stores.config.ndl.groups();
                for here in from {
                    if let Some(there) = groups.of(here.ip()) {
                        self.send_query(Place { there, here }, correlation);
                    }
                }
            }
            Output::SendAnswer { to, node, correlation, query_sent, query_received } => {
                let (announcement, progress) = {
                    let core = lock(&self.stores);
                    (core.announcement().clone(), core.progress().clone())
                };
                let (query_sent_ns, query_received_ns) = (query_sent.as_nanos(), query_received.as_nanos());
                let answer = Answer { announcement, query_sent_ns, query_received_ns, progress };
                self.send(to, node, correlation, Body::Answer(answer));
            }
            Output::SendLeave { to, node } => {
                let gave_up = self.stores.gave_up.get().cloned();
                self.send(to, node, 0, Body::Leave(Leave { announcement: self.me(), gave_up }));
            }
            Output::Probe { node, incarnation, to, within, asked } => {
                self.stores.gncl.ask_for_a_sign(self.stores.node, node, incarnation);
                // Where too many are silent at once it is not their hosts that are to be doubted.
                let _ = self.to_probe.try_send(Probe { node, incarnation, to, within, asked });
            }
            Output::AskForSign { node, incarnation } => {
                self.stores.gncl.ask_for_a_sign(self.stores.node, node, incarnation);
            }
            Output::Fact(fact) => self.tell_layers(&fact),
            Output::Moved { node, gncl, .. } => self.tell_of_a_move(node, &gncl),
            Output::Forgotten { node, incarnation } => {
                crate::log::warn!(%node, life = %incarnation, "the node is there in an earlier life than this one: its clock went back");
                self.tell();
            }
            Output::Event { to, event } => self.tell_application(to, &event),
            Output::ClockMeasured { node, incarnation, offset } => {
                self.stores.clocks.set(node, incarnation, offset);
            }
            Output::Collision { node, holder, newcomer } => crate::log::error!(
                "node address {node} is used twice: by {holder}, and by {newcomer}, which is not let in; give one of \
                 them another `address`"
            ),
            Output::AddressTaken { holder } => self.end_node(format!(
                "node address {} is used already by '{}' at {}; give this node another `node.address`, or \
                 end the other one",
                self.stores.node, holder.name, holder.at
            )),
            Output::Stalled { late } => crate::log::warn!(
                late_ms = late.as_millis(),
                "this node did not run for {} ms: its process was stopped, or had no CPU; of such cycles only one in four counts missed answers of others",
                late.as_millis()
            ),
        }
    }

    /// A later instance would find the same: the root ends the node, and nothing is tried again.
    // spec: NDL-5.5
    fn end_node(&self, words: String) {
        let root = &self.stores.posts.root;
        // A root whose post is full hears it from the supervisor, after restarts.
        if let Err(node::RootEvent::AddressTaken(words)) = root.post(node::RootEvent::AddressTaken(words))
            && !root.is_closed()
        {
            give_up(&words);
        }
    }

    fn me(&self) -> super::datagram::Announcement {
        lock(&self.stores).announcement().clone()
    }

    fn send_query(&self, to: Place, correlation: u64) {
        self.send(to, NodeAddress::ALL, correlation, Body::Query(self.me()));
    }

    fn send(&self, to: Place, node: NodeAddress, correlation: u64, body: Body) {
        // The send time is taken last: what is between it and the network counts as network.
        let mut bytes = encode(&Datagram { correlation, sent: Time::now(), body }, node);
        if let Some(secured) = self.stores.secured.get() {
            secured.seal(&mut bytes);
        }
        if let Err(error) = self.paths.send(to.here, &bytes, to.there) {
            let what = format_args!("from {} to {}: {error}", to.here, to.there);
            self.refusals.count(Time::now(), "NDL datagram not sent", &what);
        }
    }
}

pub(super) fn lock(stores: &Stores) -> MutexGuard<'_, Core> {
    stores.ndl.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The lives of nodes to which there is a connection now.
fn links(stores: &Stores) -> BTreeSet<(NodeAddress, Incarnation)> {
    // The first way is that of Control, whose connection is the one that GNCL tells of.
    let stands = |peer: &gncl::Peer| peer.ways().first().is_some_and(|way| way.outlet.is_connected());
    let peers = stores.gncl.peers();
    peers.iter().filter(|peer| stands(peer)).map(|peer| (peer.node, peer.incarnation)).collect()
}

/// What GNCL heard of those who are about to be lost. NDL's lock and GNCL's are never held together.
fn signs(stores: &Stores) -> Vec<Input> {
    let in_doubt = lock(stores).in_doubt();
    let sign = |(node, incarnation)| {
        let at = stores.gncl.sign_of(node, incarnation)?;
        Some(Input::SignSeen { node, incarnation, at })
    };
    in_doubt.into_iter().filter_map(sign).collect()
}

/// Whom to ask in any case. A seed on the link of an interface that is not there waits for it; where nobody looks for interfaces, or the
/// name of one is of no account, it is asked from everywhere.
fn seeds(stores: &Stores, usable: Option<&Usable>) -> Vec<SocketAddr> {
    let seeds = stores.config.ndl.seeds.iter().filter_map(|seed| {
        let (SocketAddr::V6(at), Some(zone)) = (seed.address, &seed.zone) else { return Some(seed.address) };
        if !at.ip().is_unicast_link_local() || stores.config.ndl.interface.are_ipv4_addresses() {
            return Some(seed.address);
        }
        let numbers = &usable?.numbers;
        let is_number = |number: &u32| numbers.values().any(|known| known == number);
        let number = numbers.get(zone).copied().or_else(|| zone.parse().ok().filter(is_number))?;
        Some(SocketAddrV6::new(*at.ip(), at.port(), 0, number).into())
    });
    seeds.collect()
}

/// Asks the root, every period, what of this node does not get on. The root waits for nobody, and NDL not for the root: that it does not answer
/// is said, and until it does it is asked nothing more.
async fn watch_progress(shell: Rc<Shell>) {
    let period = look_period(&shell.stores.config.ndl);
    let (mut root, mut question) = (RootWatch::new(Time::now()), None);
    loop {
        // A question that waits for its answer is looked at each period.
        if question.is_none() {
            tokio::time::sleep(period).await;
        }
        // Whoever reads its post has this by itself; but where an instance of LNCL that was replaced kept something, no event need follow.
        shell.stores.untold_of_apps.offer_to_sync(&shell.stores.posts);
        shell.stores.untold_of_apps.offer_to_ndl(&shell.stores.posts);
        let said = ask_root(&shell.stores, &mut root, &mut question, period).await;
        let is_current = shell.feed(|core, now| {
            if let Some(said) = said {
                core.handle(now, Input::ProgressSeen(said));
            }
        });
        if !is_current {
            return;
        }
    }
}

/// What is to be said of this node from now on; `None`: nothing else than before. A question that is not answered is kept.
async fn ask_root(
    stores: &Stores,
    root: &mut RootWatch,
    question: &mut Option<oneshot::Receiver<Progress>>,
    period: Duration,
) -> Option<Progress> {
    if stores.posts.root.is_closed() {
        // The node ends.
        return None;
    }
    root.asked(Time::now());
    if question.is_none() {
        let (answer, answered) = oneshot::channel();
        // Where the root has so much to do that its post is full it is asked later.
        *question = stores.posts.root.post(node::RootEvent::TellProgress(answer)).ok().map(|()| answered);
    }
    let answer = async {
        match question {
            Some(answered) => answered.await,
            None => std::future::pending().await,
        }
    };
    let Ok(answer) = tokio::time::timeout(period, answer).await else {
        return root.not_answered(Time::now());
    };
    *question = None;
    let said = answer.ok()?;
    root.answered(Time::now(), said.clone());
    Some(said)
}

/// Tries hosts, many at once.
async fn try_hosts(shell: Rc<Shell>, mut asked: mpsc::Receiver<Probe>) {
    let mut under_way = FuturesUnordered::new();
    loop {
        tokio::select! {
            Some(probe) = asked.recv(), if under_way.len() < PROBES_MAX => under_way.push(probe.carry_out()),
            Some(probed) = under_way.next() => {
                if !shell.feed(|core, now| core.handle(now, probed)) {
                    return;
                }
            }
            // The shell, which is ours, has the other end.
            else => return,
        }
    }
}

async fn keep_time(shell: Rc<Shell>) {
    // Not the reactor's own sleep, whose ticks of a millisecond made each look late by one to two, and each loss twice as much.
    let mut alarm = Alarm::new().unwrap_or_else(|error| {
        let remedy = remedy(Wanted::Descriptor, &error);
        give_up(&format!("NDL gets no timer of the kernel's (timerfd): {error}; {remedy}"))
    });
    loop {
        let wake = lock(&shell.stores).next_wake();
        let Some(wake) = wake else { return };
        tokio::select! {
            () = reached(&mut alarm, wake) => {}
            () = shell.rewind.notified() => continue,
        }
        let signs = signs(&shell.stores);
        let time_passed = |core: &mut Core, now| {
            signs.into_iter().for_each(|sign| core.handle(now, sign));
            core.handle(now, Input::TimePassed);
        };
        if !shell.feed(time_passed) {
            return;
        }
    }
}

/// Until this time has come.
async fn reached(alarm: &mut Alarm, at: Time) {
    poll_fn(|context| {
        if Time::now() >= at {
            return Poll::Ready(());
        }
        alarm.wake_at(Some(at), context).expect("a timer that was made takes a time");
        Poll::Pending
    })
    .await;
}

/// Binds what a start binds, for its words.
#[cfg(test)]
pub(super) fn start_words(stores: Arc<Stores>) -> Result<(), String> {
    Shell::bind(stores).map(drop)
}
