//! What is told of messages while another thread writes to the same connection: it may be a flood's, and stand behind everybody else.

use std::{
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    thread,
};

use super::*;

/// So long at most a thread is waited for.
const PATIENCE: Duration = Duration::from_secs(20);

/// A wire on which a write lasts until it is told to go on: then all of it has been taken from its beginning.
struct Slow {
    writes: SyncSender<()>,
    go_on: Mutex<Receiver<()>>,
}

impl Socket for Arc<Slow> {
    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        // Whoever has gone does not wait any more.
        let _ = self.writes.send(());
        let _ = self.go_on.lock().unwrap().recv();
        Ok(parts.iter().map(|part| part.len()).sum())
    }

    fn poll_writable(&mut self, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

/// An outlet with such a wire, its writes, and what makes one go on.
fn slow() -> (StreamOutlet<Arc<Slow>>, Receiver<()>, SyncSender<()>) {
    let ((writes, written), (go_on, goes_on)) = (sync_channel(8), sync_channel(8));
    let outlet = StreamOutlet::new(LIMITS);
    outlet.connect(Arc::new(Slow { writes, go_on: Mutex::new(goes_on) }), usize::MAX, None);
    (outlet, written, go_on)
}

fn confirmed(ledger: &Arc<Ledger>, correlation: u64) -> (Message, Ticket) {
    let mut message = message(Class::Control, correlation as u8);
    message.header.correlation = correlation;
    let (source, destination) = (message.header.source, message.header.destination);
    let ticket = Ticket { source, destination, correlation };
    message.receipt = Some(Receipt::new(ledger.clone(), ticket));
    (message, ticket)
}

#[test]
fn outcomes_are_told_and_looked_for_while_another_thread_writes() {
    let (ledger, (outlet, writes, go_on)) = (Arc::new(Ledger::default()), slow());
    let outlet = &outlet;
    let [(first, known), (second, _)] = [1, 2].map(|correlation| confirmed(&ledger, correlation));
    go_on.send(()).unwrap();
    outlet.submit(first).unwrap();
    writes.recv().unwrap();
    thread::scope(|scope| {
        // Dropped if a claim fails: then the write ends, too.
        let go_on = go_on;
        scope.spawn(|| outlet.submit(second).unwrap());
        writes.recv_timeout(PATIENCE).expect("the second one is being written");
        let (say, said) = sync_channel(1);
        scope.spawn(move || {
            let mut outcomes = vec![(known, Outcome::Delivered)];
            outlet.confirm_all(&mut outcomes);
            let _ = say.send((outcomes.len(), outlet.expire(Time::now()), outlet.unconfirmed()));
        });
        let seen = said.recv_timeout(PATIENCE).expect("whoever hears an outcome does not wait for the write");
        assert_eq!(seen, (0, true, 1));
        go_on.send(()).unwrap();
    });
    assert_eq!((ledger.take(), outlet.unconfirmed()), (vec![(1, Outcome::Delivered)], 1));
}

#[test]
fn an_outcome_that_comes_before_the_write_of_its_message_has_returned_is_told_once() {
    let (ledger, (outlet, writes, go_on)) = (Arc::new(Ledger::default()), slow());
    let outlet = &outlet;
    let (only, ticket) = confirmed(&ledger, 1);
    thread::scope(|scope| {
        let go_on = go_on;
        scope.spawn(|| outlet.submit(only).unwrap());
        writes.recv_timeout(PATIENCE).expect("it is being written");
        let (say, said) = sync_channel(1);
        scope.spawn(move || say.send(outlet.confirm(ticket, Outcome::Delivered)));
        assert!(said.recv_timeout(PATIENCE).expect("it does not wait for the write"), "it is waited for");
        go_on.send(()).unwrap();
    });
    assert_eq!((ledger.take(), outlet.unconfirmed()), (vec![(1, Outcome::Delivered)], 0));
    assert!(!outlet.confirm(ticket, Outcome::Failed), "nobody waits for it any more");
    assert_eq!(ledger.take(), []);
}
