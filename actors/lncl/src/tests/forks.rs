//! A client of another process that has forked.

use std::{
    io::{BufRead, BufReader},
    process::Stdio,
};

use bytes::BytesMut;
use sinew_figures::documentation::python_with;
use sinew_runtime::{tid::NodeAddress, wire::encode_frame};

use super::*;

/// Registers with the given bytes, forks, and waits to be killed; its child keeps the socket open until it is
/// requested to end.
const FORKING: &str = r#"
import os, signal, socket, sys
client = socket.socket(socket.AF_UNIX)
client.connect(sys.argv[1])
client.sendall(bytes.fromhex(sys.argv[2]))
client.recv(4096)
if os.fork():
    signal.pause()
print("forked", flush=True)
sys.stdin.read()
print("still here", flush=True)
"#;

// spec: LNCL-15
#[test]
fn killed_client_is_removed_despite_a_forked_child() {
    // Given: a client of another process, and a child of it with all its descriptors.
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
    assert_eq!(child.next().expect("the child writes").unwrap(), "forked");
    let AppFact::Registered { app: drive, .. } = node.fact() else { panic!("no registration") };
    assert_eq!(node.fact(), AppFact::Ready { app: drive });
    let held = node.send_confirmed(app.tid, Tid::new(node.address(), drive), &Angle { degrees: 1.0 });

    // When: the client is killed.
    let child_input = parent.stdin.take();
    parent.kill().unwrap();
    parent.wait().unwrap();

    // Then: it is gone, with its name, and its messages in hand have failed; the child is present all the time.
    assert_eq!(node.fact(), AppFact::Unregistered { app: drive });
    assert_eq!(held.recv_timeout(WATCHDOG), Ok(Outcome::Failed));
    RawClient::register(&node, &named("drive"));
    drop(child_input);
    assert_eq!(child.next().expect("the child writes").unwrap(), "still here");
}
