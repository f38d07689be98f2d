//! Two nodes, connections that are cut at any byte, and the fates of the messages.

use std::collections::VecDeque;

use proptest::prelude::*;

use super::*;

const WINDOW: Window = Window { messages: 4, bytes: 1_000 };

/// A frame on a connection, in one direction.
#[derive(Clone, Debug)]
enum Frame {
    Ack(Ack),
    Message { number: u16, value: Option<u32> },
}

/// An Ack with this memory, epoch, epoch of the other and next number; no destination is held.
fn ack_of([receiver_id, epoch, peer_epoch, next]: [u64; 4]) -> Ack {
    Ack { receiver_id, epoch, peer_epoch, next, change: 0, held: Vec::new(), room: None }
}

/// One of the two nodes.
struct Side {
    sending: Sending<u32>,
    receiving: Receiving,
    link: u64,
    /// Expires for its first number.
    queue: VecDeque<u32>,
    /// Handed to the applications.
    taken: Vec<u32>,
    /// Reported to the sender: may have arrived or not.
    lost: Vec<u32>,
    void: Vec<u32>,
    epochs: u64,
}

impl Side {
    fn new() -> Self {
        Self {
            sending: Sending::new(1_000, WINDOW),
            receiving: Receiving::new(1_000),
            link: 0,
            queue: VecDeque::new(),
            taken: Vec::new(),
            lost: Vec::new(),
            void: Vec::new(),
            epochs: 1_000,
        }
    }

    fn send_ack(&mut self, out: &mut VecDeque<Frame>) {
        let ack = self.receiving.ack(self.sending.epoch(), None);
        self.sending.epoch_announced(ack.epoch);
        out.push_back(Frame::Ack(ack));
    }

    fn attach(&mut self, link: u64, out: &mut VecDeque<Frame>) {
        self.link = link;
        self.sending.link_ended();
        self.receiving.attach(link);
        self.send_ack(out);
    }

    /// This side forgets the other, as when a node counts as lost.
    fn forget(&mut self) {
        self.epochs += 1_000;
        self.lost.extend(self.sending.drain());
        self.lost.extend(self.queue.drain(..));
        self.sending = Sending::new(self.epochs, WINDOW);
        self.receiving = Receiving::new(self.epochs);
    }

    fn write(&mut self, out: &mut VecDeque<Frame>) {
        if let Some((number, value)) = self.sending.again() {
            return out.push_back(Frame::Message { number: number as u16, value: value.copied() });
        }
        if self.sending.has_room()
            && let Some(value) = self.queue.pop_front()
        {
            let number = self.sending.keep(value, 100) as u16;
            out.push_back(Frame::Message { number, value: Some(value) });
        }
    }

    fn read(&mut self, link: u64, frame: Frame, out: &mut VecDeque<Frame>) {
        match frame {
            Frame::Ack(ack) => {
                if !self.receiving.on_epoch(link, ack.epoch) {
                    return;
                }
                match self.sending.on_ack(&ack) {
                    AckEffect::Known => {}
                    AckEffect::Resumed => {
                        // Every third value has lost its use while it was kept.
                        let void = self.sending.void(|value| value % 3 == 0);
                        self.void.extend(void);
                    }
                    // The announcement of a new epoch is a separate step, because another thread may write
                    // first.
                    AckEffect::Reset(lost) => self.lost.extend(lost),
                }
            }
            Frame::Message { number, value } => match self.receiving.arrive(link, number, 100) {
                Arrival::Take { ack_is_due } => {
                    self.taken.extend(value);
                    if ack_is_due {
                        self.send_ack(out);
                    }
                }
                Arrival::Fenced => {}
                Arrival::OutOfStep { expected } => panic!("{number} came, {expected} was to come"),
            },
        }
    }
}

#[derive(Clone, Copy, Debug)]
enum Step {
    Send(bool),
    Write(bool),
    Read(bool),
    /// Sent without being due, as the layer's clock does it.
    Acknowledge(bool),
    Cut,
    Forget(bool),
}

fn any_step() -> impl Strategy<Value = Step> {
    prop_oneof![
        8 => any::<bool>().prop_map(Step::Send),
        10 => any::<bool>().prop_map(Step::Write),
        10 => any::<bool>().prop_map(Step::Read),
        2 => any::<bool>().prop_map(Step::Acknowledge),
        2 => Just(Step::Cut),
        1 => any::<bool>().prop_map(Step::Forget),
    ]
}

/// Both nodes, and the frames on the wires between them.
struct World {
    sides: [Side; 2],
    wires: [VecDeque<Frame>; 2],
    link: u64,
    sent: u32,
    sent_by: [Vec<u32>; 2],
}

impl World {
    fn new() -> Self {
        let mut world = Self {
            sides: [Side::new(), Side::new()],
            wires: [VecDeque::new(), VecDeque::new()],
            link: 0,
            sent: 0,
            sent_by: [Vec::new(), Vec::new()],
        };
        world.cut();
        world
    }

    /// The connection ends, with its frames in flight, and the next one begins.
    fn cut(&mut self) {
        self.link += 1;
        self.wires.iter_mut().for_each(VecDeque::clear);
        for (side, wire) in self.sides.iter_mut().zip(&mut self.wires) {
            side.attach(self.link, wire);
        }
    }

    fn step(&mut self, step: Step) {
        match step {
            Step::Send(side) => {
                self.sent += 1;
                self.sides[usize::from(side)].queue.push_back(self.sent);
                self.sent_by[usize::from(side)].push(self.sent);
            }
            Step::Write(side) => {
                let side = usize::from(side);
                self.sides[side].write(&mut self.wires[side]);
            }
            Step::Read(side) => {
                let side = usize::from(side);
                if let Some(frame) = self.wires[1 - side].pop_front() {
                    self.sides[side].read(self.link, frame, &mut self.wires[side]);
                }
            }
            Step::Acknowledge(side) => {
                let side = usize::from(side);
                self.sides[side].send_ack(&mut self.wires[side]);
            }
            Step::Cut => self.cut(),
            Step::Forget(side) => {
                self.sides[usize::from(side)].forget();
                self.cut();
            }
        }
    }

    /// No more faults: everything is written and read.
    fn settle(&mut self) {
        for _ in 0..2_000 {
            for side in [false, true] {
                self.step(Step::Acknowledge(side));
                self.step(Step::Write(side));
                self.step(Step::Read(side));
                self.step(Step::Read(side));
            }
        }
        // Acknowledgements of every round are still on the wires, which is all that is.
        let is_empty = |side: &Side| side.queue.is_empty() && side.sending.is_through();
        assert!(self.sides.iter().all(is_empty), "everything goes out once nothing fails");
    }

    fn check(&self) {
        for side in 0..2 {
            let (sender, taken) = (&self.sides[side], &self.sides[1 - side].taken);
            assert!(taken.is_sorted_by(|a, b| a < b), "in order and once: {taken:?}");
            for value in &self.sent_by[side] {
                let is_reported = sender.lost.contains(value) || sender.void.contains(value);
                assert!(taken.contains(value) || is_reported, "{value} is lost in silence");
            }
            let is_void_and_taken = sender.void.iter().find(|value| taken.contains(value));
            assert_eq!(is_void_and_taken, None, "a message reported as void has arrived");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    #[test]
    fn messages_arrive_once_in_order_or_are_reported(
        steps in proptest::collection::vec(any_step(), 1..200),
    ) {
        let mut world = World::new();
        for step in steps {
            world.step(step);
        }
        world.settle();
        world.check();
    }

    #[test]
    fn without_forgetting_nothing_is_reported(
        steps in proptest::collection::vec(any_step().prop_filter("no forgetting", |s| !matches!(s, Step::Forget(_))), 1..200),
    ) {
        let mut world = World::new();
        for step in steps {
            world.step(step);
        }
        world.settle();
        world.check();
        prop_assert!(world.sides.iter().all(|side| side.lost.is_empty()));
    }
}

#[test]
fn kept_messages_are_bounded_until_acknowledged() {
    let mut sending = Sending::new(7, WINDOW);
    assert!(!sending.has_room(), "the peer has not sent its next number");
    assert_eq!(sending.on_ack(&ack_of([1, 1, 0, FIRST])), AckEffect::Resumed);
    for value in 0..4u32 {
        assert!(sending.has_room());
        assert_eq!(sending.keep(value, 10), FIRST + u64::from(value));
    }
    assert!(!sending.has_room(), "four messages are the bound");
    assert_eq!(sending.on_ack(&ack_of([1, 1, 7, 3])), AckEffect::Known);
    assert!(sending.has_room());
    sending.keep(4, 1_000);
    assert!(!sending.has_room(), "a thousand bytes are the bound");
}

#[test]
fn oversized_message_is_sent_when_window_is_empty() {
    let mut sending = Sending::new(7, WINDOW);
    sending.on_ack(&ack_of([1, 1, 0, FIRST]));
    sending.keep(1, 5_000);
    sending.on_ack(&ack_of([1, 1, 7, 2]));
    assert!(sending.has_room());
}

#[test]
fn unwritten_message_returns_its_number() {
    let mut sending = Sending::new(7, WINDOW);
    sending.on_ack(&ack_of([1, 1, 0, FIRST]));
    sending.keep(1, 10);
    sending.take_back();
    assert_eq!(sending.keep(2, 10), FIRST);
    sending.link_ended();
    assert_eq!(sending.on_ack(&ack_of([1, 1, 7, FIRST])), AckEffect::Resumed);
    assert_eq!(sending.again(), Some((FIRST, Some(&2))));
    assert_eq!(sending.again(), None);
}

#[test]
fn ack_beyond_sent_numbers_resets_the_session() {
    let mut sending = Sending::new(7, WINDOW);
    sending.on_ack(&ack_of([1, 1, 0, FIRST]));
    sending.keep(1, 10);
    assert_eq!(sending.on_ack(&ack_of([1, 1, 7, 9])), AckEffect::Reset(vec![1]));
    assert_eq!(sending.epoch(), 8);
}

#[test]
fn former_connection_delivers_nothing() {
    let mut receiving = Receiving::new(1);
    receiving.attach(1);
    assert!(receiving.on_epoch(1, 5));
    assert!(matches!(receiving.arrive(1, 1, 10), Arrival::Take { .. }));
    receiving.attach(2);
    assert_eq!(receiving.arrive(1, 2, 10), Arrival::Fenced);
    assert!(!receiving.on_epoch(1, 6));
    assert_eq!(receiving.arrive(2, 2, 10), Arrival::OutOfStep { expected: 2 }, "the epoch was not announced");
    assert!(receiving.on_epoch(2, 5));
    assert!(matches!(receiving.arrive(2, 2, 10), Arrival::Take { .. }));
    assert_eq!(receiving.ack(9, None), ack_of([1, 9, 5, 3]));
}

#[test]
fn numbers_continue_beyond_sixteen_bits() {
    let mut receiving = Receiving::new(1);
    receiving.attach(1);
    receiving.on_epoch(1, 5);
    for number in 1..=70_000u32 {
        assert!(matches!(receiving.arrive(1, number as u16, 1), Arrival::Take { .. }));
    }
    assert_eq!(receiving.ack(1, None).next, 70_001);
}

#[test]
fn due_ack_waits_for_a_part_of_the_room() {
    let cases =
        [(None, 32, 32), (Some(1_024), 32, 128), (Some(512), 32, 64), (Some(64), 32, 32), (Some(20), 10, 10)];
    for (room, due, overdue) in cases {
        let mut receiving = Receiving::new(1);
        receiving.attach(1);
        receiving.on_epoch(1, 1);
        receiving.ack(1, room.map(|messages| Window { messages, bytes: 4 << 20 }));
        let arrived: Vec<_> =
            (1..=200).map(|number| (receiving.arrive(1, number, 100), receiving.is_ack_overdue())).collect();
        let first_due =
            arrived.iter().position(|(arrival, _)| *arrival == Arrival::Take { ack_is_due: true });
        let first_overdue = arrived.iter().position(|(_, is_overdue)| *is_overdue);
        assert_eq!((first_due, first_overdue), (Some(due - 1), Some(overdue - 1)), "room: {room:?}");
        receiving.ack(1, None);
        assert!(!receiving.is_ack_overdue());
    }
}
