//! Start, run and end of the bridge.

use std::{
    fmt,
    io::{self, Write as _},
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use sinew::{NodeApi, client::ApiError};
use sinew_bridge_node::{NodeClient, Options};
use sinew_zenoh::session::{self, Role, SessionError};
use sinew_zenoh_rules::{Config, file::Mode, key, rules::Program};
use tokio::{
    runtime::Builder,
    signal::unix::{SignalKind, signal},
    sync::{Mutex, Notify, mpsc, watch},
    task::{JoinSet, LocalSet},
};
use tracing::info;
use zenoh::{
    Session, Wait,
    pubsub::Subscriber,
    query::Queryable,
    sample::{Locality, SampleKind},
};

use crate::{
    forward::ToZenoh,
    inlet::{Inlet, Put, Request},
    liveness::{Presence, Tokens},
    main_client::MainClient,
    programs,
    requests::{self, Requests},
    shared::Shared,
    types,
    zenoh_sender::ZenohSender,
};

/// Maximum bytes of a message of Zenoh. A node accepts fewer, and the rest is refused and counted.
const MESSAGE_MAX: u32 = 16 << 20;
/// Time limit of a registration.
const REGISTERED_WITHIN: Duration = Duration::from_secs(10);

/// The cause for which the bridge ended, or did not start.
#[derive(Debug)]
pub enum BridgeError {
    /// The node does not accept it, or has ended the connection.
    Node(ApiError),
    /// There is no session.
    Session(SessionError),
    /// The system makes no further thread, or gives no signals.
    System(io::Error),
    /// A part of the bridge has panicked.
    Part(String),
}

impl fmt::Display for BridgeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Node(error) => write!(f, "{error}"),
            Self::Session(error) => write!(f, "{error}; check [zenoh] in the file"),
            Self::System(error) => write!(f, "no thread or signal: {error}; raise the limit of processes"),
            Self::Part(part) => write!(f, "a part of the bridge has ended: {part}; start it again"),
        }
    }
}

impl std::error::Error for BridgeError {}

impl From<ApiError> for BridgeError {
    fn from(error: ApiError) -> Self {
        Self::Node(error)
    }
}

impl From<SessionError> for BridgeError {
    fn from(error: SessionError) -> Self {
        Self::Session(error)
    }
}

impl From<zenoh::Error> for BridgeError {
    fn from(error: zenoh::Error) -> Self {
        Self::Session(error.into())
    }
}

impl From<io::Error> for BridgeError {
    fn from(error: io::Error) -> Self {
        Self::System(error)
    }
}

/// The clients of the node.
struct Clients {
    main: NodeClient,
    types: NodeClient,
    requests: Vec<NodeClient>,
}

/// The receivers of messages of Zenoh. They end when they are dropped.
struct Entries {
    _subscribers: Vec<Subscriber<()>>,
    _queryables: Vec<Queryable<()>>,
    /// Without a token of their own, programs are there as long as this.
    _always: Vec<watch::Sender<bool>>,
    programs: Vec<(Program, watch::Receiver<bool>)>,
}

/// The ends of the queues from Zenoh.
struct Queues {
    puts: mpsc::Receiver<Put>,
    requests: mpsc::Receiver<Request>,
}

/// Passes messages until a signal, or until the node ends the connection for good.
///
/// # Errors
/// Returns the cause of the end.
pub fn run(config: Config) -> Result<(), BridgeError> {
    let node = NodeApi::connect(&config.socket)?;
    let session = open(&config)?;
    let shared = Arc::new(Shared::new(config));
    let zenoh_sender = ZenohSender::start(&session, shared.config.queue)?;
    let tokens = Arc::new(Tokens::default());
    tokens.start(&session)?;
    let runtime = Builder::new_current_thread().enable_all().build()?;
    let clients = runtime.block_on(register(&node, &shared))?;
    let presence = Presence::new(tokens, clients.main.tid().node);
    let to_zenoh = ToZenoh { shared: shared.clone(), zenoh_sender, bridge: session.zid().to_string() };
    // Here, because zenoh cannot wait on the thread of a runtime.
    let (entries, queues) = declare(&session, &to_zenoh)?;
    let local = LocalSet::new();
    let served = serve(node, clients, (queues, &entries), (to_zenoh, presence));
    let result = runtime.block_on(local.run_until(served));
    drop((local, entries));
    print_counts(&shared);
    // The process ends in any case.
    let _ = session.close().wait();
    result
}

fn open(config: &Config) -> Result<Session, BridgeError> {
    let certificates: Vec<_> = config.zenoh.certificates().collect();
    let is_peer = config.zenoh.mode == Mode::Peer;
    if !is_peer {
        info!("waits for one of {:?}", config.zenoh.connect);
    }
    let bridge = session::Bridge {
        is_peer,
        listen: &config.zenoh.listen,
        connect: &config.zenoh.connect,
        scouting: config.zenoh.scouting,
        certificates: &certificates,
        message_max: MESSAGE_MAX,
    };
    Ok(session::open(Role::Bridge(bridge), config.zenoh.lease())?)
}

/// Registers all clients but those of programs, joins the groups, and asks for the types.
async fn register(node: &NodeApi, shared: &Shared) -> Result<Clients, BridgeError> {
    let config = &shared.config;
    let unnamed = Options { within: REGISTERED_WITHIN, ..Options::default() };
    let own = Options {
        name: Some(config.name.clone()),
        address: config.address,
        types: config.rules.types_of(None),
        has_events: true,
        ..unnamed.clone()
    };
    let mut main = NodeClient::register(node, &own).await?;
    shared.payload_max.store(main.payload_max(), Ordering::Relaxed);
    for group in config.rules.groups() {
        main.join(group).await?;
    }
    let mut types = NodeClient::register(node, &unnamed).await?;
    types::refresh(shared, &mut types).await?;
    let mut requests = Vec::new();
    for number in 1..=config.requests {
        let name = Some(format!("{}.{number}", config.name));
        requests.push(NodeClient::register(node, &Options { name, ..unnamed.clone() }).await?);
    }
    for client in requests.iter().chain([&main, &types]) {
        shared.note_own(client.tid());
    }
    Ok(Clients { main, types, requests })
}

/// Declares the receivers of messages of Zenoh.
fn declare(session: &Session, to_zenoh: &ToZenoh) -> Result<(Entries, Queues), BridgeError> {
    let config = &to_zenoh.shared.config;
    let (puts_in, puts) = mpsc::channel(config.queue);
    let (requests_in, requests) = mpsc::channel(config.queue);
    let inlet = Arc::new(Inlet {
        shared: to_zenoh.shared.clone(),
        puts: puts_in,
        requests: requests_in,
        zenoh_sender: to_zenoh.zenoh_sender.clone(),
    });
    let (mut subscribers, mut queryables) = (Vec::new(), Vec::new());
    for messages in key::all_messages(config.rules.project()) {
        let for_puts = inlet.clone();
        let subscriber = session.declare_subscriber(messages).allowed_origin(Locality::Remote);
        subscribers.push(subscriber.callback(move |sample| for_puts.put_received(&sample)).wait()?);
    }
    // Only for keys with a rule: a query that another bridge answers gets no error of this one.
    for route in config.rules.inward().iter().filter(|route| route.get.is_some()) {
        let for_queries = inlet.clone();
        let queryable = session.declare_queryable(route.address.key(config.rules.project()));
        let queryable = queryable.complete(true).allowed_origin(Locality::Remote);
        queryables.push(queryable.callback(move |query| for_queries.query_received(query)).wait()?);
    }
    let (mut always, mut programs) = (Vec::new(), Vec::new());
    for program in config.rules.programs() {
        let (sender, is_there) = watch::channel(!program.needs_token);
        programs.push((program.clone(), is_there));
        if !program.needs_token {
            always.push(sender);
            continue;
        }
        let token = key::program_token(config.rules.project(), &program.name);
        let tokens = session.liveliness().declare_subscriber(token).history(true);
        let callback = move |sample: zenoh::sample::Sample| {
            sender.send_replace(sample.kind() == SampleKind::Put);
        };
        subscribers.push(tokens.callback(callback).wait()?);
    }
    let entries = Entries { _subscribers: subscribers, _queryables: queryables, _always: always, programs };
    Ok((entries, Queues { puts, requests }))
}

/// Runs all parts until a signal.
async fn serve(
    node: NodeApi,
    clients: Clients,
    (queues, entries): (Queues, &Entries),
    (to_zenoh, presence): (ToZenoh, Presence),
) -> Result<(), BridgeError> {
    let shared = to_zenoh.shared.clone();
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let mut report = signal(SignalKind::user_defined1())?;

    let changed = Arc::new(Notify::new());
    let mut parts: JoinSet<ApiError> = JoinSet::new();
    let main = MainClient::new(clients.main, queues.puts, to_zenoh.clone(), presence, changed.clone());
    parts.spawn_local(main.run());
    let requests: Requests = Arc::new(Mutex::new(queues.requests));
    for client in clients.requests {
        parts.spawn_local(requests::run(
            shared.clone(),
            client,
            requests.clone(),
            to_zenoh.zenoh_sender.clone(),
        ));
    }
    for (program, is_there) in entries.programs.clone() {
        parts.spawn_local(programs::run(node.clone(), program, to_zenoh.clone(), is_there));
    }
    let (of_types, of_changes) = (shared.clone(), changed);
    parts.spawn_local(async move {
        types::run(of_types, clients.types, of_changes).await;
        ApiError::Closed("the questions for types have ended".to_owned())
    });
    // The reader of this line may have ended.
    let _ = writeln!(io::stdout(), "up");
    loop {
        tokio::select! {
            ended = parts.join_next() => return Err(match ended {
                Some(Ok(why)) => BridgeError::Node(why),
                Some(Err(panic)) => BridgeError::Part(panic.to_string()),
                None => BridgeError::Part("all of them".to_owned()),
            }),
            _ = interrupt.recv() => return Ok(()),
            _ = terminate.recv() => return Ok(()),
            _ = report.recv() => print_counts(&shared),
        }
    }
}

fn print_counts(shared: &Shared) {
    // The reader may have closed its pipe.
    let _ = write!(io::stdout(), "{}", shared.counts);
}
