//! The cost of a client that does not read, and the reports about its undelivered messages.

use super::*;

#[test]
fn client_that_never_reads_costs_a_bounded_queue() {
    let node = TestNode::start_with(|config| config.mailbox_capacity = 4);
    let app = node.local(1);
    let (_client, tid) = RawClient::register(&node, &Register::default());
    let mut refused = 0;
    // The socket holds some hundred kilobytes.
    for _ in 0..200 {
        let header = Header::new(Kind::named("blob"), app.tid, tid);
        let result = node.state.ctx.router.send(Message::new(header, vec![0; 8_192].into()));
        refused += u32::from(result == Err(Rejection::QueueFull));
    }
    assert!(refused > 0);
    assert_alive(&node);
}

#[test]
fn unread_messages_are_listed_until_read() {
    let node = TestNode::start();
    let app = node.local(1);
    let (mut client, tid) =
        RawClient::register(&node, &Register { name: Some("hand".to_owned()), ..Register::default() });
    let leaves_some = || {
        let clients = node.state.book.takings();
        clients
            .into_iter()
            .find(|client| client.app == tid.app && &*client.name == "hand")
            .map(|client| client.taking.leaves_some)
    };
    assert_eq!(leaves_some(), Some(false));
    // When: more is sent than its socket holds.
    let deadline = Time::now() + WATCHDOG;
    while leaves_some() != Some(true) {
        assert!(Time::now() < deadline, "waited for the client's socket to be full");
        node.state.ctx.router.send(filler(app.tid, tid)).expect("the queue is empty");
    }
    // When: it reads. The queued messages arrive.
    while leaves_some() != Some(false) {
        client.next().expect("the connection stands");
    }
    drop(client);
    // Then
    while leaves_some().is_some() {
        assert!(Time::now() < deadline, "waited for the client's end");
        std::thread::yield_now();
    }
}

#[test]
fn expiry_at_a_slow_client_is_reported() {
    let node = TestNode::start();
    let app = node.local(1);
    let (_client, tid) = RawClient::register(&node, &Register::default());
    let deadline = Time::now() + WATCHDOG;
    for correlation in 1.. {
        assert!(Time::now() < deadline, "waited for a message to expire in the queue");
        // Given: the queue is full; soon the socket is, too.
        while node.state.ctx.router.send(filler(app.tid, tid)).is_ok() {}
        // When: a message with a time to live waits in another class, unless the socket has room for it at that moment.
        let outcome = send_for_5_ms(&node, app.tid, tid, correlation);
        // Then
        match outcome.recv_timeout(Duration::from_millis(200)) {
            Ok(outcome) => return assert_eq!(outcome, Outcome::Expired),
            Err(_) => continue,
        }
    }
}

fn send_for_5_ms(
    node: &TestNode,
    from: Tid,
    to: Tid,
    correlation: u64,
) -> std::sync::mpsc::Receiver<Outcome> {
    let (outcome, receiver) = std::sync::mpsc::sync_channel(1);
    let mut message = confirmed(from, to, correlation);
    message.header.sent = Time::now();
    message.header.time_to_live_us = u32::try_from(Duration::from_millis(5).as_micros()).unwrap();
    let ticket = sinew_runtime::outcome::Ticket { source: from, destination: to, correlation };
    message.receipt = Some(sinew_runtime::outcome::Receipt::new(Arc::new(OutcomeSink(outcome)), ticket));
    node.state.ctx.router.send(message).unwrap();
    receiver
}

struct OutcomeSink(std::sync::mpsc::SyncSender<Outcome>);

impl sinew_runtime::outcome::ReceiptSink for OutcomeSink {
    fn settle(&self, _: sinew_runtime::outcome::Ticket, outcome: Outcome) {
        // A message that found room in the socket is not waited for.
        let _ = self.0.send(outcome);
    }
}
