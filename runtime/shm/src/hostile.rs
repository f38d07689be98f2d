//! A peer that writes anything into all memory that it may write, while this side uses the connection. For
//! tests, and for the example `hostile`; never in a robot.

use std::{
    collections::BTreeMap,
    os::fd::OwnedFd,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use rustix::fs::{FallocateFlags, fallocate, ftruncate};

use crate::{
    BellKind, Capacity, Consumer, CorruptError, LoanError, Offer, Producer, ReceiveError, Region, RoomError,
    Terms, Wait,
    layout::{HEADER_BYTES, Mark, Word},
    memory::Peer,
    platform,
};

/// The figures of an attack.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    /// Connections.
    pub lives: u64,
    /// Messages that were received, mostly forged ones.
    pub taken: u64,
    /// Messages that were published.
    pub published: u64,
    /// Waits that ended at their deadline.
    pub timed_out: u64,
    /// Writes of the hostile side.
    pub writes: u64,
    /// How often the peer was caught, by the kind of error.
    pub caught: BTreeMap<&'static str, u64>,
}

impl Tally {
    fn catch(&mut self, corrupt: CorruptError) {
        let name = match corrupt {
            CorruptError::Tail { .. } => "tail",
            CorruptError::Head { .. } => "head",
            CorruptError::Mark(_) => "mark",
            CorruptError::Length { .. } => "length",
            CorruptError::Skip { .. } => "skip",
        };
        *self.caught.entry(name).or_default() += 1;
    }
}

/// The source of decisions: numbers of a seed, or the bytes of a script.
#[derive(Clone, Debug)]
enum Dice {
    /// xorshift64*.
    Seeded(u64),
    /// Read from the end; zeros when it is over.
    Written(Vec<u8>),
}

impl Dice {
    const fn new(seed: u64) -> Self {
        Self::Seeded(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    fn next(&mut self) -> u32 {
        match self {
            Self::Seeded(state) => {
                *state ^= *state >> 12;
                *state ^= *state << 25;
                *state ^= *state >> 27;
                (state.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 32) as u32
            }
            Self::Written(bytes) => u32::from_le_bytes([0; 4].map(|_: u8| bytes.pop().unwrap_or_default())),
        }
    }

    /// Reads no more bytes of a script than the limit needs: one more byte is one more decision.
    fn below(&mut self, limit: u32) -> u32 {
        match self {
            Self::Written(bytes) if limit <= 1 << 8 => u32::from(bytes.pop().unwrap_or_default()) % limit,
            Self::Seeded(_) | Self::Written(_) => self.next() % limit,
        }
    }

    /// The longest wait, in microseconds: a script must end soon.
    const fn patience_us(&self) -> u32 {
        match self {
            Self::Seeded(_) => 300,
            Self::Written(_) => 1,
        }
    }

    const fn is_over(&self) -> bool {
        match self {
            Self::Seeded(_) => false,
            Self::Written(bytes) => bytes.is_empty(),
        }
    }
}

/// Connects to a hostile peer and uses the connection, `lives` times. The same seed gives the same intended
/// steps; their interleaving depends on the scheduler.
///
/// # Panics
/// When this side is harmed: a message beyond its bounds, or an error that no peer should be able to cause.
#[must_use]
pub fn assault(seed: u64, lives: u64) -> Tally {
    let mut tally = Tally::default();
    for life in 0..lives {
        let mut dice = Dice::new(seed ^ life << 20);
        one_life(&mut dice, &mut tally);
    }
    tally
}

/// One connection to a hostile peer, in which a script decides the next step of either side, on one thread.
/// For a fuzzer, which selects scripts by the code that they reach.
///
/// # Panics
/// As [`assault`].
#[must_use]
pub fn play(script: &[u8]) -> Tally {
    let mut dice = Dice::Written(script.iter().rev().copied().collect());
    let (mut tally, (mut user, mut attacker)) = (Tally { lives: 1, ..Tally::default() }, meet(&mut dice));
    while !dice.is_over() && user.caught != (true, true) {
        if dice.below(2) == 0 {
            attacker.write(&mut dice);
            tally.writes += 1;
        } else {
            user.act(&mut dice, &mut tally);
        }
    }
    user.judge(attacker.wild);
    tally
}

fn one_life(dice: &mut Dice, tally: &mut Tally) {
    let (mut user, mut attacker) = meet(dice);
    let (mut attack, wild, over) = (dice.clone(), attacker.wild, AtomicBool::new(false));
    thread::scope(|scope| {
        let writes = scope.spawn(|| {
            let unless_over = || (!over.load(Ordering::Relaxed)).then_some(());
            std::iter::from_fn(unless_over).map(|()| attacker.write(&mut attack)).count()
        });
        let ends = EndsIt(&over);
        user.act_until_caught(dice, tally);
        drop(ends);
        tally.writes += writes.join().expect("the attacker has no claims that could fail") as u64;
    });
    user.judge(wild);
    tally.lives += 1;
}

/// Connects two sides: a user of the connection, and an attacker.
fn meet(dice: &mut Dice) -> (User, Attacker) {
    let bells = [BellKind::Futex, BellKind::EventFd, BellKind::Socket];
    let bell = bells[dice.below(3) as usize];
    let capacity = Capacity::new(4096 << dice.below(3)).expect("a power of two");
    let (ours, our_offer) = Region::create(capacity, bell).expect("a region");
    let (theirs, their_offer) = Region::create(capacity, bell).expect("a region");
    let keys = [&our_offer, &their_offer].map(|offer| duplicate(&offer.descriptors()[0])).into();
    let terms = Terms { bells: bells.to_vec(), ..Terms::default() };
    let (producer, consumer) = ours.connect(their_offer, &terms).expect("honest so far");
    // This many of 256 writes are random; the others are those of an honest peer, to get further.
    let wild = [0, 1, 4, 32, 256][dice.below(5) as usize];
    (User { producer, consumer, caught: (false, false) }, Attacker::new(theirs, our_offer, keys, wild))
}

/// Ends the attack also when this side panics: otherwise the panic would not be reported.
struct EndsIt<'a>(&'a AtomicBool);

impl Drop for EndsIt<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

fn duplicate(fd: &OwnedFd) -> OwnedFd {
    fd.try_clone().expect("a descriptor")
}

/// This side, as in an application.
struct User {
    producer: Producer,
    consumer: Consumer,
    /// Whether the peer was caught: by the consumer, by the producer.
    caught: (bool, bool),
}

impl User {
    /// Performs an application's operations, in any order, until both halves have caught the peer or there
    /// were enough of them.
    fn act_until_caught(&mut self, dice: &mut Dice, tally: &mut Tally) {
        for _ in 0..3_000 {
            self.act(dice, tally);
            if self.caught == (true, true) {
                return;
            }
        }
    }

    fn act(&mut self, dice: &mut Dice, tally: &mut Tally) {
        let Self { producer, consumer, caught } = self;
        if dice.below(2) == 0 {
            caught.0 |= receive(consumer, dice, tally, caught.0);
        } else {
            caught.1 |= send(producer, dice, tally, caught.1);
        }
    }

    fn judge(&self, wild: u32) {
        assert!(
            wild > 0 || self.caught == (false, false),
            "an honest peer is never accused: {:?}",
            self.caught
        );
    }
}

/// Receives. Returns whether the peer was caught.
fn receive(consumer: &mut Consumer, dice: &mut Dice, tally: &mut Tally, known: bool) -> bool {
    let max = consumer.payload_max();
    let found = match dice.below(16) {
        0 => match consumer.receive_before(&shortly(dice)) {
            Ok(lent) => Ok(Some(lent)),
            Err(ReceiveError::Corrupt(corrupt)) => Err(corrupt),
            // The attacker also holds the other end of a bell.
            Err(ReceiveError::TimedOut | ReceiveError::HungUp) => {
                tally.timed_out += 1;
                Ok(None)
            }
            Err(ReceiveError::System(error)) => panic!("no peer can cause this: {error}"),
        },
        1 => {
            let armed = consumer.arm();
            consumer.disarm();
            armed.map(|_| None)
        }
        _ => consumer.receive(),
    };
    match found {
        Ok(None) => false,
        Ok(Some(lent)) => {
            assert!(lent.len() <= max, "{} bytes where {max} is the most", lent.len());
            assert_eq!(lent.to_vec().len(), lent.len());
            tally.taken += 1;
            false
        }
        Err(corrupt) => {
            if !known {
                tally.catch(corrupt);
            }
            true
        }
    }
}

/// Sends. Returns whether the peer was caught.
fn send(producer: &mut Producer, dice: &mut Dice, tally: &mut Tally, known: bool) -> bool {
    let length = dice.below(producer.payload_max() as u32 + 1) as usize;
    let room = match dice.below(16) {
        0 => producer.loan_before(length, &shortly(dice)),
        1 => {
            let armed = producer.arm(length);
            producer.disarm();
            if let Err(LoanError::Corrupt(corrupt)) = armed {
                Err(corrupt.into())
            } else {
                Err(RoomError::TimedOut)
            }
        }
        _ => match producer.loan(length) {
            Ok(loan) => Ok(loan),
            Err(LoanError::Full { .. }) => Err(RoomError::TimedOut),
            Err(LoanError::Corrupt(corrupt)) => Err(corrupt.into()),
            Err(LoanError::TooLong { .. }) => panic!("it was not asked for more than the most"),
        },
    };
    match room {
        Ok(mut loan) => {
            assert_eq!(loan.len(), length);
            loan.fill(0xEE);
            assert!(loan.iter().all(|byte| *byte == 0xEE), "nobody else writes here");
            loan.publish();
            tally.published += 1;
            false
        }
        Err(RoomError::TimedOut | RoomError::HungUp) => {
            tally.timed_out += 1;
            false
        }
        Err(RoomError::Corrupt(corrupt)) => {
            if !known {
                tally.catch(corrupt);
            }
            true
        }
        Err(error @ (RoomError::TooLong { .. } | RoomError::System(_))) => {
            panic!("no peer can cause this: {error}")
        }
    }
}

fn shortly(dice: &mut Dice) -> Wait<'static> {
    Wait::within(Duration::from_micros(u64::from(dice.below(dice.patience_us()))))
}

/// The other side: it can write its own memory, and tries to write this side's.
struct Attacker {
    region: Region,
    /// Its view of this side.
    victim: platform::PeerMemory,
    /// Descriptors of the memory of this side, and of its own.
    keys: Vec<OwnedFd>,
    buttons: [Box<dyn crate::bell::Doorbell>; 2],
    wild: u32,
    tail: u32,
    head: u32,
}

impl Attacker {
    fn new(region: Region, victim: Offer, keys: Vec<OwnedFd>, wild: u32) -> Self {
        let mut fds = victim.descriptors.into_iter();
        let memory = platform::adopt(fds.next().expect("it comes first"), victim.capacity);
        let buttons = platform::buttons(victim.bell, victim.slot, fds.collect()).expect("honest bells");
        let victim = memory.expect("honest memory");
        Self { region, victim, keys, buttons: [buttons.message, buttons.room], wild, tail: 0, head: 0 }
    }

    fn write(&mut self, dice: &mut Dice) {
        if dice.below(256) >= self.wild {
            self.write_as_the_honest_do(dice);
        } else if dice.below(2) == 0 {
            self.lie(dice);
        } else {
            self.write_anything(dice);
        }
    }

    fn write_anything(&mut self, dice: &mut Dice) {
        let (place, value) = (dice.next(), dice.next());
        match dice.below(8) {
            0 => self.region.scribble(Word::Tail.index() as u32, value),
            1 => self.region.scribble(Word::Head.index() as u32, value),
            2 => self.try_the_keys(value),
            _ => self.region.scribble(place, value),
        }
    }

    /// Attempts operations that the seals must prevent. Another test checks that they do; here they must do
    /// no harm.
    fn try_the_keys(&self, value: u32) {
        for key in &self.keys {
            let hole = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
            let refused = [
                ftruncate(key, u64::from(value % 8192)).is_err(),
                fallocate(key, hole, 0, 4096).is_err(),
                rustix::io::pwrite(key, &value.to_ne_bytes(), u64::from(value % 4096)).is_err(),
            ];
            assert_eq!(refused, [true; 3], "a sealed memory lets nothing through");
        }
    }

    fn write_as_the_honest_do(&mut self, dice: &mut Dice) {
        let small = dice.below(600);
        match dice.below(10) {
            0..4 => self.publish(small),
            4..6 => self.take(dice),
            6 => self.region.scribble(Word::ConsumerSleep.index() as u32, small),
            7 => self.region.scribble(Word::ProducerSleep.index() as u32, small),
            8 => self.region.scribble(Word::Rung.index() as u32, small),
            _ => self.buttons[small as usize % 2].ring(),
        }
    }

    /// Writes values that a check must reject, close to those that it accepts.
    fn lie(&mut self, dice: &mut Dice) {
        let position = self.position_of_a_mark(dice);
        match dice.below(4) {
            0 => {
                let length = self.length_at_an_edge(position, dice);
                self.put_mark(position, Mark::Message(length));
            }
            1 => self.put_mark(position, Mark::Skip),
            2 => self.miscount(dice),
            // Bytes of some message, perhaps while it is copied.
            _ => {
                let place = HEADER_BYTES as u32 / 4 + dice.below(self.region.capacity.bytes() / 4);
                self.region.scribble(place, dice.next());
            }
        }
    }

    /// Publishes as an honest producer does.
    fn publish(&mut self, length: u32) {
        let capacity = self.region.capacity;
        let record = crate::layout::record_bytes(length).expect("it is small");
        let rest = capacity.rest(self.tail);
        let skip = if record > rest { rest } else { 0 };
        // Earlier false values may give any number here.
        let used = self.tail.wrapping_sub(self.victim.load(Word::Head));
        if u64::from(used) + u64::from(skip) + u64::from(record) > u64::from(capacity.bytes()) {
            return;
        }
        // Only this keeps the processor from writing there before the victim has read.
        std::sync::atomic::fence(Ordering::Acquire);
        if skip > 0 {
            self.put_mark(capacity.position(self.tail), Mark::Skip);
        }
        let start = self.tail.wrapping_add(skip);
        self.put_mark(capacity.position(start), Mark::Message(length));
        self.tail = start.wrapping_add(record);
        // Only this keeps the processor from showing the tail before the mark.
        std::sync::atomic::fence(Ordering::Release);
        self.region.scribble(Word::Tail.index() as u32, self.tail);
    }

    /// Consumes as an honest consumer does, in any pieces.
    fn take(&mut self, dice: &mut Dice) {
        let unread = self.victim.load(Word::Tail).wrapping_sub(self.head);
        self.head = self.head.wrapping_add(dice.below(unread + 1) & !7);
        self.region.scribble(Word::Head.index() as u32, self.head);
    }

    /// A random position, or the one that the victim reads next.
    fn position_of_a_mark(&self, dice: &mut Dice) -> u32 {
        let capacity = self.region.capacity;
        match dice.below(2) {
            0 => dice.below(capacity.bytes() / 8) * 8,
            _ => capacity.position(self.victim.load(Word::Head)),
        }
    }

    /// A length a little below or above the limit of one of the victim's checks, or any short one.
    fn length_at_an_edge(&self, position: u32, dice: &mut Dice) -> u32 {
        let capacity = self.region.capacity;
        let edge = match dice.below(4) {
            0 => capacity.rest(position),
            1 => capacity.payload_max(),
            2 => capacity.bytes(),
            _ => return dice.below(5_400),
        };
        edge.wrapping_add(dice.below(64)).wrapping_sub(24)
    }

    /// A tail or a head that is a little beside the true one.
    fn miscount(&mut self, dice: &mut Dice) {
        let beside = |count: u32, by: u32| count.wrapping_add(by).wrapping_sub(32);
        match dice.below(2) {
            0 => self.region.scribble(Word::Tail.index() as u32, beside(self.tail, dice.below(64))),
            _ => self.region.scribble(Word::Head.index() as u32, beside(self.head, dice.below(64))),
        }
    }

    fn put_mark(&mut self, position: u32, mark: Mark) {
        let place = (HEADER_BYTES as u32 + position) / 4;
        let bits = mark.to_bits();
        self.region.scribble(place, bits as u32);
        self.region.scribble(place + 1, (bits >> 32) as u32);
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;

    #[test]
    fn hostile_peer_harms_nothing_and_is_always_caught() {
        let mut all = Tally::default();
        for seed in 0..40 {
            let tally = assault(seed, 10);
            all.taken += tally.taken;
            all.published += tally.published;
            tally.caught.into_iter().for_each(|(name, times)| *all.caught.entry(name).or_default() += times);
        }
        let ways: Vec<&str> = all.caught.keys().copied().collect();
        assert_eq!(
            ways,
            ["head", "length", "mark", "skip", "tail"],
            "the attack reaches every check: {all:?}"
        );
        assert!(all.taken > 0 && all.published > 0, "and what lies behind them: {all:?}");
    }

    proptest::proptest! {
        #[test]
        fn hostile_script_harms_nothing(script in proptest::collection::vec(proptest::num::u8::ANY, 0..4_000)) {
            let tally = play(&script);
            proptest::prop_assert_eq!(tally.lives, 1);
        }
    }
}
