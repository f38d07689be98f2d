//! The clients, the channels, and the thread that reads messages while a client has a subscription.

use std::{
    collections::{BTreeMap, BTreeSet},
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
    time::Duration,
};

use sinew::Time;
use tokio::sync::{
    Notify,
    mpsc::{Receiver, Sender, channel},
};
use tokio_tungstenite::tungstenite::Message;

use super::{
    channels::{Change, Channels},
    protocol::{self, Level, Subscription},
};
use crate::{
    cache::panic_text,
    source::{Live, LiveItem, Source},
};

/// Clients at a time.
pub(super) const CLIENTS_MAX: usize = 8;
/// Subscriptions of a client.
const SUBSCRIPTIONS_MAX: usize = 1_024;
/// Views that wait for a client. Further ones are dropped and counted.
const VIEWS_MAX: usize = 8_192;
/// Bytes of the views that wait for a client.
const VIEW_BYTES_MAX: usize = 16 << 20;
/// Other messages that wait for a client. A client that leaves more unread is closed.
const CONTROLS_MAX: usize = 256;
/// Bytes of the other messages that wait for a client: all channels, with some 8 KiB each.
const CONTROL_BYTES_MAX: usize = 32 << 20;
/// Channels in one announcement. All channels are then a quarter of the messages that may wait.
const ANNOUNCED: usize = 64;
/// Errors that are reported to a client for one of its messages. Further ones are counted.
const FAULTS_MAX: usize = 16;
/// Time between two looks at new messages.
const PERIOD: Duration = Duration::from_millis(10);
/// Time between two reports to a client about its dropped messages.
const REPORTED_EVERY: Duration = Duration::from_secs(1);
/// Wait after a failure of the reader.
const RETRY: Duration = Duration::from_millis(250);
/// The ID of the status with dropped messages.
const DROPPED: &str = "dropped";

/// The counters of a server since its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Counts {
    /// Clients now.
    pub(crate) clients: usize,
    /// Views that were queued for a client.
    pub(crate) queued: u64,
    /// Views that found no room in the queue of their client.
    pub(crate) dropped: u64,
    /// Messages with a subscription that were not read in time from the journal of their node.
    pub(crate) missed: u64,
}

/// A client.
struct Client {
    controls: Outbox,
    views: Outbox,
    /// Has the connection closed.
    cut: Arc<Notify>,
    /// The number of each subscription, by channel.
    subscriptions: BTreeMap<u32, u32>,
    dropped: u64,
    /// The dropped messages that a status has reported.
    reported: u64,
}

#[derive(Default)]
struct State {
    clients: BTreeMap<u64, Client>,
    channels: Channels,
    /// The channels that no client knows yet.
    unannounced: Vec<u32>,
    faults: Vec<String>,
    counts: Counts,
    next: u64,
    is_over: bool,
}

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    /// Notified when a client connects, and at the end.
    changed: Condvar,
}

/// The clients and channels of a server. Its thread ends with [`end`](Self::end).
#[derive(Clone)]
pub(crate) struct Hub {
    shared: Arc<Shared>,
    /// Another text for each start.
    session: Arc<str>,
}

/// The queues of a client.
pub(super) struct Queues {
    controls: Inbox,
    views: Inbox,
}

/// The writing end of a queue that is bounded by its messages and their bytes.
struct Outbox {
    sender: Sender<Message>,
    waiting: Arc<AtomicUsize>,
    bytes_max: usize,
}

/// The reading end of a queue.
struct Inbox {
    receiver: Receiver<Message>,
    /// Bytes of the waiting messages.
    waiting: Arc<AtomicUsize>,
}

fn queue(messages_max: usize, bytes_max: usize) -> (Outbox, Inbox) {
    let (sender, receiver) = channel(messages_max);
    let waiting = Arc::new(AtomicUsize::new(0));
    (Outbox { sender, waiting: Arc::clone(&waiting), bytes_max }, Inbox { receiver, waiting })
}

impl Outbox {
    /// Queues a message. Returns whether there was room.
    fn offer(&self, message: Message) -> bool {
        let bytes = message.len();
        let has_room = self.waiting.fetch_add(bytes, Ordering::Relaxed) + bytes <= self.bytes_max;
        let is_queued = has_room && self.sender.try_send(message).is_ok();
        if !is_queued {
            self.waiting.fetch_sub(bytes, Ordering::Relaxed);
        }
        is_queued
    }
}

impl Inbox {
    async fn next(&mut self) -> Option<Message> {
        let message = self.receiver.recv().await;
        self.taken(message)
    }

    fn try_next(&mut self) -> Option<Message> {
        let message = self.receiver.try_recv().ok();
        self.taken(message)
    }

    fn taken(&self, message: Option<Message>) -> Option<Message> {
        message.inspect(|message| {
            self.waiting.fetch_sub(message.len(), Ordering::Relaxed);
        })
    }
}

/// The place of a client, until it is dropped.
pub(super) struct Place {
    hub: Hub,
    number: u64,
    pub(super) cut: Arc<Notify>,
}

impl Queues {
    /// Returns the next message: views come last. `None` once the client has lost its place.
    pub(super) async fn next(&mut self) -> Option<Message> {
        tokio::select! {
            biased;
            control = self.controls.next() => control,
            view = self.views.next() => view,
        }
    }

    /// Returns the next message, if there is one now.
    pub(super) fn try_next(&mut self) -> Option<Message> {
        self.controls.try_next().or_else(|| self.views.try_next())
    }
}

impl Client {
    /// Queues a message that is no view. A client without room for it is closed.
    fn control(&self, message: Message) {
        if !self.controls.offer(message) {
            self.cut.notify_one();
        }
    }

    /// Queues a view. Returns whether there was room.
    fn view(&mut self, message: Message) -> bool {
        let is_queued = self.views.offer(message);
        self.dropped += u64::from(!is_queued);
        is_queued
    }
}

impl State {
    /// Returns the topics with a subscription.
    fn wanted(&self) -> BTreeSet<String> {
        let channels = self.clients.values().flat_map(|client| client.subscriptions.keys());
        channels.filter_map(|number| self.channels.topic(*number)).map(str::to_owned).collect()
    }

    fn take(&mut self, item: LiveItem<'_>) {
        match item {
            LiveItem::Channel(channel) => match self.channels.put(channel) {
                Change::None => {}
                Change::New(new) => self.unannounced.push(new),
                Change::Replaced { former, new } => self.replace(former, new),
            },
            LiveItem::Message { topic, time_ns, data } => {
                let Some(number) = self.channels.number(topic) else { return };
                for client in self.clients.values_mut() {
                    let Some(subscription) = client.subscriptions.get(&number) else { continue };
                    let message = protocol::message_data(*subscription, time_ns, data);
                    let count =
                        if client.view(message) { &mut self.counts.queued } else { &mut self.counts.dropped };
                    *count += 1;
                }
            }
            LiveItem::Missed(count) => self.counts.missed += count,
        }
    }

    /// Withdraws a channel, if the clients know it, and has its successor announced.
    fn replace(&mut self, former: u32, new: u32) {
        if let Some(place) = self.unannounced.iter().position(|number| *number == former) {
            self.unannounced[place] = new;
            return;
        }
        for client in self.clients.values_mut() {
            client.subscriptions.remove(&former);
            client.control(protocol::unadvertise(former));
        }
        self.unannounced.push(new);
    }

    /// Announces the channels that are new since the last call, many in a message: a look finds hundreds.
    fn announce(&mut self) {
        for part in std::mem::take(&mut self.unannounced).chunks(ANNOUNCED) {
            let found = part.iter().filter_map(|number| Some((*number, self.channels.get(*number)?)));
            let message = protocol::advertise(found);
            for client in self.clients.values() {
                client.control(message.clone());
            }
        }
    }

    /// Shows these faults to the clients, in place of the former ones.
    fn set_faults(&mut self, faults: Vec<String>) {
        if self.faults == faults {
            return;
        }
        let former = fault_ids(self.faults.len());
        self.faults = faults;
        for client in self.clients.values() {
            if !former.is_empty() {
                client.control(protocol::remove_status(&former));
            }
            self.report_faults(client);
        }
    }

    fn report_faults(&self, client: &Client) {
        for (id, fault) in fault_ids(self.faults.len()).iter().zip(&self.faults) {
            client.control(protocol::status(Level::Warning, fault, Some(id)));
        }
    }

    /// Reports its dropped messages to each client that has more than the last status has.
    fn report_dropped(&mut self) {
        for client in self.clients.values_mut().filter(|client| client.dropped > client.reported) {
            client.reported = client.dropped;
            let text = format!(
                "{} messages were dropped: this client reads too slowly; subscribe to fewer topics",
                client.dropped
            );
            client.control(protocol::status(Level::Warning, &text, Some(DROPPED)));
        }
    }
}

fn fault_ids(count: usize) -> Vec<String> {
    (0..count).map(|number| format!("fault-{number}")).collect()
}

impl Hub {
    /// Starts the thread that reads messages. `session` is another text for each start.
    pub(crate) fn start(source: Arc<dyn Source>, session: &str) -> io::Result<Self> {
        let hub = Self { shared: Arc::default(), session: session.into() };
        let shared = Arc::clone(&hub.shared);
        thread::Builder::new().name("foxglove".to_owned()).spawn(move || run(&shared, &*source))?;
        Ok(hub)
    }

    /// Ends the thread.
    pub(crate) fn end(&self) {
        self.shared.lock().is_over = true;
        self.shared.changed.notify_all();
    }

    /// Returns the counters.
    pub(crate) fn counts(&self) -> Counts {
        let state = self.shared.lock();
        Counts { clients: state.clients.len(), ..state.counts }
    }

    /// Adds a client, and queues the description of the server and of all channels for it; `None` if there are as many
    /// as may be.
    pub(super) fn connect(&self) -> Option<(Place, Queues)> {
        let mut state = self.shared.lock();
        if state.clients.len() >= CLIENTS_MAX {
            return None;
        }
        // Below the new client gets all channels: it must not get these twice.
        state.announce();
        let (controls, controls_out) = queue(CONTROLS_MAX, CONTROL_BYTES_MAX);
        let (views, views_out) = queue(VIEWS_MAX, VIEW_BYTES_MAX);
        let cut = Arc::new(Notify::new());
        let client = Client {
            controls,
            views,
            cut: Arc::clone(&cut),
            subscriptions: BTreeMap::new(),
            dropped: 0,
            reported: 0,
        };
        client.control(protocol::server_info(&self.session));
        for part in state.channels.all().chunks(ANNOUNCED) {
            client.control(protocol::advertise(part.iter().copied()));
        }
        state.report_faults(&client);
        let number = state.next;
        state.next += 1;
        state.clients.insert(number, client);
        self.shared.changed.notify_all();
        let queues = Queues { controls: controls_out, views: views_out };
        Some((Place { hub: self.clone(), number, cut }, queues))
    }
}

impl Place {
    /// Queues a message that is no view.
    pub(super) fn send(&self, message: Message) {
        if let Some(client) = self.hub.shared.lock().clients.get(&self.number) {
            client.control(message);
        }
    }

    /// Reports these errors to the client.
    pub(super) fn report(&self, faults: &[String]) {
        for fault in faults.iter().take(FAULTS_MAX) {
            self.send(protocol::status(Level::Error, fault, None));
        }
        if let Some(more) = faults.len().checked_sub(FAULTS_MAX).filter(|more| *more > 0) {
            let text = format!("{more} further parts of this request failed; send a shorter one to see why");
            self.send(protocol::status(Level::Error, &text, None));
        }
    }

    /// Adds subscriptions, each to a channel that has none.
    pub(super) fn subscribe(&self, subscriptions: &[Subscription]) {
        let mut state = self.hub.shared.lock();
        let State { clients, channels, .. } = &mut *state;
        let Some(client) = clients.get_mut(&self.number) else { return };
        let mut faults = Vec::new();
        for Subscription { id, channel_id } in subscriptions {
            let fault = if channels.get(*channel_id).is_none() {
                format!("there is no channel {channel_id}; subscribe to one that was advertised")
            } else if client.subscriptions.contains_key(channel_id) {
                format!("channel {channel_id} has a subscription already; unsubscribe first")
            } else if client.subscriptions.len() >= SUBSCRIPTIONS_MAX {
                format!("a client has at most {SUBSCRIPTIONS_MAX} subscriptions; subscribe to fewer topics")
            } else {
                client.subscriptions.insert(*channel_id, *id);
                continue;
            };
            faults.push(fault);
        }
        drop(state);
        self.report(&faults);
    }

    /// Ends these subscriptions.
    pub(super) fn unsubscribe(&self, ids: &BTreeSet<u32>) {
        if let Some(client) = self.hub.shared.lock().clients.get_mut(&self.number) {
            client.subscriptions.retain(|_, id| !ids.contains(id));
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.hub.shared.lock().clients.remove(&self.number);
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until there is a client. Returns whether there is one; else it is the end.
    fn wait(&self) -> bool {
        let is_idle = |state: &mut State| !state.is_over && state.clients.is_empty();
        let state = self.changed.wait_while(self.lock(), is_idle).unwrap_or_else(PoisonError::into_inner);
        !state.is_over
    }
}

/// Reads messages as long as there is a client. Without a subscription the reader finds channels, and no node copies
/// messages for it.
fn run(shared: &Shared, source: &dyn Source) {
    while shared.wait() {
        let mut live = source.live();
        let mut report_due = Time::now();
        loop {
            let (wanted, has_ended) = {
                let state = shared.lock();
                (state.wanted(), state.is_over || state.clients.is_empty())
            };
            if has_ended {
                break;
            }
            let began = Time::now();
            let polled = poll(&mut *live, &wanted, shared);
            let is_broken = polled.is_err();
            {
                let mut state = shared.lock();
                state.announce();
                state.set_faults(polled.unwrap_or_else(|why| vec![why]));
                if began >= report_due {
                    report_due = began + REPORTED_EVERY;
                    state.report_dropped();
                }
            }
            if is_broken {
                // A reader that failed is replaced, and not at once: its fault is shown meanwhile.
                thread::sleep(RETRY);
                break;
            }
            thread::sleep(PERIOD.saturating_sub(Time::now().since(began)));
        }
    }
}

fn poll(live: &mut dyn Live, wanted: &BTreeSet<String>, shared: &Shared) -> Result<Vec<String>, String> {
    let polled = catch_unwind(AssertUnwindSafe(|| live.poll(wanted, &mut |item| shared.lock().take(item))));
    polled.map_err(|panic| {
        format!("sinew view failed while it read messages: {}; report this", panic_text(&*panic))
    })
}

#[cfg(test)]
mod tests;
