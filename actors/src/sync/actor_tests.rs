//! What the sync manager's actor promises at its edges: posts, routes, messages.

#[path = "copies_tests.rs"]
mod copies;
#[path = "guests_tests.rs"]
mod guests;

use std::{
    future::Future,
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use actix::Actor;
use bytes::Bytes;
use futures_util::StreamExt;
use sinew_runtime::{
    app::RequirementEvent,
    monitor::{Down, DownClass},
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    post::{Post, PostStream},
    router::{LocalRoute, Outlet, Refused},
    supervision::ReadyGate,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header, Kind, Message, Payload},
};

use super::{
    Event, SyncManager,
    list::{Entry, List, Name},
    words::{ArriveAtBarrier, BarrierAnswer, BarrierKind, LeaveBarrier, OnPartyLoss},
};
use crate::{
    access::Access, config::NodeConfig, gncl::LinkFact, lncl::AppFact, monitors, node::RootEvent,
    stores::Stores,
};

const HERE: NodeAddress = NodeAddress::new(0x7f00_0001);
const KNEE: NodeAddress = NodeAddress::new(0x7f00_0002);
const LIFE: Incarnation = Incarnation(5);
const GAIT: AppAddress = AppAddress::new(0x1000);

/// Takes messages into a post, up to its capacity.
struct Mailbox(Post<Message>);

impl Outlet for Mailbox {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        self.0.post(message).map_err(|message| Refused::new(message, Rejection::QueueFull))
    }
}

/// A node that has a sync manager only; the rest is played by the test.
struct Bench {
    stores: Arc<Stores>,
    root: PostStream<RootEvent>,
}

impl Bench {
    /// Its sync manager is ready.
    async fn new() -> Self {
        let stores = Stores::for_test(NodeConfig::new("hip"), Incarnation(1));
        let root = stores.posts.root.attach();
        let bench = Self { stores, root };
        bench.start_manager().await;
        bench
    }

    async fn start_manager(&self) {
        let (say, said) = tokio::sync::oneshot::channel();
        let gate = ReadyGate::new(move || say.send(()).expect("this test waits for it"));
        SyncManager::new(self.stores.clone(), gate).start();
        within("the sync manager is ready", said).await.unwrap();
    }

    fn tells(&self, event: Event) {
        self.stores.posts.sync.post(event).unwrap();
    }

    fn registers_gait(&self) {
        let requires = vec!["knee.drive".to_owned()];
        self.tells(Event::App(AppFact::own_registered(GAIT, Some("gait".to_owned()), requires)));
    }

    /// The knee is linked; what is sent to it can be read.
    fn links_knee(&self) -> PostStream<Message> {
        let mailbox = Post::new(64);
        self.stores.router.set_peer(KNEE, Arc::new(Mailbox(mailbox.clone())));
        self.tells(Event::Link(LinkFact::LinkUp { node: KNEE, incarnation: LIFE }));
        mailbox.attach()
    }

    /// As GNCL hands over what the knee sent.
    fn knee_says(&self, version: u64, ready: bool) {
        let name = Name::try_from("knee.drive".to_owned()).unwrap();
        let entry = Entry {
            name,
            app: GAIT,
            ready,
            ended: None,
            phases: Vec::new(),
            requires: Vec::new(),
            kinds: Vec::new(),
        };
        let list = List { incarnation: LIFE, version, entries: vec![entry], groups: Vec::new() };
        let from = Tid::new(KNEE, AppAddress::SYNC);
        self.stores.router.deliver(directory(from, list.encode(usize::MAX).0)).unwrap();
    }

    async fn released(&mut self) -> AppAddress {
        match within("a release", self.root.next()).await {
            Some(RootEvent::Release { app }) => app,
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
fn an_application_is_released_by_a_list_from_another_node_and_hears_of_its_loss() {
    run(async {
        let mut bench = Bench::new().await;
        let mailbox = Post::new(4);
        let events: Arc<[Kind]> = Arc::new([RequirementEvent::KIND]);
        let outlet = Arc::new(Mailbox(mailbox.clone()));
        bench.stores.router.set_local(GAIT, LocalRoute { outlet, events });
        let mut inbox = mailbox.attach();

        bench.registers_gait();
        let mut sent = bench.links_knee();
        let list = within("this node's list", sent.next()).await.unwrap();
        assert_eq!(List::parse(&list.payload).unwrap().entries[0].requires.len(), 1);
        assert_eq!(list.header.source, Tid::new(HERE, AppAddress::SYNC));
        assert_eq!(list.header.destination, Tid::new(KNEE, AppAddress::SYNC));
        bench.knee_says(1, true);
        assert_eq!(bench.released().await, GAIT);

        bench.tells(Event::App(AppFact::Ready { app: GAIT }));
        bench.knee_says(2, false);
        let event: RequirementEvent = within("an event", inbox.next()).await.unwrap().decode().unwrap();
        assert_eq!(event, RequirementEvent::Lost { name: "knee.drive".to_owned() });
    });
}

// spec: SYNC-4
#[test]
fn groups_that_only_guests_are_in_are_said_behind_those_of_the_robots_own() {
    run(async {
        // Given
        let bench = Bench::new().await;
        let access = Access::in_test(&bench.stores, "");
        let (guest, group) =
            (AppAddress::new(0x8000_0000), |number: u32| AppAddress::new(0xf000_0000 + number));
        access.guest_came(guest, 1_001);
        for (number, app) in [(1, guest), (2, GAIT), (3, guest), (3, GAIT)] {
            bench.stores.router.set_member(group(number), app, true);
        }
        // When
        bench.tells(Event::App(AppFact::GroupsChanged));
        let mut sent = bench.links_knee();
        // Then
        let list = within("this node's list", sent.next()).await.unwrap();
        assert_eq!(List::parse(&list.payload).unwrap().groups, [group(2), group(3), group(1)]);
    });
}

// spec: SYNC-16
#[test]
fn a_manager_that_stood_still_reads_that_a_link_is_back_before_it_tells_of_a_loss_whatever_it_reads_first() {
    run(async {
        let mut bench = Bench::new().await;
        let mailbox = Post::new(4);
        let events: Arc<[Kind]> = Arc::new([RequirementEvent::KIND]);
        bench
            .stores
            .router
            .set_local(GAIT, LocalRoute { outlet: Arc::new(Mailbox(mailbox.clone())), events });
        let mut inbox = mailbox.attach();
        bench.registers_gait();
        let _sent = bench.links_knee();
        bench.knee_says(1, true);
        assert_eq!(bench.released().await, GAIT);
        bench.tells(Event::App(AppFact::Ready { app: GAIT }));
        // given: the link is broken, and the manager gets no processor for longer than it would wait for that
        bench.tells(Event::Link(LinkFact::LinkBroken { node: KNEE, incarnation: LIFE }));
        let second = AppAddress::new(0x1001);
        bench.tells(Event::App(AppFact::own_registered(second, None, Vec::new())));
        assert_eq!(bench.released().await, second);
        std::thread::sleep(Duration::from_millis(100));
        // when: groups have changed, and behind that the link is back
        bench.tells(Event::App(AppFact::GroupsChanged));
        let _sent = bench.links_knee();
        bench.knee_says(1, true);
        // then: all that is read, and the next that is told is a true loss
        let third = AppAddress::new(0x1002);
        bench.tells(Event::App(AppFact::own_registered(third, None, Vec::new())));
        assert_eq!(bench.released().await, third);
        assert!(futures_util::poll!(inbox.next()).is_pending(), "nobody was lost");
    });
}

#[test]
fn an_event_that_a_full_mailbox_did_not_take_comes_when_there_is_room() {
    run(async {
        let mut bench = Bench::new().await;
        let mailbox = Post::new(1);
        let events: Arc<[Kind]> = Arc::new([RequirementEvent::KIND]);
        let outlet = Arc::new(Mailbox(mailbox.clone()));
        bench.stores.router.set_local(GAIT, LocalRoute { outlet, events });
        bench.registers_gait();
        let _sent = bench.links_knee();
        bench.knee_says(1, true);
        bench.released().await;

        mailbox.post(directory(Tid::NONE, Bytes::new())).unwrap();
        bench.knee_says(2, false);
        // The second application is released after the refused event was dealt with: events are handled in order.
        let second = AppAddress::new(0x1001);
        bench.tells(Event::App(AppFact::own_registered(second, None, Vec::new())));
        assert_eq!(bench.released().await, second);
        assert_eq!(mailbox.refused(), 1);

        let mut inbox = mailbox.attach();
        within("the message that was in the way", inbox.next()).await.unwrap();
        let event: RequirementEvent = within("the event", inbox.next()).await.unwrap().decode().unwrap();
        assert_eq!(event, RequirementEvent::Lost { name: "knee.drive".to_owned() });
    });
}

#[test]
fn an_answer_about_a_barrier_that_a_full_mailbox_did_not_take_comes_when_there_is_room() {
    run(async {
        let mut bench = Bench::new().await;
        let mailbox = Post::new(1);
        let outlet = Arc::new(Mailbox(mailbox.clone()));
        bench.stores.router.set_local(GAIT, LocalRoute { outlet, events: Arc::new([]) });
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
        bench.stores.router.deliver(arrival).unwrap();
        // The second application is released after the refused answer was dealt with: events are handled in order.
        let second = AppAddress::new(0x1001);
        bench.tells(Event::App(AppFact::own_registered(second, None, Vec::new())));
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
fn more_messages_than_it_reads_do_not_keep_out_what_layers_tell_it() {
    run(async {
        let bench = Bench::new().await;
        let message = || directory(Tid::new(KNEE, AppAddress::SYNC), Bytes::new());
        // when: it comes to none of them, as this has its thread
        while bench.stores.router.deliver(message()).is_ok() {}
        // then
        bench.tells(Event::Link(LinkFact::LinkUp { node: KNEE, incarnation: LIFE }));
    });
}

// spec: SYNC-10
#[test]
fn a_wait_that_is_given_up_is_taken_back_also_where_no_other_message_is_taken() {
    run(async {
        // Given: it comes to none of them, as this has its thread
        let bench = Bench::new().await;
        let message = || directory(Tid::new(KNEE, AppAddress::SYNC), Bytes::new());
        while bench.stores.router.deliver(message()).is_ok() {}
        // When
        let leave = LeaveBarrier { barrier: "calibrated".to_owned(), correlation: Some(7) };
        let leave = || Message::typed(Tid::new(HERE, GAIT), Tid::new(HERE, AppAddress::SYNC), &leave);
        // Then
        bench.stores.router.deliver(leave()).unwrap();
        // And whoever leaves without end leaves room for layers
        while bench.stores.router.deliver(leave()).is_ok() {}
        bench.tells(Event::Link(LinkFact::LinkUp { node: KNEE, incarnation: LIFE }));
    });
}

#[test]
fn a_restarted_sync_manager_goes_on_where_the_former_one_ended() {
    run(async {
        let mut bench = Bench::new().await;
        bench.registers_gait();
        let mut sent = bench.links_knee();
        let first = within("a list from the first", sent.next()).await.unwrap();
        bench.start_manager().await;
        bench.knee_says(1, true);
        assert_eq!(bench.released().await, GAIT);
        bench.tells(Event::App(AppFact::Ready { app: GAIT }));
        let second = within("a list from the second", sent.next()).await.unwrap();
        assert!(second.header.sequence > first.header.sequence);
    });
}

/// Takes no message: whoever sends one fails.
struct Mine;

impl Outlet for Mine {
    fn submit(&self, _: Message) -> Result<(), Refused> {
        panic!("whoever answers this one fails, as this test wants it")
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
fn an_arrival_that_the_successor_of_a_failed_manager_is_handed_again_counts_once_and_is_answered() {
    run(async {
        // Given: the last one arrives, and its manager fails when it gives it its answer
        let mut bench = Bench::new().await;
        let drive = AppAddress::new(0x1001);
        let (of_gait, of_drive) = (Post::new(4), Post::new(4));
        let mailbox = |post: &Post<Message>| Arc::new(Mailbox(post.clone()));
        let no_events = || -> Arc<[Kind]> { Arc::new([]) };
        bench.stores.router.set_local(GAIT, LocalRoute { outlet: mailbox(&of_gait), events: no_events() });
        bench.stores.router.set_local(drive, LocalRoute { outlet: Arc::new(Mine), events: no_events() });
        for (app, name) in [(GAIT, "gait"), (drive, "drive")] {
            let name = Some(name.to_owned());
            bench.tells(Event::App(AppFact::own_registered(app, name, Vec::new())));
            bench.released().await;
        }
        bench.stores.router.deliver(arrival(GAIT, 7)).unwrap();
        bench.stores.router.deliver(arrival(drive, 9)).unwrap();
        let mut inbox = of_gait.attach();
        let answer = within("the answer of the first", inbox.next()).await.unwrap();
        assert!(matches!(answer.decode().unwrap(), BarrierAnswer::Opened { generation: 1 }));
        // When
        bench.stores.router.set_local(drive, LocalRoute { outlet: mailbox(&of_drive), events: no_events() });
        bench.start_manager().await;
        // Then
        let mut inbox = of_drive.attach();
        let answer = within("the answer of the last", inbox.next()).await.unwrap();
        assert_eq!(answer.header.correlation, 9);
        assert!(matches!(answer.decode().unwrap(), BarrierAnswer::Opened { generation: 1 }));
        let third = AppAddress::new(0x1002);
        bench.tells(Event::App(AppFact::own_registered(third, None, Vec::new())));
        assert_eq!(bench.released().await, third, "all events before it were handled");
        let core = bench.stores.sync.lock().unwrap_or_else(PoisonError::into_inner);
        assert_eq!(core.barriers(Time::now()), [], "nobody waits for the next round");
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
fn what_is_no_directory_of_another_sync_manager_is_refused() {
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
            bench.stores.router.deliver(message).unwrap();
        }
        // Released after all of them were handled.
        bench.tells(Event::App(AppFact::own_registered(GAIT, None, Vec::new())));
        assert_eq!(bench.released().await, GAIT);
        let forged = Outcome::Rejected(Rejection::ForgedSource);
        let expected = [Outcome::Rejected(Rejection::UnknownKind), forged, forged, Outcome::Delivered];
        assert_eq!(*ledger.0.lock().unwrap(), expected);
    });
}

#[test]
fn a_cycle_is_told_to_the_root() {
    run(async {
        let mut bench = Bench::new().await;
        let name = |text: &str| Some(text.to_owned());
        for (index, own, required) in [(0x1000, "a", "b"), (0x1001, "b", "a")] {
            let app = AppAddress::new(index);
            let requires = vec![required.to_owned()];
            bench.tells(Event::App(AppFact::own_registered(app, name(own), requires)));
        }
        match within("the cycle", bench.root.next()).await {
            Some(RootEvent::RequirementCycle { names, labels }) => {
                assert_eq!((&*names, &*labels), (&["a", "b", "a"].map(str::to_owned)[..], &*names));
            }
            other => panic!("{other:?}"),
        }
    });
}

#[test]
fn the_end_of_who_is_monitored_is_told_though_the_post_was_full_when_it_came() {
    run(async {
        // given: gait monitors a drive, and the manager's post is full of what is nothing to monitors
        let bench = Bench::new().await;
        let drive = AppAddress::new(0x1001);
        let mailbox = Post::new(4);
        let outlet = Arc::new(Mailbox(mailbox.clone()));
        bench.stores.router.set_local(GAIT, LocalRoute { outlet, events: Arc::new([]) });
        monitors::feed(&bench.stores, monitors::Input::Began { app: drive });
        let set = |core: &mut monitors::Core| core.monitor(Time::now(), GAIT, Tid::new(HERE, drive));
        monitors::change(&bench.stores, set).unwrap();
        while bench.stores.posts.sync.post(Event::App(AppFact::Ready { app: GAIT })).is_ok() {}
        // when: somebody who holds a lock notes that the drive has ended
        let cause = monitors::Cause::new(DownClass::Killed, "its end");
        monitors::note(&bench.stores, monitors::Input::Ended { app: drive, cause, is_gone: true });
        // then
        let down = within("the end of the drive", mailbox.attach().next()).await.unwrap();
        assert_eq!(down.header.kind, Down::KIND);
    });
}
