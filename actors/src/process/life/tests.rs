//! What a child hears of the directory.

use std::{os::unix::process::CommandExt, process::Command};

use rustix::process::{Pid, PidfdFlags, pidfd_open};
use sinew_runtime::{
    mailbox::Mailbox,
    pending::{AppOutlet, Pending},
    tid::{AppAddress, Incarnation, NodeAddress},
};

use super::*;
use crate::{
    NodeConfig,
    lncl::{LocalApp, register_local},
    process::group::Group,
};

/// Nothing takes longer, on a busy machine either.
const WITHIN: Duration = Duration::from_secs(60);

/// A process that does nothing.
#[expect(clippy::zombie_processes, reason = "whoever has the group reaps it")]
fn sleeper() -> Rc<Process> {
    let child = Command::new("sleep").arg("600").process_group(0).spawn().unwrap();
    let pid = Pid::from_child(&child);
    Rc::new(Process::new(Arc::new(Group::new(pid, pidfd_open(pid, PidfdFlags::empty()).unwrap()))).unwrap())
}

fn hosted(stores: &Arc<Stores>) -> Arc<Hosted> {
    Arc::new(Hosted {
        stores: stores.clone(),
        link: Link::new(stores, Mailbox::new(8)),
        tid: Tid::new(NodeAddress::HERE, AppAddress::fixed(1).unwrap()),
        name: "child".to_owned(),
        progress_within: None,
    })
}

/// A life of it, and the child's end of the sockets.
fn begin(hosted: &Arc<Hosted>) -> (Child, UnixStream) {
    let (ours, theirs) = std::os::unix::net::UnixStream::pair().unwrap();
    theirs.set_nonblocking(true).unwrap();
    let child = Child::new(hosted.clone(), sleeper(), ReadyGate::new(|| {}), ours).unwrap();
    (child, UnixStream::from_std(theirs).unwrap())
}

/// The first names that the child reads.
async fn names_told(theirs: UnixStream) -> Names {
    let mut reader = Reader::new(WORDS_BYTES_MAX);
    loop {
        let frame = reader.next(&theirs).await.unwrap().unwrap();
        if frame.header.kind == Kind::HOST_NAMES {
            return payload::read::<Names>(&frame.payload).unwrap();
        }
    }
}

fn registers(stores: &Stores, name: &str) {
    let outlet = Arc::new(AppOutlet { pending: Pending::new(1), inbox: Mailbox::new(1) });
    let (name, events) = (Some(name.to_owned()), Arc::new([]));
    let app = LocalApp { name, address: None, requires: vec![], kinds: vec![], outlet, events };
    register_local(stores, app).unwrap();
}

#[test]
fn a_name_that_comes_between_the_welcome_and_the_listening_is_told() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        // Given: a child that was welcomed
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&stores));
        // When
        registers(&stores, "late");
        // Then
        let stop = Notify::new();
        tokio::select! {
            ended = child.accompany(&stop) => panic!("it lives: {ended:?}"),
            names = tokio::time::timeout(WITHIN, names_told(theirs)) => {
                assert!(names.unwrap().names.iter().any(|name| name.name == "late"));
            }
        }
    });
}

#[test]
fn names_that_there_was_no_room_for_are_told_once_the_child_reads() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        // Given: a child that does not read, for which no more can wait
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&stores));
        let tid = child.hosted.tid;
        let any = || words::bare(Kind::HOST_STOP, Tid::NONE, tid);
        assert!((0..1_000_000).any(|_| !child.say(any())), "there is room without end");
        registers(&stores, "late");
        child.tell_names();
        child.changes.mark_unchanged();
        // When: it reads
        let stop = Notify::new();
        tokio::select! {
            ended = child.accompany(&stop) => panic!("it lives: {ended:?}"),
            names = tokio::time::timeout(WITHIN, names_told(theirs)) => {
                assert!(names.unwrap().names.iter().any(|name| name.name == "late"));
            }
        }
    });
}

#[test]
fn names_that_were_looked_up_for_a_former_child_do_not_reach_the_next_one() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        // Given: two lives of a child, the former with a supervisor that was held up
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let hosted = hosted(&stores);
        let (mut former, _theirs) = begin(&hosted);
        let (mut present, theirs) = begin(&hosted);
        registers(&stores, "late");
        // When: it goes on
        former.tell_names();
        present.say(words::bare(Kind::HOST_STOP, Tid::NONE, hosted.tid));
        // Then: the next one hears its own supervisor alone
        let mut reader = Reader::new(WORDS_BYTES_MAX);
        let hears = async {
            let mut kinds = Vec::new();
            while !kinds.contains(&Kind::HOST_STOP) {
                kinds.push(reader.next(&theirs).await.unwrap().unwrap().header.kind);
            }
            kinds
        };
        let writes = hosted.link.drain(present.number);
        let kinds = tokio::select! {
            error = writes => panic!("it reads: {error}"),
            kinds = tokio::time::timeout(WITHIN, hears) => kinds.unwrap(),
        };
        assert_eq!(kinds, [Kind::HOST_WELCOME, Kind::HOST_STOP]);
    });
}
