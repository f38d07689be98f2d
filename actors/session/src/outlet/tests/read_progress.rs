//! The visible state of a peer that reads its data, and of one that does not.

use super::*;

/// Memory that a peer reads: it accepts `room` more bytes, and reports the peer's read counter.
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

fn leaves_some<S: Socket>(outlet: &SocketWriter<S>) -> bool {
    outlet.taking().expect("there is a connection").leaves_some
}

/// An outlet to memory with `room` bytes.
fn to_memory(room: usize) -> (SocketWriter<Arc<Memory>>, Arc<Memory>, LinkNumber) {
    let (outlet, memory) = (SocketWriter::new(LIMITS), Arc::new(Memory::default()));
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
fn messages_in_or_beyond_shared_memory_wait_for_peer() {
    assert_eq!(SocketWriter::<Arc<Memory>>::new(LIMITS).taking(), None, "nobody is there");
    // When: one message has room, and the next one has not.
    let (outlet, memory, link) = to_memory(message(Class::Bulk, 1).size());
    assert!(!leaves_some(&outlet));
    outlet.submit(message(Class::Bulk, 1)).expect("there is room");
    outlet.submit(message(Class::Bulk, 2)).expect("it waits");
    // Then
    assert!(leaves_some(&outlet));
    let before = outlet.taking();
    assert_eq!(outlet.taking(), before, "nothing was taken");
    // When: the peer reads a part of it, then everything that it was sent.
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
fn bytes_beyond_socket_buffer_wait_for_peer() {
    let length = message(Class::Bulk, 1).size();
    let bench = Bench::new(length);
    bench.submit(message(Class::Bulk, 1));
    assert!(!leaves_some(&bench.outlet), "nobody knows who has it");
    bench.submit(message(Class::Bulk, 2));
    let mut before = bench.outlet.taking();
    assert!(leaves_some(&bench.outlet));
    // When: it reads a part, and then the rest except for one byte.
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

/// Messages that a program need not read if it only sends, or that its `NodeApi` keeps.
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
fn frames_not_for_the_program_never_count_as_waiting() {
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
fn outcomes_behind_last_message_need_not_be_read() {
    let (outlet, memory, _) = to_memory(PLENTY);
    outlet.submit(message(Class::Bulk, 1)).expect("there is room");
    // When: it reads the reply, and the outcome comes after that.
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
fn message_behind_other_frames_waits_for_peer() {
    let [event, ..] = not_for_the_program();
    let (outlet, memory, _) = to_memory(event.size());
    outlet.submit(event).expect("there is room");
    outlet.submit(message(Class::Bulk, 1)).expect("it waits");
    assert!(leaves_some(&outlet));
    memory.take_all();
    assert!(!leaves_some(&outlet), "it has taken all that it was given");
}

#[test]
fn written_messages_are_not_due_on_next_connection() {
    let (outlet, _memory, link) = to_memory(PLENTY);
    outlet.submit(message(Class::Bulk, 1)).expect("there is room");
    outlet.disconnect(link);
    outlet.connect(Arc::new(Memory::default()), usize::MAX, None);
    assert!(!leaves_some(&outlet));
}
