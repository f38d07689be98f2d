//! Tests of the sync manager's actor at its interfaces: event queues, routes and messages.

#[path = "copies_tests.rs"]
mod copies;
#[path = "guests_tests.rs"]
mod guests;

use std::{
    future::Future,
    sync::{Arc, Mutex, PoisonError},
    task::{Context, Waker},
    time::Duration,
};

use actix::Actor;
use bytes::Bytes;
use futures_util::StreamExt;
use sinew_model::{
    barrier::{ArriveAtBarrier, BarrierAnswer, BarrierKind, LeaveBarrier, OnPartyLoss},
    cause::Cause,
    config::NodeConfig,
    context::NodeContext,
    events::LayerReport,
    facts::{AppFact, LinkFact},
    guest_quotas::GuestQuotas,
};
use sinew_runtime::{
    app::RequirementEvent,
    event_queue::{EventQueue, EventStream},
    monitor::{Down, DownClass},
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::{LocalRoute, MessageSink, SubmitError},
    supervision::ReadyGate,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header, Kind, Message, Payload},
};

use super::{
    Event, SyncManager,
    list::{Entry, List, Name},
};
use crate::{State, monitors};

const HERE: NodeAddress = NodeAddress::new(0x7f00_0001);
const KNEE: NodeAddress = NodeAddress::new(0x7f00_0002);
const INCARNATION: Incarnation = Incarnation(5);
const GAIT: AppAddress = AppAddress::new(0x1000);

/// Accepts messages into a queue, up to its capacity.
struct Mailbox(EventQueue<Message>);

impl MessageSink for Mailbox {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        self.0.post(message).map_err(|message| SubmitError::new(message, Rejection::QueueFull))
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        let result = self.submit(message);
        if result.is_err()
            && let Some(room) = room
            && self.0.poll_room(&Context::from_waker(room)).is_ready()
        {
            room.wake_by_ref();
        }
        result
    }
}

/// A node with only a sync manager; the test plays the other parts.
struct Bench {
    state: Arc<State>,
    root: EventStream<LayerReport>,
    /// The quotas of guests, as LNCL has them.
    guest_quotas: GuestQuotas,
}

impl Bench {
    /// Starts the bench; its sync manager is ready.
    async fn new() -> Self {
        let (ctx, root) = NodeContext::for_test(NodeConfig::new("hip"), Incarnation(1));
        let (state, root) = (State::new(ctx, Arc::default()), root.attach());
        let bench = Self { state, root, guest_quotas: GuestQuotas::default() };
        bench.start_manager().await;
        bench
    }

    async fn start_manager(&self) {
        let (sender, receiver) = tokio::sync::oneshot::channel();
        let gate = ReadyGate::new(move || sender.send(()).expect("this test waits for it"));
        SyncManager::new(self.state.clone(), gate).start();
        within("the sync manager is ready", receiver).await.unwrap();
    }

    fn post_event(&self, event: Event) {
        self.state.ctx.event_queues.sync.post(event).unwrap();
    }

    fn registers_gait(&self) {
        let requires = vec!["knee.drive".to_owned()];
        self.post_event(Event::App(AppFact::own_registered(GAIT, Some("gait".to_owned()), requires)));
    }

    /// Links the knee. Returns the stream of the messages sent to it.
    fn links_knee(&self) -> EventStream<Message> {
        let mailbox = EventQueue::new(64);
        self.state.ctx.router.set_peer(KNEE, Arc::new(Mailbox(mailbox.clone())));
        self.post_event(Event::Link(LinkFact::LinkUp { node: KNEE, incarnation: INCARNATION }));
        mailbox.attach()
    }

    /// Delivers a list of the knee as GNCL does.
    fn knee_publishes(&self, version: u64, ready: bool) {
        let name = Name::try_from("knee.drive".to_owned()).unwrap();
        let entry = Entry {
            name,
            app: GAIT,
            ready,
            ended: None,
            phases: Vec::new(),
            requires: Vec::new(),
            kinds: Vec::new(),
            handles: Vec::new(),
            sends: Vec::new(),
        };
        let list = List { incarnation: INCARNATION, version, entries: vec![entry], groups: Vec::new() };
        let from = Tid::new(KNEE, AppAddress::SYNC);
        self.state.ctx.router.deliver(directory(from, list.encode(usize::MAX).0)).unwrap();
    }

    async fn released(&mut self) -> AppAddress {
        match within("a release", self.root.next()).await {
            Some(LayerReport::Release { app }) => app,
            other => panic!("{other:?}"),
        }
    }
}

fn directory(from: Tid, payload: Bytes) -> Message {
    Message::new(Header::new(Kind::SYNC_DIRECTORY, from, Tid::new(HERE, AppAddress::SYNC)), payload)
}

async fn within<F: Future>(what: &str, future: F) -> F::Output {
    let waited = tokio::time::timeout(Duration::from_secs(60), future).await;
    waited.unwrap_or_else(|_| panic!("waited 60 s for: {what}"))
}

fn run(test: impl Future<Output = ()>) {
    actix::System::new().block_on(test);
}

#[test]
fn remote_list_releases_and_its_loss_is_reported() {
    run(async {
        let mut bench = Bench::new().await;
        let mailbox = EventQueue::new(4);
        let events: Arc<[Kind]> = Arc::new([RequirementEvent::KIND]);
        let sink = Arc::new(Mailbox(mailbox.clone()));
        bench.state.ctx.router.set_local(GAIT, LocalRoute { sink, events });
        let mut inbox = mailbox.attach();

        bench.registers_gait();
        let mut sent = bench.links_knee();
        let list = within("this node's list", sent.next()).await.unwrap();
        assert_eq!(List::parse(&list.payload).unwrap().entries[0].requires.len(), 1);
        assert_eq!(list.header.source, Tid::new(HERE, AppAddress::SYNC));
        assert_eq!(list.header.destination, Tid::new(KNEE, AppAddress::SYNC));
        bench.knee_publishes(1, true);
        assert_eq!(bench.released().await, GAIT);

        bench.post_event(Event::App(AppFact::Ready { app: GAIT }));
        bench.knee_publishes(2, false);
        let event: RequirementEvent = within("an event", inbox.next()).await.unwrap().decode().unwrap();
        assert_eq!(event, RequirementEvent::Lost { name: "knee.drive".to_owned() });
    });
}

// spec: SYNC-4
#[test]
fn groups_of_guests_only_are_published_last() {
    run(async {
        // Given
        let bench = Bench::new().await;
        let access = bench.state.security.access_in_test(&bench.state.ctx, "");
        let (guest, group) =
            (AppAddress::new(0x8000_0000), |number: u32| AppAddress::new(0xf000_0000 + number));
        access.add_guest(guest, 1_001);
        for (number, app) in [(1, guest), (2, GAIT), (3, guest), (3, GAIT)] {
            bench.state.ctx.router.set_member(group(number), app, true);
        }
        // When
        bench.post_event(Event::App(AppFact::GroupsChanged));
        let mut sent = bench.links_knee();
        // Then
        let list = within("this node's list", sent.next()).await.unwrap();
        assert_eq!(List::parse(&list.payload).unwrap().groups, [group(2), group(3), group(1)]);
    });
}

// spec: SYNC-16
#[test]
fn stalled_manager_reads_link_up_before_reporting_a_loss() {
    run(async {
        let mut bench = Bench::new().await;
        let mailbox = EventQueue::new(4);
        let events: Arc<[Kind]> = Arc::new([RequirementEvent::KIND]);
        bench
            .state
            .ctx
            .router
            .set_local(GAIT, LocalRoute { sink: Arc::new(Mailbox(mailbox.clone())), events });
        let mut inbox = mailbox.attach();
        bench.registers_gait();
        let _sent = bench.links_knee();
        bench.knee_publishes(1, true);
        assert_eq!(bench.released().await, GAIT);
        bench.post_event(Event::App(AppFact::Ready { app: GAIT }));
        // given: the link is broken, and the manager gets no CPU time for longer than it waits for a broken link
        bench.post_event(Event::Link(LinkFact::LinkBroken { node: KNEE, incarnation: INCARNATION }));
        let second = AppAddress::new(0x1001);
        bench.post_event(Event::App(AppFact::own_registered(second, None, Vec::new())));
        assert_eq!(bench.released().await, second);
        std::thread::sleep(Duration::from_millis(100));
        // when: groups have changed, and the link-up event is queued behind that
        bench.post_event(Event::App(AppFact::GroupsChanged));
        let _sent = bench.links_knee();
        bench.knee_publishes(1, true);
        // then: all events are read, and the next report is a true loss
        let third = AppAddress::new(0x1002);
        bench.post_event(Event::App(AppFact::own_registered(third, None, Vec::new())));
        assert_eq!(bench.released().await, third);
        assert!(futures_util::poll!(inbox.next()).is_pending(), "no requirement was lost");
    });
}

#[test]
fn rejected_event_is_delivered_when_the_mailbox_has_room() {
    run(async {
        let mut bench = Bench::new().await;
        let mailbox = EventQueue::new(1);
        let events: Arc<[Kind]> = Arc::new([RequirementEvent::KIND]);
        let sink = Arc::new(Mailbox(mailbox.clone()));
        bench.state.ctx.router.set_local(GAIT, LocalRoute { sink, events });
        bench.registers_gait();
        let _sent = bench.links_knee();
        bench.knee_publishes(1, true);
        bench.released().await;

        mailbox.post(directory(Tid::NONE, Bytes::new())).unwrap();
        bench.knee_publishes(2, false);
        // The second application is released after the rejected event was handled: events are handled in order.
        let second = AppAddress::new(0x1001);
        bench.post_event(Event::App(AppFact::own_registered(second, None, Vec::new())));
        assert_eq!(bench.released().await, second);
        assert_eq!(mailbox.refused(), 1);

        let mut inbox = mailbox.attach();
        within("the message that was in the way", inbox.next()).await.unwrap();
        let event: RequirementEvent = within("the event", inbox.next()).await.unwrap().decode().unwrap();
        assert_eq!(event, RequirementEvent::Lost { name: "knee.drive".to_owned() });
    });
}

#[test]
fn rejected_barrier_answer_is_delivered_later() {
    run(async {
        let mut bench = Bench::new().await;
        let mailbox = EventQueue::new(1);
        let sink = Arc::new(Mailbox(mailbox.clone()));
        bench.state.ctx.router.set_local(GAIT, LocalRoute { sink, events: Arc::new([]) });
        bench.registers_gait();
        mailbox.post(directory(Tid::NONE, Bytes::new())).unwrap();
        let asked = ArriveAtBarrier {
            kind: BarrierKind::Meeting,
            barrier: "calibrated".to_owned(),
            parties: vec!["gait".to_owned(), "knee".to_owned()],
            within_ms: 0,
            on_loss: OnPartyLoss::Wait,
        };
        let (gait, manager) = (Tid::new(HERE, GAIT), Tid::new(HERE, AppAddress::SYNC));
        let mut arrival = Message::typed(gait, manager, &asked);
        (arrival.header.flags, arrival.header.correlation) = (Flags::ASK, 7);
        bench.state.ctx.router.deliver(arrival).unwrap();
        // The second application is released after the rejected answer was handled: events are handled in order.
        let second = AppAddress::new(0x1001);
        bench.post_event(Event::App(AppFact::own_registered(second, None, Vec::new())));
        assert_eq!(bench.released().await, second);
        assert!(mailbox.refused() > 0);

        let mut inbox = mailbox.attach();
        within("the message that was in the way", inbox.next()).await.unwrap();
        let message = within("the answer", inbox.next()).await.unwrap();
        assert_eq!(message.header.correlation, 7);
        assert!(matches!(message.decode().unwrap(), BarrierAnswer::TimedOut { .. }));
    });
}

#[test]
fn message_flood_does_not_keep_out_events_of_layers() {
    run(async {
        let bench = Bench::new().await;
        let message = || directory(Tid::new(KNEE, AppAddress::SYNC), Bytes::new());
        // when: the manager reads none of the messages, as the test occupies its thread
        while bench.state.ctx.router.deliver(message()).is_ok() {}
        // then
        bench.post_event(Event::Link(LinkFact::LinkUp { node: KNEE, incarnation: INCARNATION }));
    });
}

// spec: SYNC-10
#[test]
fn leave_request_is_accepted_where_other_messages_are_rejected() {
    run(async {
        // Given: the manager reads none of the messages, as the test occupies its thread
        let bench = Bench::new().await;
        let message = || directory(Tid::new(KNEE, AppAddress::SYNC), Bytes::new());
        while bench.state.ctx.router.deliver(message()).is_ok() {}
        // When
        let leave = LeaveBarrier { barrier: "calibrated".to_owned(), correlation: Some(7) };
        let leave = || Message::typed(Tid::new(HERE, GAIT), Tid::new(HERE, AppAddress::SYNC), &leave);
        // Then
        bench.state.ctx.router.deliver(leave()).unwrap();
        // And: endless leave requests still leave room for layers
        while bench.state.ctx.router.deliver(leave()).is_ok() {}
        bench.post_event(Event::Link(LinkFact::LinkUp { node: KNEE, incarnation: INCARNATION }));
    });
}

#[test]
fn restarted_sync_manager_continues_the_previous_ones_state() {
    run(async {
        let mut bench = Bench::new().await;
        bench.registers_gait();
        let mut sent = bench.links_knee();
        let first = within("a list from the first", sent.next()).await.unwrap();
        bench.start_manager().await;
        bench.knee_publishes(1, true);
        assert_eq!(bench.released().await, GAIT);
        bench.post_event(Event::App(AppFact::Ready { app: GAIT }));
        let second = within("a list from the second", sent.next()).await.unwrap();
        assert!(second.header.sequence > first.header.sequence);
    });
}

/// Accepts no message: every send to it fails.
struct Mine;

impl MessageSink for Mine {
    fn submit(&self, _: Message) -> Result<(), SubmitError> {
        panic!("the planned fault of this test")
    }
}

fn arrival(app: AppAddress, correlation: u64) -> Message {
    let asked = ArriveAtBarrier {
        kind: BarrierKind::Meeting,
        barrier: "calibrated".to_owned(),
        parties: vec!["gait".to_owned(), "drive".to_owned()],
        within_ms: 60_000,
        on_loss: OnPartyLoss::Wait,
    };
    let mut arrival = Message::typed(Tid::new(HERE, app), Tid::new(HERE, AppAddress::SYNC), &asked);
    (arrival.header.flags, arrival.header.correlation) = (Flags::ASK, correlation);
    arrival
}

// spec: SYNC-10
#[test]
fn arrival_handed_to_a_successor_counts_once() {
    run(async {
        // Given: the last party arrives, and its manager fails while it delivers the answer
        let mut bench = Bench::new().await;
        let drive = AppAddress::new(0x1001);
        let (of_gait, of_drive) = (EventQueue::new(4), EventQueue::new(4));
        let mailbox = |queue: &EventQueue<Message>| Arc::new(Mailbox(queue.clone()));
        let no_events = || -> Arc<[Kind]> { Arc::new([]) };
        bench.state.ctx.router.set_local(GAIT, LocalRoute { sink: mailbox(&of_gait), events: no_events() });
        bench.state.ctx.router.set_local(drive, LocalRoute { sink: Arc::new(Mine), events: no_events() });
        for (app, name) in [(GAIT, "gait"), (drive, "drive")] {
            let name = Some(name.to_owned());
            bench.post_event(Event::App(AppFact::own_registered(app, name, Vec::new())));
            bench.released().await;
        }
        bench.state.ctx.router.deliver(arrival(GAIT, 7)).unwrap();
        bench.state.ctx.router.deliver(arrival(drive, 9)).unwrap();
        let mut inbox = of_gait.attach();
        let answer = within("the answer of the first", inbox.next()).await.unwrap();
        assert!(matches!(answer.decode().unwrap(), BarrierAnswer::Opened { generation: 1 }));
        // When
        bench.state.ctx.router.set_local(drive, LocalRoute { sink: mailbox(&of_drive), events: no_events() });
        bench.start_manager().await;
        // Then
        let mut inbox = of_drive.attach();
        let answer = within("the answer of the last", inbox.next()).await.unwrap();
        assert_eq!(answer.header.correlation, 9);
        assert!(matches!(answer.decode().unwrap(), BarrierAnswer::Opened { generation: 1 }));
        let third = AppAddress::new(0x1002);
        bench.post_event(Event::App(AppFact::own_registered(third, None, Vec::new())));
        assert_eq!(bench.released().await, third, "all events before it were handled");
        let core = bench.state.core.lock().unwrap_or_else(PoisonError::into_inner);
        assert_eq!(core.barriers(Time::now()), [], "no application waits for the next round");
    });
}

#[derive(Default)]
struct Ledger(Mutex<Vec<Outcome>>);

impl ReceiptSink for Ledger {
    fn settle(&self, _: Ticket, outcome: Outcome) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(outcome);
    }
}

// spec: SYNC-4
#[test]
fn invalid_directory_frames_are_rejected() {
    run(async {
        let mut bench = Bench::new().await;
        let ledger = Arc::new(Ledger::default());
        let foreign = Tid::new(KNEE, AppAddress::SYNC);
        let mut other_kind = directory(foreign, Bytes::new());
        other_kind.header.kind = Kind::NDL_QUERY;
        let cases = [
            other_kind,
            directory(Tid::new(KNEE, GAIT), Bytes::new()),
            directory(Tid::new(HERE, AppAddress::SYNC), Bytes::new()),
            directory(foreign, Bytes::from_static(b"garbage")),
        ];
        for mut message in cases {
            let ticket = Ticket {
                source: message.header.source,
                destination: message.header.destination,
                correlation: 1,
            };
            message.receipt = Some(Receipt::new(ledger.clone(), ticket));
            bench.state.ctx.router.deliver(message).unwrap();
        }
        // Released after all of them were handled.
        bench.post_event(Event::App(AppFact::own_registered(GAIT, None, Vec::new())));
        assert_eq!(bench.released().await, GAIT);
        let forged = Outcome::Rejected(Rejection::ForgedSource);
        let expected = [Outcome::Rejected(Rejection::UnknownKind), forged, forged, Outcome::Delivered];
        assert_eq!(*ledger.0.lock().unwrap(), expected);
    });
}

#[test]
fn cycle_is_reported_to_the_root() {
    run(async {
        let mut bench = Bench::new().await;
        let name = |text: &str| Some(text.to_owned());
        for (index, own, required) in [(0x1000, "a", "b"), (0x1001, "b", "a")] {
            let app = AppAddress::new(index);
            let requires = vec![required.to_owned()];
            bench.post_event(Event::App(AppFact::own_registered(app, name(own), requires)));
        }
        match within("the cycle", bench.root.next()).await {
            Some(LayerReport::RequirementCycle { names, labels }) => {
                assert_eq!((&*names, &*labels), (&["a", "b", "a"].map(str::to_owned)[..], &*names));
            }
            other => panic!("{other:?}"),
        }
    });
}

#[test]
fn monitored_end_is_reported_despite_a_full_queue() {
    run(async {
        // given: gait monitors a drive, and the manager's event queue is full of events that do not concern monitors
        let bench = Bench::new().await;
        let drive = AppAddress::new(0x1001);
        let mailbox = EventQueue::new(4);
        let sink = Arc::new(Mailbox(mailbox.clone()));
        bench.state.ctx.router.set_local(GAIT, LocalRoute { sink, events: Arc::new([]) });
        monitors::feed(&bench.state, monitors::Input::Started { app: drive });
        let set = |core: &mut monitors::Core| core.monitor(Time::now(), GAIT, Tid::new(HERE, drive));
        monitors::change(&bench.state, set).unwrap();
        while bench.state.ctx.event_queues.sync.post(Event::App(AppFact::Ready { app: GAIT })).is_ok() {}
        // when: another task, which holds a lock, records that the drive has ended
        let cause = Cause::new(DownClass::Killed, "its end");
        monitors::feed_deferred(&bench.state, monitors::Input::Ended { app: drive, cause, is_gone: true });
        // then
        let down = within("the end of the drive", mailbox.attach().next()).await.unwrap();
        assert_eq!(down.header.kind, Down::KIND);
    });
}
