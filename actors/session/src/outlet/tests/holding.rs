//! Any sequence of sends and Acks with held destinations: nothing leaks, the order is kept, and held
//! destinations receive nothing.

use std::collections::BTreeSet;

use proptest::prelude::*;

use super::*;
use crate::{Window, counts::Account};

/// The held application of this number, in class Control.
fn key(application: u8) -> u64 {
    u64::from(tid(application.into()).app.bits())
}

#[derive(Clone, Debug)]
enum Step {
    Submit {
        to: u8,
        confirm: bool,
    },
    Room(usize),
    /// The destinations with set bits are held from now on; a stale Ack has no larger number than the
    /// previous one.
    ReceiveAck {
        held: u8,
        is_stale: bool,
    },
    Expire,
}

fn any_step() -> impl Strategy<Value = Step> {
    prop_oneof![
        6 => (0u8..3, any::<bool>()).prop_map(|(to, confirm)| Step::Submit { to, confirm }),
        4 => (0usize..300).prop_map(Step::Room),
        3 => (0u8..8, any::<bool>()).prop_map(|(held, is_stale)| Step::ReceiveAck { held, is_stale }),
        1 => Just(Step::Expire),
    ]
}

struct World {
    bench: Bench,
    change: u64,
    held: BTreeSet<u8>,
    /// Whole frames on the wire for each application, when it became held.
    then: [usize; 3],
    submitted: u64,
    confirmed: Vec<u64>,
}

impl World {
    fn new() -> Self {
        let window = Window { messages: 64, bytes: PLENTY };
        let void = message(Class::Control, 0).header;
        let outlet = SocketWriter::with_session(LIMITS, Session::new(1, window, void, None));
        let wire = Arc::new(Wire::default());
        let link = outlet.connect(wire.clone(), usize::MAX, None);
        let bench = Bench { outlet, wire, link, outcome_log: Arc::default() };
        let mut world = Self {
            bench,
            change: 0,
            held: BTreeSet::new(),
            then: [0; 3],
            submitted: 0,
            confirmed: Vec::new(),
        };
        world.receive_ack(0, false);
        world
    }

    /// Numbers of the whole frames for `to`, in their order on the wire.
    fn seen(&self, to: u8) -> Vec<u64> {
        let all = frames(&self.bench.wire.bytes.lock().unwrap());
        let for_it = all.into_iter().filter(|message| message.header.destination == tid(to.into()));
        for_it.map(|message| message.header.sequence).collect()
    }

    fn submit(&mut self, to: u8, confirm: bool) {
        self.submitted += 1;
        let mut message =
            if confirm { self.bench.confirmed(self.submitted) } else { expiring(Class::Control, to) };
        if let Some(receipt) = message.receipt.take() {
            let ticket = Ticket { destination: tid(to.into()), ..receipt.ticket() };
            // The receipt for the other destination is settled and removed.
            receipt.settle(Outcome::Unknown);
            self.bench.outcome_log.0.lock().unwrap().pop();
            message.receipt = Some(Receipt::new(self.bench.outcome_log.clone(), ticket));
            self.confirmed.push(self.submitted);
        }
        message.header.destination = tid(to.into());
        message.header.sequence = self.submitted;
        if let Err(refused) = self.bench.outlet.submit(message) {
            refused.message.reject(refused.why);
        }
    }

    fn receive_ack(&mut self, held: u8, is_stale: bool) {
        let held: BTreeSet<u8> = (0..3).filter(|to| held >> to & 1 == 1).collect();
        self.change += u64::from(!is_stale);
        let keys = held.iter().copied().map(key).collect();
        let ack = Ack {
            receiver_id: 1,
            epoch: 1,
            peer_epoch: 1,
            next: 1,
            change: self.change,
            held: keys,
            room: None,
        };
        self.bench.outlet.on_ack(self.bench.link, &ack, Time::now());
        if !is_stale {
            for to in held.difference(&self.held) {
                self.then[usize::from(*to)] = self.seen(*to).len();
            }
            self.held = held;
        }
    }

    fn step(&mut self, step: &Step) {
        match *step {
            Step::Submit { to, confirm } => self.submit(to, confirm),
            Step::Room(room) => self.bench.make_room(room),
            Step::ReceiveAck { held, is_stale } => self.receive_ack(held, is_stale),
            Step::Expire => drop(self.bench.outlet.expire(Time::MAX)),
        }
        let OutletCounts { sent, superseded, expired, lost, refused } = self.bench.outlet.counts();
        let known = sent + superseded + expired + lost + refused + self.bench.outlet.waiting() as u64;
        assert_eq!(self.submitted, known, "all are accounted for");
        let (account, _) = self.bench.outlet.account();
        assert_eq!(Account::from(&account).unexplained(), 0, "{account:?}");
        for to in 0..3 {
            let seen = self.seen(to);
            assert!(seen.is_sorted(), "{to}: {seen:?}");
            // A message that had been started is completed.
            let may_be = self.then[usize::from(to)] + 1;
            assert!(!self.held.contains(&to) || seen.len() <= may_be, "{to} is held: {seen:?}");
        }
    }
}

proptest! {
    #[test]
    fn held_destinations_receive_nothing_and_order_is_kept(
        steps in proptest::collection::vec(any_step(), 1..60),
    ) {
        let mut world = World::new();
        for step in &steps {
            world.step(step);
        }
        world.step(&Step::ReceiveAck { held: 0, is_stale: false });
        world.step(&Step::Room(PLENTY));
        prop_assert_eq!(world.bench.outlet.waiting(), 0, "all goes out once nobody is held");
        world.bench.outlet.close(Rejection::Closed);
        let mut settled: Vec<_> = world.bench.outcome_log.take().into_iter().map(|(number, _)| number).collect();
        settled.sort_unstable();
        prop_assert_eq!(settled, world.confirmed);
    }
}
