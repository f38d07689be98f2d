//! Runs one application in its own process, then ends the process.

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

use sinew_model::config::NodeConfig;
use sinew_protocol::payload;
use sinew_runtime::{
    app::{AppWiring, DynApp},
    log,
    mailbox::Mailbox,
    remedy::{Wanted, remedy},
    safe_wake::SafelyWoken,
    supervision::{
        Place, ReadyGate, Reason, Unsupervised, UnsupervisedHandle, WatchdogHandle, log_system_stop,
        run_unsupervised,
    },
    tid::Tid,
    time::Time,
    wire::{FrameCodec, HEADER_LEN, Header, Kind},
};
use tokio::{net::UnixStream, time::MissedTickBehavior};
use tokio_util::codec::Decoder;

use super::{
    child_link::ChildLink,
    program::become_program,
    protocol::{self, Beat, ExitReport, FRAME_BYTES_MAX, Welcome},
    role::{Hosting, die},
};
use crate::{Stalls, signals::StopSignals};

/// Deadline of the node's first frame.
const WELCOME_TIMEOUT: Duration = Duration::from_secs(10);
/// Deadline of the node's read of the last frames.
const FINAL_SEND_TIMEOUT: Duration = Duration::from_millis(100);
/// Deadline of writing this process's log at its end.
const LOG_FLUSH_TIMEOUT: Duration = Duration::from_millis(500);
/// Interval of the expiry of messages.
const EXPIRY_INTERVAL: Duration = Duration::from_millis(250);
/// Longest interval between checks on a stalled application.
const STALL_CHECK_INTERVAL: Duration = Duration::from_millis(125);

/// Hosts the application, then ends this process.
pub(super) fn host(config: &NodeConfig, apps: Vec<DynApp>, hosting: Hosting) -> ! {
    let Hosting { app: name, socket } = hosting;
    let Some(app) = apps.into_iter().find(|app| app.name() == name) else {
        // If standard error has no reader, only the exit code remains.
        let _ = writeln!(
            io::stderr(),
            "this program, started again to host '{name}', declared no such application of node {}",
            config.name
        );
        std::process::exit(2);
    };
    if let Some(line) = app.command() {
        become_program(config, &name, line, socket);
    }
    let config = config.clone();
    let thread = std::thread::Builder::new().name(name.clone());
    // A thread of its own, since the caller's thread may have a runtime already.
    let hosted = thread.spawn(move || run(&config, &app, socket));
    let code = match hosted.map(std::thread::JoinHandle::join) {
        Ok(Ok(Ok(()))) => 0,
        Ok(Ok(Err(error))) => {
            log::error!(name, %error, "the process that hosts this application has no connection to its node");
            log::print(format!("the process that hosts '{name}' has no connection to its node: {error}"));
            1
        }
        // The panic hook has reported the panic.
        Ok(Err(_)) => 1,
        Err(error) => {
            let remedy = remedy(Wanted::Thread, &error);
            log::error!(name, %error, %remedy, "no thread for this application");
            log::print(format!("no thread for '{name}': {error}; {remedy}"));
            1
        }
    };
    log::flush(LOG_FLUSH_TIMEOUT);
    std::process::exit(code)
}

fn run(config: &NodeConfig, app: &DynApp, mut socket: StdStream) -> io::Result<()> {
    let welcome = read_welcome(&mut socket)?;
    socket.set_nonblocking(true)?;
    // Started before this thread takes the application's priority and CPU, so that an application that hangs
    // there cannot stop the heartbeats.
    let heartbeats =
        Heartbeats::begin((welcome.beat_us > 0).then(|| Duration::from_micros(welcome.beat_us)))?;
    let watchdog_handle = WatchdogHandle::begin(app.policy().progress_within.is_some());
    place(app).prepare();
    let system = actix::System::new();
    let stop = system.stop_future();
    system.block_on(async {
        actix_rt::spawn(log_system_stop(stop));
        run_connected(config, app, socket, welcome, (watchdog_handle, heartbeats)).await
    })
}

/// Reads exactly the first frame, and no further byte.
fn read_welcome(socket: &mut StdStream) -> io::Result<Welcome> {
    socket.set_read_timeout(Some(WELCOME_TIMEOUT))?;
    let mut codec = FrameCodec::new(FRAME_BYTES_MAX);
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

async fn run_connected(
    config: &NodeConfig,
    app: &DynApp,
    socket: StdStream,
    welcome: Welcome,
    (watchdog_handle, heartbeats): (WatchdogHandle, Heartbeats),
) -> io::Result<()> {
    let socket = Arc::new(UnixStream::from_std(socket)?);
    // Other threads can write to the socket from now on, since the reactor has polled it once. The reactor
    // does not run while the application's factory or its `started` blocks this thread, and a hang there must
    // be reported, too.
    socket.writable().await?;
    let (sequence, tid) = (welcome.sequence, Tid::from_bits(welcome.tid));
    let wire = ChildLink::new(config, socket, welcome);
    send_beat(&wire, None);
    serve(&wire);
    heartbeats.set_link(wire.clone());
    let sender = wire.sender(sequence, config.payload_max);
    let wiring = AppWiring { sender, mailbox: Mailbox::fed_by(wire.clone()) };
    let reporting = wire.clone();
    let ready = ReadyGate::new(move || reporting.send_empty(Kind::HOST_READY));
    let launch = app.launch(wiring);
    #[cfg(feature = "fault-points")]
    let launch = crate::arm_alone(app, launch);
    let (handle, ended) = run_unsupervised(&launch, ready, watched(watchdog_handle, app, &wire, tid));
    heartbeats.set_application(handle.clone());
    let stopping = wire.clone();
    actix_rt::spawn(async move {
        loop {
            stop_requested(&stopping).await;
            handle.stop();
        }
    });
    let reason = ended.await;
    send_exit_report(&wire, tid, &reason).await;
    Ok(())
}

/// Runs the connection on the application's thread, beside the application.
fn serve(wire: &Arc<ChildLink>) {
    let (draining, reading, reporting, expiring) = (wire.clone(), wire.clone(), wire.clone(), wire.clone());
    // Senders on any thread wake the first and the third task.
    actix_rt::spawn(SafelyWoken::new(async move {
        draining.drain().await;
        die();
    }));
    actix_rt::spawn(async move { reading.read().await });
    actix_rt::spawn(SafelyWoken::new(async move { poll_fn(|cx| reporting.poll_report(cx)).await }));
    actix_rt::spawn(async move {
        let mut interval = tokio::time::interval(EXPIRY_INTERVAL);
        interval.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            interval.tick().await;
            expiring.expire(Time::now());
        }
    });
}

/// Heartbeats of the process, from a thread of their own. The watchdog in this process checks the
/// application's progress: it knows the current handler, and whether the thread was given a CPU. The
/// heartbeats also report a stalled application; the node forwards that to the nodes that watch it.
struct Heartbeats {
    wire: SyncSender<Arc<ChildLink>>,
    hosted: Arc<OnceLock<UnsupervisedHandle>>,
}

impl Heartbeats {
    /// Starts the thread, with one heartbeat each `beat` at least, if set, once the connection exists.
    ///
    /// # Errors
    /// The thread could not be started, and heartbeats are required.
    fn begin(beat: Option<Duration>) -> io::Result<Self> {
        let hosted = Arc::new(OnceLock::new());
        let (wire, connected) = sync_channel::<Arc<ChildLink>>(1);
        let shared = hosted.clone();
        let thread = std::thread::Builder::new().name("beat".to_owned());
        // An error means that no connection follows: this process is about to end.
        let beats = move || {
            if let Ok(wire) = connected.recv() {
                send_beats(&wire, beat, &shared);
            }
        };
        match thread.spawn(beats) {
            Ok(_) => {}
            Err(error) if beat.is_none() => {
                log::warn!(%error, remedy = %remedy(Wanted::Thread, &error), "stalls of this application are not detected: no thread could be started");
            }
            Err(error) => {
                let why =
                    format!("no thread sends its heartbeats: {error}; {}", remedy(Wanted::Thread, &error));
                return Err(io::Error::new(error.kind(), why));
            }
        }
        Ok(Self { wire, hosted })
    }

    /// Passes the connection to the thread.
    fn set_link(&self, wire: Arc<ChildLink>) {
        // An error means that the thread does not exist.
        let _ = self.wire.send(wire);
    }

    /// Passes the application to the thread, once its factory has returned.
    fn set_application(&self, app: UnsupervisedHandle) {
        // Set once.
        let _ = self.hosted.set(app);
    }
}

fn send_beats(wire: &ChildLink, beat: Option<Duration>, hosted: &OnceLock<UnsupervisedHandle>) {
    let (mut stalls, mut has_stalled) = (Stalls::default(), false);
    loop {
        std::thread::sleep(beat.map_or(STALL_CHECK_INTERVAL, |beat| beat.min(STALL_CHECK_INTERVAL)));
        let turns = hosted.get().map(UnsupervisedHandle::turn).into_iter();
        let since = stalls.check(Time::now(), turns).into_values().next();
        if wire.has_reported_all() && (beat.is_some() || since.is_some() || has_stalled) {
            send_beat(wire, since);
            has_stalled = since.is_some();
        }
    }
}

fn send_beat(wire: &ChildLink, stalled: Option<Time>) {
    let (tid, beat) = (wire.tid(), Beat { stalled_since: stalled.map_or(0, Time::as_nanos) });
    wire.send(protocol::frame(Kind::HOST_BEAT, tid, payload::lncl_of(tid.node), &beat));
}

/// Returns the supervision of the application: the node kills its process if it hangs.
fn watched(watchdog_handle: WatchdogHandle, app: &DynApp, wire: &Arc<ChildLink>, tid: Tid) -> Unsupervised {
    let wire = wire.clone();
    let on_hung = move |reason: &Reason| {
        wire.send(protocol::frame(
            Kind::HOST_HUNG,
            tid,
            payload::lncl_of(tid.node),
            &ExitReport::from(reason),
        ));
    };
    Unsupervised {
        watchdog_handle,
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
async fn stop_requested(wire: &ChildLink) {
    let Ok(mut signals) = StopSignals::listen() else { return wire.stop_requested().await };
    tokio::select! {
        () = wire.stop_requested() => {}
        which = signals.recv() => log::info!(which, "a signal asks for a stop"),
    }
}

async fn send_exit_report(wire: &ChildLink, tid: Tid, reason: &Reason) {
    wire.report_last();
    wire.send(protocol::frame(Kind::HOST_ENDED, tid, payload::lncl_of(tid.node), &ExitReport::from(reason)));
    let until = Time::now() + FINAL_SEND_TIMEOUT;
    while !wire.has_sent_all() {
        if Time::now() >= until {
            log::warn!(%tid, waited = ?FINAL_SEND_TIMEOUT, "the node does not read the last frames of this application; it ends without them");
            return;
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}
