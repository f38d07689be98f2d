//! What a hosted application knows of its node: reads its words, and sends it the application's.
//!
//! Whoever needs something from the node reads the socket himself, on his own thread: the actor's thread before each
//! message, so that what came just now may be more urgent or newer than what waits, and whoever asks for a name.

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
use sinew_runtime::{
    mailbox::Source,
    outcome::{MemberReport, Outcome, ReceiptSink as _, Ticket},
    pending::Pending,
    router::Router,
    sender::{Directory, Sender},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Flags, FrameCodec, Kind, Message},
};
use tokio::{io::Interest, net::UnixStream, sync::Notify};
use tokio_util::codec::Decoder;

use super::{
    inbox::Inbox,
    role::die,
    words::{self, Look, Name, Names, Turn, WORDS_BYTES_MAX, Welcome},
};
use crate::{
    config::NodeConfig,
    lncl::payload::{self, Group},
    node::WAITS_MAX,
    outlet::{LinkNumber, OutletLimits, StreamOutlet},
    stores::lock,
};

/// Bytes that are read at once.
const READ_CHUNK: usize = 16 * 1024;
/// Chunks that are read before the caller has its turn.
const READS_PER_LOOK: usize = 16;
/// Longest time that a question for a name takes. Asked only where the directory is larger than the copy of it.
const LOOKING: Duration = Duration::from_millis(250);
/// Frames that wait for the node to read at most. There are fewer: turns of one window, and orders of one thread.
const URGENT_MAX: usize = 1_024;

/// The application's end of the connection to its node.
pub(super) struct Wire {
    tid: Tid,
    socket: Arc<UnixStream>,
    outlet: Arc<StreamOutlet<Arc<UnixStream>>>,
    link: LinkNumber,
    pending: Arc<Pending>,
    incoming: Mutex<Incoming>,
    inbox: Mutex<Inbox>,
    names: Mutex<KnownNames>,
    stop: Notify,
}

/// What this process knows of the directory.
#[derive(Default)]
struct KnownNames {
    names: BTreeMap<String, Name>,
    complete: bool,
}

impl KnownNames {
    fn take(&mut self, Names { names, complete }: Names) {
        for name in names {
            if complete && name.tid.is_none() {
                self.names.remove(&name.name);
            } else {
                self.names.insert(name.name.clone(), name);
            }
        }
        self.complete = complete;
    }

    /// Who has `name`, if that is known.
    fn get(&mut self, name: &str) -> Option<Option<Tid>> {
        let Some(Name { tid, watched, .. }) = self.names.get(name) else {
            return self.complete.then_some(None);
        };
        let (tid, watched) = (tid.map(Tid::from_bits), *watched);
        if !watched {
            // Nobody tells when it changes: the next question is put to the node again.
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

impl std::fmt::Debug for Wire {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Wire({})", self.tid)
    }
}

impl Wire {
    /// The connection of the application that the node has welcomed so.
    pub(super) fn new(config: &NodeConfig, socket: Arc<UnixStream>, welcome: Welcome) -> Arc<Self> {
        let limits = OutletLimits {
            queue_capacity: config.mailbox_capacity,
            queue_bytes: config.mailbox_bytes,
            unconfirmed_max: WAITS_MAX,
            payload_max: config.payload_max,
        };
        let outlet = Arc::new(StreamOutlet::new(limits));
        let link = outlet.connect(socket.clone(), config.payload_max, None);
        let chunk = vec![0; READ_CHUNK].into_boxed_slice();
        let codec = FrameCodec::new(config.payload_max.max(WORDS_BYTES_MAX));
        let mut names = KnownNames::default();
        names.take(welcome.names);
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

    /// The sending side of the application, which has sent `sequence` messages in former processes.
    pub(super) fn sender(self: &Arc<Self>, sequence: u64, payload_max: usize) -> Sender {
        let router = Arc::new(Router::through(self.tid.node, self.outlet.clone()));
        let sender = Sender::new(self.tid, router, self.clone(), self.pending.clone(), payload_max);
        // The node's word is not doubted.
        let _ = sender.count_on_from(sequence, sequence);
        sender
    }

    /// Writes what waits whenever the node reads. Ends when the node is gone.
    pub(super) async fn drain(&self) -> io::Error {
        let drain = self.outlet.drain(self.link);
        tokio::pin!(drain);
        poll_fn(|cx| {
            let drained = drain.as_mut().poll(cx);
            if self.has_said_all() {
                let waker = lock(&self.inbox).told();
                waker.into_iter().for_each(Waker::wake);
            }
            drained
        })
        .await
    }

    /// Lets expire what the node does not read.
    pub(super) fn expire(&self, now: Time) {
        self.outlet.expire(now);
    }

    /// Whether the kernel has everything that was sent.
    pub(super) fn has_sent_all(&self) -> bool {
        self.outlet.waiting() == 0
    }

    /// Reads whenever something comes. Never ends.
    pub(super) async fn read(&self) {
        loop {
            // An error of the reactor's: the thread that waits for the hang-up is left.
            if self.socket.readable().await.is_err() {
                return std::future::pending().await;
            }
            let read = self.socket.try_io(Interest::READABLE, || {
                if self.look() { Err(io::ErrorKind::WouldBlock.into()) } else { Ok(()) }
            });
            if read.is_ok() {
                tokio::task::yield_now().await;
            }
        }
    }

    /// Resolves when the node asks for an orderly stop.
    pub(super) async fn stop_asked(&self) {
        self.stop.notified().await;
    }

    /// Whose connection it is.
    pub(super) const fn tid(&self) -> Tid {
        self.tid
    }

    /// A frame without a payload, for the node.
    pub(super) fn say_kind(&self, kind: Kind) {
        self.say(words::bare(kind, self.tid, payload::lncl_of(self.tid.node)));
    }

    /// Says something ahead of all messages.
    pub(super) fn say(&self, message: Message) {
        // Not taken: the node is gone, and this process ends at once.
        let _ = self.outlet.submit_urgent(message, URGENT_MAX);
    }

    /// Whether everything that was said ahead of messages is in the kernel's hands, which outlive this process.
    pub(super) fn has_said_all(&self) -> bool {
        self.outlet.urgent_left() == 0
    }

    /// Tells of a message that has ended, if nobody asks for the next one. Never ready.
    pub(super) fn poll_tell(&self, cx: &Context<'_>) -> Poll<()> {
        let untold = lock(&self.inbox).poll_untold(cx);
        untold.into_iter().for_each(|turn| self.say(turn.frame(self.tid)));
        Poll::Pending
    }

    /// Tells of the last message.
    pub(super) fn tell_last(&self) {
        let untold = lock(&self.inbox).untold();
        untold.into_iter().for_each(|turn| self.say(turn.frame(self.tid)));
    }

    /// Reads what has come, without waiting. Returns whether that was all.
    fn look(&self) -> bool {
        let mut incoming = lock(&self.incoming);
        let Incoming { chunk, buffer, codec } = &mut *incoming;
        for _ in 0..READS_PER_LOOK {
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
                    Ok(Some(message)) => self.take(message),
                    Ok(None) => break,
                    Err(error) => {
                        crate::log::error!(%error, "the node does not speak the language of this process");
                        die();
                    }
                }
            }
        }
        false
    }

    fn take(&self, message: Message) {
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
            // It is taken in any case: whoever asked may wait no more.
            let _ = self.pending.intercept(message);
        } else if header.kind == Kind::HOST_STOP {
            self.stop.notify_one();
        } else if header.kind == Kind::HOST_NAMES {
            if let Ok(names) = payload::read(&message.payload) {
                lock(&self.names).take(names);
            }
        } else {
            let (turn, waker) = lock(&self.inbox).push(message);
            turn.into_iter().for_each(|turn| self.say(turn.frame(self.tid)));
            waker.into_iter().for_each(Waker::wake);
        }
    }

    fn poll_claimed(
        &self,
        claim: impl FnOnce(&mut Inbox) -> Option<Turn>,
        cx: &Context<'_>,
    ) -> Poll<Option<Message>> {
        self.look();
        let mut inbox = lock(&self.inbox);
        if let Some(turn) = claim(&mut inbox) {
            self.say(turn.frame(self.tid));
        }
        inbox.poll_claimed(self.has_said_all(), cx).map(Some)
    }
}

impl Source for Wire {
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

impl Directory for Wire {
    fn resolve(&self, name: &str) -> Option<Tid> {
        // What has come may change the answer.
        self.look();
        if let Some(known) = lock(&self.names).get(name) {
            return known;
        }
        self.say(words::frame(Kind::HOST_LOOK, self.tid, Tid::NONE, &Look { name: name.to_owned() }));
        let until = Time::now() + LOOKING;
        loop {
            let left = until.since(Time::now());
            if left.is_zero() {
                crate::log::warn!(name, "the node did not say within {LOOKING:?} who has this name");
                return None;
            }
            let wait = Timespec { tv_sec: 0, tv_nsec: i64::from(left.subsec_nanos()) };
            // An error is a signal that came: the clock is asked again.
            let _ = poll(&mut [PollFd::new(&*self.socket, PollFlags::IN)], Some(&wait));
            self.look();
            if let Some(known) = lock(&self.names).get(name) {
                return known;
            }
        }
    }

    fn set_member(&self, _: AppAddress, group: AppAddress, member: bool) {
        let message = payload::frame(Kind::LNCL_GROUP, self.tid, Tid::NONE, &Group { group, member });
        self.say(message);
    }
}
