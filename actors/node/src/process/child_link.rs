//! The hosted application's end of its connection to the node: reads frames, and sends the application's
//! messages.
//!
//! Each thread that needs data from the node reads the socket itself. The actor's thread reads before each
//! message, since a new message may be more urgent or newer than a waiting one. A thread that resolves a name
//! reads for the answer.

use std::{
    collections::BTreeMap,
    future::poll_fn,
    io,
    sync::{Arc, Mutex, TryLockError},
    task::{Context, Poll, Waker},
    time::Duration,
};

use bytes::BytesMut;
use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::Errno,
    net::{RecvFlags, recv},
};
use sinew_model::config::NodeConfig;
use sinew_protocol::payload::{self, Group};
use sinew_runtime::{
    lock,
    mailbox::Source,
    outcome::{MemberReport, Outcome, ReceiptSink as _, Ticket},
    pending::Pending,
    router::Router,
    sender::{Directory, Sender},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Flags, FrameCodec, Kind, Message},
};
use sinew_session::outlet::{LinkNumber, OutletLimits, SocketWriter};
use tokio::{io::Interest, net::UnixStream, sync::Notify};
use tokio_util::codec::Decoder;

use super::{
    inbox::Inbox,
    protocol::{self, FRAME_BYTES_MAX, Name, NameLookup, Names, Progress, Welcome},
    role::die,
};
use crate::WAITS_MAX;

/// Bytes read at once.
const READ_CHUNK: usize = 16 * 1024;
/// Chunks read before the caller continues.
const READS_MAX: usize = 16;
/// Deadline of the node's answer to a name lookup. A lookup is sent only if the directory is larger than its
/// copy.
const READ_INTERVAL: Duration = Duration::from_millis(250);
/// Maximum number of frames that wait for the node to read. Fewer occur: the progress reports of one window,
/// and the requests of one thread.
const URGENT_MAX: usize = 1_024;

/// The application's end of the connection to its node.
pub(super) struct ChildLink {
    tid: Tid,
    socket: Arc<UnixStream>,
    outlet: Arc<SocketWriter<Arc<UnixStream>>>,
    link: LinkNumber,
    pending: Arc<Pending>,
    incoming: Mutex<Incoming>,
    inbox: Mutex<Inbox>,
    names: Mutex<KnownNames>,
    stop: Notify,
}

/// The copy of the directory in this process.
#[derive(Default)]
struct KnownNames {
    names: BTreeMap<String, Name>,
    complete: bool,
}

impl KnownNames {
    fn apply(&mut self, Names { names, complete }: Names) {
        for name in names {
            if complete && name.tid.is_none() {
                self.names.remove(&name.name);
            } else {
                self.names.insert(name.name.clone(), name);
            }
        }
        self.complete = complete;
    }

    /// Returns the owner of `name`, or `None` if that is unknown. The inner `None` means that the name is
    /// unused.
    fn get(&mut self, name: &str) -> Option<Option<Tid>> {
        let Some(Name { tid, watched, .. }) = self.names.get(name) else {
            return self.complete.then_some(None);
        };
        let (tid, watched) = (tid.map(Tid::from_bits), *watched);
        if !watched {
            // The node sends no changes of this name, so the next lookup goes to the node again.
            self.names.remove(name);
        }
        Some(tid)
    }
}

struct Incoming {
    chunk: Box<[u8]>,
    buffer: BytesMut,
    codec: FrameCodec,
}

impl std::fmt::Debug for ChildLink {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "ChildLink({})", self.tid)
    }
}

impl ChildLink {
    /// Creates the connection of the application that `welcome` describes.
    pub(super) fn new(config: &NodeConfig, socket: Arc<UnixStream>, welcome: Welcome) -> Arc<Self> {
        let limits = OutletLimits {
            queue_capacity: config.mailbox_capacity,
            queue_bytes: config.mailbox_bytes,
            unconfirmed_max: WAITS_MAX,
            payload_max: config.payload_max,
        };
        let outlet = Arc::new(SocketWriter::new(limits));
        let link = outlet.connect(socket.clone(), config.payload_max, None);
        let chunk = vec![0; READ_CHUNK].into_boxed_slice();
        let codec = FrameCodec::new(config.payload_max.max(FRAME_BYTES_MAX));
        let mut names = KnownNames::default();
        names.apply(welcome.names);
        Arc::new(Self {
            tid: Tid::from_bits(welcome.tid),
            socket,
            outlet,
            link,
            pending: Pending::numbered_from(welcome.first_wait, WAITS_MAX),
            incoming: Mutex::new(Incoming { chunk, buffer: BytesMut::new(), codec }),
            inbox: Mutex::new(Inbox::new()),
            names: Mutex::new(names),
            stop: Notify::new(),
        })
    }

    /// Creates the sender of the application, which has sent `sequence` messages in former processes.
    pub(super) fn sender(self: &Arc<Self>, sequence: u64, payload_max: usize) -> Sender {
        let router = Arc::new(Router::through(self.tid.node, self.outlet.clone()));
        let sender = Sender::new(self.tid, router, self.clone(), self.pending.clone(), payload_max);
        // The node's number is trusted.
        let _ = sender.count_on_from(sequence, sequence);
        sender
    }

    /// Writes the waiting data as the node reads. Ends when the node is gone.
    pub(super) async fn drain(&self) -> io::Error {
        let drain = self.outlet.drain(self.link);
        tokio::pin!(drain);
        poll_fn(|cx| {
            let drained = drain.as_mut().poll(cx);
            if self.has_reported_all() {
                let waker = lock(&self.inbox).progress_was_reported();
                waker.into_iter().for_each(Waker::wake);
            }
            drained
        })
        .await
    }

    /// Expires messages that the node does not read.
    pub(super) fn expire(&self, now: Time) {
        self.outlet.expire(now);
    }

    /// Returns whether the kernel has all data that was sent.
    pub(super) fn has_sent_all(&self) -> bool {
        self.outlet.waiting() == 0
    }

    /// Reads whenever data arrives. Never ends.
    pub(super) async fn read(&self) {
        loop {
            // An error of the reactor. The thread that waits for the hang-up still works.
            if self.socket.readable().await.is_err() {
                return std::future::pending().await;
            }
            let read = self.socket.try_io(Interest::READABLE, || {
                if self.read_available() { Err(io::ErrorKind::WouldBlock.into()) } else { Ok(()) }
            });
            if read.is_ok() {
                tokio::task::yield_now().await;
            }
        }
    }

    /// Resolves when the node asks for an orderly stop.
    pub(super) async fn stop_requested(&self) {
        self.stop.notified().await;
    }

    /// Returns the TID of the application.
    pub(super) const fn tid(&self) -> Tid {
        self.tid
    }

    /// Sends a frame without a payload to the node.
    pub(super) fn send_empty(&self, kind: Kind) {
        self.send(protocol::empty_frame(kind, self.tid, payload::lncl_of(self.tid.node)));
    }

    /// Sends a frame ahead of all messages.
    pub(super) fn send(&self, message: Message) {
        // An error means that the node is gone, and this process is about to end.
        let _ = self.outlet.submit_urgent(message, URGENT_MAX);
    }

    /// Returns whether the kernel, which outlives this process, has all frames that were sent ahead of
    /// messages.
    pub(super) fn has_reported_all(&self) -> bool {
        self.outlet.urgent_left() == 0
    }

    /// Reports a finished message if the next one is not requested. Never ready.
    pub(super) fn poll_report(&self, cx: &Context<'_>) -> Poll<()> {
        let unreported = lock(&self.inbox).poll_unreported(cx);
        unreported.into_iter().for_each(|progress| self.send(progress.frame(self.tid)));
        Poll::Pending
    }

    /// Reports the end of the last message.
    pub(super) fn report_last(&self) {
        let unreported = lock(&self.inbox).take_unreported();
        unreported.into_iter().for_each(|progress| self.send(progress.frame(self.tid)));
    }

    /// Reads the data that has arrived, without waiting. Returns whether that was all.
    fn read_available(&self) -> bool {
        let mut incoming = lock(&self.incoming);
        let Incoming { chunk, buffer, codec } = &mut *incoming;
        for _ in 0..READS_MAX {
            let room = FrameCodec::room(buffer, chunk.len());
            match recv(&*self.socket, &mut chunk[..room], RecvFlags::DONTWAIT) {
                Ok((_, 0)) => die(),
                Ok((_, count)) => buffer.extend_from_slice(&chunk[..count]),
                Err(Errno::AGAIN) => return true,
                Err(Errno::INTR) => {}
                Err(_) => die(),
            }
            loop {
                match codec.decode(buffer) {
                    Ok(Some(message)) => self.handle(message),
                    Ok(None) => break,
                    Err(error) => {
                        sinew_runtime::log::error!(%error, "the node sent a frame that this process cannot read");
                        die();
                    }
                }
            }
        }
        false
    }

    fn handle(&self, message: Message) {
        let header = &message.header;
        if header.flags.has(Flags::OUTCOME) {
            let ticket =
                Ticket { source: self.tid, destination: header.source, correlation: header.correlation };
            if header.kind == Kind::MEMBERS {
                let reports = MemberReport::decode(&message.payload).unwrap_or_default();
                self.pending.members(ticket, &reports);
            } else if let Some(outcome) = message.payload.first().and_then(|code| Outcome::from_code(*code)) {
                self.outlet.confirm(ticket, outcome);
            }
        } else if header.flags.has(Flags::REPLY) {
            // Dropped in any case: the requester may no longer wait for it.
            let _ = self.pending.intercept(message);
        } else if header.kind == Kind::HOST_STOP {
            self.stop.notify_one();
        } else if header.kind == Kind::HOST_NAMES {
            if let Ok(names) = payload::read(&message.payload) {
                lock(&self.names).apply(names);
            }
        } else {
            let (progress, waker) = lock(&self.inbox).push(message);
            progress.into_iter().for_each(|progress| self.send(progress.frame(self.tid)));
            waker.into_iter().for_each(Waker::wake);
        }
    }

    fn poll_claimed(
        &self,
        claim: impl FnOnce(&mut Inbox) -> Option<Progress>,
        cx: &Context<'_>,
    ) -> Poll<Option<Message>> {
        self.read_available();
        let mut inbox = lock(&self.inbox);
        if let Some(progress) = claim(&mut inbox) {
            self.send(progress.frame(self.tid));
        }
        inbox.poll_claimed(self.has_reported_all(), cx).map(Some)
    }
}

impl Source for ChildLink {
    fn poll_take(&self, cx: &mut Context<'_>) -> Poll<Option<Message>> {
        self.poll_claimed(Inbox::claim, cx)
    }

    fn poll_event(&self, cx: &mut Context<'_>) -> Poll<Option<Message>> {
        self.poll_claimed(Inbox::claim_event, cx)
    }

    fn backlog(&self) -> Option<(usize, u64)> {
        match self.inbox.try_lock() {
            Ok(inbox) => Some(inbox.backlog()),
            Err(TryLockError::Poisoned(poisoned)) => Some(poisoned.into_inner().backlog()),
            Err(TryLockError::WouldBlock) => None,
        }
    }

    fn finish(&self, outcome: Outcome) {
        let waker = lock(&self.inbox).finish(outcome);
        waker.into_iter().for_each(Waker::wake);
    }
}

impl Directory for ChildLink {
    fn resolve(&self, name: &str) -> Option<Tid> {
        // New data may change the answer.
        self.read_available();
        if let Some(known) = lock(&self.names).get(name) {
            return known;
        }
        self.send(protocol::frame(
            Kind::HOST_LOOK,
            self.tid,
            Tid::NONE,
            &NameLookup { name: name.to_owned() },
        ));
        let until = Time::now() + READ_INTERVAL;
        loop {
            let left = until.since(Time::now());
            if left.is_zero() {
                sinew_runtime::log::warn!(
                    name,
                    "the node did not answer the lookup of this name within {READ_INTERVAL:?}"
                );
                return None;
            }
            let wait = Timespec { tv_sec: 0, tv_nsec: i64::from(left.subsec_nanos()) };
            // An error is a signal; the loop checks the clock again.
            let _ = poll(&mut [PollFd::new(&*self.socket, PollFlags::IN)], Some(&wait));
            self.read_available();
            if let Some(known) = lock(&self.names).get(name) {
                return known;
            }
        }
    }

    fn set_member(&self, _: AppAddress, group: AppAddress, member: bool) {
        let message = payload::frame(Kind::LNCL_GROUP, self.tid, Tid::NONE, &Group { group, member });
        self.send(message);
    }
}
