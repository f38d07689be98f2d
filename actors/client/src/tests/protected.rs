//! Protected payloads of receivers that poll once a cycle and never wait, and of senders that reconnect.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use sinew_runtime::{protection::Protection, time::Time};

use super::{Payload, Registration, TestNode, WATCHDOG};
use crate::{Endpoint, NodeApi, incoming::WhenFull, stall_timeout::Limit};

/// Messages that arrive while the receiver does not poll: more than are needed to arm its guard.
const BACKLOG: usize = 64;

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Speed(u64);

impl Payload for Speed {
    const NAME: &'static str = "test.speed_of_a_loop";
    // Nothing is late on a machine that is busy.
    const PROTECTION: Option<Protection> = Some(Protection::of_period(WATCHDOG));
}

/// Polls until `wanted` messages wait, and handles none.
fn await_waiting(endpoint: &mut Endpoint, wanted: usize) {
    let deadline = Time::now() + WATCHDOG;
    while endpoint.inbox.len() < wanted {
        let now = Time::now();
        assert!(now < deadline, "waited for {wanted} messages, {} arrived", endpoint.inbox.len());
        assert!(endpoint.poll_incoming(None, WhenFull::Leave, now).unwrap().is_none());
    }
}

#[test]
fn polling_once_per_command_arms_guard_after_pause() {
    let node = TestNode::start();
    let api = NodeApi::connect(node.path()).unwrap();
    let mut control = api.register_transport_address(Registration::new()).unwrap();
    let mut drive = api.register_transport_address(Registration::new()).unwrap();
    let guard = drive.guard::<Speed, _>(control.tid(), 1_u64, |speed, _| *speed = 0).unwrap();
    // Given: a backlog, all of it too old
    for sent in 0..BACKLOG {
        control.send(drive.tid(), &Speed(sent as u64)).unwrap();
    }
    await_waiting(&mut drive, BACKLOG);
    // When: one poll for each arriving message
    for cycle in 0..BACKLOG {
        if guard.arm().is_ok() {
            return;
        }
        assert!(drive.receive(Duration::ZERO).unwrap().is_none(), "it is not armed");
        if cycle == 0 {
            await_waiting(&mut control, 1);
        }
        assert!(control.receive(Duration::ZERO).unwrap().is_none(), "an echo is not for the program");
        let waiting = drive.inbox.len();
        control.send(drive.tid(), &Speed(cycle as u64)).unwrap();
        await_waiting(&mut drive, waiting + 1);
    }
    panic!("it was never armed: {:?}", guard.tally());
}

#[test]
fn sender_reconnects_before_it_seals() {
    let mut node = TestNode::start();
    let api = NodeApi::connect(node.path()).unwrap();
    let mut control = api.register_transport_address(Registration::new()).unwrap();
    node.restart();
    let deadline = Time::now() + WATCHDOG;
    while control.node.ended.is_none() {
        assert!(Time::now() < deadline, "waited for the end of the connection");
        let _ = control.poll_incoming(None, WhenFull::Leave, Time::now());
    }
    // With a time of its own there is none for it
    let own = control.tid();
    control.typed(own, &Speed(0), Limit::in_all(Duration::ZERO)).unwrap();
    assert_eq!(control.registrations(), 1);
    while control.registrations() == 1 {
        assert!(Time::now() < deadline, "waited for the endpoint to reconnect");
        control.typed(own, &Speed(0), control.stall_timeout()).unwrap();
    }
}
