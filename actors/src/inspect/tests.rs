//! What becomes of questions: answered within bounds, refused, or too many.

use std::sync::mpsc::sync_channel;

use sinew_runtime::{
    outcome::Rejection,
    router::Outlet as _,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    wire::{Header, Kind, Message, decode, encode},
};

use super::{
    inspector::{Inbox, WAITING_MAX},
    reports::{AppReport, AppsReport, Report as _},
};
use crate::{config::NodeConfig, stores::Stores};

fn question() -> Message {
    Message::new(Header::new(Kind::PING, Tid::NONE, Tid::NONE), bytes::Bytes::new())
}

fn report(count: u32) -> AppsReport {
    let app = |number: u32| AppReport {
        tid: Tid::new(NodeAddress::from([127, 0, 0, 1]), AppAddress::new(0x1000 + number)),
        name: Some(format!("app{number}")),
        ready: true,
        waits_us: None,
        missing: Vec::new(),
        ended: None,
    };
    AppsReport { name: "knee".to_owned(), apps: (0..count).map(app).collect(), left_out: 0 }
}

#[test]
fn more_questions_than_may_wait_are_refused() {
    // Given: nobody answers
    let (put, _questions) = sync_channel(WAITING_MAX);
    let inbox = Inbox(put);
    (0..WAITING_MAX).for_each(|_| assert!(inbox.submit(question()).is_ok()));
    // When, then
    assert_eq!(inbox.submit(question()).expect_err("one too many").why, Rejection::QueueFull);
}

#[test]
fn the_thread_that_answers_does_not_keep_a_node_alive() {
    let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
    super::begin(&stores).expect("a thread");
    let weak = std::sync::Arc::downgrade(&stores);
    drop(stores);
    assert!(weak.upgrade().is_none(), "nobody has asked, so that nobody has it in hand");
}

#[test]
fn what_has_no_room_in_an_answer_is_counted() {
    let mut apps = report(5);
    assert!(apps.halve());
    assert_eq!((apps.apps.len(), apps.left_out), (2, 3));
    assert!(apps.halve() && apps.halve());
    assert_eq!((apps.apps.len(), apps.left_out), (0, 5));
    assert!(!apps.halve());
}

#[test]
fn an_answer_has_its_maximum_of_entries_and_not_one_more() {
    assert!(decode::<AppsReport>(&encode(&report(super::APPS_MAX as u32))).is_ok());
    assert!(decode::<AppsReport>(&encode(&report(super::APPS_MAX as u32 + 1))).is_err());
}
