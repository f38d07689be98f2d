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

    fn account(&mut self) -> Account {
        let count = |of: &AtomicUsize| of.load(Ordering::Relaxed) as u64;
        Account { written: count(&self.written), taken: count(&self.taken) }
    }

    fn poll_writable(&mut self, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Pending
    }
}

fn seen<S: Socket>(outlet: &StreamOutlet<S>) -> (Left, u64) {
    let Taking { left, messages, .. } = outlet.taking().expect("there is a connection");
    (left, messages)
}

#[test]
fn what_lies_in_memory_untaken_waits_for_the_peer_and_what_finds_no_room_there_does_too() {
    let (outlet, memory) = (StreamOutlet::new(LIMITS), Arc::new(Memory::default()));
    assert_eq!(outlet.taking(), None, "nobody is there");
    let link = outlet.connect(memory.clone(), usize::MAX, None);
    assert_eq!(seen(&outlet), (Left::Nothing, 0));
    // When: one message has room, and the next one has not.
    memory.room.store(message(Class::Bulk, 1).size(), Ordering::Relaxed);
    outlet.submit(message(Class::Bulk, 1)).expect("there is room");
    outlet.submit(message(Class::Bulk, 2)).expect("it waits");
    // Then
    assert_eq!(seen(&outlet), (Left::Untaken, 2));
    let before = outlet.taking();
    assert_eq!(outlet.taking(), before, "nothing was taken");
    // When: the peer takes a part of it, then all that it was given.
    memory.taken.store(1, Ordering::Relaxed);
    assert_eq!(seen(&outlet).0, Left::Untaken);
    assert_ne!(outlet.taking().map(|taking| taking.mark), before.map(|taking| taking.mark));
    memory.taken.store(memory.written.load(Ordering::Relaxed), Ordering::Relaxed);
    // Then: the rest waits for us, not for it.
    assert_eq!(seen(&outlet), (Left::Ungiven, 2));
    outlet.disconnect(link);
    assert_eq!(outlet.taking(), None, "nobody is there any more");
}

#[test]
fn of_a_socket_what_it_has_no_room_for_waits_for_the_peer_and_each_byte_that_goes_is_taken() {
    let length = message(Class::Bulk, 1).size();
    let bench = Bench::new(length);
    bench.submit(message(Class::Bulk, 1));
    assert_eq!(seen(&bench.outlet), (Left::Nothing, 1), "nobody knows who has it");
    bench.submit(message(Class::Bulk, 2));
    let mut before = bench.outlet.taking();
    assert_eq!(seen(&bench.outlet), (Left::Untaken, 2));
    // When it takes a part, and the rest but for one byte.
    for room in [1, length - 2] {
        bench.make_room(room);
        let now = bench.outlet.taking();
        assert_ne!(now, before);
        assert_eq!(now.map(|taking| taking.left), Some(Left::Untaken));
        before = now;
    }
    bench.make_room(1);
    assert_eq!(seen(&bench.outlet), (Left::Nothing, 2));
}

#[test]
fn frames_of_the_layers_and_outcomes_are_no_messages() {
    let bench = Bench::new(0);
    let ticket = Ticket { source: tid(1), destination: tid(0), correlation: 1 };
    bench.submit(Message::outcome(ticket, Outcome::Delivered));
    assert_eq!(seen(&bench.outlet), (Left::Untaken, 0));
    bench.submit(message(Class::Control, 1));
    assert_eq!(seen(&bench.outlet), (Left::Untaken, 1));
}
