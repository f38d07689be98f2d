//! Random histories of a session: cuts, acknowledgements, peers that forget, messages that expire. The audit
//! accounts for each message at every moment.

use proptest::prelude::*;

use super::*;
use crate::{Window, counts::Account};

#[derive(Clone, Debug)]
enum Step {
    Submit {
        class: u8,
        expires: bool,
    },
    Room(usize),
    /// The peer has received a part of the written messages, in hundredths.
    Acknowledge(u64),
    /// The next connection; the peer has received a part of the written messages.
    Reconnect(u64),
    /// The requester of this request no longer waits for its reply. The number counts back from the latest
    /// message.
    Cancel(u64),
    /// An outcome.
    Outcome,
    /// The next connection, to a peer that knows nothing of this session.
    Forget,
    Expire,
}

fn any_step() -> impl Strategy<Value = Step> {
    prop_oneof![
        8 => (0u8..3, any::<bool>()).prop_map(|(class, expires)| Step::Submit { class, expires }),
        5 => (0usize..400).prop_map(Step::Room),
        3 => (0u64..=100).prop_map(Step::Acknowledge),
        2 => (0u64..=100).prop_map(Step::Reconnect),
        3 => (0u64..4).prop_map(Step::Cancel),
        4 => Just(Step::Outcome),
        1 => Just(Step::Forget),
        1 => Just(Step::Expire),
    ]
}

struct World {
    bench: Bench,
    submitted: u64,
    /// The outcomes among them: several outcomes may be one message.
    outcomes: u64,
    /// The peer's memory.
    receiver_id: u64,
    /// The number after the last completely written one.
    written: u64,
}

impl World {
    fn new() -> Self {
        let window = Window { messages: 6, bytes: PLENTY };
        let void = message(Class::Control, 0).header;
        let outcomes = Header { kind: Kind::GNCL_OUTCOMES, ..void };
        let outlet = SocketWriter::with_session(LIMITS, Session::new(1, window, void, Some(outcomes)));
        let wire = Arc::new(Wire::default());
        let link = outlet.connect(wire.clone(), usize::MAX, None);
        let bench = Bench { outlet, wire, link, outcome_log: Arc::default() };
        let world = Self { bench, submitted: 0, outcomes: 0, receiver_id: 1, written: 1 };
        world.receive_ack(1);
        world
    }

    fn receive_ack(&self, next: u64) {
        let of = self.bench.outlet.epoch();
        let ack = Ack {
            receiver_id: self.receiver_id,
            epoch: 1,
            peer_epoch: of,
            next,
            change: 0,
            held: Vec::new(),
            room: None,
        };
        self.bench.outlet.on_ack(self.bench.link, &ack, Time::now());
    }

    /// Returns the next number that the peer acknowledges after this part of the written messages.
    fn part(&self, hundredths: u64) -> u64 {
        let acknowledged = self.bench.outlet.account().1.expect("it has a session").acknowledged;
        acknowledged + self.written.saturating_sub(acknowledged) * hundredths / 100
    }

    fn submit(&mut self, class: u8, expires: bool) {
        self.submitted += 1;
        let mut message = message(Class::ALL[usize::from(class)], class);
        if expires {
            (message.header.sent, message.header.time_to_live_us) = (Time::now(), 3_000_000);
        }
        if message.header.class == Class::Control {
            message.header.flags = Flags::ASK;
            message.header.correlation = self.submitted;
        }
        // Handed back or not, it is accounted for.
        let _ = self.bench.outlet.submit(message);
    }

    fn cancel(&mut self, ago: u64) {
        let correlation = self.submitted.saturating_sub(ago);
        let ticket = Ticket { correlation, ..message(Class::Control, 0).ticket() };
        if !self.bench.outlet.cancel(ticket) {
            self.submitted += 1;
            let _ = self.bench.outlet.submit(Message::cancel(ticket));
        }
    }

    fn step(&mut self, step: &Step) {
        match *step {
            Step::Submit { class, expires } => self.submit(class, expires),
            Step::Room(room) => self.bench.make_room(room),
            Step::Acknowledge(part) => self.receive_ack(self.part(part)),
            Step::Reconnect(part) => {
                let next = self.part(part);
                self.bench.outlet.disconnect(self.bench.link);
                self.bench.reconnect(0);
                self.receive_ack(next);
            }
            Step::Cancel(ago) => self.cancel(ago),
            Step::Outcome => {
                (self.submitted, self.outcomes) = (self.submitted + 1, self.outcomes + 1);
                let outcome = Message::outcome(message(Class::Control, 0).ticket(), Outcome::Delivered);
                let _ = self.bench.outlet.submit_outcome(outcome, 8);
            }
            Step::Forget => {
                self.bench.outlet.disconnect(self.bench.link);
                self.bench.reconnect(0);
                self.receiver_id += 1;
                self.receive_ack(1);
                self.written = 1;
            }
            Step::Expire => drop(self.bench.outlet.expire(Time::MAX)),
        }
        let frames = frames(&self.bench.wire.bytes.lock().unwrap());
        if let Some(last) = frames.last() {
            self.written = u64::from(last.header.number) + 1;
        }
        self.balances();
    }

    fn balances(&self) {
        let (account, sent) = self.bench.outlet.account();
        assert_eq!(Account::from(&account).unexplained(), 0, "{account:?}");
        let together = self.submitted - account.taken - account.refused;
        assert!(together <= self.outcomes.saturating_sub(1), "{together} {account:?}");
        let sent = sent.expect("it has a session");
        assert!(sent.next - sent.acknowledged >= account.unacknowledged, "{account:?} {sent:?}");
    }
}

proptest! {
    #[test]
    fn session_accounts_for_every_message_at_any_time(
        steps in proptest::collection::vec(any_step(), 1..100),
    ) {
        let mut world = World::new();
        for step in &steps {
            world.step(step);
        }
        world.step(&Step::Reconnect(100));
        for _ in 0..steps.len() {
            world.step(&Step::Room(PLENTY));
            world.step(&Step::Acknowledge(100));
        }
        let (account, _) = world.bench.outlet.account();
        prop_assert_eq!((account.waiting, account.unacknowledged), (0, 0), "{:?}", account);
        world.bench.outlet.close(Rejection::Closed);
        world.balances();
    }
}

#[test]
fn peer_loss_makes_sent_unknown_and_waiting_lost() {
    let mut world = World::new();
    world.step(&Step::Room(PLENTY));
    world.step(&Step::Submit { class: 0, expires: false });
    world.bench.wire.room.store(0, Ordering::Relaxed);
    world.step(&Step::Submit { class: 2, expires: false });
    world.bench.outlet.close(Rejection::NoSuchNode);
    let (account, _) = world.bench.outlet.account();
    assert_eq!((account.taken, account.unknown, account.lost, account.waiting), (2, 1, 1, 0));
    world.balances();
}
