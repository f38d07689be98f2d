//! A child's notifications about the directory.

use std::{os::unix::process::CommandExt, process::Command};

use bytes::{Bytes, BytesMut};
use futures_util::FutureExt;
use rustix::process::{Pid, PidfdFlags, pidfd_open};
use sinew_lncl::{LocalApp, register_local, unregister_local};
use sinew_model::config::NodeConfig;
use sinew_runtime::{
    mailbox::Mailbox,
    pending::{AppSink, Pending},
    router::MessageSink,
    tid::{AppAddress, Incarnation, NodeAddress},
    wire::{Header, encode_frame},
};

use super::*;
use crate::process::{group::Group, protocol::NAMES_MAX};

/// No step takes longer, even on a busy machine.
const WITHIN: Duration = Duration::from_secs(60);

/// Runs a test on one thread.
fn run(test: impl Future<Output = ()>) {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(test);
}

/// A process that does nothing.
#[expect(clippy::zombie_processes, reason = "the owner of the group reaps it")]
fn sleeper() -> Rc<Process> {
    let child = Command::new("sleep").arg("600").process_group(0).spawn().unwrap();
    let pid = Pid::from_child(&child);
    Rc::new(Process::new(Arc::new(Group::new(pid, pidfd_open(pid, PidfdFlags::empty()).unwrap()))).unwrap())
}

fn hosted(state: &Arc<NodeState>) -> Arc<Hosted> {
    Arc::new(Hosted {
        state: state.clone(),
        link: Link::new(state, Mailbox::new(8)),
        tid: Tid::new(NodeAddress::HERE, AppAddress::fixed(1).unwrap()),
        name: "child".to_owned(),
        progress_within: None,
    })
}

/// An incarnation of it, and the child's end of the sockets.
fn begin(hosted: &Arc<Hosted>) -> (Child, UnixStream) {
    let (ours, theirs) = std::os::unix::net::UnixStream::pair().unwrap();
    theirs.set_nonblocking(true).unwrap();
    let child = Child::new(hosted.clone(), sleeper(), ReadyGate::new(|| {}), ours).unwrap();
    (child, UnixStream::from_std(theirs).unwrap())
}

/// The first names that the child reads.
async fn names_read(theirs: UnixStream) -> Names {
    let mut reader = Reader::new(FRAME_BYTES_MAX);
    loop {
        let frame = reader.next(&theirs).await.unwrap().unwrap();
        if frame.header.kind == Kind::HOST_NAMES {
            return payload::read::<Names>(&frame.payload).unwrap();
        }
    }
}

fn registers(state: &NodeState, name: &str) -> AppAddress {
    let sink = Arc::new(AppSink { pending: Pending::new(1), inbox: Mailbox::new(1) });
    let (name, events) = (Some(name.to_owned()), Arc::new([]));
    let app = LocalApp { name, address: None, requires: vec![], kinds: vec![], sink, events };
    register_local(&state.lncl, app).unwrap().app
}

/// Sends frames to a child that does not read, until its queue is full.
fn fill(child: &mut Child) {
    let tid = child.hosted.tid;
    let any = || protocol::empty_frame(Kind::HOST_STOP, Tid::NONE, tid);
    assert!((0..1_000_000).any(|_| !child.send(any())), "there is room without end");
}

/// Reads its welcome, so that nothing waits for the child.
async fn welcome(child: &Child, theirs: &UnixStream) {
    let mut reader = Reader::new(FRAME_BYTES_MAX);
    tokio::select! {
        error = child.hosted.link.drain(child.number) => panic!("it reads: {error}"),
        frame = tokio::time::timeout(WITHIN, reader.next(theirs)) => {
            let frame = frame.expect("its welcome").unwrap().unwrap();
            assert_eq!(frame.header.kind, Kind::HOST_WELCOME);
        }
    }
}

/// Submits a message to the child behind a name that it does not know yet. Returns its kind.
fn message_behind_a_name(child: &Child) -> Kind {
    let (kind, tid) = (Kind::named("test.word"), child.hosted.tid);
    registers(&child.hosted.state, "late");
    child.hosted.link.submit(Message::new(Header::new(kind, Tid::NONE, tid), Bytes::new())).unwrap();
    kind
}

/// Returns the kinds of the frames that the child reads, up to the first one of kind `last`.
async fn kinds_read(child: &mut Child, theirs: UnixStream, last: Kind) -> Vec<Kind> {
    let mut reader = Reader::new(FRAME_BYTES_MAX);
    let read = async {
        let mut kinds = Vec::new();
        while !kinds.contains(&last) {
            kinds.push(reader.next(&theirs).await.unwrap().unwrap().header.kind);
        }
        kinds
    };
    let stop = Notify::new();
    tokio::select! {
        ended = child.run(&stop) => panic!("it lives: {ended:?}"),
        kinds = tokio::time::timeout(WITHIN, read) => kinds.expect("it comes"),
    }
}

#[test]
fn groups_are_joined_only_while_registered() {
    run(async {
        // Given: a process with a registered application
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let hosted = hosted(&state);
        let (tid, group) = (hosted.tid, AppAddress::group("legs"));
        let sink = Arc::new(AppSink { pending: Pending::new(1), inbox: Mailbox::new(1) });
        let (address, events) = (Some(tid.app), Arc::new([]));
        let app = LocalApp { name: None, address, requires: vec![], kinds: vec![], sink, events };
        register_local(&state.lncl, app).unwrap();
        let (mut child, _theirs) = begin(&hosted);
        let membership = payload::Group { group, member: true };
        let joins = || payload::frame(Kind::LNCL_GROUP, tid, Tid::NONE, &membership);
        // When
        child.handle_frame(joins()).unwrap();
        // Then
        assert!(state.ctx.router.is_member(group, tid.app));
        // And: a frame after the end of its application has no effect on the next owner of the address
        unregister_local(&state.lncl, tid.app);
        child.handle_frame(joins()).unwrap();
        assert!(!state.ctx.router.is_member(group, tid.app));
    });
}

#[test]
fn dead_process_socket_is_closed_after_last_frame() {
    run(async {
        // Given: the last frame of a process; another process holds its socket open
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&state));
        let ready = protocol::empty_frame(Kind::HOST_READY, child.hosted.tid, Tid::NONE);
        let mut frame = BytesMut::new();
        encode_frame(&ready.header, &ready.payload, &mut frame);
        theirs.writable().await.unwrap();
        assert_eq!(theirs.try_write(&frame).unwrap(), frame.len());
        // When
        assert!(child.drain(), "it can be read");
        // Then
        assert!(child.last_frame_at.is_some());
        assert_eq!(theirs.try_write(&frame).unwrap_err().kind(), io::ErrorKind::BrokenPipe);
    });
}

#[test]
fn name_registered_after_welcome_is_sent() {
    run(async {
        // Given: a child that was welcomed
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&state));
        // When
        registers(&state, "late");
        // Then
        let stop = Notify::new();
        tokio::select! {
            ended = child.run(&stop) => panic!("it lives: {ended:?}"),
            names = tokio::time::timeout(WITHIN, names_read(theirs)) => {
                assert!(names.unwrap().names.iter().any(|name| name.name == "late"));
            }
        }
    });
}

#[test]
fn refused_names_are_sent_once_child_reads() {
    run(async {
        // Given: a child that does not read, for which no more can wait
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&state));
        fill(&mut child);
        registers(&state, "late");
        child.send_names();
        child.changes.mark_unchanged();
        // When: it reads
        let stop = Notify::new();
        tokio::select! {
            ended = child.run(&stop) => panic!("it lives: {ended:?}"),
            names = tokio::time::timeout(WITHIN, names_read(theirs)) => {
                assert!(names.unwrap().names.iter().any(|name| name.name == "late"));
            }
        }
    });
}

#[test]
fn lookups_of_former_child_do_not_reach_next() {
    run(async {
        // Given: two lives of a child, the former with a supervisor that was held up
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let hosted = hosted(&state);
        let (mut former, _theirs) = begin(&hosted);
        let (mut present, theirs) = begin(&hosted);
        registers(&state, "late");
        // When: the former one continues
        former.send_names();
        present.send(protocol::empty_frame(Kind::HOST_STOP, Tid::NONE, hosted.tid));
        // Then: the next one receives frames from its own supervisor only
        let mut reader = Reader::new(FRAME_BYTES_MAX);
        let read = async {
            let mut kinds = Vec::new();
            while !kinds.contains(&Kind::HOST_STOP) {
                kinds.push(reader.next(&theirs).await.unwrap().unwrap().header.kind);
            }
            kinds
        };
        let writes = hosted.link.drain(present.number);
        let kinds = tokio::select! {
            error = writes => panic!("it reads: {error}"),
            kinds = tokio::time::timeout(WITHIN, read) => kinds.unwrap(),
        };
        assert_eq!(kinds, [Kind::HOST_WELCOME, Kind::HOST_STOP]);
    });
}

#[test]
fn refused_lookup_is_answered_once_child_reads() {
    run(async {
        // Given: more names than a child is sent, and a child that does not read
        let mut config = NodeConfig::new("test");
        config.lncl.apps_max = 2 * NAMES_MAX;
        let state = NodeState::for_test(config, Incarnation(1));
        for number in 0..=NAMES_MAX {
            registers(&state, &format!("number {number}"));
        }
        let (mut child, theirs) = begin(&hosted(&state));
        fill(&mut child);
        // When: it looks one up, and reads
        let look = NameLookup { name: "number 7".to_owned() };
        child.handle_frame(protocol::frame(Kind::HOST_LOOK, child.hosted.tid, Tid::NONE, &look)).unwrap();
        // Then
        let stop = Notify::new();
        tokio::select! {
            ended = child.run(&stop) => panic!("it lives: {ended:?}"),
            names = tokio::time::timeout(WITHIN, names_read(theirs)) => {
                let [name] = &names.unwrap().names[..] else { panic!("it asked for one") };
                assert!(name.name == "number 7" && name.tid.is_some(), "{name:?}");
            }
        }
    });
}

#[test]
fn changing_names_do_not_pile_up_for_stuck_child() {
    run(async {
        // Given: a child that does not read
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&state));
        fill(&mut child);
        // When: many names come and go
        for number in 0..100 {
            let app = registers(&state, &format!("passing {number}"));
            child.send_names();
            unregister_local(&state.lncl, app);
        }
        registers(&state, "late");
        // Then: it receives the present names
        let stop = Notify::new();
        tokio::select! {
            ended = child.run(&stop) => panic!("it lives: {ended:?}"),
            names = tokio::time::timeout(WITHIN, names_read(theirs)) => {
                let names: Vec<_> = names.unwrap().names.into_iter().map(|name| name.name).collect();
                assert_eq!(names, ["late"]);
            }
        }
    });
}

#[test]
fn message_behind_blocked_names_does_not_spin() {
    run(async {
        // Given: a message behind a name, and no more room
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&state));
        welcome(&child, &theirs).await;
        let kind = message_behind_a_name(&child);
        fill(&mut child);
        let link = child.hosted.link.clone();
        assert!(link.names_needed(child.number).now_or_never().is_some(), "the message waits");
        // When: the name cannot be sent
        child.send_names();
        child.hand_over_held();
        // Then: nothing but time, or the child, helps
        assert!(link.names_needed(child.number).now_or_never().is_none(), "it is tried at once again");
        let kinds = kinds_read(&mut child, theirs, kind).await;
        assert!(kinds.contains(&Kind::HOST_NAMES), "the message came before the name");
    });
}

#[test]
fn held_message_waits_for_room() {
    run(async {
        // Given: a message behind a known name, and no more room
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&state));
        welcome(&child, &theirs).await;
        let kind = message_behind_a_name(&child);
        child.send_names();
        fill(&mut child);
        // When: it would go
        child.hand_over_held();
        // Then: it arrives once the child reads
        kinds_read(&mut child, theirs, kind).await;
    });
}
