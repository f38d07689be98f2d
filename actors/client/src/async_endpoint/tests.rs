//! Properties that only tasks have: other tasks run during a wait, and futures are dropped before they are
//! ready.

mod barriers;
mod links;
mod protected;

use std::{
    cell::Cell,
    future::Future,
    pin::pin,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc::{SyncSender, sync_channel},
    },
    task::{Context, Poll, Wake, Waker},
    thread::{self, JoinHandle},
    time::Duration,
};

use futures_util::poll;
use sinew_lncl::testing::{TestNode, WATCHDOG};
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    parameters::LEAD,
    tid::Tid,
    time::Time,
    wire::{Class, Header, Kind, Message, Payload},
};
use sinew_shm::Spin;
use tokio::{
    runtime::{Builder, Runtime},
    time::timeout,
};

use crate::{
    ApiError, AsyncEndpoint, NodeApi, Registration, Transport,
    tests::{TORQUE, Torque},
};

const RAW: Kind = Kind::named("test.raw");
const BOTH: [Transport; 2] = [Transport::Ring, Transport::Socket];

fn runtime() -> Runtime {
    Builder::new_current_thread().enable_all().build().unwrap()
}

async fn endpoint(node: &TestNode, transport: Transport) -> AsyncEndpoint {
    let registration = Registration::new().transport(transport).stall_timeout(WATCHDOG);
    let api = NodeApi::connect(node.path()).unwrap();
    api.register_transport_address_async(registration).await.unwrap()
}

fn numbered(number: u64, length: usize, tid: Tid, to: Tid) -> Message {
    let mut header = Header::new(RAW, tid, to);
    header.class = Class::Bulk;
    let mut payload = vec![7; length.max(8)];
    payload[..8].copy_from_slice(&number.to_le_bytes());
    Message::new(header, payload.into())
}

fn number_of(bytes: &[u8]) -> u64 {
    bytes.first_chunk().map_or(u64::MAX, |bytes| u64::from_le_bytes(*bytes))
}

#[test]
fn futures_are_send() {
    fn moves<T: Send>(value: T) -> T {
        value
    }
    let node = TestNode::start();
    let app = node.local(1);
    runtime().block_on(async {
        let mut endpoint = endpoint(&node, Transport::Ring).await;
        let (to, tid) = (app.tid, endpoint.tid());
        let task = tokio::spawn(async move {
            moves(endpoint.send(to, &TORQUE)).await.unwrap();
            moves(endpoint.message(Tid::NONE, &TORQUE).confirmed(WATCHDOG)).await.unwrap();
            let message = endpoint.create_message(to, RAW, 3).unwrap();
            moves(endpoint.loaned(message).send()).await.unwrap();
            // A transaction of no application does not begin.
            assert!(moves(endpoint.set_together(Vec::new(), LEAD, WATCHDOG)).await.is_err());
            moves(endpoint.receive()).await.unwrap().source()
        });
        node.router().send(Message::typed(to, tid, &TORQUE)).unwrap();
        assert_eq!(task.await.unwrap(), to);
    });
}

#[test]
fn many_endpoints_share_one_thread() {
    let node = TestNode::start();
    runtime().block_on(async {
        for transport in BOTH {
            let mut asking = endpoint(&node, transport).await;
            let mut replying = endpoint(&node, transport).await;
            let to = replying.tid();
            let echo = async {
                for _ in 0..100 {
                    let request = replying.receive().await.unwrap();
                    let mut reply = replying.create_message(request.source(), RAW, 8).unwrap();
                    reply.copy_from_slice(request.bytes());
                    replying.loaned(reply).reply_to(&request).await.unwrap();
                }
            };
            let ask = async {
                for number in 0..100_u64 {
                    let mut request = asking.create_message(to, RAW, 8).unwrap();
                    request.copy_from_slice(&number.to_le_bytes());
                    let reply = asking.loaned(request).ask_raw(WATCHDOG).await.unwrap();
                    assert_eq!(number_of(reply.bytes()), number);
                }
            };
            tokio::join!(echo, ask);
        }
    });
}

#[test]
fn message_behind_expired_ones_is_received_at_once() {
    for transport in BOTH {
        // Given: an inbox is filled with messages that have expired, and one more was read with them
        let node = TestNode::start();
        runtime().block_on(async {
            let registration = Registration::new().transport(transport).inbox_capacity(4);
            let api = NodeApi::connect(node.path()).unwrap();
            let mut endpoint = api.register_transport_address_async(registration).await.unwrap();
            let sent = Time::now();
            for number in 1..=5 {
                let mut message = numbered(number, 8, node.local(1).tid, endpoint.tid());
                message.header.sent = sent;
                message.header.time_to_live_us = if number < 5 { 50_000 } else { 0 };
                node.router().send(message).unwrap();
            }
            tokio::time::sleep(Duration::from_millis(60)).await;
            // When, then
            let received = timeout(WATCHDOG, endpoint.receive()).await.expect("it waits already").unwrap();
            assert_eq!(number_of(received.bytes()), 5);
        });
    }
}

#[test]
fn dropped_receive_loses_no_message() {
    const COUNT: u64 = 400;
    for transport in BOTH {
        let node = TestNode::start();
        let from = node.local(1).tid;
        runtime().block_on(async {
            let mut endpoint = endpoint(&node, transport).await;
            let (tid, received) = (endpoint.tid(), Arc::new(AtomicU64::new(0)));
            let (router, seen) = (node.router().clone(), received.clone());
            let sending = thread::spawn(move || {
                for number in 0..COUNT {
                    // The number of messages in flight stays small enough that none is refused.
                    while number >= seen.load(Ordering::Acquire) + 100 {
                        thread::yield_now();
                    }
                    let length = if number % 40 == 0 { 100_000 } else { 8 };
                    router.send(numbered(number, length, from, tid)).unwrap();
                }
            });
            for number in 0..COUNT {
                // Polled once and dropped, until one is ready at its first poll.
                let message = loop {
                    if let Poll::Ready(message) = poll!(pin!(endpoint.receive())) {
                        break message.unwrap();
                    }
                    tokio::task::yield_now().await;
                };
                assert_eq!(number_of(message.bytes()), number);
                received.store(number, Ordering::Release);
            }
            sending.join().unwrap();
        });
    }
}

#[test]
fn receiving_available_messages_yields_to_other_tasks() {
    // More messages than tokio's cooperative budget of a task, within the capacity of a socket.
    const COUNT: u64 = 200;
    for transport in BOTH {
        let node = TestNode::start();
        let from = node.local(1).tid;
        runtime().block_on(async {
            // Given: an endpoint with many waiting messages and more on the way, and another task
            let mut endpoint = endpoint(&node, transport).await;
            let tid = endpoint.tid();
            node.router().send(numbered(COUNT, 8, from, tid)).unwrap();
            drop(endpoint.receive().await.unwrap());
            for number in 0..COUNT {
                node.router().send(numbered(number, 8, from, tid)).unwrap();
            }
            let turns = Arc::new(AtomicU64::new(0));
            let counting = turns.clone();
            tokio::spawn(async move {
                loop {
                    counting.fetch_add(1, Ordering::Relaxed);
                    tokio::task::yield_now().await;
                }
            });
            // When
            for number in 0..COUNT {
                assert_eq!(number_of(endpoint.receive().await.unwrap().bytes()), number);
            }
            // Then
            assert!(turns.load(Ordering::Relaxed) > 0, "it had the thread for itself: {transport:?}");
        });
    }
}

/// Keeps LNCL from doing anything, until it is dropped.
struct BlockedRegistry {
    release: Option<SyncSender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl BlockedRegistry {
    async fn begin(node: &TestNode, endpoint: &mut AsyncEndpoint) -> Self {
        let (held, is_held) = sync_channel(1);
        let (release, released) = sync_channel::<()>(1);
        let thread = node.with_registry_held(move || {
            held.send(()).unwrap();
            // An error is the release, too.
            let _ = released.recv();
        });
        is_held.recv_timeout(WATCHDOG).expect("the registry is held");
        // For this it needs the registry.
        assert!(timeout(Duration::from_millis(20), endpoint.resolve("anybody", WATCHDOG)).await.is_err());
        Self { release: Some(release), thread: Some(thread) }
    }
}

impl Drop for BlockedRegistry {
    fn drop(&mut self) {
        drop(self.release.take());
        drop(self.thread.take().map(JoinHandle::join));
    }
}

#[test]
fn send_without_room_yields_until_there_is_room() {
    const COUNT: u64 = 20;
    for transport in BOTH {
        let node = TestNode::start();
        let app = node.local(1);
        runtime().block_on(async {
            let mut endpoint = endpoint(&node, transport).await;
            let blocked = BlockedRegistry::begin(&node, &mut endpoint).await;
            let sent = Cell::new(0);
            let sending = async {
                for number in 0..COUNT {
                    let mut message = endpoint.create_message(app.tid, RAW, 100_000).unwrap();
                    message[..8].copy_from_slice(&number.to_le_bytes());
                    endpoint.loaned(message).send().await.unwrap();
                    sent.set(number + 1);
                }
            };
            let others = async {
                // The same count twice, some time apart: it waits, while this runs.
                let mut last = 0;
                while last == 0 || sent.get() != last {
                    last = sent.get();
                    tokio::time::sleep(Duration::from_millis(50)).await;
                }
                assert!(last < COUNT, "there is room for all of it");
                drop(blocked);
            };
            tokio::join!(sending, others);
            for number in 0..COUNT {
                assert_eq!(number_of(&app.next().payload), number);
            }
        });
    }
}

#[test]
fn send_fails_after_stall_timeout_without_later_delivery() {
    for transport in BOTH {
        let node = TestNode::start();
        let app = node.local(1);
        runtime().block_on(async {
            let registration =
                Registration::new().transport(transport).stall_timeout(Duration::from_millis(30));
            let api = NodeApi::connect(node.path()).unwrap();
            let mut endpoint = api.register_transport_address_async(registration).await.unwrap();
            let blocked = BlockedRegistry::begin(&node, &mut endpoint).await;
            let mut sent = 0_u64;
            let error = loop {
                let mut message = endpoint.create_message(app.tid, RAW, 1_000).unwrap();
                message[..8].copy_from_slice(&sent.to_le_bytes());
                match endpoint.loaned(message).send().await {
                    Ok(()) => sent += 1,
                    Err(error) => break error,
                }
            };
            assert!(matches!(error, ApiError::Stalled(_)), "{error}");
            drop(blocked);
            for number in 0..sent {
                assert_eq!(number_of(&app.next().payload), number);
            }
            // Until then room may still be waited for.
            while endpoint.send(app.tid, &TORQUE).await.is_err() {}
            assert_eq!(app.next().decode::<Torque>().unwrap(), TORQUE);
        });
    }
}

#[test]
fn dropped_long_send_arrives_whole_or_not_at_all() {
    for transport in BOTH {
        let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
        let app = node.local(1);
        runtime().block_on(async {
            let mut endpoint = endpoint(&node, transport).await;
            for number in 0..20_u64 {
                let blocked = BlockedRegistry::begin(&node, &mut endpoint).await;
                let mut long = endpoint.create_message(app.tid, RAW, 900_000).unwrap();
                long[..8].copy_from_slice(&number.to_le_bytes());
                assert!(poll!(pin!(endpoint.loaned(long).send())).is_pending(), "so much does not fit");
                drop(blocked);
                endpoint.send(app.tid, &TORQUE).await.unwrap();
                let first = app.next();
                if first.header.kind == RAW {
                    assert_eq!((number_of(&first.payload), first.payload.len()), (number, 900_000));
                    assert_eq!(app.next().header.kind, Torque::KIND);
                }
            }
        });
    }
}

#[test]
fn settlement_on_other_thread_is_sent_during_wait() {
    for transport in BOTH {
        let node = TestNode::start();
        let app = node.local(1);
        runtime().block_on(async {
            let mut endpoint = endpoint(&node, transport).await;
            let outcome = node.send_confirmed(app.tid, endpoint.tid(), &TORQUE);
            let received = endpoint.receive().await.unwrap();
            let settling = thread::spawn(move || received.settle(Outcome::Rejected(Rejection::ByHandler)));
            assert!(timeout(Duration::from_millis(1), endpoint.receive()).await.is_err());
            settling.join().unwrap();
            assert_eq!(outcome.recv_timeout(WATCHDOG), Ok(Outcome::Rejected(Rejection::ByHandler)));
        });
    }
}

#[test]
fn dropped_registration_releases_its_name() {
    let node = TestNode::start();
    runtime().block_on(async {
        let api = NodeApi::connect(node.path()).unwrap();
        let waiting = Registration::new().name("knee").requires(["nobody"]).deadline(WATCHDOG);
        let registering = api.register_transport_address_async(waiting);
        assert!(timeout(Duration::from_millis(50), registering).await.is_err());
        let knee = Registration::new().name("knee");
        timeout(WATCHDOG, async {
            while api.register_transport_address_async(knee.clone()).await.is_err() {}
        })
        .await
        .expect("the name is free");
    });
}

/// Counts how often it is woken.
#[derive(Default)]
struct Wakes(AtomicU64);

impl Wake for Wakes {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

#[test]
fn task_spins_before_sleep_only_if_requested() {
    for (spin, looks) in [(Spin::Off, false), (Spin::For(WATCHDOG), true)] {
        let node = TestNode::start();
        let app = node.local(1);
        runtime().block_on(async {
            // given: nothing to receive
            let api = NodeApi::connect(node.path()).unwrap();
            let request = Registration::new().spin(spin);
            let mut endpoint = api.register_transport_address_async(request).await.unwrap();
            let _ = timeout(Duration::from_millis(30), endpoint.receive()).await;
            let tid = endpoint.tid();
            let wakes = Arc::new(Wakes::default());
            let waker = Waker::from(wakes.clone());
            let mut receiving = pin!(endpoint.receive());
            // when
            assert!(receiving.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
            tokio::task::yield_now().await;
            // then: it requests another poll at once, or sleeps
            assert_eq!(wakes.0.load(Ordering::Relaxed) > 0, looks, "{spin:?}");
            node.router().send(Message::typed(app.tid, tid, &TORQUE)).unwrap();
            drop(timeout(WATCHDOG, receiving).await.expect("it comes").unwrap());
        });
    }
}

#[test]
fn spinning_task_keeps_its_deadlines() {
    let node = TestNode::start();
    let app = node.local(1);
    runtime().block_on(async {
        let api = NodeApi::connect(node.path()).unwrap();
        let request = Registration::new().spin(Spin::For(10 * WATCHDOG));
        let mut endpoint = api.register_transport_address_async(request).await.unwrap();
        // The message stays in the mailbox long past its expiry.
        let confirmed = endpoint.message(app.tid, &TORQUE).confirmed(Duration::from_secs(1));
        let outcome = timeout(WATCHDOG, confirmed)
            .await
            .expect("it ends at its deadline, not when it has looked enough");
        assert_eq!(outcome.unwrap(), Outcome::Unknown);
    });
}
