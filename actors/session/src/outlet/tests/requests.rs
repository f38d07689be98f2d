//! Requests without a waiting requester: withdrawn where they wait, and not sent again.

use super::*;
use crate::Window;

pub(super) fn session(room: usize) -> Bench {
    let void = Header::new(Kind::GNCL_VOID, tid(0), tid(1));
    let window = Window { messages: 64, bytes: PLENTY };
    let outlet = SocketWriter::with_session(LIMITS, Session::new(1, window, void, None));
    let wire = Arc::new(Wire::default());
    wire.room.store(room, Ordering::Relaxed);
    let link = outlet.connect(wire.clone(), usize::MAX, None);
    let bench = Bench { outlet, wire, link, outcome_log: Arc::default() };
    receive_ack(&bench, 1, Vec::new());
    bench
}

fn receive_ack(bench: &Bench, next: u64, held: Vec<u64>) {
    let change = held.len() as u64 + 1;
    let ack = Ack { receiver_id: 1, epoch: 1, peer_epoch: 1, next, change, held, room: None };
    bench.outlet.on_ack(bench.link, &ack, Time::now());
}

fn request(bench: &Bench, number: u64) -> Message {
    let mut message = bench.confirmed(number);
    message.header.class = Class::Control;
    message.header.flags = Flags::ASK;
    message.header.correlation = number;
    message
}

/// Sends a request, and returns its ticket.
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
fn nothing_is_sent_before_the_first_ack() {
    let bench = session(PLENTY);
    let words = |kind| Message::new(Header::new(kind, tid(0), tid(1)), Bytes::new());
    let ping =
        || bench.outlet.submit_urgent(words(Kind::GNCL_PING), usize::MAX).map_err(|refused| refused.why);
    assert_eq!(ping(), Err(Rejection::Closed));
    bench.outlet.submit_urgent(words(Kind::GNCL_ACK), usize::MAX).expect("it is the first");
    assert_eq!(ping(), Ok(()));
    assert_eq!(kinds(&bench), [Kind::GNCL_ACK, Kind::GNCL_PING]);
    // And on each connection again.
    bench.outlet.connect(bench.wire.clone(), usize::MAX, None);
    assert_eq!(ping(), Err(Rejection::Closed));
}

#[test]
fn queued_request_is_cancelled_and_order_is_kept() {
    let bench = session(0);
    let tickets = [1, 2, 3].map(|number| ask(&bench, number));
    assert!(bench.outlet.cancel(tickets[1]));
    assert!(!bench.outlet.cancel(tickets[1]), "it is there no more");
    assert_eq!(bench.outcome_log.take(), [(2, Outcome::Expired)]);
    bench.make_room(PLENTY);
    let seen: Vec<_> = frames(&bench.wire.bytes.lock().unwrap());
    assert_eq!(seen.iter().map(|message| message.header.correlation).collect::<Vec<_>>(), [1, 3]);
    assert_eq!(seen.iter().map(|message| message.header.number).collect::<Vec<_>>(), [1, 2]);
    let counts = bench.outlet.counts();
    assert_eq!((counts.sent, counts.expired, bench.outlet.unconfirmed()), (2, 1, 2));
}

#[test]
fn request_is_cancelled_in_line_of_held_destination() {
    let bench = session(PLENTY);
    receive_ack(&bench, 1, vec![u64::from(request(&bench, 0).header.destination.app.bits())]);
    bench.outcome_log.take();
    let tickets = [1, 2].map(|number| ask(&bench, number));
    assert_eq!(bench.outlet.in_backlog(), 2);
    assert!(bench.outlet.cancel(tickets[0]));
    assert_eq!((bench.outlet.in_backlog(), bench.outcome_log.take()), (1, vec![(1, Outcome::Expired)]));
    assert_eq!(bench.outlet.unconfirmed(), 1);
}

#[test]
fn last_frame_is_sent_once_no_message_waits() {
    let removals: [fn(&Bench, Ticket); 2] = [
        |bench, ticket| assert!(bench.outlet.cancel(ticket)),
        |bench, _| _ = bench.outlet.expire(Time::now() + Duration::from_secs(61)),
    ];
    for remove in removals {
        // Given: the last frame waits for a request to a destination that accepts nothing.
        let bench = session(PLENTY);
        let mut request = request(&bench, 1);
        (request.header.sent, request.header.time_to_live_us) = (Time::now(), 60_000_000);
        receive_ack(&bench, 1, vec![u64::from(request.header.destination.app.bits())]);
        let ticket = request.ticket();
        bench.submit(request);
        bench.outlet.finish(message(Class::Control, 9));
        bench.drain();
        let is_asleep = || bench.outlet.lock().connection.is_drainer_asleep();
        assert!(is_asleep() && bench.outlet.in_backlog() == 1);
        // When
        remove(&bench, ticket);
        // Then
        assert!(!is_asleep(), "no ACK need follow");
        bench.drain();
        assert_eq!(bench.seen(), [9]);
    }
}

#[test]
fn request_cancelled_while_disconnected_is_not_resent() {
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
        receive_ack(&bench, if has_arrived { 2 } else { 1 }, Vec::new());
        bench.drain();
        assert_eq!(kinds(&bench), sent_again);
        let expected = if has_arrived { Vec::new() } else { vec![(1, Outcome::Expired)] };
        assert_eq!(bench.outcome_log.take(), expected);
    }
}
