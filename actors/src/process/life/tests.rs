//! What a child hears of the directory.

use std::{os::unix::process::CommandExt, process::Command};

use bytes::{Bytes, BytesMut};
use futures_util::FutureExt;
use rustix::process::{Pid, PidfdFlags, pidfd_open};
use sinew_runtime::{
    mailbox::Mailbox,
    pending::{AppOutlet, Pending},
    router::Outlet,
    tid::{AppAddress, Incarnation, NodeAddress},
    wire::{Header, encode_frame},
};

use super::*;
use crate::{
    NodeConfig,
    lncl::{LocalApp, register_local, unregister_local},
    process::{group::Group, words::NAMES_MAX},
};

/// Nothing takes longer, on a busy machine either.
const WITHIN: Duration = Duration::from_secs(60);

/// Runs a test on one thread.
fn run(test: impl Future<Output = ()>) {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(test);
}

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

fn registers(stores: &Stores, name: &str) -> AppAddress {
    let outlet = Arc::new(AppOutlet { pending: Pending::new(1), inbox: Mailbox::new(1) });
    let (name, events) = (Some(name.to_owned()), Arc::new([]));
    let app = LocalApp { name, address: None, requires: vec![], kinds: vec![], outlet, events };
    register_local(stores, app).unwrap().app
}

/// Says so much to a child that does not read that no more can wait.
fn fill(child: &mut Child) {
    let tid = child.hosted.tid;
    let any = || words::bare(Kind::HOST_STOP, Tid::NONE, tid);
    assert!((0..1_000_000).any(|_| !child.say(any())), "there is room without end");
}

/// Reads its welcome, so that nothing waits for the child.
async fn welcome(child: &Child, theirs: &UnixStream) {
    let mut reader = Reader::new(WORDS_BYTES_MAX);
    tokio::select! {
        error = child.hosted.link.drain(child.number) => panic!("it reads: {error}"),
        frame = tokio::time::timeout(WITHIN, reader.next(theirs)) => {
            let frame = frame.expect("its welcome").unwrap().unwrap();
            assert_eq!(frame.header.kind, Kind::HOST_WELCOME);
        }
    }
}

/// A message to the child, which comes behind a name that it has not been told.
fn message_behind_a_name(child: &Child) -> Kind {
    let (kind, tid) = (Kind::named("test.word"), child.hosted.tid);
    registers(&child.hosted.stores, "late");
    child.hosted.link.submit(Message::new(Header::new(kind, Tid::NONE, tid), Bytes::new())).unwrap();
    kind
}

/// What kinds the child reads, to the first of this one.
async fn kinds_read(child: &mut Child, theirs: UnixStream, last: Kind) -> Vec<Kind> {
    let mut reader = Reader::new(WORDS_BYTES_MAX);
    let hears = async {
        let mut kinds = Vec::new();
        while !kinds.contains(&last) {
            kinds.push(reader.next(&theirs).await.unwrap().unwrap().header.kind);
        }
        kinds
    };
    let stop = Notify::new();
    tokio::select! {
        ended = child.accompany(&stop) => panic!("it lives: {ended:?}"),
        kinds = tokio::time::timeout(WITHIN, hears) => kinds.expect("it comes"),
    }
}

#[test]
fn a_process_joins_groups_only_while_its_application_is_registered() {
    run(async {
        // Given: a process whose application has its address
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let hosted = hosted(&stores);
        let (tid, group) = (hosted.tid, AppAddress::group("legs"));
        let outlet = Arc::new(AppOutlet { pending: Pending::new(1), inbox: Mailbox::new(1) });
        let (address, events) = (Some(tid.app), Arc::new([]));
        let app = LocalApp { name: None, address, requires: vec![], kinds: vec![], outlet, events };
        register_local(&stores, app).unwrap();
        let (mut child, _theirs) = begin(&hosted);
        let membership = payload::Group { group, member: true };
        let joins = || payload::frame(Kind::LNCL_GROUP, tid, Tid::NONE, &membership);
        // When
        child.obey(joins()).unwrap();
        // Then
        assert!(stores.router.is_member(group, tid.app));
        // And: what it says behind its application's end leaves nothing to whoever gets the address next
        unregister_local(&stores, tid.app);
        child.obey(joins()).unwrap();
        assert!(!stores.router.is_member(group, tid.app));
    });
}

#[test]
fn who_holds_the_socket_of_a_dead_process_says_nothing_more_and_what_it_has_said_counts() {
    run(async {
        // Given: the last words of a process, whose socket somebody else holds open
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&stores));
        let ready = words::bare(Kind::HOST_READY, child.hosted.tid, Tid::NONE);
        let mut said = BytesMut::new();
        encode_frame(&ready.header, &ready.payload, &mut said);
        theirs.writable().await.unwrap();
        assert_eq!(theirs.try_write(&said).unwrap(), said.len());
        // When
        assert!(child.hear_the_rest(), "it can be read");
        // Then
        assert!(child.heard.is_some());
        assert_eq!(theirs.try_write(&said).unwrap_err().kind(), io::ErrorKind::BrokenPipe);
    });
}

#[test]
fn a_name_that_comes_between_the_welcome_and_the_listening_is_told() {
    run(async {
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
    run(async {
        // Given: a child that does not read, for which no more can wait
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&stores));
        fill(&mut child);
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
    run(async {
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

#[test]
fn a_name_that_is_asked_for_where_there_is_no_room_is_told_once_the_child_reads() {
    run(async {
        // Given: more names than a child is told, and a child that does not read
        let mut config = NodeConfig::new("test");
        config.lncl.apps_max = 2 * NAMES_MAX;
        let stores = Stores::for_test(config, Incarnation(1));
        for number in 0..=NAMES_MAX {
            registers(&stores, &format!("number {number}"));
        }
        let (mut child, theirs) = begin(&hosted(&stores));
        fill(&mut child);
        // When: it asks for one, and reads
        let look = Look { name: "number 7".to_owned() };
        child.obey(words::frame(Kind::HOST_LOOK, child.hosted.tid, Tid::NONE, &look)).unwrap();
        // Then
        let stop = Notify::new();
        tokio::select! {
            ended = child.accompany(&stop) => panic!("it lives: {ended:?}"),
            names = tokio::time::timeout(WITHIN, names_told(theirs)) => {
                let [name] = &names.unwrap().names[..] else { panic!("it asked for one") };
                assert!(name.name == "number 7" && name.tid.is_some(), "{name:?}");
            }
        }
    });
}

#[test]
fn names_that_come_and_go_while_the_child_does_not_read_do_not_pile_up() {
    run(async {
        // Given: a child that does not read
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&stores));
        fill(&mut child);
        // When: many names come and go
        for number in 0..100 {
            let app = registers(&stores, &format!("passing {number}"));
            child.tell_names();
            unregister_local(&stores, app);
        }
        registers(&stores, "late");
        // Then: it is told what there is
        let stop = Notify::new();
        tokio::select! {
            ended = child.accompany(&stop) => panic!("it lives: {ended:?}"),
            names = tokio::time::timeout(WITHIN, names_told(theirs)) => {
                let names: Vec<_> = names.unwrap().names.into_iter().map(|name| name.name).collect();
                assert_eq!(names, ["late"]);
            }
        }
    });
}

#[test]
fn a_message_behind_names_that_cannot_be_told_does_not_wake_its_thread_again_and_again() {
    run(async {
        // Given: a message behind a name, and no more room
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&stores));
        welcome(&child, &theirs).await;
        let kind = message_behind_a_name(&child);
        fill(&mut child);
        let link = child.hosted.link.clone();
        assert!(link.nudged(child.number).now_or_never().is_some(), "the message waits");
        // When: the name is told in vain
        child.tell_names();
        child.hand_over_held();
        // Then: nothing but time, or the child, helps
        assert!(link.nudged(child.number).now_or_never().is_none(), "it is tried at once again");
        let kinds = kinds_read(&mut child, theirs, kind).await;
        assert!(kinds.contains(&Kind::HOST_NAMES), "the message came before the name");
    });
}

#[test]
fn a_message_that_was_held_waits_for_room_where_there_is_none() {
    run(async {
        // Given: a message behind a name that was told, and no more room
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (mut child, theirs) = begin(&hosted(&stores));
        welcome(&child, &theirs).await;
        let kind = message_behind_a_name(&child);
        child.tell_names();
        fill(&mut child);
        // When: it would go
        child.hand_over_held();
        // Then: it comes once the child reads
        kinds_read(&mut child, theirs, kind).await;
    });
}
