//! Another process with the other end of a connection: this test program again, with a socket as its input.

use std::{
    io::{BufRead, BufReader},
    os::{
        fd::{AsFd, OwnedFd},
        unix::{fs::MetadataExt, net::UnixStream},
    },
    process::{Child, ChildStdout, Command, ExitStatus, Stdio},
    time::Duration,
};

use rustix::process::{Pid, PidfdFlags, pidfd_open};
use sinew_shm::{BellKind, Capacity, Consumer, HangUp, Offer, Producer, Region, Terms, Wait};

/// The environment variable that tells a process its role.
const ROLE: &str = "SINEW_SHM_ROLE";

pub(crate) const BELLS: [BellKind; 3] = [BellKind::Futex, BellKind::EventFd, BellKind::Socket];
pub(crate) const CAPACITY: u64 = 64 * 1024;

/// The task of the other process after it has connected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    /// Returns each message, until its peer is gone.
    Echo,
    /// Publishes "before", takes a loan and writes into it, reports it, and stays.
    HoldsLoan,
    /// Receives a message, reports it, and stays, holding the message.
    HoldsMessage,
    /// Sends numbered messages as fast as there is room, holding a loan or a message at any time.
    Sprays,
    /// Receives numbered messages until its peer is gone; succeeds if that is how it ended.
    Counts,
}

impl Role {
    const ALL: [Self; 5] = [Self::Echo, Self::HoldsLoan, Self::HoldsMessage, Self::Sprays, Self::Counts];
}

/// The line of a process that has reached its state.
const SO_FAR: &str = "so far";

/// A wait for an immediate event, on a machine that others share.
pub(crate) fn soon() -> Wait<'static> {
    Wait::within(Duration::from_secs(30))
}

/// The other process. Killed when dropped.
pub(crate) struct Peer {
    child: Child,
    output: BufReader<ChildStdout>,
    pub(crate) pidfd: OwnedFd,
}

impl Peer {
    /// Starts it with one end of a socket.
    pub(crate) fn start(role: Role, bell: BellKind, socket: UnixStream) -> Self {
        let program = std::env::current_exe().expect("this program has a path");
        let mut child = Command::new(program)
            .args(["--ignored", "--exact", "the_other_process", "--nocapture"])
            .env(ROLE, format!("{role:?} {bell:?}"))
            .stdin(Stdio::from(OwnedFd::from(socket)))
            .stdout(Stdio::piped())
            .spawn()
            .expect("another process");
        let pidfd = pidfd_open(Pid::from_child(&child), PidfdFlags::empty()).expect("it was just started");
        let output = BufReader::new(child.stdout.take().expect("it is a pipe"));
        Self { child, output, pidfd }
    }

    /// Waits for its report.
    pub(crate) fn has_come_so_far(&mut self) {
        let mut lines = (&mut self.output).lines().map_while(Result::ok);
        assert!(lines.any(|line| line.ends_with(SO_FAR)), "it ended before it came so far");
    }

    pub(crate) fn hang_up(&self) -> HangUp<'_> {
        HangUp::Process(self.pidfd.as_fd())
    }

    /// As `kill -9` does.
    pub(crate) fn kill(&mut self) {
        self.child.kill().expect("it was not waited for");
    }

    pub(crate) fn wait(&mut self) -> ExitStatus {
        self.child.wait().expect("it is a child of this process")
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// One side's ends, and the inode numbers of both sides' memory.
pub(crate) struct Connected {
    pub(crate) producer: Producer,
    pub(crate) consumer: Consumer,
    pub(crate) memory: Vec<u64>,
}

/// Exchanges offers over a socket.
pub(crate) fn connect(bell: BellKind, socket: impl AsFd) -> Connected {
    let (region, ours) =
        Region::create(Capacity::new(CAPACITY).expect("a power of two"), bell).expect("a region");
    ours.send(&socket).expect("an empty socket");
    let theirs = Offer::receive(&socket).expect("whole").expect("an offer");
    let memory = [&ours, &theirs].into_iter().flat_map(inodes).collect();
    let terms = Terms { bells: BELLS.to_vec(), ..Terms::default() };
    let (producer, consumer) = region.connect(theirs, &terms).expect("the same program's");
    Connected { producer, consumer, memory }
}

fn inodes(offer: &Offer) -> Vec<u64> {
    let files = offer.descriptors().iter().map(|fd| fd.try_clone().map(std::fs::File::from));
    // Event descriptors all have the same number, which identifies nothing.
    let memory = if offer.bell() == BellKind::Futex { 2 } else { 1 };
    files.take(memory).map(|file| file.and_then(|file| file.metadata()).expect("it is open").ino()).collect()
}

/// The processes that have one of these pieces of memory mapped or open, as lines of `/proc`.
pub(crate) fn holders(memory: &[u64]) -> Vec<String> {
    let processes = std::fs::read_dir("/proc").expect("it is there").flatten();
    let processes = processes.filter(|entry| entry.file_name().to_string_lossy().parse::<u32>().is_ok());
    let mut found = Vec::new();
    for process in processes {
        // A process may end while it is inspected.
        let maps = std::fs::read_to_string(process.path().join("maps")).unwrap_or_default();
        let held = maps.lines().filter(|line| line.contains("sinew-ring") && is_one_of(line, memory));
        found.extend(held.map(|line| format!("{}: {line}", process.path().display())));
        for open in std::fs::read_dir(process.path().join("fd")).into_iter().flatten().flatten() {
            let is_memory = open.path().metadata().is_ok_and(|it| memory.contains(&it.ino()));
            let name = std::fs::read_link(open.path()).unwrap_or_default();
            if is_memory && name.to_string_lossy().contains("sinew-ring") {
                found.push(format!("{}: {}", open.path().display(), name.display()));
            }
        }
    }
    found
}

fn is_one_of(line: &str, memory: &[u64]) -> bool {
    line.split_whitespace().nth(4).and_then(|inode| inode.parse().ok()).is_some_and(|it| memory.contains(&it))
}

/// The numbered message: length and content follow from its number.
pub(crate) fn numbered(number: u64) -> Vec<u8> {
    let mut bytes = number.to_le_bytes().to_vec();
    bytes.resize(8 + (number * 7919 % 3000) as usize, number as u8);
    bytes
}

/// The main function of the other process.
pub(crate) fn play() {
    let Ok(role) = std::env::var(ROLE) else {
        return;
    };
    let (role, bell) = role.split_once(' ').expect("two words");
    let role = Role::ALL.into_iter().find(|it| format!("{it:?}") == role).expect("a role");
    let bell = BELLS.into_iter().find(|it| format!("{it:?}") == bell).expect("a bell");
    let socket = rustix::io::dup(rustix::stdio::stdin()).expect("the socket is the input");
    let mut connected = connect(bell, &socket);
    match role {
        Role::Echo => echo(&mut connected, &socket),
        Role::HoldsLoan => holds_loan(&mut connected, &socket),
        Role::HoldsMessage => holds_message(&mut connected, &socket),
        Role::Sprays => sprays(&mut connected),
        Role::Counts => counts(&mut connected, &socket),
    }
}

fn echo(connected: &mut Connected, socket: &OwnedFd) {
    let wait = soon().or_hang_up(HangUp::Socket(socket.as_fd()));
    while let Ok(lent) = connected.consumer.receive_before(&wait) {
        let mut loan = connected.producer.loan_before(lent.len(), &wait).expect("it takes what it sent");
        lent.copy_to(&mut loan);
        loan.publish();
    }
}

fn holds_loan(connected: &mut Connected, socket: &OwnedFd) {
    connected.producer.send(b"before").expect("an empty ring");
    let mut loan = connected.producer.loan(1000).expect("room");
    loan.fill(66);
    say_and_stay(socket);
    drop(loan);
}

fn holds_message(connected: &mut Connected, socket: &OwnedFd) {
    let lent = connected.consumer.receive_before(&soon()).expect("a message");
    say_and_stay(socket);
    drop(lent);
}

fn say_and_stay(socket: &OwnedFd) {
    println!("{SO_FAR}");
    // Until the test kills this process, or ends itself.
    let _ = rustix::io::read(socket, &mut [0; 1]);
}

fn sprays(connected: &mut Connected) {
    println!("{SO_FAR}");
    for number in 0.. {
        let message = numbered(number);
        let Ok(mut loan) = connected.producer.loan_before(message.len(), &soon()) else {
            return;
        };
        loan.copy_from_slice(&message);
        loan.publish();
        while connected.consumer.receive().expect("an honest peer").is_some() {}
    }
}

fn counts(connected: &mut Connected, socket: &OwnedFd) {
    let wait = soon().or_hang_up(HangUp::Socket(socket.as_fd()));
    for number in 0.. {
        match connected.consumer.receive_before(&wait) {
            Ok(lent) => assert_eq!(lent.to_vec(), numbered(number)),
            Err(sinew_shm::ReceiveError::HungUp) => return,
            Err(error) => panic!("{error}"),
        }
        if number == 100 {
            println!("{SO_FAR}");
        }
    }
}
