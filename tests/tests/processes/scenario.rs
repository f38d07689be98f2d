//! A node with an application that follows orders, and an endpoint that sends them.

use std::path::PathBuf;

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    process::{Pid, PidfdFlags, Signal, kill_process, pidfd_open, pidfd_send_signal},
};
use sinew::{Endpoint, NodeApi, Outcome, Registration, Tid};
use sinew_testkit::{DEADLINE, NodeProcess, TestDirectory, own_group};
use sinew_tests::{
    orders::{Count, Me, Order, Who},
    process_under_test,
};

/// A node with its application `drive`, and an endpoint called `test`.
pub(crate) struct Scenario {
    pub(crate) node: NodeProcess,
    pub(crate) api: NodeApi,
    pub(crate) endpoint: Endpoint,
    pub(crate) drive: Tid,
    /// The requirement of the application.
    pub(crate) helper: Option<Endpoint>,
    // Last, so that it is removed after its users.
    _directory: TestDirectory,
}

impl Scenario {
    pub(crate) fn start(arguments: &[&str]) -> Self {
        Self::start_all("", None, arguments)
    }

    /// Starts an application that requires an endpoint of this name, which is registered.
    pub(crate) fn start_requiring(name: &str, arguments: &[&str]) -> Self {
        Self::start_all("", Some(name), &[arguments, &["--requires", name]].concat())
    }

    /// Starts it with `more` in its configuration.
    pub(crate) fn start_with(more: &str, arguments: &[&str]) -> Self {
        Self::start_all(more, None, arguments)
    }

    fn start_all(more: &str, required: Option<&str>, arguments: &[&str]) -> Self {
        let directory = TestDirectory::new();
        let mut node = process_under_test(&configuration(&directory, more), arguments);
        node.wait_for(&["is up"]);
        let api = NodeApi::connect(directory.join("robot.sock")).expect("the node is up");
        let helper = required.map(|name| {
            let registration = Registration::new().name(name);
            api.register_transport_address(registration).expect("the name is free")
        });
        let wanted = Registration::new().name("test").requires(["drive"]).deadline(DEADLINE);
        let mut endpoint = api.register_transport_address(wanted).expect("the drive becomes ready");
        let drive = endpoint.resolve("drive", DEADLINE).expect("the node answers").expect("it is ready");
        Self { node, api, endpoint, drive, helper, _directory: directory }
    }

    /// Asks the application for its identity. All counts sent before are handled first: the request has the
    /// same class.
    pub(crate) fn who(&mut self) -> Me {
        self.endpoint.message(self.drive, &Who {}).ask(DEADLINE).expect("the drive answers")
    }

    pub(crate) fn order(&mut self, order: Order) {
        self.endpoint.send(self.drive, &order).expect("the node takes it");
    }

    /// Sends an order to a handler that does not return normally; returns the outcome.
    pub(crate) fn order_confirmed(&mut self, order: Order) -> Outcome {
        self.endpoint.message(self.drive, &order).confirmed(DEADLINE).expect("the node answers")
    }

    /// Counts a number. Earlier messages of its class have been handled when this returns.
    pub(crate) fn count_confirmed(&mut self, number: u64) -> Outcome {
        let outcome = self.endpoint.message(self.drive, &Count { number }).confirmed(DEADLINE);
        outcome.expect("the node answers")
    }

    pub(crate) fn count(&mut self, number: u64) {
        self.endpoint.send(self.drive, &Count { number }).expect("the node takes it");
    }
}

pub(crate) fn configuration(directory: &TestDirectory, more: &str) -> PathBuf {
    let (path, socket) = (directory.join("robot.toml"), directory.join("robot.sock"));
    let text = format!(
        "[node]\nname = \"robot\"\naddress = \"127.0.0.1\"\nproject = \"processes\"\n\
         [lncl]\nsocket = \"{}\"\n[ndl]\nmulticast = \"{}\"\nmdns_port = false\n{more}",
        socket.display(),
        own_group()
    );
    std::fs::write(&path, text).expect("the test's own directory");
    path
}

pub(crate) fn process(id: u32) -> Pid {
    i32::try_from(id).ok().and_then(Pid::from_raw).expect("a process id")
}

pub(crate) fn signal(id: u32, signal: Signal) {
    kill_process(process(id), signal).expect("it is alive");
}

/// A process that another process started, held by a descriptor: its ID cannot be reused meanwhile.
pub(crate) struct Watched(std::os::fd::OwnedFd);

impl Watched {
    pub(crate) fn new(id: u32) -> Self {
        Self(pidfd_open(process(id), PidfdFlags::empty()).expect("it is alive"))
    }

    /// Whether it is alive.
    pub(crate) fn is_alive(&self) -> bool {
        let now = Timespec { tv_sec: 0, tv_nsec: 0 };
        poll(&mut [PollFd::new(&self.0, PollFlags::IN)], Some(&now)) == Ok(0)
    }

    /// Kills it.
    pub(crate) fn kill(&self) {
        pidfd_send_signal(&self.0, Signal::KILL).expect("it is alive");
    }

    /// Waits until it has ended.
    pub(crate) fn wait_for_end(&self) {
        let deadline = Timespec { tv_sec: DEADLINE.as_secs().cast_signed(), tv_nsec: 0 };
        let ended = poll(&mut [PollFd::new(&self.0, PollFlags::IN)], Some(&deadline));
        assert_eq!(ended, Ok(1), "the process lives on after {DEADLINE:?}");
    }
}
