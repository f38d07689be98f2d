//! Puts, queries and replies to Zenoh: a thread and a queue for each class, so that a full link for Bulk keeps
//! nothing of Control waiting.

use std::{
    io,
    sync::{
        Arc, Mutex,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread,
    time::Duration,
};

use sinew::message::Class;
use sinew_zenoh_rules::{
    Encoding,
    qos::{self, Qos},
};
use tokio::sync::mpsc::Sender;
use tracing::warn;
use zenoh::{
    Session, Wait,
    key_expr::KeyExpr,
    qos::{CongestionControl, Priority, Reliability},
    query::{ConsolidationMode, Query, Reply},
    sample::Locality,
};

use crate::shared::lock;

/// The answer of a Zenoh program to a request; `None`: there is none.
pub(crate) type Answer = Option<Result<Vec<u8>, String>>;

/// Maximum number of bytes of an error that a Zenoh program sends.
const ERROR_MAX: usize = 256;

/// Something to send to Zenoh.
pub(crate) enum Job {
    Put { key: String, payload: Vec<u8>, encoding: Encoding, attachment: String },
    Get(Box<Get>),
    Reply { query: Query, result: Result<Vec<u8>, Vec<u8>>, encoding: Encoding },
}

/// A request for Zenoh programs.
pub(crate) struct Get {
    pub(crate) key: String,
    pub(crate) payload: Vec<u8>,
    pub(crate) encoding: Encoding,
    pub(crate) attachment: String,
    pub(crate) within: Duration,
    pub(crate) answer: Pending,
}

/// A request that waits for its answer. It gets exactly one: none, if it is dropped.
pub(crate) struct Pending {
    pub(crate) number: u64,
    pub(crate) to: Option<Sender<(u64, Answer)>>,
}

impl Pending {
    fn answer(&mut self, answer: Answer) {
        if let Some(to) = self.to.take() {
            // It has room for all requests that wait; without a reader nothing waits any more.
            let _ = to.try_send((self.number, answer));
        }
    }
}

impl Drop for Pending {
    fn drop(&mut self) {
        self.answer(None);
    }
}

/// The queues to Zenoh.
#[derive(Clone)]
pub(crate) struct ZenohSender {
    queues: [SyncSender<Job>; 3],
}

impl ZenohSender {
    /// Starts the threads.
    pub(crate) fn start(session: &Session, room: usize) -> io::Result<Self> {
        let start = |class: Class| {
            let (queue, jobs) = sync_channel(room);
            let session = session.clone();
            let thread = thread::Builder::new().name(format!("to-zenoh-{class:?}").to_lowercase());
            thread.spawn(move || run(&session, Qos::of(class), &jobs))?;
            Ok::<_, io::Error>(queue)
        };
        Ok(Self { queues: [start(Class::Control)?, start(Class::Stream)?, start(Class::Bulk)?] })
    }

    /// Sends, unless the queue is full.
    ///
    /// # Errors
    /// It is full.
    pub(crate) fn send(&self, class: Class, job: Job) -> Result<(), Job> {
        let queue = &self.queues[class as usize];
        queue.try_send(job).map_err(|error| match error {
            std::sync::mpsc::TrySendError::Full(job) | std::sync::mpsc::TrySendError::Disconnected(job) => {
                job
            }
        })
    }

    /// Answers a query. Without room it ends without a reply.
    pub(crate) fn reply(&self, query: Query, result: Result<Vec<u8>, Vec<u8>>, encoding: Encoding) -> bool {
        self.send(Class::Control, Job::Reply { query, result, encoding }).is_ok()
    }
}

/// Runs the jobs of a class until all senders have ended.
fn run(session: &Session, qos: Qos, jobs: &Receiver<Job>) {
    for job in jobs {
        let result = match job {
            Job::Put { key, payload, encoding, attachment } => {
                put(session, qos, (key, payload), (encoding, attachment))
            }
            Job::Get(get) => ask(session, qos, *get),
            Job::Reply { query, result, encoding } => reply(&query, result, encoding),
        };
        if let Err(error) = result
            && !session.is_closed()
        {
            warn!("zenoh: {error}");
        }
    }
}

fn put(
    session: &Session,
    qos: Qos,
    (key, payload): (String, Vec<u8>),
    (encoding, attachment): (Encoding, String),
) -> zenoh::Result<()> {
    let put = session.put(KeyExpr::try_from(key)?, payload).encoding(encoding_of(encoding));
    let put = put.attachment(attachment).allowed_destination(Locality::Remote);
    let put =
        put.priority(priority(qos.priority)).congestion_control(congestion(qos)).express(qos.is_express);
    put.reliability(if qos.is_reliable { Reliability::Reliable } else { Reliability::BestEffort }).wait()
}

fn ask(session: &Session, qos: Qos, get: Get) -> zenoh::Result<()> {
    let pending = Arc::new(Mutex::new(get.answer));
    let callback = move |reply: Reply| lock(&pending).answer(Some(answer_of(&reply)));
    let query =
        session.get(KeyExpr::try_from(get.key)?).payload(get.payload).encoding(encoding_of(get.encoding));
    let query = query.attachment(get.attachment).allowed_destination(Locality::Remote).timeout(get.within);
    let query = query.priority(priority(qos.priority)).congestion_control(congestion(qos));
    // The first reply counts. Otherwise zenoh keeps it until all programs have answered.
    let query = query.express(qos.is_express).consolidation(ConsolidationMode::None);
    query.callback(callback).wait()
}

fn answer_of(reply: &Reply) -> Result<Vec<u8>, String> {
    match reply.result() {
        Ok(sample) => Ok(sample.payload().to_bytes().into_owned()),
        Err(error) => {
            let bytes = error.payload().to_bytes();
            Err(String::from_utf8_lossy(&bytes[..bytes.len().min(ERROR_MAX)]).into_owned())
        }
    }
}

fn reply(query: &Query, result: Result<Vec<u8>, Vec<u8>>, encoding: Encoding) -> zenoh::Result<()> {
    let key = query.key_expr().clone();
    match result {
        Ok(payload) => query.reply(key, payload).encoding(encoding_of(encoding)).wait(),
        Err(error) => query.reply_err(error).encoding(encoding_of(encoding)).wait(),
    }
}

fn encoding_of(encoding: Encoding) -> zenoh::bytes::Encoding {
    match encoding {
        Encoding::MessagePack => zenoh::bytes::Encoding::from("application/msgpack"),
        Encoding::Json => zenoh::bytes::Encoding::APPLICATION_JSON,
        Encoding::Raw => zenoh::bytes::Encoding::ZENOH_BYTES,
    }
}

const fn priority(priority: qos::Priority) -> Priority {
    match priority {
        qos::Priority::RealTime => Priority::RealTime,
        qos::Priority::InteractiveHigh => Priority::InteractiveHigh,
        qos::Priority::Background => Priority::Background,
    }
}

const fn congestion(qos: Qos) -> CongestionControl {
    if qos.blocks { CongestionControl::Block } else { CongestionControl::Drop }
}
