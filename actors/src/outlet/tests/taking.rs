//! What is seen of a peer that takes what it is sent, and of one that does not.

use super::*;

/// Memory that a peer reads: it takes `room` more bytes, and tells what the peer says to have taken of them.
#[derive(Default)]
struct Memory {
    room: AtomicUsize,
    written: AtomicUsize,
    taken: AtomicUsize,
}

impl Socket for Arc<Memory> {
    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        let all: usize = parts.iter().map(|part| part.len()).sum();
        let taken = all.min(self.room.load(Ordering::Relaxed));
        if taken == 0 {
            return Err(io::ErrorKind::WouldBlock.into());
        }
        self.room.fetch_sub(taken, Ordering::Relaxed);
        self.written.fetch_add(taken, Ordering::Relaxed);
        Ok(taken)
    }

    fn written(&self) -> u64 {
        self.written.load(Ordering::Relaxed) as u64
    }

    fn account(&mut self) -> Account {
        let count = |of: &AtomicUsize| of.load(Ordering::Relaxed) as u64;
        Account { written: count(&self.written), taken: count(&self.taken) }
    }

    fn poll_writable(&mut self, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Pending
    }
}

fn leaves_some<S: Socket>(outlet: &StreamOutlet<S>) -> bool {
    outlet.taking().expect("there is a connection").leaves_some
}

/// An outlet to memory with so much room.
fn to_memory(room: usize) -> (StreamOutlet<Arc<Memory>>, Arc<Memory>, LinkNumber) {
    let (outlet, memory) = (StreamOutlet::new(LIMITS), Arc::new(Memory::default()));
    memory.room.store(room, Ordering::Relaxed);
    let link = outlet.connect(memory.clone(), usize::MAX, None);
    (outlet, memory, link)
}

impl Memory {
    fn take_all(&self) {
        self.taken.store(self.written.load(Ordering::Relaxed), Ordering::Relaxed);
    }
}

#[test]
fn what_lies_in_memory_undelivered_waits_for_the_peer_and_what_finds_no_room_there_does_too() {
    assert_eq!(StreamOutlet::<Arc<Memory>>::new(LIMITS).taking(), None, "nobody is there");
    // When: one message has room, and the next one has not.
    let (outlet, memory, link) = to_memory(message(Class::Bulk, 1).size());
    assert!(!leaves_some(&outlet));
    outlet.submit(message(Class::Bulk, 1)).expect("there is room");
    outlet.submit(message(Class::Bulk, 2)).expect("it waits");
    // Then
    assert!(leaves_some(&outlet));
    let before = outlet.taking();
    assert_eq!(outlet.taking(), before, "nothing was taken");
    // When: the peer takes a part of it, then all that it was given.
    memory.taken.store(1, Ordering::Relaxed);
    assert!(leaves_some(&outlet));
    assert_ne!(outlet.taking().map(|taking| taking.mark), before.map(|taking| taking.mark));
    memory.take_all();
    // Then: the rest waits for us, not for it.
    assert!(!leaves_some(&outlet));
    outlet.disconnect(link);
    assert_eq!(outlet.taking(), None, "nobody is there any more");
}

#[test]
fn of_a_socket_what_it_has_no_room_for_waits_for_the_peer_and_each_byte_that_goes_is_taken() {
    let length = message(Class::Bulk, 1).size();
    let bench = Bench::new(length);
    bench.submit(message(Class::Bulk, 1));
    assert!(!leaves_some(&bench.outlet), "nobody knows who has it");
    bench.submit(message(Class::Bulk, 2));
    let mut before = bench.outlet.taking();
    assert!(leaves_some(&bench.outlet));
    // When it takes a part, and the rest but for one byte.
    for room in [1, length - 2] {
        bench.make_room(room);
        let now = bench.outlet.taking();
        assert_ne!(now, before);
        assert!(leaves_some(&bench.outlet));
        before = now;
    }
    bench.make_room(1);
    assert!(!leaves_some(&bench.outlet));
}

/// What a program that only sends need not read, or that its `NodeApi` keeps.
fn not_for_the_program() -> [Message; 5] {
    let mut event = message(Class::Bulk, 1);
    event.header.source.app = AppAddress::NDL;
    let [ping, echo] = ["sinew.ping", "sinew.echo"].map(|name| {
        let mut message = message(Class::Bulk, 2);
        message.header.kind = Kind::named(name);
        message
    });
    let mut reply = message(Class::Bulk, 3);
    reply.header.flags = Flags::REPLY;
    let ticket = Ticket { source: tid(1), destination: tid(0), correlation: 1 };
    [event, ping, echo, reply, Message::outcome(ticket, Outcome::Delivered)]
}

#[test]
fn pings_echoes_replies_events_of_layers_and_outcomes_wait_for_no_program_wherever_they_wait() {
    for (number, message) in not_for_the_program().into_iter().enumerate() {
        let (outlet, _memory, _) = to_memory(PLENTY);
        outlet.submit(message).expect("there is room");
        assert!(!leaves_some(&outlet), "number {number} in memory");
    }
    for (number, message) in not_for_the_program().into_iter().enumerate() {
        let bench = Bench::new(1);
        bench.submit(message);
        assert!(!leaves_some(&bench.outlet), "number {number} begun on a socket");
        bench.submit(super::message(Class::Control, 1));
        assert!(leaves_some(&bench.outlet), "and a message behind it");
    }
}

#[test]
fn who_has_taken_the_last_message_need_not_take_the_outcomes_behind_it() {
    let (outlet, memory, _) = to_memory(PLENTY);
    outlet.submit(message(Class::Bulk, 1)).expect("there is room");
    // When: it takes the reply, and the outcome comes after that.
    memory.take_all();
    for message in not_for_the_program() {
        outlet.submit(message).expect("there is room");
    }
    // Then
    assert!(!leaves_some(&outlet));
    // When: a message is behind them.
    outlet.submit(message(Class::Bulk, 2)).expect("there is room");
    assert!(leaves_some(&outlet));
    memory.take_all();
    assert!(!leaves_some(&outlet));
}

#[test]
fn a_message_for_which_memory_that_is_full_of_other_frames_has_no_room_waits_for_the_peer() {
    let [event, ..] = not_for_the_program();
    let (outlet, memory, _) = to_memory(event.size());
    outlet.submit(event).expect("there is room");
    outlet.submit(message(Class::Bulk, 1)).expect("it waits");
    assert!(leaves_some(&outlet));
    memory.take_all();
    assert!(!leaves_some(&outlet), "it has taken all that it was given");
}

#[test]
fn what_one_connection_had_written_is_not_due_on_the_next() {
    let (outlet, _memory, link) = to_memory(PLENTY);
    outlet.submit(message(Class::Bulk, 1)).expect("there is room");
    outlet.disconnect(link);
    outlet.connect(Arc::new(Memory::default()), usize::MAX, None);
    assert!(!leaves_some(&outlet));
}
