//! The threads of the layer: Bulk has one of its own, and its faults are still the layer's.

use std::{sync::Arc, thread};

use sinew_runtime::{
    event_queue::EventQueue,
    outcome::Outcome,
    router::{LocalRoute, MessageSink, SubmitError},
    tid::AppAddress,
    wire::{Class, Message},
};

use super::bench::{Node, next, pair, run};

/// Reports the thread on which it is given messages; one of Bulk panics, if requested.
struct Witness {
    threads: EventQueue<(Class, String)>,
    breaks: bool,
}

impl MessageSink for Witness {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        let (class, name) = (message.header.class, thread::current().name().unwrap_or_default().to_owned());
        self.threads.post((class, name)).expect("the test has room for all of them");
        assert!(!self.breaks || class != Class::Bulk, "it breaks with Bulk");
        Ok(())
    }
}

/// Registers application 1 of the node.
fn witness(node: &Node, breaks: bool) -> EventQueue<(Class, String)> {
    let threads = EventQueue::new(100);
    let sink = Arc::new(Witness { threads: threads.clone(), breaks });
    node.state.ctx.router.set_local(AppAddress::new(0x1001), LocalRoute { sink, events: Arc::new([]) });
    threads
}

fn send(from: &Node, to: &Node, class: Class, correlation: u64) {
    let mut message = from.confirmed(to.tid(1), correlation);
    message.header.class = class;
    from.state.ctx.router.send(message).expect("the peer is linked");
}

#[test]
fn bulk_is_delivered_by_a_thread_of_its_own() {
    run(async {
        let (a, b) = pair().await;
        let mut threads = witness(&b, false).attach();
        for class in [Class::Control, Class::Bulk] {
            send(&a, &b, class, 1);
            let (came, thread) = next("a message", &mut threads).await;
            assert_eq!((came, thread == "bulk"), (class, class == Class::Bulk), "on the thread '{thread}'");
        }
    });
}

#[test]
fn panic_in_bulk_delivery_ends_the_layer() {
    run(async {
        // Given
        let (mut a, mut b) = pair().await;
        witness(&b, true);
        // When
        send(&a, &b, Class::Bulk, 7);
        b.ended().await;
        // Then
        let mut threads = witness(&b, false).attach();
        b.stop_layer();
        b.start_layer().await;
        b.find(a.address(), a.listens_at());
        send(&a, &b, Class::Bulk, 8);
        assert_eq!(next("the outcome of the first", &mut a.settled).await, (7, Outcome::Failed));
        assert_eq!(next("the second", &mut threads).await, (Class::Bulk, "bulk".to_owned()));
    });
}

/// Reports the niceness of the thread that gives it a message.
#[cfg(target_os = "linux")]
struct Niceness(EventQueue<i32>);

#[cfg(target_os = "linux")]
impl MessageSink for Niceness {
    fn submit(&self, _: Message) -> Result<(), SubmitError> {
        let nice = rustix::process::getpriority_process(None).expect("a thread has one");
        self.0.post(nice).expect("the test has room for all of them");
        Ok(())
    }
}

#[cfg(target_os = "linux")]
#[test]
fn bulk_thread_has_lower_priority() {
    run(async {
        let (a, b) = pair().await;
        let seen = EventQueue::new(100);
        let sink = Arc::new(Niceness(seen.clone()));
        b.state.ctx.router.set_local(AppAddress::new(0x1001), LocalRoute { sink, events: Arc::new([]) });
        let mut seen = seen.attach();
        send(&a, &b, Class::Control, 1);
        let control = next("Control", &mut seen).await;
        send(&a, &b, Class::Bulk, 2);
        let bulk = next("Bulk", &mut seen).await;
        assert!(bulk > control || control == 19, "{bulk} is not nicer than {control}");
    });
}
