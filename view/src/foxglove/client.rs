//! The connection of one client.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use futures_util::{
    SinkExt as _, StreamExt as _,
    stream::{SplitSink, SplitStream},
};
use hyper::body::Bytes;
use tokio::{
    io::{AsyncRead, AsyncWrite},
    task::JoinSet,
    time::{Interval, MissedTickBehavior, interval, sleep, timeout},
};
use tokio_tungstenite::{
    WebSocketStream,
    tungstenite::{
        Message,
        protocol::{Role, WebSocketConfig},
    },
};

use super::{
    Writes,
    hub::{Hub, Place, Queues},
    parameters::{self, Wanted},
    protocol::{self, ClientMessage, GivenParameter, Level},
};
use crate::answer::Shared;

/// Bytes of a message of a client. A subscription has some 40.
const MESSAGE_BYTES_MAX: usize = 256 * 1_024;
/// Bytes of the buffers of a connection, each way.
const BUFFER_BYTES: usize = 64 * 1_024;
/// Messages that are written before the connection is flushed.
const BATCH: usize = 256;
/// Time for which a client may read nothing: a message waits so long for room. Then its connection is closed.
const STUCK_WITHIN: Duration = Duration::from_secs(5);
/// Time between two pings.
const PING_EVERY: Duration = Duration::from_secs(15);
/// Time without a message or an answer to a ping after which a client has gone.
const SILENT_WITHIN: Duration = Duration::from_secs(45);
/// Time limit for the end of a connection.
const CLOSED_WITHIN: Duration = Duration::from_secs(1);
/// Requests for parameters of a client at a time. Further ones are refused.
const REQUESTS_MAX: usize = 4;
/// Names of parameters of which a client gets updates.
const WATCHED_MAX: usize = 4_096;
/// Bytes of such a name: an application, a dot and a parameter have fewer.
const WATCHED_BYTES_MAX: usize = 256;
/// Time between two looks at the values of parameters for a client that wants updates.
const UPDATED_EVERY: Duration = Duration::from_secs(1);

/// Serves a client until it ends.
pub(super) async fn serve<S>(stream: S, shared: Arc<Shared>, hub: Hub, writes: Writes)
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut socket = WebSocketStream::from_raw_socket(stream, Role::Server, Some(config())).await;
    let Some((place, mut queues)) = hub.connect() else {
        let text = "too many clients are connected; close one";
        // A client that does not read it is closed all the same.
        let _ = timeout(CLOSED_WITHIN, socket.send(protocol::status(Level::Error, text, None))).await;
        let _ = timeout(CLOSED_WITHIN, socket.close(None)).await;
        return;
    };
    let place = Arc::new(place);
    let (mut sink, mut source) = socket.split();
    let session = Session {
        place: Arc::clone(&place),
        shared,
        writes,
        requests: Mutex::default(),
        watched: Mutex::default(),
    };
    tokio::select! {
        () = write(&mut sink, &mut queues) => {}
        () = session.read(&mut source) => {}
        () = session.send_updates() => {}
        () = place.cut.notified() => {}
    }
    // Its subscriptions end now, and not with its connection.
    drop((session, place));
    let _ = timeout(CLOSED_WITHIN, sink.close()).await;
}

fn config() -> WebSocketConfig {
    WebSocketConfig::default()
        .read_buffer_size(BUFFER_BYTES)
        .write_buffer_size(BUFFER_BYTES)
        .max_message_size(Some(MESSAGE_BYTES_MAX))
        .max_frame_size(Some(MESSAGE_BYTES_MAX))
}

/// Writes the messages of the queues, and pings. It ends when the client reads nothing, or has gone.
async fn write<S>(sink: &mut SplitSink<WebSocketStream<S>, Message>, queues: &mut Queues)
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut pings = pings();
    loop {
        let first = tokio::select! {
            next = queues.next() => next,
            _ = pings.tick() => Some(Message::Ping(Bytes::new())),
        };
        let mut next = first;
        for left in (0..BATCH).rev() {
            let Some(message) = next else { break };
            if !is_read(sink.feed(message)).await {
                return;
            }
            next = if left > 0 { queues.try_next() } else { None };
        }
        if !is_read(sink.flush()).await {
            return;
        }
    }
}

/// Waits until there is room for a message. Returns `false` if the client has gone or reads nothing. A slow one has the
/// time for each message, and not for all that wait.
async fn is_read<E>(written: impl Future<Output = Result<(), E>>) -> bool {
    matches!(timeout(STUCK_WITHIN, written).await, Ok(Ok(())))
}

fn pings() -> Interval {
    let mut pings = interval(PING_EVERY);
    pings.set_missed_tick_behavior(MissedTickBehavior::Delay);
    pings
}

/// The state of a client that its messages change.
struct Session {
    place: Arc<Place>,
    shared: Arc<Shared>,
    writes: Writes,
    /// The open requests for parameters. They end with the client, so that none keeps its place. A set that its
    /// application was asked for is made and logged all the same.
    requests: Mutex<JoinSet<()>>,
    /// The parameters of which it wants updates.
    watched: Mutex<Watched>,
}

/// The parameters of which a client wants updates.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
enum Watched {
    #[default]
    None,
    All,
    These(BTreeSet<String>),
}

impl Watched {
    /// Adds names; without any, all. Returns whether there was room for each.
    fn add(&mut self, names: Vec<String>) -> bool {
        if names.is_empty() || *self == Self::All {
            *self = Self::All;
            return true;
        }
        let mut known = self.names();
        let mut has_room = true;
        for name in names {
            let fits = name.len() <= WATCHED_BYTES_MAX && known.len() < WATCHED_MAX;
            has_room &= known.contains(&name) || (fits && known.insert(name));
        }
        *self = Self::These(known);
        has_room
    }

    /// Takes the single names.
    fn names(&mut self) -> BTreeSet<String> {
        match std::mem::take(self) {
            Self::None | Self::All => BTreeSet::new(),
            Self::These(names) => names,
        }
    }

    /// Removes names; without any, all. Of all parameters single ones cannot be removed: their updates still come.
    fn remove(&mut self, names: &[String]) {
        match self {
            _ if names.is_empty() => *self = Self::None,
            Self::These(known) => {
                for name in names {
                    known.remove(name);
                }
            }
            Self::None | Self::All => {}
        }
    }

    fn wanted(&self) -> Option<Wanted> {
        match self {
            Self::None => None,
            Self::All => Some(Wanted::default()),
            Self::These(names) if names.is_empty() => None,
            Self::These(names) => Some(Wanted::of(names.clone())),
        }
    }
}

impl Session {
    /// Reads the messages of the client until it ends.
    async fn read<S>(&self, source: &mut SplitStream<WebSocketStream<S>>)
    where
        S: AsyncRead + AsyncWrite + Unpin,
    {
        while let Ok(Some(Ok(message))) = timeout(SILENT_WITHIN, source.next()).await {
            match message {
                Message::Text(text) => match ClientMessage::read(text.as_str()) {
                    Ok(message) => self.handle(message),
                    Err(why) => self.fault(&why),
                },
                Message::Binary(_) => self.fault("sinew view takes no messages; `sinew send` sends them"),
                Message::Ping(_) | Message::Pong(_) | Message::Frame(_) => {}
                Message::Close(_) => return,
            }
        }
    }

    fn handle(&self, message: ClientMessage) {
        match message {
            ClientMessage::Subscribe { subscriptions } => self.place.subscribe(&subscriptions),
            ClientMessage::Unsubscribe { subscription_ids } => {
                self.place.unsubscribe(&subscription_ids.into_iter().collect());
            }
            ClientMessage::GetParameters { parameter_names, id } => {
                self.request(Vec::new(), Wanted::of(parameter_names.into_iter().collect()), id);
            }
            ClientMessage::SetParameters { parameters, id } => {
                let names = parameters.iter().map(|one| one.name.clone()).collect();
                self.request(parameters, Wanted::of(names), id);
            }
            ClientMessage::SubscribeParameterUpdates { parameter_names } => {
                if !self.watched().add(parameter_names) {
                    self.fault(&format!(
                        "a client gets updates of at most {WATCHED_MAX} parameters by name; give no name to get all"
                    ));
                }
            }
            ClientMessage::UnsubscribeParameterUpdates { parameter_names } => {
                self.watched().remove(&parameter_names);
            }
            ClientMessage::Other => self.fault("sinew view offers messages and parameters only"),
        }
    }

    fn fault(&self, why: &str) {
        self.place.send(protocol::status(Level::Error, why, None));
    }

    fn watched(&self) -> MutexGuard<'_, Watched> {
        self.watched.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets parameters, if there are some and it is allowed, and answers with the values of the wanted ones. Messages
    /// flow meanwhile.
    fn request(&self, given: Vec<GivenParameter>, wanted: Wanted, id: Option<String>) {
        let mut requests = self.requests.lock().unwrap_or_else(PoisonError::into_inner);
        while requests.try_join_next().is_some() {}
        if requests.len() >= REQUESTS_MAX {
            return self.fault("too many requests for parameters are open; wait for their answers");
        }
        let (place, shared, writes) = (Arc::clone(&self.place), Arc::clone(&self.shared), self.writes);
        requests.spawn(async move {
            let faults = answer(&place, &shared, (&given, writes), (&wanted, id.as_deref())).await;
            place.report(&faults);
        });
    }

    /// Sends the values of watched parameters that have changed.
    async fn send_updates(&self) {
        let mut last = BTreeMap::new();
        loop {
            sleep(UPDATED_EVERY).await;
            let Some(wanted) = self.watched().wanted() else { continue };
            // The next look is soon, and the answer to a request has the reason.
            let Ok(known) = parameters::known(&self.shared).await else { continue };
            let values = wanted.values(&known);
            let mut changed = values.clone();
            changed.retain(|name, value| last.get(name) != Some(value));
            if !changed.is_empty() {
                self.place.send(protocol::parameter_values(&changed, None));
            }
            last = values;
        }
    }
}

/// Carries out a request for parameters. Returns why a part of it failed.
async fn answer(
    place: &Place,
    shared: &Arc<Shared>,
    (given, writes): (&[GivenParameter], Writes),
    (wanted, id): (&Wanted, Option<&str>),
) -> Vec<String> {
    let known = match parameters::known(shared).await {
        Ok(known) => known,
        Err(why) => return vec![why],
    };
    let (known, faults) = match writes {
        _ if given.is_empty() => (known, Vec::new()),
        Writes::Refused => {
            let why = "parameters are set only by clients with the token, if sinew view was started with --foxglove-writes";
            (known, vec![why.to_owned()])
        }
        Writes::Allowed => {
            let faults = parameters::set(shared, given, &known).await;
            // Without another list the former values are the best that is known.
            (parameters::known(shared).await.unwrap_or(known), faults)
        }
    };
    place.send(protocol::parameter_values(&wanted.values(&known), id));
    faults
}

#[cfg(test)]
mod tests {
    use tokio::{io::AsyncReadExt as _, time::Instant};

    use super::*;
    use crate::source::NoSystem;

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn updates_are_wanted_by_name_or_all() {
        let mut watched = Watched::default();
        assert_eq!(watched.wanted(), None);
        watched.add(names(&["a", "b"]));
        watched.remove(&names(&["a"]));
        assert_eq!(watched.wanted(), Some(Wanted::of(BTreeSet::from(["b".to_owned()]))));
        watched.remove(&names(&["b"]));
        assert_eq!(watched.wanted(), None);
        watched.add(names(&[]));
        watched.add(names(&["a"]));
        assert_eq!(watched.wanted(), Some(Wanted::default()));
        watched.remove(&[]);
        assert_eq!(watched, Watched::None);
    }

    #[test]
    fn names_of_updates_have_a_bound() {
        let mut watched = Watched::default();
        assert!(!watched.add(vec!["a".repeat(WATCHED_BYTES_MAX + 1)]));
        assert_eq!(watched.wanted(), None);
        let all: Vec<_> = (0..WATCHED_MAX).map(|number| number.to_string()).collect();
        assert!(watched.add(all.clone()) && watched.add(names(&["7"])));
        assert!(!watched.add(names(&["further"])));
        assert_eq!(watched.wanted(), Some(Wanted::of(all.into_iter().collect())));
        assert!(watched.add(names(&[])));
        assert_eq!(watched, Watched::All);
    }

    #[tokio::test(start_paused = true)]
    async fn slow_client_is_kept_and_stuck_one_closed() {
        const SENT: usize = 100;
        const BYTES: usize = 16 * 1_024;
        // Given: a client that reads 40 KiB in a second
        let (own, mut client) = tokio::io::duplex(4_096);
        let socket = WebSocketStream::from_raw_socket(own, Role::Server, Some(config())).await;
        let (mut sink, _source) = socket.split();
        let hub = Hub::start(Arc::new(NoSystem), "1").expect("a thread");
        let (place, mut queues) = hub.connect().expect("there is room");
        let send = || (0..SENT).for_each(|_| place.send(Message::text("x".repeat(BYTES))));
        send();
        // When
        let reading = async {
            let (mut left, mut bytes) = (SENT * BYTES, [0; 4_096]);
            while left > 0 {
                left = left.saturating_sub(client.read(&mut bytes).await.expect("it is open"));
                sleep(Duration::from_millis(100)).await;
            }
        };
        // Then: it gets all, which takes longer than a client may read nothing
        let began = Instant::now();
        tokio::select! {
            () = write(&mut sink, &mut queues) => panic!("it was closed after {:?}", began.elapsed()),
            () = reading => {}
        }
        assert!(began.elapsed() > 2 * STUCK_WITHIN);
        // And: now it reads nothing
        send();
        let began = Instant::now();
        write(&mut sink, &mut queues).await;
        assert!(began.elapsed() >= STUCK_WITHIN);
        hub.end();
    }

    #[tokio::test]
    async fn open_request_ends_with_its_client() {
        let hub = Hub::start(Arc::new(NoSystem), "1").expect("a thread");
        let (place, _queues) = hub.connect().expect("there is room");
        let session = Session {
            place: Arc::new(place),
            shared: Shared::without_system(),
            writes: Writes::Refused,
            requests: Mutex::default(),
            watched: Mutex::default(),
        };
        for _ in 0..2 * REQUESTS_MAX {
            session.request(Vec::new(), Wanted::default(), None);
        }
        let requests = session.requests.lock().unwrap_or_else(PoisonError::into_inner).len();
        assert_eq!((requests, hub.counts().clients), (REQUESTS_MAX, 1));
        // When: the client ends before the answers
        drop(session);
        tokio::task::yield_now().await;
        // Then: no request keeps its place
        assert_eq!(hub.counts().clients, 0);
        hub.end();
    }
}
