//! A client of another process that has forked.

use std::{
    io::{BufRead, BufReader},
    process::Stdio,
};

use bytes::BytesMut;
use sinew_runtime::{tid::NodeAddress, wire::encode_frame};

use super::*;
use crate::documentation::python_with;

/// Registers with the bytes it is given, forks, and waits to be killed; its child keeps the socket open until it is told to go.
const FORKING: &str = r#"
import os, signal, socket, sys
door = socket.socket(socket.AF_UNIX)
door.connect(sys.argv[1])
door.sendall(bytes.fromhex(sys.argv[2]))
door.recv(4096)
if os.fork():
    signal.pause()
print("forked", flush=True)
sys.stdin.read()
print("still here", flush=True)
"#;

// spec: LNCL-15
#[test]
fn a_client_that_is_killed_is_gone_although_a_child_of_its_holds_its_socket() {
    // Given: a client of another process, and a child of its that has all its descriptors.
    let mut node = TestNode::start();
    let app = node.local(1);
    let frame =
        payload::frame(Kind::LNCL_REGISTER, Tid::NONE, payload::lncl_of(NodeAddress::HERE), &named("drive"));
    let mut bytes = BytesMut::new();
    encode_frame(&frame.header, &frame.payload, &mut bytes);
    let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    let Some(mut python) = python_with(FORKING) else { return };
    let mut parent = python
        .arg(node.path())
        .arg(hex)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("it was there a moment ago");
    let mut child = BufReader::new(parent.stdout.take().expect("it is a pipe")).lines();
    assert_eq!(child.next().expect("the child speaks").unwrap(), "forked");
    let AppFact::Registered { app: drive, .. } = node.fact() else { panic!("no registration") };
    assert_eq!(node.fact(), AppFact::Ready { app: drive });
    let held = node.send_confirmed(app.tid, Tid::new(node.address(), drive), &Angle { degrees: 1.0 });

    // When: the client is killed.
    let telling = parent.stdin.take();
    parent.kill().unwrap();
    parent.wait().unwrap();

    // Then: it is gone, with its name, and what it had in hand has failed; the child is there all the time.
    assert_eq!(node.fact(), AppFact::Unregistered { app: drive });
    assert_eq!(held.recv_timeout(WATCHDOG), Ok(Outcome::Failed));
    RawClient::register(&node, &named("drive"));
    drop(telling);
    assert_eq!(child.next().expect("the child speaks").unwrap(), "still here");
}
