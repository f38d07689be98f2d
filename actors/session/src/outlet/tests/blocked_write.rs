//! Outcomes and expiries of messages while another thread writes to the same connection: the writer may have
//! a low priority and write a burst.

use std::{
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    thread,
};

use super::*;

/// Maximum wait for a thread.
const WATCHDOG: Duration = Duration::from_secs(20);

/// A wire with a write that lasts until the test lets it proceed. All its data counts as accepted since its
/// start.
struct Slow {
    writes: SyncSender<()>,
    proceed: Mutex<Receiver<()>>,
}

impl Socket for Arc<Slow> {
    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        // If the test has ended, it does not wait any more.
        let _ = self.writes.send(());
        let _ = self.proceed.lock().unwrap().recv();
        Ok(parts.iter().map(|part| part.len()).sum())
    }

    fn poll_writable(&mut self, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

/// Returns an outlet with such a wire, its writes, and the sender that lets one proceed.
fn slow() -> (SocketWriter<Arc<Slow>>, Receiver<()>, SyncSender<()>) {
    let ((writes, written), (proceed, continued)) = (sync_channel(8), sync_channel(8));
    let outlet = SocketWriter::new(LIMITS);
    outlet.connect(Arc::new(Slow { writes, proceed: Mutex::new(continued) }), usize::MAX, None);
    (outlet, written, proceed)
}

fn confirmed(outcome_log: &Arc<OutcomeLog>, correlation: u64) -> (Message, Ticket) {
    let mut message = message(Class::Control, correlation as u8);
    message.header.correlation = correlation;
    let (source, destination) = (message.header.source, message.header.destination);
    let ticket = Ticket { source, destination, correlation };
    message.receipt = Some(Receipt::new(outcome_log.clone(), ticket));
    (message, ticket)
}

#[test]
fn outcomes_are_settled_during_a_blocked_write() {
    let (outcome_log, (outlet, writes, proceed)) = (Arc::new(OutcomeLog::default()), slow());
    let outlet = &outlet;
    let [(first, known), (second, _)] = [1, 2].map(|correlation| confirmed(&outcome_log, correlation));
    proceed.send(()).unwrap();
    outlet.submit(first).unwrap();
    writes.recv().unwrap();
    thread::scope(|scope| {
        // Dropped if a claim fails: then the write ends, too.
        let proceed = proceed;
        scope.spawn(|| outlet.submit(second).unwrap());
        writes.recv_timeout(WATCHDOG).expect("the second one is being written");
        let (report, reported) = sync_channel(1);
        scope.spawn(move || {
            let mut outcomes = vec![OutcomeRun::new(known, 1, Outcome::Delivered)];
            outlet.confirm_all(&mut outcomes);
            let _ = report.send((outcomes.len(), outlet.expire(Time::now()), outlet.unconfirmed()));
        });
        let seen = reported.recv_timeout(WATCHDOG).expect("a confirmation does not wait for the write");
        assert_eq!(seen, (0, true, 1));
        proceed.send(()).unwrap();
    });
    assert_eq!((outcome_log.take(), outlet.unconfirmed()), (vec![(1, Outcome::Delivered)], 1));
}

#[test]
fn outcome_during_write_is_settled_once() {
    let (outcome_log, (outlet, writes, proceed)) = (Arc::new(OutcomeLog::default()), slow());
    let outlet = &outlet;
    let (only, ticket) = confirmed(&outcome_log, 1);
    thread::scope(|scope| {
        let proceed = proceed;
        scope.spawn(|| outlet.submit(only).unwrap());
        writes.recv_timeout(WATCHDOG).expect("it is being written");
        let (report, reported) = sync_channel(1);
        scope.spawn(move || report.send(outlet.confirm(ticket, Outcome::Delivered)));
        assert!(reported.recv_timeout(WATCHDOG).expect("it does not wait for the write"), "it is waited for");
        proceed.send(()).unwrap();
    });
    assert_eq!((outcome_log.take(), outlet.unconfirmed()), (vec![(1, Outcome::Delivered)], 0));
    assert!(!outlet.confirm(ticket, Outcome::Failed), "no sender waits for it any more");
    assert_eq!(outcome_log.take(), []);
}
