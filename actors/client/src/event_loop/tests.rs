//! Properties of an event loop's descriptor. The suite of claims (`crate::tests`) runs on it, too.

use std::{
    os::fd::AsFd,
    pin::{Pin, pin},
    task::Poll,
    time::Duration,
};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use sinew_lncl::testing::{TestNode, WATCHDOG};
use sinew_runtime::{time::Time, wire::Message};

use super::{EventLoop, is_ready};
use crate::{
    ApiError, AsyncEndpoint, DirectLinks, NodeApi, Registration, Transport,
    tests::{TORQUE, Torque},
};

const BOTH: [Transport; 2] = [Transport::Ring, Transport::Socket];

/// Runs a future to its end, as an event loop does.
pub(crate) fn run<T>(events: &EventLoop, future: impl Future<Output = T>) -> T {
    run_within(events, Duration::MAX, future).expect("there is always a later time")
}

/// The same; `None` if it is not ready within this time.
pub(crate) fn run_within<T>(
    events: &EventLoop,
    within: Duration,
    future: impl Future<Output = T>,
) -> Option<T> {
    let deadline = Time::now() + within;
    let mut future = pin!(future);
    loop {
        if let Poll::Ready(value) = events.poll(future.as_mut()) {
            return Some(value);
        }
        let now = Time::now();
        if now >= deadline {
            return None;
        }
        let until = events.wake_in().map_or(deadline, |left| deadline.min(now + left));
        let left = Timespec::try_from(until.since(now)).ok();
        poll(&mut [PollFd::new(events, PollFlags::IN)], left.as_ref()).expect("it is a descriptor");
    }
}

fn endpoint(node: &TestNode, transport: Transport) -> (AsyncEndpoint, EventLoop) {
    let (api, events) = (NodeApi::connect(node.path()).unwrap(), EventLoop::new().unwrap());
    let registration = Registration::new().transport(transport).deadline(WATCHDOG);
    let endpoint = run(&events, api.register_transport_address_on(registration, events.clone())).unwrap();
    (endpoint, events)
}

/// Polls until nothing is left to do.
fn poll_until_silent<F: Future>(events: &EventLoop, mut future: Pin<&mut F>) -> Option<F::Output> {
    let deadline = Time::now() + WATCHDOG;
    loop {
        assert!(Time::now() < deadline, "the descriptor is always readable");
        if let Poll::Ready(value) = events.poll(future.as_mut()) {
            return Some(value);
        }
        if !is_ready(events.as_fd(), PollFlags::IN) {
            return None;
        }
    }
}

fn await_readable(events: &EventLoop) {
    let left = Timespec::try_from(WATCHDOG).ok();
    let ready = poll(&mut [PollFd::new(events, PollFlags::IN)], left.as_ref());
    assert_eq!(ready, Ok(1), "waited for the descriptor");
}

#[test]
fn descriptor_is_readable_only_after_an_event() {
    for transport in BOTH {
        // Given
        let node = TestNode::start();
        let app = node.local(1);
        let (mut endpoint, events) = endpoint(&node, transport);
        let tid = endpoint.tid();
        for _ in 0..300 {
            let mut receiving = pin!(endpoint.receive());
            assert!(poll_until_silent(&events, receiving.as_mut()).is_none());
            assert_eq!(events.wake_in(), None, "nothing is to be done at rest");
            // When
            node.router().send(Message::typed(app.tid, tid, &TORQUE)).unwrap();
            // Then
            await_readable(&events);
            let received = run(&events, receiving).unwrap();
            assert_eq!(received.decode::<Torque>().unwrap(), TORQUE);
        }
    }
}

#[test]
fn message_on_direct_link_makes_descriptor_readable() {
    // Given: two endpoints with a link
    let node = TestNode::start();
    let linked = || {
        let (api, events) = (NodeApi::connect(node.path()).unwrap(), EventLoop::new().unwrap());
        let registration = Registration::new().direct(DirectLinks::Always).deadline(WATCHDOG);
        let endpoint = run(&events, api.register_transport_address_on(registration, events.clone())).unwrap();
        (endpoint, events)
    };
    let ((mut one, events), (mut other, others)) = (linked(), linked());
    let (tid, deadline) = (one.tid(), Time::now() + WATCHDOG);
    while one.endpoint.direct.open.is_empty() || other.endpoint.direct.open.is_empty() {
        assert!(Time::now() < deadline, "they have no link");
        run(&others, other.send(tid, &TORQUE)).unwrap();
        drop(run(&events, one.receive()).unwrap());
    }
    for _ in 0..300 {
        let mut receiving = pin!(one.receive());
        assert!(poll_until_silent(&events, receiving.as_mut()).is_none());
        // When
        run(&others, other.send(tid, &TORQUE)).unwrap();
        // Then
        await_readable(&events);
        assert_eq!(run(&events, receiving).unwrap().source(), other.tid());
    }
    // Its end is an event, too, and messages go through the node from then on.
    drop(other);
    let (mut other, others) = linked();
    run(&others, other.send(tid, &TORQUE)).unwrap();
    assert_eq!(run(&events, one.receive()).unwrap().source(), other.tid());
}

#[test]
fn end_of_node_makes_descriptor_readable() {
    for transport in BOTH {
        let mut node = TestNode::start();
        let (mut endpoint, events) = endpoint(&node, transport);
        let mut receiving = pin!(endpoint.receive());
        assert!(poll_until_silent(&events, receiving.as_mut()).is_none());
        node.stop();
        let result = run_within(&events, WATCHDOG, receiving).expect("it is an event");
        assert!(matches!(result, Err(ApiError::Disconnected(_))), "{result:?}");
    }
}

#[test]
fn dropped_receive_loses_no_message() {
    for transport in BOTH {
        let node = TestNode::start();
        let app = node.local(1);
        let (mut endpoint, events) = endpoint(&node, transport);
        let tid = endpoint.tid();
        let mut received = 0;
        for _ in 0..20 {
            // The pinned futures are dropped with each turn: the last one was waiting when a message came.
            while poll_until_silent(&events, pin!(endpoint.receive())).is_some() {
                received += 1;
            }
            let mut receiving = pin!(endpoint.receive());
            assert!(poll_until_silent(&events, receiving.as_mut()).is_none());
            node.router().send(Message::typed(app.tid, tid, &TORQUE)).unwrap();
            await_readable(&events);
        }
        while received < 20 {
            assert_eq!(run(&events, endpoint.receive()).unwrap().source(), app.tid);
            received += 1;
        }
        assert!(poll_until_silent(&events, pin!(endpoint.receive())).is_none(), "none came twice");
    }
}

#[test]
fn registration_waits_without_blocking_the_thread() {
    // Given: a requirement that is not there
    let node = TestNode::start();
    let (api, events) = (NodeApi::connect(node.path()).unwrap(), EventLoop::new().unwrap());
    let registration = Registration::new().requires(["knee"]).deadline(Duration::from_millis(50));
    // When
    let mut registering = pin!(api.register_transport_address_on(registration, events.clone()));
    assert!(events.poll(registering.as_mut()).is_pending());
    assert!(events.wake_in().is_some(), "its deadline");
    // Then
    let error = run(&events, registering).err();
    assert!(matches!(error, Some(ApiError::Waiting { .. } | ApiError::NoAnswer(_))), "{error:?}");
}

#[test]
fn sleep_ends_at_its_deadline() {
    let events = EventLoop::new().unwrap();
    let deadline = Time::now() + Duration::from_millis(30);
    run(&events, events.sleep_until(deadline));
    assert!(Time::now() >= deadline);
}

#[test]
fn waker_from_another_thread_makes_descriptor_readable() {
    let events = EventLoop::new().unwrap();
    let mut asked = false;
    let mut future = pin!(std::future::poll_fn(|cx| {
        if std::mem::replace(&mut asked, true) {
            return Poll::Ready(());
        }
        let waker = cx.waker().clone();
        std::thread::spawn(move || waker.wake());
        Poll::Pending
    }));
    assert!(events.poll(future.as_mut()).is_pending());
    await_readable(&events);
    assert!(events.poll(future.as_mut()).is_ready());
}
