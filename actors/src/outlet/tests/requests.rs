//! Requests that nobody waits for any more: taken back where they wait, and not sent again.

use super::*;
use crate::session::Window;

pub(super) fn session(room: usize) -> Bench {
    let void = Header::new(Kind::GNCL_VOID, tid(0), tid(1));
    let window = Window { messages: 64, bytes: PLENTY };
    let outlet = StreamOutlet::with_session(LIMITS, Session::new(1, window, void, None));
    let wire = Arc::new(Wire::default());
    wire.room.store(room, Ordering::Relaxed);
    let link = outlet.connect(wire.clone(), usize::MAX, None);
    let bench = Bench { outlet, wire, link, ledger: Arc::default() };
    hear(&bench, 1, Vec::new());
    bench
}

fn hear(bench: &Bench, next: u64, held: Vec<u64>) {
    let change = held.len() as u64 + 1;
    let ack = Ack { memory: 1, epoch: 1, of: 1, next, change, held, room: None };
    bench.outlet.heard(bench.link, &ack, Time::now());
}

fn request(bench: &Bench, number: u64) -> Message {
    let mut message = bench.confirmed(number);
    message.header.class = Class::Control;
    message.header.flags = Flags::ASK;
    message.header.correlation = number;
    message
}

/// Sends a request, and returns what names it.
fn ask(bench: &Bench, number: u64) -> Ticket {
    let request = request(bench, number);
    let ticket = request.ticket();
    bench.submit(request);
    ticket
}

fn kinds(bench: &Bench) -> Vec<Kind> {
    frames(&bench.wire.bytes.lock().unwrap()).iter().map(|message| message.header.kind).collect()
}

// spec: SESSION-3
#[test]
fn nothing_is_said_on_a_connection_before_what_is_taken_next() {
    let bench = session(PLENTY);
    let words = |kind| Message::new(Header::new(kind, tid(0), tid(1)), Bytes::new());
    let ping =
        || bench.outlet.submit_urgent(words(Kind::GNCL_PING), usize::MAX).map_err(|refused| refused.why);
    assert_eq!(ping(), Err(Rejection::Closed));
    bench.outlet.submit_urgent(words(Kind::GNCL_ACK), usize::MAX).expect("it is the first");
    assert_eq!(ping(), Ok(()));
    assert_eq!(kinds(&bench), [Kind::GNCL_ACK, Kind::GNCL_PING]);
    // And on each one anew.
    bench.outlet.connect(bench.wire.clone(), usize::MAX, None);
    assert_eq!(ping(), Err(Rejection::Closed));
}

#[test]
fn a_request_that_waits_for_the_socket_is_taken_back_and_the_others_keep_their_order() {
    let bench = session(0);
    let tickets = [1, 2, 3].map(|number| ask(&bench, number));
    assert!(bench.outlet.cancel(tickets[1]));
    assert!(!bench.outlet.cancel(tickets[1]), "it is there no more");
    assert_eq!(bench.ledger.take(), [(2, Outcome::Expired)]);
    bench.make_room(PLENTY);
    let seen: Vec<_> = frames(&bench.wire.bytes.lock().unwrap());
    assert_eq!(seen.iter().map(|message| message.header.correlation).collect::<Vec<_>>(), [1, 3]);
    assert_eq!(seen.iter().map(|message| message.header.number).collect::<Vec<_>>(), [1, 2]);
    let counts = bench.outlet.counts();
    assert_eq!((counts.sent, counts.expired, bench.outlet.unconfirmed()), (2, 1, 2));
}

#[test]
fn a_request_for_one_who_takes_nothing_is_taken_back_out_of_its_line() {
    let bench = session(PLENTY);
    hear(&bench, 1, vec![u64::from(request(&bench, 0).header.destination.app.bits())]);
    bench.ledger.take();
    let tickets = [1, 2].map(|number| ask(&bench, number));
    assert_eq!(bench.outlet.in_lines(), 2);
    assert!(bench.outlet.cancel(tickets[0]));
    assert_eq!((bench.outlet.in_lines(), bench.ledger.take()), (1, vec![(1, Outcome::Expired)]));
    assert_eq!(bench.outlet.unconfirmed(), 1);
}

#[test]
fn a_request_that_was_given_up_while_there_was_no_connection_is_not_sent_again_if_it_has_not_arrived() {
    for (has_arrived, sent_again) in
        [(false, vec![Kind::GNCL_VOID, Kind::CANCEL]), (true, vec![Kind::CANCEL])]
    {
        let mut bench = session(PLENTY);
        let ticket = ask(&bench, 1);
        assert_eq!(kinds(&bench), [Kind::named("test")]);
        bench.outlet.disconnect(bench.link);
        assert!(!bench.outlet.cancel(ticket), "it may have arrived");
        bench.submit(Message::cancel(ticket));
        bench.reconnect(PLENTY);
        hear(&bench, if has_arrived { 2 } else { 1 }, Vec::new());
        bench.drain();
        assert_eq!(kinds(&bench), sent_again);
        let expected = if has_arrived { Vec::new() } else { vec![(1, Outcome::Expired)] };
        assert_eq!(bench.ledger.take(), expected);
    }
}
