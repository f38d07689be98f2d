//! Runs one application in a process of its own, then ends the process.

use std::{
    future::poll_fn,
    io::{self, Read, Write as _},
    os::unix::net::UnixStream as StdStream,
    sync::{
        Arc, OnceLock,
        mpsc::{SyncSender, sync_channel},
    },
    time::Duration,
};

use sinew_runtime::{
    app::{AppWiring, DynApp},
    mailbox::Mailbox,
    remedy::{Wanted, remedy},
    safe_wake::SafelyWoken,
    supervision::{Alone, AloneHandle, Place, ReadyGate, Reason, Watcher, alone, tell_of_a_stop},
    tid::Tid,
    time::Time,
    wire::{FrameCodec, HEADER_LEN, Header, Kind},
};
use tokio::{net::UnixStream, time::MissedTickBehavior};
use tokio_util::codec::Decoder;

use super::{
    role::{Hosting, die},
    wire::Wire,
    words::{self, Beat, Ending, WORDS_BYTES_MAX, Welcome},
};
use crate::{config::NodeConfig, lncl::payload, log, node::Stalls, signals::StopSignals};

/// Time that the node has for its first words.
const WELCOME: Duration = Duration::from_secs(10);
/// Time that the node has to take the last words.
const LAST_WORDS: Duration = Duration::from_millis(100);
/// Time at the end for what this process has logged to be written.
const LOG_WRITTEN: Duration = Duration::from_millis(500);
/// Longest time between two looks at what has expired.
const EXPIRING: Duration = Duration::from_millis(250);
/// Longest time between two looks at whether the application stalls.
const STALLS_LOOKED_FOR: Duration = Duration::from_millis(125);

/// Hosts the application, then ends this process.
pub(super) fn host(config: &NodeConfig, apps: Vec<DynApp>, hosting: Hosting) -> ! {
    let Hosting { app: name, socket } = hosting;
    let Some(app) = apps.into_iter().find(|app| app.name() == name) else {
        // Where nobody reads it the exit code is all there is.
        let _ = writeln!(
            io::stderr(),
            "this program, started again to host '{name}', declared no such application of node {}",
            config.name
        );
        std::process::exit(2);
    };
    let config = config.clone();
    let thread = std::thread::Builder::new().name(name.clone());
    // A thread of its own, because the caller's may have a runtime already.
    let hosted = thread.spawn(move || run(&config, &app, socket));
    let code = match hosted.map(std::thread::JoinHandle::join) {
        Ok(Ok(Ok(()))) => 0,
        Ok(Ok(Err(error))) => {
            log::error!(name, %error, "the process that hosts this application has no connection to its node");
            log::print(format!("the process that hosts '{name}' has no connection to its node: {error}"));
            1
        }
        // The panic has been told by the panic hook.
        Ok(Err(_)) => 1,
        Err(error) => {
            let remedy = remedy(Wanted::Thread, &error);
            log::error!(name, %error, %remedy, "no thread for this application");
            log::print(format!("no thread for '{name}': {error}; {remedy}"));
            1
        }
    };
    log::flush(LOG_WRITTEN);
    std::process::exit(code)
}

fn run(config: &NodeConfig, app: &DynApp, mut socket: StdStream) -> io::Result<()> {
    let welcome = read_welcome(&mut socket)?;
    socket.set_nonblocking(true)?;
    // Before the application's priority and CPU are this thread's: who hangs there keeps no sign of life from being given.
    let beats = Beats::begin((welcome.beat_us > 0).then(|| Duration::from_micros(welcome.beat_us)))?;
    let watcher = Watcher::begin(app.policy().progress_within.is_some());
    place(app).prepare();
    let system = actix::System::new();
    let stop = system.stop_future();
    system.block_on(async {
        actix_rt::spawn(tell_of_a_stop(stop));
        live(config, app, socket, welcome, (watcher, beats)).await
    })
}

/// Reads the first frame and not a byte more.
fn read_welcome(socket: &mut StdStream) -> io::Result<Welcome> {
    socket.set_read_timeout(Some(WELCOME))?;
    let mut codec = FrameCodec::new(WORDS_BYTES_MAX);
    let mut buffer = bytes::BytesMut::new();
    let mut wanted = HEADER_LEN;
    let fault = |what: String| io::Error::new(io::ErrorKind::InvalidData, what);
    loop {
        let at = buffer.len();
        buffer.resize(at + wanted, 0);
        socket.read_exact(&mut buffer[at..])?;
        if let Some(start) = buffer.first_chunk::<8>()
            && at == 0
        {
            wanted = Header::payload_len(start).map_err(|error| fault(error.to_string()))? as usize;
        }
        if let Some(message) = codec.decode(&mut buffer).map_err(|error| fault(error.to_string()))? {
            if message.header.kind != Kind::HOST_WELCOME {
                return Err(fault(format!("the node's first frame is of kind {}", message.header.kind)));
            }
            return payload::read(&message.payload).map_err(|error| fault(error.to_string()));
        }
    }
}

async fn live(
    config: &NodeConfig,
    app: &DynApp,
    socket: StdStream,
    welcome: Welcome,
    (watcher, beats): (Watcher, Beats),
) -> io::Result<()> {
    let socket = Arc::new(UnixStream::from_std(socket)?);
    // Other threads can write to it from now on: the reactor has seen it once. It has no turn while the application's
    // factory or its `started` keeps this thread, and a hang there must be told all the same.
    socket.writable().await?;
    let (sequence, tid) = (welcome.sequence, Tid::from_bits(welcome.tid));
    let wire = Wire::new(config, socket, welcome);
    say_beat(&wire, None);
    serve(&wire);
    beats.over(wire.clone());
    let sender = wire.sender(sequence, config.payload_max);
    let wiring = AppWiring { sender, mailbox: Mailbox::fed_by(wire.clone()) };
    let saying = wire.clone();
    let ready = ReadyGate::new(move || saying.say_kind(Kind::HOST_READY));
    let launch = app.launch(wiring);
    #[cfg(feature = "fault-points")]
    let launch = crate::node::arm_alone(app, launch);
    let (handle, ended) = alone(&launch, ready, watched(watcher, app, &wire, tid));
    beats.of(handle.clone());
    let stopping = wire.clone();
    actix_rt::spawn(async move {
        loop {
            stop_asked(&stopping).await;
            handle.stop();
        }
    });
    let reason = ended.await;
    say_last(&wire, tid, &reason).await;
    Ok(())
}

/// Keeps the connection going beside the application, on its thread.
fn serve(wire: &Arc<Wire>) {
    let (draining, reading, telling, expiring) = (wire.clone(), wire.clone(), wire.clone(), wire.clone());
    // Senders on any thread wake the first and the third.
    actix_rt::spawn(SafelyWoken::new(async move {
        draining.drain().await;
        die();
    }));
    actix_rt::spawn(async move { reading.read().await });
    actix_rt::spawn(SafelyWoken::new(async move { poll_fn(|cx| telling.poll_tell(cx)).await }));
    actix_rt::spawn(async move {
        let mut interval = tokio::time::interval(EXPIRING);
        interval.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            interval.tick().await;
            expiring.expire(Time::now());
        }
    });
}

/// Signs of life of the process, from a thread of their own: whether the application comes back in its time is judged by the watchdog here,
/// which knows in what it is, and whether it was given a CPU. With them it says whether the application stalls: the node tells the nodes that
/// watch it.
struct Beats {
    wire: SyncSender<Arc<Wire>>,
    hosted: Arc<OnceLock<AloneHandle>>,
}

impl Beats {
    /// One each `beat` at least, if any are wanted, once there is a connection.
    ///
    /// # Errors
    /// There is no thread, and they are wanted.
    fn begin(beat: Option<Duration>) -> io::Result<Self> {
        let hosted = Arc::new(OnceLock::new());
        let (wire, connected) = sync_channel::<Arc<Wire>>(1);
        let whose = hosted.clone();
        let thread = std::thread::Builder::new().name("beat".to_owned());
        // Nobody connects: this process is about to end.
        let beats = move || {
            if let Ok(wire) = connected.recv() {
                beat_on(&wire, beat, &whose);
            }
        };
        match thread.spawn(beats) {
            Ok(_) => {}
            Err(error) if beat.is_none() => {
                log::warn!(%error, remedy = %remedy(Wanted::Thread, &error), "no thread says whether this application stalls");
            }
            Err(error) => {
                let why =
                    format!("no thread gives its signs of life: {error}; {}", remedy(Wanted::Thread, &error));
                return Err(io::Error::new(error.kind(), why));
            }
        }
        Ok(Self { wire, hosted })
    }

    /// The connection is there.
    fn over(&self, wire: Arc<Wire>) {
        // Not taken: there is no such thread.
        let _ = self.wire.send(wire);
    }

    /// The application is there, as its factory has returned.
    fn of(&self, app: AloneHandle) {
        // Said once.
        let _ = self.hosted.set(app);
    }
}

fn beat_on(wire: &Wire, beat: Option<Duration>, hosted: &OnceLock<AloneHandle>) {
    let (mut stalls, mut has_stalled) = (Stalls::default(), false);
    loop {
        std::thread::sleep(beat.map_or(STALLS_LOOKED_FOR, |beat| beat.min(STALLS_LOOKED_FOR)));
        let turns = hosted.get().map(AloneHandle::turn).into_iter();
        let since = stalls.look(Time::now(), turns).into_values().next();
        if wire.has_said_all() && (beat.is_some() || since.is_some() || has_stalled) {
            say_beat(wire, since);
            has_stalled = since.is_some();
        }
    }
}

fn say_beat(wire: &Wire, stalled: Option<Time>) {
    let (tid, beat) = (wire.tid(), Beat { stalled_since: stalled.map_or(0, Time::as_nanos) });
    wire.say(words::frame(Kind::HOST_BEAT, tid, payload::lncl_of(tid.node), &beat));
}

/// How the application is watched: the node kills its process when it hangs.
fn watched(watcher: Watcher, app: &DynApp, wire: &Arc<Wire>, tid: Tid) -> Alone {
    let wire = wire.clone();
    let on_hung = move |reason: &Reason| {
        wire.say(words::frame(Kind::HOST_HUNG, tid, payload::lncl_of(tid.node), &Ending::from(reason)));
    };
    Alone {
        watcher,
        name: app.name().to_owned(),
        tid: Some(tid),
        place: place(app),
        progress_within: app.policy().progress_within,
        on_hung: Box::new(on_hung),
    }
}

fn place(app: &DynApp) -> Place {
    Place { thread: app.name().to_owned(), ..app.place().clone() }
}

/// Resolves when the node or a signal asks for an orderly stop.
async fn stop_asked(wire: &Wire) {
    let Ok(mut signals) = StopSignals::listen() else { return wire.stop_asked().await };
    tokio::select! {
        () = wire.stop_asked() => {}
        which = signals.recv() => log::info!(which, "a signal asks for a stop"),
    }
}

async fn say_last(wire: &Wire, tid: Tid, reason: &Reason) {
    wire.tell_last();
    wire.say(words::frame(Kind::HOST_ENDED, tid, payload::lncl_of(tid.node), &Ending::from(reason)));
    let until = Time::now() + LAST_WORDS;
    while !wire.has_sent_all() {
        if Time::now() >= until {
            log::warn!(%tid, waited = ?LAST_WORDS, "the node does not read this application's last words; it ends without them");
            return;
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}
