//! A node accepts the examples of the protocol's documentation.

use sinew_figures::documentation::{block, python};

use super::*;

const DOCUMENTATION: &str = include_str!("../../../../docs/protocol/lncl.md");

#[test]
fn documented_bytes_are_a_registration() {
    let node = TestNode::start();
    let text = block(DOCUMENTATION, "## The bytes of a registration", "```text");
    let bytes: Vec<_> = text.split_whitespace().map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
    let mut client = RawClient::connect(&node);
    client.send_bytes(&bytes);
    let tid = client.expect_registered();
    assert_eq!(registrar::resolve(&node.state, "hip"), Some(tid));
}

#[test]
fn documented_client_answers_and_confirms() {
    let Some(mut python) = python(DOCUMENTATION, "## A whole client") else { return };
    let mut node = TestNode::start();
    let mut python = python.arg(node.path()).spawn().expect("it was there a moment ago");
    let AppFact::Registered { app, name, .. } = node.fact() else { panic!("no registration") };
    assert_eq!(name.as_deref(), Some("echo"));
    assert_eq!(node.fact(), AppFact::Ready { app });
    let (mut asking, tid) = RawClient::register(&node, &Register::default());
    node.fact();
    node.fact();
    let mut request = confirmed(tid, Tid::new(node.address(), app), 4);
    request.header.flags = Flags::CONFIRM.with(Flags::ASK);
    asking.send(&request);
    let reply = asking.next().unwrap();
    assert_eq!((reply.header.flags, reply.header.correlation), (Flags::REPLY, 4));
    assert_eq!(reply.decode::<Angle>().unwrap(), Angle { degrees: 1.0 });
    assert_eq!(outcome_of(&asking.next().unwrap()), (4, Outcome::Delivered));
    python.kill().unwrap();
    python.wait().unwrap();
    assert_eq!(node.fact(), AppFact::Unregistered { app }, "a killed process is noticed");
}
