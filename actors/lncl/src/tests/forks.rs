//! A client of another process that has forked.

use std::{
    io::{BufRead, BufReader, Write as _},
    os::unix::{net::UnixStream, process::CommandExt},
    process::Stdio,
};

use bytes::BytesMut;
use rustix::process::{Pid, WaitId, WaitIdOptions, waitid};
use sinew_figures::documentation::python_with;
use sinew_runtime::{tid::NodeAddress, wire::encode_frame};

use super::{commands::command, *};

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

/// The frame that registers `name`, in hexadecimal digits.
fn registration(name: &str) -> String {
    let lncl = payload::lncl_of(NodeAddress::HERE);
    let frame = payload::frame(Kind::LNCL_REGISTER, Tid::NONE, lncl, &named(name));
    let mut bytes = BytesMut::new();
    encode_frame(&frame.header, &frame.payload, &mut bytes);
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

// spec: LNCL-15
#[test]
fn killed_client_is_removed_despite_a_forked_child() {
    // Given: a client of another process, and a child of it with all its descriptors.
    let mut node = TestNode::start();
    let app = node.local(1);
    let Some(mut python) = python_with(FORKING) else { return };
    let mut parent = python
        .arg(node.path())
        .arg(registration("drive"))
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

/// Connects and forks. The child registers with the given bytes on request, and prints the kind of the answer.
const FORKING_BEFORE: &str = r#"
import os, signal, socket, sys
client = socket.socket(socket.AF_UNIX)
client.connect(sys.argv[1])
if os.fork():
    signal.pause()
print("forked", flush=True)
sys.stdin.readline()
client.sendall(bytes.fromhex(sys.argv[2]))
print(int.from_bytes(client.recv(4096)[8:12], "little"), flush=True)
"#;

// spec: LNCL-22
#[test]
fn ended_process_does_not_get_a_commands_name() {
    // Given: a process that leads the group of a command, and its connection, which a child of it holds.
    let node = TestNode::start();
    let (port, _) = command(&node);
    let Some(mut python) = python_with(FORKING_BEFORE) else { return };
    let python = python.arg(node.path()).arg(registration("knee")).process_group(0);
    let mut parent =
        python.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("it was there a moment ago");
    let mut child = BufReader::new(parent.stdout.take().expect("it is a pipe")).lines();
    assert_eq!(child.next().expect("the child writes").unwrap(), "forked");
    port.begin(i32::try_from(parent.id()).unwrap());
    // When: it has ended, and its number is still that of its group, as if another process had it.
    let mut input = parent.stdin.take().expect("it is a pipe");
    parent.kill().unwrap();
    let ended = WaitId::Pid(Pid::from_child(&parent));
    waitid(ended, WaitIdOptions::EXITED | WaitIdOptions::NOWAIT).unwrap();
    let can_be_seen = UnixStream::pair().is_ok_and(|(own, _)| sinew_shm::peer_pidfd(own).is_ok());
    input.write_all(b"\n").unwrap();
    // Then:
    let answer: u32 = child.next().expect("the child writes").unwrap().parse().unwrap();
    parent.wait().unwrap();
    if can_be_seen {
        assert_eq!(answer, Kind::LNCL_REFUSAL.bits());
    } else {
        println!("skipped: this kernel gives no descriptor of a peer (Linux 6.5)");
    }
}
